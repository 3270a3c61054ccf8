/* One step of the pair: stages, error over tolerance, fastest rate, dense output. */
#ifndef DCVRT_STEPS_H
#define DCVRT_STEPS_H

#include "voltages.h"

static inline __attribute__((always_inline)) void combine(long n, const double *restrict x, double h, int s,
                                                          double *const *k, double *restrict into)
{
    for (long i = 0; i < n; i++) {
        double sum = A[s][0] * k[0][i];
        for (int j = 1; j < s; j++)
            if (A[s][j] != 0.0) sum += A[s][j] * k[j][i];
        into[i] = x[i] + h * sum;
    }
}

static int stage(struct run *r, int s)
{
    double *k[STAGES], *ks[STAGES];
    for (int j = 0; j < s; j++) k[j] = r->k[j].f, ks[j] = r->k[j].fs;
    struct state *into = s == STAGES - 1 ? &r->next : &r->stage;
    switch (s) {
    case 1: combine(r->n, r->now.x, r->h, 1, k, into->x); combine(r->ns, r->now.xs, r->h, 1, ks, into->xs); break;
    case 2: combine(r->n, r->now.x, r->h, 2, k, into->x); combine(r->ns, r->now.xs, r->h, 2, ks, into->xs); break;
    case 3: combine(r->n, r->now.x, r->h, 3, k, into->x); combine(r->ns, r->now.xs, r->h, 3, ks, into->xs); break;
    case 4: combine(r->n, r->now.x, r->h, 4, k, into->x); combine(r->ns, r->now.xs, r->h, 4, ks, into->xs); break;
    case 5: combine(r->n, r->now.x, r->h, 5, k, into->x); combine(r->ns, r->now.xs, r->h, 5, ks, into->xs); break;
    default: combine(r->n, r->now.x, r->h, 6, k, into->x); combine(r->ns, r->now.xs, r->h, 6, ks, into->xs);
    }
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
static inline double over_of(const struct run *r, double corner, long i)
{
    const struct options *o = r->options;
    double e = ERROR[0] * r->k[0].f[i], last = LAST_TERM[0] * r->k[0].f[i];
    for (int j = 2; j < STAGES; j++) e += ERROR[j] * r->k[j].f[i], last += LAST_TERM[j] * r->k[j].f[i];
    return r->h * larger(e, corner * last) / (o->atol + o->rtol * larger(r->now.x[i], r->next.x[i]));
}

/* Largest error of a step, in states [from, to), over its tolerance; no number where one is none. */
static double error_in(const struct run *r, long from, long to)
{
    double most[BLOCK] = {0}, sum[BLOCK] = {0}, worst = 0.0, all = 0.0;
    double corner = pow(r->options->rtol, 0.2) / SMOOTH;
    long i = from;
    for (; i + BLOCK <= to; i += BLOCK)
        for (int l = 0; l < BLOCK; l++) {
            double over = over_of(r, corner, i + l);
            most[l] = over > most[l] ? over : most[l];
            sum[l] += over;
        }
    for (; i < to; i++) {
        double over = over_of(r, corner, i);
        sum[i % BLOCK] += over, most[i % BLOCK] = larger(most[i % BLOCK], over);
    }
    for (int l = 0; l < BLOCK; l++) worst = larger(worst, most[l]), all += sum[l];
    return isfinite(all) ? worst : NAN;
}

/* Largest error of a step over its tolerance. */
static double error_of(struct run *r)
{
    const struct options *o = r->options;
    const struct fleet *f = r->fleet;
    double worst = 0.0;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        long from = group->first_state, to = from + group->packs * group->nx * group->lanes;
        double over = error_in(r, from, to) / group->tolerance;
        if (!(over <= worst)) worst = over;
        if (isnan(worst)) return INFINITY;
    }
    if (!r->d || !isfinite(worst)) return worst;
    for (int pass = 0; pass < 2; pass++) {
        if (!pass)
            for (long k = 0; k < r->d; k++) r->scale[k] = 0.0;
        for (long g = 0; g < f->groups; g++) {
            const struct group *group = f->group[g];
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
static double fastest(const struct run *r)
{
    const struct fleet *f = r->fleet;
    const double *rate = r->k[STAGES - 1].f, *rate_before = r->k[STAGES - 2].f;
    const double *x = r->next.x, *x_before = r->stage.x;
    double most = 0.0, still = STILL * r->options->atol;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
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

/* Weights of the stages at a share s of the step: the cubic of Hermite and the last term. */
static void dense_weights(double s, double *w)
{
    const double *b = A[STAGES - 1];
    double u = 1.0 - s;
    for (int j = 0; j < STAGES; j++) {
        double end = j < STAGES - 1 ? b[j] : 0.0, bend = (j == 0) - end;
        w[j] = s * (end + u * (bend + s * (end - (j == STAGES - 1) - bend + u * LAST_TERM[j])));
    }
}

static void dense_at(long n, const double *restrict x, double h, const double *w, double *const *k,
                     double *restrict into)
{
    for (long i = 0; i < n; i++) {
        double sum = w[0] * k[0][i];
        for (int j = 2; j < STAGES; j++) sum += w[j] * k[j][i];
        into[i] = x[i] + h * sum;
    }
}

/* States at a share s of the last step, into r->inside. */
static void inside_at(struct run *r, double s)
{
    double w[STAGES], *k[STAGES], *ks[STAGES];
    for (int j = 0; j < STAGES; j++) k[j] = r->k[j].f, ks[j] = r->k[j].fs;
    dense_weights(s, w);
    dense_at(r->n, r->now.x, r->h, w, k, r->inside.x);
    dense_at(r->ns, r->now.xs, r->h, w, ks, r->inside.xs);
}

#endif
