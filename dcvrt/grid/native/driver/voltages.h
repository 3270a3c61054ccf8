/* Voltages from states: V = Z s, by Newton's method where a source depends on its own voltage; rates from both. */
#ifndef DCVRT_VOLTAGES_H
#define DCVRT_VOLTAGES_H

#include "products.h"

enum { NEWTON = 30 };

#define NEWTON_TOLERANCE 1e-11
#define SLOW 0.1

/* -- linear algebra -------------------------------------------------------------------------------------- */

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

/* Re or im of Z between two coupled ports; those without a unit feed nothing. */
static double z_entry(const struct run *r, long to, long from, int part)
{
    long row = r->coupled_feed[to], feed = r->coupled_feed[from];
    if (from > 0 && r->coupled_feed[from - 1] == feed) return 0.0;
    return r->network->z[((row / BLOCK) * r->fleet->feeds + feed) * 2 * BLOCK + part * BLOCK + row % BLOCK];
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
            for (long lane = 0; lane < group->lanes; lane++, k++)
                for (int e = 0; e < 4; e++) r->by_v[4 * k + e] = pack[(i * 4 + e) * group->lanes + lane];
    }
}

/* Factors of 1 - Z ds/dv on the coupled ports. Entries of ds/dv stand column after column. */
static int factorise_ports(struct run *r)
{
    long c = r->coupled, n = 2 * c;
    for (long i = 0; i < c; i++)
        for (long j = 0; j < c; j++) {
            double zr = z_entry(r, i, j, 0);
            double zi = z_entry(r, i, j, 1);
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

/* Voltages at ports or points or both from the states, with their derivatives; m->v holds a guess of the voltages
 * of coupled ports. Nonzero where there are none. */
static int voltages(struct run *r, double t, const struct state *x, struct moment *m, int rows)
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
            products(r, z, 1, m->s, ports, new, stride, AT_PORTS, 0);
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
        products(r, z, 1, m->s, ports, m->v, stride, rows, 0);
        return 0;
    }
    if (n) {
        memset(m->vs, 0, d * stride * sizeof(double));
        rows |= AT_PORTS;
        sources(r, d, t, x, m, 0);
        products(r, z, 1, m->s, ports, m->v, stride, rows, 0);
        products(r, z, d, m->ss, ports, m->vs, stride, AT_PORTS, 0);
        for (long k = 0; k < d; k++) {
            if (r->network->dz && r->network->dz[k])
                products(r, r->network->dz[k], 1, m->s, ports, m->vs + k * stride, stride, AT_PORTS, 1);
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
    } else {
        sources(r, d, t, x, m, 0);
        products(r, z, 1, m->s, ports, m->v, stride, rows, 0);
    }
    products(r, z, d, m->ss, ports, m->vs, stride, rows, 0);
    for (long k = 0; k < d; k++)
        if (r->network->dz && r->network->dz[k])
            products(r, r->network->dz[k], 1, m->s, ports, m->vs + k * stride, stride, rows, 1);
    return 0;
}

static void flows(struct run *r, double t, const struct state *x, struct moment *m)
{
    const struct fleet *f = r->fleet;
    for (long g = 0; g < f->groups; g++)
        f->group[g]->call->flow(f->group[g], r->d, t, x->x, x->xs, m->v, m->vs, m->f, m->fs);
}

static int rates(struct run *r, double t, const struct state *x, struct moment *m)
{
    if (voltages(r, t, x, m, AT_PORTS)) return 1;
    flows(r, t, x, m);
    return 0;
}

/* Rates at a moment near one whose voltages are known. */
static void rates_near(struct run *r, double t, const struct state *x, const struct moment *known, struct moment *m)
{
    sources(r, 0, t, x, m, 0);
    products_near(r, known, m);
    flows(r, t, x, m);
}

#endif
