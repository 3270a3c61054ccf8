/* LANES cases beside one another: what they carry, their inputs, and the equations of all of them at once. Part of
 * loop.c. */

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
    int refused[LANES]; /* whether the last try of a step was refused: the next does not grow */
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
