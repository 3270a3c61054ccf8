/* Integrates a fleet through stretches of constant networks: explicit pair of orders 5 and 4, located events,
 * forward sensitivities that cross events with the jump term.
 */
#include "fleet.h"
#include "pair.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { BLOCK = 8, NEWTON = 30, MOST_DIRECTIONS = 64 };
#define NEWTON_TOLERANCE 1e-11
#define SLOW 0.1

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
    struct state now, next, stage, inside;
    struct moment k[STAGES], here, there;
    double *dense, *denses;  /* [DENSE][n], [DENSE][ns] */
    double *guard, *guards;  /* of one pack */
    double *by_v, *matrix, *right, *trial, *pack;
    long *pivot, coupled;    /* ports whose source reads their voltage */
    long *coupled_port;
    int factored;
    double *scale;           /* of the derivatives, per direction */
    double dt[MOST_DIRECTIONS]; /* derivative of the present instant, where known */
    int dt_known;
    double *memory;
};

/* -- linear algebra -------------------------------------------------------------------------------------- */

/* Rows [from, to) of Z times several columns; from and to are multiples of BLOCK. */
static inline __attribute__((always_inline)) void product(const struct run *r, const double *z, int count,
                                                          const double *s, long stride_s, double *v,
                                                          long stride_v, long from, long to, int add)
{
    long columns = r->ports;
    for (long row = from; row < to; row += BLOCK) {
        const double *at = z + (row / BLOCK) * columns * 2 * BLOCK;
        block re[8], im[8];
        for (int k = 0; k < count; k++) re[k] = im[k] = (block){0};
        for (long j = 0; j < columns; j++, at += 2 * BLOCK) {
            block zr = *(const block *)at, zi = *(const block *)(at + BLOCK);
            for (int k = 0; k < count; k++) {
                double a = s[k * stride_s + j], b = s[k * stride_s + columns + j];
                re[k] += zr * a - zi * b;
                im[k] += zr * b + zi * a;
            }
        }
        for (int k = 0; k < count; k++) {
            block *vr = (block *)(v + k * stride_v + row), *vi = (block *)(v + k * stride_v + r->rows + row);
            if (add) *vr += re[k], *vi += im[k];
            else *vr = re[k], *vi = im[k];
        }
    }
}

static void products(const struct run *r, const double *z, long count, const double *s, long stride_s, double *v,
                     long stride_v, long from, long to, int add)
{
    for (; count > 0; count -= 4, s += 4 * stride_s, v += 4 * stride_v) switch (count) {
        case 1: product(r, z, 1, s, stride_s, v, stride_v, from, to, add); break;
        case 2: product(r, z, 2, s, stride_s, v, stride_v, from, to, add); break;
        case 3: product(r, z, 3, s, stride_s, v, stride_v, from, to, add); break;
        default: product(r, z, 4, s, stride_s, v, stride_v, from, to, add);
        }
}

/* LU factors with row pivots, in place; 0 where the matrix is singular. */
static int factorise(double *a, long n, long *pivot)
{
    for (long k = 0; k < n; k++) {
        long best = k;
        for (long i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > fabs(a[best * n + k])) best = i;
        pivot[k] = best;
        if (!(fabs(a[best * n + k]) > 1e-14)) return 0;
        if (best != k)
            for (long j = 0; j < n; j++) {
                double swap = a[k * n + j];
                a[k * n + j] = a[best * n + j];
                a[best * n + j] = swap;
            }
        for (long i = k + 1; i < n; i++) {
            double factor = a[i * n + k] /= a[k * n + k];
            for (long j = k + 1; j < n; j++) a[i * n + j] -= factor * a[k * n + j];
        }
    }
    return 1;
}

static void back(const double *a, long n, const long *pivot, double *b)
{
    for (long k = 0; k < n; k++)
        if (pivot[k] != k) {
            double swap = b[k];
            b[k] = b[pivot[k]];
            b[pivot[k]] = swap;
        }
    for (long i = 0; i < n; i++)
        for (long j = 0; j < i; j++) b[i] -= a[i * n + j] * b[j];
    for (long i = n - 1; i >= 0; i--) {
        for (long j = i + 1; j < n; j++) b[i] -= a[i * n + j] * b[j];
        b[i] /= a[i * n + i];
    }
}

