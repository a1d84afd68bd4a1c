// Several rays at a time in the lanes of vectors, as CPUs like it, or one ray, as GPUs do, from one source.
//
// F and I are LANES floats and ints.  A comparison gives a mask: lanes of -1 and 0, or, of a single ray, 1 and 0.  So
// masks are joined by &, | and !, and used by ?: and any_lane alone, with both alternatives of type F or I.

#ifndef NODEGRAPH_RENDER_LANES_H
#define NODEGRAPH_RENDER_LANES_H

#if LANES == 1

typedef float F;
typedef int I;
#define TO_F convert_float
#define TO_I convert_int
#define RAMP 0
#define GATHER(type, from, at) (from)[at]
#define SCATTER(to, at, values) (to)[at] = values;

#elif LANES == 8

typedef float8 F;
typedef int8 I;
#define TO_F convert_float8
#define TO_I convert_int8
#define RAMP (int8)(0, 1, 2, 3, 4, 5, 6, 7)
#define EIGHT(from, at) (from)[(at).s0], (from)[(at).s1], (from)[(at).s2], (from)[(at).s3], \
                        (from)[(at).s4], (from)[(at).s5], (from)[(at).s6], (from)[(at).s7]
#define GATHER(type, from, at) (type)(EIGHT(from, at))

#elif LANES == 16

typedef float16 F;
typedef int16 I;
#define TO_F convert_float16
#define TO_I convert_int16
#define RAMP (int16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#define SIXTEEN(from, at) (from)[(at).s0], (from)[(at).s1], (from)[(at).s2], (from)[(at).s3], \
                          (from)[(at).s4], (from)[(at).s5], (from)[(at).s6], (from)[(at).s7], \
                          (from)[(at).s8], (from)[(at).s9], (from)[(at).sa], (from)[(at).sb], \
                          (from)[(at).sc], (from)[(at).sd], (from)[(at).se], (from)[(at).sf]
#define GATHER(type, from, at) (type)(SIXTEEN(from, at))

#endif

#if LANES > 1
#define PUT(to, at, values, k) (to)[(at).s##k] = (values).s##k;
#define PUT8(to, at, values)                                                                        \
    PUT(to, at, values, 0) PUT(to, at, values, 1) PUT(to, at, values, 2) PUT(to, at, values, 3)     \
    PUT(to, at, values, 4) PUT(to, at, values, 5) PUT(to, at, values, 6) PUT(to, at, values, 7)
#if LANES == 8
#define SCATTER(to, at, values) PUT8(to, at, values)
#else
#define SCATTER(to, at, values)                                                                     \
    PUT8(to, at, values)                                                                            \
    PUT(to, at, values, 8) PUT(to, at, values, 9) PUT(to, at, values, a) PUT(to, at, values, b)     \
    PUT(to, at, values, c) PUT(to, at, values, d) PUT(to, at, values, e) PUT(to, at, values, f)
#endif
#endif

// Whether a mask has a lane.
static inline int any_lane(I mask)
{
#if LANES == 1
    return mask;
#else
#if LANES == 16
    const int8 eight = mask.lo | mask.hi;
#else
    const int8 eight = mask;
#endif
    const int4 four = eight.lo | eight.hi;
    const int2 two = four.lo | four.hi;
    return two.x | two.y;
#endif
}

// Some compilers call a function for each of fmin, fmax and clamp of vectors; these are single instructions.
static inline F least(F a, F b)
{
    return a < b ? a : b;
}

static inline F greatest(F a, F b)
{
    return a > b ? a : b;
}

static inline I between(I value, I low, I high)
{
    value = value > low ? value : low;
    return value < high ? value : high;
}

#endif
