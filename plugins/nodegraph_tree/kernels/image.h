// What primitives of samples share: reading between them, and the weight of a straight border.

#ifndef NODEGRAPH_TREE_IMAGE_H
#define NODEGRAPH_TREE_IMAGE_H

#include "tree.h"

#define PAD 2           // cells added around a raster, as pixels.py does
#define LEVEL 2e-5f     // share of a cell in which bilinear is level

static inline float8 gather(D data, int8 i)
{
    return (float8)(data[i.s0], data[i.s1], data[i.s2], data[i.s3], data[i.s4], data[i.s5], data[i.s6], data[i.s7]);
}

// Weights of the four cells around a place t between two centres: Catmull-Rom or the uniform cubic B-spline.
static inline void cubic_basis(int spline, float8 t, float8 *w)
{
    const float8 s = 1.0f - t;
    if (spline) {
        w[0] = s * s * s * (1.0f / 6);
        w[1] = (4.0f + t * t * (3.0f * t - 6.0f)) * (1.0f / 6);
        w[2] = (4.0f + s * s * (3.0f * s - 6.0f)) * (1.0f / 6);
        w[3] = t * t * t * (1.0f / 6);
    } else {
        w[0] = -0.5f * t * s * s;
        w[1] = 1.0f + t * t * (1.5f * t - 2.5f);
        w[2] = 1.0f + s * s * (1.5f * s - 2.5f);
        w[3] = -0.5f * s * t * t;
    }
}

static inline float8 eased(int smooth, float8 t)
{
    return smooth ? t * t * (3.0f - 2.0f * t)
                  : fmin(fmax((t - LEVEL) * (1.0f / (1.0f - 2.0f * LEVEL)), 0.0f), 1.0f);
}

// Product over n[0] edges of g(t), t = p[0] + p[1] x + p[2] y, as border.py; n[1] says which g.
static inline float8 border(const State *s, P p, N n)
{
    float8 weight = 1.0f;
    for (int i = 0; i < n[0]; i++, p += 3)
        weight *= fall_off(n[1], fmax(p[0] + p[1] * s->x + p[2] * s->y, 0.0f));
    return weight;
}

#endif
