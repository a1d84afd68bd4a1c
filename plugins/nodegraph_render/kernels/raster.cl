// Following rays to a bilinear height field (height_field.py), exactly, or with PLAIN by sphere tracing.
//
// Positions are in cells from the centre of the north-western cell, x towards east and y towards south; z and the
// distance t along a ray are in metres.  A ray is followed from where it enters the box of the field, where t is 0.

#include "lanes.h"

#define ZERO ((F)(0.0f))
#define NEVER ((F)(INFINITY))
#define NO ((I)(0))

// Axes that a ray came in by.
#define X_AXIS 1
#define Y_AXIS 2

typedef struct {
    __global const float *restrict heights; // of the centres of cells
    __global const float *restrict pyramid; // greatest heights over quads, then over blocks; -INFINITY where void
    __global const int *restrict levels;    // of each level: where it begins in `pyramid`, and its width
    int rows, cols, coarsest;
    float bottom, top;
} Field;

typedef struct {
    F x, y, z;    // where it enters the box, cells and m
    F dx, dy, dz; // per metre
    F start, end; // distance from the origin to there, and from there to where it ends
    I axis;       // through which side it enters; 0 from above or where it begins inside
    I live;       // mask: it meets the box
} Ray;

typedef struct {
    F t;        // INFINITY: nothing was hit
    I column, row;
    I axis;     // by which the ray came into the quad
    I below;    // mask: the ray was below the surface as it came into the quad
    I steps;
} Hit;

// f = base + east u + south v + twist u v, with u and v from 0 to 1 over a quad.
typedef struct {
    F base, east, south, twist;
} Patch;

static inline Patch patch_at(const Field *field, I column, I row)
{
    const I at = row * field->cols + column;
    const F nw = GATHER(F, field->heights, at), ne = GATHER(F, field->heights + 1, at);
    const F sw = GATHER(F, field->heights + field->cols, at), se = GATHER(F, field->heights + field->cols + 1, at);
    const F east = ne - nw;
    return (Patch){nw, east, sw - nw, se - sw - east};
}

static inline F height_on(const Patch *patch, F u, F v)
{
    return patch->base + patch->east * u + (patch->south + patch->twist * u) * v;
}

// Narrow a ray to the slab 0 <= position <= last of an axis.
static inline void clip(Ray *ray, F origin, F direction, F inverse, I parallel, float last, int axis)
{
    const F a = -origin * inverse, b = (last - origin) * inverse;
    const I outside = (origin < 0.0f) | (origin > last);
    const F enter = parallel ? (outside ? NEVER : ZERO) : least(a, b);
    const F leave = parallel ? NEVER : greatest(a, b);
    ray->axis = enter > ray->start ? (I)(axis) : ray->axis;
    ray->start = greatest(enter, ray->start);
    ray->end = least(leave, ray->end);
}

static inline Ray enter_box(const Field *field, F x, F y, F z, F dx, F dy, F dz, F reach)
{
    const float right = field->cols - 1, bottom = field->rows - 1;
    // Finite, so that products with 0 are 0.
    Ray ray = {x, y, z, dx, dy, dz, ZERO, least(reach, (F)(1e30f)), NO, NO};
    clip(&ray, x, dx, 1.0f / dx, dx == 0.0f, right, X_AXIS);
    clip(&ray, y, dy, 1.0f / dy, dy == 0.0f, bottom, Y_AXIS);
    // Of a level ray the sign of 0 must not decide.
    const F level = dz == 0.0f ? (z > field->top ? -NEVER : NEVER) : (field->top - z) / dz;
    const I enters = (dz < 0.0f) & (level > ray.start), leaves = !(dz < 0.0f) & (level < ray.end);
    ray.start = enters ? level : ray.start;
    ray.axis = enters ? NO : ray.axis;
    ray.end = leaves ? level : ray.end;
    ray.live = ray.start <= ray.end;
    const F start = ray.live ? ray.start : ZERO;
    ray.x = ray.live ? least(greatest(x + start * dx, ZERO), (F)(right)) : ZERO;
    ray.y = ray.live ? least(greatest(y + start * dy, ZERO), (F)(bottom)) : ZERO;
    ray.z = z + start * dz;
    ray.end -= start;
    return ray;
}

