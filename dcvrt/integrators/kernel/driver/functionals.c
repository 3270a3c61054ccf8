/* Functionals of a track one by one: extrema and times here, integrals and sustained extrema in their headers. */
#include "functionals.h"

#include "curve.h"
#include "integral.h"
#include "sustained.h"

#include <stdlib.h>

#define TIE 1e-6 /* pu; minima closer than this at different places are a tie */
#define LOOKED_AT 1e-2 /* pu; a cubic is not further than this from the solution */

/* -- extrema ----------------------------------------------------------------------------------------- */

/* Value and derivative of the extremum at knot i: inside by the envelope theorem; a node moves with its time. */
static void at_knot(struct curve *c, long i, struct outcome *out)
{
    const struct track *track = c->track;
    long k = c->node[i];
    double rate;
    sharpen(c, i);
    out->time = c->t[i];
    out->place = c->between[i] ? PLACE_INSIDE : track->kind[k];
    if (!track->nw) {
        out->value = c->y[i];
        return;
    }
    exactly(c, k, out->time, &out->value, &rate, out->gradient, 0);
    for (int w = 0; !c->between[i] && w < track->nw; w++)
        out->gradient[w] += rate * node_slope(track, k, w);
}

static void plain_minimum(struct curve *c, struct outcome *out)
{
    int sharpened;
    do { /* the extrema of cubics that could be the lowest of the solution, or tie with it */
        double level = c->y[c->lowest];
        sharpened = 0;
        for (long i = 0; i < c->n; i++) {
            if (c->between[i] != OF_CUBIC || !(c->y[i] < level + LOOKED_AT))
                continue;
            double off = 2 * doubt(c, c->node[i]);
            if (off > 0.1 * TIE && c->y[i] <= level + TIE + off) {
                sharpen(c, i);
                sharpened = 1;
            }
        }
        if (sharpened)
            c->lowest = lowest_knot(c);
    } while (sharpened);
    /* a tie is another place as low, with something clearly higher on the way there */
    double level = c->y[c->lowest], highest = level;
    int seen = 0;
    for (long i = 0; i < c->n; i++) {
        if (c->y[i] <= level + TIE) {
            out->tie |= seen && highest > level + 2 * TIE;
            seen = 1;
            highest = level;
        }
        highest = higher(highest, c->y[i]);
    }
    at_knot(c, c->lowest, out);
}

/* -- sustained extrema ------------------------------------------------------------------------------- */

/* Begin of the window with y(a) = y(a + length) on the solution. */
static double polish_window(struct curve *c, const struct window *best, double length)
{
    const double *begin_t = c->track->t + c->node[best->begins], *end_t = c->track->t + c->node[best->ends];
    double a = best->begin;
    for (int k = 0; k < NEWTON_STEPS; k++) {
        double y_a, y_b, rate_a, rate_b;
        exactly(c, c->node[best->begins], a, &y_a, &rate_a, 0, 0);
        exactly(c, c->node[best->ends], a + length, &y_b, &rate_b, 0, 0);
        double step = (y_b - y_a) / (rate_b - rate_a), next = a - step;
        if (!(next >= begin_t[0] && next <= begin_t[1] && next + length >= end_t[0] && next + length <= end_t[1]))
            break;
        a = next;
        if (fabs(step) <= POLISHED)
            break;
    }
    return a;
}

/* Whether a knot holds the end of a window: a break, or an end of the run. */
static int holds(const struct curve *c, long i)
{
    return !c->between[i] && (c->track->brk[c->node[i]] >= 0 || c->node[i] == 0 ||
                              c->node[i] == c->track->n - 1);
}

static double within(double t, const double *node_t)
{
    return lower(higher(t, node_t[0]), node_t[1]);
}

/* Value and derivative of the level whose stretch lasts exactly the window. */
static void at_window(struct curve *c, const struct window *best, double length, struct scratch *s,
                      struct outcome *out)
{
    const struct track *track = c->track;
    int nw = track->nw, held = best->how != ENDS_FREE && holds(c, best->knot);
    long at_begin = c->node[best->begins], at_end = c->node[best->ends];
    double y_a, y_b, rate_a, rate_b, a = best->begin;
    out->place = PLACE_WINDOW;
    if (held && best->how == END_HELD) {
        long k = c->node[best->knot];
        out->time = within(track->t[k] - length, track->t + at_begin);
        exactly(c, at_begin, out->time, &out->value, &rate_a, out->gradient, 0);
        for (int w = 0; w < nw; w++)
            out->gradient[w] += rate_a * node_slope(track, k, w);
        return;
    }
    if (held) {
        long k = c->node[best->knot];
        out->time = track->t[k];
        exactly(c, at_end, within(track->t[k] + length, track->t + at_end), &out->value, &rate_b,
                out->gradient, 0);
        for (int w = 0; w < nw; w++)
            out->gradient[w] += rate_b * node_slope(track, k, w);
        return;
    }
    a = out->time = polish_window(c, best, length);
    exactly(c, at_begin, within(a, track->t + at_begin), &y_a, &rate_a, s->a, 0);
    exactly(c, at_end, within(a + length, track->t + at_end), &y_b, &rate_b, s->b, 0);
    out->value = higher(y_a, y_b); /* the same, unless the polish met the end of an interval */
    for (int w = 0; w < nw; w++) /* flat at both ends: the level is that of the plateau */
        out->gradient[w] = rate_a != rate_b ? (rate_a * s->b[w] - rate_b * s->a[w]) / (rate_a - rate_b)
                                            : 0.5 * (s->a[w] + s->b[w]);
}

