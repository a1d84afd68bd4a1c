// Gaussian smoothing in two passes: along rows, then along columns.
//
// A work item makes four vectors of eight cells, side by side in a row (`across`) or one below the other (`down`), so
// that what it loads serves all four: vector k sees offset o with weight w[o - 8 k], or w[o - k].  `weights` holds
// w[-reach .. reach], zero beyond the radius of the kernel.  The four sums have names of their own, as not every
// compiler keeps an array of vectors in registers.
//
// Sums are taken of differences to a cell nearby, which keeps all digits high above sea level and leaves a level
// surface exactly as it is.

#include "vectors.h"

#define ZERO ((float8)0.0f)
#define ONE ((float8)1.0f)

// Add what lies at offset o to the sums of the four vectors, `step` cells or rows apart.
#define ADD(step, above)                  \
    {                                     \
        s0 += weight[o] * above;          \
        s1 += weight[o - step] * above;   \
        s2 += weight[o - 2 * step] * above; \
        s3 += weight[o - 3 * step] * above; \
    }

// The same with voids: `counts` is how much of what lies there is known.
#define ADD_KNOWN(step, above, counts)     \
    {                                      \
        ADD(step, above)                   \
        k0 += weight[o] * counts;          \
        k1 += weight[o - step] * counts;   \
        k2 += weight[o - 2 * step] * counts; \
        k3 += weight[o - 3 * step] * counts; \
    }

// mean = sum_j w_j z(x + j), noting in *voids when there is a void.
__kernel void across(__global const float *heights, __global const float *weights, int reach, int radius, int rows,
                     int cols, int first_row, int last_row, __global float *mean, __global int *voids)
{
    const int x = get_global_id(0) * 32;
    const int y = first_row + get_global_id(1);
    if (x >= cols || y >= last_row)
        return;
    __global const float *row = heights + (size_t)y * cols;
    __global const float *weight = weights + reach;
    const float base = row[x];
    float8 s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO;
    if (x >= radius && x + 32 + radius <= cols) {
        for (int o = -radius; o <= radius + 24; ++o) {
            const float8 above = get8(row + x + o) - base;
            ADD(8, above)
        }
    } else {
        for (int o = -radius; o <= radius + 24; ++o) {
            const float8 above = load8_mirrored(row, x + o, cols) - base;
            ADD(8, above)
        }
    }
    __global float *out = mean + (size_t)y * cols;
    store8(s0 + base, out, x, cols);
    store8(s1 + base, out, x + 8, cols);
    store8(s2 + base, out, x + 16, cols);
    store8(s3 + base, out, x + 24, cols);
    // Lanes beyond the end stand for mirrored cells of the same row.
    const float8 all = s0 + s1 + s2 + s3;
    if (any(all != all))
        *voids = 1;
}

// smoothed = sum_j w_j mean(y + j).
__kernel void down(__global const float *mean, __global const float *weights, int reach, int radius, int rows, int cols,
                   int first_row, int last_row, __global float *smoothed)
{
    const int x = get_global_id(0) * 8;
    const int y = first_row + get_global_id(1) * 4;
    if (x >= cols || y >= last_row)
        return;
    __global const float *weight = weights + reach;
    const float8 base = load8(mean + (size_t)y * cols, x, cols, 0.0f);
    float8 s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO;
    if (x + 8 <= cols && y >= radius && y + radius + 3 < rows) {
        __global const float *cell = mean + (size_t)(y - radius) * cols + x;
        for (int o = -radius; o <= radius + 3; ++o, cell += cols) {
            const float8 above = get8(cell) - base;
            ADD(1, above)
        }
    } else {
        for (int o = -radius; o <= radius + 3; ++o) {
            const float8 above = load8(mean + (size_t)mirrored(y + o, rows) * cols, x, cols, 0.0f) - base;
            ADD(1, above)
        }
    }
    __global float *out = smoothed + (size_t)y * cols;
    store8(s0 + base, out, x, cols);
    if (y + 1 < last_row)
        store8(s1 + base, out + cols, x, cols);
    if (y + 2 < last_row)
        store8(s2 + base, out + 2 * (size_t)cols, x, cols);
    if (y + 3 < last_row)
        store8(s3 + base, out + 3 * (size_t)cols, x, cols);
}

// The first known height of eight cells, NAN where there is none.
static inline float known_height(float8 heights)
{
#define OR_ELSE(k, otherwise) (heights.s##k == heights.s##k ? heights.s##k : otherwise)
    return OR_ELSE(0, OR_ELSE(1, OR_ELSE(2, OR_ELSE(3, OR_ELSE(4, OR_ELSE(5, OR_ELSE(6, heights.s7)))))));
#undef OR_ELSE
}

