/* Small dense linear algebra. Matrices are stored column by column. */

#ifndef LINEAR_H
#define LINEAR_H

#include <stdbool.h>

/* Solve a x = b by elimination with row pivots; `a` is destroyed, `b` becomes x. False when `a` is singular. */
bool linear_solve(int n, double *a, double *b);

/* Factor a = U S V': `a` becomes U S, `v` becomes V, both n by n. */
void linear_svd(int n, double *a, double *v);

/* x = a^+ b for a factored matrix; singular values below `cut` times the largest count as zero. */
void linear_least_norm(int n, const double *us, const double *v, double cut, const double *b, double *x);

#endif
