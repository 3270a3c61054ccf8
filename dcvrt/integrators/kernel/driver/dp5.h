/* The explicit pair of rk54.h, with its dense output of order 4.
 *
 * The form of the dense output: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
 * section II.6. A method gives the loop: method_prepare, method_restart, method_step, method_accept,
 * method_rate, method_dense, method_middle and method_reach.
 */
#ifndef DCVRT_METHOD_H
#define DCVRT_METHOD_H

#include "rk54.h"

/* Exponents of the step control: error^-a times (error before)^b, for an error of order h^5; error^-c after
 * a step that is not taken. */
#define CONTROL_NOW 0.20
#define CONTROL_BEFORE 0.08
#define CONTROL_REJECTED 0.2
/* Errors of this pair are some four times its estimate, those of `dopri5` a third of its: counted so many times, a
 * tolerance means to both about the same error of a run. */
#define COUNTED 3.0
/* The last term of the dense output sees what the estimate does not: corners of the equations between the stages -
 * limits that are smoothed over less than the step - and a decay so fast that the step lies where the estimate
 * vanishes. On smooth solutions that term is of order h^4, the estimate of order h^5: at a tolerance it is seldom
 * above SMOOTH tolerance^(-1/5) tolerances, and what it is above them counts as error. */
#define SMOOTH 24.0

/* At rest nothing else tells of a decay too fast for the step, and what it leaves grows where the estimate vanishes.
 * The last two stages are at one instant: where their rates differ against their states in proportion, the factor is
 * that of the fastest decay, and the next step is no longer than REACH over it. A turning motion shows no such
 * proportion, however its states are scaled. Differences below STILL tolerances are not asked. */
#define REACH 5.3
#define STILL 0.01
#define PROPORTION 0.9 /* square of the cosine between them */

struct method {
    real k[STAGES][NX], last[NX]; /* last: of the dense output */
    column ks[STAGES][AT_LEAST_ONE(GROUPS * NX)], lasts[AT_LEAST_ONE(GROUPS * NX)];
    real corner; /* share of an error that the last term is, see SMOOTH; of sensitivities */
    column theta_corner;
    real decay; /* fastest that the last step showed, or 0 */
};

/* State for stage s; s is a constant where this is called, so that the sum is unrolled. */
static inline __attribute__((always_inline)) void stage_state(struct fleet *f, int s, real *x, column *xs)
{
    const struct method *w = f->method;
    for (int i = 0; i < NX; i++) {
        real sum = A[s][0] * w->k[0][i];
        for (int j = 1; j < s; j++)
            if (A[s][j] != 0.0) sum += A[s][j] * w->k[j][i];
        x[i] = f->x[i] + f->h * sum;
    }
    for (int i = 0; i < GROUPS * NX; i++) {
        column sum = A[s][0] * w->ks[0][i];
        for (int j = 1; j < s; j++)
            if (A[s][j] != 0.0) sum += A[s][j] * w->ks[j][i];
        xs[i] = f->xs[i] + f->h * sum;
    }
}

static inline __attribute__((always_inline)) void stage(struct fleet *f, int s)
{
    int last = s == STAGES - 1;
    stage_state(f, s, last ? f->x1 : f->stage_x, last ? f->xs1 : f->stage_xs);
    fleet_inputs(f, NODE[s], 0);
    fleet_flow(f, last, f->method->k[s], f->method->ks[s]);
}

static void method_prepare(struct fleet *f, const struct options *o)
{
    f->method->corner = all_lanes(pow(o->rtol, 0.2) / SMOOTH);
    f->method->theta_corner = all_columns(pow(o->theta_rtol, 0.2) / SMOOTH);
}

/* Fastest decay that the last two stages show. */
static real fastest_decay(const struct fleet *f)
{
    const struct method *w = f->method;
    real xx = all_lanes(0.0), xk = xx, kk = xx;
    for (int i = 0; i < NX; i++) {
        real weight = 1.0 / (f->atol + f->rtol * absolute(f->x1[i]));
        real dx = weight * (f->x1[i] - f->stage_x[i]), dk = weight * (w->k[STAGES - 1][i] - w->k[STAGES - 2][i]);
        xx += dx * dx;
        xk -= dx * dk;
        kk += dk * dk;
    }
    real shown = both(both(is_less(all_lanes(STILL * STILL), xx), is_less(all_lanes(0.0), xk)),
                      is_less(PROPORTION * xx * kk, xk * xk));
    return where(shown, xk / larger(xx, all_lanes(STILL * STILL)));
}

