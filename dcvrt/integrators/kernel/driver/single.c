/* The end of a case in a batch; and single cases, kept until Python has read them. Part of the scalar unit. */

static void tell(struct course *c, struct result *r)
{
    r->status = c->status;
    r->detail = c->detail;
    memcpy(r->mode, c->mode, sizeof r->mode);
    r->accepted = c->accepted;
    r->rejected = c->rejected;
    r->events = c->record.events;
    r->t = c->t;
    r->failed_from = c->failed_from;
    r->failed_to = c->failed_to;
    memcpy(r->visited, c->visited, sizeof r->visited);
    memcpy(r->x, c->x, sizeof r->x);
    if (c->status != COMPLETED) {
        struct spot s;
        spot_now(&s, c);
        spot_rate(&s, 0);
        memcpy(r->rate, s.d, sizeof r->rate);
    }
}

void work_done(struct work *w, long number, struct course *c)
{
    if (!w->result) return;
    struct result *r = w->result + number;
    size_t size = (size_t)c->record.events * EVENT * sizeof(double);
    r->event = size ? malloc(size) : 0;
    if (size && !r->event) course_fail(c, NO_MEMORY, c->t, c->t), c->record.events = 0;
    if (r->event) memcpy(r->event, c->record.event, size);
#if WATCHED > 0
    if (w->functionals && c->status == COMPLETED && !functionals_now(w, number, c))
        course_fail(c, NO_MEMORY, c->t, c->t);
#endif
    tell(c, r);
}

void results_free(struct result *r, long n)
{
    for (long i = 0; i < n; i++) free(r[i].event), r[i].event = 0;
}

/* -- single cases ------------------------------------------------------------------------------------- */

struct keep {
    struct course course;
    struct fleet *fleet;
    struct again *again;
    struct options options;
    struct task task;
    struct inputs inputs;
};

/* A place to run one case in; null when there is no memory. */
struct keep *keep_new(void) { return calloc(1, sizeof(struct keep)); }

void keep_free(struct keep *k)
{
    if (!k) return;
    record_free(&k->course.record);
    again_free(k->again);
    free(k->fleet);
    free(k);
}

/* Run one case; what it leaves is read from `view`, until the place is freed or runs another. The arrays of the task must live as
 * long. 0 when there is no memory. */
int keep_run(struct keep *k, const struct task *task, const struct options *options, struct result *result,
             struct record *view)
{
    k->options = *options;
    k->inputs = *task->inputs;
    k->task = *task;
    k->task.inputs = &k->inputs;
    free(k->fleet);
    again_free(k->again);
    k->again = 0;
    k->fleet = fleet_new(&k->course, &k->options);
    k->again = again_new(&k->options);
    if (!k->fleet || !k->again) return 0;
    k->course.again = k->again;
    struct work w = {.task = &k->task, .options = &k->options, .cases = 1};
    sail(k->fleet, &w);
    tell(&k->course, result);
    *view = k->course.record;
    again_about(k->again, &k->course);
    return 1;
}

/* States and algebraic variables at times of recorded steps, by the dense output. */
void keep_states(struct keep *k, long n, const double *t, const long *step, double *x, double *z)
{
    for (long i = 0; i < n; i++) dense_at(&known_step(k->again, step[i])->dense, t[i], x + i * N, z + i * NZN);
}
