// Instructions without a shape of their own.

#include "tree.h"

static void tree_nothing(State *s, P p, N n, D data)
{
    push(s, 0.0f, 0.0f);
}

// A tile of heights and one of weights that the host computed; n = {begin}.
static void tree_from_host(State *s, P p, N n, D data)
{
    const D at = data + n[0] + s->row * TILE + s->column;
    push(s, vload8(0, at), vload8(0, at + TILE * TILE));
}

// p = {height}
static void tree_constant(State *s, P p, N n, D data)
{
    push(s, p[0], 1.0f);
}

// p = {height at the origin, slope east, slope north}
static void tree_plane(State *s, P p, N n, D data)
{
    push(s, p[0] + p[1] * s->x + p[2] * s->y, 1.0f);
}

// Coordinates q = A (p - origin): p = {a, b, c, d}
static void tree_enter(State *s, P p, N n, D data)
{
    enter(s, p[0] * s->x + p[1] * s->y, p[2] * s->x + p[3] * s->y);
}

// p = {vertical scale, vertical shift}
static void tree_leave(State *s, P p, N n, D data)
{
    leave(s);
    s->f[s->top] = p[0] * s->f[s->top] + p[1];
}
