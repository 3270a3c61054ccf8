/* Where a run starts: the equilibrium at fixed inputs, as dcvrt/integrators/equilibrium.py finds it, and its
 * derivative by theta. Newton steps have least norm, so that directions which the equations leave open keep
 * their start values. Part of the scalar unit. */

enum { REST = NX + NZ, REST_ITERATIONS = 60, REST_POLISH = 2 };
#define REST_RANK 1e-10
#define REST_RESIDUAL 1e-9
#define REST_ROUGH 1e-3

/* Complete orthogonal factors of a matrix whose rows are scaled to size 1: A P = Q [T 0; 0 0] Z. Columns are
 * stored one after the other; Householder vectors stand below the diagonal (Q) and right of T (Z). */
struct factors {
    int rank, column[REST];
    double a[REST * REST], scale[REST], q[REST], z[REST];
};

#define ELEMENT(i, j) f->a[(j) * REST + (i)]

/* Householder vector of n numbers at a stride: makes all but the first zero; the first becomes the norm. */
static double reflector(double *v, int n, int stride)
{
    double rest = 0, first = v[0];
    for (int i = 1; i < n; i++) rest += v[i * stride] * v[i * stride];
    if (rest == 0) return 0;
    double norm = sqrt(first * first + rest), head = first > 0 ? first + norm : first - norm;
    for (int i = 1; i < n; i++) v[i * stride] /= head;
    v[0] = first > 0 ? -norm : norm;
    return 2 / (1 + rest / (head * head));
}

/* Apply I - beta w w', w = (1, v[1], ...), to numbers at a stride. */
static void reflect(const double *v, int n, int stride, double beta, double *b, int b_stride)
{
    double sum = b[0];
    for (int i = 1; i < n; i++) sum += v[i * stride] * b[i * b_stride];
    sum *= beta;
    b[0] -= sum;
    for (int i = 1; i < n; i++) b[i * b_stride] -= sum * v[i * stride];
}

static int factorise(struct factors *f, const double *jacobian)
{
    for (int i = 0; i < REST; i++) {
        double most = 0;
        for (int j = 0; j < REST; j++) {
            double size = fabs(jacobian[j * REST + i]);
            if (!isfinite(size)) return 0;
            if (size > most) most = size;
        }
        f->scale[i] = most > 0 ? 1 / most : 1;
        for (int j = 0; j < REST; j++) ELEMENT(i, j) = jacobian[j * REST + i] * f->scale[i];
    }
    for (int j = 0; j < REST; j++) f->column[j] = j;
    for (f->rank = 0; f->rank < REST; f->rank++) {
        int k = f->rank, best = k;
        double most = -1;
        for (int j = k; j < REST; j++) {
            double square = 0;
            for (int i = k; i < REST; i++) square += ELEMENT(i, j) * ELEMENT(i, j);
            if (square > most) most = square, best = j;
        }
        if (best != k) {
            int column = f->column[k];
            f->column[k] = f->column[best], f->column[best] = column;
            for (int i = 0; i < REST; i++) {
                double swap = ELEMENT(i, k);
                ELEMENT(i, k) = ELEMENT(i, best), ELEMENT(i, best) = swap;
            }
        }
        if (!(sqrt(most) > REST_RANK * (k ? fabs(ELEMENT(0, 0)) : 0))) break;
        f->q[k] = reflector(&ELEMENT(k, k), REST - k, 1);
        for (int j = k + 1; j < REST; j++) reflect(&ELEMENT(k, k), REST - k, 1, f->q[k], &ELEMENT(k, j), 1);
    }
    /* from the right, last row first: row k acts on its diagonal and on the columns beyond the rank */
    int r = f->rank, open = REST - r;
    for (int k = r - 1; k >= 0 && open; k--) {
        double row[REST + 1];
        row[0] = ELEMENT(k, k);
        for (int j = 0; j < open; j++) row[1 + j] = ELEMENT(k, r + j);
        f->z[k] = reflector(row, open + 1, 1);
        for (int i = 0; i < k; i++) {
            double other[REST + 1];
            other[0] = ELEMENT(i, k);
            for (int j = 0; j < open; j++) other[1 + j] = ELEMENT(i, r + j);
            reflect(row, open + 1, 1, f->z[k], other, 1);
            ELEMENT(i, k) = other[0];
            for (int j = 0; j < open; j++) ELEMENT(i, r + j) = other[1 + j];
        }
        ELEMENT(k, k) = row[0];
        for (int j = 0; j < open; j++) ELEMENT(k, r + j) = row[1 + j];
    }
    return 1;
}

