/* Rows that fire, timers, bounds, loss of synchronism; derivatives cross an event with the jump term. */
#ifndef DCVRT_EVENTS_H
#define DCVRT_EVENTS_H

#include "nested.h"

static double *guards_of(struct run *r, const struct group *g, long pack, double t, const struct state *x,
                         const struct moment *m)
{
    g->call->guards(g, pack, 0, t, x->x, x->xs, m->v, m->vs, r->guard, r->guards);
    return r->guard;
}

/* Largest value of guards that can fire or start a timer, of all units or quick ones alone; which of them is positive
 * first is what is sought. */
static double alarm(struct run *r, double t, const struct state *x, const struct moment *m, int quick)
{
    const struct fleet *f = r->fleet;
    double most = -INFINITY;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        if (!(group->rows + group->bounds) || (quick && !group->quick)) continue;
        long lanes = group->lanes;
        for (long pack = 0; pack < group->packs; pack++) {
            const double *value = guards_of(r, group, pack, t, x, m);
            for (long row = 0; row < group->rows + group->bounds; row++)
                for (long lane = 0; lane < lanes; lane++) {
                    double guard = value[row * lanes + lane];
                    if (row < group->rows) {
                        long a = group->row_automaton[row];
                        if (group->mode[(pack * group->na + a) * lanes + lane] != group->row_source[row])
                            continue;
                        if (isfinite(group->since[(pack * group->rows + row) * lanes + lane])) continue;
                    }
                    if (guard > most) most = guard;
                }
        }
    }
    return most;
}

/* First time in the last step at which an alarm is positive, as a share of the step; g_high is that at *at. */
static int locate(struct run *r, double g_high, double *at)
{
    double low = 0.0, high = *at, g_low = fmin(alarm(r, r->t, &r->now, &r->k[0], 0), 0.0);
    long d = r->d, ns = r->ns;
    int side = 0, bad = 0;
    if (r->coupled) memcpy(r->here.v, r->k[0].v, r->size_v * sizeof(double));
    r->d = r->ns = 0; /* where it lies does not ask for derivatives */
    for (int i = 0; i < 100 && !bad && (high - low) * r->h > LOCATED; i++) {
        double middle = i % 4 == 3 || !isfinite(g_low) || g_high <= g_low
                            ? 0.5 * (low + high)
                            : (low * g_high - high * g_low) / (g_high - g_low);
        double least = 0.01 * (high - low);
        middle = fmin(fmax(middle, low + fmin(least, 0.5 * LOCATED / r->h)), high - fmin(least, 0.5 * LOCATED / r->h));
        inside_at(r, middle);
        bad = voltages(r, r->t + middle * r->h, &r->inside, &r->here, AT_PORTS);
        double g = alarm(r, r->t + middle * r->h, &r->inside, &r->here, 0);
        if (g > 0.0) {
            high = middle, g_high = g;
            if (side == 1) g_low *= 0.5;
            side = 1;
        } else {
            low = middle, g_low = g;
            if (side == -1) g_high *= 0.5;
            side = -1;
        }
    }
    r->d = d, r->ns = ns;
    *at = high;
    return bad;
}

static void note(struct run *r, double t, long g, long row, long unit)
{
    struct record *record = r->record;
    if (record->n_events < record->event_room) {
        double *event = record->events + 4 * record->n_events;
        event[0] = t, event[1] = g, event[2] = row, event[3] = unit;
    }
    record->n_events++;
}

static void set_mode(struct run *r, const struct group *g, long pack, long lane, long a, long mode, double t)
{
    long lanes = g->lanes;
    g->mode[(pack * g->na + a) * lanes + lane] = mode;
    g->entry[(pack * g->na + a) * lanes + lane] = t;
    for (long k = 0, at = g->flag_begin[a]; k < g->flag_width[a]; k++) {
        long before = 0;
        for (long b = 0; b < a; b++) before += g->flag_width[b];
        g->q[(pack * g->nq + before + k) * lanes + lane] = g->flag_values[at + mode * g->flag_width[a] + k];
    }
    for (long row = 0; row < g->rows; row++)
        if (g->row_automaton[row] == a) g->since[(pack * g->rows + row) * lanes + lane] = INFINITY;
    g->call->hoist(g, pack, r->d);
}

/* Derivatives of states along time, in the layout of derivatives by one direction, belong to no parameter. */
static void along_time(const struct run *r, int on)
{
    for (long g = 0; g < r->fleet->groups; g++) r->fleet->group[g]->along = on;
}

