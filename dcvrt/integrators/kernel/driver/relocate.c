/* Crossings of a method whose dense output is less exact than its steps. Part of crossing.c. */

enum { MOST_AGAIN = 5 };
#define NEAR_END 1e-5 /* of a step: so close to its end the dense output is as exact as the step */

/* Root of a signed guard on the dense output by Newton's method from t; NaN when it strays from [low, high]. */
static double nearest_root(struct course *c, int row, double low, double high, double t)
{
    double rate;
    for (int round = 0; round < 8; round++) {
        double step = guard_on_step(c, row, t, &rate) / rate;
        if (!(rate > 0)) return NAN;
        t -= step;
        if (!(low <= t && t <= high)) return NAN;
        if (fabs(step) <= LOCATED) return t;
    }
    return NAN;
}

/* Time of a crossing that was found on the dense output at t: the step is made again so that it ends at the
 * crossing, and is recorded so. Where that does not settle - a guard that grazes zero - t is kept, with the
 * step as it was. */
static double locate_again(struct course *c, int row, double t)
{
    struct record *r = &c->record;
    const struct dense before = c->dense;
    double found = t, end = before.t + before.h;
    for (int round = 0; round < MOST_AGAIN; round++) {
        double h = found - before.t;
        if (!(h > LOCATED)) break;
        step_again(c, h);
        double next = nearest_root(c, row, before.t, fmin(end, found + 0.5 * h), found);
        if (isnan(next)) break;
        int settled = fabs(next - found) <= NEAR_END * h;
        found = next;
        if (!settled) continue;
        if (c->options->steps) r->step_h[r->steps - 1] = h;
        return found;
    }
    c->dense = before;
    return t;
}
