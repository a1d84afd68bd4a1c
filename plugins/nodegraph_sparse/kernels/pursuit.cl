// The rounds of a pursuit for signals of which the products with the atoms are known; see pursuit_host.py for the
// notation.  A work group follows one signal at a time: GROUP work items of LANES
// (8 or 1) atoms each.
//
// ALGORITHM is OLS, OMP or MP; NONNEGATIVE and WEIGHTED are 0 or 1.  Row i of the basis holds <d, u_i> for all atoms d,
// so that at the chosen atoms it is the Cholesky factor of their products.

#pragma OPENCL EXTENSION cl_khr_fp64 : enable

#define OLS 0
#define OMP 1
#define MP 2

// Vectors that need the alignment of an element.  PoCL calls a function for each vload8, vstore8 and select, at several
// times the cost.
#if LANES == 8
typedef double8 Reals;
typedef long8 Flags;
typedef double8 LooseReals __attribute__((aligned(8)));
typedef long8 LooseFlags __attribute__((aligned(8)));
#else
typedef double Reals, LooseReals;
typedef long Flags, LooseFlags;
#endif
#define LOAD(at) (*(__global const LooseReals *)(at))
#define STORE(value, at) (*(__global LooseReals *)(at) = (value))

#if GROUP == 1
#define MEET
#else
#define MEET barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE)
#endif

// What a work item has seen: the greatest gain as a fraction, since a comparison of fractions needs no division.
typedef struct {
    Reals over, under;
    Flags atom;
} Best;

// The state of one signal.
typedef struct {
    __global const double *first, *gram, *lengths;
    __global double *products, *apart, *wanted, *basis, *y, *x, *aim;
    __global int *chosen;
    int atoms, stride, size;
    double left, floor;
} Signal;

static Best nothing(void)
{
    Best best;
    best.over = (Reals)(0.0);
    best.under = (Reals)(1.0);
    best.atom = (Flags)(-1);
    return best;
}

static void consider(Best *best, const Signal *s, int at, Reals product, Reals apart)
{
    Reals over = product * product;
    Flags better = (over > s->floor) & (apart > DEPENDENT);
#if NONNEGATIVE
    better &= product > 0.0;
#endif
#if WEIGHTED
    over *= LOAD(s->wanted + at);
#endif
#if ALGORITHM == OLS
    better &= over * best->under > best->over * apart;
    best->under = better ? apart : best->under;
#else
    better &= over > best->over;
#endif
    best->over = better ? over : best->over;
    best->atom = better ? (Flags)(at) : best->atom;
}

// Return the first atom of the greatest gain that any lane of any work item has seen, -1 for none.
static int first_best(const Best *best, __local double *gains, __local int *atoms)
{
    double gain_of[LANES];
    long at[LANES];
    *(LooseReals *)gain_of = best->over / best->under;
    *(LooseFlags *)at = best->atom;
    double gain = 0.0;
    int atom = -1;
    for (int lane = 0; lane < LANES; ++lane) {
        const int number = (int)at[lane] + lane;
        if (gain_of[lane] > gain || (gain_of[lane] == gain && gain > 0.0 && number < atom)) {
            gain = gain_of[lane];
            atom = number;
        }
    }
#if GROUP > 1
    const int item = get_local_id(0);
    gains[item] = gain;
    atoms[item] = atom;
    for (int step = GROUP / 2; step > 0; step /= 2) {
        MEET;
        if (item < step) {
            const int other = item + step;
            if (gains[other] > gains[item] || (gains[other] == gains[item] && (uint)atoms[other] < (uint)atoms[item])) {
                gains[item] = gains[other];
                atoms[item] = atoms[other];
            }
        }
    }
    MEET;
    atom = atoms[0];
    MEET;
#endif
    return atom;
}

// Start, or start again, with no atom chosen.
static Best restart(Signal *s, double square)
{
    Best best = nothing();
    s->size = 0;
    s->left = square;
    for (int at = get_local_id(0) * LANES; at < s->atoms; at += GROUP * LANES) {
        const Reals product = LOAD(s->first + at);
        const Reals apart = LOAD(s->lengths + at);
        STORE(product, s->products + at);
        STORE(apart, s->apart + at);
        consider(&best, s, at, product, apart);
    }
    MEET;
    return best;
}

