/* Nodes of the watched outputs, between which cubics stay close to the solution. Part of course.c. */

enum { MOST_HALVINGS = 8 };

/* Watched outputs and their rates at a time of the step in `dense`. */
static void nodes_on_step(struct course *c, double t, double *y, double *rate)
{
    struct spot s;
    double x[N], z[AT_LEAST_ONE(NZN)];
    dense_at(&c->dense, t, x, z);
    spot_between(&s, c, t, x, z);
    spot_rate(&s, 0);
    watched_at(&s, y, rate);
}

/* Add nodes strictly between two points of a step, until the cubics between them meet the middles. */
static int halve(struct course *c, double ta, const double *ya, const double *ra, double tb, const double *yb,
                 const double *rb, int halvings)
{
    double t = 0.5 * (ta + tb), y[AT_LEAST_ONE(WATCHED)], rate[AT_LEAST_ONE(WATCHED)];
    int missed = 0;
    if (!halvings || tb - ta < SAME_INSTANT) return 1;
    nodes_on_step(c, t, y, rate);
    for (int j = 0; j < WATCHED; j++) {
        double cubic = 0.5 * (ya[j] + yb[j]) + 0.125 * (tb - ta) * (ra[j] - rb[j]);
        double size = higher(c->largest[j], fabs(y[j]));
        missed |= !(fabs(y[j] - cubic) <= c->options->watch_tolerance * size + WATCH_FLOOR * c->options->atol);
    }
    if (!missed) return 1;
    return halve(c, ta, ya, ra, t, y, rate, halvings - 1) && add_node(c, t, y, rate, c->record.steps - 1) &&
           halve(c, t, y, rate, tb, yb, rb, halvings - 1);
}

/* Nodes inside the part of a step from the present time to t1: at knots of the inputs, if a watched output reads
 * them, and where the cubics ask for them. */
static int nodes_inside(struct course *c, double t1, const double *y1, const double *r1)
{
    const struct inputs *in = c->task->inputs;
    const struct record *record = &c->record;
    double t = c->t, y[AT_LEAST_ONE(WATCHED)], r[AT_LEAST_ONE(WATCHED)], ya[AT_LEAST_ONE(WATCHED)],
           ra[AT_LEAST_ONE(WATCHED)];
    long last = last_piece(c);
    memcpy(ya, record->node_y + (record->nodes - 1) * WATCHED, WATCHED * sizeof(double));
    memcpy(ra, record->node_rate + (record->nodes - 1) * WATCHED, WATCHED * sizeof(double));
    for (long knot = c->piece + 1; WATCH_READS_INPUT && knot <= last && in->start[knot] < t1; knot++) {
        if (in->start[knot] <= t) continue;
        nodes_on_step(c, in->start[knot], y, r);
        if (!halve(c, t, ya, ra, in->start[knot], y, r, MOST_HALVINGS) ||
            !add_node(c, in->start[knot], y, r, c->record.steps - 1))
            return 0;
        t = in->start[knot];
        memcpy(ya, y, sizeof ya);
        memcpy(ra, r, sizeof ra);
    }
    return halve(c, t, ya, ra, t1, y1, r1, MOST_HALVINGS);
}

/* The node at the begin of the step that was taken last belongs to it. */
static void own_begin(struct course *c)
{
    struct record *r = &c->record;
    if (r->nodes) r->node_step[r->nodes - 1] = r->steps - 1;
}

/* Nodes of a step from the present time to t1 that ended without a crossing. */
int nodes_to(struct course *c, double t1, const double *y1, const double *r1, int refine)
{
    own_begin(c);
    if (refine && !nodes_inside(c, t1, y1, r1)) return 0;
    return add_node(c, t1, y1, r1, c->record.steps - 1);
}

/* Nodes of the part of a step before a crossing. */
static int nodes_before(struct course *c, double t)
{
    if (!c->options->nodes) return 1;
    double y1[AT_LEAST_ONE(WATCHED)], r1[AT_LEAST_ONE(WATCHED)];
    own_begin(c);
    nodes_on_step(c, t, y1, r1);
    return nodes_inside(c, t, y1, r1);
}
