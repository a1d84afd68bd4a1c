// Sparse terrains: patches of atoms, blended.  sparse_terrain.py says what is computed here and why.

#include "image.h"

// Share of a sample by which a place may lie before the first of the samples that it is interpolated between.  A place
// right at a sample would else fall to one side or the other as it is rounded, and neighbours would not read in step.
#define SPARSE_EARLY 2.5e-4f

// Eight neighbouring samples at once where they lie in a row, else one by one.
static inline float8 sparse_read(D data, int8 at, int step, int in_step)
{
    return in_step ? vload8(0, data + at.s0 + step) : gather(data, at + step);
}

// p = {place in radii from the first patch: east and south at the origin and per metre, and where weights stay as they
// are, from and to along both; each patch: mean, coefficients; edges...}
// n = {begin of the atoms, rows and columns of patches, terms of each, samples in a radius, interpolation, edges 2; each
// patch: atoms}
static void sparse_terrain(State *s, P p, N n, D data)
{
    const int rows = n[1], cols = n[2], terms = n[3], radius = n[4], cubic = n[5];
    const P patches = p + 8;
    const N numbers = n + 8;
    const float8 weight = border(s, patches + rows * cols * (1 + terms), n + 6);
    if (!any(weight > 0.0f)) {
        push(s, 0.0f, 0.0f);
        return;
    }
    const float8 u = p[0] + p[1] * s->x, v = p[2] + p[3] * s->y;
    const float8 held_u = clamp(u, p[4], p[5]), held_v = clamp(v, p[6], p[7]);
    const float8 west = floor(held_u), north = floor(held_v);
    const int8 column = convert_int8(west), row = convert_int8(north);
    // In samples from the patch in the north-west of the place.
    float8 c = clamp(u - west, 0.0f, 1.0f) * radius - 0.5f, r = clamp(v - north, 0.0f, 1.0f) * radius - 0.5f;
    const float8 left = floor(c + SPARSE_EARLY), top = floor(r + SPARSE_EARLY);
    c -= left;
    r -= top;
    float8 wx[4], wy[4];
    if (cubic) {
        cubic_basis(0, c, wx);
        cubic_basis(0, r, wy);
    } else {
        wx[2] = eased(0, c);
        wy[2] = eased(0, r);
        wx[1] = 1.0f - wx[2];
        wy[1] = 1.0f - wy[2];
    }
    const int first = cubic ? 0 : 1, last = cubic ? 3 : 2, stride = 2 * (radius + PAD);
    const int8 inside = n[0] + (convert_int8(top) + (PAD - 1)) * stride + convert_int8(left) + (PAD - 1);
    const int together = all(column == column.s0) && all(row == row.s0);
    const int8 order = inside - (int8)(0, 1, 2, 3, 4, 5, 6, 7);
    const int in_step = together && all(order == order.s0);
    const float8 kept = 1.0f - s->detail * s->detail, fade = 1.0f - kept * kept * kept;

    float8 height = 0.0f, total = 0.0f;
    for (int south = 0; south < 2; south++)
        for (int east = 0; east < 2; east++) {
            const float8 dx = held_u - west - east, dy = held_v - north - south;
            float8 alpha = fmax(1.0f - dx * dx - dy * dy, 0.0f);
            alpha *= alpha * alpha;
            const int8 i = column + east, j = row + south;
            alpha = i >= 0 && i < cols && j >= 0 && j < rows ? alpha : 0.0f;
            if (!any(alpha > 0.0f))
                continue;
            const int8 patch = clamp(j, 0, rows - 1) * cols + clamp(i, 0, cols - 1);
            const int8 place = inside + ((1 - south) * stride + 1 - east) * radius;
            float8 relief = 0.0f;
            for (int term = 0; term < terms; term++) {
                const int8 number = patch * terms + term, entry = patch + number + 1;
                const float8 factor = together ? (float8)(patches[entry.s0]) : gather(patches, entry);
                if (!any(factor != 0.0f))
                    continue;
                int8 at = place;
                if (together)
                    at += numbers[number.s0] * stride * stride;
                else
                    at += stride * stride
                        * (int8)(numbers[number.s0], numbers[number.s1], numbers[number.s2], numbers[number.s3],
                                 numbers[number.s4], numbers[number.s5], numbers[number.s6], numbers[number.s7]);
                float8 sum = 0.0f;
                for (int y = first; y <= last; y++) {
                    float8 line = 0.0f;
                    for (int x = first; x <= last; x++)
                        line += wx[x] * sparse_read(data, at, y * stride + x, in_step);
                    sum += wy[y] * line;
                }
                relief += factor * sum;
            }
            height += alpha * (gather(patches, patch * (1 + terms)) + fade * relief);
            total += alpha;
        }
    push(s, height / fmax(total, FLT_MIN), weight);
}
