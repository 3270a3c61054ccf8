"""What units of one structure share: their equations as the network sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from dcvrt.dae import Dae, Transition
from dcvrt.errors import ModelError, did_you_mean

SCALE = "scale"
Floats = npt.NDArray[np.float64]


@lru_cache(maxsize=256)
def _for_many(function: ca.Function, n: int) -> ca.Function:
    """A function of one unit for n of them: CasADi makes it anew in every call of `map`."""
    return function.map(n)


def for_units(function: ca.Function, *values: Floats) -> list[Floats]:
    """Results of a function of one unit, for many.

    Parameters
    ----------
    function : Function
        With dense results.
    values : arrays (units, rows)

    Returns
    -------
    list of arrays (units, rows, columns)
    """
    n = len(values[0])
    shapes = [function.size_out(k) for k in range(function.n_out())]
    given = [np.ascontiguousarray(v, dtype=np.float64) for v in values]
    found = [np.empty((n, columns, rows)) for rows, columns in shapes]
    # numbers pass through memory: matrices of CasADi are made of them one by one
    buffer: Any  # its stubs take memory of integers
    buffer, run = _for_many(function, n).buffer()
    for k, array in enumerate(given):
        buffer.set_arg(k, array.reshape(-1).data)
    for k, array in enumerate(found):
        buffer.set_res(k, array.reshape(-1).data)
    run()
    return [array.transpose(0, 2, 1) for array in found]


@dataclass(frozen=True, eq=False)
class Structure:
    r"""What units of one structure share: their equations, as the network sees them.

    A unit takes its terminal voltage v and feeds the current i(x, v) into the network. The network holds a
    shunt y for it, and the unit feeds the source current

    .. math:: s(x, v) = i(x, v) + y\, v.

    Where i is affine in v with a constant complex slope, y is minus this slope and s depends on states alone.

    Parameters
    ----------
    dae : Dae
        Without algebraic variables.
    voltage, current : str
        The input and the output that are phasors of the terminal.
    sign : float
        1 where the output flows into the network, -1 where it flows into the unit.
    setpoints : sequence of str
        Parameters that follow from the operating point, as many as the terminal's current has parts.
    varied : sequence of str
        Parameters to differentiate by beside the set-points; `SCALE` is the size of the unit.
    angle, inertia, reactance : str
        Of a rotor: the state that is its angle, the parameter that weighs it, and that behind which the
        q-axis lies; empty where there is none.
    """

    dae: Dae
    voltage: str = "v"
    current: str = "i"
    sign: float = 1.0
    setpoints: Sequence[str] = ()
    varied: Sequence[str] = ()
    angle: str = ""
    inertia: str = ""
    reactance: str = ""

    def __post_init__(self) -> None:
        if self.dae.z.numel():
            names = ", ".join(row.path for row in self.dae.algebraics)
            raise ModelError(
                f"{self.dae.name}: algebraic variables {names} cannot stand in a unit of the grid. Way out: "
                "compile with them eliminated, or put a lag in their loop."
            )
        missing = [n for n in self._parts(self.voltage) if n not in self.dae.u_names]
        missing += [n for n in self._parts(self.current) if n not in self.dae.y_names]
        if missing:
            hint = did_you_mean(missing[0], [*self.dae.u_names, *self.dae.y_names])
            raise ModelError(
                f"{self.dae.name} has no {missing[0]!r}: a unit takes the phasor {self.voltage!r} and "
                "gives the "
                f"phasor {self.current!r}.{hint}"
            )

    @staticmethod
    def _parts(name: str) -> tuple[str, str]:
        return f"{name}.re", f"{name}.im"

    # -- symbols -------------------------------------------------------------------------------------------

    @cached_property
    def v(self) -> ca.SX:
        """The terminal voltage: real and imaginary part."""
        names = self.dae.u_names
        return ca.vertcat(*(self.dae.u[names.index(n)] for n in self._parts(self.voltage)))

    @cached_property
    def others(self) -> tuple[str, ...]:
        """Inputs beside the voltage: they rest at their declared values."""
        return tuple(n for n in self.dae.u_names if n not in self._parts(self.voltage))

    @cached_property
    def i(self) -> ca.SX:
        """Current into the network: real and imaginary part."""
        names = self.dae.y_names
        return (
            self.sign
            * self.scale
            * ca.vertcat(*(self.dae.y[names.index(n)] for n in self._parts(self.current)))
        )

    @cached_property
    def scale(self) -> ca.SX:
        """Base of the unit over that of the system."""
        return ca.SX.sym(SCALE)

    @cached_property
    def y(self) -> ca.SX:
        """Shunt of the unit: symbols that stand behind its parameters where it is no constant of them."""
        return ca.SX.sym("y", 2)

    @cached_property
    def slope(self) -> ca.SX:
        """di/dv, 2 by 2."""
        return ca.jacobian(self.i, self.v)

    @cached_property
    def affine(self) -> bool:
        """Whether di/dv is one complex constant: the unit is a Norton source behind a constant admittance.

        Independence of states, voltage and modes is read from the expression; that the four entries form a
        complex number is seen from the numbers, for the parameters of the structure.
        """
        dae = self.dae
        if ca.depends_on(self.slope, ca.vertcat(dae.x, dae.u, dae.q, dae.clocks, dae.t)):
            return False
        values = [row.value for row in dae.parameter_rows]
        a = np.array(ca.Function("slope", [dae.p, self.scale], [ca.densify(self.slope)])(values, 1.0))
        return bool(np.allclose([a[0, 0], a[0, 1]], [a[1, 1], -a[1, 0]], rtol=1e-12, atol=1e-12))

    @cached_property
    def source(self) -> ca.SX:
        """s(x, v) as the unit feeds it."""
        if self.affine:
            return ca.substitute(self.i, self.v, ca.SX.zeros(2))
        (a, b), (vr, vi) = ca.vertsplit(self.y), ca.vertsplit(self.v)
        return self.i + ca.vertcat(a * vr - b * vi, a * vi + b * vr)

    @cached_property
    def p(self) -> ca.SX:
        """Parameters, then inputs that rest, then the scale and the shunt."""
        names = self.dae.u_names
        rest = [self.dae.u[names.index(n)] for n in self.others]
        return ca.vertcat(self.dae.p, *rest, self.scale, self.y)

    @property
    def moving(self) -> tuple[str, ...]:
        """Parameters that change with the operating point: derivatives pass through them."""
        return (*self.setpoints, *self.varied)

    def column(self, path: str) -> int:
        """Position among `p` of a parameter, or of `SCALE`."""
        return self.p.numel() - 3 if path == SCALE else self.dae.parameter_number(path)

    @cached_property
    def rows(self) -> list[tuple[int, Transition]]:
        """Transitions of all automata, each with the number of its automaton."""
        return [(a, row) for a, automaton in enumerate(self.dae.automata) for row in automaton.rows]

    @cached_property
    def bounds(self) -> list[tuple[int, float, float]]:
        """State, side and value of every finite bound."""
        return [
            (k, side, bound)
            for k, row in enumerate(self.dae.states)
            for side, bound in ((-1.0, row.bounds[0]), (1.0, row.bounds[1]))
            if np.isfinite(bound)
        ]

    @cached_property
    def guards(self) -> ca.SX:
        """Guards of all rows, then how far each bounded state is beyond its bound."""
        return ca.vertcat(
            ca.SX(0, 1),
            *(row.guard for _, row in self.rows),
            *(side * (self.dae.x[k] - bound) for k, side, bound in self.bounds),
        )

    # -- functions of one unit, interpreted ----------------------------------------------------------------

    @cached_property
    def flags(self) -> ca.DM:
        """Flags of the modes that a run starts in."""
        starts = [ca.DM(a.flags[a.mode_number(a.start)]) for a in self.dae.automata]
        return ca.vertcat(ca.DM(0, 1), *starts)

    def _at_start(self, expressions: Sequence[ca.SX]) -> list[ca.SX]:
        """Expressions in the start modes, at time and clocks zero."""
        dae = self.dae
        clocks = ca.SX.zeros(len(dae.automata))
        return list(
            ca.substitute(list(expressions), [dae.q, dae.clocks, dae.t], [self.flags, clocks, ca.SX(0)])
        )

    @cached_property
    def unknown(self) -> ca.SX:
        """States, then set-points: what an equilibrium finds."""
        return ca.vertcat(self.dae.x, *(self.p[self.column(path)] for path in self.setpoints))

    @cached_property
    def _wanted(self) -> ca.SX:
        return ca.SX.sym("current", 2)

    @cached_property
    def _residual(self) -> ca.SX:
        return ca.vertcat(self.dae.f, self.i - self._wanted) if self.setpoints else self.dae.f

    @cached_property
    def balance(self) -> ca.Function:
        """(x, v, p, current wanted) -> residual of the equilibrium and its Jacobian by the unknowns."""
        made = [self._residual, ca.densify(ca.jacobian(self._residual, self.unknown))]
        given = [self.dae.x, self.v, self.p, self._wanted]
        return ca.Function("balance", given, self._at_start(made), {"cse": True})

    @cached_property
    def given(self) -> ca.SX:
        """What an equilibrium moves with: the terminal voltage, then the parameters that are varied."""
        return ca.vertcat(self.v, *(self.p[self.column(path)] for path in self.varied))

    @cached_property
    def at_rest(self) -> ca.Function:
        """(x, v, p, current wanted) -> Jacobian of the residual by what is given, guards, how far each row
        would move its states, current, its Jacobian by what is unknown and given."""
        moves = [
            sum((ca.fabs(value - self.dae.x[state]) for state, value in row.reset.items()), ca.SX(0))
            for _, row in self.rows
        ]
        made = [
            ca.densify(ca.jacobian(self._residual, self.given)),
            ca.densify(self.guards),
            ca.densify(ca.vertcat(ca.SX(0, 1), *moves)),
            self.i,
            ca.densify(ca.jacobian(self.i, ca.vertcat(self.unknown, self.given))),
        ]
        at = [self.dae.x, self.v, self.p, self._wanted]
        return ca.Function("at_rest", at, self._at_start(made), {"cse": True})

    @cached_property
    def start(self) -> ca.Function:
        """(v, p) -> states to begin the search of the equilibrium with."""
        return ca.Function("start", [self.v, self.p], self._at_start([self.dae.start[: self.dae.x.numel()]]))

    @cached_property
    def slopes(self) -> ca.Function:
        """(x, v, p) -> di/dv in the start modes."""
        return ca.Function("slopes", [self.dae.x, self.v, self.p], self._at_start([ca.densify(self.slope)]))

    @cached_property
    def held(self) -> ca.Function:
        """p -> dwell times of all rows, s."""
        held = ca.vertcat(ca.SX(0, 1), *(row.held for _, row in self.rows))
        return ca.Function("held", [self.p], [ca.densify(held)])
