/* Events on guards: found between two points of a step, located on its dense output. Part of course.c. */

/* Signed guard and rate of one row on the dense output. */
static double guard_on_step(struct course *c, int row, double t, double *rate)
{
    double x[N], z[AT_LEAST_ONE(NZN)], h[AT_LEAST_ONE(GUARDS)], r[AT_LEAST_ONE(GUARDS)];
    dense_at(&c->dense, t, x, z);
    algebraics_at(c, t, x, z);
    course_guards(c, t, x, z, h, r);
    *rate = r[row];
    return h[row];
}

/* Time at which a signed guard rises through zero in [low, high]: Newton from a guess, bracketed if it
 * strays. NaN when the guard is not above zero at `high` after all. */
static double locate(struct course *c, int row, double low, double high, double guess)
{
    double t = guess, rate, value, step;
    for (int round = 0; round < 6; round++) {
        value = guard_on_step(c, row, t, &rate);
        if (!(rate > 0)) break;
        step = value / rate;
        if (fabs(step) <= LOCATED) return t;
        t -= step;
        if (!(low <= t && t <= high)) break;
    }
    value = guard_on_step(c, row, high, &rate);
    if (!(value > 0)) return NAN;
    t = high;
    while (high - low > LOCATED) {
        step = rate > 0 ? value / rate : INFINITY;
        if (fabs(step) <= LOCATED) break;
        t = low < t - step && t - step < high ? t - step : 0.5 * (low + high);
        value = guard_on_step(c, row, t, &rate);
        if (value > 0) high = t;
        else low = t;
    }
    return t;
}

#if IMPLICIT
#include "relocate.c"
#endif

/* Fraction at which the cubic is largest inside, if it is above zero there; else 0. */
static double peak(const struct cubic *k)
{
    double a = 3 * k->c3, b = 2 * k->c2, c = k->c1, disc = b * b - 4 * a * c, roots[2] = {0, 0};
    if (a == 0) {
        if (b != 0) roots[0] = -c / b;
    } else if (disc >= 0) {
        double m = -0.5 * (b + (b >= 0 ? sqrt(disc) : -sqrt(disc)));
        roots[0] = m / a;
        if (m != 0) roots[1] = c / m;
    }
    for (int n = 0; n < 2; n++)
        if (0 < roots[n] && roots[n] < 1 && cubic_at(k, roots[n]) > 0) return roots[n];
    return 0;
}

/* Fraction in [0, high] at which the cubic rises through zero. */
static double rise(const struct cubic *k, double high)
{
    double low = 0;
    for (int n = 0; n < 40; n++) {
        double s = 0.5 * (low + high);
        if (cubic_at(k, s) > 0) high = s;
        else low = s;
    }
    return high;
}

/* Whether a guard crosses between two points: 1 it is above zero at the end; 2 only in between, perhaps. */
static int crosses(double step, double a, double da, double b, double db)
{
    if (b > 0) return 1;
    return da > 0 && db < 0 && a <= 0 && fmin(a + da * step, b - db * step) > 0 ? 2 : 0;
}

/* Earliest crossing between two points of the step with known guards; its row, or -1, and its time. */
static int first_crossing(struct course *c, double ta, const double *ha, const double *ra, double tb,
                          const double *hb, const double *rb, double *found)
{
    double guess[AT_LEAST_ONE(GUARDS)], upper[AT_LEAST_ONE(GUARDS)];
    int pending[AT_LEAST_ONE(GUARDS)] = {0}, best = -1;
    for (int k = 0; k < GUARDS; k++) {
        double a = ha[k] < 0 ? ha[k] : 0; /* what held at the begin was dealt with there */
        int how = c->sign[k] != 0 ? crosses(tb - ta, a, ra[k], hb[k], rb[k]) : 0;
        if (!how) continue;
        struct cubic cubic = cubic_through(tb - ta, a, ra[k], hb[k], rb[k]);
        double top = how == 1 ? 1.0 : peak(&cubic);
        pending[k] = top > 0;
        guess[k] = ta + rise(&cubic, top) * (tb - ta);
        upper[k] = how == 1 ? tb : ta + top * (tb - ta);
    }
    for (;;) {
        int k = -1;
        for (int i = 0; i < GUARDS; i++)
            if (pending[i] && (k < 0 || guess[i] < guess[k] || (guess[i] == guess[k] && upper[i] < upper[k]))) k = i;
        if (k < 0) return best;
        pending[k] = 0;
        double high = best >= 0 ? fmin(upper[k], *found) : upper[k];
        double t = locate(c, k, ta, high, fmin(guess[k], high));
        if (!isnan(t) && (best < 0 || t < *found - SAME_INSTANT)) best = k, *found = t;
    }
}

