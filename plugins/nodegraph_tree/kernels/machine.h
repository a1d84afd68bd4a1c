// The stack machine: runs the program of a tile.  Include it after all instructions, with CASES as `Programs.compiled`
// defines it.

#ifndef NODEGRAPH_TREE_MACHINE_H
#define NODEGRAPH_TREE_MACHINE_H

#include "tree.h"

#define CASE(number, name)                                                  \
    case number:                                                            \
        name(s, floats + step.y, ints + step.z, data);                      \
        break;

// Leave height and weight of eight samples in s->f[0] and s->a[0]; s->x, s->y, s->detail and s->block are theirs.
// An instruction that concerns other blocks of the tile is skipped: its samples would not change.
static inline void run_program(
    State *s, const int tile, __global const int4 *restrict code, __global const int *restrict starts,
    P floats, N ints, D data)
{
    s->top = -1;
    s->frame = 0;
    const int end = starts[tile + 1];
    for (int at = starts[tile]; at < end; at++) {
        const int4 step = code[at];
        if (!(step.w & s->block))
            continue;
        switch (step.x) {
            CASES
        }
    }
}

#endif
