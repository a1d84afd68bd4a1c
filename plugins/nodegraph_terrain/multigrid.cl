// Black-box multigrid and the vector work of conjugate gradients; see multigrid.py for what the arrays mean.
//
// Every array of a level has a margin of MARGIN cells, and is widened to whole work groups; all that is 0.  So no kernel
// on one level asks where an edge is: beyond it conductances, couplings and inverse diagonals are 0 and give 0.  Between
// two levels each asks, as twice a widened coarse row may be longer than the fine one.
//
// FINEST: the system itself, two arrays of conductances, in the form of flows, which keeps all digits where neighbours
// are close; `diagonal` is then not read.  Otherwise a Galerkin operator: a diagonal and four couplings, one behind the
// other in `sides` (plane: cells of one array).

#define MARGIN 2
#define AT(x, y, stride) ((size_t)((y) + MARGIN) * (stride) + (x) + MARGIN)

// The number of the coarse cell at offset (dx, dy) from J in its 3 by 3 weights.
#define WEIGHT(dx, dy) (((dy) + 1) * 3 + (dx) + 1)

// (A u)(i)
inline float applied(__global const float *u, __global const float *diagonal, __global const float *sides, size_t plane,
                     size_t i, int stride)
{
#ifdef FINEST
    __global const float *east = sides, *south = sides + plane;
    const float c = u[i];
    return (east[i] * (c - u[i + 1]) + east[i - 1] * (c - u[i - 1])) +
           (south[i] * (c - u[i + stride]) + south[i - stride] * (c - u[i - stride]));
#else
    __global const float *east = sides, *south = sides + plane, *fore = sides + 2 * plane, *back = sides + 3 * plane;
    return diagonal[i] * u[i] - (east[i] * u[i + 1] + east[i - 1] * u[i - 1]) -
           (south[i] * u[i + stride] + south[i - stride] * u[i - stride]) -
           (fore[i] * u[i + stride + 1] + fore[i - stride - 1] * u[i - stride - 1]) -
           (back[i] * u[i + stride - 1] + back[i - stride + 1] * u[i - stride + 1]);
#endif
}

// defect = right - A guess
__kernel void defect(__global const float *guess, __global const float *right, __global const float *diagonal,
                     __global const float *inverse, __global const float *sides, ulong plane, int stride,
                     __global float *out)
{
    const size_t i = AT(get_global_id(0), get_global_id(1), stride);
    const float value = right[i] - applied(guess, diagonal, sides, plane, i, stride);
    out[i] = inverse[i] > 0.0f ? value : 0.0f;
}

// out = guess + inverse (right - A guess): a damped Jacobi step
__kernel void smooth(__global const float *guess, __global const float *right, __global const float *diagonal,
                     __global const float *inverse, __global const float *sides, ulong plane, int stride,
                     __global float *out)
{
    const size_t i = AT(get_global_id(0), get_global_id(1), stride);
    out[i] = guess[i] + inverse[i] * (right[i] - applied(guess, diagonal, sides, plane, i, stride));
}

// out = inverse right: a damped Jacobi step from 0
__kernel void start(__global const float *inverse, __global const float *right, int stride, __global float *out)
{
    const size_t i = AT(get_global_id(0), get_global_id(1), stride);
    out[i] = inverse[i] * right[i];
}

// out = A u at free cells, 0 elsewhere
__kernel void outflow(__global const float *u, __global const float *inverse, __global const float *sides, ulong plane,
                      int stride, __global float *out)
{
#ifdef FINEST
    const size_t i = AT(get_global_id(0), get_global_id(1), stride);
    const float value = applied(u, u, sides, plane, i, stride);
    out[i] = inverse[i] > 0.0f ? value : 0.0f;
#endif
}

// coarse = P' fine
__kernel void restriction(__global const float *fine, int stride, __global const float *weights, ulong plane,
                          int coarse_stride, int coarse_rows, int coarse_cols, __global float *coarse)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= coarse_cols || y >= coarse_rows)
        return;
    const size_t j = AT(x, y, coarse_stride), i = AT(2 * x, 2 * y, stride);
    float sum = 0.0f;
#pragma unroll
    for (int dy = -1; dy <= 1; ++dy)
