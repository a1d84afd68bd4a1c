// The pixels of a picture: what materials.py, lighting.py and sky.py define, to 1e-3 of the light.

#include "noise.h"

typedef struct {
    float right[3], up[3], forward[3]; // of the camera, unit vectors
    float half_height;                 // of the picture, m: at a distance of 1 m, or anywhere if `orthographic`
    float rise;                        // how far its middle is above the axis, in parts of its height
    float eye;                         // height, m
    float footprint;                   // of a sample, as half_height
    float limit;                       // brightest sample
    float sun[3];                      // unit vector to it
    float sunlight[3];                 // irradiance across its rays on the ground
    float hidden[3];                   // irradiance from ground that hides the sky
    float harmonics[27];               // irradiance of sky and ground by normal
    float disc[3];                     // radiance of the sun's disc
    float chord;                       // squared, from its centre to its edge; 0: there is none
    float dip;                         // angle from the level down to the horizon
    float molecules[3], haze[3];       // extinction at sea level, 1/m
    int orthographic, rows, cols, k;   // size of the whole picture in samples, and rays along a side of a pixel
    int sky_rows, sky_cols, levels;
} Look;

// What lights.py calls Ground and Plain; else the light comes from the host.
typedef struct {
    int kind; // 0: ground, 1: plain, 2: given
    float snow_line, tree_line, rock_slope, variation, relief, size, octaves;
    float colour[4];
} Material;

#define GROUND 0
#define PLAIN 1

static inline float3 get3(__global const float *from)
{
    return (float3)(from[0], from[1], from[2]);
}

// Unit direction of the ray through a sample, and where it begins, relative to the eye.
static inline float3 ray(__global const Look *look, int row, int col, float3 *origin)
{
    const float v = (1.0f + 2.0f * look->rise - (2 * row + 1) / (float)look->rows) * look->half_height;
    const float u = ((2 * col + 1) / (float)look->cols - 1.0f) * look->half_height * look->cols / look->rows;
    const float3 across = u * get3(look->right) + v * get3(look->up);
    *origin = look->orthographic ? across : (float3)(0.0f);
    return look->orthographic ? get3(look->forward) : normalize(across + get3(look->forward));
}

static inline float footprint(__global const Look *look, float depth)
{
    return look->orthographic ? look->footprint : look->footprint * depth;
}

// Fields of patches and fine slopes of natural ground, four planes of `last - first` rows; eight samples each.
__kernel void patches(__global const Look *look, __global const Material *materials, int number,
                      __global const float *depth, __global const char *layer, __global const uint *words0,
                      __global const uint *origins0, __global const uint *words1, __global const uint *origins1,
                      float spread, float slope, int first, int last, __global float *fields)
{
    const int col = get_global_id(0) * 8, row = get_global_id(1) + first;
    if (row >= last || col >= look->cols)
        return;
    const size_t base = (size_t)(row - first) * look->cols + col, plane = (size_t)(last - first) * look->cols;
    const int count = min(8, look->cols - col);
    __global const Material *material = materials + number;
    float x[8], y[8], kappa[8];
    int any = 0;
    for (int i = 0; i < 8; i++) {
        const int there = i < count && layer[base + i] == number;
        any |= there;
        const float far = there ? depth[base + i] : 0.0f;
        float3 origin;
        const float3 place = far * ray(look, row, col + i, &origin) + origin;
        x[i] = place.x;
        y[i] = place.y;
        kappa[i] = clamp(log2(material->size / (2.0f * fmax(footprint(look, far), 1e-3f))) / material->octaves, 0.0f, 1.0f);
    }
    if (!any)
        return;
    const float8 east = vload8(0, x), north = vload8(0, y), detail = vload8(0, kappa);
    float8 along, across;
    float8 value = spread * noise_fbm_slopes_lod(noise_at(words0, 0), noise_origin(origins0, 0), east, north, detail,
                                                 &along, &across);
    float8 other = spread * noise_fbm_lod(noise_at(words1, 0), noise_origin(origins1, 0), east, north, detail);
    float found[4][8];
    vstore8(value, 0, found[0]);
    vstore8(other, 0, found[1]);
    vstore8(slope * along, 0, found[2]);
    vstore8(slope * across, 0, found[3]);
    for (int i = 0; i < count; i++)
        if (layer[base + i] == number)
            for (int field = 0; field < 4; field++)
                fields[field * plane + base + i] = found[field][i];
}

