/* What a course leaves behind: samples, steps, nodes, events. Part of course.c. */
#include <stdlib.h>

/* Make room for one more in arrays of `width` doubles each. */
static int grow(double **array, long width, long room)
{
    double *larger = realloc(*array, (size_t)room * (size_t)AT_LEAST_ONE(width) * sizeof(double));
    if (larger) *array = larger;
    return larger != 0;
}

static int grow_longs(long **array, long room)
{
    long *larger = realloc(*array, (size_t)room * sizeof(long));
    if (larger) *array = larger;
    return larger != 0;
}

static int grow_bytes(unsigned char **array, long room)
{
    unsigned char *larger = realloc(*array, (size_t)room);
    if (larger) *array = larger;
    return larger != 0;
}

/* Room for so many samples. */
static int room_for_samples(struct record *r, long n)
{
    if (n <= r->sample_room) return 1;
    long room = 2 * r->sample_room > n ? 2 * r->sample_room : n;
    if (room < 4096) room = 4096;
    if (!grow(&r->sample_t, 1, room) || !grow(&r->sample_x, N, room) || !grow(&r->sample_z, NZN, room) ||
        !grow_longs(&r->sample_piece, room) || !grow_longs(&r->sample_phase, room) ||
        !grow_longs(&r->sample_step, room))
        return 0;
    r->sample_room = room;
    return 1;
}

static int grow_steps(struct record *r)
{
    if (r->steps < r->step_room) return 1;
    long room = r->step_room ? 2 * r->step_room : 1024;
    if (!grow(&r->step_t, 1, room) || !grow(&r->step_h, 1, room) || !grow(&r->step_x, ALL, room) ||
        !grow_longs(&r->step_piece, room) || !grow_longs(&r->step_phase, room))
        return 0;
    r->step_room = room;
    return 1;
}

static int grow_nodes(struct record *r)
{
    if (r->nodes < r->node_room) return 1;
    long room = r->node_room ? 2 * r->node_room : 1024;
    if (!grow(&r->node_t, 1, room) || !grow(&r->node_y, WATCHED, room) || !grow(&r->node_rate, WATCHED, room) ||
        !grow_longs(&r->node_step, room) || !grow_longs(&r->node_break, room) ||
        !grow_bytes(&r->node_kind, room))
        return 0;
    r->node_room = room;
    return 1;
}

static int grow_events(struct record *r)
{
    if (r->events < r->event_room) return 1;
    long room = r->event_room ? 2 * r->event_room : 64;
    if (!grow(&r->event, EVENT, room)) return 0;
    r->event_room = room;
    return 1;
}

static int grow_phases(struct record *r)
{
    if (r->phases < r->phase_room) return 1;
    long room = r->phase_room ? 2 * r->phase_room : 64;
    struct phase *larger = realloc(r->phase, (size_t)room * sizeof(struct phase));
    if (!larger) return 0;
    r->phase = larger;
    if (!grow(&r->dbreak, NW, room) || !grow_bytes(&r->break_kind, room)) return 0;
    r->phase_room = room;
    return 1;
}

static void record_clear(struct record *r)
{
    r->samples = r->steps = r->nodes = r->events = r->phases = r->breaks = 0;
}

void record_free(struct record *r)
{
    free(r->sample_t), free(r->sample_x), free(r->sample_z), free(r->sample_y), free(r->sample_rate);
    free(r->sample_piece), free(r->sample_phase), free(r->sample_step);
    free(r->step_t), free(r->step_h), free(r->step_x), free(r->step_piece), free(r->step_phase);
    free(r->node_t), free(r->node_y), free(r->node_rate), free(r->node_step), free(r->node_break);
    free(r->node_kind), free(r->event), free(r->phase), free(r->dbreak), free(r->break_kind);
    *r = (struct record){0};
}

/* -- samples and nodes -------------------------------------------------------------------------------- */

static int out_of_memory(struct course *c)
{
    course_fail(c, NO_MEMORY, c->t, c->t);
    return 0;
}

static int add_sample(struct course *c, double t, const double *x, const double *z, long piece)
{
    struct record *r = &c->record;
    if (!room_for_samples(r, r->samples + 1)) return out_of_memory(c);
    long k = r->samples++;
    r->sample_t[k] = t;
    memcpy(r->sample_x + k * N, x, N * sizeof(double));
    memcpy(r->sample_z + k * NZN, z, NZN * sizeof(double));
    r->sample_piece[k] = piece;
    r->sample_phase[k] = r->phases - 1;
    r->sample_step[k] = r->steps - 1;
    return 1;
}

static int add_node(struct course *c, double t, const double *y, const double *rate, long step)
{
    struct record *r = &c->record;
    if (!grow_nodes(r)) return out_of_memory(c);
    long k = r->nodes++;
    r->node_t[k] = t;
    for (int j = 0; j < WATCHED; j++) {
        r->node_y[k * WATCHED + j] = y[j];
        r->node_rate[k * WATCHED + j] = rate[j];
        c->largest[j] = higher(fabs(y[j]), c->largest[j]);
    }
    r->node_step[k] = step;
    r->node_break[k] = -1;
    r->node_kind[k] = PLACE_INSIDE;
    return 1;
}