// The first root from 0 to `span` of c + b s + a s^2, where c > 0; INFINITY where there is none.
static inline F first_root(F a, F b, F c, F span)
{
    const F discriminant = b * b - 4.0f * a * c;
    const F root = sqrt(greatest(discriminant, ZERO));
    // Neither form subtracts what is nearly equal.
    const F first = b < 0.0f ? 2.0f * c / (root - b) : -0.5f * (b + root) / a;
    const I dips = (a > 0.0f) & (b < 0.0f) & (b + 2.0f * a * span > 0.0f) & (discriminant >= 0.0f);
    const I below = c + span * (b + a * span) <= 0.0f;
    return (below | dips) ? least(first, span) : NEVER;
}

#if !PLAIN
// From block to block of the pyramid: over those that the ray passes above, down into the others, and in the quads at
// the bottom where f(x, y) = z is quadratic in t.  What rounding hides on the border of a quad is found in the next:
// the ray is then below the surface as it enters.
static inline Hit follow(const Field *field, const Ray *ray)
{
    const I parallel_x = ray->dx == 0.0f, parallel_y = ray->dy == 0.0f;
    const F per_x = 1.0f / ray->dx, per_y = 1.0f / ray->dy;
    const I forward_x = !(ray->dx < 0.0f) ? (I)(1) : NO, forward_y = !(ray->dy < 0.0f) ? (I)(1) : NO;
    const I last_column = field->cols - 2, last_row = field->rows - 2, coarsest = field->coarsest;
    I column = between(TO_I(ray->x), NO, last_column), row = between(TO_I(ray->y), NO, last_row);
    // In a block twice as wide as the stretch in which the ray passes through all heights there is seldom nothing to
    // look at.
    const F sink = (ray->dz < 0.0f ? ray->z - field->bottom : field->top - ray->z) / fabs(ray->dz);
    const F stretch = sink * greatest(fabs(ray->dx), fabs(ray->dy));
    I widest = NO;
    for (int k = 1; k <= field->coarsest; k++)
        widest += 2.0f * stretch >= (float)(1 << k * SHIFT) ? (I)(1) : NO;
    // A ray that begins inside the box may begin near the ground.
    I level = ((ray->start > 0.0f) | (widest < 1)) ? widest : (I)(1), live = ray->live;
    F t = ZERO;
    Hit hit = {NEVER, NO, NO, ray->axis, NO, NO};
    while (any_lane(live)) {
        hit.steps += live ? (I)(1) : NO;
        const I shift = level * SHIFT;
        const I block_x = column >> shift, block_y = row >> shift;
        const I next_x = (block_x + forward_x) << shift, next_y = (block_y + forward_y) << shift;
        const F leave_x = parallel_x ? NEVER : (TO_F(next_x) - ray->x) * per_x;
        const F leave_y = parallel_y ? NEVER : (TO_F(next_y) - ray->y) * per_y;
        const I through_x = leave_x < leave_y;
        const F leave = greatest(t, least(through_x ? leave_x : leave_y, ray->end));
        const F lowest = ray->z + ray->dz * (ray->dz < 0.0f ? leave : t);
        const I at = GATHER(I, field->levels, 2 * level) + block_y * GATHER(I, field->levels + 1, 2 * level) + block_x;
        const F highest = GATHER(F, field->pyramid, at);
        const I near = lowest <= highest;
        const I bottom = level == 0;
        const I test = live & near & bottom;
        if (any_lane(test)) {
            const Patch patch = patch_at(field, test ? column : NO, test ? row : NO);
            const F u = ray->dx * t + (ray->x - TO_F(column)), v = ray->dy * t + (ray->y - TO_F(row));
            const F above = ray->z + ray->dz * t - height_on(&patch, u, v);
            const F rate = ray->dz - (patch.east * ray->dx + patch.south * ray->dy) -
                           patch.twist * (u * ray->dy + v * ray->dx);
            const I below = above <= 0.0f;
            const F s = below ? ZERO : first_root(-patch.twist * ray->dx * ray->dy, rate, above, leave - t);
            const I found = test & (s < NEVER);
            hit.t = found ? t + s : hit.t;
            hit.below = found ? below : hit.below;
            live &= !found;
        }
        // A skipped block is left through one of its sides, into a neighbour of the same size.
        const I skip = live & (!near | bottom);
        const I low_x = block_x << shift, high_x = low_x + ((I)(1) << shift) - 1;
        const I low_y = block_y << shift, high_y = low_y + ((I)(1) << shift) - 1;
        const I along_x = between(TO_I(ray->x + leave * ray->dx), low_x, high_x < last_column ? high_x : last_column);
        const I along_y = between(TO_I(ray->y + leave * ray->dy), low_y, high_y < last_row ? high_y : last_row);
        const I to_x = through_x ? next_x - 1 + forward_x : along_x, to_y = through_x ? along_y : next_y - 1 + forward_y;
        live &= !(skip & ((leave >= ray->end) | (to_x < 0) | (to_x > last_column) | (to_y < 0) | (to_y > last_row)));
        const I move = skip & live;
        const I up = (to_x >> (shift + SHIFT) != block_x >> SHIFT) | (to_y >> (shift + SHIFT) != block_y >> SHIFT);
        t = move ? leave : t;
        column = move ? to_x : column;
        row = move ? to_y : row;
        hit.axis = move ? (through_x ? (I)(X_AXIS) : (I)(Y_AXIS)) : hit.axis;
        const I rise = up & (level < (highest > -INFINITY ? widest : coarsest));
        // A block that is looked into is looked into from where the ray comes down to its top.
        const F under = (highest - ray->z) / ray->dz;
        const I lower = live & !move & (ray->dz < 0.0f) & (under > t);
        t = lower ? least(under, leave) : t;
        column = lower ? between(TO_I(ray->x + t * ray->dx), low_x, high_x < last_column ? high_x : last_column) : column;
        row = lower ? between(TO_I(ray->y + t * ray->dy), low_y, high_y < last_row ? high_y : last_row) : row;
        hit.axis = lower ? NO : hit.axis;
        level = move ? level + (rise ? (I)(1) : NO) : live ? level - 1 : NO;
    }
    hit.column = column;
    hit.row = row;
    return hit;
}

