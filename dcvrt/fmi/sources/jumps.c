/* The automata: guards, timers, and the rows that lead from mode to mode. */

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "hybrid.h"

#define SAME_INSTANT 1e-9 /* s: jumps closer than this are at one instant; guards are judged this far ahead */
#define MAX_JUMPS_AT_ONCE 50

/* Whether the parameters are in order between them: what is tied to them is in its range, and there is hysteresis
   between every two modes that lead back and forth. */
bool hybrid_together(const struct hybrid *s, char *message, size_t size)
{
    double values[ROOM(NTOGETHER)];
    const double *inputs[] = {s->p}, *value = values;
    double *results[] = {values};
    model_together(inputs, results, NULL, NULL, 0);
    for (int k = 0; k < NTIED; ++k) {
        const struct tied *tied = &model_tied[k];
        double found = *value++;
        if (!(tied->low <= found && found <= tied->high)) {
            snprintf(message, size, "%s = %g %s is outside [%g, %g].", tied->what, found, tied->unit, tied->low,
                     tied->high);
            return false;
        }
    }
    for (int k = 0; k < NGAPS; ++k) {
        const struct gap *gap = &model_gaps[k];
        double width = *value++;
        if (!(width > 0.0)) {
            size_t used = (size_t)snprintf(message, size, "%s leave no gap between them (", gap->rows);
            for (int j = 0; j < gap->n_limits && used < size; ++j)
                used += (size_t)snprintf(message + used, size - used, "%s%s = %g", j ? ", " : "", gap->limits[j],
                                         value[j]);
            if (used < size)
                snprintf(message + used, size - used, "): the modes would chatter. Set the limit of the way back "
                         "beyond that of the way out.");
            return false;
        }
        value += gap->n_limits;
    }
    return true;
}

/* All clocks start, no timer runs. */
void hybrid_begin(struct hybrid *s)
{
    const double *inputs[] = {s->p};
    double *results[] = {s->held};
    model_held(inputs, results, NULL, NULL, 0);
    for (int k = 0; k < NA; ++k) s->entry[k] = s->t;
    for (int k = 0; k < NROWS; ++k) s->armed[k] = NAN;
    s->instant = -HUGE_VAL;
    s->known = false;
}

/* Whether a row leaves the mode that its automaton is in. */
bool hybrid_active(const struct hybrid *s, int row)
{
    return s->mode[model_rows[row].automaton] == model_rows[row].source;
}

/* Positive while a guard is true or a bound is left; rows of other modes are quiet. */
double hybrid_indicator(const struct hybrid *s, int k)
{
    return k < NROWS && !hybrid_active(s, k) ? -1.0 : s->h[k];
}

/* Which indicators are positive just after this instant. A tool that has located a zero is on either side of it
   by round-off: there the rate along the solution tells. How inputs go on is not known here, so that a guard
   which reads one is judged by its sign. */
static void positive_soon(const struct hybrid *s, bool *positive)
{
    struct direction d;
    memset(&d, 0, sizeof d);
    d.t = 1.0;
    memcpy(d.x, s->f, sizeof d.x);
    hybrid_move(s, &d, true);
    for (int k = 0; k < NH; ++k) {
        bool on_the_edge = !model_reads_input[k] && fabs(s->h[k]) <= fabs(d.h[k]) * SAME_INSTANT;
        positive[k] = on_the_edge ? d.h[k] > 0.0 : s->h[k] > 0.0;
    }
}

static bool ready(const struct hybrid *s, int row, bool positive)
{
    if (!hybrid_active(s, row)) return false;
    if (!(s->held[row] > 0.0)) return positive;
    /* an input may jump at the very instant at which a timer runs out: the timer was first */
    bool was_true = positive || model_reads_input[row];
    return was_true && s->armed[row] + s->held[row] <= s->t + SAME_INSTANT; /* NaN: no timer runs */
}

static bool timer_is_wrong(const struct hybrid *s, int row, bool positive)
{
    return hybrid_active(s, row) && s->held[row] > 0.0 && positive == (bool)isnan(s->armed[row]);
}

