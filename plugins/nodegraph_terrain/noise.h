// Gradient noise and its sums on eight points at a time: what gradient_noise.py and noise.py define, to 1e-5.
//
// A noise is a table of words that `Noise.table()` makes: a NoiseSum, then a NoiseOctave for each lattice.  Points are
// offsets (x, y) in metres from an origin of the caller's choice (the corner of a tile), of which `Noise.origins(x, y)`
// gives the place on each lattice, in float64: so float32 keeps its digits anywhere.  An offset spans
// at most 2^22 cells of the finest octave; the error is about 2e-7 of the amplitude.
//
//     __global const NoiseSum *sum = noise_at(words, first);           // words: uint, first: where its table starts
//     __global const NoiseOrigin *origin = noise_origin(origins, k);   // k = tile * lattices
//     float8 value = noise_value(sum, origin, x, y);
//     float8 value = noise_slopes(sum, origin, x, y, &east, &north);   // and the gradient, per metre
//
// These look the kind up in the table.  Callers that know it call one of
//
//     noise_fbm  noise_billow  noise_ridged  noise_hybrid  noise_warped           (sum, origin, x, y)
//     noise_fbm_slopes ...                                                        (sum, origin, x, y, &east, &north)
//
// and each has a form for levels of detail, with kappa (float8, 0 to 1) after y: noise_value_lod, noise_slopes_lod,
// noise_fbm_lod, noise_fbm_slopes_lod ...  Gradients are those at a fixed kappa.  A NaN in gives some number out.
//
// All are eight points wide: drivers of CPUs turn the explicit vectors into SIMD code, which they do not manage for
// kernels of one point.

#ifndef NODEGRAPH_TERRAIN_NOISE_H
#define NODEGRAPH_TERRAIN_NOISE_H

#define NOISE_FBM 0
#define NOISE_BILLOW 1
#define NOISE_RIDGED 2
#define NOISE_HYBRID 3
#define NOISE_WARPED 4

#define NOISE_OFFSET 0.7f

// Eight words each; kind, octaves that are summed, octaves of each component of a displacement.
typedef struct {
    int kind, octaves, warps;
    float feedback;
    int unused[4];
} NoiseSum;

// Amplitude, seed, cells per metre and rotation in two parts (see noise_octave), the start of its interval of kappa and one
// over its length.
typedef struct {
    float amplitude;
    uint seed;
    float cosine, sine, cosine_rest, sine_rest;
    float start, rate;
} NoiseOctave;

// Cell and place in it, 0 to 1, of an origin on a lattice.
typedef struct {
    int column, row;
    float u, v;
} NoiseOrigin;

static inline __global const NoiseSum *noise_at(__global const uint *words, size_t first)
{
    return (__global const NoiseSum *)(words + first);
}

static inline __global const NoiseOrigin *noise_origin(__global const uint *words, size_t index)
{
    return (__global const NoiseOrigin *)(words + 4 * index);
}

// How many lattices, hence origins, a noise has.
static inline int noise_lattices(__global const NoiseSum *sum)
{
    return sum->octaves + 2 * sum->warps;
}

// The greatest whole number not above t.  Where the driver keeps floor as a function, calling it would spill all registers.
static inline float8 noise_floor(float8 t)
{
#if defined(__has_builtin)
#if __has_builtin(__builtin_elementwise_floor)
#define NOISE_HAS_FLOOR
#endif
#endif
#ifdef NOISE_HAS_FLOOR
    return __builtin_elementwise_floor(t);
#else
    return floor(t);
#endif
}

static inline float8 noise_clamped(float8 t)
{
    t = t > 0.0f ? t : 0.0f;
    return t < 1.0f ? t : 1.0f;
}

static inline uint8 noise_column(uint8 x, uint seed)
{
    x ^= seed;
    x ^= x >> 15;
    return x * 0xC2B2AE3Du;
}

static inline uint8 noise_row(uint8 y)
{
    return y ^ (y >> 11);
}

