"""The C text of one structure of unit: source current, rates, guards and resets, on packs of units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from dcvrt.dae import Dae
from dcvrt.errors import ModelError, did_you_mean
from dcvrt.integrators.kernel.emit import Argument, Program


SCALE = "scale"


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
    moving : sequence of str
        Parameters that change with the operating point: derivatives pass through them. `SCALE` is the factor from
        the unit's base to that of the system.
    angle : str
        State that is the angle of a rotor; empty where there is none.
    """

    dae: Dae
    voltage: str = "v"
    current: str = "i"
    sign: float = 1.0
    moving: Sequence[str] = ()
    angle: str = ""

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
                f"{self.dae.name} has no {missing[0]!r}: a unit takes the phasor {self.voltage!r} and gives the "
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
        return self.sign * self.scale * ca.vertcat(*(self.dae.y[names.index(n)] for n in self._parts(self.current)))

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

    def column(self, path: str) -> int:
        """Position among `p` of a parameter, or of `SCALE`."""
        return self.p.numel() - 3 if path == SCALE else self.dae.parameter_number(path)

    @cached_property
    def rows(self) -> list[tuple[int, object]]:
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
            *(row.guard for _, row in self.rows),  # type: ignore[attr-defined]
            *(side * (self.dae.x[k] - bound) for k, side, bound in self.bounds),
        )

    # -- C text --------------------------------------------------------------------------------------------

    @cached_property
    def _program(self) -> Program:
        dae = self.dae
        inputs = ca.vertcat(self.v, dae.clocks)
        sizes = {"xs": dae.x.numel(), "us": inputs.numel(), "sp": len(self.moving)}
        xs, us, sp = (ca.SX.sym(name, n) for name, n in sizes.items())
        seeds = ca.SX.zeros(self.p.numel())
        for k, path in enumerate(self.moving):
            seeds[self.column(path)] = sp[k]

        def along(expression: ca.SX) -> ca.SX:
            return ca.densify(
                ca.jtimes(
                    expression,
                    ca.vertcat(dae.x, inputs, self.p),
                    ca.vertcat(xs, us, seeds),
                )
            )

        made = {
            "source": [("source", self.source)],
            "source_theta": [("source", self.source), ("sources", along(self.source))],
            "flow": [("rate", dae.f)],
            "flow_theta": [("rate", dae.f), ("rates", along(dae.f))],
            "look": [("guards", self.guards)],
            "look_theta": [("guards", self.guards), ("guardses", along(self.guards))],
            "source_by_v": [("slope", ca.densify(ca.jacobian(self.source, self.v)))],
        }
        for k, (_, row) in enumerate(self.rows):
            if row.reset:  # type: ignore[attr-defined]
                after = ca.vertcat(*ca.vertsplit(dae.x)) if dae.x.numel() else ca.SX(0, 1)
                for state, value in row.reset.items():  # type: ignore[attr-defined]
                    after[state] = value
                made[f"reset_{k}"] = [("after", after), ("afters", along(after))]
        fixed, column = {"fixed": True}, {"column": True}
        arguments = [
            Argument("p", self.p, **fixed), Argument("q", dae.q, **fixed), Argument("sp", sp, **fixed, **column),
            Argument("x", dae.x), Argument("u", inputs),
            Argument("xs", xs, **column), Argument("us", us, **column),
        ]  # fmt: skip
        columns = [r for results in made.values() for r, _ in results if r in COLUMNS]
        return Program(arguments, made, columns)

    def text(self) -> str:
        """Contents of `unit.h`."""
        program, dae = self._program, self.dae
        resets = [k for k, (_, row) in enumerate(self.rows) if row.reset]  # type: ignore[attr-defined]
        cases = "".join(f"  case {k}: reset_{k}(at, after, afters); return;\n" for k in resets)
        return "\n".join(
            [
                f"enum {{ NX = {dae.x.numel()}, NA = {len(dae.automata)}, FIXED = {program.sizes['fixed']}, "
                f"FIXED_COLUMNS = {program.sizes['fixed_columns']} }};",
                program.hoisting("hoist"),
                *(program.function(name) for name in program.functions),
                "static void reset_of(long row, const struct point *at, real *after, column *afters) {\n"
                f"  (void)at; (void)after; (void)afters;\n  switch (row) {{\n{cases}  }}\n}}\n",
            ]
        )


COLUMNS = {"sources", "rates", "guardses", "afters"}
