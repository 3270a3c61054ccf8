r"""The flat hybrid system that a diagram compiles to and that every integrator reads.

A :class:`Dae` is

.. math::
    \dot x = f(t, x, z, u, p, q, c), \qquad
    0 = g(t, x, z, u, p, q, c), \qquad
    y = h(t, x, z, u, p, q, c)

with states `x`, algebraic variables `z`, inputs `u`, parameters `p`, the flags `q` of the active modes and
the clocks `c` (time since each automaton entered its mode). Inside a mode every function is smooth; all
that is discrete stands in the automata, as data. Models build it, integrators read it; neither knows the
other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import InputError, did_you_mean, raise_all, refusal

if TYPE_CHECKING:
    from dcvrt.linear import Linear, OperatingPoint

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One named scalar of the system.

    `value` is the start value of a state or algebraic variable, the rest value of an input, the value of a
    parameter, and is not used for outputs. `bounds` of a state is its range of validity: crossing it
    is an event that ends the run with a status; of a parameter it is the range that may be set.
    """

    path: str
    unit: str
    value: float = 0.0
    bounds: tuple[float, float] = (-np.inf, np.inf)
    doc: str = ""
    source: str = ""
    crossing: str = ""
    """What it means when a state leaves its bounds, for the status sentence ("DC link collapsed")."""


@dataclass(frozen=True)
class Transition:
    """Row of an automaton: from `source` to `target` once `guard` has been positive for longer than `held`.

    `guard` and `held` are SX expressions of the system's own symbols (`held` of parameters only; 0 fires at
    once). `reset` maps state positions to expressions of the values before the jump; all other states are
    continuous.
    """

    source: str
    target: str
    guard: ca.SX
    held: ca.SX
    text: str
    reset: Mapping[int, ca.SX] = field(default_factory=dict)


@dataclass(frozen=True)
class Gap:
    """Two rows that lead back and forth between two modes: while their limits overlap, the modes chatter.

    One for every combination of the alternatives in the two guards.

    Attributes
    ----------
    rows : texts of the two rows.
    width : SX expression of the parameters; the limits are apart while it is positive.
    limits : name and SX expression of the limits that are compared.
    """

    rows: tuple[str, str]
    width: ca.SX
    limits: tuple[tuple[str, ca.SX], ...]


@dataclass(frozen=True)
class Tied:
    """A number that follows from the parameters and has a range of its own.

    A parameter of a block that is bound to an expression, or a dwell time.

    Attributes
    ----------
    what : what it is, as messages name it.
    unit, bounds : its unit, and the range in which it must lie.
    value : SX expression of the parameters.
    """

    what: str
    unit: str
    bounds: tuple[float, float]
    value: ca.SX


@dataclass(frozen=True)
class Automaton:
    """Modes, the flags each mode sets, and the rows that lead from one to another, tried top to bottom.

    Attributes
    ----------
    path : path of the block that owns it.
    modes, start : mode names and the one that a run starts in.
    q : SX column of flag symbols that the equations read, one per row of `flag_names`.
    flags : array (modes, flags): value of `q` in each mode.
    clock : SX symbol, time since the current mode was entered.
    rows : transitions in order.
    gaps : pairs of rows whose limits must be apart, whatever the parameters are set to.
    """

    path: str
    modes: tuple[str, ...]
    start: str
    q: ca.SX
    flag_names: tuple[str, ...]
    flags: Array
    clock: ca.SX
    rows: tuple[Transition, ...]
    gaps: tuple[Gap, ...] = ()

    def mode_number(self, mode: str) -> int:
        """Position of `mode` in `modes`."""
        if mode not in self.modes:
            raise InputError(f"{self.path} has no mode {mode!r}.{did_you_mean(mode, self.modes)}")
        return self.modes.index(mode)


