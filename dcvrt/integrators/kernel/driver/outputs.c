/* Outputs, their rates and sensitivities on the samples of a course, LANES samples at once. */

/* Intervals between samples in which an output turns a corner that its cubic misses, as corners.py finds them:
 * the slope changes by so much that the cubic may be off by `missed` of the output's size, and the curvature is
 * `sharper` times that of both neighbours in the phase. Returns how many. */
long corners_at(long n, const double *t, const double *y, const double *rate, const long *phase, double missed,
                double sharper, long *found)
{
    long count = 0;
    for (long begin = 0, end; begin < n; begin = end) {
        double size[AT_LEAST_ONE(NY)];
        for (int j = 0; j < NY; j++) size[j] = 1e-3;
        for (end = begin; end < n && phase[end] == phase[begin]; end++)
            for (int j = 0; j < NY; j++) size[j] = fmax(size[j], fabs(y[end * NY + j]));
        if (end - begin < 3) continue;
        for (long i = begin; i + 1 < end; i++) {
            double h = t[i + 1] - t[i];
            for (int j = 0; j < NY; j++) {
                const double *r = rate + i * NY + j;
                double turn = fabs(r[NY] - r[0]);
                if (!(turn * h > 8 * missed * size[j])) continue;
                double before = i > begin ? fabs(r[0] - r[-NY]) / (t[i] - t[i - 1]) : 0;
                double after = i + 2 < end ? fabs(r[2 * NY] - r[NY]) / (t[i + 2] - t[i + 1]) : 0;
                if (turn / h > sharper * fmax(before, after)) {
                    found[count++] = i;
                    break;
                }
            }
        }
    }
    return count;
}

/* Arrays are sample-major; derivatives by theta are [sample][output][theta], times the scale of theta, and are
 * left out when `y_theta` is null. */
int outputs_on(const struct task *task, const struct phase *phases, long n, const double *t, const double *x,
               const double *z, const long *piece, const long *phase, double *y, double *rate,
               double *y_theta, double *rate_theta)
{
    struct options none = {0};
    struct course *courses = calloc(LANES, sizeof(struct course));
    struct fleet *f = courses ? fleet_new(courses, &none) : 0;
    if (!f) return free(courses), 0;
    real d[NX], lane_y[AT_LEAST_ONE(NY)], lane_rate[AT_LEAST_ONE(NY)];
    column ds[AT_LEAST_ONE(GROUPS * NX)];
    column ys[AT_LEAST_ONE(GROUPS * NY)], yrs[AT_LEAST_ONE(GROUPS * NY)];
    long laid[LANES];
    for (int l = 0; l < LANES; l++) courses[l].task = task, laid[l] = -1, f->loaded[l] = -1;
    f->at.z = f->z1, f->at.zs = f->zs1, f->at.d = d, f->at.ds = ds;
    for (long first = 0; first < n; first += LANES) {
        for (int l = 0; l < LANES; l++) {
            long k = first + l < n ? first + l : n - 1;
            struct course *c = courses + l;
            if (laid[l] != phase[k]) {
                const struct phase *p = phases + phase[k];
                laid[l] = phase[k];
                course_fixed(task->p, p->mode, p->dentry, c->m, c->mc);
                lay_fixed(f, l, c->m, c->mc, p->entry);
            }
            if (f->loaded[l] != piece[k]) load_piece(f, l, piece[k]);
            AT(f->t, l) = t[k];
            to_lane(x + k * N, NX, f->x1, f->xs1, l);
            to_lane(z + k * NZN, NZ, f->z1, f->zs1, l);
        }
        fleet_inputs(f, 0.0, 1);
        f->at.x = f->x1;
        f->at.xs = f->xs1;
#if NW > 0
        if (y_theta) {
            flow_theta(&f->at, d, ds);
            outputs_theta(&f->at, lane_y, lane_rate, ys, yrs);
        } else
#endif
        {
            flow(&f->at, d);
            outputs(&f->at, lane_y, lane_rate);
        }
        for (int l = 0; l < LANES && first + l < n; l++) {
            long k = first + l;
            for (int i = 0; i < NY; i++) {
                y[k * NY + i] = AT(lane_y[i], l);
                rate[k * NY + i] = AT(lane_rate[i], l);
                for (int j = 0; j < NW && y_theta; j++) {
                    y_theta[(k * NY + i) * NW + j] = *theta_at(ys, NY, j, i, l);
                    rate_theta[(k * NY + i) * NW + j] = *theta_at(yrs, NY, j, i, l);
                }
            }
        }
    }
    free(f);
    free(courses);
    return 1;
}