// A vector of length sqrt(2) for the lattice points with these two parts of a hash: (E - O, E + O) with two signs.
static inline void noise_direction(uint8 column, uint8 row, float8 *east, float8 *north)
{
    uint8 h = column ^ row;
    h ^= h >> 17;
    h *= 0x29F3126Bu;
    h ^= h >> 15;
    const uint8 sign = h & 0x80000000u;
    h *= 0xD35A2D97u;
    // Lower bits as the mantissa of a number from 1 to 2.
    const float8 t = as_float8((h & 0x007FFFFFu) | 0x3F800000u) - 1.5f;
    const float8 square = t * t;
    const float8 even = -1.1854443550109863f * square + 0.9998835921287537f;
    const float8 odd = (-0.4840468168258667f * square + 1.5423520803451538f) * t;
    *east = as_float8(as_uint8(even - odd) ^ (h & 0x80000000u));
    *north = as_float8(as_uint8(even + odd) ^ sign);
}

// 6 t^5 - 15 t^4 + 10 t^3 at t + 1/2: so no large terms cancel, which near t = 1 would cost three bits.
static inline float8 noise_fade(float8 t)
{
    const float8 square = t * t;
    return t * ((6.0f * square - 5.0f) * square + 1.875f) + 0.5f;
}

// Noise in the cell at (column, row), at (u, v) from its centre, and its derivatives per cell if `slopes`.
static inline float8 noise_cell(uint8 column, uint8 row, float8 u, float8 v, uint seed, const int slopes,
                                float8 *along_u, float8 *along_v)
{
    const uint8 scaled = column * 0x9E3779B1u;
    const uint8 near = noise_column(scaled, seed), far = noise_column(scaled + 0x9E3779B1u, seed);
    const uint8 shifted = row * 0x85EBCA77u + seed;
    const uint8 bottom = noise_row(shifted), top = noise_row(shifted + 0x85EBCA77u);
    float8 east00, north00, east10, north10, east01, north01, east11, north11;
    noise_direction(near, bottom, &east00, &north00);
    noise_direction(far, bottom, &east10, &north10);
    noise_direction(near, top, &east01, &north01);
    noise_direction(far, top, &east11, &north11);
    const float8 x = u + 0.5f, y = v + 0.5f, x1 = u - 0.5f, y1 = v - 0.5f;
    const float8 n00 = east00 * x + north00 * y, n10 = east10 * x1 + north10 * y;
    const float8 n01 = east01 * x + north01 * y1, n11 = east11 * x1 + north11 * y1;
    const float8 sx = noise_fade(u), sy = noise_fade(v);
    const float8 c = n10 - n00, d = n11 - n01;
    const float8 lower = sx * c + n00, upper = sx * d + n01;
    if (slopes) {
        const float8 dx = x * x1, dy = y * y1;
        float8 a = sx * (east10 - east00) + east00, b = sx * (east11 - east01) + east01;
        *along_u = sy * (b - a) + a + 30.0f * dx * dx * (sy * (d - c) + c);
        a = sx * (north10 - north00) + north00, b = sx * (north11 - north01) + north01;
        *along_v = sy * (b - a) + a + 30.0f * dy * dy * (upper - lower);
    }
    return sy * (upper - lower) + lower;
}

// Noise at (u, v) cells from the cell `base`, for callers with lattices of their own.
static inline float8 noise_lattice(int2 base, float8 u, float8 v, uint seed, const int slopes, float8 *along_u,
                                   float8 *along_v)
{
    const float8 left = noise_floor(u), low = noise_floor(v);
    const uint8 column = as_uint8(convert_int8(left)) + (uint)base.x;
    const uint8 row = as_uint8(convert_int8(low)) + (uint)base.y;
    return noise_cell(column, row, (u - left) - 0.5f, (v - low) - 0.5f, seed, slopes, along_u, along_v);
}

// An offset in two parts: the first has 12 bits.
typedef struct {
    float8 x, y, x_rest, y_rest;
} NoisePlace;

