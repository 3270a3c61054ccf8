r"""Small disturbances about one point: the linear system, its eigenvalues and who takes part in them.

About a point the equations f, g, h of a :class:`~dcvrt.dae.Dae` become

.. math::
    \dot{\Delta x} = A \Delta x + B \Delta u, \qquad \Delta y = C \Delta x + D \Delta u,

.. math::
    A = f_x - f_z g_z^{-1} g_x, \quad B = f_u - f_z g_z^{-1} g_u, \quad
    C = h_x - h_z g_z^{-1} g_x, \quad D = h_u - h_z g_z^{-1} g_u :

the algebraic variables follow the states at once (Schur complement), the modes of the automata stand still.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import pi
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import InputError, ModelError, did_you_mean

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.dae import Dae

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
SINGULAR = 1e12
"""Condition number from which on a matrix is taken for one without an inverse."""


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """Values of everything in a system at one instant, by name.

    ``point["pll.delta"]`` reads a state, an algebraic variable, an input, a parameter or an output.

    Attributes
    ----------
    dae : the system.
    x, z, u, p : values in the order of its rows.
    modes : mode of every automaton by its path; the clocks stand at zero.
    """

    dae: Dae
    x: Array
    z: Array
    u: Array
    p: Array
    modes: Mapping[str, str]

    @property
    def flags(self) -> Array:
        """Values of `q` in these modes."""
        values = [a.flags[a.mode_number(self.modes[a.path])] for a in self.dae.automata]
        return np.concatenate([np.zeros(0), *values])

    @cached_property
    def _values(self) -> tuple[Array, Array, Array]:
        """f, g and the outputs here."""
        f, g, y = evaluate(self, self.dae.f, self.dae.g, self.dae.y)
        return f.ravel(), g.ravel(), y.ravel()

    @property
    def y(self) -> Array:
        """Outputs."""
        return self._values[2]

    @property
    def residuals(self) -> dict[str, float]:
        """What should be zero at rest: the derivative of every state, the residual of every algebraic one."""
        names = [
            *(f"d({n})/dt" for n in self.dae.x_names),
            *(f"residual of {r.path}" for r in self.dae.algebraics),
        ]
        return dict(zip(names, np.concatenate(self._values[:2]).tolist(), strict=True))

    def __getitem__(self, name: str) -> float:
        dae = self.dae
        known: dict[str, float] = {}
        for rows, values in (
            (dae.parameter_rows, self.p), (dae.inputs, self.u), (dae.outputs, self.y),
            (dae.algebraics, self.z), (dae.states, self.x),
        ):  # fmt: skip
            known |= {row.path: float(value) for row, value in zip(rows, values, strict=True)}
        if name not in known:
            raise InputError(f"the point has no value {name!r}.{did_you_mean(name, known)}")
        return known[name]

    def __str__(self) -> str:
        modes = ", ".join(f"{path} {mode}" for path, mode in self.modes.items())
        lines = [f"{self.dae.name}{' in mode ' + modes if modes else ''}"]
        rates = list(self.residuals.values())
        for what, rows, values in (
            ("input", self.dae.inputs, self.u), ("state", self.dae.states, self.x),
            ("algebraic", self.dae.algebraics, self.z), ("output", self.dae.outputs, self.y),
        ):  # fmt: skip
            for k, (row, value) in enumerate(zip(rows, values, strict=True)):
                rate = f"  d/dt {rates[k]:.1e}" if what == "state" else ""
                lines.append(f"{what:10}{row.path:24}{value:13.6g} {row.unit}{rate}")
        return "\n".join(lines)


def operating_point(
    dae: Dae,
    x: Mapping[str, float],
    u: Mapping[str, float] | None = None,
    z: Mapping[str, float] | None = None,
    modes: Mapping[str, str] | None = None,
    **parameters: float,
) -> OperatingPoint:
    """A point from values by name; what is left out keeps its start or rest value.

    Raises
    ------
    InputError
        unknown names, parameters outside their bounds.
    """
    problems: list[str] = []

    def values(what: str, rows: Any, given: Mapping[str, float] | None) -> Array:
        names = [row.path for row in rows]
        for name in set(given or {}) - set(names):
            problems.append(f"{dae.name} has no {what} {name!r}.{did_you_mean(name, names)}")
        return np.array([float((given or {}).get(row.path, row.value)) for row in rows])

    point = OperatingPoint(
        dae,
        values("state", dae.states, x),
        values("algebraic variable", dae.algebraics, z),
        values("input", dae.inputs, u),
        dae.parameter_values(**parameters),
        chosen_modes(dae, modes),
    )
    if problems:
        raise InputError("\n".join(problems))
    return point


def chosen_modes(dae: Dae, given: Mapping[str, str] | None) -> dict[str, str]:
    """Mode of every automaton: the one given, or its start mode."""
    paths = [a.path for a in dae.automata]
    for path in given or {}:
        if path not in paths:
            raise InputError(f"{dae.name} has no automaton {path!r}.{did_you_mean(path, paths)}")
    modes = {a.path: (given or {}).get(a.path, a.start) for a in dae.automata}
    for a in dae.automata:
        a.mode_number(modes[a.path])
    return modes


def evaluate(at: OperatingPoint, *expressions: ca.SX) -> list[Array]:
    """Values of expressions of the system at a point; time and clocks are zero."""
    dae = at.dae
    arguments = [dae.t, dae.x, dae.z, dae.u, dae.p, dae.q, dae.clocks]
    function = ca.Function("point", arguments, [ca.densify(e) for e in expressions])
    clocks = np.zeros(len(dae.automata))
    results = function.call([0.0, at.x, at.z, at.u, at.p, at.flags, clocks])
    return [np.array(r) for r in results]


def linearise(dae: Dae, at: OperatingPoint) -> Linear:
    """See :meth:`Dae.linearise`."""
    if at.dae is not dae:
        raise InputError(
            f"the point is one of another system ({at.dae.name}). Way out: Simulator(dae).equilibrium(...) "
            "or operating_point(dae, ...) with this one."
        )
    both, x, z, u = ca.vertcat(dae.f, dae.y), dae.x, dae.z, dae.u
    by_x, by_z, by_u, g_x, g_z, g_u = evaluate(
        at, ca.jacobian(both, x), ca.jacobian(both, z), ca.jacobian(both, u),
        ca.jacobian(dae.g, x), ca.jacobian(dae.g, z), ca.jacobian(dae.g, u),
    )  # fmt: skip
    if len(at.z):
        check_solvable(dae, g_z)
        by_x = by_x - by_z @ np.linalg.solve(g_z, g_x)
        by_u = by_u - by_z @ np.linalg.solve(g_z, g_u)
    n = len(at.x)
    if not np.isfinite(by_x).all():
        bad = [dae.x_names[k] for k in np.flatnonzero(~np.isfinite(by_x[:n]).all(axis=1))]
        raise ModelError(
            f"{dae.name}: no linear system at this point: the derivative of the equation of "
            f"{', '.join(bad) or 'an output'} is no finite number there."
        )
    return Linear(by_x[:n], by_u[:n], by_x[n:], by_u[n:], dae.x_names, dae.u_names, dae.y_names, at)


def check_solvable(dae: Dae, g_z: Array) -> None:
    """Refuse a point at which the algebraic variables do not follow the states."""
    if np.linalg.cond(g_z) < SINGULAR:
        return
    direction = np.abs(np.linalg.svd(g_z)[2][-1])
    worst = ", ".join(dae.algebraics[k].path for k in np.flatnonzero(direction > 0.1))
    raise ModelError(
        f"{dae.name}: the algebraic equations do not determine {worst} at this point (g_z is singular: a "
        "voltage collapse, or a loop with gain 1). Way out: another point, or a lag in the loop."
    )


@dataclass(frozen=True, eq=False)
class Linear:
    """The system for small disturbances; `print` shows its modes.

    Attributes
    ----------
    A, B, C, D : matrices; rows and columns in the order of the names below.
    states, inputs, outputs : paths.
    at : the point.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    at: OperatingPoint

    @cached_property
    def _decomposition(self) -> tuple[Complex, Complex]:
        """Eigenvalues from the least stable on, and the right eigenvectors."""
        values, vectors = np.linalg.eig(self.A)
        order = np.lexsort((-values.imag, np.abs(values.imag), -values.real))
        return values[order].astype(complex), vectors[:, order].astype(complex)

    def eigenvalues(self) -> Complex:
        """Eigenvalues of A, 1/s, from the least stable on."""
        return self._decomposition[0]

    def damping_ratios(self) -> Array:
        r"""Damping ratio of every eigenvalue, :math:`\zeta = -\operatorname{Re}\lambda/|\lambda|`; 0 at 0."""
        values = self.eigenvalues()
        size = np.abs(values)
        return np.where(size > 0, -values.real / np.where(size > 0, size, 1.0), 0.0)

    def frequencies(self) -> Array:
        r"""Frequency of every eigenvalue, :math:`|\operatorname{Im}\lambda|/2\pi`, Hz."""
        result: Array = np.abs(self.eigenvalues().imag) / (2 * pi)
        return result

    def participation(self) -> Participation:
        r"""Which states take part in which modes.

        With right eigenvectors V and left ones :math:`W = V^{-1}`, state k has the share
        :math:`p_{ki} = V_{ki} W_{ik}` in mode i. Every row and every column sums to one.

        Raises
        ------
        ModelError
            eigenvalues coincide and have too few eigenvectors: no shares exist.
        """
        values, right = self._decomposition
        if len(values) and not np.linalg.cond(right) < SINGULAR:
            near = [
                f"{values[k]:.4g}"
                for k in range(len(values))
                if np.sum(np.abs(values - values[k]) < 1e-5 * (1 + abs(values[k]))) > 1
            ]
            raise ModelError(
                f"{self.at.dae.name}: no participation factors: the eigenvalues {', '.join(near)} coincide "
                "and share an eigenvector. Way out: change a parameter a little."
            )
        return Participation(right * np.linalg.inv(right).T, self.states, values)

    def transfer(self, s: complex, output: str | None = None, input: str | None = None) -> Any:
        """Transfer function C (s I - A)^-1 B + D at `s` (1/s), or its entry for one output and input."""
        whole = self.C @ np.linalg.solve(s * np.eye(len(self.states)) - self.A, self.B) + self.D
        rows = slice(None) if output is None else self._number("output", self.outputs, output)
        columns = slice(None) if input is None else self._number("input", self.inputs, input)
        return whole[rows, columns]

    def frame(self, matrix: str) -> pd.DataFrame:
        """One of the matrices ``"A"``, ``"B"``, ``"C"``, ``"D"`` with its names."""
        import pandas as pd

        names = {
            "A": (self.states, self.states), "B": (self.states, self.inputs),
            "C": (self.outputs, self.states), "D": (self.outputs, self.inputs),
        }  # fmt: skip
        if matrix not in names:
            raise InputError(f"there is no matrix {matrix!r}.{did_you_mean(matrix, names)}")
        rows, columns = names[matrix]
        return pd.DataFrame(getattr(self, matrix), index=list(rows), columns=list(columns))

    def _number(self, what: str, names: tuple[str, ...], name: str) -> int:
        if name not in names:
            raise InputError(f"{self.at.dae.name} has no {what} {name!r}.{did_you_mean(name, names)}")
        return names.index(name)

    def __str__(self) -> str:
        """Table of the modes: eigenvalue, frequency, damping ratio, the states with the largest shares."""
        try:
            shares = np.abs(self.participation().matrix)
        except ModelError:
            shares = np.zeros((len(self.states), len(self.states)))
        lines = [f"{'eigenvalue, 1/s':>24}{'f, Hz':>10}{'damping':>9}  states that take part"]
        values, f, zeta = self.eigenvalues(), self.frequencies(), self.damping_ratios()
        for k, value in enumerate(values):
            if value.imag < 0:
                continue  # the other half of a pair
            text = f"{value.real:.5g}" + (f" ± {value.imag:.5g}j" if value.imag else "")
            order = [j for j in np.argsort(-shares[:, k], kind="stable")[:3] if shares[j, k] > 0.05]
            who = ", ".join(f"{self.states[j]} {shares[j, k]:.2f}" for j in order)
            lines.append(f"{text:>24}{f[k]:10.4g}{zeta[k]:9.3f}  {who}".rstrip())
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class Participation:
    """Shares of the states in the modes.

    Attributes
    ----------
    matrix : complex, (states, modes); rows and columns sum to one. Tables show magnitudes.
    states : paths.
    eigenvalues : of the modes, in the order of the columns.
    """

    matrix: Complex
    states: tuple[str, ...]
    eigenvalues: Complex

    def __getitem__(self, state: str) -> Complex:
        """Shares of one state in all modes."""
        if state not in self.states:
            raise InputError(f"there is no state {state!r}.{did_you_mean(state, self.states)}")
        row: Complex = self.matrix[self.states.index(state)]
        return row

    def frame(self) -> pd.DataFrame:
        """Magnitudes of the shares, states by eigenvalues."""
        import pandas as pd

        return pd.DataFrame(np.abs(self.matrix), index=list(self.states), columns=list(self.eigenvalues))

    def __str__(self) -> str:
        shown = [k for k, value in enumerate(self.eigenvalues) if value.imag >= 0]
        width = max((len(name) for name in self.states), default=0)
        head = [f"{v.real:.3g}" + (f"±{v.imag:.3g}j" if v.imag else "") for v in self.eigenvalues[shown]]
        columns = [max(7, len(h) + 2) for h in head]
        lines = [" " * width + "".join(h.rjust(c) for h, c in zip(head, columns, strict=True))]
        for name, row in zip(self.states, np.abs(self.matrix[:, shown]), strict=True):
            cells = ("·" if value < 5e-3 else f"{value:.2f}" for value in row)
            lines.append(name.ljust(width) + "".join(c.rjust(n) for c, n in zip(cells, columns, strict=True)))
        return "\n".join(lines)
