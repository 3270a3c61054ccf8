/* A linearly implicit method of order 5 for stiff systems with algebraic variables: Rodas5P, eight stages,
 * stiffly accurate and L-stable, with an embedded result of order 4 and a dense output of order 4.
 *
 * G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia
 * Differential Equations package, BIT 63 (2023) 27; in the form without products of the Jacobian, E. Hairer,
 * G. Wanner, Solving Ordinary Differential Equations II, section IV.7. With y = (x, z), M y' = F(t, y),
 * M = diag(1, 0), J = F_y and W = M/(h gamma) - J,
 *
 *     W U_i = F(t + a_i h, Y_i) + M sum_j c_ij U_j / h + g_i h F_t,      Y_i = y + sum_j a_ij U_j,
 *
 * and the step ends at Y_8 + U_8; U_8 is its error. Sensitivities are the same method applied to the system
 * together with its derivative by theta. The exact Jacobian of both is block triangular, so that with a prime
 * for the total derivative by theta
 *
 *     W U_i' = F'(Y_i, Y_i') + M sum_j c_ij U_j' / h + g_i h F_t' + J' U_i :
 *
 * one matrix to factorise in a step, and J' once, at its begin.
 */
#ifndef DCVRT_METHOD_H
#define DCVRT_METHOD_H

#include "elimination.h"

enum { STAGES = 8, TERMS = 3 };
#define CONTROL_NOW 0.14
#define CONTROL_BEFORE 0.08
#define CONTROL_REJECTED 0.2
/* So many tolerances may the dense output be off in the middle of a step. The end alone does not tell: what
 * follows time or an input at once is exact there, however long the step. */
#define OFF_BETWEEN 10.0

#define DIAGONAL 0.21193756319429014
static const double NODE[STAGES] = {
    0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0};
static const double DRIFT[STAGES] = {DIAGONAL,           -0.42387512638858027, -0.3384627126235924,
                                     1.8046452872882734, 2.325825639765069,    0.0, 0.0, 0.0};
#define LATE -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946
static const double A[STAGES][STAGES - 1] = {
    {0},
    {3.0},
    {2.849394379747939, 0.45842242204463923},
    {-6.954028509809101, 2.489845061869568, -10.358996098473584},
    {2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641},
    {LATE},
    {LATE, 1.0},
    {LATE, 1.0, 1.0},
};
static const double C[STAGES][STAGES - 1] = {
    {0},
    {-14.155112264123755},
    {-17.97296035885952, -2.859693295451294},
    {147.12150275711716, -1.41221402718213, 71.68940251302358},
    {165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306},
    {24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471},
    {30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783, -19.097331116725623,
     -28.087943162872662},
    {37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047, -40.06618937091002,
     -54.66780262877968, -9.48861652309627},
};
/* Dense output y(t + r h) = (1 - r) y0 + r (y1 + (1 - r) (k1 + r (k2 + r k3))), k_n = sum_i D_ni U_i. */
static const double D[TERMS][STAGES] = {
    {25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204, 0.524948541321073,
     1.1241088310450404, 0.4272876194431874, -0.17202221070155493},
    {-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796, 20.176138334709044,
     15.98066361424651, -6.789040303419874, -6.710236069923372},
    {11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643, -52.072871366152654,
     -59.78993625266729, -0.15582684282751913, 4.883087185713722},
};

struct method {
    struct eliminated w;
    real u[STAGES][SIZE], jacobian[AT_LEAST_ONE(ENTRIES)], drift[SIZE], rate[NX];
    column us[STAGES][AT_LEAST_ONE(GROUPS * SIZE)], drifts[AT_LEAST_ONE(GROUPS * SIZE)],
        bends[AT_LEAST_ONE(GROUPS * BENT)];
};

/* Sum of the stages before s with the weights of a row, for one element. */
#define WEIGHTED(sum, type, weights, number, from, element)                   \
    type sum = (weights)[0] * (from)[0][element];                             \
    for (int j = 1; j < (number); j++)                                        \
        if ((weights)[j] != 0.0) sum += (weights)[j] * (from)[j][element];

/* State for stage s > 0; s is a constant where this is called, so that the sums are unrolled. */
static inline __attribute__((always_inline)) void stage_state(struct fleet *f, int s)
{
    const struct method *w = f->method;
    for (int i = 0; i < SIZE; i++) {
        WEIGHTED(sum, real, A[s], s, w->u, i)
        if (i < NX) f->stage_x[i] = f->x[i] + sum;
        else f->stage_z[i - NX] = f->z[i - NX] + sum;
    }
    for (int g = 0; g < GROUPS; g++)
        for (int i = 0; i < SIZE; i++) {
            WEIGHTED(sum, column, A[s], s, w->us, g * SIZE + i)
            if (i < NX) f->stage_xs[g * NX + i] = f->xs[g * NX + i] + sum;
            else f->stage_zs[g * NZ + i - NX] = f->zs[g * NZ + i - NX] + sum;
        }
}

