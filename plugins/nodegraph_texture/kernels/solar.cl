// Potential solar radiation, as solar_radiation.py and horizon.py define it.  A work item makes eight cells of a row.
// Comparisons with NaN are false; heights that are not known are NaN at first and UNKNOWN in the levels.

#include "horn.h"

#define UNKNOWN -1e6f
#define PI_2 1.57079632679f

// Eight cells as one, and one by one.
typedef union {
    float8 all;
    float each[8];
} Eight;

// The first level: the heights themselves.
__kernel void ground(__global const float *heights, int rows, int cols, __global float *levels)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= cols || y >= rows)
        return;
    const float8 here = load8(heights + (size_t)y * cols, x, cols, NAN);
    store8(here == here ? here : (float8)UNKNOWN, levels + (size_t)y * cols, x, cols);
}

// A further level, the highest of 2 reach cells to each side, from the one before it, which has it for `reach` cells
// (of 1 to each side, from the heights).
__kernel void widen(__global float *levels, int level, int reach, int rows, int cols)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= cols || y >= rows)
        return;
    const size_t size = (size_t)rows * cols;
    __global const float *before = levels + (level - 1) * size;
    float8 highest = UNKNOWN;
    for (int i = max(0, y - reach); i <= min(rows - 1, y + reach); ++i) {
        if (i != y - reach && i != y && i != y + reach)
            continue;
        __global const float *row = before + (size_t)i * cols;
        highest = fmax(highest, load8(row, x - reach, cols, UNKNOWN));
        highest = fmax(highest, load8(row, x, cols, UNKNOWN));
        highest = fmax(highest, load8(row, x + reach, cols, UNKNOWN));
    }
    store8(highest, levels + level * size + (size_t)y * cols, x, cols);
}

// Tangent of the height angle of the horizon, `least` at least.  A look is five whole numbers, its level and the rows
// and columns to the near and the far cell, and two others, the fraction and the inverse of the distance.
static inline float8 horizon(__global const float *levels, __global const int *cells, __global const float *weights,
                             int first, int last, float8 here, float8 least, float top, int x, int y, int rows,
                             int cols)
{
    const size_t size = (size_t)rows * cols;
    for (int k = first; k < last; ++k) {
        __global const int *cell = cells + 5 * k;
        const float fraction = weights[2 * k], nearness = weights[2 * k + 1];
        // From here on not even the highest ground reaches above what was seen.
        if (!any8((top - here) * nearness > least))
            break;
        const int near = y + cell[1], far = y + cell[3];
        if (near < 0 || near >= rows || far < 0 || far >= rows)
            continue;
        __global const float *level = levels + cell[0] * size;
        float8 height = load8(level + (size_t)near * cols, x + cell[2], cols, NAN);
        if (fraction > 0.0f) {
            const float8 other = load8(level + (size_t)far * cols, x + cell[4], cols, NAN);
            height = height * (1.0f - fraction) + other * fraction;
        }
        const float8 tangent = (height - here) * nearness;
        least = tangent > least ? tangent : least;
    }
    return least;
}

// What a sector sends from above a height angle, (east, north, up, 0), of one cell.
static inline float4 looked_up(__global const float *sums, int bins, int layer, float upper, float at)
{
    const int row = (int)at;
    const float right = at - row;
    __global const float *corner = sums + 4 * (layer * (bins + 1) + row);
    const float4 low = mix(vload4(0, corner), vload4(1, corner), right);
    corner += 4 * (bins + 1);
    const float4 high = mix(vload4(0, corner), vload4(1, corner), right);
    return mix(low, high, upper);
}

// A sector has a direction (east, north), a range of looks, and the number of its table or -1 where no sun stands.
__kernel void radiate(__global const float *heights, __global const float *levels, int sector_count,
                      __global const float *directions, __global const int *ranges, __global const int *cells,
                      __global const float *weights, __global const float *sums, __global const float *open_sums,
                      int bins, int layers, int rows, int cols, int first_row, int last_row, float width, float height,
                      float top, float pressure, float per_pressure, float diffuse, float hours,
                      __global float *radiation, __global float *irradiation)
{
    const int x = get_global_id(0) * 8;
    const int y = first_row + get_global_id(1);
    if (x >= cols || y >= last_row)
        return;
    const float8 here = load8(heights + (size_t)y * cols, x, cols, NAN);
    float8 east, north;
    horn(heights, x, y, rows, cols, width, height, &east, &north);
    const float8 upright = 1.0f / sqrt(1.0f + east * east + north * north);
    const float8 thinned = pow(fmax(1.0f - 2.25577e-5f * here, ZERO), (float8)5.25588f);
    float8 air = (thinned - pressure) * per_pressure;
    air = air == air ? clamp(air, 0.0f, layers - 1.0f) : ZERO;
    const int8 layer = min(convert_int8(air), layers - 2);
    int layer_of[8];
    vstore8(layer, 0, layer_of);
    const Eight upper = {.all = air - convert_float8(layer)};
    float8 energy = ZERO, sky = ZERO;
    for (int k = 0; k < sector_count; ++k) {
        const float8 rise = east * directions[2 * k] + north * directions[2 * k + 1];
        float8 blocked = rise > 0.0f ? rise : ZERO;
        blocked = horizon(levels, cells, weights, ranges[3 * k], ranges[3 * k + 1], here, blocked, top, x, y, rows,
                          cols);
        const int table = ranges[3 * k + 2];
        if (table >= 0) {
            const Eight at = {.all = fmin(atan(blocked) * (bins / PI_2), bins - 1e-3f)};
            __global const float *own = sums + 4 * (size_t)table * layers * (bins + 1);
            Eight eastward, northward, upward;
            for (int c = 0; c < 8; ++c) {
                const float4 rays = looked_up(own, bins, layer_of[c], upper.each[c], at.each[c]);
                eastward.each[c] = rays.x, northward.each[c] = rays.y, upward.each[c] = rays.z;
            }
            const float8 facing = upward.all - east * eastward.all - north * northward.all;
            energy += facing > 0.0f ? facing : ZERO;
        }
        if (diffuse > 0.0f) {
            // With H the angle from the zenith to the horizon, whose cotangent is `blocked`.
            const float8 sine = 1.0f / sqrt(1.0f + blocked * blocked);
            const float8 zenith = PI_2 - atan(blocked);
            const float8 seen = sine * sine - rise * (zenith - sine * sine * blocked);
            sky += seen > 0.0f ? seen : ZERO;
        }
    }
    if (diffuse > 0.0f) {
        Eight level;
        for (int c = 0; c < 8; ++c)
            level.each[c] = mix(open_sums[layer_of[c]], open_sums[layer_of[c] + 1], upper.each[c]);
        energy += diffuse * level.all * sky;
    }
    // Of NaN where the cell is void.
    energy *= upright;
    store8(energy * (1.0f / hours), radiation + (size_t)y * cols, x, cols);
    store8(energy * 1e-3f, irradiation + (size_t)y * cols, x, cols);
}
