/* The loop over steps: LANES cases at once, each with its own time, step size, mode and stops.
 *
 * A step is computed for all lanes together; what is rare happens lane by lane in course.c. A lane whose case
 * is over takes the next one. No lane's numbers depend on its neighbours, so that a result does not depend on
 * the lane, on the order, or on the number of threads.
 */
#include "kernel.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Truth for every lane. */
#if LANES == 1
typedef int lanes_mask;
static inline int lane_of(int mask, int lane) { return (void)lane, mask; }
static inline void set_lane(int *mask, int lane) { (void)lane, *mask = 1; }
#else
typedef bits lanes_mask;
static inline int lane_of(bits mask, int lane) { return mask[lane] != 0; }
static inline void set_lane(bits *mask, int lane) { (*mask)[lane] = -1; }
#endif

/* -- one lane of reals and columns -------------------------------------------------------------------- */

/* Element (row i, theta j) of columns with so many rows, of one lane. */
static inline double *theta_at(column *columns, int rows, int j, int i, int lane)
{
#if LANES == 1
    (void)lane;
    return &AT(columns[j / COLUMNS * rows + i], j % COLUMNS);
#else
    return &AT(columns[j * rows + i], lane);
#endif
}

/* Values, then their derivatives by so many thetas, one theta after the other, to a lane; and back, by all. */
static void to_lane(const double *flat, int rows, int thetas, real *x, column *xs, int lane)
{
    for (int i = 0; i < rows; i++) AT(x[i], lane) = flat[i];
    for (int j = 0; j < thetas; j++)
        for (int i = 0; i < rows; i++) *theta_at(xs, rows, j, i, lane) = flat[rows + j * rows + i];
}

static void from_lane(double *flat, int rows, real *x, column *xs, int lane)
{
    for (int i = 0; i < rows; i++) flat[i] = AT(x[i], lane);
    for (int j = 0; j < NW; j++)
        for (int i = 0; i < rows; i++) flat[rows + j * rows + i] = *theta_at(xs, rows, j, i, lane);
}

#if LANES == 1
static inline real taken_real(int taken, real yes, real no) { return taken ? yes : no; }
static inline column taken_column(int taken, column yes, column no) { return taken ? yes : no; }
#else
static inline real taken_real(bits taken, real yes, real no) { return choose(taken, yes, no); }
static inline column taken_column(bits taken, column yes, column no) { return choose(taken, yes, no); }
#endif

/* -- the lanes ---------------------------------------------------------------------------------------- */

struct method;

/* What all lanes carry; `method` holds the stages. */
struct fleet {
    struct method *method;
    real t, h;
    real x[NX], x1[NX], stage_x[NX];
    column xs[AT_LEAST_ONE(GROUPS * NX)], xs1[AT_LEAST_ONE(GROUPS * NX)], stage_xs[AT_LEAST_ONE(GROUPS * NX)];
    real z[AT_LEAST_ONE(NZ)], z1[AT_LEAST_ONE(NZ)], stage_z[AT_LEAST_ONE(NZ)];
    column zs[AT_LEAST_ONE(GROUPS * NZ)], zs1[AT_LEAST_ONE(GROUPS * NZ)], stage_zs[AT_LEAST_ONE(GROUPS * NZ)];
    real m[AT_LEAST_ONE(FIXED)], entry[AT_LEAST_ONE(NA)];
    column mc[AT_LEAST_ONE(GROUPS * FIXED_COLUMNS)];
    /* inputs: the piece that is loaded, and their values at the last stage */
    real begin, inverse, power[4][AT_LEAST_ONE(NU)];
    column tangent[4][AT_LEAST_ONE(GROUPS * DRIVEN)];
    real stage_t, u[AT_LEAST_ONE(NU)], v[AT_LEAST_ONE(NU)], clock[AT_LEAST_ONE(NA)];
    column us[AT_LEAST_ONE(GROUPS * DRIVEN)], vs[AT_LEAST_ONE(GROUPS * DRIVEN)];
    /* guards at the begin and the end of the step, signed */
    real sign[AT_LEAST_ONE(GUARDS)], guard[AT_LEAST_ONE(GUARDS)], slope[AT_LEAST_ONE(GUARDS)];
    real guard1[AT_LEAST_ONE(GUARDS)], slope1[AT_LEAST_ONE(GUARDS)];
    /* watched outputs at the begin and the end of the step */
    real watched[AT_LEAST_ONE(WATCHED)], watched_rate[AT_LEAST_ONE(WATCHED)];
    real watched1[AT_LEAST_ONE(WATCHED)], watched_rate1[AT_LEAST_ONE(WATCHED)];
    real atol, rtol, theta_rtol, theta_share, watch_tolerance, watch_floor, largest[AT_LEAST_ONE(WATCHED)];
    struct point at;
    /* lane by lane */
    struct course *course[LANES];
    long loaded[LANES], first_piece[LANES], last_piece[LANES], number[LANES];
    int spans[LANES], last[LANES], live[LANES];
    enum seen seen[LANES]; /* on the last step */
    double wanted[LANES], step[LANES], trend[LANES];
};