/* Go to the crossing of a guard at t, and do what it asks for. */
static void at_crossing(struct course *c, int row, double t)
{
    const struct inputs *in = c->task->inputs;
    struct spot s;
    double dte[AT_LEAST_ONE(NW)] = {0};
    int rising = c->sign[row] > 0;
    c->piece = piece_at(in, c->piece, in->section[c->section], last_piece(c), t);
    c->t = t;
    c->rated = 0;
    dense_at(&c->dense, t, c->x, c->z);
    if (!make_consistent(c)) return;
#if NW > 0
    double g[GUARDS], rate[GUARDS], slopes[GUARDS * NW];
    column columns[GROUPS * GUARDS];
    spot_rated(&s, c);
    look(&s.at, g, rate);
    cross(&s.at, columns);
    unpack_columns(columns, GUARDS, slopes);
    /* a grazing guard has no derivative: not finite says so */
    for (int j = 0; j < NW; j++) dte[j] = -slopes[j * GUARDS + row] / rate[row];
#else
    (void)s;
#endif
    if (!emit_now(c)) return;
    if (row >= ROWS) {
        c->detail = row - ROWS;
        course_fail(c, LEFT_BOUNDS, t, t);
        return;
    }
    settle(c, dte, row, rising, -1, 0);
}

/* Handle the first crossing of the step in `dense` from the present time to t1, if there is one: guards are
 * compared at its ends, and at the knots of the inputs between them if one reads the inputs. Returns 0 when
 * nothing crosses, else 1; the course is then at the crossing, or over. */
int course_cross(struct course *c, const double *h0, const double *r0, double t1, const double *h1,
                 const double *r1)
{
    const struct inputs *in = c->task->inputs;
    double ha[AT_LEAST_ONE(GUARDS)], ra[AT_LEAST_ONE(GUARDS)], hb[AT_LEAST_ONE(GUARDS)], rb[AT_LEAST_ONE(GUARDS)];
    double ta = c->t, found = 0, x[N], z[AT_LEAST_ONE(NZN)];
    long knot = c->piece + 1, last = last_piece(c);
    memcpy(ha, h0, GUARDS * sizeof(double));
    memcpy(ra, r0, GUARDS * sizeof(double));
    for (;;) {
        double tb = t1;
        while (knot <= last && in->start[knot] <= ta) knot++;
        if (c->watches_input && knot <= last && in->start[knot] < t1) {
            tb = in->start[knot];
            dense_at(&c->dense, tb, x, z);
            course_guards(c, tb, x, z, hb, rb);
        } else {
            memcpy(hb, h1, GUARDS * sizeof(double));
            memcpy(rb, r1, GUARDS * sizeof(double));
        }
        int row = first_crossing(c, ta, ha, ra, tb, hb, rb, &found);
        if (row >= 0) {
#if IMPLICIT
            found = locate_again(c, row, found);
#endif
            if (!record_samples(c, &c->dense, found) || !nodes_before(c, found)) return 1;
            at_crossing(c, row, found);
            next_limit(c);
            return 1;
        }
        if (tb >= t1) return 0;
        ta = tb;
        memcpy(ha, hb, sizeof ha);
        memcpy(ra, rb, sizeof ra);
    }
}
