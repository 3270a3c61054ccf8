"""Test waveforms by name: sags, sequences of sags, phase jumps, frequency events.

Every scenario is our own composition. Where it follows a published event or rule, its docstring says which
figures are published and which are parameters of ours. Names and options can be listed without loading
anything heavy.
"""

from __future__ import annotations

import cmath
import inspect
import math
import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from dcvrt.errors import InputError, did_you_mean, is_number, raise_all

if TYPE_CHECKING:
    from dcvrt.waveform import Waveform

NOMINAL = 1.0


def _stepped(steps: Sequence[Any], until: float, name: str) -> Waveform:
    from dcvrt.waveform import Waveform

    return Waveform.segments(steps, until, name)


def _rotating(steps: Sequence[Any], until: float, name: str) -> Waveform:
    from dcvrt.waveform import Waveform

    return Waveform.rotating(steps, until, name=name)


def _sags(begins: Sequence[float], lengths: Sequence[float], depths: Sequence[complex]) -> list[Any]:
    steps: list[Any] = [(0.0, NOMINAL)]
    for begin, length, depth in zip(begins, lengths, depths, strict=True):
        steps += [(begin, depth), (begin + length, NOMINAL)]
    return steps


def _within(where: str, **values: tuple[float, float, float]) -> None:
    """Refuse values outside their range, all at once."""
    raise_all(
        [
            f"{name} = {value:g} must lie in [{low:g}, {high:g}]."
            if is_number(value)
            else f"{name} = {value!r} is not a number."
            for name, (value, low, high) in values.items()
            if not is_number(value) or not low <= value <= high
        ],
        where,
    )


# -- the scenarios ----------------------------------------------------------------------------------------


def ercot_style() -> Waveform:
    """Ramp, shallow fault, deep fault, high voltage on NOGRR282 boundaries: not ERCOT's official waveform."""
    from dcvrt.waveform import Waveform

    return Waveform.ercot_style()


def sag(retained: float = 0.5, start: float = 0.1, length: float = 0.15, until: float = 3.0) -> Waveform:
    """Rectangular sag."""
    from dcvrt.waveform import Waveform

    return Waveform.sag(retained, start, length, until)


def six_sags(
    n: int = 6,
    span: float = 82.0,
    seed: int = 0,
    spacing: Sequence[float] | None = None,
    depths: tuple[float, float] = (0.25, 0.40),
    lengths: tuple[float, float] = (0.042, 0.066),
    start: float = 1.0,
    after: float = 7.0,
) -> Waveform:
    """Six faults within 82 s, 42-66 ms to 0.25-0.40 pu, after NERC's report on 10 July 2024.

    Published: six faults, 82 s, the ranges of depth and length. Not published: depth and length of each, and
    their spacing. Depths and lengths are drawn from the ranges.

    Parameters
    ----------
    n, span : number of sags, and time from the start of the first to the end of the last, s.
    seed : of the depths and lengths; the same seed gives the same waveform everywhere.
    spacing : times from one start to the next, s, one fewer than sags; equal ones unless given.
    depths, lengths : ranges of the retained voltage, pu, and of the time, s.
    start, after : time before the first and after the last sag, s.
    """
    where = "six-sags"
    _within(where, n=(n, 1, 1000), span=(span, 0.1, 3600.0), start=(start, 0.01, 600.0))
    for label, (low, high), top in (("depths", depths, 1.0), ("lengths", lengths, 10.0)):
        _within(where, **{f"{label}[0]": (low, 0.0, high), f"{label}[1]": (high, low, top)})
    draw = random.Random(seed)
    depth = [draw.uniform(*depths) for _ in range(n)]
    length = [draw.uniform(*lengths) for _ in range(n)]
    if spacing is None:
        spacing = [(span - length[-1]) / (n - 1)] * (n - 1) if n > 1 else []
    if len(spacing) != n - 1:
        raise InputError(f"{where}: spacing has {len(spacing)} times; {n} sags need {n - 1}.")
    begins = [start + math.fsum(spacing[:k]) for k in range(n)]
    steps = _sags(begins, length, depth)
    return _stepped(steps, begins[-1] + length[-1] + after, f"{n} sags within {span:g} s, seed {seed}")


