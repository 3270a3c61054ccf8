/* The equations of a hybrid system at one point: values, derivatives along a direction, what is wrong with them. */

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "hybrid.h"
#include "linear.h"

void hybrid_defaults(struct hybrid *s)
{
    memset(s, 0, sizeof *s);
    for (int k = 0; k < NU; ++k) s->u[k] = model_inputs[k].value;
    for (int k = 0; k < NP; ++k) s->p[k] = model_parameters[k].value;
}

/* Fill in t, x, z, u, p, q and c. */
void hybrid_gather(const struct hybrid *s, struct arguments *a)
{
    double *q = a->q;
    for (int k = 0; k < NA; ++k) {
        const struct automaton *automaton = &model_automata[k];
        memcpy(q, automaton->flags + s->mode[k] * automaton->n_flags, automaton->n_flags * sizeof *q);
        q += automaton->n_flags;
        a->c[k] = s->t - s->entry[k];
    }
    a->of[0] = &s->t;
    a->of[1] = s->x;
    a->of[2] = s->z;
    a->of[3] = s->u;
    a->of[4] = s->p;
    a->of[5] = a->q;
    a->of[6] = a->c;
}

bool hybrid_finite(int n, const double *values)
{
    for (int k = 0; k < n; ++k)
        if (!isfinite(values[k])) return false;
    return true;
}

/* The largest magnitude; NaN when one is. */
double hybrid_largest(int n, const double *values)
{
    double most = 0.0;
    for (int k = 0; k < n; ++k) {
        if (isnan(values[k])) return NAN; /* no comparison with it is true */
        most = fmax(most, fabs(values[k]));
    }
    return most;
}

/* g_z^-1 of the present values, applied to `b` in place. */
static bool divide_by_g_z(const struct arguments *a, double *b)
{
    double g[ROOM(NZ)], g_z[ROOM(NZ) * ROOM(NZ)];
    double *results[] = {g, g_z};
    model_algebra((const double **)a->of, results, NULL, NULL, 0);
    return linear_solve(NZ, g_z, b);
}

/* Newton's method for 0 = g, from the values that solved it last. */
static bool solve_algebra(struct hybrid *s, struct arguments *a)
{
    for (int iteration = 0; iteration < 50; ++iteration) {
        double g[ROOM(NZ)], g_z[ROOM(NZ) * ROOM(NZ)];
        double *results[] = {g, g_z};
        model_algebra(a->of, results, NULL, NULL, 0);
        if (!linear_solve(NZ, g_z, g) || !hybrid_finite(NZ, g)) return false;
        for (int k = 0; k < NZ; ++k) s->z[k] -= g[k];
        if (hybrid_largest(NZ, g) < 1e-12 * (1.0 + hybrid_largest(NZ, s->z))) return true;
    }
    return false;
}

/* Bring f, y and h up to date. False when f or h are not numbers: the caller shall say so. */
bool hybrid_evaluate(struct hybrid *s)
{
    if (s->known) return s->valid;
    struct arguments a;
    double z[ROOM(NZ)], g[ROOM(NZ)];
    memcpy(z, s->z, sizeof z);
    hybrid_gather(s, &a);
    s->known = true;
    s->solved = NZ == 0 || solve_algebra(s, &a);
    if (!s->solved) {
        memcpy(s->z, z, sizeof z); /* the next attempt shall not begin where this one got lost */
        for (int k = 0; k < NX; ++k) s->f[k] = NAN;
        for (int k = 0; k < NY; ++k) s->y[k] = NAN;
        for (int k = 0; k < NH; ++k) s->h[k] = NAN;
        return s->valid = false;
    }
    double *results[] = {s->f, g, s->y, s->h};
    model_evaluate(a.of, results, NULL, NULL, 0);
    return s->valid = hybrid_finite(NX, s->f) && hybrid_finite(NH, s->h);
}

/* Say what is wrong with values that are not valid. */
void hybrid_fault(const struct hybrid *s, char *message, size_t size)
{
    for (int k = 0; k < NX; ++k) {
        if (!isfinite(s->x[k])) {
            snprintf(message, size, "the state %s was set to %g at %.6g s", model_states[k], s->x[k], s->t);
            return;
        }
    }
    if (!s->solved) {
        snprintf(message, size, "no consistent value of %s at %.6g s", model_algebraics, s->t);
        return;
    }
    for (int k = 0; k < NX; ++k) {
        if (!isfinite(s->f[k])) {
            snprintf(message, size, "the derivative of %s is %g at %.6g s (%s = %g)", model_states[k], s->f[k],
                     s->t, model_states[k], s->x[k]);
            return;
        }
    }
    for (int k = 0; k < NROWS; ++k)
        if (!isfinite(s->h[k]))
            snprintf(message, size, "the guard of %s is %g at %.6g s", model_rows[k].text, s->h[k], s->t);
}

/* Derivative of f, g, y and h along a direction. With `tied`, z moves so that 0 = g stays true. */
void hybrid_move(const struct hybrid *s, struct direction *d, bool tied)
{
    struct arguments a;
    hybrid_gather(s, &a);
    a.of[7] = &d->t;
    a.of[8] = d->x;
    a.of[9] = d->z;
    a.of[10] = d->u;
    a.of[11] = d->p;
    double *results[] = {d->f, d->g, d->y, d->h};
    if (NZ > 0 && tied) {
        memset(d->z, 0, sizeof d->z);
        model_slope(a.of, results, NULL, NULL, 0);
        for (int k = 0; k < NZ; ++k) d->z[k] = -d->g[k];
        if (!divide_by_g_z(&a, d->z))
            for (int k = 0; k < NZ; ++k) d->z[k] = NAN;
    }
    model_slope(a.of, results, NULL, NULL, 0);
}
