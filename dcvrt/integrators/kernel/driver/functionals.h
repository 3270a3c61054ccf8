/* Functionals of one finished run: extrema, sustained extrema, times, integrals, with exact gradients.
 *
 * The run leaves a track: nodes with exact values and rates, between which the cubic through two neighbours
 * stays close to the solution. What a functional needs is looked for on these cubics, then polished on the
 * solution itself through `evaluate`. The Python side, dcvrt/functionals.py, says what each kind means.
 */
#ifndef DCVRT_FUNCTIONALS_H
#define DCVRT_FUNCTIONALS_H

/* The larger and the smaller of two numbers in one instruction each, which fmax and fmin with their rule for NaN
 * are not; with a NaN it is the second. */
static inline double higher(double a, double b) { return a > b ? a : b; }
static inline double lower(double a, double b) { return a < b ? a : b; }

/* What stands at a node of a track, and what makes a result active. */
enum place {
    PLACE_INSIDE = 0, /* node: nothing special; result: an extremum of the solution */
    PLACE_EVENT = 1,  /* a jump of an automaton (also if the inputs jump at the same instant) */
    PLACE_JUMP = 2,   /* a jump of the inputs alone */
    PLACE_END = 3,    /* first or last node of the run, unless it is one of the two above */
    PLACE_WINDOW = 4, /* result only: the stretch lasts exactly the window; `time` is its begin */
    PLACE_NONE = 5    /* result only: no single place (a time, an integral); `time` is NaN */
};

struct track {
    long n;                    /* nodes */
    int ny;                    /* watched outputs */
    int nw;                    /* thetas; all derivatives by theta are times its scale */
    const double *t;           /* [n], ascending; twice at a break: values before it, values after it */
    const double *y;           /* [n * ny], y[k * ny + j] */
    const double *rate;        /* [n * ny], dy/dt along the solution, one-sided at a break */
    const long *step;          /* [n], the step whose dense output holds between nodes k and k + 1; at the
                                * left of a break and at the last node, the step that ends there */
    const unsigned char *kind; /* [n], enum place; both nodes of a break carry its kind */
    const long *brk;           /* [n], number of the break at which the node stands, or -1 */
    const double *dbreak;      /* [breaks * nw], derivative of a break's time by theta (0 at input jumps) */
    /* Solution at time t, which lies in the step or at one of its ends: y[ny] and rate[ny]; unless y_theta is
     * null, y_theta[ny * nw] and rate_theta[ny * nw] (output-major), derivatives at fixed time. 0 if it
     * could be done. Calls come in turns on two steps at most, and once over the nodes (t = t[k],
     * step = step[k]) for integrals: keep the last two steps' stages, and need none at the ends of a step. */
    int (*evaluate)(void *context, long step, double t, double *y, double *rate, double *y_theta,
                    double *rate_theta);
    void *context;
};

enum functional_kind {
    FUNCTIONAL_INITIAL = 0,           /* first value */
    FUNCTIONAL_MINIMUM = 1,
    FUNCTIONAL_MAXIMUM = 2,
    FUNCTIONAL_SUSTAINED_MINIMUM = 3, /* min over s of max over [s, s + window] */
    FUNCTIONAL_SUSTAINED_MAXIMUM = 4, /* max over s of min over [s, s + window] */
    FUNCTIONAL_TIME_BELOW = 5,        /* total time with signal < level */
    FUNCTIONAL_TIME_ABOVE = 6,
    FUNCTIONAL_INTEGRAL = 7,
    FUNCTIONAL_POSITIVE_INTEGRAL = 8, /* of max(signal, 0) */
    FUNCTIONAL_RECOVERY_TIME = 9      /* from the first fall below the level to the last return */
};

struct functional {
    int kind;        /* enum functional_kind */
    int signal;      /* watched output */
    int per;         /* watched output that divides the signal, or -1 */
    int relative;    /* whether the level is a share of the signal's first value */
    int value_only;  /* whether the gradient is not wanted (it is NaN then) */
    double constant; /* window, s (0: the plain extremum), or level */
};

/* Results, functional by functional; gradient[count * nw], functional-major. */
struct functional_results {
    double *value, *time, *gradient;
    unsigned char *place, *tie;
};

/* Memory that is kept from run to run, one for each thread; start it as {0}. */
struct workspace {
    unsigned long size;
    void *memory;
};

enum { FUNCTIONALS_DONE = 0, FUNCTIONALS_NO_MEMORY = 1, FUNCTIONALS_NOT_EVALUATED = 2 };

/* Compute `count` functionals of a track. Neighbours in `what` on the same signal and sense share work.
 * A window longer than the run, and a signal that is not finite, give NaN: the caller refuses the first
 * beforehand. Not to be compiled with -ffinite-math-only.
 * Returns FUNCTIONALS_DONE, or what went wrong (then the results are not to be used). */
int functionals_of(const struct track *track, const struct functional *what, int count,
                   struct workspace *workspace, struct functional_results *results);

void workspace_free(struct workspace *workspace);

#endif