static inline float steps(float value, float width)
{
    const float t = clamp(value * (0.5f / width) + 0.5f, 0.0f, 1.0f);
    return t * t * (3.0f - 2.0f * t);
}

// Reflectance, and in w the roughness, of natural ground; materials.ground explains it.
static inline float4 ground(__global const Material *material, float3 normal, float altitude, float a, float b,
                            __constant const float4 *kinds)
{
    a *= material->variation;
    b *= material->variation;
    const float steep = degrees(acos(clamp(normal.z, -1.0f, 1.0f)));
    const float treeless = steps(altitude + 130.0f * b - material->tree_line, 50.0f);
    const float wooded = steps(steep - 8.0f + 9.0f * b, 3.0f);
    const float reach = fmax(material->snow_line - material->tree_line, 200.0f);
    const float bare = steps((altitude + 250.0f * a - material->tree_line) / reach - 0.5f, 0.3f);
    const float rocky = steps(steep + 9.0f * a - material->rock_slope, 4.0f);
    const float drifts = altitude + 180.0f * a - 8.0f * fmax(steep - 25.0f, 0.0f) - material->snow_line;
    const float snowy = steps(drifts, 40.0f) * (1.0f - steps(steep + 12.0f * b - 52.0f, 5.0f));
    float4 kind = mix(mix(kinds[1], kinds[0], wooded), mix(kinds[2], kinds[3], bare), treeless);
    kind = mix(kind, mix(kinds[4], kinds[3], bare * 0.5f), rocky);
    kind.xyz *= 1.0f + 0.22f * clamp(a + 0.5f * b, -1.5f, 1.5f);
    return mix(kind, kinds[5], snowy);
}

__constant const float4 KINDS[6] = {KIND_TABLE};

// Irradiance of sky and ground by normal.
static inline float3 irradiance(__global const Look *look, float3 n)
{
    const float basis[9] = {0.282095f,
                            0.488603f * n.y,
                            0.488603f * n.z,
                            0.488603f * n.x,
                            1.092548f * n.x * n.y,
                            1.092548f * n.y * n.z,
                            0.315392f * (3.0f * n.z * n.z - 1.0f),
                            1.092548f * n.x * n.z,
                            0.546274f * (n.x * n.x - n.y * n.y)};
    float3 sum = 0.0f;
    for (int i = 0; i < 9; i++)
        sum += basis[i] * get3(look->harmonics + 3 * i);
    return fmax(sum, 0.0f);
}

// Radiance of the sky with the sun's disc.
static inline float3 sky(__global const Look *look, __global const float *table, float3 direction)
{
    const float angle = asin(clamp(direction.z, -1.0f, 1.0f)) + look->dip;
    const int half_rows = look->sky_rows / 2;
    const float up = half_rows + sqrt(clamp(angle / (M_PI_2_F + look->dip), 0.0f, 1.0f)) * (half_rows - 1);
    const float down = half_rows - 1 - sqrt(clamp(-angle / (M_PI_2_F - look->dip), 0.0f, 1.0f)) * (half_rows - 1);
    const float row = angle >= 0.0f ? up : down;
    const float3 sun = get3(look->sun);
    const float turn = atan2(fabs(direction.x * sun.y - direction.y * sun.x), direction.x * sun.x + direction.y * sun.y);
    const float col = sqrt(turn / M_PI_F) * (look->sky_cols - 1);
    const int i = min((int)row, look->sky_rows - 2), j = min((int)col, look->sky_cols - 2);
    const float u = row - i, v = col - j;
    __global const float *at = table + 3 * (i * look->sky_cols + j);
    const float3 upper = mix(get3(at), get3(at + 3), v);
    at += 3 * look->sky_cols;
    float3 found = mix(upper, mix(get3(at), get3(at + 3), v), u);
    if (look->chord > 0.0f) {
        const float3 apart = direction - sun;
        found += clamp(0.5f + (look->chord - dot(apart, apart)) / (0.1f * look->chord), 0.0f, 1.0f) * get3(look->disc);
    }
    return found;
}