static inline __attribute__((always_inline)) void stage(struct fleet *f, int s, real per_step)
{
    struct method *w = f->method;
    real *u = w->u[s], push = DRIFT[s] * f->h;
    if (s) {
        stage_state(f, s);
        fleet_inputs(f, NODE[s], 0);
#if NW > 0
        balance_theta(&f->at, u, w->us[s]);
#else
        balance(&f->at, u);
#endif
        for (int i = 0; i < NX; i++) {
            WEIGHTED(sum, real, C[s], s, w->u, i)
            u[i] += per_step * sum;
        }
    }
    if (DRIFT[s] != 0.0)
        for (int i = 0; i < SIZE; i++) u[i] += push * w->drift[i];
    solve_lanes(&w->w, u);
    for (int g = 0; g < GROUPS; g++) {
        column *us = w->us[s] + g * SIZE;
        for (int i = 0; s && i < NX; i++) {
            WEIGHTED(sum, column, C[s], s, w->us, g * SIZE + i)
            us[i] += per_step * sum;
        }
        if (DRIFT[s] != 0.0)
            for (int i = 0; i < SIZE; i++) us[i] += push * w->drifts[g * SIZE + i];
        for (int k = 0; k < BENT; k++) us[bent_row[k]] += u[bent_column[k]] * w->bends[g * BENT + k];
        solve_columns(&w->w, us);
    }
}

/* The equations and their derivatives at the begin of the step, and the factors of W. */
static void linearise(struct fleet *f, real per_step)
{
    struct method *w = f->method;
    fleet_inputs(f, 0.0, 1);
    f->at.x = f->x, f->at.z = f->z, f->at.xs = f->xs, f->at.zs = f->zs;
#if NW > 0
    linear_theta(&f->at, w->u[0], w->jacobian, w->drift, w->us[0], w->bends, w->drifts);
#else
    linear(&f->at, w->u[0], w->jacobian, w->drift);
#endif
    eliminate(&w->w, w->jacobian, per_step * (1.0 / DIAGONAL));
}

/* One of the terms of the dense output, of stages u[0][element] ... */
#define TERM(name, type, n, from, element)                                  \
    type name = D[n][0] * (from)[0][element];                               \
    for (int j = 1; j < STAGES; j++) name += D[n][j] * (from)[j][element];

static inline void dense_element(double *c0, double y0, double y1, const double (*u)[1])
{
    TERM(first, double, 0, u, 0)
    TERM(second, double, 1, u, 0)
    TERM(third, double, 2, u, 0)
    c0[0] = y0;
    c0[ALL] = y1 - y0;
    c0[2 * ALL] = first;
    c0[3 * ALL] = second + third;
    c0[4 * ALL] = -third;
}

/* Dense output of a lane's last step. */
static void method_dense(struct fleet *f, int lane, struct dense *d)
{
    struct method *w = f->method;
    double u[STAGES][1];
    d->t = AT(f->t, lane);
    d->h = AT(f->h, lane);
    for (int i = 0; i < SIZE; i++) {
        int z = i - NX;
        for (int j = 0; j < STAGES; j++) u[j][0] = AT(w->u[j][i], lane);
        if (z < 0) dense_element(&d->c[0][i], AT(f->x[i], lane), AT(f->x1[i], lane), u);
        else dense_element(&d->c[0][N + z], AT(f->z[z], lane), AT(f->z1[z], lane), u);
    }
    for (int n = 0; n < NW; n++)
        for (int i = 0; i < SIZE; i++) {
            int z = i - NX;
            for (int j = 0; j < STAGES; j++) u[j][0] = *theta_at(w->us[j], SIZE, n, i, lane);
            if (z < 0)
                dense_element(&d->c[0][NX + n * NX + i], *theta_at(f->xs, NX, n, i, lane),
                              *theta_at(f->xs1, NX, n, i, lane), u);
            else
                dense_element(&d->c[0][N + NZ + n * NZ + z], *theta_at(f->zs, NZ, n, z, lane),
                              *theta_at(f->zs1, NZ, n, z, lane), u);
        }
}