#else
// Sphere tracing with one bound: `heights` have no voids here and no slope above `steepest`, so that nothing is hit
// within h / (|u_xy| steepest - u_z) metres of a point h above them.  What lies below them in a void is in the open.
static inline Hit march(const Field *field, const Ray *ray, float width, float height, float steepest, float epsilon)
{
    const I last_column = field->cols - 2, last_row = field->rows - 2;
    const I forward_x = !(ray->dx < 0.0f) ? (I)(1) : NO, forward_y = !(ray->dy < 0.0f) ? (I)(1) : NO;
    const F level = sqrt(ray->dx * ray->dx * (width * width) + ray->dy * ray->dy * (height * height));
    const F approach = level * steepest - ray->dz;
    I live = ray->live;
    F t = ZERO;
    Hit hit = {NEVER, NO, NO, ray->axis, NO, NO};
    while (any_lane(live)) {
        hit.steps += live ? (I)(1) : NO;
        const F x = ray->x + t * ray->dx, y = ray->y + t * ray->dy;
        const I column = live ? between(TO_I(x), NO, last_column) : hit.column;
        const I row = live ? between(TO_I(y), NO, last_row) : hit.row;
        const Patch patch = patch_at(field, column, row);
        const F u = ray->dx * t + (ray->x - TO_F(column)), v = ray->dy * t + (ray->y - TO_F(row));
        const F above = ray->z + t * ray->dz - height_on(&patch, u, v);
        const I ground = GATHER(F, field->pyramid, row * (field->cols - 1) + column) > -INFINITY;
        const I near = above < epsilon;
        const I found = live & near & ground;
        hit.t = found ? t : hit.t;
        hit.below = found ? above <= 0.0f : hit.below;
        hit.column = column;
        hit.row = row;
        live &= !(found | (!near & (approach <= 0.0f)));
        // Below the heights of a void: on to the next quad.
        const F leave_x = ray->dx == 0.0f ? NEVER : (TO_F(column + forward_x) - ray->x) / ray->dx;
        const F leave_y = ray->dy == 0.0f ? NEVER : (TO_F(row + forward_y) - ray->y) / ray->dy;
        const F next = near ? least(leave_x, leave_y) : t + above / approach;
        hit.axis = live ? (near ? (leave_x < leave_y ? (I)(X_AXIS) : (I)(Y_AXIS)) : NO) : hit.axis;
        // At least as far as float32 can tell from here, and out of a void for certain.
        t = live ? greatest(next, t + t * 2.4e-7f + (near ? (F)(0.1f * epsilon) : ZERO)) : t;
        live &= t <= ray->end;
    }
    return hit;
}
#endif

