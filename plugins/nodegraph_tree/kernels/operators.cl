// Operators: they take pairs from the top of the stack and leave one.  What they mean stands with the classes of the same
// names in Python.  Every one leaves f exactly as it is where the other operand has no weight.

#include "tree.h"

// c(a), 1 from the threshold on: presence.py
static inline float8 presence(float8 a)
{
    const float8 t = fmin(2.0f * a, 1.0f);
    return t * (2.0f - t);
}

// Blend: the top joins the mean below it.
static void tree_blend(State *s, P p, N n, D data)
{
    const float8 f = s->f[s->top], a = s->a[s->top];
    s->top--;
    const float8 before = s->a[s->top], total = before + a;
    const float8 mean = before > 0.0f ? s->f[s->top] : (float8)(0.0f);
    const float8 share = total > 0.0f ? a / total : (float8)(0.0f);
    s->f[s->top] = mean + share * (f - mean);
    s->a[s->top] = total;
}

// Replace: the top B over A below it; n = {0 keep alpha_A, 1 let B reach beyond A}
static void tree_replace(State *s, P p, N n, D data)
{
    const float8 f = s->f[s->top], a = fmin(s->a[s->top], 1.0f);
    s->top--;
    float8 share = a;
    if (n[0]) {
        const float8 all = a + (1.0f - a) * presence(s->a[s->top]);
        share = all > 0.0f ? a / all : (float8)(0.0f);
        s->a[s->top] = (1.0f - a) * s->a[s->top] + a * a;
    }
    s->f[s->top] = (1.0f - share) * s->f[s->top] + share * f;
}

// Add: the top B on A below it; n = {0 keep alpha_A, 1 let B reach beyond A}
static void tree_add(State *s, P p, N n, D data)
{
    const float8 f = s->f[s->top], a = s->a[s->top];
    s->top--;
    float8 share = 1.0f;
    if (n[0]) {
        share = presence(s->a[s->top]);
        s->a[s->top] += a * a;
    }
    s->f[s->top] = share * s->f[s->top] + a * f;
}

// Carve: the top B out of A below it, or onto it; p = {radius of the smooth edge, 1 / (4 radius)}, n = {0 carve, 1 pile}
static void tree_carve(State *s, P p, N n, D data)
{
    const float8 f = s->f[s->top], a = fmin(s->a[s->top], 1.0f);
    s->top--;
    const float sign = n[0] ? 1.0f : -1.0f;
    const float8 deep = sign * (f - s->f[s->top]);
    const float8 over = fmax(deep + p[0], 0.0f);
    const float8 smooth = deep < p[0] ? over * over * p[1] : deep;
    s->f[s->top] += sign * a * smooth;
}

// A smooth hat: 1 within, fading to 0; h = {foot, 1 / rise, head, 1 / fall}
static inline float8 hat(P h, float8 v)
{
    const float8 up = clamp((v - h[0]) * h[1], 0.0f, 1.0f), down = clamp((h[2] - v) * h[3], 0.0f, 1.0f);
    return up * up * (3.0f - 2.0f * up) * (down * down * (3.0f - 2.0f * down));
}

// The weight of B by the altitude of A: the top is A, below it B; p = {hat}
static void tree_by_altitude(State *s, P p, N n, D data)
{
    const float8 factor = presence(s->a[s->top]) * hat(p, s->f[s->top]);
    s->top--;
    s->a[s->top] *= factor;
}

// The same by altitude and slope: A, A to the east, west, north and south on top; p = {hat, hat of the slope, 1 / span}
static void tree_by_terrain(State *s, P p, N n, D data)
{
    const int top = s->top;
    const float8 east = (s->f[top - 3] - s->f[top - 2]) * p[8], north = (s->f[top - 1] - s->f[top]) * p[8];
    float8 factor = presence(s->a[top - 4]) * presence(s->a[top - 3]) * presence(s->a[top - 2]);
    factor *= presence(s->a[top - 1]) * presence(s->a[top]);
    factor *= hat(p, s->f[top - 4]) * hat(p + 4, sqrt(east * east + north * north));
    s->top -= 5;
    s->a[s->top] *= factor;
}

// Level of detail: the top B is the finer, A below it the coarser; p = {k_A, 1 / (k_B - k_A)}
static void tree_level_of_detail(State *s, P p, N n, D data)
{
    const float8 f = s->f[s->top], a = s->a[s->top];
    s->top--;
    const float8 t = clamp((s->detail - p[0]) * p[1], 0.0f, 1.0f);
    const float8 coarse = (1.0f - t) * presence(s->a[s->top]), fine = t * presence(a), all = coarse + fine;
    const float8 share = all > 0.0f ? fine / all : (float8)(0.0f);
    s->f[s->top] = (1.0f - share) * s->f[s->top] + share * f;
    s->a[s->top] = (1.0f - t) * s->a[s->top] + t * a;
}

// Union: the lower of the top B and A below it, or the higher, rounded; p = {k where both are in full, k where one ends},
// n = {0 lower, 1 higher}
static void tree_union(State *s, P p, N n, D data)
{
    const float8 g = s->f[s->top], b = fmin(s->a[s->top], 1.0f);
    s->top--;
    const float8 f = s->f[s->top], a = fmin(s->a[s->top], 1.0f);
    const float sign = n[0] ? -1.0f : 1.0f;
    const float8 both = a * b, all = a + (1.0f - a) * b, k = p[1] - (p[1] - p[0]) * both;
    const float8 deep = sign * (f - g), share = clamp((deep + k) / (2.0f * k), 0.0f, 1.0f);
    const float8 smooth = deep < k ? k * share * share : deep;
    const float8 step = all > 0.0f ? b * ((1.0f - a) * deep + a * smooth) / all : (float8)(0.0f);
    s->f[s->top] = a > 0.0f ? f - sign * step : b > 0.0f ? g : (float8)(0.0f);
    s->a[s->top] = all;
}
