/* The equations of a case at one point, on doubles. Part of course.c. */

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
