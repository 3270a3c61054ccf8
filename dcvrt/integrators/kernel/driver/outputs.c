/* Outputs, their rates and sensitivities on the samples of a course, LANES samples at once. */

/* Arrays are sample-major; derivatives by the thetas themselves are [sample][output][theta], and are left out when
 * `y_theta` is null. */
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
    double inverse[AT_LEAST_ONE(NW)];
    for (int j = 0; j < NW; j++) inverse[j] = 1.0 / theta_scale[j];
    int thetas = y_theta ? NW : 0;
    long laid[LANES], present = -1;
    for (int l = 0; l < LANES; l++) courses[l].task = task, laid[l] = -1, f->loaded[l] = -1;
    f->at.z = f->z1, f->at.zs = f->zs1, f->at.d = d, f->at.ds = ds;
    double m[AT_LEAST_ONE(FIXED)], mc[AT_LEAST_ONE(FIXED_COLUMNS * NW)];
    for (long first = 0; first < n; first += LANES) {
        for (int l = 0; l < LANES; l++) {
            long k = first + l < n ? first + l : n - 1;
            const struct phase *p = phases + phase[k];
            if (present != phase[k]) {
                present = phase[k];
                course_fixed(task->p, p->mode, p->dentry, m, mc);
            }
            if (laid[l] != present) {
                laid[l] = present;
                lay_fixed(f, l, m, mc, p->entry);
            }
            if (f->loaded[l] != piece[k]) load_piece(f, l, piece[k]);
            AT(f->t, l) = t[k];
            to_lane(x + k * N, NX, thetas, f->x1, f->xs1, l);
            to_lane(z + k * NZN, NZ, thetas, f->z1, f->zs1, l);
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
                for (int j = 0; j < thetas; j++) {
                    y_theta[(k * NY + i) * NW + j] = *theta_at(ys, NY, j, i, l) * inverse[j];
                    rate_theta[(k * NY + i) * NW + j] = *theta_at(yrs, NY, j, i, l) * inverse[j];
                }
            }
        }
    }
    free(f);
    free(courses);
    return 1;
}
