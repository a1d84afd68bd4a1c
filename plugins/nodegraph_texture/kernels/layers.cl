// Surface layers on texels, as evaluate.py defines them.  Arrays are padded: rows of `wide` texels, a multiple of 8, the
// first of a row numbered by a multiple of 8 from the corner of the scene.  A work item paints eight texels.

#include "noise.h"
#include "vectors.h"

// A layer: its parent or -1, its constraints, and for coverage, displacement and tint the number of a noise or -1.
typedef struct {
    int parent, first, count;
    int noise[3];
    float bias, scale, roughness, variation, colour[3];
    int unused[3];
} Layer;

// A function of a quantity (0 altitude, 1 slope, others from 2 on): a hat, or samples among the words.
typedef struct {
    int quantity, sampled, first, count;
    float rise, rise_rate, rise_start, fall, fall_rate, fall_start;
    float low, rate;
} Constraint;

// A noise at this level: where its table lies among the words, its first lattice, and offset + factor noise.
typedef struct {
    int table, lattice;
    float kappa, factor, offset;
    int unused[3];
} Detail;

static inline float8 clamped(float8 t)
{
    t = t > 0.0f ? t : 0.0f;
    return t < 1.0f ? t : 1.0f;
}

// F at eight values; 0 where one is NaN.
static inline float8 suitability(__global const Constraint *c, __global const uint *words, float8 values)
{
    float8 found;
    if (c->sampled) {
        const float last = c->count - 1;
        float8 place = (values - c->low) * c->rate;
        place = place > 0.0f ? place : 0.0f;
        place = place < last ? place : last;
        const int8 at = min(convert_int8(place), c->count - 2);
        const float8 t = place - convert_float8(at);
        __global const float *samples = (__global const float *)(words + c->first);
#define BOTH(k) const float2 s##k = (float2)(samples[at.s##k], samples[at.s##k + 1]);
        BOTH(0) BOTH(1) BOTH(2) BOTH(3) BOTH(4) BOTH(5) BOTH(6) BOTH(7)
#undef BOTH
        const float8 a = (float8)(s0.x, s1.x, s2.x, s3.x, s4.x, s5.x, s6.x, s7.x);
        const float8 b = (float8)(s0.y, s1.y, s2.y, s3.y, s4.y, s5.y, s6.y, s7.y);
        found = a + t * (b - a);
    } else {
        const float8 up = clamped((values - c->rise) * c->rise_rate + c->rise_start);
        const float8 down = clamped((c->fall - values) * c->fall_rate + c->fall_start);
        found = up < down ? up : down;
    }
    return isnan(values) ? 0.0f : found;
}

// Cubic B-spline along columns of coefficients: values and derivatives towards the south of the columns from `left` on.
__kernel void spline_down(__global const float *coefficients, int stride, int left, int cols,
                          __global const int *first, __global const float *weight, __global const float *slope,
                          int rows, __global float *values, __global float *southward)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cols || y >= rows)
        return;
    __global const float *from = coefficients + (size_t)first[y] * stride + left + x;
    float value = 0.0f, south = 0.0f;
    for (int tap = 0; tap < 4; ++tap) {
        const float c = from[(size_t)tap * stride];
        value += weight[tap * rows + y] * c;
        south += slope[tap * rows + y] * c;
    }
    values[(size_t)y * cols + x] = value;
    southward[(size_t)y * cols + x] = south;
}

// And along rows.
__kernel void spline_across(__global const float *values, __global const float *southward, int cols, int left,
                            __global const int *first, __global const float *weight, __global const float *slope,
                            float offset, int wide, int rows, __global float *height, __global float *east,
                            __global float *north)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= wide || y >= rows)
        return;
    const size_t from = (size_t)y * cols + first[x] - left, to = (size_t)y * wide + x;
    float value = 0.0f, dx = 0.0f, dy = 0.0f;
    for (int tap = 0; tap < 4; ++tap) {
        const float c = values[from + tap], w = weight[tap * wide + x];
        value += w * c;
        dx += slope[tap * wide + x] * c;
        dy -= w * southward[from + tap];
    }
    height[to] = value + offset;
    east[to] = dx;
    north[to] = dy;
}

