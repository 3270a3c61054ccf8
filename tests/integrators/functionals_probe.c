/* Functionals on signals in closed form: sums of damped waves on stretches of time, each parameter with its
 * derivative by every theta. Compiled alone, without a model and without the loop that integrates. */
#include "functionals.c"

#include <string.h>

enum { WAVES = 2, PARAMETERS = 3 + 4 * WAVES }; /* level, slope, origin; size, damping, frequency, phase */

struct signals {
    int ny, nw;
    const double *parameter, *by; /* [stretch][output][PARAMETERS], the same by [nw] */
    long calls;
};

static void one_signal(const double *p, const double *by, int nw, double t, double *y, double *rate,
                       double *y_theta, double *rate_theta)
{
    double u = t - p[2], y_p[PARAMETERS], r_p[PARAMETERS], curvature = 0;
    *y = p[0] + p[1] * u;
    *rate = p[1];
    y_p[0] = 1, r_p[0] = 0;
    y_p[1] = u, r_p[1] = 1;
    for (int k = 0; k < WAVES; k++) {
        const double *q = p + 3 + 4 * k, d = q[1], w = q[2];
        double *y_q = y_p + 3 + 4 * k, *r_q = r_p + 3 + 4 * k;
        double e = exp(-d * u), c = e * cos(w * u + q[3]), s = e * sin(w * u + q[3]);
        *y += q[0] * c;
        *rate += q[0] * (-d * c - w * s);
        curvature += q[0] * ((d * d - w * w) * c + 2 * d * w * s);
        y_q[0] = c, r_q[0] = -d * c - w * s;
        y_q[1] = -u * q[0] * c, r_q[1] = q[0] * (u * (d * c + w * s) - c);
        y_q[2] = -u * q[0] * s, r_q[2] = q[0] * (u * (d * s - w * c) - s);
        y_q[3] = -q[0] * s, r_q[3] = q[0] * (d * s - w * c);
    }
    y_p[2] = -*rate, r_p[2] = -curvature;
    for (int j = 0; y_theta && j < nw; j++) {
        y_theta[j] = rate_theta[j] = 0;
        for (int k = 0; k < PARAMETERS; k++) {
            y_theta[j] += y_p[k] * by[k * nw + j];
            rate_theta[j] += r_p[k] * by[k * nw + j];
        }
    }
}

static int evaluate(void *context, long step, double t, double *y, double *rate, double *y_theta,
                    double *rate_theta)
{
    struct signals *s = context;
    s->calls++;
    for (int k = 0; k < s->ny; k++) {
        long at = (step * s->ny + k) * PARAMETERS;
        one_signal(s->parameter + at, s->by + at * s->nw, s->nw, t, y + k, rate + k,
                   y_theta ? y_theta + k * s->nw : 0, rate_theta ? rate_theta + k * s->nw : 0);
    }
    return 0;
}

/* Functionals of one run; `repeat` times over, for timing. Returns what functionals_of does. */
int probe(int ny, int nw, const double *parameter, const double *by, long n, const double *t,
          const long *step, const unsigned char *kind, const long *brk, const double *dbreak, int count,
          const struct functional *what, double *value, double *time, double *gradient, unsigned char *place,
          unsigned char *tie, long *calls, long repeat)
{
    struct signals signals = {ny, nw, parameter, by, 0};
    double *y = malloc(2 * n * ny * sizeof *y), *rate = y + n * ny;
    for (long k = 0; k < n; k++)
        evaluate(&signals, step[k], t[k], y + k * ny, rate + k * ny, 0, 0);
    struct track track = {n, ny, nw, t, y, rate, step, kind, brk, dbreak, evaluate, &signals};
    struct functional_results results = {value, time, gradient, place, tie};
    struct workspace workspace = {0};
    int status = 0;
    for (long k = 0; k < repeat && !status; k++) {
        signals.calls = 0;
        status = functionals_of(&track, what, count, &workspace, &results);
    }
    *calls = signals.calls;
    workspace_free(&workspace);
    free(y);
    return status;
}

/* -- signals given by samples: the solution is the cubic itself ------------------------------------------- */

struct samples {
    int ny, nw;
    const double *t, *y, *rate, *y_theta, *rate_theta; /* [n], [n][ny] twice, [n][ny][nw] twice */
};

static void cubic(double h, double s, double y0, double r0, double y1, double r1, double *y, double *rate)
{
    double m0 = r0 * h, m1 = r1 * h, rise = y1 - y0, c2 = 3 * rise - 2 * m0 - m1, c3 = m0 + m1 - 2 * rise;
    *y = y0 + s * (m0 + s * (c2 + s * c3));
    *rate = (m0 + s * (2 * c2 + 3 * s * c3)) / h;
}

