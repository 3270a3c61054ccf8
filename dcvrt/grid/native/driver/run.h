/* What a run holds: states, rates and voltages at several instants, and room to work in. */
#ifndef DCVRT_RUN_H
#define DCVRT_RUN_H

#include "fleet.h"
#include "pair.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { BLOCK = 8, WIDE_BLOCK = 16, MOST_DIRECTIONS = 64 };

typedef double block __attribute__((vector_size(8 * BLOCK), aligned(8)));
typedef float wide_block __attribute__((vector_size(4 * WIDE_BLOCK), aligned(4)));

struct state {
    double *x, *xs;
};

/* Everything at one instant: rates, sources and voltages, each with derivatives by theta. */
struct moment {
    double *f, *fs, *s, *ss, *v, *vs;
};

/* One step of the pair: states at its begin, its end and the stage before its end, rates of its stages. */
struct span {
    double h;
    double *x, *next, *before, *f[STAGES];
};

enum { LINKS = 3 }; /* steps of facilities inside one of machines, end to end */

struct run {
    const struct fleet *fleet;
    const struct options *options;
    const struct network *network;
    struct record *record;
    long n, ns, ports, points, rows, d; /* states, their derivatives, ports, points, both in blocks, directions */
    long size_v;                        /* numbers of one set of voltages: 2 rows */
    long fed_rows;                      /* rows of Z of the ports that feed, in whole blocks */
    int near;                           /* whether voltages of stages are found near those of the step's begin */
    double t, h, error_before;
    double corner;           /* part of an error that the last term is */
    double timer;            /* when the next timer runs out */
    struct state now, next, stage, inside;
    struct moment k[STAGES], here, there;
    int nests, nested;       /* whether facilities may, and in the last step did, take steps of their own */
    long quick_states, quick_feeds, quick_rows; /* of units that may: they are the last ones; rows in whole blocks */
    struct span link[LINKS];
    double *z_quick;         /* rows of Z of their ports */
    double *driven;          /* [stage][re, im][row]: what the others drive these ports by; then room */
    double drive_weight[STAGES][STAGES][STAGES]; /* [last stage known][stage of a link][stage] */
    double *guard, *guards;  /* of one pack */
    double *by_v, *matrix, *right, *trial, *pack;
    double *fed;             /* [re, im][feed] of each set: source currents as a product takes them */
    double *at_feeds;        /* [direction][re, im][row]: what a product gives for the ports that feed */
    float *fed_change, *change; /* the same of changes, in single precision */
    long *pivot, coupled;    /* ports whose source reads their voltage */
    long *coupled_port, *coupled_feed; /* and whose row of Z is that of its voltage */
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