@dataclass(frozen=True, eq=False)
class Dae:
    """Flat hybrid differential-algebraic system, frozen.

    Attributes
    ----------
    name : name of the diagram.
    t : SX symbol of time, s.
    x, z, u, p : SX columns of symbols, in the order of `states`, `algebraics`, `inputs`, `parameters`.
    f, g, y : SX columns: derivative of x, residual of z, outputs in the order of `outputs`.
    states, algebraics, inputs, parameters, outputs : their named rows.
    automata : the discrete parts; empty for a smooth system.
    start : SX column of `x` then `z`, start values as functions of `p` and `u` for the search of the
        equilibrium (a guess, not the equilibrium itself).
    notes : deviations from the paper, one line each ('path: text').
    tied : what follows from the parameters and must stay within a range of its own.
    """

    name: str
    t: ca.SX
    x: ca.SX
    z: ca.SX
    u: ca.SX
    p: ca.SX
    f: ca.SX
    g: ca.SX
    y: ca.SX
    states: tuple[Row, ...]
    algebraics: tuple[Row, ...]
    inputs: tuple[Row, ...]
    parameter_rows: tuple[Row, ...]
    outputs: tuple[Row, ...]
    automata: tuple[Automaton, ...] = ()
    start: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    notes: tuple[str, ...] = ()
    tied: tuple[Tied, ...] = ()

    @property
    def parameters(self) -> ParameterTable:
        """Path, value, unit, bounds, meaning and source of every parameter, printable."""
        return ParameterTable(self.parameter_rows)

    @property
    def q(self) -> ca.SX:
        """Flags of all automata, stacked."""
        return ca.vertcat(*[a.q for a in self.automata]) if self.automata else ca.SX(0, 1)

    @property
    def clocks(self) -> ca.SX:
        """Clocks of all automata, stacked."""
        return ca.vertcat(*[a.clock for a in self.automata]) if self.automata else ca.SX(0, 1)

    @cached_property
    def x_names(self) -> tuple[str, ...]:
        return tuple(r.path for r in self.states)

    @cached_property
    def z_names(self) -> tuple[str, ...]:
        return tuple(r.path for r in self.algebraics)

    @cached_property
    def p_names(self) -> tuple[str, ...]:
        return tuple(r.path for r in self.parameter_rows)

    @cached_property
    def u_names(self) -> tuple[str, ...]:
        return tuple(r.path for r in self.inputs)

    @cached_property
    def y_names(self) -> tuple[str, ...]:
        return tuple(r.path for r in self.outputs)

    def automaton_behind(self, output: str) -> Automaton:
        """The automaton whose flags an output shows, as `mode` does.

        Raises
        ------
        InputError
            no such output, or one that does not show exactly one automaton.
        """
        if output not in self.y_names:
            raise InputError(f"{self.name} has no output {output!r}.{did_you_mean(output, self.y_names)}")
        signal = self.y[self.y_names.index(output)]
        shown = [a for a in self.automata if a.q.numel() and ca.depends_on(signal, a.q)]
        if len(shown) != 1:
            found = ", ".join(a.path for a in shown) or "none"
            raise InputError(f"{self.name}: output {output!r} must show one automaton; it shows {found}.")
        return shown[0]

    def parameter_number(self, path: str) -> int:
        """Position of the parameter `path` in `p`."""
        if path not in self._position:
            raise InputError(f"{self.name} has no parameter {path!r}.{did_you_mean(path, self.p_names)}")
        return self._position[path]

    def parameter_values(self, **changes: float) -> Array:
        """Values of `p` with some changed; each change is checked against its bounds.

        A path `block.symbol` is given as keyword through ``**{"block.symbol": value}``.

        Raises
        ------
        InputError
            unknown names and values outside their bounds, all at once; bound parameters that they would take
            outside theirs, and limits of guards that would leave no hysteresis between two modes.
        """
        values, problems = self._given.copy(), []
        for path, value in changes.items():
            if path not in self._position:
                problems.append(f"{self.name} has no parameter {path!r}.{did_you_mean(path, self.p_names)}")
                continue
            row = self.parameter_rows[self._position[path]]
            if problem := refusal(path, value, row.unit, row.bounds):
                problems.append(problem)
                continue
            values[self._position[path]] = value
        if not problems and not self._read_together.isdisjoint(changes):
            problems = [f"{self.name}: {problem}" for problem in self.conflicts(values)]
        if problems:
            raise InputError("\n".join(problems))
        return values

    def parameter_cases(self, cases: Sequence[Mapping[str, float]], where: str) -> Array:
        """:meth:`parameter_values` of many cases that change the same parameters, a row each.

        Raises
        ------
        InputError
            what is wrong with any of the cases, each sentence once; `where` says of what they are cases.
        """
        values = np.tile(self._given, (len(cases), 1))
        paths = list(cases[0]) if cases else []
        if all(path in self._position for path in paths):
            at = [self._position[path] for path in paths]
            values[:, at] = [[case[path] for path in paths] for case in cases]
            low, high = np.array([self.parameter_rows[k].bounds for k in at]).reshape(-1, 2).T
            if np.all((values[:, at] >= low) & (values[:, at] <= high)) and self._agree(values):
                return values
        problems: dict[str, None] = {}
        for case in cases:
            try:
                self.parameter_values(**case)
            except InputError as error:
                problems |= dict.fromkeys(str(error).splitlines())
        raise_all(list(problems), where)
        return values

    def linearise(self, at: OperatingPoint) -> Linear:
        """The linear system for small disturbances about a point, algebraic variables eliminated.

        Parameters
        ----------
        at : from ``Simulator(dae).equilibrium(...)``, or :func:`dcvrt.linear.operating_point`.

        Raises
        ------
        InputError
            the point belongs to another system.
        ModelError
            the algebraic equations are singular at the point, or a derivative is not finite.
        """
        from dcvrt.linear import linearise

        return linearise(self, at)

    def conflicts(self, values: Array) -> list[str]:
        """What the parameter values, each within its bounds, do together that cannot be: one message each.

        Bound parameters and dwell times outside their range; pairs of rows without hysteresis.
        """
        numbers = iter(np.array(self._together(values)).ravel().tolist())
        problems = []
        for tied in self.tied:
            value, (low, high) = next(numbers), tied.bounds
            if not low <= value <= high and (problem := refusal(tied.what, value, tied.unit, tied.bounds)):
                problems.append(problem)
        for a in self.automata:
            for gap in a.gaps:
                width, limits = next(numbers), [(name, next(numbers)) for name, _ in gap.limits]
                if not width > 0:
                    named = [(name, value) for name, value in limits if not _is_number(name)]
                    now = ", ".join(f"{name} = {value:g}" for name, value in named or [("gap", width)])
                    problems.append(
                        f"{a.path}: '{gap.rows[0]}' and '{gap.rows[1]}' leave no gap between them ({now}): "
                        "the modes would chatter. Set the limit of the way back beyond that of the way out."
                    )
        return problems

    def _agree(self, values: Array) -> bool:
        """Whether no case, a row each, has any of the `conflicts`."""
        together = np.array(self._together(values.T))
        low, high = np.array([tied.bounds for tied in self.tied]).reshape(-1, 2).T[:, :, None]
        tied = together[: len(self.tied)]
        sizes = [1 + len(gap.limits) for a in self.automata for gap in a.gaps]
        widths = together[len(self.tied) + np.cumsum([0, *sizes])[:-1].astype(int)]
        return bool(np.all((tied >= low) & (tied <= high)) and np.all(widths > 0))

    @cached_property
    def _given(self) -> Array:
        """Values of `p` as the system has them."""
        return np.array([r.value for r in self.parameter_rows], dtype=float)

    @cached_property
    def _position(self) -> dict[str, int]:
        """Position of every parameter in `p`."""
        return {path: k for k, path in enumerate(self.p_names)}

    @cached_property
    def _read_together(self) -> frozenset[str]:
        """Parameters that the conflicts depend on."""
        together = self._together(self.p)
        reads = ca.which_depends(together, self.p, 1) if together.numel() else []
        return frozenset(path for path, read in zip(self.p_names, reads, strict=False) if read)

    @cached_property
    def _together(self) -> ca.Function:
        """What is tied to the parameters, then width and limits of every gap, as a function of them."""
        gaps = [g for a in self.automata for g in a.gaps]
        rows = [tied.value for tied in self.tied]
        rows += [e for g in gaps for e in (g.width, *(limit for _, limit in g.limits))]
        return ca.Function("together", [self.p], [ca.densify(ca.vertcat(ca.SX(0, 1), *rows))])


def _is_number(text: str) -> bool:
    """Whether a limit is written as a number, which says its own value."""
    try:
        float(text)
    except ValueError:
        return False
    return True


class ParameterTable(tuple[Row, ...]):
    """Rows of parameters that print as a table."""

    __slots__ = ()

    def __str__(self) -> str:
        cells = [("parameter", "value", "unit", "bounds", "meaning", "source")]
        cells += [
            (r.path, f"{r.value:g}", r.unit, f"[{r.bounds[0]:g}, {r.bounds[1]:g}]", r.doc, r.source)
            for r in self
        ]
        widths = [max(len(row[k]) for row in cells) for k in range(4)]
        return "\n".join(
            "  ".join([c.ljust(w) for c, w in zip(row, widths, strict=False)] + [row[4], row[5]]).rstrip()
            for row in cells
        )
