// The sample furthest from the plane of each triangle: the same numbers, bit for bit, as triangle_scan.py gives.

#pragma OPENCL FP_CONTRACT OFF
#pragma OPENCL EXTENSION cl_khr_fp64 : enable

static inline long floor_div(long a, long b)
{
    const long q = a / b;
    return q - ((a % b != 0) && ((a < 0) != (b < 0)));
}

// A work item takes one triangle, with corners x, y (counter-clockwise lattice points).  `inclusive` says, per edge,
// whether samples on it count (null: all do); samples have at least the distance `least` (null: none), and there
// heights may be NaN.
__kernel void worst_samples(__global const float *heights, __global const float *least, int cols, int count,
                            __global const long *x, __global const long *y, __global const uchar *inclusive,
                            __global const long *stride, __global double *error, __global long *cell)
{
    const int t = get_global_id(0);
    if (t >= count)
        return;
    const long px[3] = {x[3 * t], x[3 * t + 1], x[3 * t + 2]}, py[3] = {y[3 * t], y[3 * t + 1], y[3 * t + 2]};
    const long step = stride ? stride[t] : 1;
    const double z0 = heights[py[0] * cols + px[0]];
    const double z1 = heights[py[1] * cols + px[1]] - z0, z2 = heights[py[2] * cols + px[2]] - z0;
    const long x1 = px[1] - px[0], x2 = px[2] - px[0], y1 = py[1] - py[0], y2 = py[2] - py[0];
    const double area = x1 * y2 - y1 * x2;
    const double east = (z1 * y2 - z2 * y1) / area, south = (z2 * x1 - z1 * x2) / area;
    const double slope = east * step;
    const long low = min(py[0], min(py[1], py[2])), high = max(py[0], max(py[1], py[2]));
    double worst = -1.0;
    long where = -1;
    for (long row = low; row <= high; ++row) {
        if ((row - py[0]) % step != 0)
            continue;
        long first = min(px[0], min(px[1], px[2])), last = max(px[0], max(px[1], px[2]));
        for (int k = 0; k < 3; ++k) {
            const long dx = px[(k + 1) % 3] - px[k], dy = py[(k + 1) % 3] - py[k];
            const long rest = dx * row + (dy * px[k] - dx * py[k] - (inclusive ? 1 - inclusive[3 * t + k] : 0));
            if (dy > 0)
                last = min(last, floor_div(rest, dy));
            else if (dy < 0)
                first = max(first, -floor_div(-rest, dy));
            else if (rest < 0)
                last = first - 1;
        }
        const double plane = z0 + east * (first - px[0]) + south * (row - py[0]);
        long along = 0;
        for (long column = first; column <= last; column += step, ++along) {
            const long at = row * cols + column;
            double distance = fabs(slope * along + plane - heights[at]);
            if (least)
                distance = fmax(distance, (double)least[at]);
            if (distance > worst) {
                worst = distance;
                where = at;
            }
        }
    }
    error[t] = worst;
    cell[t] = where;
}