// A group of LANES rays from `first` on.  A stride of 0 gives all rays the same origin, direction or reach.
__kernel void trace(__global const float *restrict heights, __global const float *restrict pyramid,
                    __global const int *restrict levels, int coarsest, int rows, int cols, float bottom, float top, float width,
                    float height, __global const float *restrict gradient, __global const float *restrict origins,
                    int origin_stride, __global const float *restrict directions, int direction_stride,
                    __global const float *restrict reaches, int reach_stride, int count, int first,
                    float steepest, float epsilon, __global float *restrict depth,
                    __global float *restrict normal, __global char *restrict layer, __global int *restrict steps)
{
    if ((int)get_global_id(0) * LANES >= count)
        return;
    // Lanes beyond the end repeat the last ray.
    const I number = (I)((int)get_global_id(0) * LANES) + RAMP;
    const I lane = number < count ? number : (I)(count - 1);
    const Field field = {heights, pyramid, levels, rows, cols, coarsest, bottom, top};
    const I from = lane * origin_stride, along = lane * direction_stride;
    const Ray ray = enter_box(&field, GATHER(F, origins, from), GATHER(F, origins + 1, from), GATHER(F, origins + 2, from),
                              GATHER(F, directions, along), GATHER(F, directions + 1, along),
                              GATHER(F, directions + 2, along), GATHER(F, reaches, lane * reach_stride));
#if PLAIN
    const Hit hit = march(&field, &ray, width, height, steepest, epsilon);
#else
    const Hit hit = follow(&field, &ray);
#endif

    const I found = hit.t < NEVER;
    const F t = found ? hit.t : ZERO;
    F east = ZERO, north = ZERO, up = ZERO;
    if (any_lane(found)) {
        const I column = found ? hit.column : NO, row = found ? hit.row : NO;
        const F u = least(greatest(ray.dx * t + (ray.x - TO_F(column)), ZERO), (F)(1.0f));
        const F v = least(greatest(ray.dy * t + (ray.y - TO_F(row)), ZERO), (F)(1.0f));
#if SMOOTH
        const I at = 2 * (row * cols + column);
        const int down = 2 * cols;
#define ACROSS(k) (GATHER(F, gradient + (k), at) + u * (GATHER(F, gradient + (k) + 2, at) - GATHER(F, gradient + (k), at)))
#define MEAN(k) (ACROSS(k) + v * (ACROSS(down + (k)) - ACROSS(k)))
        east = -MEAN(0);
        north = -MEAN(1);
#else
        const Patch patch = patch_at(&field, column, row);
        east = (patch.east + patch.twist * v) * (-1.0f / width);
        north = (patch.south + patch.twist * u) * (1.0f / height);
#endif
        up = 1.0f / sqrt(1.0f + east * east + north * north);
        // The quad that the ray came from: if that is no ground, it hit a wall.
        const I came_x = hit.axis == X_AXIS, came_y = hit.axis == Y_AXIS;
        const I before_x = column - (came_x ? (ray.dx < 0.0f ? (I)(-1) : (I)(1)) : NO);
        const I before_y = row - (came_y ? (ray.dy < 0.0f ? (I)(-1) : (I)(1)) : NO);
        const I inside = (before_x >= 0) & (before_x < cols - 1) & (before_y >= 0) & (before_y < rows - 1);
        const I before = inside ? before_y * (cols - 1) + before_x : NO;
        const I wall = hit.below & (came_x | came_y) & (!inside | !(GATHER(F, pyramid, before) > -INFINITY));
        east = wall ? (came_x ? (ray.dx < 0.0f ? (F)(1.0f) : (F)(-1.0f)) : ZERO) : east * up;
        north = wall ? (came_y ? (ray.dy < 0.0f ? (F)(-1.0f) : (F)(1.0f)) : ZERO) : north * up;
        up = wall ? ZERO : up;
    }
    const F deep = found ? ray.start + t : NEVER;
    east = found ? east : ZERO;
    north = found ? north : ZERO;
    up = found ? up : ZERO;
    const I on = found ? NO : (I)(-1);
    __global float *const upright = normal + (size_t)3 * first;
    SCATTER(upright, 3 * lane, east)
    SCATTER(upright + 1, 3 * lane, north)
    SCATTER(upright + 2, 3 * lane, up)
    SCATTER(depth + first, lane, deep)
    SCATTER(layer + first, lane, on)
    SCATTER(steps + first, lane, hit.steps)
}
