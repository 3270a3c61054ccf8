"""One fault of an operating point, in its copy of the case: what it does to the network, and how it goes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dcvrt.grid.faults import Stage

if TYPE_CHECKING:
    from dcvrt.grid.operating_point import OperatingPoint

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]

NOT_RECOVERED = 0.01
"""Voltage just after clearing, pu, below which the faulted bus counts as not recovered."""
LOST_SYNCHRONISM = np.pi
"""Angle between a rotor and the centre of inertia, rad, from which on the rotor counts as out of step."""


class CopyRun:
    """A fault in a copy of the case.

    Parameters
    ----------
    point : OperatingPoint
    copy : int
    stages : sequence of Stage
        The network before, in and after the fault.
    buses : sequence of int
        Whose voltages are recorded.

    Attributes
    ----------
    samples : list of complex array (buses,)
    status : str
        Why it ended early, or empty.
    collapsed : bool
        Whether there was no solution near the last one.
    """

    def __init__(
        self, point: OperatingPoint, copy: int, stages: Sequence[Stage], buses: Sequence[int]
    ) -> None:
        self.point, self.copy, self.stages = point, copy, stages
        self.system = system = point.system
        self.samples: list[Phasors] = []
        self.status, self.collapsed, self._what = "", False, ""
        self._cleared: list[int] = []
        own = slice(copy * point.buses, (copy + 1) * point.buses)
        self._v, self._a = system.Bus.v.a[own], system.Bus.a.a[own]
        self._place = {bus: k for k, bus in enumerate(system.Bus.idx.v[: point.buses])}
        self._asked = [self._place[bus] for bus in buses]
        self._rotors = _Rotors(system, copy, point.copies.count)

    def enter(self, number: int, guess: Floats, before: Floats) -> None:
        """Change the network to that of a stage; `guess` are voltages near those that follow.

        In polar form V = 0 solves the balance of a bus without load, so that a search which starts from the
        voltages of the fault ends there: the fault would never be cleared. It starts from those before the
        fault instead.
        """
        last, stage = self.stages[number - 1], self.stages[number]
        self._cleared = [bus for bus in last.shunts if bus not in stage.shunts]
        self._what = "inception" if stage.shunts else "clearing" if self._cleared else "a change of branches"
        self.point.enter(stage, self.copy)
        if self._cleared:
            _, own = self.point.variables[self.copy]
            guess[own] = before[own]

    def recovered(self) -> bool:
        """Whether the voltage is back where a fault has just been cleared."""
        for bus in self._cleared:
            if self.system.dae.y[self._v[self._place[bus]]] < NOT_RECOVERED:
                self.collapse(float(self.system.dae.t), f"the voltage at bus {bus}")
        return not self.collapsed

    def record(self) -> bool:
        """Keep the voltages; false where a rotor is out of step."""
        y = self.system.dae.y
        self.samples.append(y[self._v[self._asked]] * np.exp(1j * y[self._a[self._asked]]))
        lost = self._rotors.out_of_step()
        if lost:
            self.status = f"lost synchronism at t = {float(self.system.dae.t):.3f} s: {lost}."
        return not lost

    def collapse(self, t: float, variable: str) -> None:
        """There is no solution at `t`; `variable` moved most."""
        v = self.system.dae.y[self._v]
        low = int(np.argmin(v))
        self.collapsed = True
        self.status = (
            f"voltage collapse or numerical failure after {self._what}, at t = {t:.4f} s: no solution near "
            f"the last one; {variable} did not settle; lowest voltage {v[low]:.2f} pu at bus "
            f"{self.system.Bus.idx.v[low]}."
        )


class _Rotors:
    """Rotor angles of all machines of a copy against their centre of inertia."""

    def __init__(self, system: Any, copy: int, copies: int) -> None:
        models = [model for model in system.SynGen.models.values() if model.n]

        def own(values: Any) -> Any:
            each = len(values) // copies
            return values[copy * each : (copy + 1) * each]

        self.system = system
        self.address = np.concatenate([own(model.delta.a) for model in models])
        self.inertia = np.concatenate([own(model.M.v * model.ue.v) for model in models])
        self.name = [
            f"{model.class_name} '{idx}'" for model in models for idx in model.idx.v[: model.n // copies]
        ]
        self.on = self.inertia > 0

    def out_of_step(self) -> str:
        """Say which machine is furthest from the centre of inertia, when that is half a turn or more."""
        delta = self.system.dae.x[self.address]
        away = np.where(self.on, np.abs(delta - delta @ self.inertia / self.inertia.sum()), 0.0)
        k = int(np.argmax(away))
        if away[k] <= LOST_SYNCHRONISM:
            return ""
        return f"{self.name[k]} is {np.rad2deg(away[k]):.0f} deg from the centre of inertia"