/* -- inputs ------------------------------------------------------------------------------------------- */

static void load_piece(struct fleet *f, int lane, long piece)
{
    const double *row = f->course[lane]->task->inputs->table + piece * PIECE;
    f->loaded[lane] = piece;
    AT(f->begin, lane) = row[0];
    AT(f->inverse, lane) = row[1];
    for (int e = 0; e < 4; e++)
        for (int k = 0; k < NU; k++) AT(f->power[e][k], lane) = row[2 + e * NU + k];
    for (int e = 0; e < 4 && DRIVEN; e++)
        for (int j = 0; j < NW; j++)
            for (int part = 0; part < DRIVEN; part++)
                *theta_at(f->tangent[e], DRIVEN, j, part, lane) = row[2 + 4 * NU + e * TANGENTS + part * NW + j];
}

/* Bring the piece that holds at t into a lane whose step spans several. */
static void follow_pieces(struct fleet *f, int lane, double t)
{
    struct course *c = f->course[lane];
    long piece = piece_at(c->task->inputs, f->loaded[lane], f->first_piece[lane], f->last_piece[lane], t);
    if (piece != f->loaded[lane]) load_piece(f, lane, piece);
}

/* Inputs and clocks of every lane at a fraction of its step; rates of the inputs if asked for. */
static void fleet_inputs(struct fleet *f, double fraction, int with_rate)
{
    f->stage_t = f->t + fraction * f->h;
    for (int l = 0; l < LANES; l++)
        if (f->spans[l]) follow_pieces(f, l, AT(f->stage_t, l));
    real r = (f->stage_t - f->begin) * f->inverse;
    for (int k = 0; k < NU; k++)
        f->u[k] = f->power[0][k] + r * (f->power[1][k] + r * (f->power[2][k] + r * f->power[3][k]));
    for (int a = 0; a < NA; a++) f->clock[a] = f->stage_t - f->entry[a];
    for (int k = 0; k < GROUPS * DRIVEN; k++)
        f->us[k] = f->tangent[0][k] + r * (f->tangent[1][k] + r * (f->tangent[2][k] + r * f->tangent[3][k]));
    if (!with_rate) return;
    for (int k = 0; k < NU; k++)
        f->v[k] = (f->power[1][k] + r * (2.0 * f->power[2][k] + 3.0 * r * f->power[3][k])) * f->inverse;
    for (int k = 0; k < GROUPS * DRIVEN; k++)
        f->vs[k] = (f->tangent[1][k] + r * (2.0 * f->tangent[2][k] + 3.0 * r * f->tangent[3][k])) * f->inverse;
}

/* -- equations of all lanes --------------------------------------------------------------------------- */