/* s of least norm that makes |A s - b| least; b is used up. */
static void least_norm(const struct factors *f, double *b, double *s)
{
    int r = f->rank, open = REST - r;
    double y[REST] = {0};
    for (int i = 0; i < REST; i++) b[i] *= f->scale[i];
    for (int k = 0; k < r; k++) reflect(&ELEMENT(k, k), REST - k, 1, f->q[k], b + k, 1);
    for (int k = r - 1; k >= 0; k--) {
        y[k] = b[k];
        for (int j = k + 1; j < r; j++) y[k] -= ELEMENT(k, j) * y[j];
        y[k] /= ELEMENT(k, k);
    }
    for (int k = 0; k < r && open; k++) {
        double row[REST + 1], part[REST + 1];
        part[0] = y[k];
        for (int j = 0; j < open; j++) row[1 + j] = ELEMENT(k, r + j), part[1 + j] = y[r + j];
        reflect(row, open + 1, 1, f->z[k], part, 1);
        y[k] = part[0];
        for (int j = 0; j < open; j++) y[r + j] = part[1 + j];
    }
    for (int j = 0; j < REST; j++) s[f->column[j]] = y[j];
}

static double rest_residual(struct spot *s, const double *w, double *residual, double *jacobian)
{
    double size = 0;
    s->at.x = w;
    s->at.z = w + NX;
    rest(&s->at, residual, jacobian);
    for (int i = 0; i < REST; i++)
        if (!(fabs(residual[i]) <= size)) size = fabs(residual[i]);
    return size;
}

/* Equilibrium of one case; x and z with their sensitivities. `tangent`: derivative of the two parts of the phasor
 * by every theta, times scale. 0 if there is none. */
static int rest_of(const double *p, const double *u, const double *tangent, double *x, double *z)
{
    static const double none[AT_LEAST_ONE(NW * NA)] = {0};
    double w[REST], trial[REST], residual[REST], jacobian[REST * REST], b[REST], step[REST];
    double m[AT_LEAST_ONE(FIXED)], mc[AT_LEAST_ONE(FIXED_COLUMNS * NW)];
    struct spot s;
    struct factors f;
    int undamped = 0;
    memset(&s, 0, sizeof s);
    course_fixed(p, start_mode, none, m, mc);
    s.at = (struct point){&s.t, w, w + NX, s.u, s.v, s.c, s.d, m, s.xs, s.zs, s.us, s.vs, s.ds, s.mc};
    memcpy(s.u, u, NU * sizeof(double));
    pack_columns(mc, FIXED_COLUMNS, s.mc);
    pack_columns(tangent, DRIVEN, s.us);
    begin(&s.at, w);
    double size = rest_residual(&s, w, residual, jacobian);
    for (int round = 0; round < REST_ITERATIONS; round++) {
        if (size < REST_RESIDUAL && undamped >= REST_POLISH) break;
        if (!factorise(&f, jacobian)) return 0;
        for (int i = 0; i < REST; i++) b[i] = -residual[i];
        least_norm(&f, b, step);
        double cut = 1, smaller_size;
        for (;;) {
            for (int i = 0; i < REST; i++) trial[i] = w[i] + cut * step[i];
            smaller_size = rest_residual(&s, trial, residual, jacobian);
            if (smaller_size <= (1 - 0.25 * cut) * size || smaller_size < REST_RESIDUAL) break;
            cut /= 2;
            if (cut < 1e-6) return 0;
        }
        undamped += cut == 1 && size < REST_ROUGH;
        memcpy(w, trial, sizeof w);
        size = smaller_size;
    }
    if (!(size < REST_RESIDUAL) || !factorise(&f, jacobian)) return 0;
    memcpy(x, w, NX * sizeof(double));
    memcpy(z, w + NX, NZ * sizeof(double));
#if NW > 0
    double by_theta[NW * REST], start_theta[NW * REST], moved[REST];
    column columns[GROUPS * REST];
    s.at.x = w;
    s.at.z = w + NX;
    rest_theta(&s.at, columns);
    unpack_columns(columns, REST, by_theta);
    begin_theta(&s.at, columns);
    unpack_columns(columns, REST, start_theta);
    for (int j = 0; j < NW; j++) {
        /* the part of the start's derivative that the equations leave open, and their answer to theta */
        const double *start = start_theta + j * REST;
        for (int i = 0; i < REST; i++) {
            b[i] = -by_theta[j * REST + i];
            for (int k = 0; k < REST; k++) b[i] -= jacobian[k * REST + i] * start[k];
        }
        least_norm(&f, b, moved);
        for (int i = 0; i < NX; i++) x[NX + j * NX + i] = start[i] + moved[i];
        for (int i = 0; i < NZ; i++) z[NZ + j * NZ + i] = start[NX + i] + moved[NX + i];
    }
#endif
    return 1;
}

/* Equilibria of many cases; `found` tells which have one. */
void rests_of(long n, const double *p, const double *u, const double *tangent, double *x, double *z, int *found)
{
    for (long k = 0; k < n; k++)
        found[k] = rest_of(p + k * NP, u + k * NU, tangent + k * DRIVEN * NW, x + k * N, z + k * NZN);
}
