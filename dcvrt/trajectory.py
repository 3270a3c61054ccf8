"""Result of one run: signals over time, events, status, sensitivities."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dcvrt.errors import InputError, did_you_mean

Array = NDArray[np.float64]
COMPLETED = "completed"


@dataclass(frozen=True)
class Event:
    """A jump of an automaton.

    Attributes
    ----------
    time : s.
    automaton : path of the block that switched.
    source, target : modes before and after.
    row : text of the row that fired.
    tie : texts of further rows that were due at the same instant; the first in the table won.
    grad : derivative of the time by every theta, s per unit of theta.
    """

    time: float
    automaton: str
    source: str
    target: str
    row: str
    tie: tuple[str, ...] = ()
    grad: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        tie = f" (tie with: {'; '.join(self.tie)})" if self.tie else ""
        return f"{self.time:.6f} s  {self.automaton}: {self.source} -> {self.target}  [{self.row}]{tie}"


class Pullback(Protocol):
    """What an adjoint run can say: the derivative by every theta of a form in derivatives of its samples."""

    def gradient(self, slope: object, sign: float = 1.0) -> Mapping[str, float]: ...


@dataclass(frozen=True, eq=False)
class Signals:
    """Named columns over time; the last axis of `sens` and `rate_sens` is theta.

    `rate` is the time derivative along the solution, one-sided at jumps.
    """

    names: tuple[str, ...]
    value: Array
    rate: Array | None = None
    sens: Array | None = None
    rate_sens: Array | None = None


Slopes = Callable[[], tuple[Array, Array | None]]
"""Computes the sensitivities of signals and of their rates."""


class LateSignals(Signals):
    """Signals whose sensitivities are computed when they are first read.

    Parameters
    ----------
    names, value, rate : as of :class:`Signals`.
    slopes : returns `sens` and `rate_sens`; called once at most, then forgotten.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        value: Array,
        rate: Array | None,
        slopes: Slopes,
    ) -> None:
        self.__dict__.update(names=names, value=value, rate=rate, slopes=slopes)

    @cached_property
    def _found(self) -> tuple[Array, Array | None]:
        found: tuple[Array, Array | None] = self.__dict__["slopes"]()
        del self.__dict__["slopes"]
        return found

    @property
    def sens(self) -> Array:
        """Derivatives of the values by every theta."""
        return self._found[0]

    @property
    def rate_sens(self) -> Array | None:
        """Derivatives of the rates by every theta."""
        return self._found[1]

    def __reduce__(self) -> tuple[Any, ...]:
        return Signals, (self.names, self.value, self.rate, self.sens, self.rate_sens)


