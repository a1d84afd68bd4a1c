// Relaxation of a raster towards the conductance-weighted mean of the four neighbours; cells that are not free stay.
//
// UNIFORM: one conductance along each axis.  Otherwise `across` (rows, cols - 1) and `down` (rows - 1, cols) hold them.

// How far the mean of the neighbours lies above the cell.
inline float rise(__global const float *x, __global const float *across, __global const float *down, float across_all,
                  float down_all, int rows, int cols, int col, int row)
{
    const size_t i = (size_t)row * cols + col, side = i - row;
    // Beyond the edge lies the cell itself, without conductance.
    const int w = col > 0, e = col + 1 < cols, n = row > 0, s = row + 1 < rows;
#ifdef UNIFORM
    const float kw = w ? across_all : 0.0f, ke = e ? across_all : 0.0f;
    const float kn = n ? down_all : 0.0f, ks = s ? down_all : 0.0f;
#else
    const float kw = w ? across[side - 1] : 0.0f, ke = e ? across[side] : 0.0f;
    const float kn = n ? down[i - cols] : 0.0f, ks = s ? down[i] : 0.0f;
#endif
    const float c = x[i], sum = (kw + ke) + (kn + ks);
    const float flow = (kw * (x[i - w] - c) + ke * (x[i + e] - c)) + (kn * (x[i - n * cols] - c) + ks * (x[i + s * cols] - c));
    return sum > 0.0f ? flow / sum : 0.0f;
}

#define RISE(x) rise(x, across, down, across_all, down_all, rows, cols, col, row)

__kernel void jacobi(__global const float *x, __global const uchar *free, __global const float *across,
                     __global const float *down, float across_all, float down_all, int rows, int cols,
                     __global float *out)
{
    const int col = get_global_id(0), row = get_global_id(1);
    if (col >= cols || row >= rows)
        return;
    const size_t i = (size_t)row * cols + col;
    out[i] = x[i] + (free[i] ? RISE(x) : 0.0f);
}

// One colour of the chessboard, in place: its cells are neighbours of the other colour only.
__kernel void sor(__global float *x, __global const uchar *free, __global const float *across,
                  __global const float *down, float across_all, float down_all, int rows, int cols, int colour,
                  float relaxation)
{
    const int row = get_global_id(1), col = 2 * get_global_id(0) + ((row + colour) & 1);
    if (col >= cols || row >= rows)
        return;
    const size_t i = (size_t)row * cols + col;
    if (free[i])
        x[i] += relaxation * RISE(x);
}
