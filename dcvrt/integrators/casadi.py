"""CasADi's integrators as solvers of smooth stretches: options, and the stretch itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.errors import InputError, did_you_mean

Array = NDArray[np.float64]
PLUGINS = ("erk", "rosenbrock", "cvodes", "idas")


@dataclass(frozen=True)
class Casadi:
    """Which CasADi integrator solves the stretches between events, and how tightly.

    Guards are looked at on the samples of a run: a band that a signal crosses in less than `save_at` can be
    missed. The compiled kernel looks at every step; here a smaller `save_at` is the way out.

    Parameters
    ----------
    plugin : ``erk`` (explicit 5(4) pair, for systems without algebraic variables), ``rosenbrock`` (L-stable,
        linearly implicit), ``cvodes`` and ``idas`` (multistep; the accuracy reference).
    rtol, atol : relative and absolute tolerance of every state and sensitivity.
    interpreted : do not compile the model although a C compiler is there.
    """

    plugin: Literal["erk", "rosenbrock", "cvodes", "idas"] = "erk"
    rtol: float = 1e-6
    atol: float = 1e-8
    interpreted: bool = False

    def __post_init__(self) -> None:
        if self.plugin not in PLUGINS:
            raise InputError(
                f"There is no CasADi integrator {self.plugin!r}.{did_you_mean(self.plugin, PLUGINS)}"
            )
        for name, value in (("rtol", self.rtol), ("atol", self.atol)):
            if not 1e-14 <= value < 1:
                raise InputError(f"{name} = {value:g} must be at least 1e-14 (round-off) and below 1.")

    @property
    def implicit(self) -> bool:
        """Whether the method needs the Jacobian of the right-hand side."""
        return self.plugin != "erk"

    @property
    def algebraic(self) -> bool:
        """Whether the method takes algebraic variables."""
        return self.plugin in ("rosenbrock", "idas")

    @property
    def groups(self) -> int:
        """Most pieces of the inputs in one call: a multistep method has to start anew on each."""
        return 1 if self.plugin in ("cvodes", "idas") else 64

    def options(self) -> dict[str, Any]:
        """Options of the CasADi plugin."""
        chosen = {"reltol": self.rtol, "abstol": self.atol}
        if self.plugin in ("cvodes", "idas"):
            chosen |= {"max_num_steps": 100_000}
        return chosen


def bind(
    function: ca.Function, arguments: Mapping[str, Array], results: Mapping[str, Array]
) -> tuple[Any, Callable[[], None]]:
    """Let a function read and write these arrays in place: its buffer, to be kept alive, and the call.

    CasADi stores columns one after the other, so that an array (columns, rows) is a matrix (rows, columns).
    """
    buffer: Any
    buffer, call = function.buffer()
    for name, array in arguments.items():
        if array.size:
            buffer.set_arg(function.index_in(name), memoryview(array.reshape(-1)))  # type: ignore[arg-type]
    for name, array in results.items():
        if array.size:
            buffer.set_res(function.index_out(name), memoryview(array.reshape(-1)))  # type: ignore[arg-type]
    return buffer, call


class Stretch:
    """Solver of `groups` consecutive smooth stretches with `points` output times each, in one call.

    Group k spans normalised time [k, k + 1]; its controls hold where it lies in real time and the inputs over
    it.
    """

    def __init__(
        self, rhs: ca.Function, sizes: Mapping[str, int], solver: Casadi, points: int, groups: int
    ) -> None:
        symbols = {n: ca.MX.sym(n, sizes[n]) for n in ("t", "x", "z", "p", "u")}
        ode, alg = rhs(*symbols.values())
        dae = {**symbols, "ode": ode, "alg": alg}
        if not sizes["z"]:
            del dae["z"], dae["alg"]
        options = solver.options()
        if solver.groups > 1:
            options["control_group_size"] = [points] * groups
        grid = (np.arange(1, points * groups + 1) / points).tolist()
        self.function = ca.integrator("stretch", solver.plugin, dae, 0.0, grid, options)
        self.points, self.groups = points, groups
        count = points * groups
        self.X, self.Z = np.zeros((count, sizes["x"])), np.zeros((count, sizes["z"]))
        self.x0, self.z0, self.p = np.zeros(sizes["x"]), np.zeros(sizes["z"]), np.zeros(sizes["p"])
        self.u = np.zeros((groups if solver.groups > 1 else count, sizes["u"]))  # one row an output otherwise
        arguments = {"x0": self.x0, "z0": self.z0, "p": self.p, "u": self.u}
        self.buffer, self.call = bind(self.function, arguments, {"xf": self.X, "zf": self.Z})

    def __call__(self, x0: Array, z0: Array, p: Array, controls: Array) -> tuple[Array, Array]:
        """States and algebraic variables at all output times; views that the next call overwrites.

        Raises
        ------
        ArithmeticError
            the integrator gave up, or its result is not finite.
        """
        self.x0[:], self.z0[:], self.p[:] = x0, z0, p
        self.u[:] = controls
        try:
            self.call()
        except Exception as error:
            raise ArithmeticError(str(error).strip().splitlines()[-1]) from None
        if self.buffer.ret() != 0:
            raise ArithmeticError("the step size became too small")
        if not np.isfinite(self.X[-1]).all():
            raise ArithmeticError("the state is no longer a finite number")
        return self.X, self.Z
