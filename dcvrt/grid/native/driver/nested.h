/* A step of machines inside which facilities take three steps of their own.
 *
 * Machines M take one step of the pair, of length h, facilities F three links of length h/3. Sources of machines are
 * functions of their states alone, s_M(x_M), so that once the states of a stage are known, so is what drives the ports
 * of facilities there:
 *
 *     u_k = Z_FM s_M(x_M,k),     V_F = u + Z_FF s_F(x_F),     V_M,k = Z_MM s_M,k + Z_MF s_F,k.
 *
 * The nodes of the pair fall on nodes of the links,
 *
 *     2/9 = 0 + 2/3 . 1/3,   1/3 = end of the first,   5/9 = 1/3 + 2/3 . 1/3,   2/3 = end of the second,   1,
 *
 * so that links and step are interleaved: the machines' stage k is moved first, u(t) becomes the polynomial that meets
 * u_0, its slope there and the u of all stages known, the links go on to c_k, and s_F goes from there into the rates of
 * the machines. In stage 1 all states lie on the tangent, as in the pair; u_1 gives the slope, and the first link is made
 * once u_2 is known. On a link, the states at 2/3 are those of Simpson's rule and those at the end, before the last u is
 * known, those of the pair: the states of its stages themselves err too much where a lag is stiff.
 *
 * Where facilities follow u at once, each stage has the s_F of its own u, and the order is that of the pair. What they
 * remember of u on the way has errors of order 3, small by the impedances between M and F; it differs from stage to
 * stage, so that the estimate of the machines' step sees it, and refuses or shortens the step.
 *
 * A step is made so while machines move, where it may be `worth` times as long as one of all units. It needs sources of
 * machines that do not depend on their voltage, and carries no derivatives.
 */
#ifndef DCVRT_NESTED_H
#define DCVRT_NESTED_H

#include "steps.h"

/* By stage of the machines: the link on which it lies, and the stage of it. */
static const int LINK_OF[STAGES] = {0, 0, 0, 1, 1, 2, 2}, STAGE_OF[STAGES] = {0, 4, 6, 4, 6, 5, 6};

/* Weights of the rates of a link in its states at 2/3: Simpson's rule. */
static const double SIMPSON[5] = {1. / 9, 0.0, 4. / 9, 0.0, 1. / 9};

/* Weights of u of the machines' stages in its polynomial at `at`, stages to `last` being known: a Hermite node at 0,
 * whose slope is that towards u_1, and the nodes of later stages, the last but one being left for the last. */
static void drive_weights(int last, double at, double *w)
{
    int count = 0, of[STAGES];
    double slope = at, value = 1.0, sum = 0.0;
    for (int k = 2; k <= last; k++)
        if (k < STAGES - 2 || k == last) of[count++] = k;
    for (int i = 0; i < count; i++) {
        double factor = 1.0 - at / NODE[of[i]];
        slope *= factor, value *= factor, sum += 1.0 / NODE[of[i]];
    }
    value *= 1.0 + at * sum;
    for (int k = 0; k < STAGES; k++) w[k] = 0.0;
    w[0] = value - slope / NODE[1], w[1] = slope / NODE[1];
    for (int j = 0; j < count; j++) {
        double own = NODE[of[j]], weight = at / own * (at / own);
        for (int i = 0; i < count; i++)
            if (i != j) weight *= (at - NODE[of[i]]) / (own - NODE[of[i]]);
        w[of[j]] = weight;
    }
}

static void all_drive_weights(struct run *r)
{
    for (int last = 1; last < STAGES; last++)
        for (int s = 1; s < STAGES; s++)
            drive_weights(last, (LINK_OF[last] + NODE[s]) / LINKS, r->drive_weight[last][s]);
}

/* Rows of Z of the ports of quick units, in blocks of their own. */
static void quick_impedances(struct run *r)
{
    long feeds = r->fleet->feeds, first = feeds - r->quick_feeds;
    for (long i = 0; i < r->quick_rows; i++) {
        long row = first + (i < r->quick_feeds ? i : r->quick_feeds - 1);
        const double *from = r->network->z + row / BLOCK * feeds * 2 * BLOCK + row % BLOCK;
        double *into = r->z_quick + i / BLOCK * feeds * 2 * BLOCK + i % BLOCK;
        for (long e = 0; e < 2 * feeds; e++) into[e * BLOCK] = from[e * BLOCK];
    }
}

/* u += Z s of the sources of quick units, or of the others: [re, im][row]. */
static void add_driven(const struct run *r, const double *s, int quick, double *u)
{
    const struct fleet *f = r->fleet;
    for (long b = 0; b < r->quick_rows; b += BLOCK) {
        block *real = (block *)(u + b), *imaginary = (block *)(u + r->quick_rows + b);
        block re = *real, im = *imaginary, re_too = {0}, im_too = {0}; /* a sum waits for the one before it */
        for (long g = 0; g < f->groups; g++) {
            const struct group *group = f->group[g];
            if (group->quick != quick) continue;
            const double *own = s + group->first_port;
            const double *z = r->z_quick + (b / BLOCK * f->feeds + group->first_feed) * 2 * BLOCK;
            for (long j = 0; j < group->units; j++, z += 2 * BLOCK) {
                block zr = *(const block *)z, zi = *(const block *)(z + BLOCK);
                re += zr * own[j], im += zr * own[r->ports + j];
                re_too -= zi * own[r->ports + j], im_too += zi * own[j];
            }
        }
        re += re_too, im += im_too;
        *real = re, *imaginary = im;
    }
}

