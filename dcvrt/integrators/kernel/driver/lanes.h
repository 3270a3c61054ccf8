/* The numbers that the equations are written in.
 *
 * `real` holds one number for each of LANES cases; `column` holds derivatives by theta. With one lane a real is
 * a double and a column packs up to COLUMNS thetas of that case; with many lanes both pack one number a lane.
 * The same text of equations and method is compiled for either. Operators come with the compiler's vector
 * types; the functions below are written for a double and for a pack, and `_Generic` chooses.
 */
#ifndef DCVRT_LANES_H
#define DCVRT_LANES_H

#include <math.h>
#include <stdint.h>

#if LANES == 1
#define PACK (COLUMNS > 1 ? COLUMNS : 2)
#else
#define PACK LANES
#endif

typedef double pack __attribute__((vector_size(8 * PACK)));
typedef __INT64_TYPE__ bits __attribute__((vector_size(8 * PACK)));

#if LANES == 1
typedef double real;
#if COLUMNS == 1
typedef double column;
#else
typedef pack column;
#endif
enum { GROUPS = (NW + COLUMNS - 1) / COLUMNS };
#else
typedef pack real;
typedef pack column;
enum { GROUPS = NW };
#endif

/* Element k of a real or a column. */
#define AT(value, k) (((double *)&(value))[k])

static inline pack spread(double a) { return a - (pack){0}; }
static inline pack choose(bits which, pack yes, pack no)
{
    return (pack)(((bits)yes & which) | ((bits)no & ~which));
}

#if LANES == 1
static inline real all_lanes(double a) { return a; }
#else
static inline real all_lanes(double a) { return spread(a); }
#endif
#if LANES == 1 && COLUMNS == 1
static inline column all_columns(double a) { return a; }
static inline column widened(real a) { return a; }
#elif LANES == 1
static inline column all_columns(double a) { return spread(a); }
static inline column widened(real a) { return spread(a); }
#else
static inline column all_columns(double a) { return spread(a); }
static inline column widened(real a) { return a; }
#endif

/* -- functions with an instruction of their own ------------------------------------------------------- */

#if PACK == 8 && defined(__AVX512F__)
#include <immintrin.h>
static inline pack root_p(pack a) { return (pack)_mm512_sqrt_pd((__m512d)a); }
#elif PACK == 4 && defined(__AVX__)
#include <immintrin.h>
static inline pack root_p(pack a) { return (pack)_mm256_sqrt_pd((__m256d)a); }
#elif PACK == 2 && defined(__SSE2__)
#include <immintrin.h>
static inline pack root_p(pack a) { return (pack)_mm_sqrt_pd((__m128d)a); }
#else
static inline pack root_p(pack a)
{
    for (int k = 0; k < PACK; k++) a[k] = sqrt(a[k]);
    return a;
}
#endif
static inline double root_1(double a) { return sqrt(a); }

static inline pack absolute_p(pack a) { return (pack)((bits)a & INT64_MAX); }
static inline double absolute_1(double a) { return fabs(a); }
static inline pack smaller_p(pack a, pack b) { return choose(a < b, a, b); }
static inline double smaller_1(double a, double b) { return a < b ? a : b; }
static inline pack larger_p(pack a, pack b) { return choose(a > b, a, b); }
static inline double larger_1(double a, double b) { return a > b ? a : b; }

/* -- truth as 1 and 0 --------------------------------------------------------------------------------- */

static inline pack truth(bits a) { return (pack)(a & (bits)spread(1.0)); }
static inline pack is_less_p(pack a, pack b) { return truth(a < b); }
static inline double is_less_1(double a, double b) { return a < b; }
static inline pack is_at_most_p(pack a, pack b) { return truth(a <= b); }
static inline double is_at_most_1(double a, double b) { return a <= b; }
static inline pack is_equal_p(pack a, pack b) { return truth(a == b); }
static inline double is_equal_1(double a, double b) { return a == b; }
static inline pack is_other_p(pack a, pack b) { return truth(a != b); }
static inline double is_other_1(double a, double b) { return a != b; }
static inline pack is_false_p(pack a) { return truth(a == 0.0); }
static inline double is_false_1(double a) { return a == 0.0; }
static inline pack both_p(pack a, pack b) { return truth((a != 0.0) & (b != 0.0)); }
static inline double both_1(double a, double b) { return a != 0.0 && b != 0.0; }
static inline pack either_p(pack a, pack b) { return truth((a != 0.0) | (b != 0.0)); }
static inline double either_1(double a, double b) { return a != 0.0 || b != 0.0; }
static inline pack where_p(pack a, pack b) { return choose(a != 0.0, b, spread(0.0)); }
static inline double where_1(double a, double b) { return a != 0.0 ? b : 0.0; }
static inline pack sign_of_p(pack a) { return choose(a == 0.0, a, truth(a > 0.0) - truth(a < 0.0)); }
static inline double sign_of_1(double a) { return a == 0.0 ? a : (double)((a > 0.0) - (a < 0.0)); }