/* Rate at a stage, or at the end of the step. */
static void fleet_flow(struct fleet *f, int last, real *k, column *ks)
{
    f->at.x = last ? f->x1 : f->stage_x;
    f->at.xs = last ? f->xs1 : f->stage_xs;
#if NW > 0
    flow_theta(&f->at, k, ks);
#else
    (void)ks;
    flow(&f->at, k);
#endif
}

#if LANES == 1
/* Largest element, or NaN if there is one. */
static inline double largest_element(column a)
{
    double found = AT(a, 0);
    for (int k = 1; k < COLUMNS; k++)
        if (AT(a, k) > found || isnan(AT(a, k))) found = AT(a, k);
    return found;
}
#endif

/* Error over tolerance of so many variables from x to x1: root mean square over them, the largest of it and of
 * that of every column. */
static real fleet_norm(struct fleet *f, int rows, const real *x, const real *x1, const real *error,
                       const column *xs, const column *xs1, const column *errors)
{
    real sum = all_lanes(0.0);
    for (int i = 0; i < rows; i++) {
        real size = larger(absolute(x[i]), absolute(x1[i]));
        real e = error[i] / (f->atol + f->rtol * size);
        sum += e * e;
    }
    for (int g = 0; g < GROUPS; g++) {
        const column *now = xs + g * rows, *then = xs1 + g * rows;
        column most = all_columns(1e-6), squares = all_columns(0.0);
        for (int i = 0; i < rows; i++) most = larger(most, absolute(now[i]));
        for (int i = 0; i < rows; i++) {
            column size = larger(absolute(now[i]), absolute(then[i]));
            column e = errors[g * rows + i] / (f->theta_rtol * (size + f->theta_share * most));
            squares += e * e;
        }
#if LANES == 1
        double worst = largest_element(squares);
        if (worst > sum || isnan(worst)) sum = worst;
#else
        sum = choose((squares > sum) | (squares != squares), squares, sum);
#endif
    }
    return root(sum * (1.0 / rows));
}

/* Guards at the end of the step, where the rate of the states is known. */
static void fleet_guards(struct fleet *f)
{
    look(&f->at, f->guard1, f->slope1);
    for (int k = 0; k < GUARDS; k++) {
        f->guard1[k] *= f->sign[k];
        f->slope1[k] *= f->sign[k];
    }
}

/* Lanes in which some guard may cross on the step: by its ends, or by a hump of the cubic between them. */
static lanes_mask fleet_crossings(struct fleet *f)
{
    lanes_mask any = {0};
    for (int k = 0; k < GUARDS; k++) {
        real a = smaller(f->guard[k], all_lanes(0.0)), b = f->guard1[k];
        real rise = a + f->slope[k] * f->h, fall = b - f->slope1[k] * f->h;
        any |= (b > 0.0) | ((f->slope[k] > 0.0) & (f->slope1[k] < 0.0) & (rise > 0.0) & (fall > 0.0));
    }
    return any;
}

#include METHOD

#if WATCHED > 0
/* Watched outputs at the end of the step; lanes in which the cubic through both ends misses the middle. */
static lanes_mask fleet_watch(struct fleet *f)
{
    real middle[AT_LEAST_ONE(WATCHED)];
    lanes_mask missed = {0};
    watch(&f->at, f->watched1, f->watched_rate1);
    method_middle(f, f->stage_x, f->stage_z);
    fleet_inputs(f, 0.5, 0);
    f->at.x = f->stage_x;
    f->at.z = f->stage_z;
    watch_value(&f->at, middle);
    for (int j = 0; j < WATCHED; j++) {
        real cubic = 0.5 * (f->watched[j] + f->watched1[j]) +
                     0.125 * f->h * (f->watched_rate[j] - f->watched_rate1[j]);
        real size = larger(f->largest[j], absolute(f->watched1[j]));
        real off = absolute(middle[j] - cubic);
        missed |= (off > f->watch_tolerance * size + f->watch_floor) | (off != off);
    }
    return missed;
}
#endif

