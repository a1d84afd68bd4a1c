// The gradient of a surface by Horn's weights, of eight neighbouring cells of a row, as gradient.py defines it.
// Comparisons with NaN are false, and a void is NaN.

#ifndef NODEGRAPH_TERRAIN_HORN_H
#define NODEGRAPH_TERRAIN_HORN_H

#include "vectors.h"

#define ZERO ((float8)0.0f)

// The neighbour, or the point reflection of its opposite where it is missing; both relative to the centre.
static inline float8 reflected(float8 neighbour, float8 opposite)
{
    return neighbour == neighbour ? neighbour : -opposite;
}

// The mean of three differences with weights 1, 2, 1, leaving out those that are missing; 0 without any.
static inline float8 weighted(float8 first, float8 middle, float8 last)
{
    const float8 one = 1.0f, two = 2.0f;
    const float8 sum = (first == first ? first : ZERO) + (middle == middle ? two * middle : ZERO) +
                       (last == last ? last : ZERO);
    const float8 weight = (first == first ? one : ZERO) + (middle == middle ? two : ZERO) + (last == last ? one : ZERO);
    return weight > 0.0f ? sum / weight : ZERO;
}

// Gradient towards east and north of eight cells at (x, y), NaN where they are void.
static inline void horn(__global const float *heights, int x, int y, int rows, int cols, float width, float height,
                        float8 *east, float8 *north)
{
    float8 a = NAN, b = NAN, c = NAN, g = NAN, h = NAN, i = NAN;
    __global const float *row = heights + (size_t)y * cols;
    const float8 e = load8(row, x, cols, NAN);
    const float8 d = load8(row, x - 1, cols, NAN), f = load8(row, x + 1, cols, NAN);
    if (y > 0) {
        a = load8(row - cols, x - 1, cols, NAN);
        b = load8(row - cols, x, cols, NAN);
        c = load8(row - cols, x + 1, cols, NAN);
    }
    if (y < rows - 1) {
        g = load8(row + cols, x - 1, cols, NAN);
        h = load8(row + cols, x, cols, NAN);
        i = load8(row + cols, x + 1, cols, NAN);
    }
    *east = ((c - a) + 2.0f * (f - d) + (i - g)) * (1.0f / (8.0f * width));
    *north = ((a - g) + 2.0f * (b - h) + (c - i)) * (1.0f / (8.0f * height));
    const int8 incomplete = *east != *east || *north != *north || e != e;
    if (!any(incomplete))
        return;
    // Horn's weights leave out the centre: where that is void, so are all differences to it.
    a -= e, b -= e, c -= e, g -= e, h -= e, i -= e;
    const float8 left = d - e, right = f - e;
    const float8 a2 = reflected(a, i), b2 = reflected(b, h), c2 = reflected(c, g), d2 = reflected(left, right);
    const float8 f2 = reflected(right, left), g2 = reflected(g, c), h2 = reflected(h, b), i2 = reflected(i, a);
    const float8 across = weighted(c2 - a2, f2 - d2, i2 - g2) * (0.5f / width);
    const float8 down = weighted(a2 - g2, b2 - h2, c2 - i2) * (0.5f / height);
    *east = incomplete ? across + (e - e) : *east;
    *north = incomplete ? down + (e - e) : *north;
}

#endif