#pragma unroll
        for (int dx = -1; dx <= 1; ++dx)
            sum += weights[WEIGHT(dx, dy) * plane + j] * fine[i + dy * stride + dx];
    coarse[j] = sum;
}

// fine += P coarse; each work item makes the two by two cells from 2 J on
__kernel void prolongation(__global const float *coarse, __global const float *weights, ulong plane, int coarse_stride,
                           int coarse_rows, int coarse_cols, int stride, __global float *fine)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= coarse_cols || y >= coarse_rows)
        return;
    const size_t j = AT(x, y, coarse_stride), i = AT(2 * x, 2 * y, stride);
    const size_t e = j + 1, s = j + coarse_stride, se = s + 1;
#define GIVEN(dx, dy, cell) (weights[WEIGHT(dx, dy) * plane + (cell)] * coarse[cell])
    fine[i] += GIVEN(0, 0, j);
    fine[i + 1] += GIVEN(1, 0, j) + GIVEN(-1, 0, e);
    fine[i + stride] += GIVEN(0, 1, j) + GIVEN(0, -1, s);
    fine[i + stride + 1] += GIVEN(1, 1, j) + GIVEN(-1, 1, e) + GIVEN(1, -1, s) + GIVEN(-1, -1, se);
}

// The coarsest level: out = solver right, both over the level's cells, row by row.
__kernel void direct(__global const float *solver, __global const float *right, int rows, int cols, int stride,
                     __global float *out)
{
    const int cell = get_global_id(0);
    __global const float *line = solver + (size_t)cell * rows * cols;
    float sum = 0.0f;
    for (int y = 0; y < rows; ++y)
        for (int x = 0; x < cols; ++x)
            sum += line[y * cols + x] * right[AT(x, y, stride)];
    out[AT(cell % cols, cell / cols, stride)] = sum;
}

// Setting up.

// The finest level from the raster: values and conductances with a margin.
__kernel void finest(__global const float *values, __global const float *across, __global const float *down,
                     float across_all, float down_all, int rows, int cols, ulong plane, int stride,
                     __global float *x_out, __global float *sides)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cols || y >= rows)
        return;
    const size_t from = (size_t)y * cols + x, i = AT(x, y, stride);
    x_out[i] = values[from];
    sides[i] = x + 1 < cols ? (across ? across[from - y] : across_all) : 0.0f;
    sides[plane + i] = y + 1 < rows ? (down ? down[from] : down_all) : 0.0f;
}

// Diagonal, damped inverse, and couplings between free cells only.
__kernel void couplings(__global const float *sides, __global const uchar *free, float damping, int rows, int cols,
                        ulong plane, int stride, __global float *diagonal, __global float *inverse,
                        __global float *coupled)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cols || y >= rows)
        return;
    const size_t from = (size_t)y * cols + x, i = AT(x, y, stride);
    const int here = free[from] != 0;
    const int right = here && x + 1 < cols && free[from + 1], below = here && y + 1 < rows && free[from + cols];
    const float sum = here ? (sides[i] + sides[i - 1]) + (sides[plane + i] + sides[plane + i - stride]) : 0.0f;
    diagonal[i] = sum;
    inverse[i] = sum > 0.0f ? damping / sum : 0.0f;
    coupled[i] = right ? sides[i] : 0.0f;
    coupled[plane + i] = below ? sides[plane + i] : 0.0f;
}

// Minus A(i, i + step), step = (dx, dy).
inline float coupling(__global const float *sides, size_t plane, size_t i, int stride, int dx, int dy)
{
    const int back = dy < 0 || (dy == 0 && dx < 0);
    if (back) {
        i += dy * stride + dx;
        dx = -dx;
        dy = -dy;
    }
    const int side = dy == 0 ? 0 : dx == 0 ? 1 : dx > 0 ? 2 : 3;
#ifdef FINEST
    return side < 2 ? sides[side * plane + i] : 0.0f;
#else
    return sides[side * plane + i];
#endif
}

inline float quotient(float given, float whole)
{
    return whole > 0.0f ? given / whole : 0.0f;
}

#define C(i, dx, dy) coupling(sides, plane, (i), stride, (dx), (dy))

