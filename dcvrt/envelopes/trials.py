"""The items of an envelope as waveforms: one trial for each thing to stay connected through.

A trial puts the voltage just inside a band for just the time of the band. Where a code leaves something open
- how long a continuous range lasts, how fast the frequency gets there - the choice is ours, an option, and
marked ``own``.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from dcvrt.envelopes.choices import OWN, Choices
from dcvrt.envelopes.table import Band, Envelope, FrequencyBand, joined
from dcvrt.waveform import Waveform

CONNECTED, RECOVERED, NO_COUNTING = "connected", "recovered", "no counting"
IT_CURVE, SERVED = "IT voltage", "servers on"
"""What a trial may be judged by."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A waveform made from one item of an envelope.

    Attributes
    ----------
    label, kind : which item it is; kind is ``"low"``, ``"high"``, ``"along"``, ``"continuous"``,
        ``"frequency"``, ``"rocof"``, ``"phase"``, ``"staircase"``, ``"reclosing"``, ``"recovery"`` or
        ``"counting"``.
    waveform : what to run.
    begin, end : of the disturbance, s.
    held : how long it stays at `level`, s.
    level : voltage, pu, frequency, Hz, or angle, degrees, that it goes to; nan where it goes to several.
    time : time to stay connected, s; inf without limit.
    mark : evidence, including our own choices that matter.
    judged : by what: ``"connected"``, ``"recovered"``, ``"no counting"``, ``"IT voltage"``,
        ``"servers on"``.
    note : what to know about it.
    """

    label: str
    kind: str
    waveform: Waveform
    begin: float
    end: float
    level: float
    time: float
    mark: str
    judged: tuple[str, ...] = (CONNECTED, RECOVERED)
    note: str = ""
    held: float = math.nan

    def __post_init__(self) -> None:
        if math.isnan(self.held):
            object.__setattr__(self, "held", self.end - self.begin)

    @property
    def shortened(self) -> bool:
        """Whether it runs for less than the time that is required."""
        return self.held < self.time - 1e-9


def trials_of(envelope: Envelope, choices: Choices) -> tuple[Trial, ...]:
    """Every trial of an envelope, in the order of its items."""
    found = [trial for make in MAKERS for trial in make(envelope, choices)]
    if envelope.side == "server":
        found = [replace(trial, judged=(IT_CURVE, SERVED)) for trial in found]
    return tuple(_named(trial, envelope) for trial in found)


def _named(trial: Trial, envelope: Envelope) -> Trial:
    w = trial.waveform
    return replace(trial, waveform=Waveform(w.t, w.v, name=f"{envelope.name}: {trial.label}"))


def level_in(band: Band, choices: Choices) -> float:
    """Voltage of a trial in a band: at `depth` between its edges, `inside` away from both."""
    severe = choices.open_end if band.severe is None else band.severe
    if band.mild is None:
        return severe
    sign = math.copysign(1.0, severe - band.mild)
    innermost, outermost = band.mild + sign * choices.inside, severe - sign * choices.inside
    if band.severe == 0.0:
        outermost = 0.0
    return innermost + choices.depth * (outermost - innermost)


# -- voltage ----------------------------------------------------------------------------------------------


def _rectangle(voltage: complex, time: float, choices: Choices) -> tuple[Waveform, float, float]:
    begin, end = choices.before, choices.before + time
    steps = [(0.0, 1.0), (begin, voltage), (end, 1.0)]
    return Waveform.segments(steps, until=end + choices.after), begin, end


def _continuous(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    if envelope.continuous is None:
        return
    known = envelope.continuous
    for edge, sign in ((known.low, 1.0), (known.high, -1.0)):
        level = edge + sign * choices.inside
        yield Trial(
            f"{edge:g} pu, continuous",
            "continuous",
            *_rectangle(level, choices.longest, choices),
            level,
            math.inf,
            known.mark,
        )


def _bands(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    for kind, bands in (("low", envelope.low), ("high", envelope.high)):
        for band in bands:
            level = level_in(band, choices)
            open_end = band.severe is None
            if band.mild is None:
                label = f"{band.severe:g} pu"
            elif open_end:
                label = f"beyond {band.mild:g} pu"
            else:
                label = f"{min(band.mild, band.severe):g}-{max(band.mild, band.severe):g} pu"  # type: ignore[type-var]
            notes = ["far end not known"] * open_end + ["approximate"] * band.approximate
            yield Trial(
                f"{label}, {band.time:g} s",
                kind,
                *_rectangle(level, min(band.time, choices.longest), choices),
                level,
                band.time,
                joined(band.mark, OWN if open_end else ""),
                note="; ".join(notes),
            )


def _along(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    """The worst course that the envelope still contains: every level until its time is over."""
    if envelope.kind != "envelope":
        return
    for side, bands in (("low", envelope.low), ("high", envelope.high)):
        times = [band.time for band in bands]
        rising = all(a > b for a, b in itertools.pairwise(times))
        if len(bands) < 2 or not rising or max(times) > choices.longest:
            continue
        begin, steps = choices.before, [(0.0, 1.0)]
        for band in reversed(bands):
            steps.append((begin, level_in(band, choices)))
            begin = choices.before + band.time
        steps.append((begin, 1.0))
        yield Trial(
            f"along the {side}-voltage curve",
            "along",
            Waveform.segments(steps, until=begin + choices.after),
            choices.before,
            begin,
            math.nan,
            times[0],
            joined(*(band.mark for band in bands)),
        )


def _staircase(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    if envelope.staircase is None:
        return
    stairs = envelope.staircase
    begins = [choices.before + t for t in stairs.times]
    end = begins[-1] + choices.last_step
    steps = [(0.0, 1.0), *zip(begins, stairs.voltages, strict=True), (end, 1.0)]
    yield Trial(
        "undervoltage staircase",
        "staircase",
        Waveform.segments(steps, until=end + choices.after),
        choices.before,
        end,
        math.nan,
        end - choices.before,
        joined(stairs.mark, OWN),
        note=f"length of the last step, {choices.last_step:g} s, is ours",
    )


def _reclosing(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    if envelope.reclosing is None:
        return
    shots = envelope.reclosing
    begins = [choices.before + k * (shots.longest + choices.dead_time) for k in range(int(choices.shots))]
    steps = [(0.0, 1.0)]
    for begin in begins:
        steps += [(begin, choices.shot_voltage), (begin + shots.longest, 1.0)]
    end = begins[-1] + shots.longest
    yield Trial(
        f"reclosing, {int(choices.shots)} shots of {shots.longest * 1e3:g} ms",
        "reclosing",
        Waveform.segments(steps, until=end + choices.after),
        begins[0],
        end,
        choices.shot_voltage,
        shots.longest,
        joined(shots.mark, OWN),
        note="number, depth and spacing are ours",
    )


def _recovery(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    """A sag of our own where a code asks for recovery and has no curve to recover from."""
    if envelope.recovery is None or envelope.low:
        return
    level, time = choices.reference_voltage, choices.reference_time
    yield Trial(
        f"recovery from {level:g} pu, {time:g} s",
        "recovery",
        *_rectangle(level, time, choices),
        level,
        time,
        joined(envelope.recovery.mark, OWN),
        judged=(RECOVERED,),
        note="no voltage curve known: the sag is ours",
    )


def _counting(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    """The same sag again and again: the mildest and the deepest level of the curve."""
    if envelope.counting_prohibited is None or not envelope.low:
        return
    for band in (envelope.low[0], envelope.low[-1]):
        level, time = level_in(band, choices), min(choices.sag_time, band.time)
        begins = [choices.before + k * (time + choices.gap) for k in range(int(choices.sags))]
        steps = [(0.0, 1.0)]
        for begin in begins:
            steps += [(begin, level), (begin + time, 1.0)]
        end = begins[-1] + time
        yield Trial(
            f"{int(choices.sags)} sags to {level:g} pu",
            "counting",
            Waveform.segments(steps, until=end + max(choices.after, choices.gap)),
            begins[0],
            end,
            level,
            time,
            joined(envelope.counting_prohibited.mark, OWN),
            judged=(NO_COUNTING,),
            note=f"number, length and spacing ({choices.gap:g} s) are ours",
        )


# -- frequency and angle ----------------------------------------------------------------------------------


def _frequency(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    nominal = envelope.nominal_hz
    for band in envelope.frequency:
        for edge, sign in _severe_edges(band, nominal):
            level = edge + sign * choices.inside_hz
            away, hold = level - nominal, min(band.time, choices.longest)
            there = choices.before + abs(away) / choices.ramp
            back = there + hold
            end = back + abs(away) / choices.ramp
            steps: list[Any] = [
                (0.0, 0.0), (choices.before, 0.0, away), (there, away), (back, away, 0.0), (end, 0.0)
            ]  # fmt: skip
            time = "continuous" if math.isinf(band.time) else f"{band.time:g} s"
            yield Trial(
                f"{edge:g} Hz, {time}",
                "frequency",
                Waveform.rotating(steps, until=end + choices.after),
                choices.before,
                end,
                level,
                band.time,
                joined(band.mark, OWN),
                judged=(CONNECTED,),
                held=hold,
                note=f"reached at {choices.ramp:g} Hz/s, our rate",
            )


def _severe_edges(band: FrequencyBand, nominal: float) -> list[tuple[float, float]]:
    """Edges away from the nominal frequency, each with the sign of the way inside."""
    if band.low < nominal < band.high:
        return [(band.low, 1.0), (band.high, -1.0)]
    return [(band.low, 1.0)] if band.high <= nominal else [(band.high, -1.0)]


def _rocof(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    if envelope.rocof is None:
        return
    for sign in (-1.0, 1.0):
        rate, begin = sign * envelope.rocof.rate, choices.before
        end, away = begin + choices.ramp_time, rate * choices.ramp_time
        steps: list[Any] = [(0.0, 0.0), (begin, 0.0, away), (end, away)]
        yield Trial(
            f"ramp of {rate:+g} Hz/s",
            "rocof",
            Waveform.rotating(steps, until=end + choices.after),
            begin,
            end,
            envelope.nominal_hz + away,
            choices.ramp_time,
            joined(envelope.rocof.mark, OWN),
            judged=(CONNECTED,),
            note=f"how long it lasts, {choices.ramp_time:g} s, is ours",
        )


def _phase(envelope: Envelope, choices: Choices) -> Iterator[Trial]:
    if envelope.phase_jump is None:
        return
    for sign in (-1.0, 1.0):
        degrees, begin = sign * envelope.phase_jump.degrees, choices.before
        steps: list[Any] = [(0.0, 1.0), (begin, cmath.rect(1.0, math.radians(degrees)))]
        yield Trial(
            f"phase jump of {degrees:+g} degrees",
            "phase",
            Waveform.segments(steps, until=begin + choices.after),
            begin,
            begin + choices.after,
            degrees,
            0.0,
            envelope.phase_jump.mark,
            judged=(CONNECTED,),
        )


MAKERS = (
    _continuous, _bands, _along, _staircase, _reclosing, _recovery, _counting, _frequency, _rocof, _phase,
)  # fmt: skip
