"""Several faults at a time, each in a copy of the case: the same numbers as one after another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dcvrt.grid import BusFault, FaultSequence, Grid, LineTrip, Period, andes, grid
from dcvrt.grid.fault_run import FaultRun
from dcvrt.grid.faults import Fault
from dcvrt.grid.operating_point import OperatingPoint
from dcvrt.grid.repeated import Copies
from tests.grid.live import CASES, FURTHER, package

FAULTS = {"ieee39": (16, 4), "npcc": (10, 30), "ieee14": (4, 2), "ieeet1": (4, 2)}
"""Buses of two faults, where not 8 and 10."""


def runs(
    case: Grid, faults: Sequence[Fault], monkeypatch: pytest.MonkeyPatch, together: bool, until: float = 0.4
) -> dict[Fault, FaultRun]:
    if not together:
        monkeypatch.setattr(grid, "TOGETHER", 1)
    hosting = {case.sites[0]: 5.0}
    return case.waveforms_of(hosting, Period(), faults, until, "andes")


def assert_alike(one: dict[Fault, FaultRun], other: dict[Fault, FaultRun]) -> None:
    for fault, run in one.items():
        assert run.status == other[fault].status
        assert set(run.waveforms) == set(other[fault].waveforms)
        for bus, waveform in run.waveforms.items():
            assert np.array_equal(waveform.t, other[fault][bus].t)
            assert np.abs(waveform.v - other[fault][bus].v).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", [*CASES, *(name for name in FURTHER if name != "frequency")])
def test_every_case_together_and_one_by_one(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path, dynamics = (CASES | FURTHER)[name]
    case = Grid.from_case(
        package() / path, (7,), dynamics=package() / dynamics if dynamics else None, redispatch="slack"
    )
    faults = [BusFault(bus, clear=0.08) for bus in FAULTS.get(name, (8, 10))]
    together = runs(case, faults, monkeypatch, True)
    assert all(run.completed for run in together.values())
    assert_alike(together, runs(case, faults, monkeypatch, False))


@pytest.mark.slow
def test_what_happens_to_one_is_not_seen_by_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loss of synchronism, a collapse, faults that are cleared at other times, branches that open."""
    case = Grid.from_case("ieee118")
    faults: list[Fault] = [
        BusFault(9, clear=0.6),
        BusFault(77),
        BusFault(80, opens=(77, 80)),
        BusFault(103, clear=0.05),
        LineTrip(23, 24, reclose=0.3),
        FaultSequence((BusFault(77, 0.1, 0.1), BusFault(80, 0.5, 0.1))),
        BusFault(100),
    ]
    together = runs(case, faults, monkeypatch, True, 1.5)
    assert "lost synchronism" in together[faults[0]].status
    assert sum(run.completed for run in together.values()) == len(faults) - 1
    assert_alike(together, runs(case, faults, monkeypatch, False, 1.5))


def test_a_fault_that_wants_shorter_steps_is_simulated_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """With so few iterations steps of 50 ms do not converge after some of the faults, but shorter ones do."""
    case = Grid.from_case("ieee118")
    monkeypatch.setattr("dcvrt.grid.trapezoid.ITERATIONS", 5)
    faults, simulated = [BusFault(77), BusFault(69, x_f=0.3), BusFault(100, x_f=1.0)], []
    plain = OperatingPoint._simulate

    def counted(point: OperatingPoint, some: Sequence[Fault], *rest: Any) -> Any:
        simulated.append(len(some))
        return plain(point, some, *rest)

    monkeypatch.setattr(OperatingPoint, "_simulate", counted)
    together = case.waveforms_of({}, Period(), faults, 0.4, "andes", 0.05)
    alone = simulated.count(1)
    assert simulated[0] == 3
    assert 0 < alone < 3
    assert all(run.completed for run in together.values())
    monkeypatch.setattr(grid, "TOGETHER", 1)
    assert_alike(together, case.waveforms_of({}, Period(), faults, 0.4, "andes", 0.05))


def test_copies_share_no_equation() -> None:
    """Every variable is in one copy, all copies are alike, and no entry of the Jacobian joins two."""
    for path in ("ieee14/ieee14_ieeet1.xlsx", "kundur/kundur_ieeest.xlsx"):
        system = andes.read(package() / path)
        copies = Copies(system, 3)
        with andes.quiet():
            system.setup()
            system.PFlow.run()
            system.TDS.config.no_tqdm = 1
            system.TDS.init()
        dae, variables = system.dae, copies.variables()
        n, m = int(dae.n), int(dae.m)
        assert sorted(np.concatenate([x for x, _ in variables])) == list(range(n))
        assert sorted(np.concatenate([y for _, y in variables])) == list(range(m))
        copy = np.zeros(n + m, dtype=int)
        for k, (x, y) in enumerate(variables):
            copy[x], copy[y + n] = k, k
            assert dae.x[x] == pytest.approx(dae.x[variables[0][0]], abs=1e-9)
            assert dae.y[y] == pytest.approx(dae.y[variables[0][1]], abs=1e-9)
        system.j_update(models=system.exist.pflow_tds)
        for block, row, column in (("fx", 0, 0), ("fy", 0, n), ("gx", n, 0), ("gy", n, n)):
            entries = getattr(dae, block)
            i, j = np.ravel(entries.I) + row, np.ravel(entries.J) + column
            assert (copy[i] == copy[j]).all()


def test_names_of_devices_tell_their_copy() -> None:
    system = andes.read(Path(package() / "ieee14" / "ieee14.raw"))
    buses = list(system.Bus.idx.v)
    copies = Copies(system, 2)
    assert [copies.name(bus, 0) for bus in buses] == buses
    assert system.Bus.idx.v == [*buses, *(copies.name(bus, 1) for bus in buses)]
    assert copies.numbers(system.Line).tolist() == [0] * (system.Line.n // 2) + [1] * (system.Line.n // 2)
