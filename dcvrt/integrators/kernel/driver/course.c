/* One case between its steps: timers, located events, jumps of the automata and of the inputs.
 *
 * Across a jump at t_e with reset R, from dx/dt = f- to f+,
 *     dt_e/dtheta = -h_theta / (dh/dt),   S+ = R_theta + (dR/dt - f+) dt_e/dtheta,
 * where h is the guard and derivatives by theta and along time are total ones at the left of the jump.
 */
#include "kernel.h"

#include <math.h>
#include <string.h>

#include "spot.c"

/* -- modes -------------------------------------------------------------------------------------------- */

void course_fixed(const double *p, const int *mode, const double *dentry, double *m, double *mc)
{
    double q[AT_LEAST_ONE(NQ)];
    column sp[AT_LEAST_ONE(GROUPS * DIRECTIONS)], sc[AT_LEAST_ONE(GROUPS * NA)];
    column columns[AT_LEAST_ONE(GROUPS * FIXED_COLUMNS)];
    int n = 0;
    for (int a = 0; a < NA; a++)
        for (int k = 0; k < flag_width[a]; k++) q[n++] = flag_values[flag_begin[a] + mode[a] * flag_width[a] + k];
    double back[AT_LEAST_ONE(NW * NA)];
    for (int k = 0; k < NW * NA; k++) back[k] = -dentry[k];
    pack_columns(back, NA, sc);
    memset(sp, 0, sizeof sp);
    for (int k = 0; k < DIRECTIONS; k++) {
        int j = direction_column[k];
        AT(sp[j / COLUMNS * DIRECTIONS + k], j % COLUMNS) = direction_scale[k];
    }
    hoist(p, q, sc, sp, m, columns);
    unpack_columns(columns, FIXED_COLUMNS, mc);
}

static void set_signs(struct course *c)
{
    c->watches_input = 0;
    for (int k = 0; k < GUARDS; k++) {
        c->sign[k] = 1.0;
        if (k < ROWS) c->sign[k] = c->mode[row_automaton[k]] != row_source[k] ? 0.0 : isnan(c->armed[k]) ? 1.0 : -1.0;
        if (c->sign[k] != 0.0 && guard_reads_input[k]) c->watches_input = 1;
    }
}

void course_fail(struct course *c, enum status status, double from, double to)
{
    c->status = status;
    c->failed_from = from;
    c->failed_to = to;
}

#include "algebra.c"
#include "record.c"
#include "nodes.c"

/* -- jumps -------------------------------------------------------------------------------------------- */

static int add_event(struct course *c, int row, const int *ties, const double *dte)
{
    struct record *r = &c->record;
    if (!grow_events(r)) return course_fail(c, NO_MEMORY, c->t, c->t), 0;
    double *e = r->event + EVENT * r->events++;
    e[0] = c->t;
    e[1] = row;
    for (int k = 0; k < ROWS; k++) e[2 + k] = ties[k];
    for (int j = 0; j < NW; j++) e[2 + ROWS + j] = dte[j];
    if (r->events > MAX_EVENTS) return course_fail(c, TOO_MANY_EVENTS, c->t, c->t), 0;
    return 1;
}

/* Apply one row. */
static int jump(struct course *c, int row, const int *ties, const double *dte)
{
    struct spot s;
    double moved[NX];
    if (c->jumps <= MAX_JUMPS_AT_ONCE) c->visited[c->jumps] = row;
    if (++c->jumps > MAX_JUMPS_AT_ONCE) return course_fail(c, CHATTER, c->t, c->t), 0;
    spot_rated(&s, c);
    memcpy(moved, s.d, sizeof moved);
    if (row_resets[row]) {
        double after[NX];
        reset_of(row, &s.at, after, moved);
#if NW > 0
        column afters[GROUPS * NX];
        reset_theta_of(row, &s.at, afters);
        unpack_columns(afters, NX, c->x + NX);
#endif
        memcpy(c->x, after, sizeof after);
    }
    int a = row_automaton[row];
    c->mode[a] = row_target[row];
    c->entry[a] = c->t;
    for (int j = 0; j < NW; j++) c->dentry[j * NA + a] = dte[j];
    for (int k = 0; k < ROWS; k++)
        if (row_automaton[k] == a) c->armed[k] = NAN;
    course_fixed(c->task->p, c->mode, c->dentry, c->m, c->mc);
    c->rated = 0;
    if (!make_consistent(c)) return 0;
    if (NW) {
        spot_rated(&s, c);
        for (int j = 0; j < NW; j++)
            for (int i = 0; i < NX; i++) c->x[NX + j * NX + i] += (moved[i] - s.d[i]) * dte[j];
        if (!make_consistent(c)) return 0;
    }
    return add_event(c, row, ties, dte);
}

