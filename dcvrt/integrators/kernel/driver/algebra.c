/* Algebraic variables that fit states: Newton's method, with their sensitivities. Part of course.c. */

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