/* States and algebraic variables in the middle of the step; h times their rates there, if asked for. */
static inline __attribute__((always_inline)) void middle(struct fleet *f, real *x, real *z, real *move)
{
    const struct method *w = f->method;
    for (int i = 0; i < SIZE; i++) {
        TERM(first, real, 0, w->u, i)
        TERM(second, real, 1, w->u, i)
        TERM(third, real, 2, w->u, i)
        real y0 = i < NX ? f->x[i] : f->z[i - NX], y1 = i < NX ? f->x1[i] : f->z1[i - NX];
        real y = 0.5 * (y0 + y1) + 0.25 * (first + 0.5 * (second + 0.5 * third));
        if (i < NX) x[i] = y;
        else z[i - NX] = y;
        if (move && i < NX) move[i] = y1 - y0 + 0.25 * (second + third);
    }
}

static void method_middle(struct fleet *f, real *x, real *z) { middle(f, x, z, 0); }

static inline real worse(real a, real b) { return taken_real((b > a) | (b != b), b, a); }

/* Error over tolerance of the dense output in the middle of the step: W^-1 (F - M y'), which is the distance to
 * the solution for what follows at once, and small of order 5 for what does not. */
static real off_between(struct fleet *f, real per_step)
{
    real move[NX], off[SIZE], squares = all_lanes(0.0), squares_z = all_lanes(0.0);
    middle(f, f->stage_x, f->stage_z, move);
    fleet_inputs(f, 0.5, 0);
    balance(&f->at, off);
    for (int i = 0; i < NX; i++) off[i] -= per_step * move[i];
    solve_lanes(&f->method->w, off);
    for (int i = 0; i < NX; i++) {
        real e = off[i] / (f->atol + f->rtol * larger(absolute(f->x[i]), absolute(f->x1[i])));
        squares += e * e;
    }
    for (int i = 0; i < NZ; i++) {
        real e = off[NX + i] / (f->atol + f->rtol * larger(absolute(f->z[i]), absolute(f->z1[i])));
        squares_z += e * e;
    }
    return root(worse(squares * (1.0 / NX), squares_z * (1.0 / AT_LEAST_ONE(NZ))));
}

/* One step of every lane from f->x over f->h to f->x1; the error of each over its tolerance. */
static real method_step(struct fleet *f)
{
    struct method *w = f->method;
    real per_step = 1.0 / taken_real(f->h > 0.0, f->h, all_lanes(1e-9)); /* an idle lane has no step */
    linearise(f, per_step);
    f->at.x = f->stage_x, f->at.z = f->stage_z, f->at.xs = f->stage_xs, f->at.zs = f->stage_zs;
    stage(f, 0, per_step);
    stage(f, 1, per_step);
    stage(f, 2, per_step);
    stage(f, 3, per_step);
    stage(f, 4, per_step);
    stage(f, 5, per_step);
    stage(f, 6, per_step);
    stage(f, 7, per_step);
    const real *error = w->u[STAGES - 1];
    column errors[AT_LEAST_ONE(GROUPS * NX)], errors_z[AT_LEAST_ONE(GROUPS * NZ)];
    for (int i = 0; i < NX; i++) f->x1[i] = f->stage_x[i] + error[i];
    for (int i = 0; i < NZ; i++) f->z1[i] = f->stage_z[i] + error[NX + i];
    for (int g = 0; g < GROUPS; g++) {
        const column *us = w->us[STAGES - 1] + g * SIZE;
        for (int i = 0; i < NX; i++) {
            errors[g * NX + i] = us[i];
            f->xs1[g * NX + i] = f->stage_xs[g * NX + i] + us[i];
        }
        for (int i = 0; i < NZ; i++) {
            errors_z[g * NZ + i] = us[NX + i];
            f->zs1[g * NZ + i] = f->stage_zs[g * NZ + i] + us[NX + i];
        }
    }
    real norm = fleet_norm(f, NX, f->x, f->x1, error, f->xs, f->xs1, errors);
    if (NZ) norm = worse(norm, fleet_norm(f, NZ, f->z, f->z1, error + NX, f->zs, f->zs1, errors_z));
    return worse(norm, off_between(f, per_step) * (1.0 / OFF_BETWEEN));
}

static void method_prepare(struct fleet *f, const struct options *o) { (void)f, (void)o; }

/* Every step begins anew from the state. */
static void method_restart(struct fleet *f, int lane, const double *rate) { (void)f, (void)lane, (void)rate; }
static void method_accept(struct fleet *f, lanes_mask taken) { (void)f, (void)taken; }

/* Rate of the states at the end of the step, where the equations are laid out. */
static const real *method_rate(struct fleet *f)
{
    if (GUARDS || WATCHED) flow(&f->at, f->method->rate);
    return f->method->rate;
}

/* How long the next step of a lane may be: nothing decays too fast. */
static double method_reach(const struct fleet *f, int lane)
{
    (void)f, (void)lane;
    return INFINITY;
}

#endif