/* Whether `hybrid_update` would do anything now. */
bool hybrid_due(struct hybrid *s)
{
    bool positive[ROOM(NH)];
    if (!hybrid_evaluate(s)) return false;
    positive_soon(s, positive);
    for (int k = 0; k < NROWS; ++k)
        if (ready(s, k, positive[k]) || timer_is_wrong(s, k, positive[k])) return true;
    for (int k = NROWS; k < NH; ++k)
        if (positive[k]) return true;
    return false;
}

static enum outcome left_bounds(const struct hybrid *s, int number, char *message, size_t size)
{
    const struct bound *bound = &model_bounds[number];
    snprintf(message, size, "%s at %.3f s (%s)", bound->what, s->t, bound->where);
    return LEFT_BOUNDS;
}

static enum outcome chatters(const struct hybrid *s, char *message, size_t size)
{
    size_t used = (size_t)snprintf(message, size, "more than %d jumps at %.6g s between", MAX_JUMPS_AT_ONCE, s->t);
    for (int k = 0; k < NROWS && used < size; ++k)
        if (s->visited[k]) used += (size_t)snprintf(message + used, size - used, "\n  %s", model_rows[k].text);
    if (used < size)
        snprintf(message + used, size - used, "\nThe guards of these modes are true together: give them "
                 "hysteresis or a dwell time.");
    return CHATTERS;
}

static void jump(struct hybrid *s, int row)
{
    const struct row *r = &model_rows[row];
    if (r->resets) {
        struct arguments a;
        double x[ROOM(NX)];
        double *results[] = {x};
        hybrid_gather(s, &a);
        r->resets(a.of, results, NULL, NULL, 0);
        memcpy(s->x, x, sizeof x);
    }
    s->mode[r->automaton] = r->target;
    s->entry[r->automaton] = s->t;
    for (int k = 0; k < NROWS; ++k)
        if (model_rows[k].automaton == r->automaton) s->armed[k] = NAN;
    s->known = false;
}

/* Apply the first row that is due, or, when none is, start and stop the timers. */
enum outcome hybrid_update(struct hybrid *s, bool *reset, char *message, size_t size)
{
    bool positive[ROOM(NH)];
    *reset = false;
    if (!hybrid_evaluate(s)) return NOT_VALID;
    positive_soon(s, positive);
    for (int k = NROWS; k < NH; ++k)
        if (positive[k]) return left_bounds(s, k - NROWS, message, size);
    if (s->t - s->instant > SAME_INSTANT) {
        s->instant = s->t;
        s->jumps = 0;
        memset(s->visited, 0, sizeof s->visited);
    }
    for (int k = 0; k < NROWS; ++k) {
        if (!ready(s, k, positive[k])) continue;
        s->visited[k] = true;
        if (++s->jumps > MAX_JUMPS_AT_ONCE) return chatters(s, message, size);
        size_t used = (size_t)snprintf(message, size, "%.9g s: %s", s->t, model_rows[k].text);
        for (int other = k + 1; other < NROWS && used < size; ++other)
            if (model_rows[other].automaton == model_rows[k].automaton && ready(s, other, positive[other]))
                used += (size_t)snprintf(message + used, size - used, "; also due: %s", model_rows[other].text);
        *reset = model_rows[k].resets != NULL;
        jump(s, k);
        return JUMPED;
    }
    for (int k = 0; k < NROWS; ++k)
        if (timer_is_wrong(s, k, positive[k])) s->armed[k] = positive[k] ? s->t : NAN;
    return SETTLED;
}

/* When the next timer runs out; false when none runs. */
bool hybrid_next_timer(const struct hybrid *s, double *t)
{
    bool found = false;
    for (int k = 0; k < NROWS; ++k) {
        if (!hybrid_active(s, k) || isnan(s->armed[k])) continue;
        double fires = s->armed[k] + s->held[k];
        if (!found || fires < *t) *t = fires;
        found = true;
    }
    return found;
}
