/* Integral of a curve, or of its positive part. Without derivatives it is that of the cubics, which were seen to
 * meet the solution in their middles; with derivatives by theta they are further columns of one row.
 *
 * Over an interval it is that of the cubics, which the values and rates at its ends give, and what the change
 * of their third derivative from the interval before tells of the next term. Where that is large, the interval
 * is halved until the cubics agree.
 * A jump of the signal at a time that theta moves adds (y- - y+) dt/dtheta; a zero crossing adds nothing.
 */
#ifndef DCVRT_INTEGRAL_H
#define DCVRT_INTEGRAL_H

#include "curve.h"

/* Largest correction of an integral, over its span and the size of its integrand: what is left is well below. */
#define INTEGRATED 1e-6
#define SMALL_ERROR 1e-5 /* likewise without derivatives; a larger one tells nothing and is left out */
#define FINEST 64
#define NOISE 1e-7 /* of the largest value: what changes its sign below it is taken for zero */

/* Signal and its derivatives by theta, as one row, at a time on the interval from node k. */
static void signal_row(struct curve *c, long k, double t, double *value, double *rate)
{
    exactly(c, k, t, value, rate, value + 1, rate + 1);
}

/* Integral of the cubics through rows at two times. */
static void add_cubics(double h, int m, const double *y0, const double *r0, const double *y1,
                       const double *r1, double *sum)
{
    for (int w = 0; w < m; w++)
        sum[w] += 0.5 * h * (y0[w] + y1[w]) + h * h / 12 * (r0[w] - r1[w]);
}

/* Add the integral of the rows over [low, high] on the interval of node k; `left`, `right`: rows at its ends.
 * Halved until the cubics agree. */
static void add_finely(struct curve *c, long k, double low, double high, struct scratch *s, double *total)
{
    int m = 1 + c->track->nw, agree = 0;
    for (int w = 0; w < m; w++)
        s->sum[w] = 0;
    add_cubics(high - low, m, s->left, s->left_rate, s->right, s->right_rate, s->sum);
    for (int parts = 2; parts <= FINEST && !agree; parts *= 2) {
        double h = (high - low) / parts;
        for (int w = 0; w < m; w++)
            s->finer[w] = 0.5 * h * (s->left[w] + s->right[w]) + h * h / 12 * (s->left_rate[w] - s->right_rate[w]);
        for (int p = 1; p < parts; p++) { /* inside, the terms with the rates cancel */
            signal_row(c, k, low + p * h, s->middle, s->middle_rate);
            for (int w = 0; w < m; w++)
                s->finer[w] += h * s->middle[w];
        }
        agree = 1;
        for (int w = 0; w < m; w++) {
            double error = (s->finer[w] - s->sum[w]) / 15;
            agree &= fabs(error) <= INTEGRATED * (high - low) * s->size[w];
            s->sum[w] = s->finer[w] + error;
        }
        if (!agree)
            for (int w = 0; w < m; w++)
                s->sum[w] = s->finer[w];
    }
    for (int w = 0; w < m; w++)
        total[w] += s->sum[w];
}

/* Add the integral over the interval between the rows, with the fourth derivative that the change of the
 * third one tells (0 without an interval before). Where that is too large it tells nothing: 0 is returned, and
 * nothing added. */
static int add_interval(double h, double h_before, int m, struct scratch *s, double *total)
{
    int small = 1;
    for (int w = 0; w < m; w++) {
        double rise = s->right[w] - s->left[w];
        double third = 6 / (h * h) * (s->left_rate[w] + s->right_rate[w] - 2 * rise / h);
        double fourth = h_before > 0 ? 2 * (third - s->third[w]) / (h + h_before) : third / h;
        double error = fourth * h * h * h * h / 720;
        small &= fabs(error) <= INTEGRATED * s->size[w];
        s->third[w] = third;
        s->sum[w] = h_before > 0 ? error * h : 0.0;
    }
    if (!small)
        return 0;
    add_cubics(h, m, s->left, s->left_rate, s->right, s->right_rate, s->sum);
    for (int w = 0; w < m; w++)
        total[w] += s->sum[w];
    return 1;
}

/* Integral over the parts of one interval between nodes on which the signal is positive; `first` to `last`
 * are its knots. */
static void add_positive_parts(struct curve *c, long first, long last, struct scratch *s, double *total)
{
    long k = c->node[first];
    for (long i = first; i < last; i++) {
        double low = c->t[i], high = c->t[i + 1];
        if (c->y[i] <= 0 && c->y[i + 1] <= 0)
            continue;
        if (c->y[i] < 0)
            low = polish_level(c, i, 0.0, meets(c, i, 0.0));
        else if (c->y[i + 1] < 0)
            high = polish_level(c, i, 0.0, meets(c, i, 0.0));
        if (!(high > low))
            continue;
        signal_row(c, k, low, s->left, s->left_rate);
        signal_row(c, k, high, s->right, s->right_rate);
        add_finely(c, k, low, high, s, total);
    }
}