/* -- sine and cosine ---------------------------------------------------------------------------------- */

/* An angle is brought to [-pi/4, pi/4] by subtracting n quarter turns of pi/2, given in three parts of 33 bits
 * so that the products with n are exact; beyond FAR_ANGLE they would not be, and libm is asked. The
 * polynomials interpolate (sin r - r)/r^3 and (cos r - 1 + r^2/2)/r^4 in r^2 at Chebyshev's points. */
#define FAR_ANGLE 1e6
#define WHOLE 6755399441055744.0 /* 1.5 * 2^52: adding it rounds to a whole number, in the low bits */
#define QUARTER_TURNS(a) ((a) * 0.6366197723675814 + WHOLE)
#define REDUCED(a, n) \
    ((((a) - (n) * 1.5707963267341256) - (n) * 6.077100506303966e-11) - (n) * 2.0222662487959506e-21)
#define SINE_SERIES(r, s)                                                                                \
    ((r) + (r) * (s) * (-0.16666666666666666 + (s) * (0.008333333333330925 + (s) *                       \
     (-0.00019841269836722437 + (s) * (2.755731608382574e-06 + (s) * (-2.505112794596564e-08 + (s) *     \
     1.591784866512194e-10))))))
#define COSINE_SERIES(s)                                                                                 \
    (1.0 - 0.5 * (s) + (s) * (s) * (0.041666666666666664 + (s) * (-0.0013888888888887382 + (s) *         \
     (2.480158729874308e-05 + (s) * (-2.755731726001471e-07 + (s) * (2.0876143829213935e-09 + (s) *      \
     -1.1382456865840483e-11))))))

static inline int is_far(pack a)
{
    bits far = absolute_p(a) > FAR_ANGLE;
    int64_t any = 0;
    for (int k = 0; k < PACK; k++) any |= far[k];
    return any != 0;
}

static inline pack sine_p(pack a)
{
    if (__builtin_expect(is_far(a), 0)) {
        for (int k = 0; k < PACK; k++) a[k] = sin(a[k]);
        return a;
    }
    pack shifted = QUARTER_TURNS(a), n = shifted - WHOLE, r = REDUCED(a, n), s = r * r;
    pack value = choose(((bits)shifted & 1) == 0, SINE_SERIES(r, s), COSINE_SERIES(s));
    return (pack)((bits)value ^ (((bits)shifted & 2) << 62));
}

static inline pack cosine_p(pack a)
{
    if (__builtin_expect(is_far(a), 0)) {
        for (int k = 0; k < PACK; k++) a[k] = cos(a[k]);
        return a;
    }
    pack shifted = QUARTER_TURNS(a), n = shifted - WHOLE, r = REDUCED(a, n), s = r * r;
    pack value = choose(((bits)shifted & 1) != 0, SINE_SERIES(r, s), COSINE_SERIES(s));
    return (pack)((bits)value ^ ((((bits)shifted + 1) & 2) << 62));
}

static inline int64_t low_bits(double a)
{
    union { double number; int64_t whole; } u = {a};
    return u.whole;
}

static inline double sine_1(double a)
{
    if (!(fabs(a) <= FAR_ANGLE)) return sin(a);
    double shifted = QUARTER_TURNS(a), n = shifted - WHOLE, r = REDUCED(a, n), s = r * r;
    int64_t turns = low_bits(shifted);
    double value = turns & 1 ? COSINE_SERIES(s) : SINE_SERIES(r, s);
    return turns & 2 ? -value : value;
}

static inline double cosine_1(double a)
{
    if (!(fabs(a) <= FAR_ANGLE)) return cos(a);
    double shifted = QUARTER_TURNS(a), n = shifted - WHOLE, r = REDUCED(a, n), s = r * r;
    int64_t turns = low_bits(shifted);
    double value = turns & 1 ? SINE_SERIES(r, s) : COSINE_SERIES(s);
    return (turns + 1) & 2 ? -value : value;
}

/* -- the rest, by libm lane after lane ---------------------------------------------------------------- */

#define BY_LIBM(name, function)                                     \
    static inline double name##_1(double a) { return function(a); } \
    static inline pack name##_p(pack a)                             \
    {                                                               \
        for (int k = 0; k < PACK; k++) a[k] = function(a[k]);       \
        return a;                                                   \
    }
