"""f, g and their Jacobian of a loaded ANDES system, evaluated by the functions that ANDES has generated for
them.

The same calls in the same order as `TDS.fg_update` and `System.j_update` of ANDES, and of f and g the same
numbers to the last bit. It leaves out models that have nothing to do in a call, and takes what models give in
one pass instead of one a variable, and without a sparse matrix to add each part to.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

BLOCKS = ("fx", "fy", "gx", "gy")
"""Jacobians of f and g by states and by algebraic variables, as ANDES calls them."""


class Evaluation:
    """Evaluates the equations and limiters of an initialised system.

    Parameters
    ----------
    system : andes.System
        After `TDS.init`.
    """

    def __init__(self, system: Any) -> None:
        self.system, self.tds = system, system.TDS
        models = system.exist.pflow_tds

        def those(has_work: Callable[[Any], bool]) -> dict[str, Any]:
            return {name: model for name, model in models.items() if has_work(model)}

        self._services = those(lambda m: bool(len(m.services_var)) or m.flags.sv_num is True)
        self._before = those(lambda m: any(limit.has_check_var for limit in m.discrete.values()))
        self._after = those(lambda m: any(limit.has_check_eq for limit in m.discrete.values()))
        self._f = those(lambda m: callable(m.calls.f) or _by_hand(m, "f_num"))
        self._g = those(lambda m: callable(m.calls.g) or _by_hand(m, "g_num"))
        self._sums = [_Sum(system, name) for name in ("f", "g")]

    def __call__(self, iteration: int) -> None:
        """Evaluate at the present `x` and `y`; states beyond a limit are put onto it."""
        system, self.tds.niter = self.system, iteration
        system.dae.clear_fg()
        system.s_update_var(self._services)
        system.l_update_var(self._before, niter=iteration, err=self.tds.mis[-1])
        system.f_update(self._f)
        system.l_update_eq(self._after, init=False, niter=iteration)
        system.g_update(self._g)
        for one in self._sums:
            one()
        system.g_islands()
        for limiter in system.antiwindups:
            for address, value, _ in limiter.x_set:
                np.put(system.dae.x, address, value)


class Jacobian:
    """Entries of the Jacobian of (f, g) by (x, y), several of which may stand at one place.

    Parameters
    ----------
    system : andes.System
        After `TDS.init`.

    Attributes
    ----------
    row, column : int arrays (entries,)
        States first, then algebraic variables.
    """

    def __init__(self, system: Any) -> None:
        self.system, self.models = system, system.exist.pflow_tds
        n = int(system.dae.n)
        rows, columns, self._constant = [], [], []
        for block in BLOCKS:
            first_row, first_column = n * (block[0] == "g"), n * (block[1] == "y")
            constant = system.dae.tpl[block]
            self._constant.append(np.ravel(constant.V))
            places = [(constant.I, constant.J), *((i, j) for i, j, _ in self._of_models(block))]
            rows += [np.ravel(i).astype(np.int64) + first_row for i, _ in places]
            columns += [np.ravel(j).astype(np.int64) + first_column for _, j in places]
        alone = np.zeros(
            0, dtype=np.int64
        )  # buses without a line keep their voltage, as in `System.j_islands`
        if system.Bus.n_islanded_buses:
            alone = n + np.concatenate([system.Bus.islanded_a, system.Bus.islanded_v]).astype(np.int64)
        self._islanded = np.flatnonzero(np.isin(np.concatenate(rows), alone))
        self._kept = np.full(len(alone), system.config.diag_eps)
        self.row, self.column = np.concatenate([*rows, alone]), np.concatenate([*columns, alone])
        self._own = np.flatnonzero((self.row == self.column) & (self.row < n))

    def _of_models(self, block: str) -> Iterator[tuple[Any, Any, Any]]:
        for model in self.models.values():
            yield from model.triplets.zip_ijv(block)

    def __call__(self) -> Floats:
        """Values of the entries at the present `x` and `y`."""
        self.system.call_models("j_update", self.models)
        parts = []
        for block, constant in zip(BLOCKS, self._constant, strict=True):
            parts += [constant, *(np.ravel(values) for _, _, values in self._of_models(block))]
        values = np.concatenate([*parts, self._kept])
        values[self._islanded] = 0.0
        return values

    def own_rates(self, values: Floats) -> Floats:
        """Derivative of the rate of each state by itself."""
        return np.bincount(self.row[self._own], values[self._own], int(self.system.dae.n)).astype(float)


class _Sum:
    """Collects what the variables of all models give for one kind of equation."""

    def __init__(self, system: Any, name: str) -> None:
        self._name, self._dae = name, system.dae
        self._added = [variable for variable in system._adders[name] if len(variable.e)]
        self._set = system._setters[name]
        nowhere = np.zeros(0, dtype=np.int64)
        self._address: Integers = np.concatenate([nowhere, *(np.ravel(v.a) for v in self._added)])

    def __call__(self) -> None:
        into = getattr(self._dae, self._name)
        if self._added:
            parts = np.concatenate([variable.e for variable in self._added])
            into += np.bincount(self._address, parts, len(into))
        for variable in self._set:
            np.put(into, variable.a, variable.e)


def _by_hand(model: Any, flag: str) -> bool:
    """Whether a model, or a block in it, has equations that are not generated."""
    parts = (model, *model.blocks.values())
    return any(getattr(part.flags, flag) is True for part in parts)