static inline float8 mean_of(float8 sum, float8 known)
{
    return select(sum / known, ZERO, known == 0.0f);
}

// With voids: the mean of the known cells of a row, and their share of the weights.
__kernel void across_voids(__global const float *heights, __global const float *weights, int reach, int radius,
                           int rows, int cols, int first_row, int last_row, __global float *mean,
                           __global float *share)
{
    const int x = get_global_id(0) * 32;
    const int y = first_row + get_global_id(1);
    if (x >= cols || y >= last_row)
        return;
    __global const float *row = heights + (size_t)y * cols;
    __global const float *weight = weights + reach;
    float base = known_height(load8_mirrored(row, x, cols));
    for (int o = -radius; o <= radius + 24 && isnan(base); o += 8)
        base = known_height(load8_mirrored(row, x + o, cols));
    base = isnan(base) ? 0.0f : base;
    float8 s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO, k0 = ZERO, k1 = ZERO, k2 = ZERO, k3 = ZERO;
    if (x >= radius && x + 32 + radius <= cols) {
        for (int o = -radius; o <= radius + 24; ++o) {
            const float8 height = get8(row + x + o);
            const int8 is_void = height != height;
            const float8 above = select(height - base, ZERO, is_void), counts = select(ONE, ZERO, is_void);
            ADD_KNOWN(8, above, counts)
        }
    } else {
        for (int o = -radius; o <= radius + 24; ++o) {
            const float8 height = load8_mirrored(row, x + o, cols);
            const int8 is_void = height != height;
            const float8 above = select(height - base, ZERO, is_void), counts = select(ONE, ZERO, is_void);
            ADD_KNOWN(8, above, counts)
        }
    }
    const size_t offset = (size_t)y * cols;
    store8(mean_of(s0, k0) + base, mean + offset, x, cols);
    store8(mean_of(s1, k1) + base, mean + offset, x + 8, cols);
    store8(mean_of(s2, k2) + base, mean + offset, x + 16, cols);
    store8(mean_of(s3, k3) + base, mean + offset, x + 24, cols);
    store8(k0, share + offset, x, cols);
    store8(k1, share + offset, x + 8, cols);
    store8(k2, share + offset, x + 16, cols);
    store8(k3, share + offset, x + 24, cols);
}

// Write a row of smoothed cells, leaving voids void.
static inline void finish_row(float8 smoothed, __global const float *heights, __global float *out, int x, int y,
                              int cols, int last_row)
{
    if (y >= last_row)
        return;
    const float8 height = load8(heights + (size_t)y * cols, x, cols, 0.0f);
    store8(select(smoothed, (float8)NAN, height != height), out + (size_t)y * cols, x, cols);
}

__kernel void down_voids(__global const float *heights, __global const float *mean, __global const float *share,
                         __global const float *weights, int reach, int radius, int rows, int cols, int first_row,
                         int last_row, __global float *smoothed)
{
    const int x = get_global_id(0) * 8;
    const int y = first_row + get_global_id(1) * 4;
    if (x >= cols || y >= last_row)
        return;
    __global const float *weight = weights + reach;
    // A known cell has a share in its own row, so the last of the four rows with one gives a height nearby.
    float8 base = ZERO;
    for (int k = 0; k < 4; ++k) {
        const size_t offset = (size_t)min(y + k, rows - 1) * cols;
        base = select(base, load8(mean + offset, x, cols, 0.0f), load8(share + offset, x, cols, 0.0f) > 0.0f);
    }
    float8 s0 = ZERO, s1 = ZERO, s2 = ZERO, s3 = ZERO, k0 = ZERO, k1 = ZERO, k2 = ZERO, k3 = ZERO;
    if (x + 8 <= cols && y >= radius && y + radius + 3 < rows) {
        size_t cell = (size_t)(y - radius) * cols + x;
        for (int o = -radius; o <= radius + 3; ++o, cell += cols) {
            const float8 counts = get8(share + cell), above = counts * (get8(mean + cell) - base);
            ADD_KNOWN(1, above, counts)
        }
    } else {
        for (int o = -radius; o <= radius + 3; ++o) {
            const size_t offset = (size_t)mirrored(y + o, rows) * cols;
            const float8 counts = load8(share + offset, x, cols, 0.0f);
            const float8 above = counts * (load8(mean + offset, x, cols, 0.0f) - base);
            ADD_KNOWN(1, above, counts)
        }
    }
    finish_row(s0 / k0 + base, heights, smoothed, x, y, cols, last_row);
    finish_row(s1 / k1 + base, heights, smoothed, x, y + 1, cols, last_row);
    finish_row(s2 / k2 + base, heights, smoothed, x, y + 2, cols, last_row);
    finish_row(s3 / k3 + base, heights, smoothed, x, y + 3, cols, last_row);
}