static int between_samples(void *context, long step, double t, double *y, double *rate, double *y_theta,
                           double *rate_theta)
{
    const struct samples *d = context;
    int ny = d->ny, n_theta = ny * d->nw;
    double h = d->t[step + 1] - d->t[step], s = (t - d->t[step]) / h;
    const double *y0 = d->y + step * ny, *r0 = d->rate + step * ny;
    const double *a0 = d->y_theta + step * n_theta, *b0 = d->rate_theta + step * n_theta;
    for (int k = 0; k < ny; k++)
        cubic(h, s, y0[k], r0[k], y0[k + ny], r0[k + ny], y + k, rate + k);
    for (int k = 0; y_theta && k < n_theta; k++)
        cubic(h, s, a0[k], b0[k], a0[k + n_theta], b0[k + n_theta], y_theta + k, rate_theta + k);
    return 0;
}

int probe_samples(int ny, int nw, long n, const double *t, const double *y, const double *rate,
                  const double *y_theta, const double *rate_theta, const long *step,
                  const unsigned char *kind, const long *brk, const double *dbreak, int count,
                  const struct functional *what, double *value, double *time, double *gradient,
                  unsigned char *place, unsigned char *tie)
{
    struct samples samples = {ny, nw, t, y, rate, y_theta, rate_theta};
    struct track track = {n, ny, nw, t, y, rate, step, kind, brk, dbreak, between_samples, &samples};
    struct functional_results results = {value, time, gradient, place, tie};
    struct workspace workspace = {0};
    int status = functionals_of(&track, what, count, &workspace, &results);
    workspace_free(&workspace);
    return status;
}

#ifdef PROBE_MAIN
#include <stdio.h>

static unsigned long state = 1;

static double uniform(double low, double high)
{
    state = state * 6364136223846793005UL + 1442695040888963407UL;
    return low + (high - low) * (double)(state >> 11) / 9007199254740992.0;
}

/* Many random runs, odd ones among them: one node, no length, double times at the ends, no finite values. */
int main(void)
{
    enum { RUNS = 4000, STRETCHES = 4, NODES = 60, NY = 2, NW = 3, COUNT = 20 };
    static double parameter[STRETCHES * NY * PARAMETERS], by[STRETCHES * NY * PARAMETERS * NW];
    static double t[NODES], dbreak[STRETCHES * NW];
    static long step[NODES], brk[NODES];
    static unsigned char kind[NODES];
    struct functional what[COUNT];
    double *value = malloc(COUNT * sizeof *value), *time = malloc(COUNT * sizeof *time);
    double *gradient = malloc(COUNT * NW * sizeof *gradient);
    unsigned char *place = malloc(COUNT), *tie = malloc(COUNT);
    long finite = 0, calls;
    for (int run = 0; run < RUNS; run++) {
        int stretches = 1 + (int)uniform(0, STRETCHES), nw = (int)uniform(0, NW + 1);
        for (int k = 0; k < STRETCHES * NY * PARAMETERS; k++)
            parameter[k] = uniform(-1, 1) * (k % 7 == 5 ? 40 : 1);
        for (int k = 0; k < STRETCHES * NY * PARAMETERS * NW; k++)
            by[k] = uniform(-1, 1);
        if (run % 50 == 0)
            parameter[0] = NAN;
        long n = 0;
        for (int s = 0; s < stretches; s++) {
            double begin = n ? t[n - 1] : 0.0, length = run % 9 == 0 ? 0.0 : uniform(0, 1);
            int nodes = run % 11 == 0 ? 1 : 2 + (int)uniform(0, NODES / STRETCHES - 2);
            for (int k = 0; k < nodes; k++, n++) {
                t[n] = begin + (nodes > 1 ? length * k / (nodes - 1) : 0.0);
                step[n] = s;
                brk[n] = -1;
                kind[n] = PLACE_INSIDE;
            }
            if (s) {
                brk[n - nodes] = brk[n - nodes - 1] = s - 1;
                kind[n - nodes] = kind[n - nodes - 1] = s % 2 ? PLACE_EVENT : PLACE_JUMP;
                for (int w = 0; w < NW; w++)
                    dbreak[(s - 1) * NW + w] = uniform(-1, 1);
            }
        }
        for (int k = 0; k < COUNT; k++)
            what[k] = (struct functional){k % 10, k / 10, run % 3 ? -1 : 1, run % 2, uniform(-0.2, 0.4)};
        if (probe(NY, nw, parameter, by, n, t, step, kind, brk, dbreak, COUNT, what, value, time, gradient,
                  place, tie, &calls, 1))
            return 1;
        for (int k = 0; k < COUNT; k++)
            finite += isfinite(value[k]) != 0;
    }
    printf("%ld\n", finite);
    free(value), free(time), free(gradient), free(place), free(tie);
    return 0;
}
#endif
