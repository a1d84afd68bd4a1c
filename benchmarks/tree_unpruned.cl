// A disc as tree_disc_rough, but with its noise computed for all samples: what pruning spares.

#include "relief.h"
#include "tree.h"

static void tree_disc_eager(State *s, P p, N n, D data)
{
    const float8 dx = s->x - p[0], dy = s->y - p[1];
    push(s, p[3] + p[4] * tree_relief(s, data, n[0], n + 2), fall_off(n[1], sqrt(dx * dx + dy * dy) * p[2]));
}
