// Sampling a grid: each work item runs the program of its tile for eight samples of a row.

#include "machine.h"

__kernel void sample(
    __global const int4 *restrict code, __global const int *restrict starts, __global const float *restrict floats,
    __global const int *restrict ints, __global const float *restrict data,
    const int rows, const int cols, const int across, const int first, const float dx, const float dy,
    const float detail, __global const float *restrict details, const float threshold, const float heaviest,
    __global float *restrict height, __global float *restrict weight)
{
    const int column = 8 * get_global_id(0), row = first + get_global_id(1);
    State s;
    s.column = column % TILE;
    s.row = row % TILE;
    s.block = 1 << (s.row / BLOCK_ROWS * (TILE / BLOCK_COLUMNS) + s.column / BLOCK_COLUMNS);
    s.x = ((float8)(0, 1, 2, 3, 4, 5, 6, 7) + (s.column + 0.5f)) * dx;
    s.y = -(s.row + 0.5f) * dy;
    const long place = (long)row * cols + column;
    const int count = row < rows ? min(8, cols - column) : 0;
    s.detail = detail;
    if (details)
        for (int i = 0; i < count; i++)
            ((float *)&s.detail)[i] = details[place + i];
    run_program(&s, (row / TILE) * across + column / TILE, code, starts, floats, ints, data);
    const float8 f = s.a[0] >= threshold ? s.f[0] : (float8)(NAN), a = fmin(s.a[0], heaviest);
    if (count == 8) {
        vstore8(f, 0, height + place);
        vstore8(a, 0, weight + place);
    } else {
        for (int i = 0; i < count; i++) {
            height[place + i] = ((const float *)&f)[i];
            weight[place + i] = ((const float *)&a)[i];
        }
    }
}
