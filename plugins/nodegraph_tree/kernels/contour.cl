// Contours: radial cross-sections about a centre.  contour.py says what is computed here.

#include "tree.h"

// A radial section of n pieces {begin, height, slope, bend} at u.
static inline float8 contour_section(P piece, int n, float8 u)
{
    float8 c = piece[1] + u * (piece[2] + u * piece[3]);
    for (int i = 1; i < n; i++) {
        piece += 4;
        const float8 t = u - piece[0];
        c = t >= 0.0f ? piece[1] + t * (piece[2] + t * piece[3]) : c;
    }
    return c;
}

// p = {centre east, north, cosine, sine of the direction, height, core, 1 / (reach - core), outline..., sectors...}
// n = {pieces of the outline, sectors, pieces of a section, fall-off}
static void tree_contour(State *s, P p, N n, D data)
{
    const float8 x = s->x - p[0], y = s->y - p[1];
    float8 theta = atan2(p[2] * y - p[3] * x, p[2] * x + p[3] * y);
    theta = theta < 0.0f ? theta + 6.2831853f : theta;
    P q = p + 7;
    float8 rho = 1.0f;
    for (int i = 0; i < n[0]; i++, q += 5) {
        const float8 t = theta - q[0];
        const float8 here = q[1] + t * (q[2] + t * (q[3] + t * q[4]));
        rho = i == 0 || t >= 0.0f ? here : rho;
    }
    const float8 u = sqrt(x * x + y * y) / rho;
    const float8 a = fall_off(n[3], fmax(u - p[5], 0.0f) * p[6]);
    float8 c = 0.0f;
    for (int i = 0; i < n[1]; i++, q += 2 + 8 * n[2]) {
        const float8 t = clamp((theta - q[0]) * q[1], 0.0f, 1.0f);
        const float8 first = contour_section(q + 2, n[2], u), last = contour_section(q + 2 + 4 * n[2], n[2], u);
        const float8 here = first + t * t * (3.0f - 2.0f * t) * (last - first);
        c = i == 0 || theta >= q[0] ? here : c;
    }
    push(s, a > 0.0f ? p[4] + c : (float8)(0.0f), a);
}
