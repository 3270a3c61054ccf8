/* Integrates a fleet through stretches of constant networks: explicit pair of orders 5 and 4, located events,
 * forward sensitivities that cross events with the jump term.
 */
#include "events.h"

static int sample(struct run *r, double t, const struct state *x, struct moment *m)
{
    if (voltages(r, t, x, m, AT_POINTS)) return 1;
    struct record *record = r->record;
    long points = r->points, stride = 2 * r->rows, k = record->n_samples++;
    for (int part = 0; part < 2; part++) {
        memcpy(record->v + (2 * k + part) * points, m->v + part * r->rows + r->ports, points * sizeof(double));
        for (long d = 0; d < r->d; d++)
            memcpy(record->vs + ((k * r->d + d) * 2 + part) * points,
                   m->vs + d * stride + part * r->rows + r->ports, points * sizeof(double));
    }
    return 0;
}

/* How many times longer the next step may be for this error of the last one. */
static double growth(const struct run *r, double error)
{
    return fmax(0.2, 0.9 * pow(fmax(error, 1e-8), -0.14) * pow(r->error_before, 0.08));
}

static int stretch_run(struct run *r, const struct stretch *s)
{
    const struct options *o = r->options;
    long next_sample = 0;
    r->network = s->network;
    r->factored = 0;
    r->near = !r->d && !r->coupled && r->options->rtol >= NEAR_FROM;
    if (r->nests) quick_impedances(r);
    int nest = r->nests && !(o->worth > 0.0);
    r->t = s->from;
    r->dt_known = 1;
    for (long k = 0; k < r->d; k++) r->dt[k] = s->dfrom ? s->dfrom[k] : 0.0;
    int status = settle(r);
    if (status) return status;
    if (rates(r, r->t, &r->now, &r->k[0])) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
    r->h = 1e-3;
    r->error_before = 1.0;
    while (next_sample < s->samples && s->sample[next_sample] <= r->t + SAME_INSTANT) {
        if (r->coupled) memcpy(r->here.v, r->k[0].v, r->size_v * sizeof(double));
        if (sample(r, r->t, &r->now, &r->here)) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        next_sample++;
    }
    while (r->t < s->to - SAME_INSTANT) {
        if (r->record->steps + r->record->rejected >= o->max_steps) return failed(r, TOO_MANY_STEPS, r->t, 0, 0, 0, 0);
        double limit = fmin(s->to, r->timer);
        double free_step = r->h;
        int cut = 0;
        if (r->h > o->longest) r->h = free_step = o->longest;
        if (r->t + 1.0001 * r->h >= limit) r->h = limit - r->t, cut = 1;
        int bad = 0;
        r->nested = nest;
        if (nest) nested_step(r);
        else
            for (int k = 1; k < STAGES && !bad; k++) bad = stage(r, k);
        double of_slow = bad ? INFINITY : error_of(r, 0), of_quick = bad ? INFINITY : error_of(r, 1);
        double error = fmax(of_slow, of_quick);
        if (!(error <= 1.0)) {
            r->record->rejected++;
            r->h *= isfinite(error) ? fmax(0.2, 0.9 * pow(error, -0.2)) : 0.2;
            if (r->h < 1e-10) return failed(r, isfinite(error) ? STEP_TOO_SMALL : NO_VOLTAGE, r->t, 0, 0, 0, 0);
            continue;
        }
        r->record->steps++;
        double base = cut ? fmax(free_step, r->h) : r->h, links = nest ? LINKS : 1.0;
        double slow_h = fmin(base * growth(r, of_slow), REACH / fastest(r, 0));
        double quick_h = fmin(base / links * growth(r, of_quick), REACH / fastest(r, 1));
        r->error_before = fmax(error, 1e-4);
        double most_h = fmin(5.0 * base, slow_h), next_h = fmin(most_h, quick_h);
        double nested_h = fmin(most_h, LINKS * quick_h), moves = of_slow * pow(nested_h / r->h, 5.0);
        nest = r->nests && (!(o->worth > 0.0) || (nested_h > o->worth * next_h && moves > MOVING));
        if (nest) next_h = nested_h;
        double end;
        if (ends_at(r, &end)) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        int event = end > 0.0;
        if (!event) end = 1.0;
        double until = end == 1.0 ? (cut ? limit : r->t + r->h) : r->t + end * r->h;
        for (; next_sample < s->samples && s->sample[next_sample] < until - SAME_INSTANT; next_sample++) {
            inside_at(r, (s->sample[next_sample] - r->t) / r->h);
            if (r->coupled) memcpy(r->here.v, r->k[0].v, r->size_v * sizeof(double));
            if (sample(r, s->sample[next_sample], &r->inside, &r->here))
                return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        }
        int restart = event;
        if (end < 1.0) {
            inside_at(r, end);
            memcpy(r->now.x, r->inside.x, r->n * sizeof(double));
            memcpy(r->now.xs, r->inside.xs, r->ns * sizeof(double));
            next_h = fmin(next_h, free_step);
        } else {
            struct state swap = r->now;
            r->now = r->next;
            r->next = swap;
            struct moment last = r->k[STAGES - 1];
            r->k[STAGES - 1] = r->k[0];
            r->k[0] = last;
        }
        r->t = until;
        if (!event) lapses(r, r->t, &r->now, &r->k[0]);
        if (r->t >= r->timer - SAME_INSTANT) restart = 1;
        if (restart) {
            if (r->coupled) memcpy(r->here.v, r->k[0].v, r->size_v * sizeof(double));
            r->dt_known = 0;
            status = settle(r);
            if (status) return status;
            if (r->coupled) memcpy(r->k[0].v, r->here.v, r->size_v * sizeof(double));
            if (rates(r, r->t, &r->now, &r->k[0])) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        }
        r->h = next_h;
        for (; next_sample < s->samples && s->sample[next_sample] <= r->t + SAME_INSTANT; next_sample++) {
            if (r->coupled) memcpy(r->here.v, r->k[0].v, r->size_v * sizeof(double));
            if (sample(r, r->t, &r->now, &r->here)) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        }
        long g = 0;
        double away = 0.0;
        long lost = out_of_step(r, &g, &away);
        if (lost >= 0) return failed(r, OUT_OF_STEP, r->t, g, lost, 0, away);
    }
    return COMPLETED;
}