// (1 - exp(-x)) / x
static inline float fading(float x)
{
    return x < 1e-4f ? 1.0f - 0.5f * x : -expm1(-x) / x;
}

static inline float3 fading3(float3 x)
{
    return (float3)(fading(x.x), fading(x.y), fading(x.z));
}

// Light of a surface through the air in front of it; Sky.air_light explains it.
static inline float3 through_air(__global const Look *look, __global const float *lit, float3 light, float3 direction,
                                 float depth)
{
    const float here = fmax(look->eye, 0.0f), there = fmax(look->eye + direction.z * depth, 0.0f);
    const float low = fmin(here, there), rise = fabs(there - here);
    const float3 molecules = depth * exp(low / -MOLECULES_HEIGHT) * fading(rise / MOLECULES_HEIGHT) * get3(look->molecules);
    const float3 haze = depth * exp(low / -HAZE_HEIGHT) * fading(rise / HAZE_HEIGHT) * get3(look->haze);
    const float level = clamp((here + there) / (2.0f * LEVEL_SPACING), 0.0f, look->levels - 1.0f);
    const int i = min((int)level, look->levels - 2);
    __global const float *at = lit + 6 * i;
    const float3 sunlight = mix(get3(at), get3(at + 6), level - i), multiple = mix(get3(at + 3), get3(at + 9), level - i);
    const float cosine = dot(direction, get3(look->sun));
    const float round = 3.0f / (16.0f * M_PI_F) * (1.0f + cosine * cosine);
    const float g = ASYMMETRY;
    const float base = fmax(1.0f + g * g - 2.0f * g * cosine, 1e-4f);
    const float ahead = (1.0f - g * g) / (4.0f * M_PI_F) / (base * sqrt(base));
    const float3 scattered = ALBEDO * haze, all = molecules + haze;
    const float3 added = sunlight * (molecules * round + scattered * ahead) + multiple * (molecules + scattered);
    return light * exp(-all) + added * fading3(all);
}

// One pixel each, from k x k samples; arrays hold the rows from `first` to `last`.
__kernel void pixels(__global const Look *look, __global const Material *materials, __global const float *depth,
                     __global const float *normals, __global const char *layer, __global const float *sunny,
                     __global const float *open, __global const float *fields, __global const float *given,
                     __global const float *table, __global const float *lit, int first, int last,
                     __global float *picture)
{
    const int k = look->k, wide = look->cols / k;
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= wide || y >= (last - first) / k)
        return;
    const size_t plane = (size_t)(last - first) * look->cols;
    float3 sum = 0.0f;
    for (int i = 0; i < k; i++)
        for (int j = 0; j < k; j++) {
            const int row = y * k + i, col = x * k + j;
            const size_t at = (size_t)row * look->cols + col;
            float3 origin;
            const float3 direction = ray(look, first + row, col, &origin);
            float3 light;
            if (layer[at] < 0) {
                light = sky(look, table, direction);
            } else {
                __global const Material *material = materials + layer[at];
                if (material->kind > PLAIN) {
                    light = get3(given + 3 * at);
                } else {
                    float3 normal = get3(normals + 3 * at), albedo = get3(material->colour);
                    if (material->kind == GROUND) {
                        const float altitude = look->eye + origin.z + direction.z * depth[at];
                        const float4 kind = ground(material, normal, altitude, fields[at], fields[plane + at], KINDS);
                        albedo = kind.xyz;
                        const float rough = material->relief * kind.w;
                        normal -= rough * (float3)(fields[2 * plane + at], fields[3 * plane + at], 0.0f);
                        normal = normalize(normal);
                    }
                    light = fmax(dot(normal, get3(look->sun)), 0.0f) * sunny[at] * get3(look->sunlight);
                    light += open[at] * irradiance(look, normal) + (1.0f - open[at]) * get3(look->hidden);
                    light *= albedo / M_PI_F;
                }
                if (!look->orthographic)
                    light = through_air(look, lit, light, direction, depth[at]);
            }
            sum += fmin(light, look->limit);
        }
    vstore3(sum / (float)(k * k), (size_t)y * wide + x, picture);
}
