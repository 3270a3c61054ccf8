/* Products of impedances and source currents: in double precision, and of changes in single precision. */
#ifndef DCVRT_PRODUCTS_H
#define DCVRT_PRODUCTS_H

#include "run.h"

enum { AT_PORTS = 1, AT_POINTS = 2 };

/* Blocks of rows of a product under way at once, as many as the registers hold: a sum waits for the one before it. */
#if defined(__AVX512F__)
enum { AT_ONCE = 4 };
#else
enum { AT_ONCE = 2 };
#endif

/* Blocks of rows [from, to) of Z times `count` columns of `fed`, into real parts at `v` and imaginary ones `apart` from
 * them, `wide` blocks at a time. Gives the first block that is left. */
static inline __attribute__((always_inline)) long product(const struct run *r, const double *z, int count, int wide,
                                                          double *v, long stride_v, long apart, long from, long to,
                                                          int add)
{
    long feeds = r->fleet->feeds, each = feeds * 2 * BLOCK;
    long b = from;
    for (; b + wide <= to; b += wide) {
        const double *at = z + b * each, *fed = r->fed;
        block re[12], im[12];
        for (int k = 0; k < wide * count; k++) re[k] = im[k] = (block){0};
        for (long j = 0; j < feeds; j++, at += 2 * BLOCK)
            for (int w = 0; w < wide; w++) {
                block zr = *(const block *)(at + w * each), zi = *(const block *)(at + w * each + BLOCK);
                for (int k = 0; k < count; k++) {
                    int e = w * count + k;
                    double real = fed[2 * k * feeds + j], imaginary = fed[(2 * k + 1) * feeds + j];
                    re[e] += zr * real, im[e] += zr * imaginary;
                    re[e] -= zi * imaginary, im[e] += zi * real;
                }
            }
        for (int w = 0; w < wide; w++)
            for (int k = 0; k < count; k++) {
                double *vr = v + k * stride_v + (b - from + w) * BLOCK;
                block *real = (block *)vr, *imaginary = (block *)(vr + apart);
                int e = w * count + k;
                if (add) *real += re[e], *imaginary += im[e];
                else *real = re[e], *imaginary = im[e];
            }
    }
    return b;
}

/* Blocks of rows [from, to) of Z times the columns of `fed`. */
static void blocks(const struct run *r, const double *z, int count, double *v, long stride_v, long apart, long from,
                   long to, int add)
{
    long b = from;
    switch (count) {
    case 1:
        b = product(r, z, 1, AT_ONCE, v, stride_v, apart, b, to, add);
        b = product(r, z, 1, 2, v + (b - from) * BLOCK, stride_v, apart, b, to, add);
        product(r, z, 1, 1, v + (b - from) * BLOCK, stride_v, apart, b, to, add);
        break;
    case 2: product(r, z, 2, 1, v, stride_v, apart, b, to, add); break;
    case 3: product(r, z, 3, 1, v, stride_v, apart, b, to, add); break;
    default: product(r, z, 4, 1, v, stride_v, apart, b, to, add);
    }
}

/* Z times several sets of source currents, for ports or points or both. A lane without a unit has the voltage of the
 * unit that it repeats. */
static void products(struct run *r, const double *z, long count, const double *s, long stride_s, double *v,
                     long stride_v, int rows, int add)
{
    const struct fleet *f = r->fleet;
    long fed_blocks = r->fed_rows / BLOCK, all_blocks = fed_blocks + (r->rows - r->ports) / BLOCK;
    for (long now; count > 0; count -= now, s += now * stride_s, v += now * stride_v) {
        now = count < 4 ? count : 4;
        for (long k = 0; k < 2 * now; k++)
            for (long g = 0; g < f->groups; g++) {
                const struct group *group = f->group[g];
                const double *from = s + (k / 2) * stride_s + (k % 2) * r->ports + group->first_port;
                memcpy(r->fed + k * f->feeds + group->first_feed, from, group->units * sizeof(double));
            }
        if (rows & AT_POINTS)
            blocks(r, z, (int)now, v + r->ports, stride_v, r->rows, fed_blocks, all_blocks, add);
        if (!(rows & AT_PORTS)) continue;
        blocks(r, z, (int)now, r->at_feeds, 2 * r->fed_rows, r->fed_rows, 0, fed_blocks, 0);
        for (long k = 0; k < 2 * now; k++) {
            double *part = v + (k / 2) * stride_v + (k % 2) * r->rows;
            for (long g = 0; g < f->groups; g++) {
                const struct group *group = f->group[g];
                const double *found = r->at_feeds + k * r->fed_rows + group->first_feed;
                double *own = part + group->first_port;
                for (long i = 0; i < group->packs * group->lanes; i++)
                    own[i] = (add ? own[i] : 0.0) + found[i < group->units ? i : group->units - 1];
            }
        }
    }
}

/* `wide` blocks of rows, from b on, of Z times a change of the source currents, in single precision. */
static inline __attribute__((always_inline)) void product_near(const struct run *r, int wide, long b)
{
    long each = r->fleet->feeds * 2 * WIDE_BLOCK;
    const float *at = r->network->near + b * each, *real = r->fed_change, *imaginary = real + r->fleet->feeds;
    long apart = (r->fed_rows + WIDE_BLOCK - 1) / WIDE_BLOCK * WIDE_BLOCK;
    wide_block re[AT_ONCE], im[AT_ONCE];
    for (int w = 0; w < wide; w++) re[w] = im[w] = (wide_block){0};
    for (long j = 0; j < r->fleet->feeds; j++, at += 2 * WIDE_BLOCK)
        for (int w = 0; w < wide; w++) {
            wide_block zr = *(const wide_block *)(at + w * each);
            wide_block zi = *(const wide_block *)(at + w * each + WIDE_BLOCK);
            re[w] += zr * real[j], im[w] += zr * imaginary[j];
            re[w] -= zi * imaginary[j], im[w] += zi * real[j];
        }
    for (int w = 0; w < wide; w++) {
        *(wide_block *)(r->change + (b + w) * WIDE_BLOCK) = re[w];
        *(wide_block *)(r->change + apart + (b + w) * WIDE_BLOCK) = im[w];
    }
}

/* Voltages of ports near those of another moment: V + Z (s' - s), the product in single precision. */
static void products_near(struct run *r, const struct moment *known, struct moment *m)
{
    const struct fleet *f = r->fleet;
    for (int part = 0; part < 2; part++)
        for (long g = 0; g < f->groups; g++) {
            const struct group *group = f->group[g];
            const double *s = m->s + part * r->ports + group->first_port;
            const double *before = known->s + part * r->ports + group->first_port;
            float *into = r->fed_change + part * f->feeds + group->first_feed;
            for (long i = 0; i < group->units; i++) into[i] = (float)(s[i] - before[i]);
        }
    long all = (r->fed_rows + WIDE_BLOCK - 1) / WIDE_BLOCK, b = 0;
    for (; b + AT_ONCE <= all; b += AT_ONCE) product_near(r, AT_ONCE, b);
    for (; b < all; b++) product_near(r, 1, b);
    for (int part = 0; part < 2; part++)
        for (long g = 0; g < f->groups; g++) {
            const struct group *group = f->group[g];
            const float *change = r->change + part * all * WIDE_BLOCK + group->first_feed;
            const double *from = known->v + part * r->rows + group->first_port;
            double *v = m->v + part * r->rows + group->first_port;
            for (long i = 0; i < group->units; i++) v[i] = from[i] + change[i];
            for (long i = group->units; i < group->packs * group->lanes; i++) v[i] = v[group->units - 1];
        }
}

#endif