// Add an atom to the basis, take away the projection of the signal, and see what atom would be best then.
static Best append(Signal *s, int atom)
{
    Best best = nothing();
    const int size = s->size;
    const double distance = sqrt(s->apart[atom]), scale = 1.0 / distance, y = s->products[atom] * scale;
    __global const double *row = s->gram + (size_t)atom * s->atoms;
    __global double *made = s->basis + (size_t)size * s->stride;
    MEET;
    for (int at = get_local_id(0) * LANES; at < s->atoms; at += GROUP * LANES) {
        Reals q = LOAD(row + at);
        __global const double *basis = s->basis + at;
        for (int i = 0; i < size; ++i, basis += s->stride)
            q -= s->basis[(size_t)i * s->stride + atom] * LOAD(basis);
        q *= scale;
        STORE(q, made + at);
        const Reals product = LOAD(s->products + at) - y * q;
        const Reals apart = LOAD(s->apart + at) - q * q;
        STORE(product, s->products + at);
        STORE(apart, s->apart + at);
        consider(&best, s, at, product, apart);
    }
    MEET;
    if (get_local_id(0) == 0) {
        // An atom is never chosen again while it is there; its distance is kept where its row has it.
        s->chosen[size] = atom;
        s->apart[atom] = 0.0;
        made[atom] = distance;
        s->y[size] = y;
    }
    s->left -= y * y;
    s->size = size + 1;
    MEET;
    return best;
}

// Find the coefficients by back substitution.
static void solve(const Signal *s, __global double *out)
{
    if (get_local_id(0) == 0)
        for (int i = s->size - 1; i >= 0; --i) {
            __global const double *row = s->basis + (size_t)i * s->stride;
            double left = s->y[i];
            for (int j = i + 1; j < s->size; ++j)
                left -= out[j] * row[s->chosen[j]];
            out[i] = left / row[s->chosen[i]];
        }
    MEET;
}

#if NONNEGATIVE
// The inner loop of Lawson and Hanson: go towards the least squares until a coefficient falls to zero, give up its atom,
// and fit the others anew.
static Best make_nonnegative(Signal *s, Best best, double square)
{
    if (get_local_id(0) == 0)
        s->x[s->size - 1] = 0.0;
    for (;;) {
        solve(s, s->aim);
        double first = INFINITY;
        for (int i = 0; i < s->size; ++i)
            if (s->aim[i] <= 0.0)
                first = min(first, s->x[i] / (s->x[i] - s->aim[i]));
        MEET;
        int kept = 0;
        const int size = s->size;
        if (first == INFINITY) {
            for (int i = get_local_id(0); i < size; i += GROUP)
                s->x[i] = s->aim[i];
            MEET;
            return best;
        }
        for (int i = 0; i < size; ++i) {
            const double x = s->x[i], aim = s->aim[i];
            const int atom = s->chosen[i], stays = aim > 0.0 || x / (x - aim) > first;
            MEET;
            if (get_local_id(0) == 0 && stays) {
                s->x[kept] = x + first * (aim - x);
                s->chosen[kept] = atom;
            }
            kept += stays;
        }
        MEET;
        best = restart(s, square);
        for (int i = 0; i < kept; ++i)
            best = append(s, s->chosen[i]);
    }
}
#endif

#if ALGORITHM == MP
static Best subtract(Signal *s, int atom)
{
    Best best = nothing();
    const double step = s->products[atom];
    __global const double *row = s->gram + (size_t)atom * s->atoms;
    int slot = 0;
    while (slot < s->size && s->chosen[slot] != atom)
        ++slot;
    MEET;
    for (int at = get_local_id(0) * LANES; at < s->atoms; at += GROUP * LANES) {
        const Reals product = LOAD(s->products + at) - step * LOAD(row + at);
        STORE(product, s->products + at);
        consider(&best, s, at, product, LOAD(s->apart + at));
    }
    if (get_local_id(0) == 0) {
        s->chosen[slot] = atom;
        s->x[slot] = step + (slot < s->size ? s->x[slot] : 0.0);
    }
    s->size = max(s->size, slot + 1);
    s->left -= step * step;
    MEET;
    return best;
}
#endif