// The offset (x + dx, y + dy).
static inline NoisePlace noise_place(float8 x, float8 y, float8 dx, float8 dy)
{
    NoisePlace at;
    at.x = as_float8(as_uint8(x) & 0xFFFFF000u);
    at.y = as_float8(as_uint8(y) & 0xFFFFF000u);
    at.x_rest = (x - at.x) + dx;
    at.y_rest = (y - at.y) + dy;
    return at;
}

// Added to a number below 2^22, this rounds it to a whole one, which stands in the last bits of the sum.
#define NOISE_WHOLE 12582912.0f
#define NOISE_WHOLE_BITS 0x4B400000u

// n_i of an octave and, if `slopes`, its derivatives per metre.
//
// An offset may span hundreds of cells, of which float32 would keep some 1e-5.  The octave's numbers, too, are in two
// parts: products of first parts are exact, and the nearest whole cells are taken off them before anything is added.  What
// is left is small, hence true to 1e-7.
static inline float8 noise_octave(__global const NoiseOctave *octave, __global const NoiseOrigin *origin,
                                  const NoisePlace at, const int slopes, float8 *east, float8 *north)
{
    const float c = octave->cosine, s = octave->sine, c_rest = octave->cosine_rest, s_rest = octave->sine_rest;
    const float cosine = c + c_rest, sine = s + s_rest;
    const float8 cx = c * at.x + NOISE_WHOLE, sx = s * at.x + NOISE_WHOLE;
    const float8 cy = c * at.y + NOISE_WHOLE, sy = NOISE_WHOLE - s * at.y;
    float8 u = cosine * at.x_rest + (c_rest * at.x + (origin->u - 0.5f)) - (sine * at.y_rest + s_rest * at.y);
    float8 v = sine * at.x_rest + (s_rest * at.x + (origin->v - 0.5f)) + (cosine * at.y_rest + c_rest * at.y);
    u += (c * at.x - (cx - NOISE_WHOLE)) - (s * at.y + (sy - NOISE_WHOLE));
    v += (s * at.x - (sx - NOISE_WHOLE)) + (c * at.y - (cy - NOISE_WHOLE));
    const float8 left = u + NOISE_WHOLE, low = v + NOISE_WHOLE;
    const uint8 column = as_uint8(cx) + as_uint8(sy) + as_uint8(left) + ((uint)origin->column - 3u * NOISE_WHOLE_BITS);
    const uint8 row = as_uint8(sx) + as_uint8(cy) + as_uint8(low) + ((uint)origin->row - 3u * NOISE_WHOLE_BITS);
    float8 along_u, along_v;
    const float8 n = noise_cell(column, row, u - (left - NOISE_WHOLE), v - (low - NOISE_WHOLE), octave->seed, slopes,
                                &along_u, &along_v);
    if (slopes) {
        *east = cosine * along_u + sine * along_v;
        *north = cosine * along_v - sine * along_u;
    }
    return n;
}

// b_i at a level of detail, rising from 0 to 1.
static inline float8 noise_filter(__global const NoiseOctave *octave, float8 kappa)
{
    const float8 t = noise_clamped((kappa - octave->start) * octave->rate);
    const float8 rest = 1.0f - t * t;
    return 1.0f - rest * rest * rest;
}

// The greatest of eight levels of detail: octaves that start above it are left out.
static inline float noise_greatest(float8 kappa)
{
    const float4 a = kappa.lo > kappa.hi ? kappa.lo : kappa.hi;
    const float2 b = a.lo > a.hi ? a.lo : a.hi;
    return b.x > b.y ? b.x : b.y;
}

static inline __global const NoiseOctave *noise_octaves(__global const NoiseSum *sum)
{
    return (__global const NoiseOctave *)(sum + 1);
}

#define NOISE_ARGUMENTS                                                                                          \
    __global const NoiseSum *sum, __global const NoiseOrigin *origin, float8 x, float8 y, const int filtered,    \
        float8 kappa, const int slopes, float8 *east, float8 *north

