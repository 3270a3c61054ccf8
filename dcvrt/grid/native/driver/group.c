/* The units of one structure: their generated equations, pack after pack. */
#include "width.h"
#if defined(FEW) && LANES > FEW
#undef LANES
#define LANES FEW
#endif
#define NW 1
#include "lanes.h"
#include "fleet.h"

#include <string.h>

/* Directions are counted at run time; the generated text knows them as GROUPS. */
static _Thread_local long directions_now;
#define GROUPS directions_now

#include "unit.h"

enum { MOST_DIRECTIONS = 64, U = 2 + NA }; /* inputs: the terminal voltage, then the clocks */
#define AT_LEAST_ONE(n) ((n) > 0 ? (n) : 1)

/* Inputs of a pack and their derivatives. */
struct gathered {
    real u[U];
    column us[MOST_DIRECTIONS * U];
};

static void gather(const struct group *g, long pack, long directions, double t, const double *v,
                   const double *vs, struct gathered *at)
{
    long port = g->first_port + pack * LANES;
    memcpy(&at->u[0], v + port, sizeof(real));
    memcpy(&at->u[1], v + g->v_rows + port, sizeof(real));
    for (long d = 0; d < directions; d++) {
        memcpy(&at->us[d * U], vs + d * 2 * g->v_rows + port, sizeof(real));
        memcpy(&at->us[d * U + 1], vs + d * 2 * g->v_rows + g->v_rows + port, sizeof(real));
    }
    const real *entry = (const real *)g->entry + pack * NA;
    const column *entries = (const column *)g->entries + pack * directions * NA;
    for (int a = 0; a < NA; a++) at->u[2 + a] = t - entry[a];
    for (long d = 0; d < directions; d++)
        for (int a = 0; a < NA; a++) at->us[d * U + 2 + a] = g->along ? all_columns(1.0) : -entries[d * NA + a];
}

static struct point point_of(const struct group *g, long pack, long directions, const double *x,
                             const double *xs, const struct gathered *at)
{
    return (struct point){
        .x = (const real *)(x + g->first_state) + pack * NX,
        .u = at->u,
        .m = (const real *)g->kept + pack * FIXED,
        .xs = xs ? (const column *)(xs + g->first_state * directions) + pack * directions * NX : 0,
        .us = at->us,
        .mc = g->along ? (const column *)g->no_columns
                       : (const column *)g->kept_columns + pack * directions * FIXED_COLUMNS,
    };
}

static void source_all(const struct group *g, long directions, double t, const double *x, const double *xs,
                       const double *v, const double *vs, double *s, double *ss)
{
    directions_now = directions;
    for (long pack = 0; pack < g->packs; pack++) {
        struct gathered gathered;
        real value[2];
        column values[MOST_DIRECTIONS * 2];
        gather(g, pack, directions, t, v, vs, &gathered);
        struct point at = point_of(g, pack, directions, x, xs, &gathered);
        if (directions) source_theta(&at, value, values);
        else source(&at, value);
        long port = g->first_port + pack * LANES;
        memcpy(s + port, &value[0], sizeof(real));
        memcpy(s + g->ports + port, &value[1], sizeof(real));
        for (long d = 0; d < directions; d++) {
            memcpy(ss + d * 2 * g->ports + port, &values[2 * d], sizeof(real));
            memcpy(ss + d * 2 * g->ports + g->ports + port, &values[2 * d + 1], sizeof(real));
        }
    }
}

static void flow_all(const struct group *g, long directions, double t, const double *x, const double *xs,
                     const double *v, const double *vs, double *f, double *fs)
{
    directions_now = directions;
    for (long pack = 0; pack < g->packs; pack++) {
        struct gathered gathered;
        gather(g, pack, directions, t, v, vs, &gathered);
        struct point at = point_of(g, pack, directions, x, xs, &gathered);
        real *rate = (real *)(f + g->first_state) + pack * NX;
        if (directions)
            flow_theta(&at, rate, (column *)(fs + g->first_state * directions) + pack * directions * NX);
        else flow(&at, rate);
    }
}

static void guards_of(const struct group *g, long pack, long directions, double t, const double *x,
                      const double *xs, const double *v, const double *vs, double *value, double *values)
{
    struct gathered gathered;
    directions_now = directions;
    gather(g, pack, directions, t, v, vs, &gathered);
    struct point at = point_of(g, pack, directions, x, xs, &gathered);
    if (directions) look_theta(&at, (real *)value, (column *)values);
    else look(&at, (real *)value);
}

static void slopes_all(const struct group *g, double t, const double *x, const double *v, double *by_v)
{
    directions_now = 0;
    for (long pack = 0; pack < g->packs; pack++) {
        struct gathered gathered;
        gather(g, pack, 0, t, v, 0, &gathered);
        struct point at = point_of(g, pack, 0, x, 0, &gathered);
        source_by_v(&at, (real *)by_v + pack * 4);
    }
}

static void reset_lane(const struct group *g, long row, long pack, int lane, long directions, double t, double *x,
                       double *xs, const double *v, const double *vs)
{
    struct gathered gathered;
    real after[AT_LEAST_ONE(NX)];
    column afters[AT_LEAST_ONE(NX) * MOST_DIRECTIONS];
    directions_now = directions;
    gather(g, pack, directions, t, v, vs, &gathered);
    struct point at = point_of(g, pack, directions, x, xs, &gathered);
    reset_of(row, &at, after, afters);
    double *own = x + g->first_state + pack * NX * LANES;
    for (int i = 0; i < NX; i++) own[i * LANES + lane] = AT(after[i], lane);
    for (long d = 0; d < directions; d++) {
        double *theirs = xs + g->first_state * directions + (pack * directions + d) * NX * LANES;
        for (int i = 0; i < NX; i++) theirs[i * LANES + lane] = AT(afters[d * NX + i], lane);
    }
}

static void hoist_pack(const struct group *g, long pack, long directions)
{
    directions_now = directions;
    hoist((const real *)g->p + pack * g->np, (const real *)g->q + pack * g->nq,
          (const column *)g->moving_seed + pack * directions * g->moving, (real *)g->kept + pack * FIXED,
          (column *)g->kept_columns + pack * directions * FIXED_COLUMNS);
}

const struct functions functions = {source_all, flow_all, guards_of, slopes_all, reset_lane, hoist_pack};
long sizes[] = {LANES, FIXED, FIXED_COLUMNS};