/* Which guards are positive just after this instant; `forced` is one that was located here. */
static void positive_now(struct course *c, int forced, int value, int *positive)
{
    struct spot s;
    double g[AT_LEAST_ONE(GUARDS)], rate[AT_LEAST_ONE(GUARDS)];
    if (!ROWS) return;
    spot_rated(&s, c);
    look(&s.at, g, rate);
    for (int k = 0; k < ROWS; k++)
        positive[k] = fabs(g[k]) <= fabs(rate[k]) * SAME_INSTANT ? rate[k] > 0 : g[k] > 0;
    if (forced >= 0) positive[forced] = value;
}

/* First row that is due, or -1; `ties` marks the further ones of the same automaton. */
static int ready_row(struct course *c, const int *positive, int due, int *ties)
{
    int found = -1;
    for (int k = 0; k < ROWS; k++) {
        int active = c->mode[row_automaton[k]] == row_source[k];
        int timed_out = c->armed[k] + c->held[k] <= c->t + SAME_INSTANT;
        int ready = (active && positive[k] && (c->held[k] <= 0 || timed_out)) || k == due;
        ties[k] = ready && found >= 0 && row_automaton[k] == row_automaton[found];
        if (ready && found < 0) found = k;
    }
    return found;
}

static void set_timers(struct course *c, const int *positive, const double *dte)
{
    for (int k = 0; k < ROWS; k++) {
        if (!(c->held[k] > 0) || c->mode[row_automaton[k]] != row_source[k]) continue;
        if (!positive[k]) {
            c->armed[k] = NAN;
        } else if (isnan(c->armed[k])) {
            c->armed[k] = c->t;
            for (int j = 0; j < NW; j++) c->darmed[k * NW + j] = dte[j];
        }
    }
}

/* Apply every row that is due at this instant, then start and stop timers. `forced` is a guard known to be
 * positive or not just after this instant, since its crossing was located here; `due` a row whose timer has
 * run out; both -1 if there is none. */
static int settle(struct course *c, const double *given, int forced, int value, int due, int first)
{
    int positive[AT_LEAST_ONE(ROWS)] = {0}, ties[AT_LEAST_ONE(ROWS)] = {0}, jumped = 0, row;
    double dte[AT_LEAST_ONE(NW)];
    memcpy(dte, given, NW * sizeof(double));
    if (c->t - c->instant > SAME_INSTANT) c->instant = c->t, c->jumps = 0;
    if (first && !open_phase(c)) return 0;
    for (;;) {
        positive_now(c, forced, value, positive);
        row = ready_row(c, positive, due, ties);
        if (row < 0) break;
        if (first && !jumped && !emit_now(c)) return 0;
        if (!jump(c, row, ties, dte)) return 0;
        jumped = 1;
        due = -1;
        if (forced >= 0 && row_automaton[forced] == row_automaton[row]) forced = -1;
    }
    if (jumped) {
        if (!begin_phase(c, dte, PLACE_EVENT)) return 0;
    } else if (first) {
        if (!make_consistent(c) || !emit_now(c)) return 0;
    }
    set_timers(c, positive, dte);
    set_signs(c);
    return 1;
}

/* -- what comes next ---------------------------------------------------------------------------------- */

static int within_bounds(struct course *c)
{
    for (int k = 0; k < BOUNDS; k++)
        if (bound_sign[k] * (c->x[bound_state[k]] - bound_value[k]) > 1e-9 * (1 + fabs(bound_value[k]))) {
            c->detail = k;
            course_fail(c, LEFT_BOUNDS, c->t, c->t);
            return 0;
        }
    return 1;
}

static int enter_section(struct course *c, long number)
{
    static const double none[AT_LEAST_ONE(NW)] = {0};
    const struct inputs *in = c->task->inputs;
    c->section = number;
    c->piece = in->section[number];
    c->border = in->start[in->section[number + 1]];
    c->rated = 0;
    if (!number && !make_consistent(c)) return 0;
    if (!within_bounds(c)) return 0;
    if (number && !begin_phase(c, none, PLACE_JUMP)) return 0;
    return settle(c, none, -1, 0, -1, number == 0);
}

/* When the first timer runs out, and its row. */
static double next_timer(const struct course *c, int *row)
{
    double fires = INFINITY;
    for (int k = 0; k < ROWS; k++)
        if (c->armed[k] + c->held[k] < fires) fires = c->armed[k] + c->held[k], *row = k;
    return fires;
}

/* Make the jumps that are due now and set where the next step has to end; 0 when the course is over. A timer
 * that runs out at the instant of an input jump fires before it, since its guard held until then. */