// A quantity, bilinear; NaN where the nearest cell is void (`missing`, if given) or there is none.
__kernel void bilinear(__global const float *cells, __global const uchar *missing, int rows, int cols,
                       __global const int *down, __global const float *down_weight, __global const int *down_nearest,
                       __global const int *across, __global const float *across_weight,
                       __global const int *across_nearest, float offset, int wide, int high, int number,
                       __global float *planes)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= wide || y >= high)
        return;
    const int near_row = down_nearest[y], near_col = across_nearest[x];
    const int hole = near_row < 0 || near_col < 0 || (missing && missing[(size_t)near_row * cols + near_col]);
    __global const float *upper = cells + (size_t)down[y] * cols;
    __global const float *lower = cells + (size_t)min(down[y] + 1, rows - 1) * cols;
    const int left = across[x], right = min(left + 1, cols - 1);
    const float s = down_weight[high + y], t = across_weight[wide + x];
    const float a = upper[left] + s * (lower[left] - upper[left]), b = upper[right] + s * (lower[right] - upper[right]);
    planes[((size_t)number * high + y) * wide + x] = hole ? NAN : a + t * (b - a) + offset;
}

// Layers `begin` to `end` - 1.  The slope is that of the ground displaced by `rise`, what layers before `begin` have added;
// `risen` is what there is after `end`.  `places` says where layers, constraints and details begin among the words, and
// how many lattices all noises have.  Planes of `covers` and `colour` lie one after the other.
__kernel void paint(__global const uint *words, int4 places, __global const uint *origins, int tiles, int tile_row,
                    int tile_col, int begin, int end, int steep, int row, int col, int wide, int high, float width,
                    float height, __global const float *ground, __global const float *east,
                    __global const float *north, __global const float *quantities, __global const float *rise,
                    __global float *risen, __global float *colour, __global float *covers)
{
    const int x = get_global_id(0) * 8, y = get_global_id(1);
    if (x >= wide || y >= high)
        return;
    __global const Layer *layers = (__global const Layer *)(words + places.x);
    __global const Constraint *constraints = (__global const Constraint *)(words + places.y);
    __global const Detail *details = (__global const Detail *)(words + places.z);
    const size_t at = (size_t)y * wide + x, plane = (size_t)wide * high;

    // Offsets from the middle of a tile of 64 x 64 texels.
    const int global_row = row + y, global_col = col + x;
    __global const uint *tile = origins + (size_t)4 * places.w *
                                ((size_t)((global_row >> 6) - tile_row) * tiles + ((global_col >> 6) - tile_col));
    const float8 lanes = (float8)(0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f);
    const float8 px = (lanes + (float)((global_col & 63) - 32)) * width;
    const float8 py = (float8)(31.5f - (float)(global_row & 63)) * height;

    const float8 base = get8(ground + at);
    float8 added = begin ? get8(rise + at) : 0.0f;
    float8 steepness = 0.0f;
    if (steep) {
        float8 dx = get8(east + at), dy = get8(north + at);
        if (begin && y > 0 && y < high - 1) {
            dx += (load8(rise + (size_t)y * wide, x + 1, wide, 0.0f) - load8(rise + (size_t)y * wide, x - 1, wide, 0.0f)) *
                  (0.5f / width);
            dy += (get8(rise + at - wide) - get8(rise + at + wide)) * (0.5f / height);
        }
        steepness = atan(sqrt(dx * dx + dy * dy)) * 57.29577951308232f;
    }
    float8 mix[3];
    for (int channel = 0; channel < 3; ++channel)
        mix[channel] = begin ? get8(colour + channel * plane + at) : (float8)layers->colour[channel];

    for (int number = begin; number < end; ++number) {
        __global const Layer *layer = layers + number;
        const float8 most = layer->parent < 0 ? 1.0f : get8(covers + layer->parent * plane + at);
        float8 cover = most > 0.0f ? (float8)1.0f : (float8)0.0f;
        for (int i = layer->first; i < layer->first + layer->count && any8(cover > 0.0f); ++i) {
            const int quantity = constraints[i].quantity;
            const float8 values = quantity == 0   ? base + added
                                  : quantity == 1 ? steepness
                                                  : get8(quantities + (quantity - 2) * plane + at);
            cover *= suitability(constraints + i, words, values);
        }
        const int8 some = cover > 0.0f;
        if (any8(some)) {
            // One call for all three, as the compiler writes each out in full.
            for (int role = 0; role < 3; ++role) {
                const int which = layer->noise[role];
                float8 noise = 0.0f;
                if (which >= 0) {
                    __global const Detail *detail = details + which;
                    noise = detail->offset;
                    if (detail->table >= 0)
                        noise += detail->factor * noise_value_lod(noise_at(words, detail->table),
                                                                  noise_origin(tile, detail->lattice), px, py,
                                                                  (float8)detail->kappa);
                }
                if (role == 0) {
                    cover = clamped((layer->bias + layer->scale * noise) * cover) * most;
                    cover = some ? cover : 0.0f;
                } else if (role == 1) {
                    added += cover * layer->roughness * noise;
                } else {
                    const float8 brightness = 1.0f + layer->variation * noise;
                    for (int channel = 0; channel < 3; ++channel) {
                        const float8 own = which < 0 ? (float8)layer->colour[channel]
                                                     : clamped(brightness * layer->colour[channel]);
                        mix[channel] = (1.0f - cover) * mix[channel] + cover * own;
                    }
                }
            }
        }
        put8(cover, covers + number * plane + at);
    }
    put8(added, risen + at);
    for (int channel = 0; channel < 3; ++channel)
        put8(mix[channel], colour + channel * plane + at);
}

