/* Steps of a finished course made again, for values on their dense output. Part of the scalar unit. */

/* One step with what held on it. */
struct known {
    long step;
    struct dense dense;
    long piece, first, last;
    double entry[AT_LEAST_ONE(NA)], m[AT_LEAST_ONE(FIXED)], mc[AT_LEAST_ONE(FIXED_COLUMNS * NW)];
};

struct again {
    struct fleet *fleet;
    struct course lane; /* carries the state of the step that is made again */
    const struct course *of;
    struct known known[2];
    int newest;
};

void again_free(struct again *a)
{
    if (a) free(a->fleet);
    free(a);
}

struct again *again_new(const struct options *options)
{
    struct again *a = calloc(1, sizeof(struct again));
    if (!a) return 0;
    a->fleet = fleet_new(&a->lane, options);
    if (a->fleet) return a;
    again_free(a);
    return 0;
}

/* Turn to another course. */
static void again_about(struct again *a, const struct course *c)
{
    a->of = c;
    a->known[0].step = a->known[1].step = -1;
}

static long section_of(const struct inputs *in, long piece)
{
    long low = 0, high = in->sections - 1;
    while (low < high) {
        long middle = (low + high + 1) / 2;
        if (in->section[middle] <= piece) low = middle;
        else high = middle - 1;
    }
    return low;
}

/* A step of the lane, of which time, state and mode are set. */
static void make_step(struct again *a, double h, struct dense *dense)
{
    struct fleet *f = a->fleet;
    struct course *c = &a->lane;
    double rate[N];
    course_flow(c, c->t, c->x, c->z, rate);
    lay_state(f, 0, rate);
    AT(f->h, 0) = f->step[0] = h;
    f->spans[0] = leaves_piece(f, 0, c->t + h);
    method_step(f);
    method_dense(f, 0, dense);
}

/* The step that a course has just made, made again with another length: its dense output. */
void step_again(struct course *c, double h)
{
    struct course *lane = &c->again->lane;
    lane->task = c->task;
    lane->options = c->options;
    lane->piece = c->piece;
    lane->section = c->section;
    lane->t = c->dense.t;
    memcpy(lane->x, c->dense.c[0], N * sizeof(double));
    memcpy(lane->z, c->dense.c[0] + N, NZN * sizeof(double));
    memcpy(lane->entry, c->entry, sizeof c->entry);
    memcpy(lane->m, c->m, sizeof c->m);
    memcpy(lane->mc, c->mc, sizeof c->mc);
    make_step(c->again, h, &c->dense);
}

/* A recorded step, made again unless it is one of the last two. */
static struct known *known_step(struct again *a, long step)
{
    for (int n = 0; n < 2; n++)
        if (a->known[n].step == step) return a->newest = n, a->known + n;
    const struct record *r = &a->of->record;
    const struct inputs *in = a->of->task->inputs;
    const struct phase *p = r->phase + r->step_phase[step];
    struct course *c = &a->lane;
    struct fleet *f = a->fleet;
    a->newest = !a->newest;
    struct known *k = a->known + a->newest;
    c->task = a->of->task;
    c->options = a->of->options;
    c->piece = r->step_piece[step];
    c->section = section_of(in, c->piece);
    c->t = r->step_t[step];
    memcpy(c->x, r->step_x + step * ALL, N * sizeof(double));
    memcpy(c->z, r->step_x + step * ALL + N, NZN * sizeof(double));
    memcpy(c->entry, p->entry, sizeof p->entry);
    course_fixed(c->task->p, p->mode, p->dentry, c->m, c->mc);
    make_step(a, r->step_h[step], &k->dense);
    k->step = step;
    k->piece = c->piece;
    k->first = f->first_piece[0];
    k->last = f->last_piece[0];
    memcpy(k->entry, c->entry, sizeof k->entry);
    memcpy(k->m, c->m, sizeof k->m);
    memcpy(k->mc, c->mc, sizeof k->mc);
    return k;
}

#if WATCHED > 0
/* Watched outputs at a time of a step, with their rates and the derivatives of both: see struct track. */
static int watch_again(void *context, long step, double t, double *y, double *rate, double *y_theta,
                       double *rate_theta)
{
    struct again *a = context;
    if (step < 0 || step >= a->of->record.steps) return 1;
    struct known *k = known_step(a, step);
    const struct inputs *in = a->of->task->inputs;
    struct spot s;
    double x[N], z[AT_LEAST_ONE(NZN)];
    dense_at(&k->dense, t, x, z);
    long piece = piece_at(in, k->piece, k->first, k->last, t);
    spot_at(&s, in, piece, t, x, z, k->entry, k->m, k->mc);
    spot_rate(&s, y_theta != 0);
#if NW > 0
    if (y_theta) {
        column ys[GROUPS * WATCHED], yrs[GROUPS * WATCHED];
        watch_theta(&s.at, y, rate, ys, yrs);
        for (int j = 0; j < WATCHED; j++)
            for (int n = 0; n < NW; n++) {
                y_theta[j * NW + n] = AT(ys[n / COLUMNS * WATCHED + j], n % COLUMNS);
                rate_theta[j * NW + n] = AT(yrs[n / COLUMNS * WATCHED + j], n % COLUMNS);
            }
        return 0;
    }
#endif
    (void)rate_theta;
    watch(&s.at, y, rate);
    return 0;
}

/* Functionals of a completed course; 0 if they could not be computed. */
static int functionals_now(struct work *w, long number, struct course *c)
{
    struct record *r = &c->record;
    long last = r->nodes - 1, at = number * w->functionals;
    struct functional_results results = w->functional_results;
    results.value += at, results.time += at, results.place += at, results.tie += at;
    results.gradient += at * NW;
    r->node_step[last] = r->steps - 1;
    if (r->node_break[0] < 0) r->node_kind[0] = PLACE_END;
    if (r->node_break[last] < 0) r->node_kind[last] = PLACE_END;
    again_about(w->again, c);
    struct track track = {
        .n = r->nodes, .ny = WATCHED, .nw = NW, .t = r->node_t, .y = r->node_y, .rate = r->node_rate,
        .step = r->node_step, .kind = r->node_kind, .brk = r->node_break, .dbreak = r->dbreak,
        .evaluate = watch_again, .context = w->again,
    };
    return functionals_of(&track, w->functional, (int)w->functionals, &w->workspace, &results) == FUNCTIONALS_DONE;
}
#endif