static double *take(double **free_memory, long count)
{
    double *here = *free_memory;
    *free_memory += (count + 7) & ~7L;
    return here;
}

static long count_memory(const struct run *r, long guards, long sensitive)
{
    long vectors = 4 * (r->n + r->ns) + (STAGES + 2) * (r->n + r->ns + (1 + r->d) * (2 * r->ports + r->size_v));
    long n = 2 * r->coupled;
    long links = LINKS * (STAGES + 3) * (r->n + 8) + 2 * r->quick_rows * (r->fleet->feeds + STAGES + 2);
    return vectors + guards * (1 + sensitive) + 2 * n + n * n + n + r->size_v +
           4 * r->ports + r->d + 8 * r->fleet->feeds + 8 * r->fed_rows + r->fleet->feeds + r->fed_rows + WIDE_BLOCK +
           (r->nests ? links : 0) +
           8 * 128; /* each vector begins on its own cache line */
}

int fleet_run(const struct fleet *f, const struct options *o, long stretches, const struct stretch *s, double *x,
              double *xs, double *v_start, struct record *record)
{
    struct run r = {.fleet = f, .options = o, .record = record};
    r.n = f->states, r.d = f->directions, r.ns = r.n * r.d, r.ports = f->ports, r.points = f->points;
    r.rows = f->ports + ((f->points + BLOCK - 1) / BLOCK) * BLOCK;
    r.size_v = 2 * r.rows;
    r.fed_rows = (f->feeds + BLOCK - 1) / BLOCK * BLOCK;
    r.corner = pow(o->rtol, 0.2) / SMOOTH;
    long guards = 0;
    for (long g = 0; g < f->groups; g++) {
        long all = (f->group[g]->rows + f->group[g]->bounds) * f->group[g]->lanes;
        guards = all > guards ? all : guards;
        if (f->group[g]->quick) {
            r.quick_states += (g + 1 < f->groups ? f->group[g + 1]->first_state : r.n) - f->group[g]->first_state;
            r.quick_feeds += f->group[g]->units;
        }
        if (f->group[g]->reads_v) r.coupled += f->group[g]->packs * f->group[g]->lanes;
    }
    r.quick_rows = (r.quick_feeds + BLOCK - 1) / BLOCK * BLOCK;
    r.nests = r.quick_states && !r.d && !r.coupled;
    long sensitive = r.d > 0 ? r.d : 1;
    long total = count_memory(&r, guards + 8, sensitive);
    if (posix_memalign((void **)&r.memory, 64, total * sizeof(double))) return NO_MEMORY;
    memset(r.memory, 0, total * sizeof(double));
    r.pivot = malloc((2 * r.coupled + 1) * sizeof(long));
    r.coupled_port = malloc((r.coupled + 1) * sizeof(long));
    r.coupled_feed = malloc((r.coupled + 1) * sizeof(long));
    if (!r.pivot || !r.coupled_port || !r.coupled_feed) {
        free(r.memory), free(r.pivot), free(r.coupled_port), free(r.coupled_feed);
        return NO_MEMORY;
    }
    for (long g = 0, k = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        for (long i = 0; group->reads_v && i < group->packs * group->lanes; i++, k++) {
            r.coupled_port[k] = group->first_port + i;
            r.coupled_feed[k] = group->first_feed + (i < group->units ? i : group->units - 1);
        }
    }
    double *at = r.memory;
    struct state *states[] = {&r.now, &r.next, &r.stage, &r.inside};
    for (int k = 0; k < 4; k++) states[k]->x = take(&at, r.n), states[k]->xs = take(&at, r.d ? r.ns : 0);
    for (int k = 0; k < STAGES + 2; k++) {
        struct moment *m = k < STAGES ? &r.k[k] : k == STAGES ? &r.here : &r.there;
        m->f = take(&at, r.n), m->fs = take(&at, r.ns), m->s = take(&at, 2 * r.ports);
        m->ss = take(&at, r.d * 2 * r.ports), m->v = take(&at, r.size_v), m->vs = take(&at, r.d * r.size_v);
    }
    r.guard = take(&at, guards + 8), r.guards = take(&at, (guards + 8) * sensitive);
    r.by_v = take(&at, 4 * r.coupled), r.matrix = take(&at, 4 * r.coupled * r.coupled);
    r.right = take(&at, 2 * r.coupled), r.trial = take(&at, r.size_v), r.pack = take(&at, 4 * r.ports);
    r.scale = take(&at, r.d), r.fed = take(&at, 8 * f->feeds);
    r.at_feeds = take(&at, 8 * r.fed_rows);
    r.fed_change = (float *)take(&at, f->feeds), r.change = (float *)take(&at, r.fed_rows + WIDE_BLOCK);
    if (r.nests) {
        for (int l = 0; l < LINKS; l++) { /* a link ends where the next one begins */
            struct span *link = &r.link[l];
            link->x = l ? r.link[l - 1].next : take(&at, r.n);
            link->next = take(&at, r.n), link->before = take(&at, r.n);
            for (int j = 0; j < STAGES; j++) link->f[j] = take(&at, r.n);
        }
        r.z_quick = take(&at, 2 * r.quick_rows * f->feeds);
        r.driven = take(&at, 2 * (STAGES + 2) * r.quick_rows);
        all_drive_weights(&r);
    }
    memcpy(r.now.x, x, r.n * sizeof(double));
    if (r.d) memcpy(r.now.xs, xs, r.ns * sizeof(double));
    for (long p = 0; p < r.ports; p++) {
        r.k[0].v[p] = r.here.v[p] = v_start[p];
        r.k[0].v[r.rows + p] = r.here.v[r.rows + p] = v_start[r.ports + p];
    }
    int status = COMPLETED;
    for (long k = 0; k < stretches && !status; k++) {
        if (r.d && s[k].dfrom) { /* the begin of the stretch moves with theta: S+ = S- + (f- - f+) dt */
            int moves = 0;
            for (long d = 0; d < r.d; d++) moves |= s[k].dfrom[d] != 0.0;
            if (moves) {
                int bad = 0; /* before the first stretch everything is at rest: f- = 0 */
                if (k > 0) {
                    r.network = s[k - 1].network;
                    bad = rates(&r, s[k].from, &r.now, &r.k[1]);
                }
                r.network = s[k].network, r.factored = 0;
                bad |= rates(&r, s[k].from, &r.now, &r.k[2]);
                if (bad) { status = failed(&r, NO_VOLTAGE, s[k].from, 0, 0, 0, 0); break; }
                if (k > 0) shift_by(&r, r.k[1].f, 1.0, s[k].dfrom);
                shift_by(&r, r.k[2].f, -1.0, s[k].dfrom);
            }
        }
        status = stretch_run(&r, &s[k]);
    }
    memcpy(x, r.now.x, r.n * sizeof(double));
    if (r.d) memcpy(xs, r.now.xs, r.ns * sizeof(double));
    free(r.memory), free(r.pivot), free(r.coupled_port), free(r.coupled_feed);
    return status;
}
