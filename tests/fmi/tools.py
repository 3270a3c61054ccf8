"""Exported units as the tests use them: run by fmpy, called function by function, held against our runs."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy import fmi3
from fmpy.model_description import ModelDescription, read_model_description

from dcvrt.dae import Dae
from dcvrt.fmi import export
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform


@dataclass
class Unit:
    """An FMU on disk and unpacked, its description, and what its instances have logged."""

    path: Path
    folder: Path
    description: ModelDescription
    log: list[tuple[int, str]] = field(default_factory=list)

    @classmethod
    def of(cls, dae: Dae, folder: Path, **options: Any) -> Unit:
        path = export(dae, folder / f"{dae.name}.fmu", **options)
        unpacked = fmpy.extract(str(path), str(folder / f"{dae.name}-unpacked"))
        return cls(path, Path(unpacked), read_model_description(str(path), validate=True))

    def reference(self, name: str) -> int:
        (found,) = [v.valueReference for v in self.description.modelVariables if v.name == name]
        return int(found)

    def references(self, *names: str) -> list[int]:
        return [self.reference(name) for name in names]

    def heard(self, *_: Any) -> None:
        _, status, _, text = _
        self.log.append((status, text.decode()))

    @contextmanager
    def instance(self) -> Iterator[fmi3.FMU3Model]:
        made = fmi3.FMU3Model(
            guid=self.description.guid,
            unzipDirectory=str(self.folder),
            modelIdentifier=self.description.modelExchange.modelIdentifier,
            instanceName="unit",
        )
        self.log.clear()
        made.instantiate(loggingOn=True, logMessage=self.heard)
        try:
            yield made
        finally:
            made.freeInstance()

    def messages(self, status: int = fmi3.fmi3Error) -> list[str]:
        return [text for level, text in self.log if level == status]

    def simulate(
        self, waveform: Waveform, tolerance: float = 1e-9, interval: float = 1e-3, **more: Any
    ) -> np.ndarray:
        """Run on a waveform; a jump of the input is a time that stands twice."""
        inputs = [v.name for v in self.description.modelVariables if v.causality == "input"]
        signal = np.zeros(len(waveform.t), dtype=[("time", float), *((name, float) for name in inputs)])
        signal["time"], signal["v_poi.re"], signal["v_poi.im"] = waveform.t, waveform.v.real, waveform.v.imag
        for name in set(inputs) - {"v_poi.re", "v_poi.im"}:
            (variable,) = [v for v in self.description.modelVariables if v.name == name]
            signal[name] = float(variable.start)
        self.log.clear()
        options: dict[str, Any] = {
            "solver": "CVode",
            "stop_time": waveform.until,
            "relative_tolerance": tolerance,
            "output_interval": interval,
            "debug_logging": True,
            "logger": self.heard,
        }
        return fmpy.simulate_fmu(str(self.folder), input=signal, **(options | more))


def start(instance: fmi3.FMU3Model, values: Mapping[int, float] | None = None, at: float = 0.0) -> None:
    """Initialise with some values set, and settle the modes."""
    if values:
        instance.setFloat64(list(values), list(values.values()))
    instance.enterInitializationMode(startTime=at)
    instance.exitInitializationMode()
    settle(instance)
    instance.enterContinuousTimeMode()


def settle(instance: fmi3.FMU3Model) -> tuple[bool, float | None, int]:
    """Update the discrete states until nothing changes: whether to end, next event, number of updates."""
    for count in range(1, 200):
        again, terminate, _, _, timed, at = instance.updateDiscreteStates()
        if terminate or not again:
            return terminate, at if timed else None, count
    raise AssertionError("the modes do not settle")


def column(read: Any, n: int) -> np.ndarray:
    """What a function of fmpy fills into a buffer."""
    values = np.zeros(n)
    read(values.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), n)
    return values


def put_states(instance: fmi3.FMU3Model, x: np.ndarray) -> None:
    x = np.ascontiguousarray(x, dtype=float)
    instance.setContinuousStates(x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)), len(x))


def changes(result: np.ndarray, mode: str) -> list[tuple[float, int]]:
    """Times at which a mode of a run by fmpy changes, and what it changes to."""
    values = np.asarray(result[mode])
    return [(float(result["time"][k + 1]), int(values[k + 1])) for k in np.flatnonzero(np.diff(values))]


def between(run: Trajectory, name: str, t: np.ndarray) -> np.ndarray:
    """A signal of our own run at other times, on the cubics through its samples and their rates."""
    k = run.outputs.names.index(name)
    assert run.outputs.rate is not None
    y, rate = run.outputs.value[:, k], run.outputs.rate[:, k]
    i = np.clip(np.searchsorted(run.t, t, side="right") - 1, 0, len(run.t) - 2)
    h = run.t[i + 1] - run.t[i]
    s = np.divide(t - run.t[i], h, out=np.zeros_like(t), where=h > 0)
    a, da, rise, db = y[i], rate[i] * h, y[i + 1] - y[i], rate[i + 1] * h
    return a + s * (da + s * (3 * rise - 2 * da - db + s * (da + db - 2 * rise)))


def apart(t: np.ndarray, instants: list[float], by: float = 2e-6) -> np.ndarray:
    """Times that are away from every instant."""
    distance = [np.abs(t - instant) for instant in instants] or [np.full(len(t), np.inf)]
    return np.min(distance, axis=0) > by
