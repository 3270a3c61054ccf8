/* One case between its steps: timers, located events, jumps of the automata and of the inputs.
 *
 * Across a jump at t_e with reset R, from dx/dt = f- to f+,
 *     dt_e/dtheta = -h_theta / (dh/dt),   S+ = R_theta + (dR/dt - f+) dt_e/dtheta,
 * where h is the guard and derivatives by theta and along time are total ones at the left of the jump.
 */
#include "kernel.h"

#include <math.h>
#include <string.h>

/* -- the equations at one point ----------------------------------------------------------------------- */

struct spot {
    struct point at;
    double t, u[AT_LEAST_ONE(NU)], v[AT_LEAST_ONE(NU)], c[AT_LEAST_ONE(NA)], d[AT_LEAST_ONE(N)];
    column xs[AT_LEAST_ONE(GROUPS * NX)], zs[AT_LEAST_ONE(GROUPS * NZ)], us[AT_LEAST_ONE(GROUPS * DRIVEN)],
        vs[AT_LEAST_ONE(GROUPS * DRIVEN)], ds[AT_LEAST_ONE(GROUPS * NX)],
        mc[AT_LEAST_ONE(GROUPS * FIXED_COLUMNS)];
};

/* Columns from derivatives that stand theta after theta, and back. */
static void pack_columns(const double *flat, int rows, column *to)
{
    for (int g = 0; g < GROUPS; g++)
        for (int i = 0; i < rows; i++)
            for (int k = 0; k < COLUMNS; k++) {
                int j = g * COLUMNS + k;
                AT(to[g * rows + i], k) = j < NW ? flat[j * rows + i] : 0.0;
            }
}

static void unpack_columns(const column *from, int rows, double *flat)
{
    for (int j = 0; j < NW; j++)
        for (int i = 0; i < rows; i++) flat[j * rows + i] = AT(from[j / COLUMNS * rows + i], j % COLUMNS);
}

static void inputs_at(const struct inputs *in, long piece, double t, struct spot *s)
{
    const double *row = in->table + piece * PIECE, *c0 = row + 2, *c1 = c0 + NU, *c2 = c1 + NU, *c3 = c2 + NU;
    double inverse = row[1], r = (t - row[0]) * inverse;
    for (int k = 0; k < NU; k++) {
        s->u[k] = c0[k] + r * (c1[k] + r * (c2[k] + r * c3[k]));
        s->v[k] = (c1[k] + r * (2 * c2[k] + 3 * r * c3[k])) * inverse;
    }
    const double *d0 = c3 + NU, *d1 = d0 + TANGENTS, *d2 = d1 + TANGENTS, *d3 = d2 + TANGENTS;
    for (int j = 0; j < GROUPS * COLUMNS; j++)
        for (int part = 0; part < DRIVEN; part++) {
            int to = j / COLUMNS * DRIVEN + part, k = part * NW + j, e = j % COLUMNS;
            AT(s->us[to], e) = j < NW ? d0[k] + r * (d1[k] + r * (d2[k] + r * d3[k])) : 0.0;
            AT(s->vs[to], e) = j < NW ? (d1[k] + r * (2 * d2[k] + 3 * r * d3[k])) * inverse : 0.0;
        }
}

/* Lay out a point for the functions of the model; the rate of the states is not known yet. */
static void spot_at(struct spot *s, const struct inputs *in, long piece, double t, const double *x,
                    const double *z, const double *entry, const double *m, const double *mc)
{
    s->t = t;
    inputs_at(in, piece, t, s);
    for (int a = 0; a < NA; a++) s->c[a] = t - entry[a];
    if (NW) {
        pack_columns(x + NX, NX, s->xs);
        pack_columns(z + NZ, NZ, s->zs);
        pack_columns(mc, FIXED_COLUMNS, s->mc);
    }
    s->at = (struct point){&s->t, x, z, s->u, s->v, s->c, s->d, m, s->xs, s->zs, s->us, s->vs, s->ds, s->mc};
}

static void spot_now(struct spot *s, struct course *c)
{
    spot_at(s, c->task->inputs, c->piece, c->t, c->x, c->z, c->entry, c->m, c->mc);
}

/* Rate of the states at the spot, with its sensitivities when they will be needed. */
static void spot_rate(struct spot *s, int with_theta)
{
#if NW > 0
    if (with_theta) {
        flow_theta(&s->at, s->d, s->ds);
        return;
    }
#endif
    (void)with_theta;
    flow(&s->at, s->d);
}

/* The present point with the rate of the states, which is computed once. */
static void spot_rated(struct spot *s, struct course *c)
{
    spot_now(s, c);
    if (c->rated) {
        memcpy(s->d, c->rate, NX * sizeof(double));
        return;
    }
    spot_rate(s, 0);
    memcpy(c->rate, s->d, NX * sizeof(double));
    c->rated = 1;
}

/* Watched outputs and their rates. */
static void watched_at(struct spot *s, double *y, double *rate)
{
#if WATCHED > 0
    watch(&s->at, y, rate);
#else
    (void)s, (void)y, (void)rate;
#endif
}

static long last_piece(const struct course *c) { return c->task->inputs->section[c->section + 1] - 1; }

static void spot_between(struct spot *s, struct course *c, double t, const double *x, const double *z)
{
    const struct inputs *in = c->task->inputs;
    long first = in->section[c->section];
    spot_at(s, in, piece_at(in, c->piece, first, last_piece(c), t), t, x, z, c->entry, c->m, c->mc);
}

void course_flow(struct course *c, double t, const double *x, const double *z, double *f)
{
    struct spot s;
    spot_between(&s, c, t, x, z);
    spot_rate(&s, 1);
    memcpy(f, s.d, NX * sizeof(double));
    unpack_columns(s.ds, NX, f + NX);
}

