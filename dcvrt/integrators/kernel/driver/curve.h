/* One signal of a track as cubics that are monotone between knots: the nodes, and the extrema between them.
 *
 * A minimum is sought on each curve; maxima are minima of the curve with `sign` = -1.
 */
#ifndef DCVRT_CURVE_H
#define DCVRT_CURVE_H

#include "functionals.h"

#include <float.h>
#include <math.h>

enum between { AT_NODE = 0, OF_CUBIC = 1, OF_SOLUTION = 2 };

struct curve {
    const struct track *track;
    int signal, per;
    double sign;
    double *node_y, *node_rate; /* [track->n], signal and rate at the nodes */
    unsigned char *turns;       /* [track->n], whether the cubic from a node on may have an extremum inside */
    long n;                 /* knots */
    long lowest;            /* the lowest knot */
    double *t, *y, *rate;   /* [n] */
    long *node;             /* [n], the node at a knot; the node before it where `between` */
    unsigned char *between; /* [n], whether the knot is an extremum between two nodes, enum between */
    long *queue;            /* [n], work space */
    double *outputs;        /* [2 * ny * (1 + nw)], what `evaluate` writes */
    int failed;             /* whether `evaluate` did */
};

struct outcome {
    double value, time, *gradient;
    int place, tie;
};

/* Rows of numbers in the workspace: [nw], and [1 + nw] for a signal with its derivatives. */
struct scratch {
    double *a, *b, *first;
    double *left, *left_rate, *right, *right_rate, *sum, *finer, *third, *size, *total;
    double *middle, *middle_rate; /* one row each */
};

#define NEWTON_STEPS 12
#define POLISHED 1e-9 /* s; a time that moved by less in a step of Newton's method is exact after it */

/* a / b with its derivative da, given those of a and b. */
static double quotient_slope(double quotient, double da, double b, double db)
{
    return (da - quotient * db) / b;
}

/* Signal and rate at a node. */
static void at_node(const struct curve *c, long k, double *y, double *rate)
{
    const struct track *track = c->track;
    const double *value = track->y + k * track->ny, *slope = track->rate + k * track->ny;
    *y = c->sign * value[c->signal];
    *rate = c->sign * slope[c->signal];
    if (c->per >= 0) {
        *y /= value[c->per];
        *rate = quotient_slope(*y, *rate, value[c->per], slope[c->per]);
    }
}

/* Signal and rate of the solution at a time from node k on; unless `theta` is null their derivatives too. */
static void exactly(struct curve *c, long k, double t, double *y, double *rate, double *theta,
                    double *rate_theta)
{
    const struct track *track = c->track;
    int ny = track->ny, nw = track->nw;
    double *value = c->outputs, *slope = value + ny, *by = slope + ny, *slope_by = by + ny * nw;
    int wanted = theta && nw;
    if (track->evaluate(track->context, track->step[k], t, value, slope, wanted ? by : 0,
                        wanted ? slope_by : 0))
        c->failed = 1;
    *y = c->sign * value[c->signal];
    *rate = c->sign * slope[c->signal];
    double below = 1.0, below_rate = 0.0;
    if (c->per >= 0) {
        below = value[c->per];
        below_rate = slope[c->per];
        *y /= below;
        *rate = quotient_slope(*y, *rate, below, below_rate);
    }
    for (int w = 0; wanted && w < nw; w++) {
        theta[w] = c->sign * by[c->signal * nw + w];
        double rate_w = c->sign * slope_by[c->signal * nw + w];
        if (c->per >= 0) {
            theta[w] = quotient_slope(*y, theta[w], below, by[c->per * nw + w]);
            rate_w = quotient_slope(*y, rate_w, below, slope_by[c->per * nw + w]);
            rate_w -= (*rate * by[c->per * nw + w] + theta[w] * below_rate) / below;
        }
        if (rate_theta)
            rate_theta[w] = rate_w;
    }
}

/* Value and rate at t of the cubic on piece i; the knots' own values at its ends. */
static double on_piece(const struct curve *c, long i, double t, double *rate)
{
    double h = c->t[i + 1] - c->t[i], s = h > 0 ? (t - c->t[i]) / h : 0.0;
    if (s <= 0 || s >= 1) {
        i += s >= 1;
        *rate = c->rate[i];
        return c->y[i];
    }
    double rise = c->y[i + 1] - c->y[i], m0 = c->rate[i] * h, m1 = c->rate[i + 1] * h;
    double c2 = 3 * rise - 2 * m0 - m1, c3 = m0 + m1 - 2 * rise;
    *rate = (m0 + s * (2 * c2 + 3 * s * c3)) / h;
    return c->y[i] + s * (m0 + s * (c2 + s * c3));
}

