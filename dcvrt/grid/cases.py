"""Where networks come from: MATPOWER files, and the IEEE 118-bus system with its ratings."""

from __future__ import annotations

import csv
import importlib.resources
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np

from dcvrt.errors import InputError
from dcvrt.grid import matpower
from dcvrt.grid.network import Branches, Generators, Network


def from_matpower(path: Path) -> Network:
    """Build a network from a MATPOWER case file; see `Network.from_matpower`."""
    return _from_tables(matpower.read(path), path.stem)


def ieee118() -> Network:
    """Build the IEEE 118-bus system; see `Network.ieee118`."""
    spec = importlib.util.find_spec("andes")  # located, not imported: importing it takes a second
    if spec is None or spec.origin is None:
        raise InputError(
            "ieee118: the case file comes with the package 'andes', which is not installed. "
            "Way out: pip install andes, or Network.from_matpower(path) with your own case118.m."
        )
    bare = from_matpower(Path(spec.origin).parent / "cases" / "matpower" / "case118.m")
    lines, units = bare.branches, bare.generators
    table = importlib.resources.files("dcvrt") / "data" / "pglib" / "ieee118_ratings.csv"
    rows = list(csv.DictReader(line for line in table.read_text().splitlines() if not line.startswith("#")))
    ends = [(int(row["from_bus"]), int(row["to_bus"])) for row in rows]
    if ends != list(zip(lines.from_bus.tolist(), lines.to_bus.tolist(), strict=True)):
        raise InputError(
            "ieee118: case118.m of the installed andes package lists its branches in another order "
            "than the ratings table. Way out: install an andes version that dcvrt supports."
        )
    return replace(
        bare,
        name="ieee118",
        branches=replace(lines, rating=np.array([float(row["rating_mva"]) for row in rows])),
        generators=replace(units, p_min=np.zeros(len(units))),
    )


def _from_tables(case: matpower.Case, name: str) -> Network:
    """Build a network from the tables of a case file."""
    bus = case.bus[case.bus[:, matpower.BUS_TYPE] != matpower.ISOLATED]
    number = bus[:, matpower.BUS_NUMBER].astype(np.int64)
    live = set(number.tolist())
    branch = case.branch[case.branch[:, matpower.BRANCH_STATUS] > 0]
    unit = case.gen[case.gen[:, matpower.GEN_STATUS] > 0]
    isolated = set(case.bus[:, matpower.BUS_NUMBER].astype(np.int64).tolist()) - live
    branch = branch[[not ({int(row[0]), int(row[1])} & isolated) for row in branch]]
    unit = unit[[int(row[0]) not in isolated for row in unit]]
    unit_bus = unit[:, matpower.GEN_BUS].astype(np.int64)

    v_set = np.ones(len(number))
    place = {int(b): k for k, b in enumerate(number)}
    for b, volts in zip(unit_bus, unit[:, matpower.GEN_VOLTAGE], strict=True):
        if int(b) in place:
            v_set[place[int(b)]] = volts
    held = set(unit_bus.tolist())  # a bus of type 2 without a unit in service holds nothing
    kinds = tuple(
        "slack" if code == matpower.SLACK else "pv" if code == matpower.PV and int(b) in held else "pq"
        for b, code in zip(number, bus[:, matpower.BUS_TYPE], strict=True)
    )
    seen: dict[int, int] = {}
    names = []
    for b in unit_bus.tolist():
        seen[b] = seen.get(b, 0) + 1
        names.append(f"G{b}" if seen[b] == 1 else f"G{b}_{seen[b]}")
    tap = branch[:, matpower.BRANCH_TAP]
    rating = branch[:, matpower.BRANCH_RATING]
    return Network(
        name=name,
        base_mva=case.base_mva,
        bus=number,
        kind=kinds,
        base_kv=bus[:, matpower.BUS_BASE_KV].copy(),
        p_load=bus[:, matpower.BUS_P].copy(),
        q_load=bus[:, matpower.BUS_Q].copy(),
        g_shunt=bus[:, matpower.BUS_G].copy(),
        b_shunt=bus[:, matpower.BUS_B].copy(),
        v_set=v_set,
        branches=Branches(
            from_bus=branch[:, 0].astype(np.int64),
            to_bus=branch[:, 1].astype(np.int64),
            r=branch[:, matpower.BRANCH_R].copy(),
            x=branch[:, matpower.BRANCH_X].copy(),
            b=branch[:, matpower.BRANCH_B].copy(),
            tap=np.where(tap == 0, 1.0, tap),
            shift=np.deg2rad(branch[:, matpower.BRANCH_SHIFT]),
            rating=np.where(rating == 0, np.inf, rating),
        ),
        generators=Generators(
            bus=unit_bus,
            p_set=unit[:, matpower.GEN_P].copy(),
            p_min=unit[:, matpower.GEN_P_MIN].copy(),
            p_max=unit[:, matpower.GEN_P_MAX].copy(),
            q_min=unit[:, matpower.GEN_Q_MIN].copy(),
            q_max=unit[:, matpower.GEN_Q_MAX].copy(),
            name=tuple(names),
        ),
        slack_angle=float(
            np.deg2rad(bus[bus[:, matpower.BUS_TYPE] == matpower.SLACK, matpower.BUS_ANGLE].sum())
        ),
    )