/* -- step sizes --------------------------------------------------------------------------------------- */

/* log2 and 2^x to two digits, which is all that step control needs. */
static double rough_log2(double a)
{
    union { double number; long long whole; } u = {a};
    double exponent = (double)((u.whole >> 52) - 1023);
    u.whole = (u.whole & 0xfffffffffffffLL) | 0x3ff0000000000000LL;
    return exponent + (u.number - 1.0) * (1.3465 - 0.3465 * (u.number - 1.0));
}

static double rough_exp2(double a)
{
    if (a < -60) a = -60;
    if (a > 60) a = 60;
    double whole = floor(a), part = a - whole;
    union { long long whole; double number; } u = {((long long)whole + 1023) << 52};
    return u.number * (1.0 + part * (0.6565 + 0.3435 * part));
}

/* Size of the first step after a restart: one explicit Euler step tells how fast the rate changes. */
static double first_step(struct course *c, const double *rate, double most)
{
    double d0 = 0, d1 = 0, d2 = 0, x[N], rate1[N], z[AT_LEAST_ONE(NZN)];
    const struct options *o = c->options;
    memcpy(z, c->z, NZN * sizeof(double));
    for (int i = 0; i < NX; i++) {
        double weight = o->atol + o->rtol * fabs(c->x[i]);
        d0 += c->x[i] / weight * (c->x[i] / weight);
        d1 += rate[i] / weight * (rate[i] / weight);
    }
    double h = d0 < 1e-10 || d1 < 1e-10 ? 1e-6 : 0.01 * sqrt(d0 / d1);
    h = fmin(h, most);
    for (int i = 0; i < N; i++) x[i] = c->x[i] + h * rate[i];
    course_flow(c, c->t + h, x, z, rate1);
    for (int i = 0; i < NX; i++) {
        double e = (rate1[i] - rate[i]) / (o->atol + o->rtol * fabs(c->x[i]));
        d2 += e * e;
    }
    d1 = sqrt(d1 / NX);
    d2 = sqrt(d2 / NX) / h;
    double fastest = fmax(d1, d2);
    double next = fastest <= 1e-15 ? fmax(1e-6, h * 1e-3) : rough_exp2(CONTROL_REJECTED * rough_log2(0.01 / fastest));
    next = fmin(fmin(100 * h, next), most);
    return next > 0 ? next : 1e-9; /* not finite: the first step will tell */
}

static void lay_fixed(struct fleet *f, int lane, const double *m, const double *mc, const double *entry)
{
    for (int k = 0; k < FIXED; k++) AT(f->m[k], lane) = m[k];
    for (int j = 0; j < NW; j++)
        for (int k = 0; k < FIXED_COLUMNS; k++)
            *theta_at(f->mc, FIXED_COLUMNS, j, k, lane) = mc[j * FIXED_COLUMNS + k];
    for (int a = 0; a < NA; a++) AT(f->entry[a], lane) = entry[a];
}

/* Lay the state of a course on a lane, and its rate. */
static void lay_state(struct fleet *f, int lane, const double *rate)
{
    struct course *c = f->course[lane];
    const struct inputs *in = c->task->inputs;
    AT(f->t, lane) = c->t;
    to_lane(c->x, NX, NW, f->x, f->xs, lane);
    to_lane(c->z, NZ, NW, f->z, f->zs, lane);
    lay_fixed(f, lane, c->m, c->mc, c->entry);
    f->first_piece[lane] = in->section[c->section];
    f->last_piece[lane] = in->section[c->section + 1] - 1;
    load_piece(f, lane, c->piece);
    method_restart(f, lane, rate);
}

