"""The variables of an FMU: names, value references, and which of them what depends on.

Value references run through the blocks time, x, dx/dt, u, p, y, z, event indicators, modes in this order, as
`sources/fmi3.c` reads them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.dae import Dae, Gap, Transition
from dcvrt.errors import ModelError

IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
BOUND_TOLERANCE = 1e-9
"""How far beyond its bound a state is taken to have left it, over 1 + |bound|."""


def structured(path: str) -> str:
    """A path as a structured name of FMI: parts that are no identifiers are quoted.

    >>> structured("pll.K_p"), structured("ups-a.v")
    ('pll.K_p', "'ups-a'.v")
    """
    parts = path.split(".")
    return ".".join(part if IDENTIFIER.fullmatch(part) else f"'{part}'" for part in parts)


@dataclass(frozen=True)
class Bound:
    """One side of the range of validity of a state."""

    state: int
    sign: float
    limit: float


class First(NamedTuple):
    """The first value reference of each block."""

    time: int
    x: int
    f: int
    u: int
    p: int
    y: int
    z: int
    h: int
    mode: int


class Layout:
    """Blocks of variables of one system, and the expressions behind them.

    `h` stacks what the event indicators are while their row is active: the guards of all rows, then
    `sign (x - bound) - tolerance` of the bounds of states. `together` stacks what must be in order between
    the parameters: what is tied to them, then width and limits of every gap.
    """

    def __init__(self, dae: Dae) -> None:
        self.dae = dae
        self.rows: list[tuple[int, Transition]] = [
            (a, row) for a, automaton in enumerate(dae.automata) for row in automaton.rows
        ]
        self.bounds = [
            Bound(k, sign, float(limit))
            for k, row in enumerate(dae.states)
            for sign, limit in ((-1.0, row.bounds[0]), (1.0, row.bounds[1]))
            if np.isfinite(limit)
        ]
        # an empty column may come as a row without columns, which vertcat takes for one of zeros
        self.f, self.g, self.y = (ca.vec(e) for e in (dae.f, dae.g, dae.y))
        self.h = ca.vertcat(
            ca.SX(0, 1),
            *[ca.SX(row.guard) for _, row in self.rows],
            *[
                b.sign * (dae.x[b.state] - b.limit) - BOUND_TOLERANCE * (1 + abs(b.limit))
                for b in self.bounds
            ],
        )
        self.gaps: list[tuple[str, Gap]] = [(a.path, gap) for a in dae.automata for gap in a.gaps]
        widths_and_limits = [
            e for _, gap in self.gaps for e in (gap.width, *(limit for _, limit in gap.limits))
        ]
        self.together = ca.vertcat(ca.SX(0, 1), *[tied.value for tied in dae.tied], *widths_and_limits)
        nx = len(dae.states)
        sizes = (1, nx, nx, len(dae.inputs), len(dae.parameter_rows), len(dae.outputs), len(dae.algebraics))
        starts = np.cumsum((0, *sizes, len(self.rows) + len(self.bounds)))
        self.first = First(*(int(k) for k in starts))

    # -- what depends on what ----------------------------------------------------------------------------

    @cached_property
    def _reach_of_z(self) -> NDArray[np.bool_]:
        """Whether the algebraic part as a whole depends on each of x, u, t and the clocks."""
        return np.array([column.any() for column in self._pattern(self.g, self._knowns).T])

    @property
    def _knowns(self) -> ca.SX:
        return ca.vertcat(self.dae.x, self.dae.u, self.dae.t, self.dae.clocks)

    @staticmethod
    def _pattern(results: ca.SX, arguments: ca.SX) -> NDArray[np.bool_]:
        if not results.numel() or not arguments.numel():
            return np.zeros((results.numel(), arguments.numel()), dtype=bool)
        pattern = ca.DM(ca.jacobian(ca.densify(results), arguments).sparsity(), 1)
        return np.array(pattern.full()) != 0

    def _depends(self, results: ca.SX) -> NDArray[np.bool_]:
        """Which of x, u, t and the clocks each result depends on, directly or through z."""
        direct = self._pattern(results, self._knowns)
        through_z = np.array([row.any() for row in self._pattern(results, self.dae.z)], dtype=bool)
        return direct | np.outer(through_z, self._reach_of_z)

    def dependencies(self, results: ca.SX) -> list[tuple[int, ...]]:
        """Value references of the states, inputs and, where it matters, time that each result depends on."""
        nx, nu = len(self.dae.states), len(self.dae.inputs)
        references = np.array(
            [*range(self.first.x, self.first.x + nx), *range(self.first.u, self.first.u + nu)], dtype=int
        )
        found = []
        for row in self._depends(results):
            timed = (self.first.time,) if row[nx + nu :].any() else ()
            found.append((*timed, *references[row[: nx + nu]].tolist()))
        return found

    def reads_input(self) -> list[bool]:
        """Whether each event indicator reads an input."""
        nx, nu = len(self.dae.states), len(self.dae.inputs)
        return [bool(row[nx : nx + nu].any()) for row in self._depends(self.h)]

    # -- names -------------------------------------------------------------------------------------------

    def check_names(self) -> None:
        """Refuse a system in which two variables have one name: an FMU knows them by name only.

        Raises
        ------
        ModelError
            all such names.
        """
        dae = self.dae
        rows = (*dae.states, *dae.inputs, *dae.parameter_rows, *dae.outputs, *dae.algebraics)
        counts = Counter(("time", *(row.path for row in rows)))
        twice = [name for name, count in counts.items() if count > 1]
        if twice:
            raise ModelError(
                f"{dae.name}: an FMU needs a name of its own for each variable; two are called "
                f"{', '.join(twice)}. Way out: give the output (Diagram.output) another name."
            )

    def indicator_names(self) -> list[str]:
        """`block.guard[k]` for rows, `block.state.bound[k]` for bounds; k counts from 1."""
        names, counts = [], dict.fromkeys(range(len(self.dae.automata)), 0)
        for a, _ in self.rows:
            counts[a] += 1
            names.append(f"{structured(self.dae.automata[a].path)}.guard[{counts[a]}]")
        for k, bound in enumerate(self.bounds):
            before = sum(b.state == bound.state for b in self.bounds[:k])
            names.append(f"{structured(self.dae.states[bound.state].path)}.bound[{before + 1}]")
        return names

    def indicator_texts(self) -> list[str]:
        """What each event indicator watches."""
        states = self.dae.states
        return [
            *(f"positive while {row.text} is active and true" for _, row in self.rows),
            *(
                f"positive when {states[b.state].path} is {'above' if b.sign > 0 else 'below'} {b.limit:g}"
                for b in self.bounds
            ),
        ]


def identifier(name: str) -> str:
    """A C identifier for a model.

    >>> identifier("gfl-vfd-cooling"), identifier("2-level")
    ('gfl_vfd_cooling', '_2_level')
    """
    word = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return f"_{word}" if not word or word[0].isdigit() else word


def nominals(dae: Dae, smallest: float = 1e-3) -> Sequence[float]:
    """Size of every state: its start value, or 1 where that says nothing."""
    if not dae.start.numel():
        values = np.array([row.value for row in dae.states])
    else:
        at = ca.Function("start", [dae.u, dae.p], [ca.densify(dae.start)])
        rest = [row.value for row in dae.inputs]
        values = np.array(at(rest, [row.value for row in dae.parameter_rows])).ravel()[: len(dae.states)]
    size = np.abs(values)
    return np.where(np.isfinite(size) & (size >= smallest), size, 1.0).tolist()