/* How long the next step of a lane may be. */
static double method_reach(const struct fleet *f, int lane)
{
    double decay = AT(f->method->decay, lane);
    return decay > 0 ? REACH / decay : INFINITY;
}

/* One step of every lane from f->x over f->h to f->x1; the error of each over its tolerance. */
static real method_step(struct fleet *f)
{
    struct method *w = f->method;
    stage(f, 1);
    stage(f, 2);
    stage(f, 3);
    stage(f, 4);
    stage(f, 5);
    stage(f, 6);
    w->decay = fastest_decay(f);
    real error[NX];
    column errors[AT_LEAST_ONE(GROUPS * NX)];
    for (int i = 0; i < NX; i++) {
        real sum = ERROR[0] * w->k[0][i];
        for (int j = 2; j < STAGES; j++) sum += ERROR[j] * w->k[j][i];
        real last = LAST_TERM[0] * w->k[0][i];
        for (int j = 2; j < STAGES; j++) last += LAST_TERM[j] * w->k[j][i];
        w->last[i] = f->h * last;
        error[i] = larger(COUNTED * absolute(f->h * sum), w->corner * absolute(w->last[i]));
    }
    for (int i = 0; i < GROUPS * NX; i++) {
        column sum = ERROR[0] * w->ks[0][i];
        for (int j = 2; j < STAGES; j++) sum += ERROR[j] * w->ks[j][i];
        column last = LAST_TERM[0] * w->ks[0][i];
        for (int j = 2; j < STAGES; j++) last += LAST_TERM[j] * w->ks[j][i];
        w->lasts[i] = f->h * last;
        errors[i] = larger(COUNTED * absolute(f->h * sum), w->theta_corner * absolute(w->lasts[i]));
    }
    return fleet_norm(f, NX, f->x, f->x1, error, f->xs, f->xs1, errors);
}

/* Rate at the begin of a step after a jump, given as flat vector. */
static void method_restart(struct fleet *f, int lane, const double *rate)
{
    to_lane(rate, NX, NW, f->method->k[0], f->method->ks[0], lane);
}

/* The lanes that are `taken` go on from the end of the step. */
static void method_accept(struct fleet *f, lanes_mask taken)
{
    struct method *w = f->method;
    for (int i = 0; i < NX; i++) w->k[0][i] = taken_real(taken, w->k[STAGES - 1][i], w->k[0][i]);
    for (int i = 0; i < GROUPS * NX; i++)
        w->ks[0][i] = taken_column(taken, w->ks[STAGES - 1][i], w->ks[0][i]);
}

/* Rate of the states at the end of the step. */
static const real *method_rate(struct fleet *f) { return f->method->k[STAGES - 1]; }

static inline void dense_element(double *c0, int stride, double h, double x0, double x1, double k0, double k1,
                                 double last)
{
    double change = x1 - x0, bend = h * k0 - change;
    c0[0] = x0;
    c0[stride] = change;
    c0[2 * stride] = bend;
    c0[3 * stride] = change - h * k1 - bend;
    c0[4 * stride] = last;
}

/* Dense output of a lane's last step. */
static void method_dense(struct fleet *f, int lane, struct dense *d)
{
    struct method *w = f->method;
    double h = AT(f->h, lane);
    d->t = AT(f->t, lane);
    d->h = h;
    for (int i = 0; i < NX; i++)
        dense_element(&d->c[0][i], ALL, h, AT(f->x[i], lane), AT(f->x1[i], lane), AT(w->k[0][i], lane),
                      AT(w->k[STAGES - 1][i], lane), AT(w->last[i], lane));
    for (int n = 0; n < NW; n++)
        for (int i = 0; i < NX; i++)
            dense_element(&d->c[0][NX + n * NX + i], ALL, h, *theta_at(f->xs, NX, n, i, lane),
                          *theta_at(f->xs1, NX, n, i, lane), *theta_at(w->ks[0], NX, n, i, lane),
                          *theta_at(w->ks[STAGES - 1], NX, n, i, lane), *theta_at(w->lasts, NX, n, i, lane));
}

/* States in the middle of the step. */
static void method_middle(struct fleet *f, real *x, real *z)
{
    (void)z;
    const struct method *w = f->method;
    for (int i = 0; i < NX; i++) {
        real change = f->x1[i] - f->x[i], bend = f->h * w->k[0][i] - change;
        real back = change - f->h * w->k[STAGES - 1][i] - bend;
        x[i] = f->x[i] + 0.5 * (change + 0.5 * (bend + 0.5 * (back + 0.5 * w->last[i])));
    }
}

#endif