/* Take up a course after a jump, or at its begin. */
static void load_lane(struct fleet *f, int lane)
{
    struct course *c = f->course[lane];
    double rate[N], h[AT_LEAST_ONE(GUARDS)], r[AT_LEAST_ONE(GUARDS)];
    course_here(c, rate, h, r);
    lay_state(f, lane, rate);
    for (int k = 0; k < GUARDS; k++) {
        AT(f->sign[k], lane) = c->sign[k];
        AT(f->guard[k], lane) = h[k];
        AT(f->slope[k], lane) = r[k];
    }
    if (c->options->nodes) {
        const struct record *n = &c->record;
        for (int k = 0; k < WATCHED; k++) {
            AT(f->watched[k], lane) = n->node_y[(n->nodes - 1) * WATCHED + k];
            AT(f->watched_rate[k], lane) = n->node_rate[(n->nodes - 1) * WATCHED + k];
            AT(f->largest[k], lane) = c->largest[k];
        }
    }
    f->wanted[lane] = first_step(c, rate, fmin(c->limit - c->t, c->options->longest));
    f->trend[lane] = 0.0;
}

/* Whether the step of a lane leaves the piece of the inputs that is loaded. */
static int leaves_piece(struct fleet *f, int lane, double t1)
{
    const struct inputs *in = f->course[lane]->task->inputs;
    return f->loaded[lane] < f->last_piece[lane] && t1 > in->start[f->loaded[lane] + 1];
}

/* Choose the step of a lane: not past the limit, and no crumb before it. */
static void plan_step(struct fleet *f, int lane)
{
    struct course *c = f->course[lane];
    double left = c->limit - c->t, h = lower(f->wanted[lane], c->options->longest);
    f->last[lane] = h >= left * (1 - 1e-6);
    if (f->last[lane]) h = left;
    else if (2 * h > left) h = 0.5 * left;
    f->step[lane] = h;
    AT(f->h, lane) = h;
    follow_pieces(f, lane, c->t);
    f->spans[lane] = leaves_piece(f, lane, c->t + h);
}

/* Judge the step of a lane: 1 if it is taken; the size of the next follows. */
static int judge_step(struct fleet *f, int lane, double error)
{
    struct course *c = f->course[lane];
    const struct options *o = c->options;
    double h = f->step[lane], t1 = f->last[lane] ? c->limit : c->t + h;
    f->seen[lane] = error <= 1.0 && f->spans[lane] ? course_inputs(c, t1) : INPUTS_ONE_CUBIC;
    if (f->seen[lane] == INPUTS_UNSEEN) error = 16.0;
    if (error <= 1.0) {
        double now = rough_log2(higher(error, 1e-10)), factor;
        factor = 0.9 * rough_exp2(CONTROL_BEFORE * f->trend[lane] - CONTROL_NOW * now);
        factor = lower(6.0, higher(0.2, factor));
        f->trend[lane] = higher(now, -13.0);
        /* a step that was cut by a limit says little about the size that is possible */
        f->wanted[lane] = f->last[lane] || h < f->wanted[lane] ? higher(h * factor, f->wanted[lane]) : h * factor;
        c->accepted++;
        if (c->accepted + c->rejected > o->max_steps) return course_fail(c, TOO_MANY_STEPS, c->t, t1), 0;
        return 1;
    }
    c->rejected++;
    int finite = isfinite(error);
    f->wanted[lane] = h * (finite ? higher(0.2, 0.9 * rough_exp2(-CONTROL_REJECTED * rough_log2(error))) : 0.25);
    if (f->wanted[lane] < 4e-16 * fmax(1.0, fabs(c->t)))
        course_fail(c, finite ? STEP_TOO_SMALL : NOT_FINITE, c->t, t1);
    else if (c->accepted + c->rejected > o->max_steps)
        course_fail(c, TOO_MANY_STEPS, c->t, t1);
    return 0;
}

/* -- the loop ----------------------------------------------------------------------------------------- */

