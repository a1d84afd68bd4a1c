// Sphere tracing a construction tree: each work item follows eight rays.
//
// The rays walk a quadtree of bounds (quadtree.py).  Where a ray passes above all terrain of a node it skips the node;
// in a leaf the leaf's program (device.py) is run for all of the eight rays that are in it, which neighbouring pixels
// mostly are.  A step is the longest that any node around the point allows: see tree_tracer.py for the reasons.
//
// Coordinates are relative to an origin near the eye, so that float32 is as fine as the distance asks for.

#include "machine.h"

#define LANES 8
#define BOLD 0.9f
#define FAST 1e30f

typedef struct {
    __global const float *box;          // west, south, width, height of each node
    __global const float *limits;       // top, slope, slope of the weight, 1 where all is terrain
    __global const int *child;
    __global const float *detail;       // of each leaf
    float threshold;
    int levels;                         // how many levels to ask for bounds: one is plain sphere tracing
} Quadtree;

typedef struct {
    float o[3], u[3], level;            // origin, direction, |u_xy|
    float t, end;
    int outside;                        // the last point was no terrain: the next may lie behind a wall
    float from, gap, safe;              // the last point that stands, the height above the ground there, how far is safe
    float slope;                        // that bounds the ground on a step longer than that; negative: it is not longer
    float fall;                         // how fast the ground came nearer lately
} Ray;

typedef struct {
    float floor, share;                 // epsilon = floor + share * t
} Epsilon;

static inline float epsilon(const Epsilon e, const float t) { return e.floor + e.share * t; }

// Crossing a border, rays go this much further, so that rounding never leaves them where they were.
static inline float beyond(const Epsilon e, const float t) { return 0.125f * epsilon(e, t) + 4e-7f * t; }

// However steep the ground may be, rays go so far: rounding never leaves them where they were, and they end.
static inline float creep(const Epsilon e, const float t) { return epsilon(e, t) / 64.0f + 4e-7f * t; }

// The distance at which a ray leaves a box.
static inline float leaving(const Ray *r, const float4 box)
{
    float t = INFINITY;
    if (r->u[0] != 0.0f)
        t = ((r->u[0] > 0.0f ? box.x + box.z : box.x) - r->o[0]) / r->u[0];
    if (r->u[1] != 0.0f)
        t = fmin(t, ((r->u[1] > 0.0f ? box.y + box.w : box.y) - r->o[1]) / r->u[1]);
    return t;
}

static inline int child_at(const Quadtree *q, const int node, const float4 box, const float x, const float y)
{
    return q->child[node] + (x >= box.x + 0.5f * box.z) + 2 * (y >= box.y + 0.5f * box.w);
}

// Clip a ray to the region and say whether anything is left.
static int clip(const Quadtree *q, Ray *r)
{
    const float4 box = vload4(0, q->box);
    float near = 0.0f;
    for (int axis = 0; axis < 2; axis++) {
        const float low = axis ? box.y : box.x, high = low + (axis ? box.w : box.z);
        if (r->u[axis] == 0.0f) {
            if (r->o[axis] < low || r->o[axis] > high)
                return 0;
            continue;
        }
        const float a = (low - r->o[axis]) / r->u[axis], b = (high - r->o[axis]) / r->u[axis];
        near = fmax(near, fmin(a, b));
        r->end = fmin(r->end, fmax(a, b));
    }
    r->outside = near > 0.0f;
    r->t = near;
    return near <= r->end;
}

// Go on to the next point where the terrain must be asked; return its leaf, or -1 where the ray has ended.
static int seek(const Quadtree *q, const Epsilon e, Ray *r, int *node_out)
{
    while (r->t <= r->end && isfinite(r->t)) {  // a ray that rises over endless ground goes to infinity at once
        const float x = r->o[0] + r->t * r->u[0], y = r->o[1] + r->t * r->u[1], z = r->o[2] + r->t * r->u[2];
        int node = 0, level = 0;
        float next = -1.0f;
        for (;;) {
            const float4 box = vload4(node, q->box);
            if (level < q->levels) {
                const float4 limit = vload4(node, q->limits);
                if (z > limit.x) {
                    const float out = leaving(r, box), down = r->u[2] < 0.0f ? (limit.x - r->o[2]) / r->u[2] : INFINITY;
                    next = fmin(out, down) + beyond(e, r->t);
                    if (limit.x == -INFINITY)
                        r->outside = 1;
                    break;
                }
            }
            const int child = q->child[node];
            if (child < 0) {
                *node_out = node;
                return -1 - child;
            }
            node = child_at(q, node, box, x, y);
            level++;
        }
        r->t = fmax(next, r->t + beyond(e, r->t));
    }
    return -1;
}