class Sensitivities:
    """``run.sens["v_it", "beta"]``: derivative of a signal by a theta, on `run.t`."""

    def __init__(self, run: Trajectory) -> None:
        self._run = run

    def __getitem__(self, key: tuple[str, str]) -> Array:
        if not isinstance(key, tuple) or len(key) != 2:
            raise InputError(f"sens[{key!r}]: write run.sens['v_it', 'beta'], a signal and a theta.")
        signal, theta = key
        if theta not in self._run.wrt:
            raise InputError(
                f"{theta!r} is not among the wrt of this simulator.{did_you_mean(theta, self._run.wrt)}"
            )
        signals, k = self._run._find(signal)
        if self._run.adjoint is not None:
            raise InputError(
                f"sens[{signal!r}, {theta!r}]: an adjoint run has gradients of functionals, no sensitivities "
                f"over time. Ways out: Minimum({signal!r}).of(run).grad, margins(run); or mode='forward'."
            )
        assert signals.sens is not None
        return signals.sens[:, k, self._run.wrt.index(theta)]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Signals, events and status of one run.

    At an input jump and at an event a time stands twice: the values before, then the values after.

    Attributes
    ----------
    t : times, s; neighbours are at most `save_at` apart.
    outputs, states, algebraics : the signals.
    events : jumps of the automata in order.
    status : ``"completed"``, or the sentence that says how the run ended before its time.
    parameters : values of all parameters.
    wrt : names of the thetas.
    start_modes : mode of every automaton at the start.
    break_grad : derivative of the times that stand twice by every theta, in their order (0 at input jumps).
    adjoint : of a run with mode="adjoint": gives gradients in place of sensitivities.
    """

    t: Array
    outputs: Signals
    states: Signals
    algebraics: Signals
    events: tuple[Event, ...]
    status: str
    parameters: Mapping[str, float]
    wrt: tuple[str, ...]
    start_modes: Mapping[str, str]
    break_grad: Array
    name: str = ""
    adjoint: Pullback | None = None

    @property
    def completed(self) -> bool:
        """Whether the run reached the end of the waveform."""
        return self.status == COMPLETED

    @property
    def x(self) -> Array:
        """States, (times, states), columns in the order of the system."""
        return self.states.value

    @property
    def sens(self) -> Sensitivities:
        """Forward sensitivities: ``run.sens["v_it", "beta"]``."""
        return Sensitivities(self)

    @property
    def breaks(self) -> NDArray[np.int64]:
        """Positions k where t[k] == t[k + 1]: the last sample before a jump or an event."""
        return np.flatnonzero(np.diff(self.t) == 0.0)

    @property
    def sequence(self) -> tuple[str, ...]:
        """Modes visited with the rows that led there: the label under which margins may be compared."""
        begin = tuple(f"{path}: {mode}" for path, mode in self.start_modes.items())
        return begin + tuple(f"{e.automaton}: {e.source} -> {e.target} [{e.row}]" for e in self.events)

    def gradient(self, slope: Array, sign: float = 1.0) -> Mapping[str, float]:
        """Derivatives by name from the one entry per theta that a functional found."""
        if self.adjoint is not None:
            return self.adjoint.gradient(slope[0], sign)
        return {theta: float(sign * g) for theta, g in zip(self.wrt, slope, strict=True)}

    def __getitem__(self, name: str) -> Array:
        signals, k = self._find(name)
        return signals.value[:, k]

    def at(self, name: str, t: ArrayLike) -> Array:
        """Signal at any times: cubic between samples for outputs, else linear; after the jump at a jump."""
        signals, k = self._find(name)
        t = np.asarray(t, dtype=float)
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        h = self.t[i + 1] - self.t[i]
        s = np.clip((t - self.t[i]) / np.where(h > 0, h, 1.0), 0.0, 1.0)
        a, b = signals.value[i, k], signals.value[i + 1, k]
        value = a + s * (b - a)
        if signals.rate is not None:
            m, n = signals.rate[i, k] * h - (b - a), (b - a) - signals.rate[i + 1, k] * h
            value = value + s * (1 - s) * ((1 - s) * m + s * n)
        return value

    def _find(self, name: str) -> tuple[Signals, int]:
        groups = (self.outputs, self.states, self.algebraics)
        for signals in groups:
            if name in signals.names:
                return signals, signals.names.index(name)
        known = [n for signals in groups for n in signals.names]
        raise InputError(f"the run has no signal {name!r}.{did_you_mean(name, known)}")

    def plot(self, path: str | Path, signals: Sequence[str] | None = None) -> None:
        """Draw signals over time with the events marked, into a file (.svg, .png, .pdf).

        `signals` are the outputs that describe a ride-through unless given.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        wanted = list(
            signals or [n for n in ("v_it", "w_dc", "p_g", "p_b", "i_g", "q_g") if n in self.outputs.names]
        )
        if not wanted:
            wanted = list(self.outputs.names[:6] or self.states.names[:6])
        figure = Figure(figsize=(7.0, 1.3 * len(wanted) + 0.8), layout="constrained")
        FigureCanvasAgg(figure)
        axes: Any = figure.subplots(len(wanted), 1, sharex=True, squeeze=False)[:, 0]
        for axis, name in zip(axes, wanted, strict=True):
            axis.plot(self.t, self[name], linewidth=1.2, color="tab:blue")
            for event in self.events:
                axis.axvline(event.time, color="0.75", linewidth=0.7, zorder=0)
            axis.set_ylabel(name)
        for event in self.events:
            axes[0].annotate(
                event.target, (event.time, 1.02), xycoords=("data", "axes fraction"), rotation=60, fontsize=6
            )
        axes[-1].set_xlabel("time, s" if self.completed else f"time, s ({self.status})")
        try:
            figure.savefig(path)
        except OSError as error:
            raise InputError(
                f"plot: {path} cannot be written: {error.strerror}. Way out: another path."
            ) from None
        except ValueError as error:  # a form of file that matplotlib does not know
            raise InputError(
                f"plot: {path}: {error}. Way out: a path that ends with .svg, .png or .pdf."
            ) from None