/* Put the next case on a lane; 0 when none is left. */
static int next_case(struct fleet *f, int lane, struct work *w)
{
    struct course *c = f->course[lane];
    while (w->next < w->cases) {
        long number = w->next++;
        f->number[lane] = number;
        if (course_begin(c, w->task + number, w->options)) {
            load_lane(f, lane);
            return 1;
        }
        work_done(w, number, c);
    }
    f->live[lane] = 0;
    f->spans[lane] = 0;
    AT(f->h, lane) = 0.0;
    return 0;
}

/* A step of a lane was taken: record it and see what happened on it. 1 if the lane goes on smoothly. */
static int after_step(struct fleet *f, int lane, int crossing, int missed)
{
    struct course *c = f->course[lane];
    const struct options *o = c->options;
    double t1 = f->last[lane] ? c->limit : c->t + f->step[lane], x1[N], z1[AT_LEAST_ONE(NZN)];
    int varied = f->seen[lane] != INPUTS_ONE_CUBIC;
    int look_closer = crossing || (c->watches_input && varied);
    int refine = missed || (WATCH_READS_INPUT && varied);
    if (o->steps) {
        double *begin = record_step(c, f->step[lane]);
        if (!begin) return 0;
        from_lane(begin, NX, f->x, f->xs, lane);
        from_lane(begin + N, NZ, f->z, f->zs, lane);
    }
    int samples_inside = o->samples && f->step[lane] > o->save_at;
    if (look_closer || refine || samples_inside) method_dense(f, lane, &c->dense);
    if (look_closer) {
        double h0[AT_LEAST_ONE(GUARDS)], r0[AT_LEAST_ONE(GUARDS)], h1[AT_LEAST_ONE(GUARDS)], r1[AT_LEAST_ONE(GUARDS)];
        for (int k = 0; k < GUARDS; k++) {
            h0[k] = AT(f->guard[k], lane), r0[k] = AT(f->slope[k], lane);
            h1[k] = AT(f->guard1[k], lane), r1[k] = AT(f->slope1[k], lane);
        }
        if (course_cross(c, h0, r0, t1, h1, r1)) return 0;
    }
    if (o->nodes) {
        double y1[AT_LEAST_ONE(WATCHED)], r1[AT_LEAST_ONE(WATCHED)];
        for (int k = 0; k < WATCHED; k++) y1[k] = AT(f->watched1[k], lane), r1[k] = AT(f->watched_rate1[k], lane);
        if (!nodes_to(c, t1, y1, r1, refine)) return 0;
        for (int k = 0; k < WATCHED; k++) AT(f->largest[k], lane) = c->largest[k];
    }
    if (f->last[lane] || o->samples) {
        from_lane(x1, NX, f->x1, f->xs1, lane);
        from_lane(z1, NZ, f->z1, f->zs1, lane);
    }
    if (o->samples && !course_record(c, t1, x1, z1)) return 0;
    if (f->last[lane]) {
        course_move(c, t1, x1, z1);
        return 0;
    }
    c->t = t1;
    c->piece = piece_at(c->task->inputs, c->piece, f->first_piece[lane], f->last_piece[lane], t1);
    return 1;
}