/* -- the network ----------------------------------------------------------------------------------------- */

static double z_entry(const struct run *r, long row, long column, int part)
{
    return r->network->z[((row / BLOCK) * r->ports + column) * 2 * BLOCK + part * BLOCK + row % BLOCK];
}

/* Slopes ds/dv of all coupled ports at these voltages: [port][2][2]. */
static void slopes(struct run *r, double t, const double *x, const double *v)
{
    const struct fleet *f = r->fleet;
    double *pack = r->pack;
    for (long g = 0, k = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        if (!group->reads_v) continue;
        group->call->source_by_v(group, t, x, v, pack);
        for (long i = 0; i < group->packs; i++)
            for (long lane = 0; lane < f->lanes; lane++, k++)
                for (int e = 0; e < 4; e++) r->by_v[4 * k + e] = pack[(i * 4 + e) * f->lanes + lane];
    }
}

/* Factors of 1 - Z ds/dv on the coupled ports. Entries of ds/dv stand column after column. */
static int factorise_ports(struct run *r)
{
    long c = r->coupled, n = 2 * c;
    for (long i = 0; i < c; i++)
        for (long j = 0; j < c; j++) {
            double zr = z_entry(r, r->coupled_port[i], r->coupled_port[j], 0);
            double zi = z_entry(r, r->coupled_port[i], r->coupled_port[j], 1);
            const double *by = r->by_v + 4 * j;
            for (int q = 0; q < 2; q++) {
                double a = by[2 * q], b = by[2 * q + 1];
                r->matrix[i * n + j + q * c] = (i == j && q == 0) - (zr * a - zi * b);
                r->matrix[(i + c) * n + j + q * c] = (i == j && q == 1) - (zr * b + zi * a);
            }
        }
    r->factored = factorise(r->matrix, n, r->pivot);
    return r->factored;
}

static void sources(struct run *r, long directions, double t, const struct state *x, struct moment *m, int coupled)
{
    const struct fleet *f = r->fleet;
    for (long g = 0; g < f->groups; g++)
        if (!coupled || f->group[g]->reads_v)
            f->group[g]->call->source(f->group[g], directions, t, x->x, x->xs, m->v, m->vs, m->s, m->ss);
}

/* Voltages at rows [0, rows) of Z from the states, with their derivatives; m->v holds a guess of the voltages
 * of coupled ports. Nonzero where there are none. */