/* Integral over one piece of a cubic, or over the part on which it is positive. */
static double integral_of_piece(const struct curve *c, long i, int positive)
{
    double low = c->t[i], high = c->t[i + 1], sum = 0;
    double y0 = c->y[i], y1 = c->y[i + 1], rate0 = c->rate[i], rate1 = c->rate[i + 1];
    if (positive && y0 <= 0 && y1 <= 0)
        return 0;
    if (positive && y0 < 0)
        low = meets(c, i, 0.0), y0 = on_piece(c, i, low, &rate0);
    else if (positive && y1 < 0)
        high = meets(c, i, 0.0), y1 = on_piece(c, i, high, &rate1);
    add_cubics(high - low, 1, &y0, &rate0, &y1, &rate1, &sum);
    return sum;
}

/* Integral without derivatives: of the cubics, with the fourth derivative that the change of the third one tells. */
static double integral_of_cubics(const struct curve *c, int positive)
{
    double total = 0, size = 0, third_before = 0, h_before = 0;
    for (long i = 0, next; i + 1 < c->n; i = next) {
        int whole = 1;
        for (next = i + 1; c->between[next]; next++)
            whole &= c->y[next] >= 0;
        double h = c->t[next] - c->t[i], y0 = c->y[i], y1 = c->y[next];
        if (h > 0 && (!positive || (whole && y0 >= 0 && y1 >= 0))) {
            double third = 6 / (h * h) * (c->rate[i] + c->rate[next] - 2 * (y1 - y0) / h);
            double error = h_before > 0 ? 2 * (third - third_before) / (h + h_before) * h * h * h * h / 720 : 0;
            size = higher(size, fabs(y1));
            add_cubics(h, 1, &y0, c->rate + i, &y1, c->rate + next, &total);
            if (fabs(error) <= SMALL_ERROR * size)
                total += error * h;
            third_before = third;
            h_before = h;
        } else {
            for (long piece = i; piece < next && h > 0; piece++)
                total += integral_of_piece(c, piece, positive);
            h_before = 0;
        }
    }
    return total;
}

static void integral(struct curve *c, int positive, struct scratch *s, struct outcome *out)
{
    const struct track *track = c->track;
    int m = 1 + track->nw;
    double *total = s->total, *swap, h_before = 0;
    long loaded = -1; /* the node whose row is in `left` */
    double noise = 0;
    for (int w = 0; w < m; w++)
        total[w] = s->size[w] = 0;
    for (long i = 0; i < c->n; i++)
        noise = higher(noise, NOISE * fabs(c->y[i]));
    for (long k = 0, i = 0, next; k < track->n - 1; k++, i = next) {
        double low = c->y[i], high = c->y[i];
        next = i;
        do {
            next++;
            low = lower(low, c->y[next]);
            high = higher(high, c->y[next]);
        } while (c->between[next]);
        double h = track->t[k + 1] - track->t[k];
        if (!(h > 0)) { /* where the signal jumps, the integral moves with the time of the jump */
            double jump = positive ? higher(c->y[i], 0) - higher(c->y[next], 0) : c->y[i] - c->y[next];
            for (int w = 0; w < track->nw; w++)
                total[1 + w] += jump * node_slope(track, k, w);
            h_before = 0;
            continue;
        }
        if (positive && (high <= 0 || (low < 0 && high <= noise)))
            continue;
        if (positive && low < 0) {
            add_positive_parts(c, i, next, s, total);
            loaded = -1;
            h_before = 0;
            continue;
        }
        if (loaded != k) {
            signal_row(c, k, track->t[k], s->left, s->left_rate);
            h_before = 0;
        }
        signal_row(c, k + 1, track->t[k + 1], s->right, s->right_rate);
        for (int w = 0; w < m; w++) /* what is small beside the signal itself need not be small in itself */
            s->size[w] = higher(higher(s->size[w], fabs(s->right[w])), 1e-4 * s->size[0]);
        if (!add_interval(h, h_before, m, s, total))
            add_finely(c, k, track->t[k], track->t[k + 1], s, total);
        h_before = h;
        loaded = k + 1;
        swap = s->left, s->left = s->right, s->right = swap;
        swap = s->left_rate, s->left_rate = s->right_rate, s->right_rate = swap;
    }
    out->value = total[0];
    for (int w = 0; w < track->nw; w++)
        out->gradient[w] = total[1 + w];
}

#endif