// A cell beside the coarse cell, at (dx, dy): what its equation, summed across the line through both, takes from it.
inline float beside(__global const float *diagonal, __global const float *sides, size_t plane, size_t j, int stride,
                    int dx, int dy)
{
    const size_t i = j + dy * stride + dx;
    const float given = C(i, -dx, -dy) + C(i, -dx + dy, -dy + dx) + C(i, -dx - dy, -dy - dx);
    const float other = C(i, dx, dy) + C(i, dx + dy, dy + dx) + C(i, dx - dy, dy - dx);
    const float whole = diagonal[i] - (C(i, dy, dx) + C(i, -dy, -dx));
    return quotient(given, fmax(whole, given + other));
}

// A cell at a corner: `along` and `down` are the weights of the cells beside the coarse cell in its row and column.
inline float corner(__global const float *diagonal, __global const float *sides, size_t plane, size_t j, int stride,
                    int dx, int dy, float along, float down)
{
    const size_t i = j + dy * stride + dx;
    const float given = C(i, 0, -dy) * along + C(i, -dx, 0) * down + C(i, -dx, -dy);
    return quotient(given, diagonal[i]);
}

__kernel void interpolation(__global const float *diagonal, __global const float *sides, ulong plane, int stride,
                            ulong coarse_plane, int coarse_stride, int coarse_rows, int coarse_cols,
                            __global float *weights)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= coarse_cols || y >= coarse_rows)
        return;
    const size_t j = AT(2 * x, 2 * y, stride);
    __global float *out = weights + AT(x, y, coarse_stride);
    const float e = beside(diagonal, sides, plane, j, stride, 1, 0), w = beside(diagonal, sides, plane, j, stride, -1, 0);
    const float s = beside(diagonal, sides, plane, j, stride, 0, 1), n = beside(diagonal, sides, plane, j, stride, 0, -1);
    out[WEIGHT(0, 0) * coarse_plane] = diagonal[j] > 0.0f ? 1.0f : 0.0f;
    out[WEIGHT(1, 0) * coarse_plane] = e;
    out[WEIGHT(-1, 0) * coarse_plane] = w;
    out[WEIGHT(0, 1) * coarse_plane] = s;
    out[WEIGHT(0, -1) * coarse_plane] = n;
    out[WEIGHT(1, 1) * coarse_plane] = corner(diagonal, sides, plane, j, stride, 1, 1, e, s);
    out[WEIGHT(-1, 1) * coarse_plane] = corner(diagonal, sides, plane, j, stride, -1, 1, w, s);
    out[WEIGHT(1, -1) * coarse_plane] = corner(diagonal, sides, plane, j, stride, 1, -1, e, n);
    out[WEIGHT(-1, -1) * coarse_plane] = corner(diagonal, sides, plane, j, stride, -1, -1, w, n);
}

// The product P' A P.  Offsets are literals in macros, so that the compiler drops at once what is out of reach.

#ifdef FINEST
#define LINKED(dx, dy) ((dx) == 0 || (dy) == 0)
#else
#define LINKED(dx, dy) 1
#endif
#define IN_REACH(fx, fy) ((fx) >= -1 && (fx) <= 1 && (fy) >= -1 && (fy) <= 1)

// A(i, i + step) times the weight of K = J + (kx, ky) at i + step, for the cell i at offset (ax, ay) from 2 J.
#define TERM(ax, ay, kx, ky, dx, dy)                                                                \
    (LINKED(dx, dy) && IN_REACH((ax) + (dx)-2 * (kx), (ay) + (dy)-2 * (ky))                         \
         ? ((dx) == 0 && (dy) == 0 ? -diagonal[i + (ay) * stride + (ax)]                            \
                                   : C(i + (ay) * stride + (ax), dx, dy)) *                         \
               weights[WEIGHT((ax) + (dx)-2 * (kx), (ay) + (dy)-2 * (ky)) * coarse_plane + j +      \
                       (ky) * coarse_stride + (kx)]                                                 \
         : 0.0f)

