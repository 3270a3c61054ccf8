/* Where a run starts: the equilibrium, and its derivative. */

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "hybrid.h"
#include "linear.h"

#define RANK_CUT 1e-10
#define AT_REST 1e-9
#define ROUGH 1e-3 /* below this residual Newton's method is quadratic: */
#define POLISH 2   /* so many full steps take it to round-off */

/* f and g at the unknowns `w`, and their Jacobian; clocks and time stand at zero. */
static void rest(const struct hybrid *s, const double *w, double *residual, double *jacobian)
{
    struct hybrid at = *s;
    struct arguments a;
    memcpy(at.x, w, NX * sizeof *w);
    memcpy(at.z, w + NX, NZ * sizeof *w);
    at.t = 0.0;
    for (int k = 0; k < NA; ++k) at.entry[k] = 0.0;
    hybrid_gather(&at, &a);
    double *results[] = {residual, jacobian};
    model_rest(a.of, results, NULL, NULL, 0);
}

/* Rows of the Jacobian scaled to unit size, so that a fast state does not hide a slow one. */
struct scaled {
    double scale[ROOM(NW)], jacobian[ROOM(NW) * ROOM(NW)], us[ROOM(NW) * ROOM(NW)], v[ROOM(NW) * ROOM(NW)];
};

static void factor(const double *jacobian, struct scaled *m)
{
    for (int i = 0; i < NW; ++i) {
        m->scale[i] = 0.0;
        for (int j = 0; j < NW; ++j) m->scale[i] = fmax(m->scale[i], fabs(jacobian[i + j * NW]));
        if (m->scale[i] == 0.0) m->scale[i] = 1.0;
    }
    for (int k = 0; k < NW * NW; ++k) m->us[k] = m->jacobian[k] = jacobian[k] / m->scale[k % NW];
    linear_svd(NW, m->us, m->v);
}

/* The step of least norm that removes a residual. */
static void least_step(const struct scaled *m, const double *residual, double *step)
{
    double b[ROOM(NW)];
    for (int i = 0; i < NW; ++i) b[i] = -residual[i] / m->scale[i];
    linear_least_norm(NW, m->us, m->v, RANK_CUT, b, step);
}

static bool no_equilibrium(const double *residual, char *message, size_t size)
{
    bool told[ROOM(NW)] = {false};
    size_t used = (size_t)snprintf(message, size, "%s: no equilibrium at the first value of the inputs. "
                                   "Largest residuals:", MODEL_NAME);
    for (int place = 0; place < 5 && place < NW && used < size; ++place) {
        int worst = -1;
        double most = -1.0;
        for (int k = 0; k < NW; ++k) {
            double here = isfinite(residual[k]) ? fabs(residual[k]) : HUGE_VAL;
            if (told[k] || here <= most) continue;
            worst = k;
            most = here;
        }
        told[worst] = true;
        used += (size_t)snprintf(message + used, size - used, "\n  %s = %.3g", model_residuals[worst],
                                 residual[worst]);
    }
    if (used < size) snprintf(message + used, size - used, "\nCheck start values of inputs and parameters.");
    return false;
}

/* Find x and z at rest with the present inputs and parameters, by a damped Newton method with steps of least
   norm from the start values: directions that the equations leave open keep their start values. */
bool hybrid_equilibrium(struct hybrid *s, char *message, size_t size)
{
    double w[ROOM(NW)], trial[ROOM(NW)], step[ROOM(NW)], residual[ROOM(NW)], moved[ROOM(NW)];
    double jacobian[ROOM(NW) * ROOM(NW)];
    struct scaled m;
    const double *inputs[] = {s->u, s->p};
    double *start[] = {w};
    for (int k = 0; k < NA; ++k) s->mode[k] = model_automata[k].start;
    model_start(inputs, start, NULL, NULL, 0);
    if (START_AT_EQUILIBRIUM) {
        rest(s, w, residual, jacobian);
        double size_now = hybrid_largest(NW, residual);
        for (int iteration = 0, undamped = 0; iteration < 60; ++iteration) {
            if (size_now < AT_REST && undamped >= POLISH) break; /* the last steps take it to round-off */
            if (!hybrid_finite(NW * NW, jacobian)) return no_equilibrium(residual, message, size);
            factor(jacobian, &m);
            least_step(&m, residual, step);
            double cut = 1.0, size_new;
            for (;;) {
                for (int k = 0; k < NW; ++k) trial[k] = w[k] + cut * step[k];
                rest(s, trial, moved, jacobian);
                size_new = hybrid_largest(NW, moved);
                if (size_new <= (1.0 - 0.25 * cut) * size_now || size_new < AT_REST) break;
                cut /= 2.0;
                if (cut < 1e-6) return no_equilibrium(residual, message, size);
            }
            if (cut == 1.0 && size_now < ROUGH) ++undamped;
            memcpy(w, trial, sizeof w);
            memcpy(residual, moved, sizeof residual);
            size_now = size_new;
        }
        if (!(size_now < AT_REST)) return no_equilibrium(residual, message, size);
    }
    memcpy(s->x, w, NX * sizeof *w);
    memcpy(s->z, w + NX, NZ * sizeof *w);
    s->known = false;
    return true;
}

/* Derivative of the equilibrium, and of f, y and h there, along d->u and d->p:
   d(x, z) = -J^+ d(f, g) + (1 - J^+ J) dstart. */
void hybrid_equilibrium_slope(const struct hybrid *s, struct direction *d)
{
    double w[ROOM(NW)], residual[ROOM(NW)], jacobian[ROOM(NW) * ROOM(NW)], open[ROOM(NW)], back[ROOM(NW)];
    const double *inputs[] = {s->u, s->p, d->u, d->p};
    double *start[] = {open};
    model_start_slope(inputs, start, NULL, NULL, 0);
    d->t = 0.0;
    memset(d->x, 0, sizeof d->x);
    memset(d->z, 0, sizeof d->z);
    if (START_AT_EQUILIBRIUM) {
        struct scaled m;
        memcpy(w, s->x, NX * sizeof *w);
        memcpy(w + NX, s->z, NZ * sizeof *w);
        rest(s, w, residual, jacobian);
        factor(jacobian, &m);
        hybrid_move(s, d, false);
        memcpy(residual, d->f, NX * sizeof *w);
        memcpy(residual + NX, d->g, NZ * sizeof *w);
        for (int i = 0; i < NW; ++i)
            for (int j = 0; j < NW; ++j) residual[i] += jacobian[i + j * NW] * open[j];
        least_step(&m, residual, back);
        for (int k = 0; k < NW; ++k) open[k] += back[k];
    }
    memcpy(d->x, open, NX * sizeof *open);
    memcpy(d->z, open + NX, NZ * sizeof *open);
    hybrid_move(s, d, !START_AT_EQUILIBRIUM);
}
