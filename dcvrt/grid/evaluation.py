"""f and g of a loaded ANDES system, evaluated by the functions that ANDES has generated for them.

The same calls in the same order as `TDS.fg_update` of ANDES, and the same numbers to the last bit. It leaves
out models that have nothing to do in a call, and adds up what models give in one pass instead of one a
variable: together a sixth of a replay.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.int64]


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
