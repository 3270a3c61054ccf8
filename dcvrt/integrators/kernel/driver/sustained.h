/* The least level below which a curve stays for a whole window D: min over s of max over [s, s + D].
 *
 * While s and s + D each move on one monotone piece, the knots between them do not change, and with M their
 * maximum the function of s is max(M, y(s), y(s + D)). Only a falling begin and a rising end matter beside
 * M: a rising begin and a falling end are below a knot inside. So its minimum over such a stretch of s is M,
 * or the level at which y(s) = y(s + D), or that at which one end is held: at a jump, an event, an end of
 * the run. A bound from above, got by growing a stretch around the lowest knot, rules out nearly all of s.
 */
#ifndef DCVRT_SUSTAINED_H
#define DCVRT_SUSTAINED_H

#include "curve.h"

#define SAME_LENGTH 1e-12 /* s; a stretch shorter than the window by round-off of its ends still counts */

enum reached { AT_KNOT, ENDS_FREE, BEGIN_HELD, END_HELD };

struct window {
    double level, begin;
    enum reached how;
    long knot;       /* what the level is that of, or where the held end stands */
    long begins, ends; /* pieces of the two ends */
};

/* Smallest stretch of knots around the lowest one that grows to the lower side and lasts the window. */
static struct window grown_stretch(const struct curve *c, double length)
{
    long l = c->lowest, r = l, top = l;
    while (c->t[r] - c->t[l] < length) {
        int leftwards = r == c->n - 1 || (l > 0 && c->y[l - 1] < c->y[r + 1]);
        long next = leftwards ? --l : ++r;
        if (c->y[next] > c->y[top])
            top = next;
    }
    return (struct window){c->y[top], c->t[l], AT_KNOT, top, 0, 0};
}

/* Improve `best` by windows that begin between `from` and `to` on piece i and end on piece j; `top` is the
 * highest knot between, or -1; `end_first` tells whether at `to` it is the end that reaches its next knot. */
static void look(const struct curve *c, long i, long j, double from, double to, int end_first, long top,
                 double length, struct window *best)
{
    double unused, e1 = on_piece(c, i, to, &unused), f0 = on_piece(c, j, from + length, &unused);
    int falling = c->y[i] >= c->y[i + 1], rising = c->y[j + 1] >= c->y[j];
    if (i == j && falling)
        rising = 0;
    double highest = top >= 0 ? c->y[top] : -INFINITY;
    double bound = higher(highest, higher(falling ? e1 : -INFINITY, rising ? f0 : -INFINITY));
    if (!(bound < best->level))
        return;
    struct window found = {bound, from, AT_KNOT, top, i, j};
    if (falling && rising) {
        double e0 = on_piece(c, i, from, &unused), f1 = on_piece(c, j, to + length, &unused);
        if (f0 < e0 && e1 < f1) {
            struct crossing x = {i, j, 0.0, 0.0, length};
            found.begin = cross_between(c, &x, from, to);
            found.level = on_piece(c, i, found.begin, &unused);
            found.how = ENDS_FREE;
        } else if (f0 < e0) {
            rising = 0; /* the begin is the higher one on the whole stretch */
        } else {
            falling = 0;
        }
    }
    if (found.how != ENDS_FREE && falling) {
        found = (struct window){e1, to, end_first ? END_HELD : AT_KNOT, end_first ? j + 1 : i + 1, i, j};
    } else if (found.how != ENDS_FREE && rising) {
        int at_knot = from > c->t[i];
        found = (struct window){f0, from, at_knot ? AT_KNOT : BEGIN_HELD, at_knot ? j : i, i, j};
    }
    if (highest >= found.level)
        found = (struct window){highest, found.begin, AT_KNOT, top, i, j};
    if (found.level < best->level)
        *best = found;
}

/* Improve `best` by windows on the pieces between two knots. */
static void sweep(const struct curve *c, long first, long last, double length, struct window *best)
{
    const double *t = c->t, *y = c->y;
    long *queue = c->queue, head = 0, tail = 0; /* knots inside the window that may become its maximum */
    long i = first, j = first;
    double from = t[first];
    for (;;) {
        double begin_next = t[i + 1], end_next = t[j + 1] - length;
        int end_first = end_next <= begin_next;
        double to = end_first ? end_next : begin_next;
        long top = head < tail ? queue[head] : -1;
        if (to > from) {
            if (top < 0 || y[top] < best->level)
                look(c, i, j, from, to, end_first, top, length, best);
            from = to;
        }
        if (end_first) {
            if (++j >= last)
                return;
            while (tail > head && y[queue[tail - 1]] <= y[j])
                tail--;
            queue[tail++] = j;
        } else {
            i++;
            if (head < tail && queue[head] == i)
                head++;
        }
    }
}

static struct window sustained_minimum(const struct curve *c, double window)
{
    double length = window - SAME_LENGTH;
    struct window best = grown_stretch(c, length);
    double bound = best.level;
    long first = 0, last;
    for (; next_run(c, bound, 1, &first, &last); first = last + 1) {
        long before = first ? first - 1 : 0, after = last < c->n - 1 ? last + 1 : last;
        if (c->t[after] - c->t[before] >= length)
            sweep(c, before, after, length, &best);
    }
    return best;
}

/* Whether several stretches at or below the level (and `slack` above it) last the window. */
static int several_stretches(const struct curve *c, double level, double slack, double window)
{
    double length = window - SAME_LENGTH;
    int count = 0;
    long first = 0, last;
    level += slack;
    for (; next_run(c, level, 0, &first, &last); first = last + 1) {
        long before = first ? first - 1 : 0, after = last < c->n - 1 ? last + 1 : last;
        if (c->t[after] - c->t[before] < length)
            continue;
        double lasts = c->t[last] - c->t[first];
        if (lasts < length) {
            double begin = first ? meets(c, before, level) : c->t[0];
            double end = last < c->n - 1 ? meets(c, last, level) : c->t[last];
            lasts = end - begin;
        }
        count += lasts >= length;
    }
    return count > 1;
}

#endif
