/* What a run holds: states, rates and voltages at several instants, and room to work in. */
#ifndef DCVRT_RUN_H
#define DCVRT_RUN_H

#include "fleet.h"
#include "pair.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { BLOCK = 8, MOST_DIRECTIONS = 64 };

typedef double block __attribute__((vector_size(8 * BLOCK), aligned(8)));

struct state {
    double *x, *xs;
};

/* Everything at one instant: rates, sources and voltages, each with derivatives by theta. */
struct moment {
    double *f, *fs, *s, *ss, *v, *vs;
};

struct run {
    const struct fleet *fleet;
    const struct options *options;
    const struct network *network;
    struct record *record;
    long n, ns, ports, points, rows, d; /* states, their derivatives, ports, points, rows of Z, directions */
    long size_v;                        /* numbers of one set of voltages: 2 (ports + points) */
    double t, h, error_before;
    double timer;            /* when the next timer runs out */
    struct state now, next, stage, inside;
    struct moment k[STAGES], here, there;
    double *guard, *guards;  /* of one pack */
    double *by_v, *matrix, *right, *trial, *pack;
    double *fed;             /* [feed][direction][re, im]: source currents as a product takes them */
    long *pivot, coupled;    /* ports whose source reads their voltage */
    long *coupled_port;
    long *feed_of_port;      /* number among the ports that feed, or -1 */
    int factored;
    double *scale;           /* of the derivatives, per direction */
    double dt[MOST_DIRECTIONS]; /* derivative of the present instant, where known */
    int dt_known;
    double *memory;
};

static int failed(struct run *r, int status, double t, long g, long unit, long row, double amount)
{
    struct record *record = r->record;
    record->t = t, record->group = g, record->unit = unit, record->row = row, record->amount = amount;
    return status;
}

#endif
