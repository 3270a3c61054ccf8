/* A hybrid system in time: its state, and what can be done with it. Nothing here knows of FMI.

   dx/dt = f, 0 = g, y = h(t, x, z, u, p, q, c): states x, algebraic variables z, inputs u, parameters p, flags q
   of the modes, clocks c = time since a mode was entered. The functions and tables of one system are in model.c. */

#ifndef HYBRID_H
#define HYBRID_H

#include <stdbool.h>
#include <stddef.h>

#include "model.h"

#define ROOM(n) ((n) > 0 ? (n) : 1) /* C has no arrays without elements */
#define NW (NX + NZ)                /* unknowns of the equilibrium */
#define NH (NROWS + NBOUNDS)        /* event indicators: guards, then bounds of states */

/* All that changes, in one piece without pointers: copying it saves and restores a run. */
struct hybrid {
    double t;
    double x[ROOM(NX)], z[ROOM(NZ)], u[ROOM(NU)], p[ROOM(NP)];
    int mode[ROOM(NA)];
    double entry[ROOM(NA)];    /* time at which the present mode was entered */
    double held[ROOM(NROWS)];  /* how long a guard must be true; 0: it acts at once */
    double armed[ROOM(NROWS)]; /* since when the guard of a timed row is true; NaN: it is not */

    double instant; /* the time of the last jumps, how many they were, and by which rows */
    int jumps;
    bool visited[ROOM(NROWS)];

    bool known;  /* the values below belong to the values above */
    bool solved; /* and so does z */
    bool valid;  /* and f and h are numbers */
    double f[ROOM(NX)], y[ROOM(NY)], h[ROOM(NH)];
};

/* A direction in which the system moves, and how its results move along it. */
struct direction {
    double t, x[ROOM(NX)], z[ROOM(NZ)], u[ROOM(NU)], p[ROOM(NP)];
    double f[ROOM(NX)], g[ROOM(NZ)], y[ROOM(NY)], h[ROOM(NH)];
};

/* What the functions of the model take, in their order: t, x, z, u, p, q, c, and then a direction. */
struct arguments {
    const double *of[12];
    double q[ROOM(NQ)], c[ROOM(NA)];
};

enum outcome {
    SETTLED,      /* no row is due; timers are set */
    JUMPED,       /* one row was applied; ask again */
    LEFT_BOUNDS,  /* a state left its range of validity */
    CHATTERS,     /* too many jumps at one instant */
    NOT_VALID     /* the equations gave no number */
};

/* equations.c */
void hybrid_defaults(struct hybrid *s);
void hybrid_gather(const struct hybrid *s, struct arguments *a);
bool hybrid_evaluate(struct hybrid *s);
void hybrid_fault(const struct hybrid *s, char *message, size_t size);
void hybrid_move(const struct hybrid *s, struct direction *d, bool tied);
bool hybrid_finite(int n, const double *values);
double hybrid_largest(int n, const double *values);

/* equilibrium.c */
bool hybrid_equilibrium(struct hybrid *s, char *message, size_t size);
void hybrid_equilibrium_slope(const struct hybrid *s, struct direction *d);

/* jumps.c */
bool hybrid_together(const struct hybrid *s, char *message, size_t size);
void hybrid_begin(struct hybrid *s);
bool hybrid_active(const struct hybrid *s, int row);
double hybrid_indicator(const struct hybrid *s, int k);
bool hybrid_due(struct hybrid *s);
enum outcome hybrid_update(struct hybrid *s, bool *reset, char *message, size_t size);
bool hybrid_next_timer(const struct hybrid *s, double *t);

#endif