static inline float8 noise_series(__global const NoiseOctave *octave, __global const NoiseOrigin *origin, int count,
                                  const int absolute, const NoisePlace at, const int filtered, float8 kappa,
                                  const int slopes, float8 *east, float8 *north)
{
    const float detail = filtered ? noise_greatest(kappa) : 1.0f;
    float8 value = 0.0f, ex = 0.0f, ny = 0.0f;
    for (int i = 0; i < count; ++i) {
        if (filtered && detail <= octave[i].start)
            continue;
        float8 along_x, along_y;
        float8 n = noise_octave(octave + i, origin + i, at, slopes, &along_x, &along_y);
        float8 factor = octave[i].amplitude;
        if (filtered)
            factor *= noise_filter(octave + i, kappa);
        value += factor * (absolute ? fabs(n) : n);
        if (slopes) {
            if (absolute)
                factor = n < 0.0f ? -factor : n > 0.0f ? factor : 0.0f;
            ex += factor * along_x;
            ny += factor * along_y;
        }
    }
    if (slopes) {
        *east = ex;
        *north = ny;
    }
    return value;
}

static inline float8 noise_all_fbm(NOISE_ARGUMENTS)
{
    const NoisePlace at = noise_place(x, y, 0.0f, 0.0f);
    return noise_series(noise_octaves(sum), origin, sum->octaves, 0, at, filtered, kappa, slopes, east, north);
}

static inline float8 noise_all_billow(NOISE_ARGUMENTS)
{
    const NoisePlace at = noise_place(x, y, 0.0f, 0.0f);
    return noise_series(noise_octaves(sum), origin, sum->octaves, 1, at, filtered, kappa, slopes, east, north);
}

static inline float8 noise_multifractal(const int ridged, NOISE_ARGUMENTS)
{
    __global const NoiseOctave *octave = noise_octaves(sum);
    const int count = sum->octaves;
    const float raise = 1.0f / (1.0f + NOISE_OFFSET);
    const float feedback = ridged ? sum->feedback : sum->feedback * (1.0f + NOISE_OFFSET);
    float8 value = 0.0f, ex = 0.0f, ny = 0.0f, weight = 1.0f, weight_x = 0.0f, weight_y = 0.0f;
    const float detail = filtered ? noise_greatest(kappa) : 1.0f;
    const NoisePlace at = noise_place(x, y, 0.0f, 0.0f);
    for (int i = 0; i < count; ++i) {
        if (filtered && detail <= octave[i].start)
            continue;
        float8 along_x, along_y, signal, slope;
        const float8 n = noise_octave(octave + i, origin + i, at, slopes, &along_x, &along_y);
        if (ridged) {
            const float8 depth = 1.0f - fabs(n);
            signal = depth * depth;
            slope = n > 0.0f ? -2.0f * depth : n < 0.0f ? 2.0f * depth : 0.0f;
        } else {
            signal = n * raise + NOISE_OFFSET * raise;
            slope = raise;
        }
        float8 b = 1.0f;
        if (filtered)
            b = noise_filter(octave + i, kappa);
        const float8 factor = octave[i].amplitude * b;
        const float8 weighted = weight * signal, risen = feedback * weighted;
        value += factor * weighted;
        if (slopes) {
            const int8 open = risen > 0.0f && risen < 1.0f;
            const float8 rate_x = weight_x * signal + weight * (slope * along_x);
            const float8 rate_y = weight_y * signal + weight * (slope * along_y);
            ex += factor * rate_x;
            ny += factor * rate_y;
            const float8 after_x = open ? feedback * rate_x : 0.0f, after_y = open ? feedback * rate_y : 0.0f;
            weight_x = filtered ? (1.0f - b) * weight_x + b * after_x : after_x;
            weight_y = filtered ? (1.0f - b) * weight_y + b * after_y : after_y;
        }
        const float8 clamped = noise_clamped(risen);
        weight = filtered ? (1.0f - b) * weight + b * clamped : clamped;
    }
    if (slopes) {
        *east = ex;
        *north = ny;
    }
    return value;
}