// Choose atoms and find coefficients.  Work groups share the signals; each has `scratch` of its own.
__kernel void pursue(
    __global const double *correlations,
    __global const double *gram,
    __global const double *lengths,
    __global const double *squares,
    __global const double *tolerances,
    __global const double *weights,
    __global const int *sources,
    const int signals,
    const int atoms,
    const int sparsity,
    const int rounds,
    const int kinds,
    const int stride,
    const ulong room,
    __global double *scratch,
    __global int *indices,
    __global double *coefficients)
{
    __local double gains[GROUP];
    __local int numbers[GROUP];
    Signal s;
    s.gram = gram;
    s.lengths = lengths;
    s.atoms = atoms;
    s.stride = stride;
    s.products = scratch + get_group_id(0) * room;
    s.apart = s.products + stride;
    s.wanted = s.apart + stride;
    s.aim = s.wanted + stride;
    s.y = s.aim + sparsity;
    s.basis = s.y + sparsity;
    for (int signal = get_group_id(0); signal < signals; signal += get_num_groups(0)) {
        const double square = squares[signal], tolerance = tolerances[signal];
        s.first = correlations + (size_t)signal * atoms;
        s.chosen = indices + (size_t)signal * sparsity;
        s.x = coefficients + (size_t)signal * sparsity;
        s.floor = NOISE * NOISE * square;
#if WEIGHTED
        for (int at = get_local_id(0); at < atoms; at += GROUP)
            s.wanted[at] = weights[(size_t)signal * kinds + sources[at]];
        MEET;
#endif
        Best best = restart(&s, square);
        for (int round = 0; round < rounds; ++round) {
            if (s.left <= tolerance)
                break;
#if ALGORITHM != MP
            if (s.size == sparsity)
                break;
#endif
            const int atom = first_best(&best, gains, numbers);
            if (atom < 0)
                break;
#if ALGORITHM == MP
            best = subtract(&s, atom);
#else
            best = append(&s, atom);
#if NONNEGATIVE
            best = make_nonnegative(&s, best, square);
#endif
#endif
        }
#if ALGORITHM != MP && !NONNEGATIVE
        solve(&s, s.x);
#endif
        for (int i = s.size + get_local_id(0); i < sparsity; i += GROUP) {
            s.chosen[i] = -1;
            s.x[i] = 0.0;
        }
        MEET;
    }
}

// Return the squared norm of what the sums of atoms leave of the signals: a work item for each.
__kernel void leave(
    __global const double *vectors,
    __global const double *dictionary,
    __global const int *indices,
    __global const double *coefficients,
    const int length,
    const int sparsity,
    __global double *squares)
{
    const size_t signal = get_global_id(0);
    __global const double *x = vectors + signal * length, *amount = coefficients + signal * sparsity;
    __global const int *chosen = indices + signal * sparsity;
    int used = 0;
    while (used < sparsity && chosen[used] >= 0)
        ++used;
    Reals sum = (Reals)(0.0);
    int at = 0;
    for (; at + LANES <= length; at += LANES) {
        Reals rest = LOAD(x + at);
        for (int i = 0; i < used; ++i)
            rest -= amount[i] * LOAD(dictionary + (size_t)chosen[i] * length + at);
        sum += rest * rest;
    }
    double parts[LANES];
    *(LooseReals *)parts = sum;
    double square = 0.0;
    for (int lane = 0; lane < LANES; ++lane)
        square += parts[lane];
    for (; at < length; ++at) {
        double rest = x[at];
        for (int i = 0; i < used; ++i)
            rest -= amount[i] * dictionary[(size_t)chosen[i] * length + at];
        square += rest * rest;
    }
    squares[signal] = square;
}