/* Derivative of the time at which a guard crosses zero: -(dg/dtheta) / (dg/dt); r->here holds the moment. */
static int crossing(struct run *r, const struct group *g, long row, long pack, long lane)
{
    long d = r->d, lanes = g->lanes, all = g->rows + g->bounds;
    struct state moving = {r->now.x, r->stage.xs};
    struct network still = {r->network->z, 0};
    const struct network *network = r->network;
    memcpy(moving.xs, r->here.f, r->n * sizeof(double));
    memcpy(r->there.v, r->here.v, r->size_v * sizeof(double));
    along_time(r, 1);
    r->d = 1, r->network = &still;
    int bad = voltages(r, r->t, &moving, &r->there, AT_PORTS);
    g->call->guards(g, pack, 1, r->t, moving.x, moving.xs, r->there.v, r->there.vs, r->guard, r->guards);
    double rate = r->guards[row * lanes + lane];
    r->d = d, r->network = network;
    along_time(r, 0);
    if (bad) return 1;
    g->call->guards(g, pack, d, r->t, r->now.x, r->now.xs, r->here.v, r->here.vs, r->guard, r->guards);
    for (long k = 0; k < d; k++)
        r->dt[k] = rate != 0.0 ? -r->guards[(k * all + row) * lanes + lane] / rate : 0.0;
    r->dt_known = 1;
    return 0;
}

/* S += sign f dt over the whole fleet. */
static void shift_by(struct run *r, const double *f, double sign, const double *dt)
{
    const struct fleet *fleet = r->fleet;
    for (long g = 0; g < fleet->groups; g++) {
        const struct group *group = fleet->group[g];
        long each = group->nx * group->lanes;
        for (long pack = 0; pack < group->packs; pack++)
            for (long k = 0; k < r->d; k++) {
                double *s = r->now.xs + group->first_state * r->d + (pack * r->d + k) * each;
                const double *rate = f + group->first_state + pack * each;
                for (long e = 0; e < each; e++) s[e] += sign * rate[e] * dt[k];
            }
    }
}

/* One unit changes its mode at an instant that moves by r->dt. Derivatives cross it with the jump term: those of
 * x- at the instant itself are S- + f- dt; the reset maps them; behind it f+ dt is taken off again. */
static int jump(struct run *r, long g, long row, long pack, long lane)
{
    const struct group *group = r->fleet->group[g];
    long lanes = group->lanes, a = group->row_automaton[row], d = r->d;
    if (d) {
        if (rates(r, r->t, &r->now, &r->here)) return NO_VOLTAGE;
        if (!r->dt_known && crossing(r, group, row, pack, lane)) return NO_VOLTAGE;
        shift_by(r, r->here.f, 1.0, r->dt);
    }
    if (group->row_resets[row]) {
        if (voltages(r, r->t, &r->now, &r->here, AT_PORTS)) return NO_VOLTAGE;
        group->call->reset(group, row, pack, (int)lane, d, r->t, r->now.x, r->now.xs, r->here.v, r->here.vs);
    }
    set_mode(r, group, pack, lane, a, group->row_target[row], r->t);
    for (long k = 0; k < d; k++) group->entries[((pack * d + k) * group->na + a) * lanes + lane] = r->dt[k];
    if (d) {
        if (rates(r, r->t, &r->now, &r->here)) return NO_VOLTAGE;
        shift_by(r, r->here.f, -1.0, r->dt);
    }
    return COMPLETED;
}

/* Time of the next timer that runs out. */
static double next_timer(const struct run *r)
{
    const struct fleet *f = r->fleet;
    double next = INFINITY;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        long count = group->packs * group->rows * group->lanes;
        for (long k = 0; k < count; k++) {
            double due = group->since[k] + group->held[k];
            if (due < next) next = due;
        }
    }
    return next;
}

/* Everything that is due at r->t: rows that fire, timers that start or lapse. Where r->dt is not known, the instant
 * is that of a located crossing. */
static int settle(struct run *r)
{
    const struct fleet *f = r->fleet;
    for (int jumps = 0;; jumps++) {
        int fired = 0;
        if (voltages(r, r->t, &r->now, &r->here, AT_PORTS)) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        for (long g = 0; g < f->groups && !fired; g++) {
            const struct group *group = f->group[g];
            if (!(group->rows + group->bounds)) continue;
            long lanes = group->lanes;
            for (long pack = 0; pack < group->packs && !fired; pack++) {
                const double *value = guards_of(r, group, pack, r->t, &r->now, &r->here);
                for (long row = group->rows; row < group->rows + group->bounds; row++)
                    for (long lane = 0; lane < lanes; lane++)
                        if (value[row * lanes + lane] > 0.0)
                            return failed(r, LEFT_BOUNDS, r->t, g, pack * lanes + lane, row - group->rows, 0);
                for (long row = 0; row < group->rows && !fired; row++)
                    for (long lane = 0; lane < lanes && !fired; lane++) {
                        long a = group->row_automaton[row];
                        if (group->mode[(pack * group->na + a) * lanes + lane] != group->row_source[row])
                            continue;
                        double *since = &group->since[(pack * group->rows + row) * lanes + lane];
                        double held = group->held[(pack * group->rows + row) * lanes + lane];
                        int was = isfinite(*since);
                        if (value[row * lanes + lane] <= 0.0 && !(was && r->t >= *since + held - SAME_INSTANT)) {
                            *since = INFINITY;
                            continue;
                        }
                        long at = (pack * r->d * group->rows + row) * lanes + lane, step = group->rows * lanes;
                        if (!was && held > 0.0) {
                            *since = r->t;
                            if (r->d) {
                                if (!r->dt_known && (rates(r, r->t, &r->now, &r->here) ||
                                                     crossing(r, group, row, pack, lane)))
                                    return failed(r, NO_VOLTAGE, r->t, g, pack * lanes + lane, row, 0);
                                for (long k = 0; k < r->d; k++) group->sinces[at + k * step] = r->dt[k];
                                value = guards_of(r, group, pack, r->t, &r->now, &r->here);
                            }
                        }
                        if (held > 0.0 && r->t < *since + held - SAME_INSTANT) continue;
                        if (held > 0.0) {
                            for (long k = 0; k < r->d; k++) r->dt[k] = group->sinces[at + k * step];
                            r->dt_known = 1;
                        }
                        if (jumps >= MAX_JUMPS_AT_ONCE)
                            return failed(r, CHATTER, r->t, g, pack * lanes + lane, row, 0);
                        int status = jump(r, g, row, pack, lane);
                        if (status) return failed(r, status, r->t, g, pack * lanes + lane, row, 0);
                        note(r, r->t, g, row, pack * lanes + lane);
                        fired = 1;
                    }
            }
        }
        if (!fired) {
            r->timer = next_timer(r);
            return COMPLETED;
        }
    }
}

