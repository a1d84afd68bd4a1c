// Discs of ground, and noise without an edge.

#include "relief.h"
#include "tree.h"

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

// p = {centre east, north, 1 / radius, height, amplitude}, n = {noise's table, fall-off, origins...}
static void tree_disc_rough(State *s, P p, N n, D data)
{
    const float8 weight = tree_round(s, p, n[1]);
    if (any(weight > 0.0f))
        push(s, p[3] + p[4] * tree_relief(s, data, n[0], n + 2), weight);
    else
        push(s, 0.0f, 0.0f);
}

// p = {height, amplitude}, n = {noise's table, origins...}
static void tree_noise(State *s, P p, N n, D data)
{
    push(s, p[0] + p[1] * tree_relief(s, data, n[0], n + 1), 1.0f);
}
