r"""Design of a facility: the least value of a parameter with which it rides through what it is exposed to.

For a site whose hosted capacity is given, a parameter p (converter rating, battery power, hold-up of the DC
link) and the margins m of every fault and period,

.. math:: p^\ast = \min \{p \in [p_{low}, p_{high}] : m_{f,t}(p) \ge 0 \text{ for every fault and period}\}.

In the open loop the voltage at the site does not depend on the facility: one simulation of the grid for each
fault and period serves every value that is tried.

The range is scanned first, so that a margin that does not grow with the parameter is seen. Between the least
scanned value that passes and the one below it, Newton steps with exact margin gradients follow: the root of
the worst margin is the largest of the roots that the tangents predict. Where the order of events changes, a
margin jumps and its gradient says nothing; a step that does not halve the bracket in time is followed by a
bisection. The answer is always the end of the bracket that was run and passed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, did_you_mean, outside, raise_all

if TYPE_CHECKING:
    from dcvrt.criteria import Criteria
    from dcvrt.dae import Dae
    from dcvrt.integrators import Simulator
    from dcvrt.waveform import Waveform

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

TARGETS = ("voltage", "loss")
TOLERANCE = 1e-3
"""Relative distance between the answer and the failing value below it."""
SCAN = 9
"""Values of a range that are tried first."""
WIDE = 10.0
"""Ratio of the ends of a range from which on the scan is spaced geometrically."""
KINK = 3.0
"""A margin that falls across the last bracket by this many times what its slope says has jumped."""
NOISE = 1e-5
"""Difference of margins, pu or share, that is no jump: the tolerance of the integrator."""


@dataclass(frozen=True, eq=False)
class Exposure:
    """What a facility is exposed to.

    Attributes
    ----------
    period, fault : what reports call it.
    waveform : POI voltage.
    d : load factor of the period.
    """

    period: str
    fault: str
    waveform: Waveform
    d: float


@dataclass(frozen=True, eq=False)
class Trial:
    """Margins of every exposure at one value of the parameter.

    Attributes
    ----------
    value : the parameter.
    margin : array (exposures, 2)
        Voltage margin, pu, and loss margin, share of the import; NaN for a run without a result.
    slope : array (exposures, 2)
        Their derivatives by the parameter; NaN where there are none.
    sequence : events that each run passed through.
    status : how each run ended.
    met : array (exposures,)
        Whether each run meets all its criteria; a run without a result does not.
    """

    value: float
    margin: Floats
    slope: Floats
    sequence: tuple[tuple[str, ...], ...]
    status: tuple[str, ...]
    met: Flags

    @property
    def passed(self) -> bool:
        """Whether every exposure is ridden through."""
        return bool(self.met.all())

    @property
    def worst(self) -> tuple[int, int]:
        """Exposure and target of the least margin; a run without a result, or that has not recovered, is
        worse than any."""
        order = np.where(np.isnan(self.margin), -np.inf, self.margin)
        unmet = ~self.met & (order >= 0).all(axis=1)
        order[unmet] = -1e300
        k, target = np.unravel_index(int(order.argmin()), order.shape)
        return int(k), int(target)

    def root(self, falling_short: bool) -> float | None:
        """Where the tangents meet zero: the largest such value over the margins that grow with the parameter,
        or over those of them that fall short."""
        grows = np.isfinite(self.margin) & (self.slope > 0)
        if falling_short:
            grows &= self.margin < 0
        if not grows.any():
            return None
        return float((self.value - self.margin[grows] / self.slope[grows]).max())


Attempt = Callable[[Sequence[float]], list[Trial]]
"""Runs every exposure at each of some values."""


@dataclass(frozen=True, eq=False)
class Least:
    """The least value that passes, or why there is none.

    Attributes
    ----------
    value : the answer, which was run and passed; None where no value tried in the range passes.
    ends_at : what the answer rests on. `margin`: a margin that vanishes there. `sequence`: the order of
        events changes between the answer and the failing value below it. `jump`: the margin jumps there
        without such a change. `range`: the low end of the range passes. `none`: nothing passes.
    passes, fails : the trial at the answer, and the one just below it that fails; None where there is none.
        Without an answer `fails` is the trial whose worst margin is best.
    at : position of the exposure, and of the target in `TARGETS`, that decides.
    fails_above : scanned values above the answer that fail: the margins do not grow all the way.
    runs : facility runs made.
    low, high : range that was searched.
    """

    value: float | None
    ends_at: Literal["margin", "sequence", "jump", "range", "none"]
    passes: Trial | None
    fails: Trial | None
    at: tuple[int, int]
    fails_above: tuple[float, ...]
    runs: int
    low: float
    high: float


def least_value(attempt: Attempt, low: float, high: float, tolerance: float = TOLERANCE) -> Least:
    """Least value in a range at which every exposure passes.

    Parameters
    ----------
    attempt : runs the exposures.
    low, high : the range.
    tolerance : distance of the answer to the failing value below it, relative to the larger of the answer and
        a hundredth of the range.

    Raises
    ------
    InputError
        A range without width, or a tolerance that is not above 0.
    """
    if not (np.isfinite([low, high]).all() and low < high and tolerance > 0):
        raise InputError(
            f"design: nothing to search from {low:g} to {high:g} with a tolerance of {tolerance:g}. Way out: "
            "a finite range whose low end is below the high one, and a tolerance above 0."
        )
    space = np.geomspace if low > 0 and high / low > WIDE else np.linspace
    scanned = attempt([low, *space(low, high, SCAN).tolist()[1:-1], high])
    runs = sum(len(trial.status) for trial in scanned)
    first = next((k for k, trial in enumerate(scanned) if trial.passed), None)
    if first is None:
        best = max(scanned, key=_score)
        return Least(None, "none", None, best, best.worst, (), runs, low, high)
    above = tuple(trial.value for trial in scanned[first:] if not trial.passed)
    if first == 0:
        passes = scanned[0]
        return Least(passes.value, "range", passes, None, passes.worst, above, runs, low, high)
    fails, passes = scanned[first - 1], scanned[first]
    widths = [np.inf, np.inf]
    while (width := passes.value - fails.value) > (close := _close(passes.value, low, high, tolerance)):
        middle = 0.5 * (fails.value + passes.value)
        value = middle if width > 0.5 * widths[-2] else _newton(fails, passes, close)
        widths.append(width)
        (trial,) = attempt([value])
        runs += len(trial.status)
        fails, passes = (fails, trial) if trial.passed else (trial, passes)
    at = fails.worst
    return Least(passes.value, _ends_at(fails, passes, at), passes, fails, at, above, runs, low, high)


def _score(trial: Trial) -> tuple[int, float]:
    """How near a trial is to passing: exposures that are met, then the least margin of the others."""
    worst = trial.margin[trial.worst]
    return int(trial.met.sum()), -np.inf if np.isnan(worst) else float(worst)


def _close(value: float, low: float, high: float, tolerance: float) -> float:
    return tolerance * max(abs(value), 0.01 * (high - low))


def _newton(fails: Trial, passes: Trial, close: float) -> float:
    """The next value: the predicted root, moved a little so that the bracket closes from both sides.

    Of the two ends the one whose tangents reach the shorter way; the middle where neither points inside.
    """
    low, high = fails.value, passes.value
    predicted = [root for root in (fails.root(True), passes.root(False)) if root is not None]
    inside = [root for root in predicted if low <= root <= high]
    if not inside:
        return 0.5 * (low + high)
    root = min(inside, key=lambda root: min(root - low, high - root))
    beside = 0.45 * close
    if high - root < 2.0 * beside:  # the passing end is at the root: a value that fails closes the bracket
        return high - 2.0 * beside
    return root + beside


def _ends_at(fails: Trial, passes: Trial, at: tuple[int, int]) -> Literal["margin", "sequence", "jump"]:
    k, _ = at
    if fails.sequence[k] != passes.sequence[k] or np.isnan(fails.margin[at]):
        return "sequence"
    expected = abs(passes.slope[at]) * (passes.value - fails.value)
    fell = passes.margin[at] - fails.margin[at]
    return "margin" if fell <= KINK * (expected if np.isfinite(expected) else 0.0) + NOISE else "jump"


# -- on a facility -------------------------------------------------------------------------------------------


def on_facility(
    simulator: Simulator,
    exposures: Sequence[Exposure],
    criteria: Criteria,
    parameter: str,
    values: Mapping[str, float],
) -> Attempt:
    """Trials of a parameter of a facility, all values and exposures in one batch.

    Parameters
    ----------
    simulator : compiled facility, on the base S_B = H; margins have a slope where it differentiates by the
        parameter.
    exposures : what it is exposed to.
    criteria : what riding through means.
    parameter : path of the parameter.
    values : the others that differ from the facility's own, `pf` and `beta` among them.
    """

    def attempt(tried: Sequence[float]) -> list[Trial]:
        n = len(exposures)
        table: dict[str, float | list[float]] = {**values, "H": 1.0}
        table["d"] = [exposure.d for exposure in exposures] * len(tried)
        table[parameter] = np.repeat(tried, n).tolist()
        found = simulator.batch(
            [exposure.waveform for exposure in exposures] * len(tried), table, criteria=criteria
        )
        trials = []
        for j, value in enumerate(tried):
            here = slice(j * n, (j + 1) * n)
            margins, slopes = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
            for k, m in enumerate(found.margins[here]):
                if m is not None:
                    margins[k] = m.voltage.value, m.loss.value
                    slopes[k] = [t.grad.get(parameter, np.nan) for t in (m.voltage, m.loss)]
            trials.append(
                Trial(
                    float(value),
                    margins,
                    slopes,
                    tuple(() if m is None else m.sequence for m in found.margins[here]),
                    tuple(found.status[here]),
                    np.array([m is not None and m.passed for m in found.margins[here]]),
                )
            )
        return trials

    return attempt


@dataclass(frozen=True, eq=False)
class Need:
    """What a facility needs of a parameter.

    Attributes
    ----------
    parameter, unit : which it is.
    least : the search.
    replayed : trials of a simulator of its own without gradients, by a run of every exposure again: at the
        answer, and at the failing value just below it, where there are these.
    """

    parameter: str
    unit: str
    least: Least
    replayed: tuple[Trial, ...]

    @property
    def passes(self) -> bool:
        """Whether there is an answer at which the replay passes."""
        return bool(self.replayed) and self.replayed[0].passed

    @property
    def confirmed(self) -> bool:
        """Whether the replay passes at the answer and fails at the value below it, where there is one."""
        return self.passes and not any(trial.passed for trial in self.replayed[1:])


def need(
    variant: str,
    exposures: Sequence[Exposure],
    parameter: str = "beta",
    *,
    pf: float = 0.98,
    criteria: Criteria | None = None,
    low: float | None = None,
    high: float | None = None,
    values: Mapping[str, float] | None = None,
    tolerance: float = TOLERANCE,
) -> Need:
    """Least value of a parameter with which a facility rides through all that it is exposed to, replayed.

    Parameters
    ----------
    variant : facility variant.
    exposures : POI voltages with their load factors; the facility's size acts through them alone.
    parameter : path, as `beta`, `bess.P_dis`, `dc.T_hold`.
    pf : power factor of the import.
    criteria : what riding through means; default: `Criteria()`.
    low, high : range; default: the bounds of the parameter.
    values : other parameters, by path; `beta` among them unless it is the one that is sought.
    tolerance : relative distance to the failing value below the answer.

    Raises
    ------
    InputError
        No exposure, an unknown parameter, or a range that is missing or leaves the parameter's bounds, all at
        once.
    """
    from dcvrt.criteria import Criteria
    from dcvrt.planning.replay import simulator_of

    others = dict(values or {})
    plain = simulator_of(variant, {})
    problems = [] if exposures else ["there is no waveform to ride through."]
    problems += parameter_problems(plain.dae, variant, parameter, low, high)
    if parameter in others:
        problems.append(f"{parameter}: is sought and given. Way out: leave it out of the values.")
    raise_all(problems, "design")
    low, high = span(plain.dae, parameter, low, high)
    judged = Criteria() if criteria is None else criteria
    wrt = (parameter,) if parameter not in DESIGNED else tuple(p for p in DESIGNED if p in plain.dae.p_names)
    with_gradients, without = (
        on_facility(simulator, exposures, judged, parameter, others | {"pf": pf})
        for simulator in (simulator_of(variant, {}, wrt), plain)
    )
    least = least_value(with_gradients, low, high, tolerance)
    again = [trial.value for trial in (least.passes, least.fails) if trial is not None]
    replayed = tuple(without(again)) if least.value is not None else ()
    unit = next(row.unit for row in plain.dae.parameters if row.path == parameter)
    return Need(parameter, unit, least, replayed)


DESIGNED = ("beta", "bess.P_dis", "dc.T_hold")
"""Converter rating, battery power and hold-up of the DC link: what is usually asked for. A simulator with the
derivatives by all three is compiled once for any of them."""


def parameter_problems(
    dae: Dae, variant: str, parameter: str, low: float | None, high: float | None
) -> list[str]:
    """What is wrong with a parameter to be sought and its range: one line each."""
    rows = {row.path: row for row in dae.parameters if row.path not in SET_BY_PLACE}
    if parameter in SET_BY_PLACE:
        return [f"{parameter}: is set by the site, the period and the grid, and cannot be sought."]
    if parameter not in rows:
        return [f"{parameter}: variant {variant!r} has no such parameter.{did_you_mean(parameter, rows)}"]
    row = rows[parameter]
    problems = [
        f"{parameter}: has no {end} bound. Way out: give the {end} end of its range."
        for end, bound, given in (("low", row.bounds[0], low), ("high", row.bounds[1], high))
        if given is None and not np.isfinite(bound)
    ]
    problems += [
        outside(parameter, given, row.unit, row.bounds)
        for given in (low, high)
        if given is not None and not row.bounds[0] <= given <= row.bounds[1]
    ]
    if not problems:
        ends = span(dae, parameter, low, high)
        if not ends[0] < ends[1]:
            problems.append(f"{parameter}: nothing to search from {ends[0]:g} to {ends[1]:g}.")
    return problems


SET_BY_PLACE = ("H", "d", "pf")


def span(dae: Dae, parameter: str, low: float | None, high: float | None) -> tuple[float, float]:
    """Range of a parameter: what is given, else its bounds."""
    bounds = next(row.bounds for row in dae.parameters if row.path == parameter)
    return (bounds[0] if low is None else low, bounds[1] if high is None else high)
