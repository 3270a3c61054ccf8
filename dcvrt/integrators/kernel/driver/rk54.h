/* The explicit pair of orders 5 and 4 with the wide region of stability: RK5(4)7S of Dormand and Prince.
 *
 * J. R. Dormand, P. J. Prince, J. Comp. Appl. Math. 6 (1980) 19-26. The last stage is the first of the next step.
 * It is stable for h lambda down to -5.7 on the real axis, where the pair 7M of the same paper (`dopri5`) ends at
 * -3.3, and its stages leave no gap as wide as that of 7M between 3/10 and 4/5, in which a corner is not seen.
 * Its error estimate vanishes at h lambda = -7.08, where a step grows what it does not see 13 times: whoever steps
 * with it has to keep away from there by something else.
 *
 * Dense output of order 4: the cubic of Hermite with s^2 (1 - s)^2 h sum LAST_TERM k, one of a family that all
 * conditions of order 4 leave free; its last entry is the round number next to the least error of order 5 (2.04).
 */
#ifndef DCVRT_RK54_H
#define DCVRT_RK54_H

enum { STAGES = 7 };

static const double NODE[STAGES] = {0.0, 2. / 9, 1. / 3, 5. / 9, 2. / 3, 1.0, 1.0};
static const double A[STAGES][STAGES - 1] = {
    {0},
    {2. / 9},
    {1. / 12, 1. / 4},
    {55. / 324, -25. / 108, 50. / 81},
    {83. / 330, -13. / 22, 61. / 66, 9. / 110},
    {-19. / 28, 9. / 4, 1. / 7, -27. / 7, 22. / 7},
    {19. / 200, 0.0, 3. / 5, -243. / 400, 33. / 40, 7. / 80},
};
static const double ERROR[STAGES] = {11. / 1250, 0.0, -33. / 500, 891. / 5000, -33. / 250, -9. / 1000, 1. / 50};
static const double LAST_TERM[STAGES] = {-259. / 200, 0.0, 93. / 20, -1377. / 400, -33. / 40, -87. / 80, 2.0};

#endif
