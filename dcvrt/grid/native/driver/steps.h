/* One step of the pair: stages, error over tolerance, fastest rate, dense output. */
#ifndef DCVRT_STEPS_H
#define DCVRT_STEPS_H

#include "voltages.h"

static inline __attribute__((always_inline)) void combine(int s, long from, long to, double h, const double *restrict x,
                                                          double *const *k, double *restrict into)
{
    for (long i = from; i < to; i++) {
        double sum = A[s][0] * k[0][i];
        for (int j = 1; j < s; j++)
            if (A[s][j] != 0.0) sum += A[s][j] * k[j][i];
        into[i] = x[i] + h * sum;
    }
}

/* States [from, to) of a stage. */
static void combine_at(int s, long from, long to, double h, const double *x, double *const *k, double *into)
{
    switch (s) {
    case 1: combine(1, from, to, h, x, k, into); break;
    case 2: combine(2, from, to, h, x, k, into); break;
    case 3: combine(3, from, to, h, x, k, into); break;
    case 4: combine(4, from, to, h, x, k, into); break;
    case 5: combine(5, from, to, h, x, k, into); break;
    default: combine(6, from, to, h, x, k, into);
    }
}

static int stage(struct run *r, int s)
{
    double *k[STAGES], *ks[STAGES];
    for (int j = 0; j < s; j++) k[j] = r->k[j].f, ks[j] = r->k[j].fs;
    struct state *into = s == STAGES - 1 ? &r->next : &r->stage;
    combine_at(s, 0, r->n, r->h, r->now.x, k, into->x);
    combine_at(s, 0, r->ns, r->h, r->now.xs, ks, into->xs);
    if (r->near && s < STAGES - 1) {
        rates_near(r, r->t + NODE[s] * r->h, into, &r->k[0], &r->k[s]);
        return 0;
    }
    if (r->coupled) memcpy(r->k[s].v, r->k[s - 1].v, r->size_v * sizeof(double));
    return rates(r, r->t + NODE[s] * r->h, into, &r->k[s]);
}

static inline double larger(double a, double b)
{
    a = fabs(a), b = fabs(b);
    return a > b ? a : b;
}

/* Error of a step in one state over its tolerance; `corner` is the part of an error that the last term is. */
static inline double over_of(const struct options *o, const struct span *a, double corner, long i)
{
    double e = ERROR[0] * a->f[0][i], last = LAST_TERM[0] * a->f[0][i];
    for (int j = 2; j < STAGES; j++) e += ERROR[j] * a->f[j][i], last += LAST_TERM[j] * a->f[j][i];
    return a->h * larger(e, corner * last) / (o->atol + o->rtol * larger(a->x[i], a->next[i]));
}

/* The last step of all units, or of those that took no steps inside it. */
static struct span whole(const struct run *r)
{
    struct span all = {.h = r->h, .x = r->now.x, .next = r->next.x, .before = r->stage.x};
    for (int j = 0; j < STAGES; j++) all.f[j] = r->k[j].f;
    return all;
}

/* Largest error of a step, in states [from, to), over its tolerance; no number where one is none. */
static double error_in(const struct run *r, const struct span *a, long from, long to)
{
    const struct options *o = r->options;
    double most[BLOCK] = {0}, sum[BLOCK] = {0}, worst = 0.0, all = 0.0;
    double corner = r->corner;
    long i = from;
    for (; i + BLOCK <= to; i += BLOCK)
        for (int l = 0; l < BLOCK; l++) {
            double over = over_of(o, a, corner, i + l);
            most[l] = over > most[l] ? over : most[l];
            sum[l] += over;
        }
    for (; i < to; i++) {
        double over = over_of(o, a, corner, i);
        sum[i % BLOCK] += over, most[i % BLOCK] = larger(most[i % BLOCK], over);
    }
    for (int l = 0; l < BLOCK; l++) worst = larger(worst, most[l]), all += sum[l];
    return isfinite(all) ? worst : NAN;
}