static void sources_of(struct run *r, int quick, double t, const double *x, struct moment *m)
{
    const struct fleet *f = r->fleet;
    for (long g = 0; g < f->groups; g++)
        if (f->group[g]->quick == quick) f->group[g]->call->source(f->group[g], 0, t, x, 0, m->v, 0, m->s, 0);
}

/* Sources of quick units, then their voltages, driven by u, then their rates. */
static void quick_rates(struct run *r, double t, const double *x, const double *u, struct moment *m, double *f)
{
    const struct fleet *fleet = r->fleet;
    long first = fleet->feeds - r->quick_feeds;
    double *v = r->driven + STAGES * 2 * r->quick_rows;
    memcpy(v, u, 2 * r->quick_rows * sizeof(double));
    sources_of(r, 1, t, x, m);
    add_driven(r, m->s, 1, v);
    for (long g = 0; g < fleet->groups; g++) {
        const struct group *group = fleet->group[g];
        if (!group->quick) continue;
        for (int part = 0; part < 2; part++) {
            const double *row = v + part * r->quick_rows + group->first_feed - first;
            double *own = m->v + part * r->rows + group->first_port;
            for (long i = 0; i < group->packs * group->lanes; i++)
                own[i] = row[i < group->units ? i : group->units - 1];
        }
        group->call->flow(group, 0, t, x, 0, m->v, 0, f, 0);
    }
}

/* Rates of stage s of the link on which the machines' stage `last` lies, all u to there being known. */
static void link_rates(struct run *r, int last, int s, const double *x, double *f)
{
    long size = 2 * r->quick_rows;
    double *u = r->driven + (STAGES + 1) * size;
    const double *w = r->drive_weight[last][s];
    for (long i = 0; i < size; i += BLOCK) {
        block sum = w[0] * *(const block *)(r->driven + i);
        for (int k = 1; k <= last; k++) sum += w[k] * *(const block *)(r->driven + k * size + i);
        *(block *)(u + i) = sum;
    }
    quick_rates(r, r->t + (LINK_OF[last] + NODE[s]) * r->h / LINKS, x, u, &r->there, f);
}

static void combine_quick(const struct run *r, const struct span *link, int s, double *into)
{
    combine_at(s, r->n - r->quick_states, r->n, link->h, link->x, link->f, into);
}

/* Moves the links on to where they meet the machines' stage k; the states there. */
static const double *links_to(struct run *r, int k)
{
    long slow = r->n - r->quick_states;
    struct span *link = &r->link[LINK_OF[k]];
    if (k == 1) {
        for (long i = slow; i < r->n; i++) link->next[i] = link->x[i] + NODE[1] * r->h * link->f[0][i];
        return link->next;
    }
    int met = k > 2 && LINK_OF[k] == LINK_OF[k - 1] ? STAGE_OF[k - 1] : 0, last = STAGE_OF[k];
    for (int s = met + 1; s <= last; s++) {
        double *into = s < STAGES - 1 ? link->before : link->next;
        combine_quick(r, link, s, into);
        link_rates(r, k, s, into, link->f[s]);
    }
    if (last == 4)
        for (long i = slow; i < r->n; i++) {
            double sum = SIMPSON[0] * link->f[0][i] + SIMPSON[2] * link->f[2][i] + SIMPSON[4] * link->f[4][i];
            link->next[i] = link->x[i] + link->h * sum;
        }
    else if (last == STAGES - 2) combine_quick(r, link, STAGES - 1, link->next);
    else if (k < STAGES - 1) /* the next link begins there */
        memcpy(link[1].f[0] + slow, link->f[last] + slow, r->quick_states * sizeof(double));
    return link->next;
}

static void nested_step(struct run *r)
{
    const struct fleet *f = r->fleet;
    long slow = r->n - r->quick_states, size = 2 * r->quick_rows, quick = r->quick_states * sizeof(double);
    struct span *link = r->link;
    memset(r->driven, 0, STAGES * size * sizeof(double));
    add_driven(r, r->k[0].s, 0, r->driven);
    for (int l = 0; l < LINKS; l++) link[l].h = r->h / LINKS;
    memcpy(link[0].x + slow, r->now.x + slow, quick);
    memcpy(link[0].f[0] + slow, r->k[0].f + slow, quick);
    for (int s = 1; s < STAGES; s++) {
        struct state *into = s < STAGES - 1 ? &r->stage : &r->next;
        struct moment *m = &r->k[s];
        double t = r->t + NODE[s] * r->h, *k[STAGES];
        for (int j = 0; j < s; j++) k[j] = r->k[j].f;
        combine_at(s, 0, slow, r->h, r->now.x, k, into->x);
        sources_of(r, 0, t, into->x, m);
        add_driven(r, m->s, 0, r->driven + s * size);
        sources_of(r, 1, t, links_to(r, s), m);
        if (r->near && s < STAGES - 1) products_near(r, &r->k[0], m);
        else products(r, r->network->z, 1, m->s, 2 * r->ports, m->v, 2 * r->rows, AT_PORTS, 0);
        for (long g = 0; g < f->groups; g++)
            if (!f->group[g]->quick) f->group[g]->call->flow(f->group[g], 0, t, into->x, 0, m->v, 0, m->f, 0);
    }
    memcpy(r->next.x + slow, link[LINKS - 1].next + slow, quick);
    memcpy(r->k[STAGES - 1].f + slow, link[LINKS - 1].f[STAGES - 1] + slow, quick);
}

#endif