// Whether nothing can lie between the last point that stands and this one, though the step was longer than was safe: what
// is free behind this point must meet what was free before the other.
static inline int stands(const Ray *r, const float gap)
{
    if (r->slope < 0.0f)
        return 1;
    return gap >= 0.0f && gap >= (r->t - r->from - r->safe) * (r->slope * r->level + r->u[2]);
}

// Go on from a point where the terrain has height `gap` below it and weight `a`.
static void stride(const Quadtree *q, const Epsilon e, Ray *r, const float gap, const float a)
{
    const float x = r->o[0] + r->t * r->u[0], y = r->o[1] + r->t * r->u[1];
    const float least = beyond(e, r->t), wide = epsilon(e, r->t);
    float best = creep(e, r->t), bold = 0.0f, slope = -1.0f;
    int node = 0;
    for (int level = 0; level < q->levels; level++) {
        const float4 box = vload4(node, q->box), limit = vload4(node, q->limits);
        const float rise = limit.z * r->level;
        float step = leaving(r, box) - r->t + least;
        if (a < q->threshold) {
            step = rise > 0.0f ? fmin(step, fmax((q->threshold - a) / rise, wide)) : step;
        } else {
            const float rate = limit.y * r->level - r->u[2], back = limit.y * r->level + r->u[2];
            if (rate > 0.0f) {
                const float safe = gap / rate, room = step - least;
                // As far as the ground leaves what is free here and there in touch, if it goes on as it did.
                const float far = fmin(room, BOLD * (safe * fmax(back, 0.0f) + gap) / (fmax(back, 0.0f) + r->fall));
                if (q->levels > 1 && limit.w != 0.0f && far > safe && far > bold) {
                    bold = far;
                    slope = limit.y;
                }
                step = fmin(step, safe);
            }
            if (limit.w == 0.0f && rise > 0.0f)
                step = fmin(step, fmax((a - q->threshold) / rise, wide));
        }
        best = fmax(best, step);
        if (q->child[node] < 0)
            break;
        node = child_at(q, node, box, x, y);
    }
    r->from = r->t;
    r->gap = gap;
    r->safe = best;
    r->slope = bold > best ? slope : -1.0f;
    r->t += fmax(best, bold);
}

static inline int first_of(const int set)
{
    int lane = 0;
    while (!(set >> lane & 1))
        lane++;
    return lane;
}

// The lanes of a set that are in the same leaf as its first.
static inline int alike(const int *leaves, const int first, const int set)
{
    int same = 0;
    for (int i = first; i < LANES; i++)
        same |= (set >> i & 1 && leaves[i] == leaves[first]) << i;
    return same;
}

// Run the program of a leaf for the lanes of a set, at points displaced by (dx, dy) metres.
static void ask(
    State *s, const Quadtree *q, const Ray *rays, const int leaf, const float4 box, const int set, const int anywhere,
    const float *dx, const float *dy, __global const int4 *code, __global const int *starts, P floats, N ints, D data)
{
    float *xs = (float *)&s->x, *ys = (float *)&s->y;
    const float wide = TILE / BLOCK_COLUMNS / box.z, high = TILE / BLOCK_ROWS / box.w;
    const int first = first_of(set);
    s->block = anywhere ? -1 : 0;
    for (int i = 0; i < LANES; i++) {
        const int lane = set >> i & 1 ? i : first;  // the others are asked as well: where does not matter
        const Ray *r = rays + lane;
        xs[i] = r->o[0] + r->t * r->u[0] + dx[lane] - box.x;
        ys[i] = r->o[1] + r->t * r->u[1] + dy[lane] - (box.y + box.w);
        const int column = clamp((int)(xs[i] * wide), 0, TILE / BLOCK_COLUMNS - 1);
        const int row = clamp((int)(-ys[i] * high), 0, TILE / BLOCK_ROWS - 1);
        s->block |= 1 << (row * (TILE / BLOCK_COLUMNS) + column);
    }
    s->detail = q->detail[leaf];
    run_program(s, leaf, code, starts, floats, ints, data);
}

