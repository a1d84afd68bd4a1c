// Discs of ground, and noise without an edge.

#include "noise.h"
#include "tree.h"

// The noise whose table starts at data[n[0]], filtered by the level of detail if n[1], with the tile's origins from
// n[2].
static inline float8 tree_relief(const State *s, N n, D data)
{
    __global const NoiseSum *sum = noise_at((__global const uint *)data, n[0]);
    __global const NoiseOrigin *origin = noise_origin((__global const uint *)(n + 2), 0);
    return n[1] ? noise_value_lod(sum, origin, s->x, s->y, s->detail) : noise_value(sum, origin, s->x, s->y);
}

// g of the distance to the centre (p[0], p[1]) over the radius 1 / p[2].
static inline float8 tree_round(const State *s, P p, int kind)
{
    const float8 dx = s->x - p[0], dy = s->y - p[1];
    return fall_off(kind, sqrt(dx * dx + dy * dy) * p[2]);
}

// p = {centre east, north, 1 / radius, height, -}, n = {fall-off}
static void tree_disc_flat(State *s, P p, N n, D data)
{
    push(s, p[3], tree_round(s, p, n[0]));
}

// p = {centre east, north, 1 / radius, height, amplitude}, n = {fall-off, noise...}
static void tree_disc_rough(State *s, P p, N n, D data)
{
    const float8 weight = tree_round(s, p, n[0]);
    if (any(weight > 0.0f))
        push(s, p[3] + p[4] * tree_relief(s, n + 1, data), weight);
    else
        push(s, 0.0f, 0.0f);
}

// p = {height, amplitude}, n = {noise...}
static void tree_noise(State *s, P p, N n, D data)
{
    push(s, p[0] + p[1] * tree_relief(s, n, data), 1.0f);
}
