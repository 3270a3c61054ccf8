/* The pair of rk54.h as the network's loop steps with it, and how far.
 *
 * The lags of facilities, 2 to 5 ms, bound its step, not the error. To keep away from where its estimate vanishes, the
 * step stays below REACH over the fastest rate that the last two stages show. Units whose last two stages differ by
 * less than STILL of the tolerance are not asked: a step brings what is so small to half the tolerance at most, and then
 * it shows; below, the difference is more often that of the slow motion, and its rate none of the unit's.
 *
 * Where limits of facilities are smoothed over less than a step, their corner may lie between the stages, and a step
 * or a sample inside it errs by a multiple of the estimate. The last term of the dense output sees it: what it is
 * above SMOOTH tolerance^(-1/5) tolerances counts as error, as in the kernel of single facilities.
 *
 * Voltages of the stages lie near those at the begin of the step: what they differ by is a product in single precision,
 * whose rounding is 1e-7 of the difference. From a tolerance of NEAR_FROM on, that is far below it. The voltages with
 * which the next step begins are always in double precision, so that rounding does not add up.
 *
 * Steps of facilities inside one of machines (nested.h) may err LINK_TOLERANCE times as much as one of all units: what
 * errs are lags that follow the voltage, and the next such step leaves little of it. They are taken while machines move,
 * so that a step of theirs would err by MOVING of the tolerance: at rest, lags that are not quite still would push them.
 */
#ifndef DCVRT_PAIR_H
#define DCVRT_PAIR_H

#include "rk54.h"

#define REACH 5.3
#define STILL 0.03
#define SMOOTH 24.0
#define NEAR_FROM 5e-7
#define LINK_TOLERANCE 2.0
#define MOVING 3e-3

#endif
