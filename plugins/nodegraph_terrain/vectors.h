// Eight neighbouring cells of a row at a time, on rows of any length.

#ifndef NODEGRAPH_TERRAIN_VECTORS_H
#define NODEGRAPH_TERRAIN_VECTORS_H

// Eight floats at any address.  PoCL calls a function for each vload8 and saves all registers around it; clang, which
// most OpenCL compilers are built on, reads a vector of stated alignment in one instruction.
#ifdef __clang__
typedef float8 unaligned_float8 __attribute__((aligned(4)));
static inline float8 get8(__global const float *from)
{
    return *(__global const unaligned_float8 *)from;
}
static inline void put8(float8 value, __global float *to)
{
    *(__global unaligned_float8 *)to = value;
}
#else
static inline float8 get8(__global const float *from)
{
    return vload8(0, from);
}
static inline void put8(float8 value, __global float *to)
{
    vstore8(value, 0, to);
}
#endif

// `any`, for which PoCL calls a function.
static inline int any8(int8 which)
{
    const int4 a = which.lo | which.hi;
    const int2 b = a.lo | a.hi;
    return (b.x | b.y) < 0;
}

// Index of cell i of n on a mirrored axis, ... 1 0 | 0 1 .. n-1 | n-1 n-2 ...
static inline int mirrored(int i, int n)
{
    if (i >= 0 && i < n)
        return i;
    const int period = 2 * n;
    i %= period;
    i = i < 0 ? i + period : i;
    return i < n ? i : period - 1 - i;
}

// Cells x .. x + 7 of a row of n; those beyond its ends are `outside`.
static inline float8 load8(__global const float *row, int x, int n, float outside)
{
    if (x >= 0 && x <= n - 8)
        return get8(row + x);
#define CELL(k) (x + k >= 0 && x + k < n ? row[x + k] : outside)
    return (float8)(CELL(0), CELL(1), CELL(2), CELL(3), CELL(4), CELL(5), CELL(6), CELL(7));
#undef CELL
}

// Cells x .. x + 7 of a mirrored row of n.
static inline float8 load8_mirrored(__global const float *row, int x, int n)
{
    if (x >= 0 && x <= n - 8)
        return get8(row + x);
    if (x <= -8 && x >= -n)
        return get8(row - x - 8).s76543210;
    if (x >= n && x <= 2 * n - 8)
        return get8(row + 2 * n - x - 8).s76543210;
#define CELL(k) row[mirrored(x + k, n)]
    return (float8)(CELL(0), CELL(1), CELL(2), CELL(3), CELL(4), CELL(5), CELL(6), CELL(7));
#undef CELL
}

// Write cells x .. x + 7 of a row of n, as far as they are in it.
static inline void store8(float8 value, __global float *row, int x, int n)
{
    if (x <= n - 8) {
        put8(value, row + x);
        return;
    }
#define CELL(k)     \
    if (x + k < n)  \
        row[x + k] = value.s##k;
    CELL(0) CELL(1) CELL(2) CELL(3) CELL(4) CELL(5) CELL(6) CELL(7)
#undef CELL
}

#endif