/* What rises through zero between two times: sense * (y - level) on one piece, or, where there is an
 * `other` piece, y(t + shift) - y(t). */
struct crossing {
    long piece, other; /* other < 0: none */
    double level, sense, shift;
};

static double crossing_value(const struct curve *c, const struct crossing *x, double t, double *slope)
{
    double rate, later_rate, y = on_piece(c, x->piece, t, &rate);
    if (x->other < 0) {
        *slope = x->sense * rate;
        return x->sense * (y - x->level);
    }
    double later = on_piece(c, x->other, t + x->shift, &later_rate);
    *slope = later_rate - rate;
    return later - y;
}

/* Root in [low, high] of what rises there from below zero to above it: Newton, bracketed. */
static double cross_between(const struct curve *c, const struct crossing *x, double low, double high)
{
    double slope, from = crossing_value(c, x, low, &slope), to = crossing_value(c, x, high, &slope);
    double t = to > from ? low - from * (high - low) / (to - from) : low;
    for (int k = 0; k < 80; k++) {
        if (!(t > low && t < high))
            t = 0.5 * (low + high);
        double value = crossing_value(c, x, t, &slope);
        if (value > 0)
            high = t;
        else
            low = t;
        double step = slope > 0 ? value / slope : high - low;
        if (fabs(step) <= 1e-15 * (1 + fabs(t)) || high - low <= 1e-15 * (1 + fabs(t)))
            return t;
        t -= step;
    }
    return t;
}

/* Time at which the cubic of piece i passes a level that lies between its ends. */
static double meets(const struct curve *c, long i, double level)
{
    if (!(c->t[i + 1] > c->t[i]))
        return c->t[i];
    struct crossing x = {i, -1, level, c->y[i + 1] > c->y[i] ? 1.0 : -1.0, 0.0};
    return cross_between(c, &x, c->t[i], c->t[i + 1]);
}

/* Signal and rate at all nodes, and where the cubics between them may turn; 0 if a number is not finite. */
static int lay_nodes(struct curve *c)
{
    const double *t = c->track->t;
    double *restrict y = c->node_y, *restrict rate = c->node_rate;
    unsigned char *restrict turns = c->turns;
    long n = c->track->n;
    int finite = 1;
    for (long k = 0; k < n; k++)
        at_node(c, k, y + k, rate + k);
    for (long k = 0; k < n; k++)
        finite &= (fabs(y[k]) <= DBL_MAX) & (fabs(rate[k]) <= DBL_MAX);
    for (long k = 0; k < n - 1; k++) {
        double h = t[k + 1] - t[k], rise = y[k + 1] - y[k], m0 = rate[k] * h, m1 = rate[k + 1] * h;
        int monotone = (rise * m0 >= 0) & (rise * m1 >= 0) & (higher(fabs(m0), fabs(m1)) <= 3 * fabs(rise));
        turns[k] = !monotone;
    }
    return finite;
}

/* Add the extrema of the cubic between nodes k and k + 1 as knots; `c->n` - 1 is the knot of node k. */
static void add_extrema(struct curve *c, long k)
{
    double h = c->track->t[k + 1] - c->track->t[k], y0 = c->node_y[k];
    double rise = c->node_y[k + 1] - y0, m0 = c->node_rate[k] * h, m1 = c->node_rate[k + 1] * h;
    double c2 = 3 * rise - 2 * m0 - m1, c3 = m0 + m1 - 2 * rise, square = c2 * c2 - 3 * c3 * m0;
    if (!(square > 0))
        return;
    double m = -(c2 + copysign(sqrt(square), c2)), s[2] = {m / (3 * c3), m0 / m};
    if (s[0] > s[1]) {
        double swap = s[0];
        s[0] = s[1];
        s[1] = swap;
    }
    for (int r = 0; r < 2; r++)
        if (s[r] > 1e-9 && s[r] < 1 - 1e-9) { /* false for what c3 = 0 or m = 0 makes of it */
            c->t[c->n] = c->track->t[k] + s[r] * h;
            c->y[c->n] = y0 + s[r] * (m0 + s[r] * (c2 + s[r] * c3));
            c->rate[c->n] = 0.0;
            c->node[c->n] = k;
            c->between[c->n++] = OF_CUBIC;
        }
}

static long lowest_knot(const struct curve *c)
{
    long low = 0;
    for (long i = 1; i < c->n; i++)
        if (c->y[i] < c->y[low])
            low = i;
    return low;
}

