// Rasters as primitives: on the ground as they are, on a quadrangle, along a curve.

#include "image.h"

// A raster at columns p[0] + p[1] c and rows p[2] + p[3] r from its cell (n[1], n[2]); places outside are moved to its
// edge. n = {begin, column, row, columns, rows, 0 bilinear 1 bicubic 2 spline 3 smooth}
static float8 pixels(P p, N n, D data, float8 c, float8 r)
{
    c = fmin(fmax(p[0] + p[1] * c, -0.5f - n[1]), n[3] - 0.5f - n[1]);
    r = fmin(fmax(p[2] + p[3] * r, -0.5f - n[2]), n[4] - 0.5f - n[2]);
    const float8 left = floor(c), top = floor(r);
    const int stride = n[3] + 2 * PAD;
    const int8 column = clamp(convert_int8(left) + (n[1] + PAD), 1, n[3] + 1);
    const int8 row = clamp(convert_int8(top) + (n[2] + PAD), 1, n[4] + 1);
    const int8 at = n[0] + row * stride + column;
    c -= left;
    r -= top;
    if (n[5] == 0 || n[5] == 3) {
        const float8 u = eased(n[5], c), v = eased(n[5], r);
        const float8 upper = gather(data, at) * (1.0f - u) + gather(data, at + 1) * u;
        const float8 lower = gather(data, at + stride) * (1.0f - u) + gather(data, at + stride + 1) * u;
        return upper * (1.0f - v) + lower * v;
    }
    float8 wx[4], wy[4], sum = 0.0f;
    cubic_basis(n[5] == 2, c, wx);
    cubic_basis(n[5] == 2, r, wy);
    for (int j = 0; j < 4; j++) {
        const int8 first = at + ((j - 1) * stride - 1);
        sum += wy[j] * (wx[0] * gather(data, first) + wx[1] * gather(data, first + 1) +
                        wx[2] * gather(data, first + 2) + wx[3] * gather(data, first + 3));
    }
    return sum;
}

// Push height and weight of a raster at (c, r), as both ways onto it share them.
// p = {scale, rise, heights 4, mask 4, edges...}, n = {has a mask, heights 6, mask 6, edges 2}
static inline void push_image(State *s, P p, N n, D data, float8 c, float8 r)
{
    float8 weight = border(s, p + 10, n + 13);
    if (!any(weight > 0.0f)) {
        push(s, 0.0f, 0.0f);
        return;
    }
    if (n[0])
        weight *= pixels(p + 6, n + 7, data, c, r);
    push(s, p[0] * pixels(p + 2, n + 1, data, c, r) + p[1], weight);
}

// North-up on the ground: c and r are metres east and south of the tile's origin.
static void tree_image_grid(State *s, P p, N n, D data)
{
    push_image(s, p, n, data, s->x, -s->y);
}

// On a quadrangle: place = a + c E + r F + c r G from the tile's place on it; p = {a, E, F, G (x and y each), sense,
// least and greatest r, image...}.  Solved for r by the form of the quadratic's root that has no difference of like
// numbers.
static void tree_image_quad(State *s, P p, N n, D data)
{
    const float8 x = s->x - p[0], y = s->y - p[1];
    const float ex = p[2], ey = p[3], fx = p[4], fy = p[5], gx = p[6], gy = p[7], sense = p[8];
    const float8 k0 = sense * (x * ey - y * ex), k1 = sense * ((ex * fy - ey * fx) + (x * gy - y * gx));
    const float k2 = sense * (gx * fy - gy * fx);
    const float8 root = sqrt(fmax(k1 * k1 - 4.0f * k0 * k2, 0.0f));
    const float8 r = fmin(fmax(-2.0f * k0 / fmax(k1 + root, FLT_MIN), p[9]), p[10]);
    const float8 ux = ex + r * gx, uy = ey + r * gy;
    const float8 c = ((x - r * fx) * ux + (y - r * fy) * uy) / (ux * ux + uy * uy);
    push_image(s, p + 11, n, data, c, r);
}

// One picture on one arc of a curve: p = {share after the first joint and before the second: t = p0 + p1 x + p2 y each;
// place (x, y) and direction of a point (s, d); curvature there, metres of s per metre, d; 1 - width / margin, 1 /
// margin, t at the start and at the end; fade in and fade out over s: t = p0 + p1 s each; scale, rise; heights 4},
// n = {fall-off, heights 6}
static void tree_image_curve(State *s, P p, N n, D data)
{
    const float8 after = clamp(p[0] + p[1] * s->x + p[2] * s->y, 0.0f, 1.0f);
    const float8 before = 1.0f - clamp(p[3] + p[4] * s->x + p[5] * s->y, 0.0f, 1.0f);
    const float8 x = s->x - p[6], y = s->y - p[7];
    const float8 along = x * p[8] + y * p[9], left = y * p[8] - x * p[9];
    const float k = p[10];
    const float8 g = fmax(1.0f - k * left, 1e-6f), z = k * along, tangent = z / g;
    const float8 root = sqrt(g * g + z * z);
    const float8 safe = fabs(tangent) < 1e-3f ? (float8)(1.0f) : tangent;
    const float8 bent = fabs(tangent) < 1e-3f ? 1.0f - tangent * tangent * (1.0f / 3) : atan(safe) / safe;
    const float8 ds = p[11] * along / g * bent;
    const float8 dd = (2.0f * left - k * (along * along + left * left)) / (1.0f + root);
    const float8 sides = fall_off(n[0], fmax(p[13] + p[14] * fabs(p[12] + dd), 0.0f));
    const float8 start = fall_off(n[0], fmax(p[15] - p[14] * ds, 0.0f));
    const float8 end = fall_off(n[0], fmax(p[16] + p[14] * ds, 0.0f));
    const float8 in = clamp(p[17] + p[18] * ds, 0.0f, 1.0f), out = clamp(p[19] + p[20] * ds, 0.0f, 1.0f);
    const float8 weight =
        after * before * sides * start * end * eased(1, in) * (1.0f - eased(1, out));
    if (any(weight > 0.0f))
        push(s, p[21] * pixels(p + 23, n + 1, data, ds, -dd) + p[22], weight);
    else
        push(s, 0.0f, 0.0f);
}