/* Guards that matter, signed so that they rise when it counts; the others are -1 at rate 0. */
static void signed_guards(const struct course *c, const struct spot *s, double *h, double *rate)
{
    double g[AT_LEAST_ONE(GUARDS)], r[AT_LEAST_ONE(GUARDS)];
    look(&s->at, g, r);
    for (int k = 0; k < GUARDS; k++) {
        h[k] = c->sign[k] != 0 ? c->sign[k] * g[k] : -1.0;
        rate[k] = c->sign[k] * r[k];
    }
}

static void course_guards(struct course *c, double t, const double *x, const double *z, double *h, double *rate)
{
    struct spot s;
    spot_between(&s, c, t, x, z);
    spot_rate(&s, 0);
    signed_guards(c, &s, h, rate);
}

/* Rate of the states with its sensitivities, and guards, at the present point. */
void course_here(struct course *c, double *f, double *h, double *rate)
{
    struct spot s;
    if (NW) {
        spot_now(&s, c);
        spot_rate(&s, 1);
        unpack_columns(s.ds, NX, f + NX);
    } else {
        spot_rated(&s, c);
    }
    memcpy(f, s.d, NX * sizeof(double));
    signed_guards(c, &s, h, rate);
}

/* The cubic a + s (c1 + s (c2 + s c3)) through two values with slopes, s in [0, 1]. */
struct cubic { double a, c1, c2, c3; };

static struct cubic cubic_through(double step, double a, double da, double b, double db)
{
    return (struct cubic){a, da * step, 3 * (b - a) - (2 * da + db) * step, (da + db) * step - 2 * (b - a)};
}

static double cubic_at(const struct cubic *k, double s) { return k->a + s * (k->c1 + s * (k->c2 + s * k->c3)); }

static double cubic_slope(const struct cubic *k, double s) { return k->c1 + s * (2 * k->c2 + 3 * s * k->c3); }

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

/* -- algebraic variables ------------------------------------------------------------------------------ */

#if NZ > 0
/* Solve A y = b by elimination with row exchanges; b holds `columns` right-hand sides. 0 if A is singular. */
static int solve(double *A, double *b, int n, int columns)
{
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(A[k * n + i]) > fabs(A[k * n + best])) best = i;
        if (!(fabs(A[k * n + best]) > 0)) return 0;
        for (int j = 0; j < n; j++) {
            double swap = A[j * n + k];
            A[j * n + k] = A[j * n + best], A[j * n + best] = swap;
        }
        for (int j = 0; j < columns; j++) {
            double swap = b[j * n + k];
            b[j * n + k] = b[j * n + best], b[j * n + best] = swap;
        }
        for (int i = k + 1; i < n; i++) {
            double factor = A[k * n + i] / A[k * n + k];
            for (int j = k; j < n; j++) A[j * n + i] -= factor * A[j * n + k];
            for (int j = 0; j < columns; j++) b[j * n + i] -= factor * b[j * n + k];
        }
    }
    for (int j = 0; j < columns; j++)
        for (int k = n - 1; k >= 0; k--) {
            for (int i = k + 1; i < n; i++) b[j * n + k] -= A[i * n + k] * b[j * n + i];
            b[j * n + k] /= A[k * n + k];
        }
    return 1;
}

/* Newton for 0 = g at fixed states, then the sensitivities of z; 0 when it does not settle. */
static int consistent(const struct inputs *in, long piece, double t, const double *x, double *z,
                      const double *entry, const double *m, const double *mc)
{
    struct spot s;
    double g[NZ], jacobian[NZ * NZ];
    for (int round = 0; round < 50; round++) {
        spot_at(&s, in, piece, t, x, z, entry, m, mc);
        algebra(&s.at, g, jacobian);
        if (!solve(jacobian, g, NZ, 1)) return 0;
        double step = 0, size = 0;
        for (int k = 0; k < NZ; k++) {
            z[k] -= g[k];
            if (!(fabs(g[k]) <= step)) step = fabs(g[k]);
            if (fabs(z[k]) > size) size = fabs(z[k]);
        }
        if (!isfinite(step)) return 0;
        if (step < 1e-12 * (1 + size)) {
#if NW > 0
            double slopes[NZ * NW];
            column columns[GROUPS * NZ];
            spot_at(&s, in, piece, t, x, z, entry, m, mc);
            algebra(&s.at, g, jacobian);
            algebra_theta(&s.at, columns);
            unpack_columns(columns, NZ, slopes);
            if (!solve(jacobian, slopes, NZ, NW)) return 0;
            for (int k = 0; k < NZ * NW; k++) z[NZ + k] = -slopes[k];
#endif
            return 1;
        }
    }
    return 0;
}
#endif

static int make_consistent(struct course *c)
{
#if NZ > 0
    c->rated = 0;
    if (!consistent(c->task->inputs, c->piece, c->t, c->x, c->z, c->entry, c->m, c->mc)) {
        course_fail(c, NOT_CONSISTENT, c->t, c->t);
        return 0;
    }
#else
    (void)c;
#endif
    return 1;
}

/* Algebraic variables at a point of the present phase, from a guess. */
static int algebraics_at(struct course *c, double t, const double *x, double *z)
{
#if NZ > 0
    const struct inputs *in = c->task->inputs;
    long piece = piece_at(in, c->piece, in->section[c->section], last_piece(c), t);
    return consistent(in, piece, t, x, z, c->entry, c->m, c->mc);
#else
    (void)c, (void)t, (void)x, (void)z;
    return 1;
#endif
}

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

/* -- events on guards --------------------------------------------------------------------------------- */

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