static int voltages(struct run *r, double t, const struct state *x, struct moment *m, long from, long rows)
{
    long n = r->coupled, stride = 2 * r->rows, ports = 2 * r->ports, d = r->d;
    const double *z = r->network->z;
    if (n) {
        double last = INFINITY;
        int iteration = 0;
        sources(r, 0, t, x, m, 0);
        for (;; iteration++) {
            if (iteration == NEWTON) return 1;
            double *new = r->trial, worst = 0.0;
            products(r, z, 1, m->s, ports, new, stride, 0, r->ports, 0);
            for (long k = 0; k < n; k++) {
                long p = r->coupled_port[k];
                r->right[k] = new[p] - m->v[p];
                r->right[n + k] = new[r->rows + p] - m->v[r->rows + p];
                worst = fmax(worst, fmax(fabs(r->right[k]), fabs(r->right[n + k])));
            }
            if (!isfinite(worst)) return 1;
            if (worst < NEWTON_TOLERANCE) break;
            if (!r->factored || worst > SLOW * last) {
                slopes(r, t, x->x, m->v);
                if (!factorise_ports(r)) return 1;
            }
            last = worst;
            back(r->matrix, 2 * n, r->pivot, r->right);
            for (long k = 0; k < n; k++) {
                long p = r->coupled_port[k];
                m->v[p] += r->right[k];
                m->v[r->rows + p] += r->right[n + k];
            }
            sources(r, 0, t, x, m, 1);
        }
        if (d) { /* derivatives of the voltages of coupled ports, by the exact slopes */
            slopes(r, t, x->x, m->v);
            if (!factorise_ports(r)) return 1;
        }
    }
    if (!d) {
        if (!n) sources(r, 0, t, x, m, 0);
        products(r, z, 1, m->s, ports, m->v, stride, from, rows, 0);
        return 0;
    }
    if (n) {
        memset(m->vs, 0, d * stride * sizeof(double));
        sources(r, d, t, x, m, 0);
        products(r, z, 1, m->s, ports, m->v, stride, 0, rows, 0);
        products(r, z, d, m->ss, ports, m->vs, stride, 0, r->ports, 0);
        for (long k = 0; k < d; k++) {
            if (r->network->dz && r->network->dz[k])
                products(r, r->network->dz[k], 1, m->s, ports, m->vs + k * stride, stride, 0, r->ports, 1);
            for (long c = 0; c < n; c++) {
                r->right[c] = m->vs[k * stride + r->coupled_port[c]];
                r->right[n + c] = m->vs[k * stride + r->rows + r->coupled_port[c]];
            }
            back(r->matrix, 2 * n, r->pivot, r->right);
            for (long c = 0; c < n; c++) {
                m->vs[k * stride + r->coupled_port[c]] = r->right[c];
                m->vs[k * stride + r->rows + r->coupled_port[c]] = r->right[n + c];
            }
        }
        sources(r, d, t, x, m, 1);
        from = 0;
    } else {
        sources(r, d, t, x, m, 0);
        products(r, z, 1, m->s, ports, m->v, stride, from, rows, 0);
    }
    products(r, z, d, m->ss, ports, m->vs, stride, from, rows, 0);
    for (long k = 0; k < d; k++)
        if (r->network->dz && r->network->dz[k])
            products(r, r->network->dz[k], 1, m->s, ports, m->vs + k * stride, stride, from, rows, 1);
    return 0;
}

static int rates(struct run *r, double t, const struct state *x, struct moment *m)
{
    if (voltages(r, t, x, m, 0, r->ports)) return 1;
    const struct fleet *f = r->fleet;
    for (long g = 0; g < f->groups; g++)
        f->group[g]->call->flow(f->group[g], r->d, t, x->x, x->xs, m->v, m->vs, m->f, m->fs);
    return 0;
}

/* -- steps ----------------------------------------------------------------------------------------------- */

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
    if (r->coupled) memcpy(r->k[s].v, r->k[s - 1].v, r->size_v * sizeof(double));
    return rates(r, r->t + NODE[s] * r->h, into, &r->k[s]);
}

static inline double larger(double a, double b)
{
    a = fabs(a), b = fabs(b);
    return a > b ? a : b;
}

static inline double over_of(const struct run *r, long i)
{
    const struct options *o = r->options;
    double e = ERROR[0] * r->k[0].f[i];
    for (int j = 2; j < STAGES; j++) e += ERROR[j] * r->k[j].f[i];
    return fabs(r->h * e) / (o->atol + o->rtol * larger(r->now.x[i], r->next.x[i]));
}

/* Largest error of a step, in states [from, to), over its tolerance; no number where one is none. */
static double error_in(const struct run *r, long from, long to)
{
    double most[BLOCK] = {0}, sum[BLOCK] = {0}, worst = 0.0, all = 0.0;
    long i = from;
    for (; i + BLOCK <= to; i += BLOCK)
        for (int l = 0; l < BLOCK; l++) {
            double over = over_of(r, i + l);
            most[l] = over > most[l] ? over : most[l];
            sum[l] += over;
        }
    for (; i < to; i++) sum[i % BLOCK] += over_of(r, i), most[i % BLOCK] = larger(most[i % BLOCK], over_of(r, i));
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
        long from = group->first_state, to = from + group->packs * group->nx * f->lanes;
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
            long each = group->nx * f->lanes, at = group->first_state * r->d;
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
 * end, so that their states differ by what the fastest motion makes of them. */
static double fastest(const struct run *r)
{
    const struct fleet *f = r->fleet;
    double most = 0.0;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        for (long pack = 0; pack < group->packs; pack++) {
            double rate[BLOCK] = {0}, state[BLOCK] = {0};
            long at = group->first_state + pack * group->nx * f->lanes;
            for (long i = 0; i < group->nx; i++, at += f->lanes)
                for (long l = 0; l < f->lanes; l++) {
                    double df = r->k[STAGES - 1].f[at + l] - r->k[STAGES - 2].f[at + l];
                    double dx = r->next.x[at + l] - r->stage.x[at + l];
                    rate[l] += df * df, state[l] += dx * dx;
                }
            for (long l = 0; l < f->lanes; l++)
                if (state[l] > 1e-24 && rate[l] > most * state[l]) most = rate[l] / state[l];
        }
    }
    return sqrt(most);
}