// The inner part of a window, from (top, left) on, into pictures of `cols` columns from row `into` on.
// `holes`, if given, says which texels are void.
__kernel void finish(__global const float *ground, __global const float *east, __global const float *north,
                     __global const float *rise, __global const float *colour, __global const float *covers,
                     __global const uchar *holes, int layers, int displaced, int wide, int high, int top, int left,
                     int rows, int cols, int into, float width, float height, __global uchar *pixels,
                     __global float *heights, __global float *normals, __global float *coverage)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= cols || y >= rows)
        return;
    const size_t plane = (size_t)wide * high, at = (size_t)(y + top) * wide + x + left;
    const size_t to = (size_t)(y + into) * cols + x;
    if (holes && holes[at]) {
        vstore4((uchar4)0, to, pixels);
        heights[to] = NAN;
        vstore3((float3)NAN, to, normals);
        for (int layer = 0; layer < layers; ++layer)
            coverage[to * layers + layer] = 0.0f;
        return;
    }
    float dx = east[at], dy = north[at];
    if (displaced) {
        dx += (rise[at + 1] - rise[at - 1]) * (0.5f / width);
        dy += (rise[at - wide] - rise[at + wide]) * (0.5f / height);
    }
    const float over = 1.0f / sqrt(1.0f + dx * dx + dy * dy);
    vstore3((float3)(-dx * over, -dy * over, over), to, normals);
    heights[to] = ground[at] + rise[at];
    const float4 shown = (float4)(colour[at], colour[plane + at], colour[2 * plane + at], covers[at]);
    vstore4(convert_uchar4_sat_rte(shown * 255.0f), to, pixels);
    for (int layer = 0; layer < layers; ++layer)
        coverage[to * layers + layer] = covers[layer * plane + at];
}
