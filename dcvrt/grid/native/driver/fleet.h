/* A fleet: all units of a grid (machines with their controls, facilities, nonlinear loads) and the network
 * that couples them.
 *
 * Units of one structure form a group and run in the lanes of packs, each with its own parameters and modes.
 * A unit feeds the source current s(x, v) = i(x, v) + y v into the network, whose admittance contains y; the
 * voltages at all ports and points of interest are V = Z s. Where i is affine in v, y is chosen so that s
 * depends on states alone, and one product gives all voltages; else Newton's method finds those of the ports
 * that depend on their own voltage.
 *
 * States of a group: [pack][state][lane]; derivatives by theta: [pack][direction][state][lane]. Voltages and
 * currents: real parts of all ports, then imaginary parts; their derivatives one direction after another.
 * Lanes without a unit repeat the last unit and feed nothing. A group has as many lanes as its object is made for.
 */
#ifndef DCVRT_FLEET_H
#define DCVRT_FLEET_H

/* Jumps closer than this, s, are at one instant; a crossing is located to LOCATED. */
#define SAME_INSTANT 1e-9
#define LOCATED 1e-11
enum { MAX_JUMPS_AT_ONCE = 50 };

enum status {
    COMPLETED = 0,
    LEFT_BOUNDS = 1,
    CHATTER = 2,
    STEP_TOO_SMALL = 4,
    TOO_MANY_STEPS = 5,
    NOT_FINITE = 6,
    NO_VOLTAGE = 7,        /* no voltages satisfy the network's equations near the last ones */
    OUT_OF_STEP = 8,
    NO_MEMORY = 9
};

struct group;

/* What the object of one structure gives. `v` has stride `ports` between real and imaginary parts. */
typedef void source_call(const struct group *, long directions, double t, const double *x, const double *xs,
                         const double *v, const double *vs, double *s, double *ss);
typedef void flow_call(const struct group *, long directions, double t, const double *x, const double *xs,
                       const double *v, const double *vs, double *f, double *fs);
typedef void guard_call(const struct group *, long pack, long directions, double t, const double *x,
                        const double *xs, const double *v, const double *vs, double *g, double *gs);
typedef void slope_call(const struct group *, double t, const double *x, const double *v, double *by_v);
typedef void reset_call(const struct group *, long row, long pack, int lane, long directions, double t, double *x,
                        double *xs, const double *v, const double *vs);
typedef void hoist_call(const struct group *, long pack, long directions);

struct functions {
    source_call *source;
    flow_call *flow;
    guard_call *guards;
    slope_call *source_by_v;
    reset_call *reset;
    hoist_call *hoist;
};

struct group {
    long units, lanes, packs, nx, np, nq, na, rows, bounds, moving, fixed, fixed_columns;
    long ports, v_rows; /* numbers of real parts in currents and in voltages of the whole fleet */
    long first_port, first_feed, first_state; /* states of a group begin at a multiple of BLOCK */
    long reads_v;    /* whether the source depends on the unit's own voltage */
    long quick;      /* whether it may take steps of its own inside those of the others; such groups are the last */
    long angle;      /* state that is a rotor angle, or -1 */
    double tolerance;          /* of its states, over that of the options */
    const double *p;           /* [pack][np][lane] */
    const double *moving_seed; /* [pack][direction][moving][lane]: dp/dtheta of the parameters that move */
    const double *held;        /* [pack][row][lane] */
    const double *inertia;     /* [pack][lane], of rotors */
    double *q;                 /* [pack][nq][lane] */
    double *entry, *entries;   /* [pack][na][lane] and [pack][direction][na][lane]: when the mode was entered */
    double *since, *sinces;    /* [pack][row][lane]: when the guard became true; infinite while it is not */
    long along;                /* whether the direction asked for is time, which changes no parameter */
    double *kept, *kept_columns, *no_columns; /* values of parameters and flags alone */
    long *mode;                /* [pack][na][lane] */
    const long *row_automaton, *row_source, *row_target, *row_resets, *flag_begin, *flag_width;
    const double *flag_values;
    const struct functions *call;
};

struct fleet {
    long groups;
    struct group *const *group;
    long ports, points, states, directions;
    long feeds;          /* ports that feed a current: those of lanes with a unit, group after group */
};

/* One network: Z from the ports that feed a current to those ports, then to points, and its derivatives. Blocks of
 * eight rows: [block][feed][re, im][8]; rows of ports and rows of points are each filled up to whole blocks. */
struct network {
    const double *z;
    const double *const *dz; /* one for each direction, or null where Z does not depend on it */
    const float *near;       /* rows of ports, blocks of sixteen: for voltages that lie near known ones */
};

/* A stretch without a change of the network. */
struct stretch {
    double from, to;
    const double *dfrom;     /* [direction] derivative of its begin */
    const struct network *network;
    long samples;
    const double *sample;    /* times, in [from, to] */
};

struct options {
    double rtol, atol, theta_rtol, theta_share, longest, out_of_step;
    double worth; /* how many times longer a step has to be with steps of quick units inside it */
    long max_steps;
};

struct record {
    double *v, *vs;          /* [sample][re, im][point], [sample][direction][re, im][point] */
    double *events;          /* [event][4]: time, group, row, pack * lanes + lane */
    long event_room, n_events, n_samples, steps, rejected;
    double t, amount;
    long group, unit, row;   /* of a failure */
};

int fleet_run(const struct fleet *, const struct options *, long stretches, const struct stretch *,
              double *x, double *xs, double *v_start, struct record *);

#endif