/* Largest error of a step over its tolerance, of units that are quick and of others, in states and derivatives. */
static double error_of(struct run *r, int quick)
{
    const struct options *o = r->options;
    const struct fleet *f = r->fleet;
    double worst = 0.0;
    struct span all = whole(r);
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        if (group->quick != quick) continue;
        long from = group->first_state, to = from + group->packs * group->nx * group->lanes;
        int links = quick && r->nested;
        double tolerance = group->tolerance * (links ? LINK_TOLERANCE : 1.0);
        for (int l = 0; l < (links ? LINKS : 1); l++) {
            double over = error_in(r, links ? &r->link[l] : &all, from, to) / tolerance;
            if (!(over <= worst)) worst = over;
            if (isnan(worst)) return INFINITY;
        }
    }
    if (!r->d || !isfinite(worst)) return worst;
    for (int pass = quick; pass < 2; pass++) { /* the sizes of derivatives, of all units, are found but once */
        if (!pass)
            for (long k = 0; k < r->d; k++) r->scale[k] = 0.0;
        for (long g = 0; g < f->groups; g++) {
            const struct group *group = f->group[g];
            if (pass && group->quick != quick) continue;
            long each = group->nx * group->lanes, at = group->first_state * r->d;
            for (long pack = 0; pack < group->packs; pack++)
                for (long k = 0; k < r->d; k++, at += each)
                    for (long i = at; i < at + each; i++) {
                        double size = fmax(fabs(r->now.xs[i]), fabs(r->next.xs[i]));
                        if (!pass) {
                            r->scale[k] = fmax(r->scale[k], size);
                            continue;
                        }
                        double e = ERROR[0] * r->k[0].fs[i];
                        for (int j = 2; j < STAGES; j++) e += ERROR[j] * r->k[j].fs[i];
                        double weight = o->theta_rtol * (size + o->theta_share * r->scale[k]);
                        double over = weight > 0.0 ? fabs(r->h * e) / weight : 0.0;
                        if (!(over <= worst)) worst = over;
                    }
        }
    }
    return worst;
}

/* Largest rate at which a unit moves back to where it is drawn, from the last two stages of a step: both are at its
 * end, so that their states differ by what the fastest motion makes of them. Of the rates only what points back along
 * that difference counts: a slow state that differs drives faster ones, which says nothing of how fast they decay. */
static double fastest(const struct run *r, int quick)
{
    const struct fleet *f = r->fleet;
    const struct span a = quick && r->nested ? r->link[LINKS - 1] : whole(r);
    const double *rate = a.f[STAGES - 1], *rate_before = a.f[STAGES - 2], *x = a.next, *x_before = a.before;
    double most = 0.0, still = STILL * r->options->atol;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        if (group->quick != quick) continue;
        long lanes = group->lanes, each = group->nx * lanes, at = group->first_state;
        for (long pack = 0; pack < group->packs; pack++, at += each) {
            block back = {0}, size = {0}; /* as many states as a block holds at once */
            long i = 0;
            for (; i + BLOCK <= each; i += BLOCK) {
                block dx = *(const block *)(x + at + i) - *(const block *)(x_before + at + i);
                back += dx * (*(const block *)(rate_before + at + i) - *(const block *)(rate + at + i));
                size += dx * dx;
            }
            for (; i < each; i++) {
                double dx = x[at + i] - x_before[at + i];
                back[i % lanes] += dx * (rate_before[at + i] - rate[at + i]), size[i % lanes] += dx * dx;
            }
            for (long l = lanes; l < BLOCK; l++) back[l % lanes] += back[l], size[l % lanes] += size[l];
            for (long l = 0; l < lanes; l++)
                if (size[l] > still * still && back[l] > most * size[l]) most = back[l] / size[l];
        }
    }
    return most;
}

/* Values [from, to) at a share s of a step: the cubic of Hermite and the last term. */
static void dense_at(const struct span *a, long from, long to, double s, double *restrict into)
{
    double u = 1.0 - s, moved = s * s * (3.0 - 2.0 * s), w[STAGES];
    for (int j = 0; j < STAGES; j++) w[j] = a->h * s * s * u * u * LAST_TERM[j];
    w[0] += a->h * s * u * u, w[STAGES - 1] -= a->h * s * s * u;
    for (long i = from; i < to; i++) {
        double sum = w[0] * a->f[0][i];
        for (int j = 2; j < STAGES; j++) sum += w[j] * a->f[j][i];
        into[i] = a->x[i] + moved * (a->next[i] - a->x[i]) + sum;
    }
}

/* States at a share s of the last step, into r->inside. */
static void inside_at(struct run *r, double s)
{
    struct span all = whole(r), derivatives = {.h = r->h, .x = r->now.xs, .next = r->next.xs};
    long slow = r->nested ? r->n - r->quick_states : r->n;
    dense_at(&all, 0, slow, s, r->inside.x);
    if (r->nested) {
        int l = s < 1.0 ? (int)(LINKS * s) : LINKS - 1;
        dense_at(&r->link[l], slow, r->n, LINKS * s - l, r->inside.x);
    }
    for (int j = 0; j < STAGES; j++) derivatives.f[j] = r->k[j].fs;
    dense_at(&derivatives, 0, r->ns, s, r->inside.xs);
}

#endif