/* Run all cases of a piece of work. */
static void sail(struct fleet *f, struct work *w)
{
    int live = 0;
    for (int l = 0; l < LANES; l++) live += f->live[l] = next_case(f, l, w);
    while (live) {
        for (int l = 0; l < LANES; l++)
            if (f->live[l]) plan_step(f, l);
        real error = method_step(f);
        lanes_mask crossing = {0}, smooth = {0}, missed = {0};
        fleet_inputs(f, 1.0, 1);
        f->at.x = f->x1;
        f->at.z = f->z1;
        f->at.d = method_rate(f);
        if (GUARDS) {
            fleet_guards(f);
            crossing = fleet_crossings(f);
        }
#if WATCHED > 0
        if (w->options->nodes) missed = fleet_watch(f);
#endif
        for (int l = 0; l < LANES; l++) {
            if (!f->live[l]) continue;
            int taken = judge_step(f, l, AT(error, l)), goes_on = 0;
            if (!taken && f->course[l]->status != UNDER_WAY) { /* the sentence tells the state at which it ended */
                from_lane(f->course[l]->x, NX, f->x, f->xs, l);
                from_lane(f->course[l]->z, NZ, f->z, f->zs, l);
            }
            if (taken) {
                goes_on = after_step(f, l, lane_of(crossing, l), lane_of(missed, l));
                if (goes_on) set_lane(&smooth, l);
            }
            if (f->course[l]->status != UNDER_WAY) {
                work_done(w, f->number[l], f->course[l]);
                live -= !next_case(f, l, w);
            } else if (taken && !goes_on) {
                load_lane(f, l);
            }
        }
        for (int i = 0; i < NX; i++) f->x[i] = taken_real(smooth, f->x1[i], f->x[i]);
        for (int i = 0; i < GROUPS * NX; i++) f->xs[i] = taken_column(smooth, f->xs1[i], f->xs[i]);
        for (int i = 0; i < NZ; i++) f->z[i] = taken_real(smooth, f->z1[i], f->z[i]);
        for (int i = 0; i < GROUPS * NZ; i++) f->zs[i] = taken_column(smooth, f->zs1[i], f->zs[i]);
        for (int k = 0; k < GUARDS; k++) {
            f->guard[k] = taken_real(smooth, f->guard1[k], f->guard[k]);
            f->slope[k] = taken_real(smooth, f->slope1[k], f->slope[k]);
        }
        for (int k = 0; k < WATCHED; k++) {
            f->watched[k] = taken_real(smooth, f->watched1[k], f->watched[k]);
            f->watched_rate[k] = taken_real(smooth, f->watched_rate1[k], f->watched_rate[k]);
        }
        method_accept(f, smooth);
        for (int l = 0; l < LANES; l++)
            if (f->live[l]) AT(f->t, l) = f->course[l]->t;
    }
}

/* Lanes with memory of their own; null when there is none. */
static struct fleet *fleet_new(struct course *courses, const struct options *o)
{
    size_t whole = (sizeof(struct fleet) + 63) / 64 * 64, part = (sizeof(struct method) + 63) / 64 * 64;
    char *memory = aligned_alloc(64, whole + part);
    if (!memory) return 0;
    memset(memory, 0, whole + part);
    struct fleet *f = (struct fleet *)memory;
    f->method = (struct method *)(memory + whole);
    f->atol = all_lanes(o->atol);
    f->rtol = all_lanes(o->rtol);
    f->theta_rtol = all_lanes(o->theta_rtol);
    f->theta_share = all_lanes(o->theta_share);
    method_prepare(f, o);
    f->watch_tolerance = all_lanes(o->watch_tolerance);
    f->watch_floor = all_lanes(WATCH_FLOOR * o->atol);
    f->inverse = all_lanes(1.0);
    f->at = (struct point){.t = &f->stage_t, .u = f->u, .v = f->v, .c = f->clock, .m = f->m, .z = f->z, .zs = f->zs,
                           .us = f->us, .vs = f->vs, .mc = f->mc};
    for (int l = 0; l < LANES; l++) f->course[l] = courses + l;
    return f;
}

/* Run the cases of a piece of work on LANES lanes; 0 when there is no memory. */
int RUN(struct work *w)
{
    struct course *courses = calloc(LANES, sizeof(struct course));
    struct fleet *f = courses ? fleet_new(courses, w->options) : 0;
    int again = w->functionals || IMPLICIT;
    w->again = again ? again_new(w->options) : 0;
    for (int l = 0; courses && l < LANES; l++) courses[l].again = w->again;
    if (f && (w->again || !again)) sail(f, w);
    else w->next = 0;
    again_free(w->again);
    workspace_free(&w->workspace);
    for (int l = 0; courses && l < LANES; l++) record_free(&courses[l].record);
    free(f);
    free(courses);
    return w->next == w->cases;
}
