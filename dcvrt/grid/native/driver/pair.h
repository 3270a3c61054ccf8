/* The explicit pair of orders 5 and 4 with the wide region of stability: RK5(4)7S of Dormand and Prince.
 *
 * J. R. Dormand, P. J. Prince, J. Comp. Appl. Math. 6 (1980) 19-26. The last stage is the first of the next step.
 * The lags of facilities, 2 to 5 ms, bound its step, not the error: it is stable for h lambda down to -5.7 on the
 * real axis, where the pair 7M of the same paper (`dopri5`) ends at -3.3.
 *
 * Its error estimate vanishes at h lambda = -7.08, where a step grows what it does not see 13 times: the step is
 * kept below REACH over the fastest rate that the last two stages show. Units whose last two stages differ by less
 * than STILL of the tolerance are not asked: a step brings what is so small to half the tolerance at most, and then it
 * shows; below, the difference is more often that of the slow motion, and its rate none of the unit's.
 *
 * Dense output of order 4: the cubic of Hermite with s^2 (1 - s)^2 h sum LAST_TERM k, one of a family that all
 * conditions of order 4 leave free; its last entry is the round number next to the least error of order 5 (2.04).
 *
 * Where limits of facilities are smoothed over less than a step, their corner may lie between the stages, and a step
 * or a sample inside it errs by a multiple of the estimate. The last term of the dense output sees it: what it is
 * above SMOOTH tolerance^(-1/5) tolerances counts as error, as in the kernel of single facilities.
 */
#ifndef DCVRT_PAIR_H
#define DCVRT_PAIR_H

enum { STAGES = 7 };
#define REACH 5.3
#define STILL 0.03
#define SMOOTH 24.0

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
