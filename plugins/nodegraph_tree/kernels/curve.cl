// Curves: circular arcs with cross-sections.  skeleton.py and curve.py say what is computed here and why.

#include "relief.h"
#include "tree.h"

#define CURVE_ARC 18
#define CURVE_WINDOW 1.0f

// An arc of a curve seen from eight samples.
typedef struct {
    float8 distance, along, side;
} Seen;

// atan(sqrt(y)) / sqrt(y) for 0 <= y <= 0.18, to 1e-7
static inline float8 curve_arctangent(float8 y)
{
    return 1.0f + y * (-0.33333333f + y * (0.2f + y * (-0.14285714f + y * (0.11111111f + y * (-0.090909091f
           + y * (0.076923077f + y * (-0.066666667f + y * 0.058823529f)))))));
}

// A length along the arc that slows down beyond its ends.
static inline float8 curve_soft(float8 s, float length, float soft)
{
    const float8 extra = fmax(fabs(s) - length, 0.0f);
    return clamp(s, -length, length) + copysign(extra * (1.0f - extra * soft), s);
}

// q = {middle east, north, tangent, curvature, half, beyond, length, soft, fold, height's cubic, place, its slope,
//      what float32 has lost of the middle}: a sample is near an arc, so that the difference keeps its digits.
static inline Seen curve_project(const State *s, P q)
{
    const float8 x = (s->x - q[0]) - q[16], y = (s->y - q[1]) - q[17];
    const float8 a = q[2] * x + q[3] * y, b = q[2] * y - q[3] * x;
    const float k = q[4], half_ = q[5], beyond = q[6];
    Seen found;
    if (k == 0.0f) {
        // Straight: half and beyond are half the lengths.
        const float8 m = clamp(a, -2.0f * half_, 2.0f * half_), e = a - m;
        found.distance = sqrt(e * e + b * b);
        found.along = curve_soft(clamp(a, -2.0f * beyond, 2.0f * beyond), q[7], q[8]);
        found.side = b / fmax(found.distance, 1e-30f);
        return found;
    }
    const float8 u = 1.0f - k * b, w = k * a, far = sqrt(u * u + w * w), size = fabs(a);
    const float8 q_ = fmax(far + fabs(u), 1e-30f);
    const int8 behind = u < 0.0f, over = behind | (size > half_ * q_), past = behind | (size > beyond * q_);
    const float8 inside = a / q_;
    const float8 m = over ? copysign((float8)(half_), a) : inside;
    float8 inner;
    if (q[9] > 0.0f) {
        const float8 top = behind ? beyond * k * beyond * w : beyond * beyond * q_;
        const float8 bottom = behind ? q_ : copysign(fmax(size, 1e-30f), a);
        inner = past ? top / bottom : inside;
    } else {
        inner = past ? copysign((float8)(beyond), a) : inside;
    }
    const float8 h = k * m, one = 1.0f / (1.0f + h * h), g = 2.0f * m * one;
    const float8 ea = a - g, eb = b - g * h, angle = k * inner;
    found.distance = sqrt(ea * ea + eb * eb);
    found.along = curve_soft(2.0f * inner * curve_arctangent(angle * angle), q[7], q[8]) * fmin(4.0f * far, 1.0f);
    found.side = ((1.0f - h * h) * eb - 2.0f * h * ea) * one / fmax(found.distance, 1e-30f);
    return found;
}

// A cross-section of n pieces {begin, height, slope, bend} at distances x.
static inline float8 curve_section(P piece, int n, float8 x)
{
    float8 c = piece[1] + x * (piece[2] + x * piece[3]);
    for (int i = 1; i < n; i++) {
        piece += 4;
        const float8 u = x - piece[0];
        c = u >= 0.0f ? piece[1] + u * (piece[2] + u * piece[3]) : c;
    }
    return c;
}

// p = {L of heights, L of places, 2 radius, arcs..., sections...}
// n = {arcs, first section, sections, pieces left, pieces right (0: symmetric), fall-off}
static void tree_curve(State *s, P p, N n, D data)
{
    const int arcs = n[0], sections = n[2], left = n[3], right = n[4];
    const float lift = p[0], place_lift = p[1], reach = p[2];
    float8 d = INFINITY, low = INFINITY, high = -INFINITY, least = INFINITY, most = -INFINITY;
    P q = p + 3;
    for (int i = 0; i < arcs; i++, q += CURVE_ARC) {
        const Seen it = curve_project(s, q);
        d = fmin(d, it.distance);
        const int8 reached = it.distance < reach;
        const float8 t = clamp(it.along, -q[7], q[7]);
        const float8 z = q[10] + t * (q[11] + t * (q[12] + t * q[13]))
                         + (it.along - t) * (q[11] + t * (2.0f * q[12] + 3.0f * q[13] * t));
        const float8 raised = lift * it.distance;
        low = reached ? fmin(low, z + raised) : low;
        high = reached ? fmax(high, z - raised) : high;
        if (sections > 1) {
            const float8 place = q[14] + q[15] * it.along, up = place_lift * it.distance;
            least = reached ? fmin(least, place + up) : least;
            most = reached ? fmax(most, place - up) : most;
        }
    }
    if (all(d >= 0.5f * reach)) {
        push(s, 0.0f, 0.0f);
        return;
    }
    float8 side = 0.0f;
    if (right) {
        const float8 window = 1.0f / fmax(CURVE_WINDOW * d, 1e-30f);
        float8 one = 0.0f, other = 0.0f;
        q = p + 3;
        for (int i = 0; i < arcs; i++, q += CURVE_ARC) {
            const Seen it = curve_project(s, q);
            const float8 fade = clamp(1.0f - (it.distance - d) * window, 0.0f, 1.0f) * it.side;
            one = fmax(one, fade);
            other = fmax(other, -fade);
        }
        side = clamp(2.0f * (one - other), -1.0f, 1.0f);
    }
    q = p + 3 + arcs * CURVE_ARC;
    const float8 place = sections > 1 ? 0.5f * (least + most) - n[1] : (float8)(0.0f);
    float8 c = 0.0f, radius = 0.0f, core = 0.0f;
    for (int i = 0; i < sections; i++) {
        // Hats over the sections; before the first and after the last one they stay.
        float8 share = 1.0f;
        if (i > 0)
            share = clamp(place - (i - 1), 0.0f, 1.0f);
        if (i < sections - 1)
            share = fmin(share, clamp(i + 1 - place, 0.0f, 1.0f));
        radius += share * q[0];
        core += share * q[1];
        q += 2;
        float8 here = curve_section(q, left, d);
        q += 4 * left;
        if (right) {
            here = 0.5f * ((1.0f + side) * here + (1.0f - side) * curve_section(q, right, d));
            q += 4 * right;
        }
        c += share * here;
    }
    const float8 t = fmax(d - core, 0.0f) / (radius - core);
    const float8 a = fall_off(n[5], t);
    push(s, a > 0.0f ? 0.5f * (low + high) + c : (float8)(0.0f), a);
}

// Roughness on top of what was pushed last; p = {amplitude}, n = {noise's table, origins...}
static void tree_curve_rough(State *s, P p, N n, D data)
{
    if (!any(s->a[s->top] > 0.0f))
        return;
    s->f[s->top] += s->a[s->top] > 0.0f ? p[0] * tree_relief(s, data, n[0], n + 1) : (float8)(0.0f);
}