def reclosing(
    shots: int = 3,
    length: float = 0.06,
    dead_times: Sequence[float] | None = None,
    retained: float = 0.0,
    start: float = 0.5,
    after: float = 5.0,
) -> Waveform:
    """Shots of an automatic reclosure, 50-70 ms each (Dominion); number, depth and dead times are ours.

    Parameters
    ----------
    shots, length, retained : number of shots, length of each, s, voltage in them, pu.
    dead_times : times from the end of a shot to the next, s; 0.5, 2, 5, 5, ... unless given.
    start, after : time before the first and after the last shot, s.
    """
    where = "reclosing"
    _within(where, shots=(shots, 1, 20), length=(length, 1e-3, 10.0), retained=(retained, 0.0, 1.0))
    waits = [0.5, 2.0, *[5.0] * shots][: shots - 1] if dead_times is None else list(dead_times)
    if len(waits) != shots - 1:
        raise InputError(f"{where}: dead_times has {len(waits)} times; {shots} shots need {shots - 1}.")
    begins = [start + k * length + math.fsum(waits[:k]) for k in range(shots)]
    steps = _sags(begins, [length] * shots, [retained] * shots)
    name = f"reclosing: {shots} shots of {length * 1e3:g} ms to {retained:g} pu"
    return _stepped(steps, begins[-1] + length + after, name)


def interruption(length: float = 0.15, start: float = 0.5, after: float = 5.0) -> Waveform:
    """Momentary interruption: no voltage at all."""
    _within("interruption", length=(length, 1e-3, 60.0))
    steps = _sags([start], [length], [0.0])
    return _stepped(steps, start + length + after, f"interruption of {length * 1e3:g} ms")


def swell(level: float = 1.2, length: float = 2.0, start: float = 0.5, after: float = 5.0) -> Waveform:
    """Voltage swell."""
    _within("swell", level=(level, 1.0, 2.0), length=(length, 1e-3, 600.0))
    steps = _sags([start], [length], [level])
    return _stepped(steps, start + length + after, f"swell to {level:g} pu for {length:g} s")


def phase_jump(
    degrees: float = 20.0,
    retained: float = 1.0,
    length: float | None = None,
    start: float = 0.5,
    after: float = 5.0,
) -> Waveform:
    """Jump of the voltage angle, 20 degrees in the MTB demand cases, for good or for a `length`, s."""
    _within("phase-jump", degrees=(degrees, -180.0, 180.0), retained=(retained, 0.0, 2.0))
    turned = cmath.rect(retained, math.radians(degrees))
    steps = _sags([start], [length], [turned]) if length is not None else [(0.0, NOMINAL), (start, turned)]
    return _stepped(steps, start + (length or 0.0) + after, f"phase jump of {degrees:+g} degrees")


def frequency_ramp(
    rocof: float = -1.0,
    deviation: float = 1.0,
    hold: float = 2.0,
    back: bool = True,
    start: float = 0.5,
    after: float = 3.0,
) -> Waveform:
    """Frequency that ramps away, stays and comes back; voltage magnitude at 1 pu.

    Parameters
    ----------
    rocof : rate of change, Hz/s; its sign says which way.
    deviation : where the ramp ends, Hz from nominal, positive.
    hold, back : time at that frequency, s, and whether it comes back at the same rate.
    """
    where = "frequency-ramp"
    _within(
        where,
        rocof=(abs(rocof) if is_number(rocof) else rocof, 1e-3, 100.0),
        deviation=(deviation, 1e-3, 10.0),
    )
    _within(where, hold=(hold, 1e-3, 3600.0))
    away, time = math.copysign(deviation, rocof), deviation / abs(rocof)
    steps: list[Any] = [(0.0, 0.0), (start, 0.0, away), (start + time, away)]
    end = start + time + hold
    if back:
        steps += [(end, away, 0.0), (end + time, 0.0)]
        end += time
    return _rotating(steps, end + after, f"frequency ramp of {rocof:+g} Hz/s to {away:+g} Hz")