// depth: infinite where nothing is hit; normals: planes of x, y and z.
__kernel void trace(
    __global const int4 *restrict code, __global const int *restrict starts, __global const float *restrict floats,
    __global const int *restrict ints, __global const float *restrict data,
    __global const float *restrict boxes, __global const float *restrict limits, __global const int *restrict child,
    __global const float *restrict details, const int levels, const float threshold,
    __global const float *restrict origins, const int origin_step,
    __global const float *restrict directions, const int direction_step, __global const float *restrict reach,
    const int first, const int count, const float ground, const float floor, const float share, const float margin,
    __global float *restrict depth, __global float *restrict normals, __global int *restrict steps)
{
    const Quadtree q = {boxes, limits, child, details, threshold, levels};
    const Epsilon e = {floor, share};
    const int start = first + LANES * get_global_id(0);
    Ray rays[LANES];
    int taken[LANES], leaves[LANES], nodes[LANES], walls[LANES];
    float zero[LANES], found[LANES];
    int active = 0, hits = 0;
    for (int i = 0; i < LANES; i++) {
        Ray *r = rays + i;
        taken[i] = walls[i] = 0;
        zero[i] = 0.0f;
        found[i] = INFINITY;
        if (start + i >= first + count)
            continue;
        const long from = (long)(start + i);
        for (int axis = 0; axis < 3; axis++) {
            r->o[axis] = origins[from * origin_step + axis];
            r->u[axis] = directions[from * direction_step + axis];
        }
        r->level = hypot(r->u[0], r->u[1]);
        r->end = reach[from];
        r->slope = -1.0f;
        r->fall = INFINITY;
        active |= clip(&q, r) << i;
    }
    State s;
    while (active) {
        for (int i = 0; i < LANES; i++)
            if (active >> i & 1) {
                leaves[i] = seek(&q, e, rays + i, nodes + i);
                if (leaves[i] < 0)
                    active &= ~(1 << i);
            }
        int waiting = active;
        while (waiting) {
            const int leader = first_of(waiting), same = alike(leaves, leader, waiting);
            const float4 box = vload4(nodes[leader], boxes);
            ask(&s, &q, rays, leaves[leader], box, same, 0, zero, zero, code, starts, floats, ints, data);
            for (int i = leader; i < LANES; i++) {
                if (!(same >> i & 1))
                    continue;
                Ray *r = rays + i;
                const float f = ((const float *)s.f)[i] - ground, a = ((const float *)s.a)[i];
                const float gap = r->o[2] + r->t * r->u[2] - f;
                taken[i]++;
                if (!stands(r, gap)) {
                    r->t = r->from + r->safe;
                    r->slope = -1.0f;
                    r->fall = INFINITY;
                    continue;
                }
                if (a >= threshold && gap < epsilon(e, r->t)) {
                    walls[i] = r->outside && gap < -epsilon(e, r->t);
                    found[i] = r->t;
                    hits |= 1 << i;
                    active &= ~(1 << i);
                    continue;
                }
                const float fall = (r->gap - gap) / (r->t - r->from);
                r->fall = r->outside || a < threshold || isinf(r->fall) ? FAST : fmax(fall, 0.0f);
                r->outside = a < threshold;
                stride(&q, e, r, gap, a);
            }
            waiting &= ~same;
        }
    }
    // Normals, from central differences as wide as a pixel there: what is finer than that would only flicker.
    int waiting = hits;
    while (waiting) {
        const int leader = first_of(waiting), same = alike(leaves, leader, waiting);
        const float4 box = vload4(nodes[leader], boxes);
        float reach_[LANES], back[LANES];
        float8 f[4], a[4];
        for (int i = 0; i < LANES; i++) {
            const float t = same >> i & 1 ? rays[i].t : rays[leader].t;
            reach_[i] = fmin(fmax(2.0f * epsilon(e, t), 1e-3f), margin * fmin(box.z, box.w));
            back[i] = -reach_[i];
        }
        for (int side = 0; side < 4; side++) {
            const float *d = side & 1 ? back : reach_;
            ask(&s, &q, rays, leaves[leader], box, same, 1, side < 2 ? d : zero, side < 2 ? zero : d,
                code, starts, floats, ints, data);
            f[side] = s.f[0];
            a[side] = s.a[0];
        }
        for (int i = leader; i < LANES; i++) {
            if (!(same >> i & 1))
                continue;
            const float8 *v = walls[i] ? a : f;
            const float scale = 0.5f / reach_[i];
            const float gx = (((const float *)v)[i] - ((const float *)(v + 1))[i]) * scale;
            const float gy = (((const float *)(v + 2))[i] - ((const float *)(v + 3))[i]) * scale;
            float3 n = (float3)(-gx, -gy, walls[i] ? 0.0f : 1.0f);
            if (walls[i] && gx == 0.0f && gy == 0.0f)
                n = (float3)(-rays[i].u[0], -rays[i].u[1], 0.0f);
            const long place = 3 * (long)(start + i);
            vstore3(normalize(n), 0, normals + place);
        }
        waiting &= ~same;
    }
    for (int i = 0; i < LANES; i++)
        if (start + i < first + count) {
            depth[start + i] = found[i];
            steps[start + i] = taken[i];
        }
}
