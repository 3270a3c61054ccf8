"""The compiled kernel as Python objects: C structures, the loaded object, tables of inputs."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, Structure, c_double, c_int, c_long, c_ubyte, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dcvrt.integrators.channels import Channels
from dcvrt.integrators.equations import Equations

Array = NDArray[np.float64]
DOUBLES, LONGS, BYTES = POINTER(c_double), POINTER(c_long), POINTER(c_ubyte)
MAX_JUMPS_AT_ONCE = 50


class Inputs(Structure):
    """struct inputs of kernel.h."""

    _fields_ = (
        ("pieces", c_long), ("sections", c_long), ("start", DOUBLES), ("table", DOUBLES), ("section", LONGS),
    )  # fmt: skip


class Task(Structure):
    """struct task."""

    _fields_ = (("p", DOUBLES), ("x", DOUBLES), ("z", DOUBLES), ("inputs", POINTER(Inputs)))


class Options(Structure):
    """struct options."""

    _fields_ = (
        *((n, c_double) for n in ("rtol", "atol", "theta_rtol", "theta_share")),
        *((n, c_double) for n in ("save_at", "longest", "watch_tolerance")),
        ("max_steps", c_long), ("samples", c_int), ("steps", c_int), ("nodes", c_int),
    )  # fmt: skip


class Record(Structure):
    """struct record."""

    _fields_ = (
        *((n, c_long) for n in ("samples", "steps", "nodes", "events", "phases", "breaks")),
        *((f"{n}_room", c_long) for n in ("sample", "output", "step", "node", "event", "phase", "break")),
        *((n, DOUBLES) for n in ("sample_t", "sample_x", "sample_z", "sample_y", "sample_rate")),
        *((n, LONGS) for n in ("sample_piece", "sample_phase", "sample_step")),
        *((n, DOUBLES) for n in ("step_t", "step_h", "step_x")),
        *((n, LONGS) for n in ("step_piece", "step_phase")),
        *((n, DOUBLES) for n in ("node_t", "node_y", "node_rate")),
        *((n, LONGS) for n in ("node_step", "node_break")),
        ("node_kind", BYTES), ("event", DOUBLES), ("phase", c_void_p), ("dbreak", DOUBLES),
        ("break_kind", BYTES),
    )  # fmt: skip


class Corners(Structure):
    """struct corners."""

    _fields_ = (("missed", c_double), ("sharper", c_double), ("parts", c_int), ("levels", c_int))


class FunctionalResults(Structure):
    """struct functional_results."""

    _fields_ = (
        *((n, DOUBLES) for n in ("value", "time", "gradient")),
        *((n, BYTES) for n in ("place", "tie")),
    )  # fmt: skip


class Workspace(Structure):
    """struct workspace of functionals.h."""

    _fields_ = (("size", ctypes.c_ulong), ("memory", c_void_p))


class Work(Structure):
    """struct work."""

    _fields_ = (
        ("task", c_void_p), ("options", POINTER(Options)), ("result", c_void_p), ("functional", c_void_p),
        ("functionals", c_long), ("functional_results", FunctionalResults), ("cases", c_long),
        ("next", c_long), ("workspace", Workspace), ("again", c_void_p),
    )  # fmt: skip


def result_type(equations: Equations) -> type[Structure]:
    """struct result, whose arrays have the sizes of the system."""

    class Result(Structure):
        _fields_ = (
            ("status", c_int), ("detail", c_int), ("mode", c_int * max(equations.na, 1)),
            ("accepted", c_long), ("rejected", c_long), ("events", c_long),
            *((n, c_double) for n in ("t", "failed_from", "failed_to")),
            ("x", c_double * equations.nx), ("rate", c_double * equations.nx),
            ("visited", c_int * (MAX_JUMPS_AT_ONCE + 1)), ("event", DOUBLES),
        )  # fmt: skip

    return Result


class Library:
    """One compiled object."""

    def __init__(self, path: Path, equations: Equations) -> None:
        self.dll = ctypes.CDLL(str(path))
        self.Result = result_type(equations)
        dll = self.dll
        dll.keep_new.restype = c_void_p
        dll.keep_free.argtypes = [c_void_p]
        dll.keep_run.argtypes = [c_void_p] * 5
        dll.keep_states.restype = None
        dll.keep_states.argtypes = [c_void_p, c_long, *[c_void_p] * 4]
        dll.outputs_on.argtypes = [c_void_p, c_void_p, c_long, *[c_void_p] * 9]
        dll.keep_samples.argtypes = [c_void_p] * 3
        dll.rests_of.argtypes = [c_long, *[c_void_p] * 6]
        dll.rests_of.restype = None
        dll.run_one_lane.argtypes = dll.run_many_lanes.argtypes = [c_void_p]
        dll.results_free.argtypes = [c_void_p, c_long]
        dll.results_free.restype = None
        self.lanes = int(dll.lanes_at_once())


def doubles(array: Array) -> Any:
    """Pointer to the data of a contiguous array, which the caller keeps alive."""
    return array.ctypes.data_as(DOUBLES)


class InputTable:
    """Pieces of the inputs, laid out as the driver reads them."""

    def __init__(self, equations: Equations, channels: Channels) -> None:
        n, nu, nw = len(channels.start), equations.nu, equations.nw
        driven = equations.tangents and equations.voltage is not None
        parts = [channels.start[:, None], 1.0 / channels.length[:, None]]
        inputs = channels.C[:, 2 : 2 + 4 * nu].reshape(n, nu, 4)
        parts.append(inputs.transpose(0, 2, 1).reshape(n, 4 * nu))
        if driven:
            tangents = channels.C[:, 2 + 4 * nu :].reshape(n, nw, 2, 4)
            parts.append(tangents.transpose(0, 3, 2, 1).reshape(n, 8 * nw))
        self.table: Array = np.ascontiguousarray(np.hstack(parts))
        self.start: Array = np.append(channels.start, channels.start[-1] + channels.length[-1])
        self.section = np.append(channels.sections, n).astype(ctypes.c_long)
        self.struct = Inputs(
            n,
            len(channels.sections),
            doubles(self.start),
            doubles(self.table),
            self.section.ctypes.data_as(LONGS),
        )


class _Place:
    """Memory of the driver as numpy takes it."""

    def __init__(self, address: int | None, shape: tuple[int, ...], kind: str) -> None:
        self.__array_interface__ = {"data": (address, False), "shape": shape, "typestr": kind, "version": 3}


def view(pointer: Any, *shape: int) -> NDArray[Any]:
    """An array that the driver owns, in place: not to be used when the driver has freed it."""
    kind = np.dtype(pointer._type_).str
    if 0 in shape:
        return np.zeros(shape, dtype=kind)
    return np.asarray(_Place(ctypes.cast(pointer, c_void_p).value, shape, kind))
