"""Small grids built by hand, and tools that several tests of the native engine use."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from dcvrt.grid import BusFault, FaultSequence, Grid, LineTrip, Period, andes
from dcvrt.grid.native.engine import Engine, Theta, sample_times, thetas
from dcvrt.grid.native.point import NativePoint
from dcvrt.grid.native.run import Options, Simulated
from dcvrt.grid.network import Branches, Generators, Network
from dcvrt.grid.units import Unit
from dcvrt.models import Diagram
from dcvrt.models.declared import Part
from dcvrt.models.machines import GenCls, GenRou, Sexs, Tgov1

NO_VRT = {21: 31.4, 75: 153.9, 106: 102.4, 108: 104.1}
"""Hosted MW of the paper's allocation without ride-through."""
WINDY = Period("windy", 0.9, {69: 100.0, 80: 80.0}, 0.95)
TIGHT = Options(rtol=1e-9, atol=1e-9)
TIGHTEST = Options(rtol=1e-12, atol=1e-12, theta_rtol=1e-9, longest=0.02)

Line = tuple[int, int, complex]


def network(
    kinds: Mapping[int, str],
    lines: Sequence[Line],
    units: Mapping[int, float],
    loads: Mapping[int, complex] | None = None,
    v_set: Mapping[int, float] | None = None,
    q_limits: Mapping[int, tuple[float, float]] | None = None,
    taps: Mapping[int, complex] | None = None,
    p_max: float = 1e4,
) -> Network:
    """A network on 100 MVA: lines (from, to, z), units by MW, loads by MVA, complex ratios by line."""
    bus = list(kinds)
    at = {b: k for k, b in enumerate(bus)}
    load, volts = np.zeros(len(bus), dtype=complex), np.ones(len(bus))
    for b, s in (loads or {}).items():
        load[at[b]] = s
    for b, v in (v_set or {}).items():
        volts[at[b]] = v
    z, none = np.array([line[2] for line in lines]), np.zeros(len(lines))
    ratio = np.array([(taps or {}).get(k, 1.0) for k in range(len(lines))], dtype=complex)
    q = np.array([(q_limits or {}).get(b, (-1e4, 1e4)) for b in units], dtype=float)
    return Network(
        "sketch", 100.0, np.array(bus), tuple(kinds.values()), np.full(len(bus), 230.0), load.real, load.imag,
        np.zeros(len(bus)), np.zeros(len(bus)), volts,
        Branches(
            np.array([line[0] for line in lines]), np.array([line[1] for line in lines]), z.real, z.imag,
            none, abs(ratio), np.angle(ratio), none + np.inf,
        ),
        Generators(
            np.array(list(units)), np.array(list(units.values()), dtype=float), np.zeros(len(units)),
            np.full(len(units), p_max), q[:, 0], q[:, 1], tuple(f"G{b}" for b in units),
        ),
    )  # fmt: skip


def unit(
    bus: int,
    share: float = 1.0,
    exciter: Callable[[], Part] | None = None,
    governor: Callable[[], Part] | None = None,
    kind: type[Part] = GenCls,
    name: str = "",
    **values: float,
) -> Unit:
    """A machine at a bus, by the values of its block."""
    recipe: dict[str, Callable[[], Part]] = {"machine": partial(kind, **values)}
    if exciter is not None:
        recipe["exciter"] = exciter
    if governor is not None:
        recipe["governor"] = governor
    return Unit(bus, name or f"machine {bus}", bus, share, share, recipe)


def round_rotor(bus: int, share: float = 1.0, **values: float) -> Unit:
    """A machine with exciter and governor, of moderate size."""
    given = dict(M=8.0, x_d=1.8, x_q=1.7, x_d1=0.3, x_q1=0.55, x_d2=0.25, x_q2=0.25, x_l=0.2) | values
    return unit(
        bus, share, partial(Sexs, K=50.0, E_min=-5.0, E_max=5.0, T_A=1.0, T_B=10.0, T_E=0.05),
        partial(Tgov1, V_max=9.0, V_min=0.0), GenRou, **given,
    )  # fmt: skip


def engine(net: Network, units: Sequence[Unit], sites: Sequence[int], **more: object) -> Engine:
    """The engine on a grid built by hand; hosted load has unity power factor."""
    return Engine(net, tuple(units), tuple(sites), 1.0 + 0j, **more)  # type: ignore[arg-type]


Fault = BusFault | LineTrip | FaultSequence


def run(
    of: Engine,
    hosting: Mapping[int, float],
    fault: Fault,
    until: float = 0.6,
    wrt: Sequence[str] = (),
    period: Period | None = None,
    options: Options = TIGHT,
    facilities: Mapping[int, Diagram] | None = None,
    times: Sequence[np.ndarray] | None = None,
    step: float = 1 / 120,
    values: Mapping[str, float] | None = None,
) -> tuple[np.ndarray, Simulated, NativePoint]:
    """Times, what the engine leaves, and the operating point."""
    by = thetas(wrt, of.sites, of.network)
    point = of.point(hosting, period or Period(), by, facilities, values)
    stages = fault.stages(of.network)
    times = times or sample_times(stages, until, step)
    moves = {len(stages) - 1: np.array([float(q.kind == "clear") for q in by])} if by else None
    return np.concatenate(times), point.simulate(stages, times, options, moves), point


def states(point: NativePoint, end: np.ndarray) -> list[np.ndarray]:
    """States where a run ended, (units, states) of each group."""
    layout, found = point.system.layout, []
    for group, packs, lanes, at in zip(
        layout.groups, layout.packs, layout.lanes, layout.first_state, strict=False
    ):
        nx = group.structure.dae.x.numel()
        own = end[at : at + packs * nx * lanes].reshape(packs, nx, lanes)
        found.append(own.transpose(0, 2, 1).reshape(-1, nx)[: len(group.units)])
    return found


def away(t: np.ndarray, *events: float, by: float = 1e-3) -> np.ndarray:
    """Where times are further from all events."""
    return np.all([abs(t - event) > by for event in events], axis=0)


def package() -> Path:
    """Folder of the cases that ANDES brings along."""
    return andes.case118().parent.parent


def case(name: str, sites: Sequence[int], **more: object) -> Grid:
    """A case of the ANDES package."""
    return Grid.from_case(package() / name, sites=sites, **more)  # type: ignore[arg-type]


__all__ = [
    "NO_VRT",
    "TIGHT",
    "TIGHTEST",
    "WINDY",
    "Theta",
    "Unit",
    "away",
    "case",
    "engine",
    "network",
    "round_rotor",
    "run",
    "states",
    "unit",
]
