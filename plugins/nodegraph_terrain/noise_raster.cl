// Noise at the centres of cells.  A work item makes eight cells of a row.

#include "noise.h"
#include "vectors.h"

// Tiles are 2^tile cells wide and high; `origins` holds what the cell in the middle of each is on the lattices, for the
// tiles of the rows from first_row on.  `width` and `height` are those of a cell in metres.
__kernel void noise_cells(__global const uint *words, __global const uint *origins, int tile, int rows, int cols,
                          int first_row, int last_row, float width, float height, int filtered, float kappa,
                          float amplitude, float offset, __global float *out)
{
    const int x = get_global_id(0) * 8, y = first_row + get_global_id(1);
    if (x >= cols || y >= last_row)
        return;
    const int side = 1 << tile, middle = side >> 1;
    const int across = (cols + side - 1) >> tile;
    const size_t index = (size_t)((y - first_row) >> tile) * across + (x >> tile);
    __global const NoiseSum *sum = noise_at(words, 0);
    __global const NoiseOrigin *origin = noise_origin(origins, index * noise_lattices(sum));
    const float8 lanes = (float8)(0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f);
    const float8 east = (lanes + (float)((x & (side - 1)) - middle)) * width;
    const float8 north = (float)(middle - (y & (side - 1))) * height;
    const float8 value =
        filtered ? noise_value_lod(sum, origin, east, north, (float8)kappa) : noise_value(sum, origin, east, north);
    store8(amplitude * value + offset, out + (size_t)y * cols, x, cols);
}