/* Store the present values, once. */
static int emit_now(struct course *c)
{
    struct record *r = &c->record;
    if (c->options->nodes) {
        long begin = r->phase[r->phases - 1].first_node;
        if (r->nodes == begin || r->node_t[r->nodes - 1] != c->t) {
            double y[AT_LEAST_ONE(WATCHED)], rate[AT_LEAST_ONE(WATCHED)];
            struct spot s;
            spot_rated(&s, c);
            watched_at(&s, y, rate);
            if (!add_node(c, c->t, y, rate, r->steps)) return 0;
        }
    }
    if (!c->options->samples) return 1;
    long first = r->phase[r->phases - 1].first_sample;
    if (r->samples > first && r->sample_t[r->samples - 1] == c->t) return 1;
    return add_sample(c, c->t, c->x, c->z, c->piece);
}

/* Samples strictly inside the part of a step that ends at `until`. */
int record_samples(struct course *c, const struct dense *d, double until)
{
    if (!c->options->samples) return 1;
    const struct inputs *in = c->task->inputs;
    double x[N], z[AT_LEAST_ONE(NZN)], begin = c->t;
    long first = in->section[c->section], last = last_piece(c), piece = c->piece;
    long parts = (long)ceil((until - begin) / c->options->save_at - 1e-6);
    for (long k = 1; k < parts; k++) {
        double t = begin + (until - begin) * (double)k / (double)parts;
        dense_at(d, t, x, z);
        piece = piece_at(in, piece, first, last, t);
        if (!add_sample(c, t, x, z, piece)) return 0;
    }
    return 1;
}

/* Remember a step from the present time on, so that its dense output can be had again. Returns where its first
 * states and algebraic variables are to be written; null when there is no memory. */
double *record_step(struct course *c, double h)
{
    struct record *r = &c->record;
    if (!grow_steps(r)) return out_of_memory(c), (double *)0;
    long k = r->steps++;
    r->step_t[k] = c->t;
    r->step_h[k] = h;
    r->step_piece[k] = c->piece;
    r->step_phase[k] = r->phases - 1;
    return r->step_x + k * ALL;
}

/* Take a time that differs from the present by round-off for the present. */
static void be_at(struct course *c, double t)
{
    struct record *r = &c->record;
    struct phase *last = r->phase + r->phases - 1;
    if (r->samples && r->sample_t[r->samples - 1] == c->t) r->sample_t[r->samples - 1] = t;
    if (r->nodes && r->node_t[r->nodes - 1] == c->t) r->node_t[r->nodes - 1] = t;
    if (last->t == c->t) last->t = t;
    c->t = t;
    c->rated = 0;
}

static int open_phase(struct course *c)
{
    struct record *r = &c->record;
    if (!grow_phases(r)) return out_of_memory(c);
    struct phase *p = r->phase + r->phases++;
    p->t = c->t;
    memcpy(p->entry, c->entry, sizeof p->entry);
    memcpy(p->dentry, c->dentry, sizeof p->dentry);
    memcpy(p->mode, c->mode, sizeof p->mode);
    p->first_sample = r->samples;
    p->first_node = r->nodes;
    return 1;
}

/* The last node stands at a break; until something follows, the last step is the one that ends there. */
static void mark_break(struct record *r, long number)
{
    if (!r->nodes) return;
    long k = r->nodes - 1;
    int left = r->phase[r->phases - 1].first_node > k;
    r->node_kind[k] = r->break_kind[number];
    r->node_break[k] = number;
    if (left) r->node_step[k] = r->steps - 1;
}

/* Start a new phase with the present values as its first sample. */
static int begin_phase(struct course *c, const double *dte, int kind)
{
    struct record *r = &c->record;
    struct phase *last = r->phase + r->phases - 1;
    if (r->phases > 1 && last->t == c->t) { /* passed through at this instant: a time stands at most twice */
        r->samples = last->first_sample;
        r->nodes = last->first_node;
        r->phases--;
        r->breaks--;
    }
    long k = r->breaks++;
    if (!open_phase(c)) return 0;
    memcpy(r->dbreak + k * NW, dte, NW * sizeof(double));
    r->break_kind[k] = (unsigned char)kind;
    mark_break(r, k);
    if (!make_consistent(c) || !emit_now(c)) return 0;
    mark_break(r, k);
    return 1;
}

/* A step from the present time to t1, where the states are x1, was taken without a jump. */
int course_record(struct course *c, double t1, const double *x1, const double *z1)
{
    const struct inputs *in = c->task->inputs;
    if (!record_samples(c, &c->dense, t1)) return 0;
    if (!c->options->samples) return 1;
    return add_sample(c, t1, x1, z1, piece_at(in, c->piece, in->section[c->section], last_piece(c), t1));
}