// Minus (A P)(i, K), times the weight of J at i.
#define ROW(ax, ay, kx, ky)                                                                                   \
    (weights[WEIGHT(ax, ay) * coarse_plane + j] *                                                             \
     (TERM(ax, ay, kx, ky, 0, 0) + (TERM(ax, ay, kx, ky, 1, 0) + TERM(ax, ay, kx, ky, -1, 0)) +               \
      (TERM(ax, ay, kx, ky, 0, 1) + TERM(ax, ay, kx, ky, 0, -1)) +                                            \
      ((TERM(ax, ay, kx, ky, 1, 1) + TERM(ax, ay, kx, ky, -1, -1)) +                                          \
       (TERM(ax, ay, kx, ky, 1, -1) + TERM(ax, ay, kx, ky, -1, 1)))))

// Minus the coupling of J to K: the sum over J's own cell and the four beside it.
#define PRODUCT(kx, ky) \
    (ROW(0, 0, kx, ky) + (ROW(1, 0, kx, ky) + ROW(-1, 0, kx, ky)) + (ROW(0, 1, kx, ky) + ROW(0, -1, kx, ky)))

__kernel void galerkin(__global const float *diagonal, __global const float *sides, ulong plane, int stride,
                       __global const float *weights, float damping, ulong coarse_plane, int coarse_stride,
                       int coarse_rows, int coarse_cols, __global float *coarse_diagonal,
                       __global float *coarse_inverse, __global float *coarse_sides)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= coarse_cols || y >= coarse_rows)
        return;
    const size_t i = AT(2 * x, 2 * y, stride), j = AT(x, y, coarse_stride);
    const float sum = -PRODUCT(0, 0);
    coarse_diagonal[j] = sum;
    coarse_inverse[j] = sum > 0.0f ? damping / sum : 0.0f;
    coarse_sides[j] = PRODUCT(1, 0);
    coarse_sides[coarse_plane + j] = PRODUCT(0, 1);
    coarse_sides[2 * coarse_plane + j] = PRODUCT(1, 1);
    coarse_sides[3 * coarse_plane + j] = PRODUCT(-1, 1);
}

// Vectors.

// r = -A x - source
__kernel void residual(__global const float *x, __global const float *source, __global const float *inverse,
                       __global const float *sides, ulong plane, int rows, int cols, int stride, __global float *r)
{
#ifdef FINEST
    const int col = get_global_id(0), row = get_global_id(1);
    const size_t i = AT(col, row, stride);
    float value = -applied(x, x, sides, plane, i, stride);
    if (source && col < cols && row < rows)
        value -= source[(size_t)row * cols + col];
    r[i] = inverse[i] > 0.0f ? value : 0.0f;
#endif
}

// p = z + beta p
__kernel void turn(__global const float *z, float beta, __global float *p)
{
    const size_t i = get_global_id(0);
    p[i] = z[i] + beta * p[i];
}

// x += alpha p
__kernel void add(__global const float *p, float alpha, __global float *x)
{
    const size_t i = get_global_id(0);
    x[i] += alpha * p[i];
}

// x += alpha p, r -= alpha q
__kernel void advance(__global const float *p, __global const float *q, float alpha, __global float *x,
                      __global float *r)
{
    const size_t i = get_global_id(0);
    x[i] += alpha * p[i];
    r[i] -= alpha * q[i];
}

// Sums of a b and largest |b|, one of each per work item, which reads `count` vectors of eight `step` apart.
__kernel void measure(__global const float *a, __global const float *b, int count, int apart, int step,
                      __global float *sums, __global float *peaks)
{
    const int g = get_global_id(0);
    size_t v = (size_t)g * apart;
    float8 sum = 0.0f, peak = 0.0f;
    for (int k = 0; k < count; ++k, v += step) {
        const float8 other = vload8(v, b);
        sum += vload8(v, a) * other;
        peak = fmax(peak, fabs(other));
    }
    const float4 four = sum.lo + sum.hi, most = fmax(peak.lo, peak.hi);
    sums[g] = (four.x + four.y) + (four.z + four.w);
    peaks[g] = fmax(fmax(most.x, most.y), fmax(most.z, most.w));
}

// The raster without its margin.
__kernel void unpadded(__global const float *from, int stride, int rows, int cols, __global float *to)
{
    const int x = get_global_id(0), y = get_global_id(1);
    to[(size_t)y * cols + x] = from[AT(x, y, stride)];
}