static void sustained(struct curve *c, double length, struct scratch *s, struct outcome *out)
{
    if (c->t[c->n - 1] - c->t[0] < length - SAME_LENGTH)
        return;
    struct window best = sustained_minimum(c, length);
    double off = doubt(c, c->node[best.how == AT_KNOT ? best.knot : best.begins]);
    if (best.how != AT_KNOT)
        off = higher(off, doubt(c, c->node[best.ends]));
    out->tie = several_stretches(c, best.level, TIE + 2 * off, length);
    if (best.how == AT_KNOT)
        at_knot(c, best.knot, out);
    else
        at_window(c, &best, length, s, out);
}

/* -- times below a level ----------------------------------------------------------------------------- */

struct level {
    double value, share; /* the level; the share of the first value that it is, or 0 */
    const double *first; /* [nw], derivative of the first value */
};

/* Time at which the curve passes the level on piece i, and its derivative. */
static double passes(struct curve *c, long i, const struct level *level, struct scratch *s, double *moved)
{
    const struct track *track = c->track;
    long k = c->node[i];
    if (!(c->t[i + 1] > c->t[i])) {
        for (int w = 0; w < track->nw; w++)
            moved[w] = node_slope(track, k, w);
        return c->t[i];
    }
    double y, rate, t = polish_level(c, i, level->value, meets(c, i, level->value));
    if (!track->nw)
        return t;
    exactly(c, k, t, &y, &rate, s->a, 0);
    for (int w = 0; w < track->nw; w++) /* a level that is only touched has no derivative */
        moved[w] = rate != 0 ? -(s->a[w] - level->share * level->first[w]) / rate : NAN;
    return t;
}

/* Total time below a level, or (`span`) from the first fall below it to the last return above it. */
static void time_below(struct curve *c, const struct level *level, int span, struct scratch *s,
                       struct outcome *out)
{
    int nw = c->track->nw, below = c->y[0] < level->value, fell = below;
    long last = c->n - 1, returned = -1;
    double total = below ? -c->t[0] : 0.0;
    for (long i = 0; i < last; i++) {
        int after = c->y[i + 1] < level->value;
        if (after == below)
            continue;
        below = after;
        if (!after && span) {
            returned = i; /* only the last return counts, and is located below */
        } else if (!(span && fell)) {
            double sign = after ? -1.0 : 1.0;
            total += sign * passes(c, i, level, s, s->b);
            for (int w = 0; w < nw; w++)
                out->gradient[w] += sign * s->b[w];
        }
        fell |= after;
    }
    if (span && below) {
        total = INFINITY;
        for (int w = 0; w < nw; w++)
            out->gradient[w] = NAN;
    } else if (below) {
        total += c->t[last];
    } else if (span && returned >= 0) {
        total += passes(c, returned, level, s, s->b);
        for (int w = 0; w < nw; w++)
            out->gradient[w] += s->b[w];
    }
    out->value = total;
}

/* -- all of them ------------------------------------------------------------------------------------- */

/* Lay curve and scratch out in the workspace; 0 if there is no memory. */
static int workspace_ready(struct workspace *workspace, const struct track *track, struct curve *c,
                           struct scratch *s)
{
    unsigned long knots = 3 * (unsigned long)track->n, nw = track->nw, m = 1 + nw, ny = track->ny;
    unsigned long nodes = (unsigned long)track->n, doubles = 3 * knots + 2 * nodes + 2 * ny * m + 3 * nw + 12 * m;
    unsigned long size = doubles * sizeof(double) + 2 * knots * sizeof(long) + knots + nodes;
    if (workspace->size < size) {
        free(workspace->memory);
        workspace->size = 2 * size;
        workspace->memory = malloc(workspace->size);
        if (!workspace->memory) {
            workspace->size = 0;
            return 0;
        }
    }
    double *d = workspace->memory;
    c->t = d, d += knots;
    c->y = d, d += knots;
    c->rate = d, d += knots;
    c->node_y = d, d += nodes;
    c->node_rate = d, d += nodes;
    c->outputs = d, d += 2 * ny * m;
    s->a = d, d += nw;
    s->b = d, d += nw;
    s->first = d, d += nw;
    s->left = d, d += m;
    s->left_rate = d, d += m;
    s->right = d, d += m;
    s->right_rate = d, d += m;
    s->sum = d, d += m;
    s->finer = d, d += m;
    s->third = d, d += m;
    s->size = d, d += m;
    s->total = d, d += m;
    s->middle = d, d += 2 * m;
    s->middle_rate = s->middle + m;
    d = workspace->memory;
    d += doubles;
    c->node = (long *)d;
    c->queue = c->node + knots;
    c->between = (unsigned char *)(c->queue + knots);
    c->turns = c->between + knots;
    return 1;
}