static void dense_of(const struct run *r, long n, const double *x, const double *x1, double *const *k, double *c)
{
    for (long i = 0; i < n; i++) {
        double sum = LAST_TERM[0] * k[0][i];
        for (int j = 2; j < STAGES; j++) sum += LAST_TERM[j] * k[j][i];
        double change = x1[i] - x[i], bend = r->h * k[0][i] - change;
        c[i] = x[i];
        c[n + i] = change;
        c[2 * n + i] = bend;
        c[3 * n + i] = change - r->h * k[STAGES - 1][i] - bend;
        c[4 * n + i] = r->h * sum;
    }
}

static void dense_step(struct run *r)
{
    double *k[STAGES], *ks[STAGES];
    for (int j = 0; j < STAGES; j++) k[j] = r->k[j].f, ks[j] = r->k[j].fs;
    dense_of(r, r->n, r->now.x, r->next.x, k, r->dense);
    dense_of(r, r->ns, r->now.xs, r->next.xs, ks, r->denses);
}

static void dense_at(long n, const double *restrict c, double s, double *restrict x)
{
    double u = 1.0 - s;
    for (long i = 0; i < n; i++)
        x[i] = c[i] + s * (c[n + i] + u * (c[2 * n + i] + s * (c[3 * n + i] + u * c[4 * n + i])));
}

static void inside_at(struct run *r, double s)
{
    dense_at(r->n, r->dense, s, r->inside.x);
    dense_at(r->ns, r->denses, s, r->inside.xs);
}

/* -- events ---------------------------------------------------------------------------------------------- */

static double *guards_of(struct run *r, const struct group *g, long pack, double t, const struct state *x,
                         const struct moment *m)
{
    g->call->guards(g, pack, 0, t, x->x, x->xs, m->v, m->vs, r->guard, r->guards);
    return r->guard;
}

/* Largest value of guards that can fire or start a timer; which of them is positive first is what is sought. */
static double alarm(struct run *r, double t, const struct state *x, const struct moment *m)
{
    const struct fleet *f = r->fleet;
    double most = -INFINITY;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        if (!(group->rows + group->bounds)) continue;
        for (long pack = 0; pack < group->packs; pack++) {
            const double *value = guards_of(r, group, pack, t, x, m);
            for (long row = 0; row < group->rows + group->bounds; row++)
                for (long lane = 0; lane < f->lanes; lane++) {
                    double guard = value[row * f->lanes + lane];
                    if (row < group->rows) {
                        long a = group->row_automaton[row];
                        if (group->mode[(pack * group->na + a) * f->lanes + lane] != group->row_source[row])
                            continue;
                        if (isfinite(group->since[(pack * group->rows + row) * f->lanes + lane])) continue;
                    }
                    if (guard > most) most = guard;
                }
        }
    }
    return most;
}