/* Stops the timers that have lost their guard at the end of the step. */
static void lapses(struct run *r, double t, const struct state *x, const struct moment *m)
{
    const struct fleet *f = r->fleet;
    if (!isfinite(r->timer)) return;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        long count = group->packs * group->rows * group->lanes;
        int running = 0;
        for (long k = 0; k < count; k++) running |= isfinite(group->since[k]);
        if (!running) continue;
        for (long pack = 0; pack < group->packs; pack++) {
            const double *value = guards_of(r, group, pack, t, x, m);
            for (long k = 0; k < group->rows * group->lanes; k++) {
                double *since = &group->since[pack * group->rows * group->lanes + k];
                if (isfinite(*since) && value[k] <= 0.0) *since = INFINITY;
            }
        }
    }
    r->timer = next_timer(r);
}

/* Whether a timer of a quick unit runs that has lost its guard. */
static int lost_guard(struct run *r, double t, const struct state *x, const struct moment *m)
{
    const struct fleet *f = r->fleet;
    if (!isfinite(r->timer)) return 0;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        for (long pack = 0; group->quick && pack < group->packs; pack++) {
            const double *value = guards_of(r, group, pack, t, x, m);
            for (long k = 0; k < group->rows * group->lanes; k++)
                if (isfinite(group->since[pack * group->rows * group->lanes + k]) && value[k] <= 0.0) return 1;
        }
    }
    return 0;
}

/* Share of the last step at which it ends for units to be looked at: the first time at which an alarm is positive, or
 * the end of the first step inside it after which a timer of a facility has lost its guard; 0 where neither is. */
static int ends_at(struct run *r, double *at)
{
    static const int stage_of[LINKS - 1] = {2, 4};
    double most = 0.0;
    *at = 0.0;
    for (int l = 0; r->nested && l + 1 < LINKS && *at == 0.0; l++) {
        const struct moment *m = &r->k[stage_of[l]];
        struct state x = {r->link[l].next, 0};
        double t = r->t + NODE[stage_of[l]] * r->h;
        if (alarm(r, t, &x, m, 1) <= 0.0 && !lost_guard(r, t, &x, m)) continue;
        *at = NODE[stage_of[l]];
        inside_at(r, *at); /* with the machines, and their alarms */
        if (voltages(r, t, &r->inside, &r->here, AT_PORTS)) return 1;
        most = alarm(r, t, &r->inside, &r->here, 0);
    }
    if (*at == 0.0) {
        most = alarm(r, r->t + r->h, &r->next, &r->k[STAGES - 1], 0);
        if (most > 0.0) *at = 1.0;
    }
    return most > 0.0 && locate(r, most, at);
}

/* Which rotor is further from the centre of inertia than allowed; -1 where none is. */
static long out_of_step(const struct run *r, long *in_group, double *away)
{
    const struct fleet *f = r->fleet;
    double sum = 0.0, weight = 0.0;
    for (int pass = 0; pass < 2; pass++)
        for (long g = 0; g < f->groups; g++) {
            const struct group *group = f->group[g];
            if (group->angle < 0) continue;
            long lanes = group->lanes;
            for (long pack = 0; pack < group->packs; pack++)
                for (long lane = 0; lane < lanes; lane++) {
                    double m = group->inertia[pack * lanes + lane];
                    double angle = r->now.x[group->first_state + (pack * group->nx + group->angle) * lanes + lane];
                    if (!pass) sum += m * angle, weight += m;
                    else if (m > 0 && fabs(angle - sum / weight) > r->options->out_of_step) {
                        *in_group = g, *away = angle - sum / weight;
                        return pack * lanes + lane;
                    }
                }
        }
    return -1;
}

#endif