/* Knots of the curve; 0 if the signal is not finite everywhere. */
static int make_knots(struct curve *c)
{
    const struct track *track = c->track;
    c->n = 0;
    if (!lay_nodes(c))
        return 0;
    for (long k = 0, last = track->n - 1; k <= last; k++) {
        long i = c->n++;
        c->t[i] = track->t[k];
        c->y[i] = c->node_y[k];
        c->rate[i] = c->node_rate[k];
        c->node[i] = k;
        c->between[i] = AT_NODE;
        if (k < last && c->turns[k] && track->t[k + 1] > track->t[k])
            add_extrema(c, k);
    }
    c->lowest = lowest_knot(c);
    return 1;
}

/* First and last knot of the next run of knots below a level (or at it, unless `strictly`), from *first on. */
static int next_run(const struct curve *c, double level, int strictly, long *first, long *last)
{
    long i = *first;
    while (i < c->n && !(strictly ? c->y[i] < level : c->y[i] <= level))
        i++;
    *first = i;
    while (i < c->n && (strictly ? c->y[i] < level : c->y[i] <= level))
        i++;
    *last = i - 1;
    return *first < c->n;
}

/* Derivative of the time at which a node stands by theta w: not zero at events. */
static double node_slope(const struct track *track, long k, int w)
{
    return track->brk[k] >= 0 ? track->dbreak[track->brk[k] * track->nw + w] : 0.0;
}

/* Third derivative of the cubic between nodes k and k + 1; 0 where there is none. */
static double third_derivative(const struct curve *c, long k, double *h)
{
    const double *y = c->node_y + k, *rate = c->node_rate + k;
    *h = k >= 0 && k < c->track->n - 1 ? c->track->t[k + 1] - c->track->t[k] : 0.0;
    if (!(*h > 0))
        return 0.0;
    return 6 / (*h * *h) * (rate[0] + rate[1] - 2 * (y[1] - y[0]) / *h);
}

/* How far the cubic from node k on may be off the solution, from how its neighbours differ from it. */
static double doubt(const struct curve *c, long k)
{
    double h, h_left, h_right, here = third_derivative(c, k, &h);
    double left = third_derivative(c, k - 1, &h_left), right = third_derivative(c, k + 1, &h_right);
    double fourth = 0.0;
    if (h_left > 0)
        fourth = fabs(here - left) * 2 / (h + h_left);
    if (h_right > 0)
        fourth = higher(fourth, fabs(right - here) * 2 / (h + h_right));
    if (!(h_left > 0 || h_right > 0))
        fourth = h > 0 ? fabs(here) / h : 0.0;
    return fourth * h * h * h * h / 384;
}

/* Move an extremum of a cubic to that of the solution: root of the rate by secants. */
static void sharpen(struct curve *c, long i)
{
    if (c->between[i] != OF_CUBIC)
        return;
    double t = c->t[i], y = c->y[i], rate, before = 0;
    /* first the curvature of the cubic, from the piece on the right */
    double h = c->t[i + 1] - t, slope = (6 * (c->y[i + 1] - y) / h - 2 * c->rate[i + 1]) / h;
    for (int k = 0; k < NEWTON_STEPS; k++) {
        exactly(c, c->node[i], t, &y, &rate, 0, 0);
        if (k && rate != before)
            slope = (rate - before) / h;
        double step = slope != 0 ? rate / slope : 0.0;
        if (!(t - step > c->t[i - 1] && t - step < c->t[i + 1])) {
            t = c->t[i]; /* the solution has none where its cubic has one: too flat to matter */
            exactly(c, c->node[i], t, &y, &rate, 0, 0);
            break;
        }
        t -= step;
        if (fabs(step) <= POLISHED) { /* the value of the parabola: it moves by less than its round-off */
            y -= 0.5 * rate * step;
            break;
        }
        h = -step;
        before = rate;
    }
    c->t[i] = t;
    c->y[i] = y;
    c->between[i] = OF_SOLUTION;
}

/* Time at which the solution passes a level, from where the cubic of piece i does. */
static double polish_level(struct curve *c, long i, double level, double t)
{
    const double *node_t = c->track->t + c->node[i];
    for (int k = 0; k < NEWTON_STEPS; k++) {
        double y, rate;
        exactly(c, c->node[i], t, &y, &rate, 0, 0);
        double step = (y - level) / rate;
        if (!(t - step >= node_t[0] && t - step <= node_t[1]))
            break;
        t -= step;
        if (fabs(step) <= POLISHED)
            break;
    }
    return t;
}

#endif