static int looks_for_high(int kind)
{
    return kind == FUNCTIONAL_MAXIMUM || kind == FUNCTIONAL_SUSTAINED_MAXIMUM || kind == FUNCTIONAL_TIME_ABOVE;
}

/* Value at the first node and its derivative. */
static void first_value(struct curve *c, double *value, double *theta)
{
    double rate;
    if (c->track->nw)
        exactly(c, 0, c->track->t[0], value, &rate, theta, 0);
    else
        at_node(c, 0, value, &rate);
}

static void compute(struct curve *c, const struct functional *what, struct scratch *s, struct outcome *out)
{
    struct level level = {c->sign * what->constant, 0.0, s->first};
    if (what->relative) {
        first_value(c, &level.value, s->first);
        level.share = what->constant;
        level.value *= level.share;
    } else {
        for (int w = 0; w < c->track->nw; w++)
            s->first[w] = 0;
    }
    switch (what->kind) {
    case FUNCTIONAL_INITIAL:
        first_value(c, &out->value, out->gradient);
        break;
    case FUNCTIONAL_MINIMUM:
    case FUNCTIONAL_MAXIMUM:
        plain_minimum(c, out);
        break;
    case FUNCTIONAL_SUSTAINED_MINIMUM:
    case FUNCTIONAL_SUSTAINED_MAXIMUM:
        if (what->constant > 0)
            sustained(c, what->constant, s, out);
        else
            plain_minimum(c, out);
        break;
    case FUNCTIONAL_TIME_BELOW:
    case FUNCTIONAL_TIME_ABOVE:
        time_below(c, &level, 0, s, out);
        break;
    case FUNCTIONAL_INTEGRAL:
    case FUNCTIONAL_POSITIVE_INTEGRAL:
        if (c->track->nw)
            integral(c, what->kind == FUNCTIONAL_POSITIVE_INTEGRAL, s, out);
        else
            out->value = integral_of_cubics(c, what->kind == FUNCTIONAL_POSITIVE_INTEGRAL);
        break;
    case FUNCTIONAL_RECOVERY_TIME:
        time_below(c, &level, 1, s, out);
        break;
    }
    if (what->kind == FUNCTIONAL_MAXIMUM || what->kind == FUNCTIONAL_SUSTAINED_MAXIMUM) {
        out->value = -out->value;
        for (int w = 0; w < c->track->nw; w++)
            out->gradient[w] = -out->gradient[w];
    }
}

int functionals_of(const struct track *track, const struct functional *what, int count,
                   struct workspace *workspace, struct functional_results *results)
{
    struct curve curve = {.track = track, .signal = -1};
    struct track still = *track; /* the same without derivatives */
    still.nw = 0;
    struct scratch scratch;
    int known = 0, finite = 0, nw = track->nw;
    if (!workspace_ready(workspace, track, &curve, &scratch))
        return FUNCTIONALS_NO_MEMORY;
    for (int k = 0; k < count; k++) {
        double sign = looks_for_high(what[k].kind) ? -1.0 : 1.0;
        if (curve.signal != what[k].signal || curve.per != what[k].per || curve.sign != sign) {
            curve.signal = what[k].signal;
            curve.per = what[k].per;
            curve.sign = sign;
            known = 0;
        }
        int first_only = what[k].kind == FUNCTIONAL_INITIAL;
        if (!first_only && !known) {
            finite = make_knots(&curve);
            known = 1;
        }
        struct outcome out = {NAN, NAN, results->gradient + k * nw, PLACE_NONE, 0};
        int usable = first_only || finite, gradient = usable && !what[k].value_only;
        for (int w = 0; w < nw; w++)
            out.gradient[w] = gradient ? 0.0 : NAN;
        curve.track = gradient ? track : &still;
        if (usable)
            compute(&curve, &what[k], &scratch, &out);
        for (int w = 0; w < nw && isnan(out.value); w++)
            out.gradient[w] = NAN;
        results->value[k] = out.value;
        results->time[k] = out.time;
        results->place[k] = (unsigned char)out.place;
        results->tie[k] = (unsigned char)out.tie;
    }
    return curve.failed ? FUNCTIONALS_NOT_EVALUATED : FUNCTIONALS_DONE;
}

void workspace_free(struct workspace *workspace)
{
    free(workspace->memory);
    workspace->memory = 0;
    workspace->size = 0;
}
