r"""Does a response meet a code? Stay connected, come back in time, do not count sags.

**Connected** is judged by the import, not by a mode: with p0 and V0 the import and voltage before the
disturbance, the share

.. math::
    s(t) = \frac{p_g(t)}{p_0\, \min(|V(t)| / V_0,\, 1)}

is what is left of a load of constant current in a sag (of constant power in a swell). A facility counts as
disconnected when s stays below `connected_share` for longer than `tolerance`. Below `v_floor` no import is
asked for: there is nothing to import from. It has to stay connected from the start of the run until the
voltage or the frequency leaves what the code covers; from then on nothing is required.

**Recovered** is judged after every excursion: the time from the voltage passing the level of the code until
the import stays at the share of the code, up to the next excursion.

**No counting**: after every one of several sags the import comes back, if it did after the first.

**IT voltage**, for curves of server supplies: the distance of v_it from the curve. A curve that does not go
down to 0 pu says nothing about deeper and shorter gaps: those up to `tolerance` are left out.

**Servers on**, for the same curves: the IT power at the end against that at the start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dcvrt.criteria import Curve, sustained_minimum
from dcvrt.envelopes.choices import OWN, Yardstick
from dcvrt.envelopes.coverage import SAME_LEVEL, SAME_TIME, Course, covered_until, limit, spans
from dcvrt.envelopes.table import Envelope, joined
from dcvrt.envelopes.trials import CONNECTED, IT_CURVE, NO_COUNTING, RECOVERED, SERVED
from dcvrt.errors import InputError
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform

Array = NDArray[np.float64]
NORMAL = (0.90, 1.10)
"""Voltages, pu, that count as undisturbed where a code gives no range; our choice."""


@dataclass(frozen=True)
class Finding:
    """Verdict on one requirement.

    Attributes
    ----------
    requirement : ``"connected"``, ``"recovered"``, ``"no counting"``, ``"IT voltage"`` or ``"servers on"``.
    passed : None when it could not be judged; `text` says why.
    margin : distance from failing in `unit` (below 0: failed); -inf when it never came back, nan when not
        judged.
    text : what was found.
    mark : evidence of the requirement.
    time : when the connection was lost, s; nan otherwise.
    """

    requirement: str
    passed: bool | None
    margin: float
    unit: str
    text: str
    mark: str
    time: float = math.nan


@dataclass(frozen=True)
class Verdict:
    """Every finding on one run; `lowest_share` is the lowest s that lasted longer than the tolerance."""

    findings: tuple[Finding, ...]
    lowest_share: float = math.nan

    @property
    def passed(self) -> bool | None:
        """False when a requirement is not met, None when none could be judged."""
        judged = [finding.passed for finding in self.findings if finding.passed is not None]
        return all(judged) if judged else None

    def __getitem__(self, requirement: str) -> Finding:
        return next(f for f in self.findings if f.requirement == requirement)

    def __contains__(self, requirement: object) -> bool:
        return any(f.requirement == requirement for f in self.findings)


def check(
    envelope: Envelope,
    run: Trajectory,
    waveform: Waveform,
    yardstick: Yardstick | None = None,
    judged: tuple[str, ...] | None = None,
) -> Verdict:
    """Judge the response `run` to `waveform` against a code.

    Parameters
    ----------
    judged : requirements to judge; all that the code has and the waveform brings up unless given.

    Raises
    ------
    InputError
        the run imports nothing at its start, lacks the output `p_g` or, for a server curve, `v_it` or `p_it`.
    """
    yardstick = yardstick or Yardstick()
    every = (IT_CURVE, SERVED) if envelope.side == "server" else (CONNECTED, RECOVERED, NO_COUNTING)
    wanted = every if judged is None else judged
    if not run.completed:
        numeric = run.status.startswith(("integration failed", "more than", "no consistent value"))
        return Verdict(
            tuple(Finding(what, None if numeric else False, math.nan, "", run.status, "") for what in wanted)
        )
    course = Course.of(waveform)
    if envelope.side == "server":
        found = [_it_voltage(envelope, run, yardstick)] if IT_CURVE in wanted else []
        if SERVED in wanted:
            found.append(_served(run, yardstick))
        return Verdict(tuple(found))
    until, why = covered_until(envelope, course, yardstick)
    lowest, connected = _connected(envelope, run, waveform, until, why, yardstick)
    findings = [connected] if CONNECTED in wanted else []
    if until >= waveform.until - SAME_TIME:
        recoveries = _recoveries(envelope, run, course, yardstick)
        if RECOVERED in wanted and recoveries:
            findings.append(_recovered(envelope, recoveries, yardstick))
        if NO_COUNTING in wanted and envelope.counting_prohibited is not None and len(recoveries) > 1:
            findings.append(_no_counting(envelope, recoveries))
    return Verdict(tuple(findings), lowest)


# -- findings ---------------------------------------------------------------------------------------------


def _connected(
    envelope: Envelope, run: Trajectory, waveform: Waveform, until: float, why: str, yardstick: Yardstick
) -> tuple[float, Finding]:
    curve = _between(share_of_constant_current(run, waveform, yardstick.v_floor), float(run.t[0]), until)
    mark = joined(*(band.mark for band in (*envelope.low, *envelope.high)), OWN)
    if curve.t[-1] - curve.t[0] <= yardstick.tolerance:
        text = f"not required: the voltage leaves the envelope at once ({why})"
        return math.nan, Finding(CONNECTED, None, math.nan, "share", text, mark)
    lowest = sustained_minimum(curve, yardstick.tolerance).value
    margin = lowest - yardstick.connected_share
    text, lost = f"imports at least {lowest:.1%}", math.nan
    if margin < 0:
        stretches = curve.stretches_below(yardstick.connected_share)
        lost, back = next(s for s in stretches if s[1] - s[0] >= yardstick.tolerance)
        text = f"off from {lost:.3f} s for {back - lost:.3f} s"
    if why:
        text += f"; required until {until:.3f} s ({why})"
    return lowest, Finding(CONNECTED, margin >= 0, margin, "share", text, mark, lost)


@dataclass(frozen=True)
class Excursion:
    """One excursion of the voltage: when it ended, how long the import took, how long one looked; s."""

    clear: float
    took: float
    looked: float


def _recoveries(envelope: Envelope, run: Trajectory, course: Course, yardstick: Yardstick) -> list[Excursion]:
    asked = envelope.recovery
    above = asked.above if asked is not None and asked.above is not None else yardstick.above
    share = asked.share if asked is not None and asked.share is not None else yardstick.share
    highest = asked.highest if asked is not None else None
    high = envelope.continuous.high if envelope.continuous is not None else NORMAL[1]
    m, end = course.magnitude, float(course.t[-1])
    excursions = spans((m < above - SAME_LEVEL) | (m > high + SAME_LEVEL))
    power = _curve(run, "p_g", 1.0 / _import_before(run))
    found = []
    for number, (_, last) in enumerate(excursions):
        clear = float(course.t[last])
        if clear >= end - SAME_TIME:
            break
        looked = float(course.t[excursions[number + 1][0]]) if number + 1 < len(excursions) else end
        part = _between(power, clear, looked)
        outside = part.stretches_below(share)
        if highest is not None:
            outside += _mirrored(part).stretches_below(-highest)
        back = max((b for _, b in outside), default=clear)
        took = math.inf if outside and back >= part.t[-1] - SAME_TIME else back - clear
        found.append(Excursion(clear, took, looked - clear))
    return found


def _recovered(envelope: Envelope, recoveries: list[Excursion], yardstick: Yardstick) -> Finding:
    slowest = max(recoveries, key=lambda r: r.took)
    asked = envelope.recovery
    text = (
        f"back after {slowest.took:.3f} s"
        if math.isfinite(slowest.took)
        else f"not back within {slowest.looked:.3g} s"
    )
    if asked is None:
        return Finding(RECOVERED, None, math.nan, "s", f"{text}; no requirement known", "")
    mark = joined(asked.mark, OWN if asked.share is None or asked.above is None else "")
    if math.isinf(slowest.took) and slowest.looked < asked.within:
        return Finding(RECOVERED, None, math.nan, "s", f"{text}, which is too short to tell", mark)
    margin = asked.within - slowest.took
    return Finding(RECOVERED, margin >= 0, margin, "s", text, mark)


def _no_counting(envelope: Envelope, recoveries: list[Excursion]) -> Finding:
    assert envelope.counting_prohibited is not None
    mark = envelope.counting_prohibited.mark
    if math.isinf(recoveries[0].took):
        return Finding(NO_COUNTING, None, math.nan, "s", "not back after the first sag either", mark)
    lost = [k for k, r in enumerate(recoveries, 1) if math.isinf(r.took)]
    if lost:
        return Finding(NO_COUNTING, False, -math.inf, "s", f"not back after sag {lost[0]}", mark)
    margin = min(r.looked - r.took for r in recoveries)
    return Finding(NO_COUNTING, True, margin, "s", f"back after each of {len(recoveries)} sags", mark)


def _served(run: Trajectory, yardstick: Yardstick) -> Finding:
    power = run["p_it"]
    share = float(power[-1] / power[0])
    text = f"IT power at {share:.0%} in the end"
    return Finding(SERVED, share >= yardstick.share, share - yardstick.share, "share", text, OWN)


def _it_voltage(envelope: Envelope, run: Trajectory, yardstick: Yardstick) -> Finding:
    """Distance of v_it from the curve, counted from the moment it leaves the continuous range."""
    t, v = run.t, run["v_it"]
    ends = [b.severe for b in envelope.low if b.severe is not None]
    steady = envelope.continuous
    low = steady.low if steady is not None else max(ends)
    distance = [float(v.min()) - low if (v >= low).all() else math.inf]
    for side, bands, edge in (
        (-1, envelope.low, low),
        (1, envelope.high, steady.high if steady else math.inf),
    ):
        outside = (v - edge) * side > 0
        for first, last in spans(outside):
            part = slice(first, last + 1)
            tau = t[part] - t[first]
            worst = limit(bands, edge, tau, side)
            if side < 0 and min(ends) > 0:
                worst = np.where(tau <= yardstick.tolerance, -math.inf, worst)
            distance.append(float(((worst - v[part]) * side).min()))
    margin = min(distance)
    mark = joined(*(band.mark for band in (*envelope.low, *envelope.high)))
    return Finding(IT_CURVE, margin >= 0, margin, "pu", f"lowest IT voltage {v.min():.3f} pu", mark)


# -- signals ----------------------------------------------------------------------------------------------


def _import_before(run: Trajectory) -> float:
    before = float(run["p_g"][0])
    if not before > 0:
        raise InputError(
            f"envelope: the import before the disturbance is p_g = {before:g} pu; nothing to judge by."
        )
    return before


def _curve(run: Trajectory, name: str, factor: float) -> Curve:
    signals, k = run._find(name)
    if signals.rate is None:
        raise InputError(f"envelope: {name!r} must be an output of the system.")
    return curve_of(run.t, factor * signals.value[:, k], factor * signals.rate[:, k])


def curve_of(t: Array, y: Array, rate: Array) -> Curve:
    """A signal with its rate as a curve without derivatives."""
    none = np.zeros((len(t), 0))
    return Curve.with_extrema(t, y, rate, none, none, none, np.full(len(t), "extremum"))


def share_of_constant_current(run: Trajectory, waveform: Waveform, v_floor: float) -> Curve:
    """s(t) of this module; 1 below `v_floor`."""
    signals, k = run._find("p_g")
    if signals.rate is None:
        raise InputError("envelope: 'p_g' must be an output of the system.")
    power, rate = signals.value[:, k] / _import_before(run), signals.rate[:, k] / _import_before(run)
    before = np.append(np.diff(run.t) == 0.0, False)
    v = waveform.at(np.where(before, np.nextafter(run.t, -np.inf), run.t))
    m = np.abs(v) / abs(complex(waveform.v[0]))
    pieces = waveform.pieces()
    place = np.clip(np.searchsorted(pieces.start, run.t, side="right") - 1, 0, len(pieces.start) - 1)
    place = np.where(before & (pieces.start[place] == run.t), place - 1, place)
    h = pieces.length[place]
    x = np.clip((run.t - pieces.start[place]) / h, 0.0, 1.0)
    c = pieces.coefficients[place]
    slope = (c[:, 1] + x * (2 * c[:, 2] + 3 * x * c[:, 3])) / h
    with np.errstate(divide="ignore", invalid="ignore"):
        m_rate = (v.conj() * slope).real / np.abs(v) / abs(complex(waveform.v[0]))
        base = np.minimum(m, 1.0)
        share = power / base
        share_rate = rate / base - np.where(m < 1.0, share * m_rate / base, 0.0)
    some = m > v_floor
    return curve_of(run.t, np.where(some, share, 1.0), np.where(some, share_rate, 0.0))


def _mirrored(curve: Curve) -> Curve:
    return curve_of(curve.t, -curve.y, -curve.rate)


def _between(curve: Curve, begin: float, end: float) -> Curve:
    """Part of a curve; ends that are no sample are moved inwards to one."""
    first = int(np.searchsorted(curve.t, begin + SAME_TIME, side="right")) - 1
    first += int(curve.t[first] < begin - SAME_TIME)
    last = int(np.searchsorted(curve.t, end - SAME_TIME, side="left"))
    last -= int(last == len(curve.t) or curve.t[last] > end + SAME_TIME)
    part = slice(first, max(last, first) + 1)
    return Curve(
        curve.t[part], curve.y[part], curve.rate[part], curve.y_theta[part], curve.t_theta[part],
        curve.kind[part], curve.rate_theta[part],
    )  # fmt: skip
