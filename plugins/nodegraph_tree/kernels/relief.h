// Noise in the frame at hand, for all that has a relief.

#ifndef NODEGRAPH_TREE_RELIEF_H
#define NODEGRAPH_TREE_RELIEF_H

#include "noise.h"
#include "tree.h"

// The noise whose table starts at data[table], with the places of the tile's origin on its lattices; octaves above the
// level of detail fade out.
static inline float8 tree_relief(const State *s, D data, int table, N origins)
{
    __global const NoiseSum *sum = noise_at((__global const uint *)data, table);
    __global const NoiseOrigin *origin = noise_origin((__global const uint *)origins, 0);
    return any(s->detail < 1.0f) ? noise_value_lod(sum, origin, s->x, s->y, s->detail)
                                 : noise_value(sum, origin, s->x, s->y);
}

#endif
