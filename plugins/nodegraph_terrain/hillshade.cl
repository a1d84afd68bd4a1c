// Hillshading with Horn's gradient, one or several lights, and cast shadows where SHADOWS is defined.  A work item
// makes eight cells of a row.  Comparisons with NaN are false, and a void is NaN.

#include "horn.h"

#define STRIPE 1024

// Least and greatest height of stripes of a row; FLT_MAX and -FLT_MAX where all is void.
__kernel void extremes(__global const float *heights, int rows, int cols, __global float *lows, __global float *highs)
{
    const int stripes = (cols + STRIPE - 1) / STRIPE;
    const int stripe = get_global_id(0), y = get_global_id(1);
    if (stripe >= stripes || y >= rows)
        return;
    float8 low = FLT_MAX, high = -FLT_MAX;
    for (int x = stripe * STRIPE; x < min(cols, (stripe + 1) * STRIPE); x += 8) {
        const float8 height = load8(heights + (size_t)y * cols, x, cols, NAN);
        low = height < low ? height : low;
        high = height > high ? height : high;
    }
    float4 low4 = fmin(low.lo, low.hi), high4 = fmax(high.lo, high.hi);
    lows[y * stripes + stripe] = fmin(fmin(low4.x, low4.y), fmin(low4.z, low4.w));
    highs[y * stripes + stripe] = fmax(fmax(high4.x, high4.y), fmax(high4.z, high4.w));
}

#ifdef SHADOWS
// Share of the sun's disc above the horizon.  Crossing k is at cells near (0, 1) and far (2, 3), rows and columns away,
// with tangents per metre of height (0, 1), and matters while ground may be (2) metres higher than the cell.
static inline float8 sunlit(__global const float *heights, float8 centre, int x, int y, int rows, int cols, float top,
                            __global const int *cells, __global const float *tangents, int count, float disc_high,
                            float per_disc)
{
    float8 horizon = -1e30f;
    for (int k = 0; k < count; ++k) {
        __global const float *tangent = tangents + 4 * k;
        if (!any(top - centre >= tangent[2]))
            break;
        __global const int *cell = cells + 4 * k;
        const int near = y + cell[0], far = y + cell[2];
        if (near < 0 || near >= rows || far < 0 || far >= rows)
            continue;
        const float8 first = load8(heights + (size_t)near * cols, x + cell[1], cols, NAN) - centre;
        const float8 second = load8(heights + (size_t)far * cols, x + cell[3], cols, NAN) - centre;
        const float8 angle = tangent[0] * first + tangent[1] * second;
        horizon = angle > horizon ? angle : horizon;
    }
    float8 share = (disc_high - horizon) * per_disc;
    share = share > 0.0f ? share : ZERO;
    return share < 1.0f ? share : (float8)1.0f;
}
#endif

// A light is eight floats: its unit vector (0 east, 1 north, 2 up), the direction its weight is measured across (3, 4),
// and the range of its crossings (5, 6).
__kernel void shade(__global const float *heights, __global const float *lights, int light_count,
                    int multidirectional, int rows, int cols, int first_row, int last_row, float width, float height,
                    float z_factor, float level,
#ifdef SHADOWS
                    float top, __global const int *cells, __global const float *tangents, float disc_high,
                    float per_disc,
#endif
                    __global float *shaded)
{
    const int x = get_global_id(0) * 8;
    const int y = first_row + get_global_id(1);
    if (x >= cols || y >= last_row)
        return;
    float8 east, north;
    horn(heights, x, y, rows, cols, width, height, &east, &north);
    east *= z_factor;
    north *= z_factor;
    const float8 squared = east * east + north * north;
    const float8 scale = 1.0f / sqrt(1.0f + squared);
    // Of NaN where the cell is void.
    float8 total = ZERO * scale;
    for (int k = 0; k < light_count; ++k) {
        __global const float *light = lights + 8 * k;
        float8 lit = light[2] - east * light[0] - north * light[1];
        lit = (lit > 0.0f ? lit : ZERO) * scale;
        if (multidirectional) {
            const float8 across = east * light[3] - north * light[4];
            lit *= 0.5f * (squared > level ? across * across / squared : (float8)0.5f);
        }
#ifdef SHADOWS
        const int first = convert_int(light[5]), last = convert_int(light[6]);
        if (first < last && any(lit > 0.0f)) {
            const float8 centre = load8(heights + (size_t)y * cols, x, cols, NAN);
            lit *= sunlit(heights, centre, x, y, rows, cols, top, cells + 4 * first, tangents + 4 * first, last - first,
                          disc_high, per_disc);
        }
#endif
        total += lit;
    }
    // The other way round a void would become 1.
    store8(total > 1.0f ? (float8)1.0f : total, shaded + (size_t)y * cols, x, cols);
}