static inline float8 noise_all_ridged(NOISE_ARGUMENTS)
{
    return noise_multifractal(1, sum, origin, x, y, filtered, kappa, slopes, east, north);
}

static inline float8 noise_all_hybrid(NOISE_ARGUMENTS)
{
    return noise_multifractal(0, sum, origin, x, y, filtered, kappa, slopes, east, north);
}

static inline float8 noise_all_warped(NOISE_ARGUMENTS)
{
    __global const NoiseOctave *octave = noise_octaves(sum);
    const int count = sum->octaves, warps = sum->warps;
    const NoisePlace at = noise_place(x, y, 0.0f, 0.0f);
    float8 qx, qy, rx, ry, ex, ny;
    const float8 q = noise_series(octave + count, origin + count, warps, 0, at, filtered, kappa, slopes, &qx, &qy);
    const float8 r = noise_series(octave + count + warps, origin + count + warps, warps, 0, at, filtered, kappa,
                                  slopes, &rx, &ry);
    const NoisePlace to = noise_place(x, y, q, r);
    const float8 value = noise_series(octave, origin, count, 0, to, filtered, kappa, slopes, &ex, &ny);
    if (slopes) {
        *east = ex + ex * qx + ny * rx;
        *north = ny + ex * qy + ny * ry;
    }
    return value;
}

static inline float8 noise_all(NOISE_ARGUMENTS)
{
    switch (sum->kind) {
    case NOISE_BILLOW:
        return noise_all_billow(sum, origin, x, y, filtered, kappa, slopes, east, north);
    case NOISE_RIDGED:
        return noise_all_ridged(sum, origin, x, y, filtered, kappa, slopes, east, north);
    case NOISE_HYBRID:
        return noise_all_hybrid(sum, origin, x, y, filtered, kappa, slopes, east, north);
    case NOISE_WARPED:
        return noise_all_warped(sum, origin, x, y, filtered, kappa, slopes, east, north);
    default:
        return noise_all_fbm(sum, origin, x, y, filtered, kappa, slopes, east, north);
    }
}

// The forms that callers use.
#define NOISE_FORMS(all, value, with_slopes)                                                                     \
    static inline float8 value(__global const NoiseSum *sum, __global const NoiseOrigin *origin, float8 x,       \
                               float8 y)                                                                         \
    {                                                                                                            \
        float8 east, north;                                                                                      \
        return all(sum, origin, x, y, 0, (float8)1.0f, 0, &east, &north);                                        \
    }                                                                                                            \
    static inline float8 value##_lod(__global const NoiseSum *sum, __global const NoiseOrigin *origin, float8 x, \
                                     float8 y, float8 kappa)                                                     \
    {                                                                                                            \
        float8 east, north;                                                                                      \
        return all(sum, origin, x, y, 1, kappa, 0, &east, &north);                                               \
    }                                                                                                            \
    static inline float8 with_slopes(__global const NoiseSum *sum, __global const NoiseOrigin *origin, float8 x, \
                                     float8 y, float8 *east, float8 *north)                                      \
    {                                                                                                            \
        return all(sum, origin, x, y, 0, (float8)1.0f, 1, east, north);                                          \
    }                                                                                                            \
    static inline float8 with_slopes##_lod(__global const NoiseSum *sum, __global const NoiseOrigin *origin,     \
                                           float8 x, float8 y, float8 kappa, float8 *east, float8 *north)        \
    {                                                                                                            \
        return all(sum, origin, x, y, 1, kappa, 1, east, north);                                                 \
    }

NOISE_FORMS(noise_all, noise_value, noise_slopes)
NOISE_FORMS(noise_all_fbm, noise_fbm, noise_fbm_slopes)
NOISE_FORMS(noise_all_billow, noise_billow, noise_billow_slopes)
NOISE_FORMS(noise_all_ridged, noise_ridged, noise_ridged_slopes)
NOISE_FORMS(noise_all_hybrid, noise_hybrid, noise_hybrid_slopes)
NOISE_FORMS(noise_all_warped, noise_warped, noise_warped_slopes)

#endif
