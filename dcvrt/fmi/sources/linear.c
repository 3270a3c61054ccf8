#include "linear.h"

#include <math.h>

bool linear_solve(int n, double *a, double *b)
{
    for (int k = 0; k < n; ++k) {
        int pivot = k;
        for (int i = k + 1; i < n; ++i)
            if (fabs(a[i + k * n]) > fabs(a[pivot + k * n])) pivot = i;
        if (!(fabs(a[pivot + k * n]) > 0.0)) return false; /* NaN ends here too */
        if (pivot != k) {
            for (int j = k; j < n; ++j) {
                double swap = a[k + j * n];
                a[k + j * n] = a[pivot + j * n];
                a[pivot + j * n] = swap;
            }
            double swap = b[k];
            b[k] = b[pivot];
            b[pivot] = swap;
        }
        for (int i = k + 1; i < n; ++i) {
            double factor = a[i + k * n] / a[k + k * n];
            for (int j = k + 1; j < n; ++j) a[i + j * n] -= factor * a[k + j * n];
            b[i] -= factor * b[k];
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        for (int j = k + 1; j < n; ++j) b[k] -= a[k + j * n] * b[j];
        b[k] /= a[k + k * n];
    }
    return true;
}

static double dot(int n, const double *a, const double *b)
{
    double sum = 0.0;
    for (int i = 0; i < n; ++i) sum += a[i] * b[i];
    return sum;
}

static void rotate(int n, double *a, double *b, double c, double s)
{
    for (int i = 0; i < n; ++i) {
        double left = a[i], right = b[i];
        a[i] = c * left - s * right;
        b[i] = s * left + c * right;
    }
}

/* One-sided Jacobi method: rotate pairs of columns until all are at right angles. Slow and simple, and it keeps
   the small singular values, by which the open directions of an equilibrium are known. */
void linear_svd(int n, double *a, double *v)
{
    for (int i = 0; i < n * n; ++i) v[i] = i % (n + 1) == 0 ? 1.0 : 0.0;
    for (int sweep = 0, turned = 1; sweep < 60 && turned; ++sweep) {
        turned = 0;
        for (int i = 0; i < n; ++i) {
            for (int j = i + 1; j < n; ++j) {
                double *left = a + i * n, *right = a + j * n;
                double alpha = dot(n, left, left), beta = dot(n, right, right), gamma = dot(n, left, right);
                if (fabs(gamma) <= 1e-15 * sqrt(alpha * beta)) continue;
                double zeta = (beta - alpha) / (2.0 * gamma);
                double t = (zeta < 0.0 ? -1.0 : 1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                double c = 1.0 / sqrt(1.0 + t * t);
                rotate(n, left, right, c, c * t);
                rotate(n, v + i * n, v + j * n, c, c * t);
                turned = 1;
            }
        }
    }
}

void linear_least_norm(int n, const double *us, const double *v, double cut, const double *b, double *x)
{
    double largest = 0.0;
    for (int j = 0; j < n; ++j) largest = fmax(largest, dot(n, us + j * n, us + j * n));
    for (int i = 0; i < n; ++i) x[i] = 0.0;
    for (int j = 0; j < n; ++j) {
        double square = dot(n, us + j * n, us + j * n);
        if (!(square > cut * cut * largest)) continue;
        double share = dot(n, us + j * n, b) / square;
        for (int i = 0; i < n; ++i) x[i] += share * v[i + j * n];
    }
}
