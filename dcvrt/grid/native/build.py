"""Objects of the native engine: one for each structure of unit, one for the network, compiled once."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from ctypes import POINTER, Structure, c_double, c_float, c_long, c_void_p
from functools import lru_cache
from importlib import resources
from pathlib import Path
from weakref import WeakKeyDictionary

from dcvrt.errors import InputError
from dcvrt.grid.native.structure import Structure as UnitStructure
from dcvrt.grid.native.text import text_of
from dcvrt.integrators.compiler import Compiler, build, find_compiler, native_flags

FLAGS = (
    "-std=gnu11",
    "-O3",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-fPIC",
    "-shared",
)
QUIET = ("-Wno-psabi", "-w")
DOUBLES, FLOATS, LONGS = POINTER(c_double), POINTER(c_float), POINTER(c_long)


class GroupStruct(Structure):
    """struct group of fleet.h."""

    _fields_ = (
        *(
            (name, c_long)
            for name in (
                "units", "lanes", "packs", "nx", "np", "nq", "na", "rows", "bounds", "moving", "fixed",
                "fixed_columns",
                "ports", "v_rows", "first_port", "first_feed", "first_state", "reads_v", "quick", "angle",
            )
        ),
        ("tolerance", c_double),
        *((name, DOUBLES) for name in ("p", "moving_seed", "held", "inertia")),
        *((name, DOUBLES) for name in ("q", "entry", "entries", "since", "sinces")), ("along", c_long),
        *((name, DOUBLES) for name in ("kept", "kept_columns", "no_columns")),
        *(
            (name, LONGS)
            for name in (
                "mode", "row_automaton", "row_source", "row_target", "row_resets", "flag_begin", "flag_width",
            )
        ),
        ("flag_values", DOUBLES), ("call", c_void_p),
    )  # fmt: skip


class FleetStruct(Structure):
    """struct fleet."""

    _fields_ = (
        ("groups", c_long), ("group", POINTER(POINTER(GroupStruct))),
        *((name, c_long) for name in ("ports", "points", "states", "directions", "feeds")),
    )  # fmt: skip


class NetworkStruct(Structure):
    """struct network."""

    _fields_ = (("z", DOUBLES), ("dz", POINTER(DOUBLES)), ("near", FLOATS))


class StretchStruct(Structure):
    """struct stretch."""

    _fields_ = (
        ("begin", c_double), ("end", c_double), ("dfrom", DOUBLES), ("network", POINTER(NetworkStruct)),
        ("samples", c_long), ("sample", DOUBLES),
    )  # fmt: skip


class OptionsStruct(Structure):
    """struct options."""

    _fields_ = (
        *((n, c_double) for n in ("rtol", "atol", "theta_rtol", "theta_share")),
        *((n, c_double) for n in ("longest", "out_of_step", "worth")),
        ("max_steps", c_long),
    )  # fmt: skip


class RecordStruct(Structure):
    """struct record."""

    _fields_ = (
        ("v", DOUBLES), ("vs", DOUBLES), ("events", DOUBLES),
        *((n, c_long) for n in ("event_room", "n_events", "n_samples", "steps", "rejected")),
        ("t", c_double), ("amount", c_double),
        *((n, c_long) for n in ("group", "unit", "row")),
    )  # fmt: skip


class UnitObject:
    """The compiled equations of one structure."""

    def __init__(self, path: Path) -> None:
        self.dll = ctypes.CDLL(str(path))
        sizes = (c_long * 3).in_dll(self.dll, "sizes")
        self.lanes, self.fixed, self.fixed_columns = (int(n) for n in sizes)
        self.functions = ctypes.addressof((c_void_p * 6).in_dll(self.dll, "functions"))


def _files(*names: str) -> dict[str, str]:
    driver = resources.files("dcvrt.grid.native") / "driver"
    shared = resources.files("dcvrt.integrators.kernel") / "driver"
    found = {f.name: f for folder in (shared, driver) for f in folder.iterdir()}
    return {name: found[name].read_text(encoding="utf-8") for name in names}


def compiler() -> Compiler:
    """The C compiler, which the native engine cannot do without.

    Raises
    ------
    InputError
        When there is none.
    """
    found = find_compiler()
    if found is None:
        raise InputError(
            "the native engine needs a C compiler and found none. Way out: install gcc or clang, "
            "pip install 'dcvrt[compiler]', or ask for engine='andes'."
        )
    return found


@lru_cache(maxsize=1)
def network_library() -> ctypes.CDLL:
    """The object that integrates a fleet."""
    found = compiler()
    base = ("fleet.h", "pair.h", "rk54.h", "run.h", "products.h", "voltages.h")
    files = _files(*base, "steps.h", "nested.h", "events.h", "network.c")
    path = build(files, found, (*FLAGS, *native_flags(found), *QUIET), ("network.c",))
    dll = ctypes.CDLL(str(path))
    dll.fleet_run.argtypes = [
        POINTER(FleetStruct), POINTER(OptionsStruct), c_long, POINTER(StretchStruct), DOUBLES, DOUBLES,
        DOUBLES, POINTER(RecordStruct),
    ]  # fmt: skip
    return dll


FEW = 4
"""Lanes of an object for that many units or fewer, where others have more: in half a register, roots and
quotients, which bound the equations of facilities, take half the time."""
_objects: WeakKeyDictionary[UnitStructure, dict[bool, UnitObject]] = WeakKeyDictionary()


def unit_objects(structures: Sequence[UnitStructure], units: Sequence[int]) -> list[UnitObject]:
    """Objects of several structures, for so many units each; new ones are compiled side by side."""
    wanted = [(s, n <= FEW) for s, n in zip(structures, units, strict=True)]
    new = [(s, few) for s, few in dict.fromkeys(wanted) if few not in _objects.get(s, {})]
    if new:
        found = compiler()
        flags = (*FLAGS, *native_flags(found), *QUIET)
        fixed = _files("fleet.h", "group.c", "lanes.h", "width.h")
        texts = [{**fixed, "unit.h": text_of(s)} for s, _ in new]
        all_flags = [(*flags, f"-DFEW={FEW}") if few else flags for _, few in new]
        with ThreadPoolExecutor(max_workers=2) as pool:
            paths = list(
                pool.map(lambda files, flags: build(files, found, flags, ("group.c",)), texts, all_flags)
            )
        for (structure, few), path in zip(new, paths, strict=True):
            _objects.setdefault(structure, {})[few] = UnitObject(path)
    return [_objects[s][few] for s, few in wanted]
