"""Copies of a case side by side in one ANDES system: islands that no line joins.

ANDES evaluates all devices of a model at once, in NumPy, and for a hundred buses most of the time is that of
the calls: an evaluation of seven copies takes twice as long as that of one. So several faults of an operating
point are simulated in one system, each in a copy of its own.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.int64]

NUMBER = (int, float, np.number)
NAMED = re.compile(r" \(copy (\d+)\)$")
"""How the name of a device in a copy ends."""


class Copies:
    """Copies of all devices of a system; number 0 are the devices themselves.

    Parameters
    ----------
    system : andes.System
        Not set up yet; gets the copies.
    count : int
        How many there are in all.
    """

    def __init__(self, system: Any, count: int) -> None:
        self.system, self.count = system, count
        numbers: list[Any] = [
            idx for model in system.models.values() for idx in model.idx.v if isinstance(idx, NUMBER)
        ]
        self._offset = 10 ** len(str(int(max(map(abs, numbers), default=0))))
        first = {name: model.n for name, model in system.models.items() if model.n}
        for copy in range(1, count):
            for name, devices in first.items():
                model = system.models[name]
                links = set(model.idx_params)
                columns = {p: param.v for p, param in model.params.items() if len(param.v) >= devices}
                for k in range(devices):
                    values = {
                        p: self.name(column[k], copy) if p in links else column[k]
                        for p, column in columns.items()
                    }
                    system.add(name, {**values, "idx": self.name(model.idx.v[k], copy)})

    def name(self, idx: Any, copy: int) -> Any:
        """What a device of the case, or none, is called in a copy."""
        if idx is None or not copy:
            return idx
        return int(idx) + copy * self._offset if isinstance(idx, NUMBER) else f"{idx} (copy {copy})"

    def _copy_of(self, idx: Any) -> int:
        if isinstance(idx, NUMBER):
            return int(idx) // self._offset
        found = NAMED.search(str(idx))
        return int(found[1]) if found else 0

    def numbers(self, model: Any) -> Integers:
        """Copy of each device of a model; one that ANDES has made is where those that it refers to are."""
        columns = [model.idx.v, *(link.v for link in model.idx_params.values())]
        known: dict[Any, int] = {}
        for column in columns:
            known.update((idx, self._copy_of(idx)) for idx in column if idx is not None and idx not in known)
        each = zip(*columns, strict=True)
        return np.array([max(known.get(idx, 0) for idx in own) for own in each], dtype=np.int64)

    def variables(self) -> list[tuple[Integers, Integers]]:
        """Addresses of the states and of the algebraic variables of each copy, once they are assigned."""
        system = self.system
        x, y = (np.zeros(int(n), dtype=np.int64) for n in (system.dae.n, system.dae.m))
        for model in system.exist.pflow_tds.values() if self.count > 1 else ():
            number = self.numbers(model) if model.n else np.zeros(0, dtype=np.int64)
            for variables, of in ((model.states, x), (model.algebs, y)):
                for variable in variables.values():
                    of[variable.a] = number
        return [(np.flatnonzero(x == k), np.flatnonzero(y == k)) for k in range(self.count)]
