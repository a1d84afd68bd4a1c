// The stack machine's state, and what every instruction is.
//
// An instruction is a function  static void name(State *s, P p, N n, D data)  that reads the coordinates s->x, s->y (m, eight
// samples of a row, relative to the frame's origin) and the level of detail s->detail, and pushes or combines pairs of
// height and weight.  Its parameters are p[0], p[1], ... and n[0], n[1], ...; data holds the shared arrays.

#ifndef NODEGRAPH_TREE_H
#define NODEGRAPH_TREE_H

typedef __global const float *restrict P;
typedef __global const int *restrict N;
typedef __global const float *restrict D;

typedef struct {
    float8 x, y;                        // coordinates of the samples in the frame at hand
    float8 detail;                      // level of detail, 0 to 1
    float8 f[STACK], a[STACK];          // heights and weights; the top is at index `top`
    float8 xs[FRAMES], ys[FRAMES];      // coordinates of the frames around
    int top, frame;
    int column, row;                    // place of the first sample in its tile
    int block;                          // the block of the tile that holds the samples, as a bit; all bits: not known
} State;

static inline void push(State *s, float8 f, float8 a)
{
    s->top++;
    s->f[s->top] = f;
    s->a[s->top] = a;
}

static inline void enter(State *s, float8 x, float8 y)
{
    s->xs[s->frame] = s->x;
    s->ys[s->frame] = s->y;
    s->frame++;
    s->x = x;
    s->y = y;
}

static inline void leave(State *s)
{
    s->frame--;
    s->x = s->xs[s->frame];
    s->y = s->ys[s->frame];
}

// g(t), as falloff.py numbers it; t >= 0.
static inline float8 fall_off(int kind, float8 t)
{
    t = fmin(t, 1.0f);
    if (kind == 3) {
        t = fmax(2.0f * t - 1.0f, 0.0f);
        kind = 1;
    }
    // In factors: no digits cancel, and none is below 0.
    const float8 u = kind == 0 ? 1.0f - t * t : 1.0f - t;
    if (kind == 0)
        return u * u * u;
    if (kind == 1)
        return u * u * (1.0f + 2.0f * t);
    return u * u * u * (1.0f + t * (3.0f + 6.0f * t));
}

#endif
