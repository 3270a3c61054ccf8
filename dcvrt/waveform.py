r"""Voltage at the point of interconnection (POI) over time: what a facility has to ride through.

A :class:`Waveform` is the positive-sequence phasor V(t) in per unit on given times. **A time that stands
twice is a jump**: the first value holds up to it, the second from it on. Between jumps V is a C1 cubic

.. math::
    V(t_k + s T_k) = c_0 + c_1 s + c_2 s^2 + c_3 s^3, \qquad 0 \le s \le 1,

through the samples, with the slope of the parabola through three neighbours at inner samples and the
one-sided parabola at jumps and ends. The slopes are linear in the samples, so a tangent dV/dtheta that is
given on the same times is interpolated to the exact derivative of V(t). Two points alone are joined by a
straight line, which is why the stepped waveforms below mark their corners as (empty) jumps: constants and
ramps are met exactly.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dcvrt.errors import InputError, did_you_mean, raise_all
from dcvrt.samples import Pieces, check_samples, cubic_pieces, gaps, negative, spans_of_steps
from dcvrt.waveform_tables import TIME_NAMES, column, columns, voltage

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Segment = tuple[float, complex] | tuple[float, complex, complex]

HIGHEST = 3.0
"""Voltage magnitude, pu, above which a waveform is taken to be in volts or kilovolts by mistake."""
TURN = 0.05
"""Largest angle, rad, between samples of a rotating phasor: the cubic's magnitude errs by 3/128 of its fourth
power, its speed ripples by a sixth of its square."""
BEND = 3e-6
"""Largest product of speed, acceleration, and cube of the distance between samples: the cubic's magnitude
errs by about a seventh of it."""


@dataclass(frozen=True, eq=False)
class Waveform:
    """Positive-sequence POI voltage phasor over time, with its jumps marked.

    Parameters
    ----------
    t : times in s, increasing; a time that stands twice is a jump.
    v : complex voltage in pu on these times (network frame); real values are magnitudes at angle 0.
    tangents : dV/dtheta per named quantity, complex, on the same times (pu per unit of theta).
    name : shown in reports.

    Raises
    ------
    InputError
        NaN, times that do not increase, a time that stands three times, fewer than two samples, shapes that
        differ.

    Examples
    --------
    >>> w = Waveform.sag(retained=0.5, start=0.1, length=0.15, until=1.0)
    >>> complex(w.at(0.2)), w.jumps
    ((0.5+0j), (0.1, 0.25))
    """

    t: Array
    v: ComplexArray
    tangents: Mapping[str, ComplexArray] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self) -> None:
        problems = check_samples(self.t, self.v, "v")
        for tangent, values in self.tangents.items():
            problems += [
                p for p in check_samples(self.t, values, f"tangents[{tangent!r}]") if "tangents" in p
            ]
        if not problems and (high := np.abs(self.v)).max() > HIGHEST:
            k = int(np.argmax(high))
            problems.append(
                f"|v[{k}]| = {high[k]:g} pu at {self.t[k]:g} s is above {HIGHEST:g} pu. "
                "Divide by the nominal voltage: a waveform is in per unit."
            )
        raise_all(problems, f"waveform {self.name!r}" if self.name else "waveform")
        set_ = object.__setattr__
        set_(self, "t", _frozen(np.asarray(self.t, dtype=float)))
        set_(self, "v", _frozen(np.asarray(self.v, dtype=complex)))
        tangents = {k: _frozen(np.asarray(x, dtype=complex)) for k, x in self.tangents.items()}
        set_(self, "tangents", MappingProxyType(tangents))
        set_(self, "_pieces", {})

    def __reduce__(self) -> tuple[Any, ...]:
        return Waveform, (np.array(self.t), np.array(self.v), dict(self.tangents), self.name)

    # -- constructors -------------------------------------------------------------------------------------

    @classmethod
    def segments(
        cls, steps: Sequence[Segment], until: float | None = None, name: str = "segments"
    ) -> Waveform:
        """Build from steps and ramps.

        Parameters
        ----------
        steps : entries ``(t, v)`` - from `t` on the voltage is `v` - or ``(t, v_from, v_to)`` - at `t` it
            steps to `v_from` and goes straight to `v_to`, which it reaches when the next entry begins. Values
            are magnitudes or complex, pu.
        until : end of the waveform, s; 1 s after the last entry unless given.

        Examples
        --------
        >>> w = Waveform.segments([(0.0, 1.0), (0.1, 0.5), (0.2, 0.7, 1.0), (0.6, 1.0)], until=1.0)
        >>> w.magnitude.tolist()
        [1.0, 1.0, 0.5, 0.5, 0.7, 1.0, 1.0, 1.0]
        """
        spans, problems = spans_of_steps(steps, until)
        problems += [
            problem for k, s in enumerate(steps) for problem in negative(np.array(s[1:]), f"segment {k}")
        ]
        raise_all(problems, "waveform")
        t = [x for span in spans for x in span]
        v = [x for s in steps for x in (complex(s[1]), complex(s[-1]))]
        return cls(np.array(t), np.array(v), name=name)

    @classmethod
    def sag(
        cls, retained: float, start: float, length: float, until: float, phase_jump: float = 0.0
    ) -> Waveform:
        """Rectangular sag from 1 pu to `retained` pu (a swell when above 1).

        Parameters
        ----------
        retained : voltage magnitude in the sag, pu.
        start, length, until : begin and duration of the sag and end of the waveform, s; a sag that lasts
            longer than the waveform ends with it.
        phase_jump : angle of the phasor during the sag, rad.
        """
        if not retained >= 0.0 or not length > 0.0:
            raise InputError(
                f"sag: retained = {retained:g} pu must not be negative, length = {length:g} s not zero."
            )
        during = retained * cmath.exp(1j * phase_jump)
        steps: list[Segment] = [(0.0, 1.0), (start, during)]
        if start + length < until:
            steps.append((start + length, 1.0))
        return cls.segments(steps, until, name=f"sag to {retained:g} pu for {length * 1e3:g} ms")

    @classmethod
    def rotating(
        cls,
        steps: Sequence[tuple[float, float] | tuple[float, float, float]],
        until: float | None = None,
        magnitude: float = 1.0,
        name: str = "rotating phasor",
    ) -> Waveform:
        r"""Build a phasor of constant magnitude whose frequency leaves the nominal one.

        .. math::
            V(t) = |V| \, e^{j \theta(t)}, \qquad \dot\theta = 2 \pi \, \Delta f(t)

        It is sampled so densely that |V(t)| stays within 1e-6 of `magnitude` between the samples too.

        Parameters
        ----------
        steps : deviation from the nominal frequency, Hz, as for :meth:`segments`: ``(t, f)`` - from `t` on it
            is `f` - or ``(t, f_from, f_to)``, a straight ramp. The angle never jumps.
        until : end of the waveform, s; 1 s after the last entry unless given.
        magnitude : |V|, pu.

        Examples
        --------
        >>> w = Waveform.rotating([(0.0, 0.0), (0.5, 0.0, -1.0), (1.5, -1.0)], until=3.0)
        >>> abs(w.at(1.5) + 1.0) < 1e-12, abs(w.at(2.0) - 1.0) < 1e-12  # half a turn each
        (True, True)
        """
        spans, problems = spans_of_steps(steps, until)
        raise_all(problems, "waveform")
        t, theta, angle = [], [], 0.0
        for (begin, end), step in zip(spans, steps, strict=True):
            first, last = 2 * math.pi * float(step[1]), 2 * math.pi * float(step[-1])
            length, rate = end - begin, (last - first) / (end - begin)
            fastest = max(abs(first), abs(last))
            turn = length * max(fastest / TURN, math.cbrt(fastest * abs(rate) / BEND))
            since = np.linspace(0.0, length, max(2 if turn == 0 else 9, math.ceil(turn) + 1))
            t.append(begin + since)
            t[-1][-1] = end
            theta.append(angle + first * since + 0.5 * rate * since**2)
            angle = float(theta[-1][-1])
        return cls(np.concatenate(t), magnitude * np.exp(1j * np.concatenate(theta)), name=name)

    @classmethod
    def from_samples(
        cls,
        t: ArrayLike,
        v: ArrayLike,
        tangents: Mapping[str, ArrayLike] | None = None,
        jumps: Iterable[float] | None = None,
        name: str = "samples",
    ) -> Waveform:
        """Wrap sampled values.

        Parameters
        ----------
        t, v : times in s and complex or magnitude values in pu; a time that stands twice is a jump.
        tangents : dV/dtheta on the same times.
        jumps : times at which `v` jumps although no time stands twice there: the sample before holds up to
            the jump, the sample after from it on.
        """
        raise_all(negative(v, "v"), f"waveform {name!r}")
        t, v = np.asarray(t, dtype=float), np.asarray(v, dtype=complex)
        columns = {k: np.asarray(x, dtype=complex) for k, x in (tangents or {}).items()}
        raise_all(check_samples(t, v, "v"), f"waveform {name!r}")
        for jump in sorted(jumps or ()):
            if not t[0] < jump < t[-1]:
                raise InputError(f"waveform: jump at {jump:g} s is outside ({t[0]:g}, {t[-1]:g}) s.")
            k = int(np.searchsorted(t, jump, side="left"))
            before, after = np.flatnonzero(t == jump), np.array([jump, jump])
            if len(before) == 2:
                continue
            missing = after[len(before) :]
            t = np.insert(t, k, missing)
            take = np.insert(np.arange(len(v)), k, [k - 1, k][: len(missing)])
            v, columns = v[take], {name_: x[take] for name_, x in columns.items()}
        return cls(t, v, columns, name)

    @classmethod
    def from_csv(
        cls,
        path: str | Path,
        phases: Literal["minimum", "mean"] | None = None,
        jumps: Iterable[float] | None = None,
    ) -> Waveform:
        """Read a table with a header: a time column in s and the voltage in pu.

        The voltage is `v_re` and `v_im`, or a magnitude with or without `angle` in degrees, or three RMS
        phase voltages `v_a`, `v_b`, `v_c` that `phases` reduces to their minimum or mean (a facility model
        here is positive-sequence: the minimum is the careful choice). Separators ``,`` ``;`` or tab, a
        byte-order mark, a decimal comma, a leading count line and lines that begin with ``#`` are understood.

        Raises
        ------
        InputError
            a missing column (with the columns found), a cell that is not a number, unusable samples, a gap in
            a record that is sampled at a fixed interval.
        """
        table = columns(Path(path))
        where = f"{path}: waveform table"
        t = column(table, TIME_NAMES, where)
        v = voltage(table, phases, where)
        raise_all(gaps(t), str(path))
        try:
            return cls.from_samples(t, v, jumps=jumps, name=Path(path).stem)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    @classmethod
    def from_comtrade(
        cls,
        path: str | Path,
        magnitude: str,
        angle: str | None = None,
        base: float = 1.0,
        jumps: Iterable[float] | None = None,
    ) -> Waveform:
        """Read RMS or phasor channels of a COMTRADE record (.cfg with .dat beside it, or .cff).

        Parameters
        ----------
        magnitude, angle : names of the analogue channels with the magnitude and the angle in degrees.
            Channels with the instantaneous wave are not phasors: take their phasor first.
        base : value of `magnitude` that is 1 pu.
        """
        try:
            import comtrade  # type: ignore[import-not-found, unused-ignore]
        except ModuleNotFoundError:
            raise InputError(
                "Reading COMTRADE needs the package 'comtrade': pip install 'dcvrt[comtrade]'. "
                "Or export the record to CSV and use Waveform.from_csv."
            ) from None
        record = comtrade.load(str(path))
        found = {
            str(n).strip(): np.asarray(x, dtype=float)
            for n, x in zip(record.analog_channel_ids, record.analog, strict=True)
        }
        for channel in filter(None, (magnitude, angle)):
            if channel not in found:
                raise InputError(f"{path}: no analogue channel {channel!r}.{did_you_mean(channel, found)}")
        raise_all(negative(found[magnitude], magnitude), str(path))
        turn = np.deg2rad(found[angle]) if angle else 0.0
        v = found[magnitude] / base * np.exp(1j * turn)
        t = np.asarray(record.time, dtype=float)
        raise_all(gaps(t), str(path))
        return cls.from_samples(t, v, jumps=jumps, name=Path(path).stem)

    @classmethod
    def ercot_style(cls) -> Waveform:
        """Test waveform with ramp, shallow fault, deep fault and high voltage, 10 s.

        Our own composition on the voltage and time boundaries of ERCOT NOGRR282 (0.90, 0.80, 0.50, 0.20 and
        1.20 pu; 2.0, 0.5 and 0.25 s). It is **not** ERCOT's test waveform, which was not available.
        """
        steps: list[Segment] = [
            (0.0, 1.0),
            (0.5, 1.0, 0.91), (1.0, 0.91), (1.5, 0.91, 1.0), (2.0, 1.0),  # ramp inside the continuous range
            (2.5, 0.80), (3.0, 1.0),  # shallow fault
            (4.0, 0.20), (4.25, 0.50), (4.5, 0.80), (6.0, 1.0),  # deep fault, back along the envelope
            (7.0, 1.20), (9.0, 1.0),  # high voltage
        ]  # fmt: skip
        return cls.segments(steps, until=10.0, name="ERCOT-style (not the official waveform)")

    # -- what it holds ------------------------------------------------------------------------------------

    @property
    def magnitude(self) -> Array:
        """|V| on `t`, pu."""
        return np.abs(self.v)

    @property
    def jumps(self) -> tuple[float, ...]:
        """Times that stand twice, s."""
        return tuple(self.t[1:][np.diff(self.t) == 0].tolist())

    @property
    def start(self) -> float:
        """First time, s."""
        return float(self.t[0])

    @property
    def until(self) -> float:
        """Last time, s."""
        return float(self.t[-1])

    def pieces(self, tangent: str | None = None) -> Pieces:
        """Times and cubic coefficients of V, or of one of its tangents."""
        cache: dict[str | None, Pieces] = self.__dict__["_pieces"]
        if tangent not in cache:
            if tangent is not None and tangent not in self.tangents:
                raise InputError(
                    f"waveform {self.name!r} has no tangent {tangent!r}."
                    f"{did_you_mean(tangent, self.tangents)}"
                )
            cache[tangent] = cubic_pieces(self.t, self.v if tangent is None else self.tangents[tangent])
        return cache[tangent]

    def at(self, t: ArrayLike) -> Any:
        """Phasor at times `t`, pu; at a jump the value after it, outside the range the end values."""
        value = self.pieces().at(t)
        return complex(value) if np.ndim(value) == 0 else value

    def same_layout(self, other: Waveform) -> bool:
        """Whether both stand on the same times with jumps at the same places."""
        return np.array_equal(self.t, other.t)

    def shifted(self, by: float) -> Waveform:
        """Shift in time by `by` s."""
        return replace(self, t=self.t + by)

    def resampled(self, dt: float) -> Waveform:
        """Sample anew so that no step is longer than `dt` s; jumps stay where they are."""
        if not dt > 0:
            raise InputError(f"waveform: dt = {dt:g} s must be positive.")
        edges = np.concatenate(([0], np.flatnonzero(np.diff(self.t) == 0) + 1, [len(self.t)]))
        runs = [(self.t[a], self.t[b - 1]) for a, b in itertools.pairwise(edges) if b - a > 1]
        grids = [np.linspace(a, b, max(2, math.ceil((b - a) / dt - 1e-9) + 1)) for a, b in runs]
        t = np.concatenate(grids)

        def on_grids(tangent: str | None) -> ComplexArray:
            pieces = self.pieces(tangent)
            parts = [pieces.at(grid) for grid in grids]
            for part, grid in zip(
                parts, grids, strict=True
            ):  # the end of a run lies before the jump, not after it
                part[-1] = pieces.coefficients[np.searchsorted(pieces.start, grid[-1], side="left") - 1].sum()
            return np.concatenate(parts)

        return Waveform(t, on_grids(None), {k: on_grids(k) for k in self.tangents}, self.name)


def _frozen(values: NDArray[Any]) -> NDArray[Any]:
    values = values.copy()
    values.setflags(write=False)
    return values
