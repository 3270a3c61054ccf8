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

#include "fleet.c"

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
    f->refused[lane] = 0;
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
        factor = lower(f->refused[lane] ? 1.0 : 6.0, higher(0.2, factor));
        f->refused[lane] = 0;
        f->trend[lane] = higher(now, -13.0);
        /* a step that was cut by a limit says little about the size that is possible */
        f->wanted[lane] = f->last[lane] || h < f->wanted[lane] ? higher(h * factor, f->wanted[lane]) : h * factor;
        f->wanted[lane] = lower(f->wanted[lane], method_reach(f, lane));
        c->accepted++;
        if (c->accepted + c->rejected > o->max_steps) return course_fail(c, TOO_MANY_STEPS, c->t, t1), 0;
        return 1;
    }
    c->rejected++;
    f->refused[lane] = 1;
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
