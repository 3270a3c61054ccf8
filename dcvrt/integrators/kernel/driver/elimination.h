/* Gaussian elimination for all lanes at once.
 *
 * The pattern of the matrix is known, and pivots in a fixed order with it (elimination_text.h). In a lane where
 * rows grow too much on the way, a full elimination with row exchanges stands in; every lane exchanges its own.
 */
#ifndef DCVRT_ELIMINATION_H
#define DCVRT_ELIMINATION_H

enum { SIZE = NX + NZ };
#define GROWTH 1e4 /* beyond the largest element of a row: so many digits may be lost */

#if LANES == 1
static inline int not_at_most(double a, double b) { return !(a <= b); }
static inline int any_lane(int mask) { return mask; }
#else
static inline bits not_at_most(pack a, pack b) { return ~(a <= b); }
static inline int any_lane(bits mask)
{
    int64_t any = 0;
    for (int l = 0; l < LANES; l++) any |= mask[l];
    return any != 0;
}
#endif

#include "elimination_text.h"

struct eliminated {
    real lu[FACTORS];
    /* where the order does not do: */
    int any;              /* whether there is such a lane */
    lanes_mask grown;     /* which lanes */
    real a[SIZE][SIZE];   /* L below the diagonal, U above it */
    real inverse[SIZE];   /* of the diagonal of U */
    int row[SIZE][LANES]; /* what each row was exchanged with */
};

static inline void exchange(void *a, void *b, int lane)
{
    double *x = (double *)a + lane, *y = (double *)b + lane, swap = *x;
    *x = *y;
    *y = swap;
}

static __attribute__((noinline)) void eliminate_with_exchanges(struct eliminated *e, const real *jacobian, real d)
{
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j < SIZE; j++) e->a[i][j] = i == j && i < NX ? d : all_lanes(0.0);
    for (int k = 0; k < ENTRIES; k++) e->a[entry_row[k]][entry_column[k]] -= jacobian[k];
    for (int k = 0; k < SIZE; k++) {
        for (int l = 0; l < LANES; l++) {
            int best = k;
            for (int i = k + 1; i < SIZE; i++)
                if (fabs(AT(e->a[i][k], l)) > fabs(AT(e->a[best][k], l))) best = i;
            e->row[k][l] = best;
            for (int j = 0; best != k && j < SIZE; j++) exchange(&e->a[k][j], &e->a[best][j], l);
        }
        e->inverse[k] = 1.0 / e->a[k][k];
        for (int i = k + 1; i < SIZE; i++) {
            e->a[i][k] *= e->inverse[k];
            for (int j = k + 1; j < SIZE; j++) e->a[i][j] -= e->a[i][k] * e->a[k][j];
        }
    }
}

/* Factors of W = diag(d, 0) - J; a singular matrix gets some that are not finite. */
static void eliminate(struct eliminated *e, const real *jacobian, real d)
{
    e->grown = eliminate_in_order(jacobian, d, e->lu);
    e->any = any_lane(e->grown);
    if (e->any) eliminate_with_exchanges(e, jacobian, d);
}

#define SUBSTITUTE(type)                                                                            \
    type other[SIZE];                                                                               \
    for (int i = 0; i < SIZE; i++) other[i] = b[i];                                                 \
    for (int k = 0; k < SIZE; k++)                                                                  \
        for (int l = 0; l < LANES; l++)                                                             \
            for (int n = 0; n < (int)(sizeof(type) / sizeof(real)) && e->row[k][l] != k; n++)       \
                exchange(&other[k], &other[e->row[k][l]], l + n);                                   \
    for (int i = 1; i < SIZE; i++)                                                                  \
        for (int j = 0; j < i; j++) other[i] -= e->a[i][j] * other[j];                              \
    for (int i = SIZE - 1; i >= 0; i--) {                                                           \
        for (int j = i + 1; j < SIZE; j++) other[i] -= e->a[i][j] * other[j];                       \
        other[i] *= e->inverse[i];                                                                  \
    }

static __attribute__((noinline)) void solve_with_exchanges(const struct eliminated *e, real *b)
{
    SUBSTITUTE(real)
    solve_in_order(e->lu, b);
    for (int i = 0; i < SIZE; i++) b[i] = taken_real(e->grown, other[i], b[i]);
}

static __attribute__((noinline)) void solve_columns_with_exchanges(const struct eliminated *e, column *b)
{
    SUBSTITUTE(column)
    solve_columns_in_order(e->lu, b);
    for (int i = 0; i < SIZE; i++) b[i] = taken_column(e->grown, other[i], b[i]);
}

/* Replace a right-hand side by the solution. */
static inline void solve_lanes(const struct eliminated *e, real *b)
{
    if (__builtin_expect(e->any, 0)) solve_with_exchanges(e, b);
    else solve_in_order(e->lu, b);
}

/* The same for one group of columns. */
static inline void solve_columns(const struct eliminated *e, column *b)
{
    if (__builtin_expect(e->any, 0)) solve_columns_with_exchanges(e, b);
    else solve_columns_in_order(e->lu, b);
}

#endif