def frequency_step(
    deviation: float = -0.5, hold: float = 2.0, start: float = 0.5, after: float = 3.0
) -> Waveform:
    """Frequency that steps away and, after `hold` s, back; the angle does not jump."""
    _within("frequency-step", deviation=(deviation, -10.0, 10.0), hold=(hold, 1e-3, 3600.0))
    steps = [(0.0, 0.0), (start, deviation), (start + hold, 0.0)]
    return _rotating(steps, start + hold + after, f"frequency step of {deviation:+g} Hz")


def undervoltage_steps(last_step: float = 5.0, start: float = 0.5, after: float = 5.0) -> Waveform:
    """MTB-style staircase 0.90, 0.85, 0.80, 0.70, 0.60 pu at 0, 10, 17, 25, 32 s; the last length is ours."""
    _within("undervoltage-steps", last_step=(last_step, 0.01, 600.0))
    begins = [start + t for t in (0.0, 10.0, 17.0, 25.0, 32.0)]
    end = begins[-1] + last_step
    steps = [(0.0, NOMINAL), *zip(begins, (0.90, 0.85, 0.80, 0.70, 0.60), strict=True), (end, NOMINAL)]
    return _stepped(steps, end + after, "undervoltage staircase")


def unbalanced_sag(
    phases: int = 1, retained: float = 0.0, length: float = 0.15, start: float = 0.5, after: float = 5.0
) -> Waveform:
    r"""Sag of one or two phases, as the positive sequence that a facility model here sees.

    With the angles of all phases unchanged :math:`V_1 = (3 - n + n r) / 3` for n phases at r. A relay or a
    supply on the worst phase sees r: its verdict can be worse. The name of the waveform says so.
    """
    _within("unbalanced-sag", phases=(phases, 1, 3), retained=(retained, 0.0, 1.0), length=(length, 1e-3, 60))
    positive = (3 - phases + phases * retained) / 3
    what = f"{phases} phase(s) at {retained:g} pu for {length * 1e3:g} ms"
    name = f"positive sequence {positive:.3f} pu of {what}"
    return _stepped(_sags([start], [length], [positive]), start + length + after, name)


SCENARIOS: dict[str, Callable[..., Waveform]] = {
    "ercot-style": ercot_style,
    "sag-30": partial(sag, 0.30),
    "sag-50": partial(sag, 0.50),
    "sag-70": partial(sag, 0.70),
    "sag-85": partial(sag, 0.85),
    "six-sags": six_sags,
    "reclosing": reclosing,
    "interruption": interruption,
    "swell": swell,
    "phase-jump": phase_jump,
    "frequency-ramp": frequency_ramp,
    "frequency-step": frequency_step,
    "undervoltage-steps": undervoltage_steps,
    "unbalanced-sag": unbalanced_sag,
}
"""Every scenario by name; sag-NN leaves NN % for 150 ms."""


def names() -> tuple[str, ...]:
    """Names of the scenarios.

    >>> names()[0]
    'ercot-style'
    """
    return tuple(SCENARIOS)


def get(name: str, **options: Any) -> Waveform:
    """The waveform of a scenario.

    Parameters
    ----------
    name : one of :func:`names`.
    options : parameters of the function of that name in this module.

    Raises
    ------
    InputError
        an unknown name or option, a value outside its range.

    Examples
    --------
    >>> w = get("swell", level=1.15, length=1.0)
    >>> w.name, complex(w.at(1.0))
    ('swell to 1.15 pu for 1 s', (1.15+0j))
    """
    if name not in SCENARIOS:
        raise InputError(f"there is no scenario {name!r}.{did_you_mean(name, SCENARIOS)}")
    make = SCENARIOS[name]
    known = list(inspect.signature(make).parameters)
    raise_all(
        [
            f"no option {key!r}.{did_you_mean(key, known) or ' It has none.'}"
            for key in options
            if key not in known
        ],
        f"scenario {name!r}",
    )
    return make(**options)
