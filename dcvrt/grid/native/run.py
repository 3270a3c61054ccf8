"""Fault simulation of an operating point with the compiled engine."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, byref, c_long, pointer
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.grid.native import build
from dcvrt.grid.native.build import (
    DOUBLES,
    FLOATS,
    LONGS,
    FleetStruct,
    GroupStruct,
    NetworkStruct,
    OptionsStruct,
    RecordStruct,
    StretchStruct,
    UnitObject,
)
from dcvrt.grid.native.fleet import Equilibrium, Group

Floats = npt.NDArray[np.float64]
Phasors = npt.NDArray[np.complex128]
BLOCK, WIDE_BLOCK = 8, 16
EVENT_ROOM = 4096
ALIGNMENT = 64
MOST_DIRECTIONS = 64
"""Derivatives that one run carries; the driver holds room for so many."""
STATUSES = {
    0: "",
    1: "left its valid range",
    2: "chattered",
    4: "the step became too small",
    5: "too many steps",
    6: "a state is no number",
    7: "voltage collapse or numerical failure: no voltages satisfy the network's equations",
    8: "lost synchronism",
    9: "out of memory",
}


@dataclass(frozen=True)
class Options:
    """Tolerances of a fault simulation.

    Parameters
    ----------
    rtol, atol : float
        Error of a step, relative and absolute, of every state.
    theta_rtol : float
        Error of a derivative, relative to itself plus `theta_share` of the largest one by the same parameter.
    theta_share : float
    longest : float
        Longest step, s.
    out_of_step : float
        Angle from the centre of inertia, rad, from which on a rotor counts as out of step.
    worth : float
        How many times longer a step of the machines has to be when facilities take steps of their own inside
        it, for them to do so: 0 lets them always, infinity never.
    max_steps : int
    """

    rtol: float = 1e-6
    atol: float = 1e-6
    theta_rtol: float = 1e-4
    theta_share: float = 1e-2
    longest: float = 0.1
    out_of_step: float = np.pi
    worth: float = 1.5
    max_steps: int = 200_000


@dataclass(frozen=True, eq=False)
class Layout:
    """Where units stand among ports and states; the same for every operating point."""

    groups: tuple[Group, ...]
    objects: tuple[UnitObject, ...]

    @property
    def lanes(self) -> list[int]:
        """Lanes of each group."""
        return [o.lanes for o in self.objects]

    @property
    def packs(self) -> list[int]:
        return [-(-len(g.units) // o.lanes) for g, o in zip(self.groups, self.objects, strict=True)]

    @property
    def ports(self) -> int:
        """Ports, those of lanes without a unit included; a multiple of the rows of a block."""
        return -(-sum(p * n for p, n in zip(self.packs, self.lanes, strict=True)) // BLOCK) * BLOCK

    @property
    def first_state(self) -> list[int]:
        """Where the states of each group begin, then how many there are; at multiples of a block."""
        sizes = [
            -(-p * n * g.structure.dae.x.numel() // BLOCK) * BLOCK
            for g, p, n in zip(self.groups, self.packs, self.lanes, strict=True)
        ]
        return [sum(sizes[:k]) for k in range(len(sizes) + 1)]

    @cached_property
    def unit_of_port(self) -> npt.NDArray[np.int64]:
        """Of each port the number of its unit, through the groups; lanes without a unit repeat the last."""
        unit, first = [], 0
        for group, packs, lanes in zip(self.groups, self.packs, self.lanes, strict=True):
            unit.append(first + np.minimum(np.arange(packs * lanes), len(group.units) - 1))
            first += len(group.units)
        return np.concatenate([*unit, np.full(self.ports - sum(map(len, unit)), first - 1)])


def in_lanes(values: Floats, lanes: int) -> Floats:
    """(units, ...) as (packs, ..., lanes); lanes without a unit repeat the last."""
    packs = -(-len(values) // lanes)
    own = np.minimum(np.arange(packs * lanes), len(values) - 1)
    spread = values[own].reshape(packs, lanes, *values.shape[1:])
    return np.ascontiguousarray(np.moveaxis(spread, 1, -1), dtype=float)


def _aligned(array: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """A contiguous copy that begins where a vector register may be loaded from."""
    room = np.empty(array.nbytes + ALIGNMENT, dtype=np.uint8)
    skip = -room.ctypes.data % ALIGNMENT
    copy = room[skip : skip + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


def _pointer(array: npt.NDArray[np.float64]) -> ctypes._Pointer[ctypes.c_double]:
    return array.ctypes.data_as(DOUBLES)


@dataclass(eq=False)
class NetworkTable:
    """Impedances of one network as the engine reads them.

    Parameters
    ----------
    z : complex array (ports that feed a current + points, ports that feed a current)
        Rows of ports and rows of points are each filled up to whole blocks.
    dz : sequence of such arrays or None, one a parameter
    """

    z: Phasors
    dz: Sequence[Phasors | None]

    def __post_init__(self) -> None:
        self._z = _blocks(self.z)
        feeds = self.z.shape[1]
        rows = np.zeros((-(-feeds // WIDE_BLOCK) * WIDE_BLOCK, feeds), dtype=complex)
        rows[:feeds] = self.z[:feeds]
        self._near = _blocks(rows, WIDE_BLOCK, np.float32)
        self._dz = [None if d is None else _blocks(d) for d in self.dz]
        self._pointers = (DOUBLES * max(len(self._dz), 1))(
            *(DOUBLES() if d is None else _pointer(d) for d in self._dz)
        )
        self.struct = NetworkStruct(_pointer(self._z), self._pointers, self._near.ctypes.data_as(FLOATS))


def _blocks(z: Phasors, size: int = BLOCK, precision: type = np.float64) -> Floats:
    rows, columns = z.shape
    blocks = z.reshape(rows // size, size, columns).transpose(0, 2, 1)
    return _aligned(np.stack([blocks.real, blocks.imag], axis=2, dtype=precision, casting="same_kind"))  # type: ignore[return-value]


class Fleet:
    """Units at an operating point, ready to run: parameters, states and modes in lanes."""

    def __init__(
        self,
        layout: Layout,
        rest: Sequence[Equilibrium],
        dx: Sequence[Floats],
        dset: Sequence[Floats],
        points: int,
    ) -> None:
        self.layout, self.points = layout, points
        self.directions = dx[0].shape[-1] if dx else 0
        self._keep: list[object] = []
        self._start: list[tuple[npt.NDArray[np.generic], npt.NDArray[np.generic]]] = []
        d, ports = self.directions, layout.ports
        rows = ports + -(-points // BLOCK) * BLOCK
        structs, port, feed = [], 0, 0
        *begins, states = layout.first_state
        self.x, self.xs = np.zeros(states), np.zeros(states * d)
        for group, packs, obj, eq, gx, gs, state in zip(
            layout.groups, layout.packs, layout.objects, rest, dx, dset, begins, strict=True
        ):
            structs.append(self._group(group, packs, obj, eq, gs))
            structs[-1].ports, structs[-1].v_rows = ports, rows
            structs[-1].first_port, structs[-1].first_feed, structs[-1].first_state = port, feed, state
            x, xs = in_lanes(eq.x, obj.lanes).ravel(), in_lanes(gx.transpose(0, 2, 1), obj.lanes).ravel()
            self.x[state : state + len(x)] = x
            self.xs[state * d : state * d + len(xs)] = xs
            port += packs * obj.lanes
            feed += len(group.units)
        self._structs = structs
        self._table = (POINTER(GroupStruct) * max(len(structs), 1))(*(pointer(s) for s in structs))
        self.struct = FleetStruct(len(structs), self._table, ports, points, states, d, feed)

    def _held(self, array: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        self._keep.append(array)
        return array

    def _group(
        self,
        group: Group,
        packs: int,
        obj: UnitObject,
        eq: Equilibrium,
        dset: Floats,
    ) -> GroupStruct:
        dae, d, lanes = group.structure.dae, self.directions, obj.lanes
        automata, table = dae.automata, group.structure.rows
        flags = [np.asarray(a.flags, dtype=float).reshape(len(a.modes), -1) for a in automata]
        widths = [f.shape[1] for f in flags]
        begins = np.cumsum([0, *(f.size for f in flags)])[:-1]
        start = np.concatenate(
            [*(f[a.mode_number(a.start)] for a, f in zip(automata, flags, strict=True)), []]
        )
        held = group.held(eq.p)
        modes = np.array([a.mode_number(a.start) for a in automata] or [0])
        seeds = dset.transpose(0, 2, 1)
        structure = group.structure

        def doubles(array: Floats) -> object:
            return _pointer(self._held(_aligned(np.asarray(array, dtype=float))))  # type: ignore[arg-type]

        def longs(values: Sequence[int]) -> object:
            return self._held(np.array([*values, 0], dtype=c_long)).ctypes.data_as(LONGS)

        def varying(array: npt.NDArray[np.generic], kind: Any) -> object:
            """An array that a run changes: kept with its first values."""
            array = _aligned(array)
            self._start.append((array, array.copy()))
            return array.ctypes.data_as(kind)

        inertia = np.zeros(len(group.units))
        if structure.inertia:
            inertia = eq.p[:, structure.column(structure.inertia)]
        mass = in_lanes(inertia, lanes)
        mass.ravel()[len(group.units) :] = 0.0
        many = packs * lanes
        struct = GroupStruct(
            units=len(group.units), lanes=lanes, packs=packs, nx=dae.x.numel(), np=eq.p.shape[1],
            nq=len(start), na=len(automata), rows=len(table),
            bounds=len(structure.bounds), moving=len(structure.moving), fixed=obj.fixed,
            fixed_columns=obj.fixed_columns,
            reads_v=int(not structure.affine),
            quick=int(group.quick),
            angle=dae.x_names.index(structure.angle) if structure.angle else -1,
            tolerance=group.tolerance,
            p=doubles(in_lanes(eq.p, lanes)),
            moving_seed=doubles(in_lanes(seeds, lanes)),
            held=doubles(in_lanes(held, lanes)), inertia=doubles(mass),
            q=varying(np.repeat(np.tile(start, packs), lanes), DOUBLES),
            entry=varying(np.zeros(many * max(len(automata), 1)), DOUBLES),
            entries=varying(np.zeros(many * max(len(automata) * d, 1)), DOUBLES),
            since=varying(np.full(many * max(len(table), 1), np.inf), DOUBLES),
            sinces=varying(np.zeros(many * max(len(table) * d, 1)), DOUBLES),
            kept=doubles(np.zeros(many * max(obj.fixed, 1))),
            kept_columns=doubles(np.zeros(many * max(obj.fixed_columns * d, 1))),
            no_columns=doubles(np.zeros(many * max(obj.fixed_columns, len(automata), 1))),
            mode=varying(np.repeat(np.tile(modes, packs), lanes).astype(c_long), LONGS),
            row_automaton=longs([a for a, _ in table]),
            row_source=longs([automata[a].mode_number(r.source) for a, r in table]),
            row_target=longs([automata[a].mode_number(r.target) for a, r in table]),
            row_resets=longs([int(bool(r.reset)) for _, r in table]),
            flag_begin=longs(begins.tolist()), flag_width=longs(widths),
            flag_values=doubles(np.concatenate([*(f.ravel() for f in flags), [0.0]])),
            call=obj.functions,
        )  # fmt: skip
        return struct

    def restart(self) -> None:
        """Put modes and timers back to where a run begins."""
        for array, first in self._start:
            array[...] = first

    def hoist(self) -> None:
        """Compute what depends on parameters and flags alone."""
        call = ctypes.CFUNCTYPE(None, POINTER(GroupStruct), c_long, c_long)
        for struct, obj in zip(self._structs, self.layout.objects, strict=True):
            function = call((ctypes.c_void_p * 6).from_address(obj.functions)[5] or 0)
            for pack in range(struct.packs):
                function(byref(struct), pack, self.directions)


@dataclass(frozen=True, eq=False)
class Simulated:
    """What a run leaves.

    Parameters
    ----------
    v : complex array (samples, points)
    tangents : complex array (samples, parameters, points)
    status : str
        Empty when the end was reached.
    events : tuple of (time, unit, row)
    steps, rejected : int
    end : array
        States where the run ended, as they lie in lanes.
    """

    v: Phasors
    tangents: Phasors
    status: str
    events: tuple[tuple[float, str, str], ...]
    steps: int
    rejected: int
    end: Floats


def simulate(
    fleet: Fleet,
    stretches: Sequence[tuple[float, float, NetworkTable, Floats, Floats]],
    v_start: Phasors,
    options: Options,
) -> Simulated:
    """Run through stretches of constant networks.

    Parameters
    ----------
    fleet : Fleet
    stretches : sequence of (from, to, network, samples, derivative of `from`)
    v_start : complex array (ports,)
        Voltages just before.
    options : Options
    """
    dll = build.network_library()
    fleet.restart()
    fleet.hoist()
    points, d = fleet.points, fleet.directions
    padded = points
    count = sum(len(s[3]) for s in stretches)
    v = np.zeros((count, 2, padded))
    vs = np.zeros((count, max(d, 1), 2, padded))
    events = np.zeros((EVENT_ROOM, 4))
    record = RecordStruct(v=_pointer(v), vs=_pointer(vs), events=_pointer(events), event_room=EVENT_ROOM)
    held = [
        (np.ascontiguousarray(samples, dtype=float), np.ascontiguousarray(np.r_[moves, 0.0], dtype=float))
        for *_, samples, moves in stretches
    ]
    table = (StretchStruct * len(stretches))(
        *(
            StretchStruct(a, b, _pointer(moves), pointer(network.struct), len(samples), _pointer(samples))
            for (a, b, network, *_), (samples, moves) in zip(stretches, held, strict=True)
        )
    )
    x, xs = fleet.x.copy(), np.r_[fleet.xs, 0.0]
    start = np.r_[v_start.real, v_start.imag].astype(float)
    o = options
    settings = OptionsStruct(
        o.rtol, o.atol, o.theta_rtol, o.theta_share, o.longest, o.out_of_step, o.worth, o.max_steps
    )
    code = dll.fleet_run(
        byref(fleet.struct), byref(settings), len(stretches), table, _pointer(x), _pointer(xs),
        _pointer(start), byref(record),
    )  # fmt: skip
    done = record.n_samples
    named = tuple(_event(fleet, events[k]) for k in range(min(record.n_events, EVENT_ROOM)))
    return Simulated(
        v[:done, 0] + 1j * v[:done, 1],
        (vs[:done, :, 0] + 1j * vs[:done, :, 1])[:, :d],
        _status(fleet, code, record),
        tuple(e for e in named if e[1]),
        record.steps,
        record.rejected,
        x,
    )


def _event(fleet: Fleet, event: Floats) -> tuple[float, str, str]:
    group, unit = fleet.layout.groups[int(event[1])], int(event[3])
    name = group.units[unit].name if unit < len(group.units) else ""  # a lane that repeats the last unit
    _, row = group.structure.rows[int(event[2])]
    return float(event[0]), name, row.text


def _status(fleet: Fleet, code: int, record: RecordStruct) -> str:
    if not code:
        return ""
    text = f"{STATUSES[code]} at t = {record.t:.4f} s"
    if code in (1, 2, 8) and fleet.layout.groups:
        group = fleet.layout.groups[record.group]
        unit = group.units[min(record.unit, len(group.units) - 1)]
        text += f": {unit.name} at bus {unit.bus}"
        if code == 8:
            text += f" is {np.rad2deg(abs(record.amount)):.0f} deg from the centre of inertia"
        elif code == 2:
            text += f", {group.structure.rows[record.row][1].text}"
        else:
            state = group.structure.dae.states[group.structure.bounds[record.row][0]]
            text += f", {state.path}" + (f" ({state.crossing})" if state.crossing else "")
    return text + "."
