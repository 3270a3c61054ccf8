/* What the parts of the driver share: a case to run, its state between steps, and what it leaves behind.
 *
 * A `course` is one case under way. The loop over lanes (loop.c) makes its steps; all that happens between
 * steps - timers, located events, jumps of the automata, input jumps, records - happens here, on doubles,
 * case by case, with the same code for one lane and for many.
 *
 * Vectors of states are flat: x, then dx/dtheta times the scale of theta for each theta. The sizes (NX, NW,
 * ROWS ...) come from the text of the model.
 */
#ifndef DCVRT_KERNEL_H
#define DCVRT_KERNEL_H

#include "functionals.h"

#include <stddef.h>

#define AT_LEAST_ONE(n) ((n) > 0 ? (n) : 1)
enum {
    N = NX * (1 + NW),            /* states and their sensitivities */
    NZN = NZ * (1 + NW),          /* algebraic variables and theirs */
    ALL = N + NZN,
    GUARDS = ROWS + BOUNDS,
    TANGENTS = DRIVEN ? 2 * NW : 0,
    PIECE = 2 + 4 * NU + 4 * TANGENTS, /* numbers of one piece of the inputs */
    DENSE = 5,                    /* coefficients of the dense output */
    EVENT = 2 + ROWS + NW         /* numbers of one event: time, row, ties, gradient */
};

/* Jumps closer than this, s, are at one instant; a guard is judged by its sign this long after it. */
#define SAME_INSTANT 1e-9
#define LOCATED 1e-12
#define WATCH_FLOOR 100.0 /* cubics may miss a watched output by so many absolute tolerances of the states */
#define ONE_CUBIC 0.1 /* inputs are one cubic if they are off it by so much of what cubics may miss of an output */
enum { MAX_JUMPS_AT_ONCE = 50, MAX_EVENTS = 10000 };

/* How a course ended; the sentence is made of these in Python. */
enum status {
    COMPLETED = 0,
    LEFT_BOUNDS = 1,       /* detail: number of the bound */
    CHATTER = 2,           /* more than MAX_JUMPS_AT_ONCE at one instant */
    TOO_MANY_EVENTS = 3,
    STEP_TOO_SMALL = 4,
    TOO_MANY_STEPS = 5,
    NOT_FINITE = 6,
    NOT_CONSISTENT = 7,    /* no algebraic variables fit */
    NO_MEMORY = 8,
    NO_EQUILIBRIUM = 9,
    UNDER_WAY = -1
};

/* What a step saw of the inputs: it may have missed a pulse; it has not; they are one cubic on it. */
enum seen { INPUTS_UNSEEN, INPUTS_SEEN, INPUTS_ONE_CUBIC };

/* The inputs of a case: pieces on which each is a cubic. A row holds start, 1/length, then for each power of
 * (t - start)/length the inputs, then likewise the tangents of the phasor: real parts of all thetas,
 * imaginary parts of all thetas. Sections are parted by jumps. */
struct inputs {
    long pieces, sections;
    const double *start;   /* [pieces + 1], the end last */
    const double *table;   /* [pieces * PIECE] */
    const long *section;   /* [sections + 1], first piece of each; `pieces` last */
};

struct task {
    const double *p, *x, *z; /* parameters; start values */
    const struct inputs *inputs;
};

struct options {
    double rtol, atol;             /* of the states */
    double theta_rtol, theta_share; /* of a sensitivity: theta_rtol (|S| + theta_share max|column of S|) */
    double save_at, longest, watch_tolerance;
    long max_steps;
    int samples; /* whether to keep samples of the states, at most save_at apart */
    int steps;   /* whether to keep the begin of every step, so that it can be evaluated again */
    int nodes;   /* whether to keep nodes of the watched outputs */
};

/* Dense output of one step: x(t + h r) = c0 + r (c1 + (1 - r) (c2 + r (c3 + (1 - r) c4))). */
struct dense {
    double t, h;
    double c[DENSE][ALL]; /* states with sensitivities, then algebraic variables with theirs */
};

struct phase {
    double t, entry[AT_LEAST_ONE(NA)], dentry[AT_LEAST_ONE(NW * NA)];
    int mode[AT_LEAST_ONE(NA)];
    long first_sample, first_node;
};

/* What a course leaves. Arrays grow; those of one record have the same length. */
struct record {
    long samples, steps, nodes, events, phases, breaks;
    long sample_room, output_room, step_room, node_room, event_room, phase_room, break_room;
    double *sample_t, *sample_x, *sample_z, *sample_y, *sample_rate; /* the last two by keep_samples */
    long *sample_piece, *sample_phase, *sample_step;
    double *step_t, *step_h, *step_x;
    long *step_piece, *step_phase;
    double *node_t, *node_y, *node_rate;
    long *node_step, *node_break;
    unsigned char *node_kind;
    double *event;
    struct phase *phase;
    double *dbreak;
    unsigned char *break_kind;
};

