// Warps: they push displaced coordinates.  warp.py says what they mean.

#include "tree.h"
#include "noise.h"

// p = {centre x, y from the frame's origin, 1 / radius, angle back, what to take off x, y}
static void tree_twist(State *s, P p, N n, D data)
{
    const float8 east = s->x - p[0], north = s->y - p[1];
    const float8 t = fmin((east * east + north * north) * (p[2] * p[2]), 1.0f), u = 1.0f - t;
    const float8 turn = p[3] * (u * u * u);
    const float8 half_sine = sin(0.5f * turn), sine = sin(turn), lost = -2.0f * half_sine * half_sine;
    enter(s, s->x + (lost * east - sine * north - p[4]), s->y + (lost * north + sine * east - p[5]));
}

// p = {along / step and across at the frame's origin, axis x, y, 1 / step, 1 / reach, what to take off x, y, splines ...};
// n = {how many splines}
static void tree_bend(State *s, P p, N n, D data)
{
    const float8 along = p[0] + (p[2] * s->x + p[3] * s->y) * p[4], across = p[1] + (p[2] * s->y - p[3] * s->x);
    const float8 t = across * p[5];
    float8 offset = 0.0f;
    for (int i = 0; i < n[0]; i++) {
        const float8 u = fabs(along - (i + 2.0f));
        const float8 wide = fmax(2.0f - u, 0.0f), narrow = fmax(1.0f - u, 0.0f);
        offset += p[8 + i] * (1.0f / 6.0f) * (wide * wide * wide - 4.0f * narrow * narrow * narrow);
    }
    const float8 v = 1.0f - fmin(t * t, 1.0f);
    const float8 moved = offset * (v * v * v);
    enter(s, s->x + (moved * p[3] - p[6]), s->y - (moved * p[2] + p[7]));
}

// p = {amplitude, what to take off x, y}; n = {both noises' tables in data, words of a noise's origins, both origins}
static void tree_distort(State *s, P p, N n, D data)
{
    __global const uint *words = (__global const uint *)data, *origins = (__global const uint *)(n + 3);
    const float8 dx = noise_fbm(noise_at(words, n[0]), noise_origin(origins, 0), s->x, s->y);
    const float8 dy = noise_fbm(noise_at(words, n[1]), noise_origin(origins + n[2], 0), s->x, s->y);
    enter(s, s->x + (p[0] * dx - p[1]), s->y + (p[0] * dy - p[2]));
}