#define BY_LIBM_OF_TWO(name, function)                                        \
    static inline double name##_1(double a, double b) { return function(a, b); } \
    static inline pack name##_p(pack a, pack b)                               \
    {                                                                         \
        for (int k = 0; k < PACK; k++) a[k] = function(a[k], b[k]);           \
        return a;                                                             \
    }
BY_LIBM(tangent, tan)
BY_LIBM(arcsine, asin)
BY_LIBM(arccosine, acos)
BY_LIBM(arctangent, atan)
BY_LIBM(hyperbolic_sine, sinh)
BY_LIBM(hyperbolic_cosine, cosh)
BY_LIBM(hyperbolic_tangent, tanh)
BY_LIBM(area_sine, asinh)
BY_LIBM(area_cosine, acosh)
BY_LIBM(area_tangent, atanh)
BY_LIBM(exponential, exp)
BY_LIBM(logarithm, log)
BY_LIBM(exponential_less_one, expm1)
BY_LIBM(logarithm_of_one_more, log1p)
BY_LIBM(error_function, erf)
BY_LIBM(down, floor)
BY_LIBM(up, ceil)
BY_LIBM_OF_TWO(angle, atan2)
BY_LIBM_OF_TWO(power, pow)
BY_LIBM_OF_TWO(hypotenuse, hypot)
BY_LIBM_OF_TWO(with_sign_of, copysign)
BY_LIBM_OF_TWO(remainder_of, fmod)

/* -- one name for both types -------------------------------------------------------------------------- */

#define FOR_TYPE(name, a) _Generic((a), double: name##_1, default: name##_p)
#define root(a) FOR_TYPE(root, a)(a)
#define sine(a) FOR_TYPE(sine, a)(a)
#define cosine(a) FOR_TYPE(cosine, a)(a)
#define tangent(a) FOR_TYPE(tangent, a)(a)
#define arcsine(a) FOR_TYPE(arcsine, a)(a)
#define arccosine(a) FOR_TYPE(arccosine, a)(a)
#define arctangent(a) FOR_TYPE(arctangent, a)(a)
#define angle(a, b) FOR_TYPE(angle, a)(a, b)
#define hyperbolic_sine(a) FOR_TYPE(hyperbolic_sine, a)(a)
#define hyperbolic_cosine(a) FOR_TYPE(hyperbolic_cosine, a)(a)
#define hyperbolic_tangent(a) FOR_TYPE(hyperbolic_tangent, a)(a)
#define area_sine(a) FOR_TYPE(area_sine, a)(a)
#define area_cosine(a) FOR_TYPE(area_cosine, a)(a)
#define area_tangent(a) FOR_TYPE(area_tangent, a)(a)
#define exponential(a) FOR_TYPE(exponential, a)(a)
#define logarithm(a) FOR_TYPE(logarithm, a)(a)
#define exponential_less_one(a) FOR_TYPE(exponential_less_one, a)(a)
#define logarithm_of_one_more(a) FOR_TYPE(logarithm_of_one_more, a)(a)
#define power(a, b) FOR_TYPE(power, a)(a, b)
#define hypotenuse(a, b) FOR_TYPE(hypotenuse, a)(a, b)
#define error_function(a) FOR_TYPE(error_function, a)(a)
#define absolute(a) FOR_TYPE(absolute, a)(a)
#define sign_of(a) FOR_TYPE(sign_of, a)(a)
#define with_sign_of(a, b) FOR_TYPE(with_sign_of, a)(a, b)
#define down(a) FOR_TYPE(down, a)(a)
#define up(a) FOR_TYPE(up, a)(a)
#define remainder_of(a, b) FOR_TYPE(remainder_of, a)(a, b)
#define smaller(a, b) FOR_TYPE(smaller, a)(a, b)
#define larger(a, b) FOR_TYPE(larger, a)(a, b)
#define is_less(a, b) FOR_TYPE(is_less, a)(a, b)
#define is_at_most(a, b) FOR_TYPE(is_at_most, a)(a, b)
#define is_equal(a, b) FOR_TYPE(is_equal, a)(a, b)
#define is_other(a, b) FOR_TYPE(is_other, a)(a, b)
#define is_false(a) FOR_TYPE(is_false, a)(a)
#define both(a, b) FOR_TYPE(both, a)(a, b)
#define either(a, b) FOR_TYPE(either, a)(a, b)
#define where(a, b) FOR_TYPE(where, a)(a, b)

/* Where the equations are evaluated. `d` is the rate of the states, `v` that of the inputs, `m` the fixed
 * values of the mode; what ends in s is the derivative by theta of what it begins with, group after group. */
struct point {
    const real *t, *x, *z, *u, *v, *c, *d, *m;
    const column *xs, *zs, *us, *vs, *ds, *mc;
};

#endif