struct course {
    const struct task *task;
    const struct options *options;
    /* now */
    double t, x[N], z[AT_LEAST_ONE(NZN)];
    double rate[NX]; /* of the states now, where `rated` */
    int rated;
    long piece, section;
    double border, limit; /* end of the section; end of the next step at the latest */
    /* automata */
    int mode[AT_LEAST_ONE(NA)];
    double entry[AT_LEAST_ONE(NA)], dentry[AT_LEAST_ONE(NW * NA)];
    double held[AT_LEAST_ONE(ROWS)], dheld[AT_LEAST_ONE(ROWS * NW)];
    double armed[AT_LEAST_ONE(ROWS)], darmed[AT_LEAST_ONE(ROWS * NW)];
    double sign[AT_LEAST_ONE(GUARDS)]; /* +1: matters when it rises through 0; -1: when it falls; 0: not */
    int watches_input;                 /* a guard that matters reads the inputs themselves */
    /* values of the mode */
    double m[AT_LEAST_ONE(FIXED)];
    double mc[AT_LEAST_ONE(FIXED_COLUMNS * NW)]; /* theta after theta */
    /* jumps at the present instant */
    double instant;
    int jumps, visited[MAX_JUMPS_AT_ONCE + 1];
    /* the end */
    int status, detail;
    double failed_from, failed_to;
    long accepted, rejected;
    struct dense dense;
    struct again *again; /* makes steps of this course again */
    struct record record;
    double largest[AT_LEAST_ONE(WATCHED)]; /* of every watched output so far */
};

/* Cases to run one after the other, and where their results go. */
struct work {
    const struct task *task;
    const struct options *options;
    struct result *result;
    const struct functional *functional;
    long functionals;
    struct functional_results functional_results; /* of the first case; the others follow */
    long cases, next;
    struct workspace workspace;
    struct again *again;
};

/* What is left of a case in a batch. The event list is the caller's to free. */
struct result {
    int status, detail, mode[AT_LEAST_ONE(NA)];
    long accepted, rejected, events;
    double t, failed_from, failed_to, x[NX], rate[NX];
    int visited[MAX_JUMPS_AT_ONCE + 1];
    double *event;
};

/* What is a corner, and how it is resolved: the constants of corners.py. */
struct corners {
    double missed, sharper;
    int parts, levels;
};

/* course.c */
int course_begin(struct course *c, const struct task *task, const struct options *options);
int course_move(struct course *c, double t, const double *x, const double *z);
int course_cross(struct course *c, const double *h0, const double *r0, double t1, const double *h1,
                 const double *r1);
enum seen course_inputs(struct course *c, double t1);
int course_record(struct course *c, double t1, const double *x1, const double *z1);
void course_fail(struct course *c, enum status status, double from, double to);
void course_here(struct course *c, double *f, double *h, double *rate);
void course_flow(struct course *c, double t, const double *x, const double *z, double *f);

void course_fixed(const double *p, const int *mode, const double *dentry, double *m, double *mc);

/* record.c */
double *record_step(struct course *c, double h);
void record_free(struct record *r);

/* nodes.c */
int nodes_to(struct course *c, double t1, const double *y1, const double *r1, int refine);

/* again.c */
struct again *again_new(const struct options *options);
void again_free(struct again *a);
void step_again(struct course *c, double h);

/* outputs.c */
int outputs_on(const struct task *task, const struct phase *phases, long n, const double *t, const double *x,
               const double *z, const long *piece, const long *phase, double *y, double *rate, double *y_theta,
               double *rate_theta);

/* single.c */
void work_done(struct work *w, long number, struct course *c);

/* loop.c, once for one lane and once for many */
int run_one_lane(struct work *w);
int run_many_lanes(struct work *w);

/* dense output */
static inline double dense_value(const struct dense *d, double r, double s, int i)
{
    return d->c[0][i] + r * (d->c[1][i] + s * (d->c[2][i] + r * (d->c[3][i] + s * d->c[4][i])));
}

static inline void dense_at(const struct dense *d, double t, double *x, double *z)
{
    double r = d->h > 0 ? (t - d->t) / d->h : 0.0, s = 1.0 - r;
    for (int i = 0; i < N; i++) x[i] = dense_value(d, r, s, i);
    for (int i = 0; i < NZN; i++) z[i] = dense_value(d, r, s, N + i);
}

/* Piece of the inputs that holds at t, searched from a piece of the same section. */
static inline long piece_at(const struct inputs *in, long piece, long first, long last, double t)
{
    while (piece < last && t >= in->start[piece + 1]) piece++;
    while (piece > first && t < in->start[piece]) piece--;
    return piece;
}

#endif