static int next_limit(struct course *c)
{
    while (c->status == UNDER_WAY) {
        int row = -1, at_border = c->t >= c->border;
        double fires = next_timer(c, &row);
        if (at_border && !(fires <= c->t + SAME_INSTANT)) {
            if (c->section + 1 >= c->task->inputs->sections) {
                c->status = COMPLETED;
                break;
            }
            enter_section(c, c->section + 1);
            continue;
        }
        if (!at_border) {
            c->limit = fires < c->border ? fires : c->border;
            if (c->limit - c->t > LOCATED) return 1;
            be_at(c, c->limit);
            if (fires > c->limit) continue;
        }
        double dte[AT_LEAST_ONE(NW)];
        for (int j = 0; j < NW; j++) dte[j] = c->darmed[row * NW + j] + c->dheld[row * NW + j];
        settle(c, dte, -1, 0, row, 0);
    }
    return 0;
}

int course_begin(struct course *c, const struct task *task, const struct options *options)
{
    const struct inputs *in = task->inputs;
    struct spot s;
    record_clear(&c->record);
    c->task = task;
    c->options = options;
    c->t = in->start[0];
    c->rated = 0;
    memcpy(c->x, task->x, N * sizeof(double));
    memcpy(c->z, task->z, NZN * sizeof(double));
    c->piece = c->section = 0;
    c->instant = -INFINITY;
    c->jumps = c->detail = 0;
    c->accepted = c->rejected = 0;
    c->status = UNDER_WAY;
    memset(c->largest, 0, sizeof c->largest);
    for (int a = 0; a < NA; a++) c->mode[a] = start_mode[a], c->entry[a] = c->t;
    memset(c->dentry, 0, sizeof c->dentry);
    for (int k = 0; k < ROWS; k++) c->armed[k] = NAN;
    course_fixed(task->p, c->mode, c->dentry, c->m, c->mc);
    spot_now(&s, c);
    held_of(&s.at, c->held);
#if NW > 0
    column helds[AT_LEAST_ONE(GROUPS * ROWS)];
    double flat[AT_LEAST_ONE(NW * ROWS)];
    held_theta(&s.at, helds);
    unpack_columns(helds, ROWS, flat);
    for (int k = 0; k < ROWS; k++)
        for (int j = 0; j < NW; j++) c->dheld[k * NW + j] = flat[j * ROWS + k];
#endif
    return enter_section(c, 0) && next_limit(c);
}

/* The step ends at t, a limit, and no guard crossed on the way: what is due there. */
int course_move(struct course *c, double t, const double *x, const double *z)
{
    const struct inputs *in = c->task->inputs;
    c->piece = piece_at(in, c->piece, in->section[c->section], last_piece(c), t);
    c->t = t;
    c->rated = 0;
    memcpy(c->x, x, N * sizeof(double));
    memcpy(c->z, z, NZN * sizeof(double));
    return next_limit(c);
}

/* What the inputs do on a step to t1, by how far they are at the knots inside off the cubic through their values
 * and rates at its ends. A step that spans whole pieces must stay near it, or stages may lie on either side of a
 * pulse. */
enum seen course_inputs(struct course *c, double t1)
{
    const struct inputs *in = c->task->inputs;
    long last = last_piece(c), knot = c->piece + 1;
    while (knot <= last && in->start[knot] <= c->t) knot++;
    struct spot a, b, s;
    struct cubic cubic[AT_LEAST_ONE(NU)];
    double h = t1 - c->t, near = 100 * (c->options->rtol + c->options->atol);
    double smooth = ONE_CUBIC * c->options->watch_tolerance, off = 0, off_rate = 0;
    int spans_pieces = knot + 1 <= last && in->start[knot + 1] < t1;
    inputs_at(in, piece_at(in, c->piece, 0, last, c->t), c->t, &a);
    inputs_at(in, piece_at(in, c->piece, 0, last, t1), t1, &b);
    for (int k = 0; k < NU; k++) cubic[k] = cubic_through(h, a.u[k], a.v[k], b.u[k], b.v[k]);
    for (; knot <= last && in->start[knot] < t1; knot++) {
        double at = (in->start[knot] - c->t) / h;
        inputs_at(in, knot, in->start[knot], &s);
        for (int k = 0; k < NU; k++) {
            off = higher(fabs(s.u[k] - cubic_at(cubic + k, at)), off);
            off_rate = higher(fabs(s.v[k] * h - cubic_slope(cubic + k, at)), off_rate);
        }
        if (spans_pieces && !(off <= near)) return INPUTS_UNSEEN;
    }
    return off <= smooth && off_rate <= smooth ? INPUTS_ONE_CUBIC : INPUTS_SEEN;
}

#include "crossing.c"