/* First time in the last step at which an alarm is positive; r->inside and r->here are left there. */
static int locate(struct run *r, double *at)
{
    double low = 0.0, high = 1.0, g_low, g_high;
    if (r->coupled) memcpy(r->here.v, r->k[0].v, r->size_v * sizeof(double));
    inside_at(r, low);
    if (voltages(r, r->t, &r->inside, &r->here, 0, r->ports)) return 1;
    g_low = fmin(alarm(r, r->t, &r->inside, &r->here), 0.0);
    inside_at(r, high);
    if (voltages(r, r->t + r->h, &r->inside, &r->here, 0, r->ports)) return 1;
    g_high = alarm(r, r->t + r->h, &r->inside, &r->here);
    int side = 0;
    for (int i = 0; i < 100 && (high - low) * r->h > LOCATED; i++) {
        double middle = i % 4 == 3 || !isfinite(g_low) || g_high <= g_low
                            ? 0.5 * (low + high)
                            : (low * g_high - high * g_low) / (g_high - g_low);
        double least = 0.01 * (high - low);
        middle = fmin(fmax(middle, low + fmin(least, 0.5 * LOCATED / r->h)), high - fmin(least, 0.5 * LOCATED / r->h));
        inside_at(r, middle);
        if (voltages(r, r->t + middle * r->h, &r->inside, &r->here, 0, r->ports)) return 1;
        double g = alarm(r, r->t + middle * r->h, &r->inside, &r->here);
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
    inside_at(r, high);
    if (voltages(r, r->t + high * r->h, &r->inside, &r->here, 0, r->ports)) return 1;
    *at = high;
    return 0;
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
    long lanes = r->fleet->lanes;
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

static int failed(struct run *r, int status, double t, long g, long unit, long row, double amount)
{
    struct record *record = r->record;
    record->t = t, record->group = g, record->unit = unit, record->row = row, record->amount = amount;
    return status;
}

/* Derivatives of states along time, in the layout of derivatives by one direction, belong to no parameter. */
static void along_time(const struct run *r, int on)
{
    for (long g = 0; g < r->fleet->groups; g++) r->fleet->group[g]->along = on;
}

/* Derivative of the time at which a guard crosses zero: -(dg/dtheta) / (dg/dt); r->here holds the moment. */
static int crossing(struct run *r, const struct group *g, long row, long pack, long lane)
{
    long d = r->d, lanes = r->fleet->lanes, all = g->rows + g->bounds;
    struct state moving = {r->now.x, r->stage.xs};
    struct network still = {r->network->z, 0};
    const struct network *network = r->network;
    memcpy(moving.xs, r->here.f, r->n * sizeof(double));
    memcpy(r->there.v, r->here.v, r->size_v * sizeof(double));
    along_time(r, 1);
    r->d = 1, r->network = &still;
    int bad = voltages(r, r->t, &moving, &r->there, 0, r->ports);
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
        long each = group->nx * fleet->lanes;
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
    long lanes = r->fleet->lanes, a = group->row_automaton[row], d = r->d;
    if (d) {
        if (rates(r, r->t, &r->now, &r->here)) return NO_VOLTAGE;
        if (!r->dt_known && crossing(r, group, row, pack, lane)) return NO_VOLTAGE;
        shift_by(r, r->here.f, 1.0, r->dt);
    }
    if (group->row_resets[row]) {
        if (voltages(r, r->t, &r->now, &r->here, 0, r->ports)) return NO_VOLTAGE;
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

/* Everything that is due at r->t: rows that fire, timers that start or lapse. Where r->dt is not known, the instant
 * is that of a located crossing. */
static int settle(struct run *r)
{
    const struct fleet *f = r->fleet;
    for (int jumps = 0;; jumps++) {
        int fired = 0;
        if (voltages(r, r->t, &r->now, &r->here, 0, r->ports)) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
        for (long g = 0; g < f->groups && !fired; g++) {
            const struct group *group = f->group[g];
            if (!(group->rows + group->bounds)) continue;
            for (long pack = 0; pack < group->packs && !fired; pack++) {
                const double *value = guards_of(r, group, pack, r->t, &r->now, &r->here);
                for (long row = group->rows; row < group->rows + group->bounds; row++)
                    for (long lane = 0; lane < f->lanes; lane++)
                        if (value[row * f->lanes + lane] > 0.0)
                            return failed(r, LEFT_BOUNDS, r->t, g, pack * f->lanes + lane, row - group->rows, 0);
                for (long row = 0; row < group->rows && !fired; row++)
                    for (long lane = 0; lane < f->lanes && !fired; lane++) {
                        long a = group->row_automaton[row];
                        if (group->mode[(pack * group->na + a) * f->lanes + lane] != group->row_source[row])
                            continue;
                        double *since = &group->since[(pack * group->rows + row) * f->lanes + lane];
                        double held = group->held[(pack * group->rows + row) * f->lanes + lane];
                        int was = isfinite(*since);
                        if (value[row * f->lanes + lane] <= 0.0 && !(was && r->t >= *since + held - SAME_INSTANT)) {
                            *since = INFINITY;
                            continue;
                        }
                        long at = (pack * r->d * group->rows + row) * f->lanes + lane, step = group->rows * f->lanes;
                        if (!was && held > 0.0) {
                            *since = r->t;
                            if (r->d) {
                                if (!r->dt_known && (rates(r, r->t, &r->now, &r->here) ||
                                                     crossing(r, group, row, pack, lane)))
                                    return failed(r, NO_VOLTAGE, r->t, g, pack * f->lanes + lane, row, 0);
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
                            return failed(r, CHATTER, r->t, g, pack * f->lanes + lane, row, 0);
                        int status = jump(r, g, row, pack, lane);
                        if (status) return failed(r, status, r->t, g, pack * f->lanes + lane, row, 0);
                        note(r, r->t, g, row, pack * f->lanes + lane);
                        fired = 1;
                    }
            }
        }
        if (!fired) return COMPLETED;
    }
}

/* Time of the next timer that runs out. */
static double next_timer(const struct run *r)
{
    const struct fleet *f = r->fleet;
    double next = INFINITY;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        long count = group->packs * group->rows * f->lanes;
        for (long k = 0; k < count; k++) {
            double due = group->since[k] + group->held[k];
            if (due < next) next = due;
        }
    }
    return next;
}

/* Whether a timer that runs has lost its guard at the end of the step. */
static int lapses(struct run *r, double t, const struct state *x, const struct moment *m)
{
    const struct fleet *f = r->fleet;
    int any = 0;
    for (long g = 0; g < f->groups; g++) {
        const struct group *group = f->group[g];
        long count = group->packs * group->rows * f->lanes;
        int running = 0;
        for (long k = 0; k < count; k++) running |= isfinite(group->since[k]);
        if (!running) continue;
        for (long pack = 0; pack < group->packs; pack++) {
            const double *value = guards_of(r, group, pack, t, x, m);
            for (long k = 0; k < group->rows * f->lanes; k++) {
                double *since = &group->since[pack * group->rows * f->lanes + k];
                if (isfinite(*since) && value[k] <= 0.0) *since = INFINITY, any = 1;
            }
        }
    }
    return any;
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
            for (long pack = 0; pack < group->packs; pack++)
                for (long lane = 0; lane < f->lanes; lane++) {
                    double m = group->inertia[pack * f->lanes + lane];
                    double angle = r->now.x[group->first_state + (pack * group->nx + group->angle) * f->lanes + lane];
                    if (!pass) sum += m * angle, weight += m;
                    else if (m > 0 && fabs(angle - sum / weight) > r->options->out_of_step) {
                        *in_group = g, *away = angle - sum / weight;
                        return pack * f->lanes + lane;
                    }
                }
        }
    return -1;
}

/* -- the run --------------------------------------------------------------------------------------------- */

static int sample(struct run *r, double t, const struct state *x, struct moment *m)
{
    if (voltages(r, t, x, m, r->ports, r->rows)) return 1;
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

static int stretch_run(struct run *r, const struct stretch *s)
{
    const struct options *o = r->options;
    long next_sample = 0;
    r->network = s->network;
    r->factored = 0;
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
        double limit = fmin(s->to, next_timer(r));
        double free_step = r->h;
        int cut = 0;
        if (r->h > o->longest) r->h = free_step = o->longest;
        if (r->t + 1.0001 * r->h >= limit) r->h = limit - r->t, cut = 1;
        int bad = 0;
        for (int k = 1; k < STAGES && !bad; k++) bad = stage(r, k);
        double error = bad ? INFINITY : error_of(r);
        if (!(error <= 1.0)) {
            r->record->rejected++;
            r->h *= isfinite(error) ? fmax(0.2, 0.9 * pow(error, -0.2)) : 0.2;
            if (r->h < 1e-10) return failed(r, isfinite(error) ? STEP_TOO_SMALL : NO_VOLTAGE, r->t, 0, 0, 0, 0);
            continue;
        }
        r->record->steps++;
        double grow = 0.9 * pow(fmax(error, 1e-8), -0.14) * pow(r->error_before, 0.08);
        r->error_before = fmax(error, 1e-4);
        double next_h = (cut ? fmax(free_step, r->h) : r->h) * fmin(5.0, fmax(0.2, grow));
        next_h = fmin(next_h, REACH / fastest(r));
        dense_step(r);
        double end = 1.0;
        int event = alarm(r, r->t + r->h, &r->next, &r->k[STAGES - 1]) > 0.0;
        if (event && locate(r, &end)) return failed(r, NO_VOLTAGE, r->t, 0, 0, 0, 0);
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
        if (r->t >= next_timer(r) - SAME_INSTANT) restart = 1;
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
    return vectors + DENSE * (r->n + r->ns) + guards * (1 + sensitive) + 2 * n + n * n + n + r->size_v +
           4 * r->ports + r->d + 8 * 128; /* each vector begins on its own cache line */
}

int fleet_run(const struct fleet *f, const struct options *o, long stretches, const struct stretch *s, double *x,
              double *xs, double *v_start, struct record *record)
{
    struct run r = {.fleet = f, .options = o, .record = record};
    r.n = f->states, r.d = f->directions, r.ns = r.n * r.d, r.ports = f->ports, r.points = f->points;
    r.rows = f->ports + ((f->points + BLOCK - 1) / BLOCK) * BLOCK;
    r.size_v = 2 * r.rows;
    long guards = 0;
    for (long g = 0; g < f->groups; g++) {
        long all = (f->group[g]->rows + f->group[g]->bounds) * f->lanes;
        guards = all > guards ? all : guards;
        if (f->group[g]->reads_v) r.coupled += f->group[g]->packs * f->lanes;
    }
    long sensitive = r.d > 0 ? r.d : 1;
    long total = count_memory(&r, guards + 8, sensitive);
    if (posix_memalign((void **)&r.memory, 64, total * sizeof(double))) return NO_MEMORY;
    memset(r.memory, 0, total * sizeof(double));
    r.pivot = malloc((2 * r.coupled + 1) * sizeof(long));
    r.coupled_port = malloc((r.coupled + 1) * sizeof(long));
    if (!r.pivot || !r.coupled_port) {
        free(r.memory), free(r.pivot), free(r.coupled_port);
        return NO_MEMORY;
    }
    for (long g = 0, k = 0; g < f->groups; g++)
        for (long i = 0; f->group[g]->reads_v && i < f->group[g]->packs * f->lanes; i++)
            r.coupled_port[k++] = f->group[g]->first_port + i;
    double *at = r.memory;
    struct state *states[] = {&r.now, &r.next, &r.stage, &r.inside};
    for (int k = 0; k < 4; k++) states[k]->x = take(&at, r.n), states[k]->xs = take(&at, r.d ? r.ns : 0);
    for (int k = 0; k < STAGES + 2; k++) {
        struct moment *m = k < STAGES ? &r.k[k] : k == STAGES ? &r.here : &r.there;
        m->f = take(&at, r.n), m->fs = take(&at, r.ns), m->s = take(&at, 2 * r.ports);
        m->ss = take(&at, r.d * 2 * r.ports), m->v = take(&at, r.size_v), m->vs = take(&at, r.d * r.size_v);
    }
    r.dense = take(&at, DENSE * r.n), r.denses = take(&at, DENSE * r.ns);
    r.guard = take(&at, guards + 8), r.guards = take(&at, (guards + 8) * sensitive);
    r.by_v = take(&at, 4 * r.coupled), r.matrix = take(&at, 4 * r.coupled * r.coupled);
    r.right = take(&at, 2 * r.coupled), r.trial = take(&at, r.size_v), r.pack = take(&at, 4 * r.ports);
    r.scale = take(&at, r.d);
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
    free(r.memory), free(r.pivot), free(r.coupled_port);
    return status;
}
