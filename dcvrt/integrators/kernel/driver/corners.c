/* More samples of a finished course where an output turns a corner that a cubic between two samples misses: see
 * corners.py. Part of the scalar unit. */

/* Room for outputs on as many samples as there is room for, and that for so many at least. */
static int room_with_outputs(struct record *r, long samples)
{
    if (!room_for_samples(r, samples)) return 0;
    if (r->output_room >= r->sample_room) return 1;
    if (!grow(&r->sample_y, NY, r->sample_room) || !grow(&r->sample_rate, NY, r->sample_room)) return 0;
    r->output_room = r->sample_room;
    return 1;
}

/* Whether some output turns a corner between samples i and i + 1; `limit` is what a change of slope times the
 * length may be, `begin` and `end` are the samples of the phase. */
static int is_corner(const struct record *r, long i, long begin, long end, const double *limit, double sharper)
{
    const double *t = r->sample_t, *rate = r->sample_rate + i * NY;
    double h = t[i + 1] - t[i];
    int any = 0;
    for (int j = 0; j < NY; j++) any |= fabs(rate[NY + j] - rate[j]) * h > limit[j];
    for (int j = 0; j < NY && any; j++) {
        double turn = fabs(rate[NY + j] - rate[j]);
        if (!(turn * h > limit[j])) continue;
        double before = i > begin ? fabs(rate[j] - rate[j - NY]) / (t[i] - t[i - 1]) : 0;
        double after = i + 2 < end ? fabs(rate[2 * NY + j] - rate[NY + j]) / (t[i + 2] - t[i + 1]) : 0;
        if (turn / h > sharper * fmax(before, after)) return 1;
    }
    return 0;
}

/* Intervals with a corner, in order: the slope changes by so much that the cubic may be off by `missed` of the
 * output's size, and the curvature is `sharper` times that of both neighbours in the phase. */
static long find_corners(const struct record *r, const struct corners *what, long *found)
{
    long count = 0, n = r->samples;
    for (long begin = 0, end; begin < n; begin = end) {
        double size[AT_LEAST_ONE(NY)], limit[AT_LEAST_ONE(NY)];
        for (int j = 0; j < NY; j++) size[j] = 1e-3;
        for (end = begin; end < n && r->sample_phase[end] == r->sample_phase[begin]; end++)
            for (int j = 0; j < NY; j++) {
                double y = fabs(r->sample_y[end * NY + j]);
                size[j] = y > size[j] ? y : size[j];
            }
        for (int j = 0; j < NY; j++) limit[j] = 8 * what->missed * size[j];
        for (long i = begin; i + 1 < end && end - begin >= 3; i++)
            if (is_corner(r, i, begin, end, limit, what->sharper)) found[count++] = i;
    }
    return count;
}

/* Outputs and their rates at `n` samples from the first one on. */
static int sample_outputs(struct keep *k, struct record *r, long first, long n)
{
    return outputs_on(&k->task, k->course.record.phase, n, r->sample_t + first, r->sample_x + first * N,
                      r->sample_z + first * NZN, r->sample_piece + first, r->sample_phase + first,
                      r->sample_y + first * NY, r->sample_rate + first * NY, 0, 0);
}

/* Samples strictly inside some intervals, parts - 1 in each, one after the other. */
static int between_samples(struct keep *k, int parts, const long *at, long count, struct record *more)
{
    const struct record *r = &k->course.record;
    more->samples = 0;
    if (!room_with_outputs(more, count * (parts - 1))) return 0;
    for (long c = 0; c < count; c++) {
        long i = at[c], step = r->sample_step[i + 1];
        for (int part = 1; part < parts; part++) {
            long n = more->samples++;
            double t = r->sample_t[i] + (r->sample_t[i + 1] - r->sample_t[i]) * part / parts;
            more->sample_t[n] = t;
            more->sample_step[n] = step;
            more->sample_phase[n] = r->sample_phase[i + 1];
            more->sample_piece[n] =
                piece_at(&k->inputs, r->sample_piece[i], r->sample_piece[i], r->sample_piece[i + 1], t);
            dense_at(&known_step(k->again, step)->dense, t, more->sample_x + n * N, more->sample_z + n * NZN);
        }
    }
    return sample_outputs(k, more, 0, more->samples);
}

/* Move `n` samples from one place to another. */
static void move_samples(struct record *to, long at, const struct record *from, long first, long n)
{
#define MOVE(name, width) \
    memmove(to->name + at * (width), from->name + first * (width), (size_t)n * (width) * sizeof *to->name)
    MOVE(sample_t, 1), MOVE(sample_x, N), MOVE(sample_z, NZN), MOVE(sample_y, NY), MOVE(sample_rate, NY);
    MOVE(sample_piece, 1), MOVE(sample_phase, 1), MOVE(sample_step, 1);
#undef MOVE
}

/* Insert samples inside some intervals, equally many in each. */
static int insert_samples(struct record *r, const long *at, long count, const struct record *more)
{
    long inside = more->samples / count, end = r->samples;
    if (!room_with_outputs(r, r->samples + more->samples)) return 0;
    r->samples += more->samples;
    for (long c = count - 1; c >= 0; c--) {
        long from = at[c] + 1;
        move_samples(r, from + (c + 1) * inside, r, from, end - from);
        move_samples(r, from + c * inside, more, c * inside, inside);
        end = from;
    }
    return 1;
}

/* Outputs on the samples of the case, and more samples at corners, again and again inside the new intervals.
 * 0 when there is no memory. */
int keep_samples(struct keep *k, const struct corners *what, struct record *view)
{
    struct record *r = &k->course.record;
    struct record more = {0};
    int done = room_with_outputs(r, r->samples) && sample_outputs(k, r, 0, r->samples);
    long *at = 0;
    for (int level = 0; done && level < what->levels; level++) {
        long *larger = realloc(at, (size_t)(r->samples + 1) * sizeof(long)), count;
        done = larger != 0;
        if (!done) break;
        at = larger;
        count = find_corners(r, what, at);
        if (!count) break;
        done = between_samples(k, what->parts, at, count, &more) && insert_samples(r, at, count, &more);
    }
    free(at);
    record_free(&more);
    *view = *r;
    return done;
}
