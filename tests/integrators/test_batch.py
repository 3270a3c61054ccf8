"""Batches: rows in order, failures kept and labelled, bad tables refused before anything runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.criteria import Criteria, margins
from dcvrt.errors import InputError
from dcvrt.integrators import Casadi, Kernel, Simulator, find_compiler
from dcvrt.waveform import Waveform
from tests.integrators.systems import flat, store


@pytest.fixture(scope="module", params=["kernel", "casadi"])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    if request.param == "kernel" and find_compiler() is None:
        pytest.skip("no C compiler here")
    solver = Kernel() if request.param == "kernel" else Casadi()
    return Simulator(facility.gfl().compile(), solver, wrt=("beta",))


def test_rows_are_the_single_runs(simulator: Simulator) -> None:
    sag, c = Waveform.sag(0.5, 0.1, 0.15, until=0.5), Criteria()
    result = simulator.batch([sag] * 3, {"H": 1.0, "beta": [1.0, 1.15, 1.3]}, criteria=c)
    table = result.table()
    assert (len(result), result.failed) == (3, ())
    assert table["beta"].tolist() == [1.0, 1.15, 1.3]
    assert set(table["status"]) == {"completed"}
    single = margins(simulator(sag, H=1.0, beta=1.15), c)
    assert table["loss"][1] == pytest.approx(single.loss.value, rel=1e-7)
    assert table["d_loss/d_beta"][1] == pytest.approx(single.loss.grad["beta"], rel=1e-6)
    assert table["sequence"][1] == " | ".join(single.sequence)
    assert np.all(np.diff(table["loss"]) > 0)  # more converter never loses more


def test_one_waveform_serves_all_and_one_value_too(simulator: Simulator) -> None:
    shared = simulator.batch([flat(0.1)], {"beta": [1.0, 1.2]})
    assert [p["beta"] for p in shared.parameters] == [1.0, 1.2]
    waves = [Waveform.sag(v, 0.02, 0.05, until=0.1) for v in (0.9, 0.8)]
    assert simulator.batch(waves, {"beta": 1.1}, keep=True).runs[1] is not None
    assert len(simulator.batch(waves, {})) == 2


def test_failures_are_kept_and_labelled(simulator: Simulator) -> None:
    sag = Waveform.sag(0.05, 0.1, 0.3, until=0.5)
    result = simulator.batch(
        [sag],
        {"bess.P_dis": [1.2, 0.0], "sup.T_deep": 5.0, "dc.T_hold": 0.01},
        criteria=Criteria(),
        keep=True,
    )
    assert result.failed == (1,)
    assert "DC link" in result.status[1]
    assert "dc.w below 0.36" in result.status[1]
    table = result.table()
    assert np.isnan(table["voltage"][1])
    assert not np.isnan(table["voltage"][0])
    failed = result.runs[1]
    assert failed is not None
    assert failed["dc.w"][-1] == pytest.approx(0.36, abs=1e-6)


def test_no_equilibrium_is_a_labelled_row() -> None:
    result = Simulator(store()).batch([Waveform.sag(0.5, 0.1, 0.1, until=0.3)], {"P": [1.0, 2.0]})
    assert result.failed == ()
    dead = Simulator(facility.gfl().compile()).batch(
        [Waveform.segments([(0.0, 0.02)], until=0.1)], {"beta": [1.1]}, criteria=Criteria()
    )
    assert dead.failed == (0,)
    assert dead.margins == (None,)
    assert dead.table()["status"][0].startswith("gfl: no equilibrium at the first value of the waveform.")


@pytest.mark.parametrize(
    ("waves", "table", "message"),
    [
        ([], {"beta": 1.0}, "batch: there is nothing to run: waveforms is empty."),
        ([flat()], {"beta": []}, "batch: there is nothing to run: 'beta' is empty."),
        (
            [flat()] * 2,
            {"beta": [1.0, 1.1, 1.2]},
            "batch: columns differ in length: 'beta' has 3, waveforms has 2. "
            "Give one value for all or one per case.",
        ),
        ([flat()], {"beta": [1.0, 9.0, 8.0]}, None),
    ],
)
def test_unusable_tables(simulator: Simulator, waves: list, table: dict, message: str | None) -> None:
    with pytest.raises(InputError) as error:
        simulator.batch(waves, table)
    if message is not None:
        assert str(error.value) == message
    else:
        assert str(error.value).startswith("batch: 2 problems\n  beta = 9 is outside [")


def test_cases_that_begin_alike_fail_alike_and_are_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faults of one operating point share the voltage before them: beta V below d has no equilibrium."""
    from dcvrt.integrators import simulator

    looked: list[float] = []

    def counted(eq: Any, u: Any, p: Any, *more: Any) -> Any:
        looked.append(abs(complex(*u[:2])))
        return equilibrium(eq, u, p, *more)

    equilibrium = simulator.equilibrium
    monkeypatch.setattr(simulator, "equilibrium", counted)
    sim = Simulator(facility.gfl().compile(), save_at=2e-3)
    sags = [Waveform.segments([(0.0, 0.95), (0.1, v), (0.2, 0.95)], until=0.4) for v in (0.6, 0.7, 0.8)]
    low = Waveform.segments([(0.0, 0.93), (0.1, 0.6), (0.2, 0.93)], until=0.4)
    found = sim.batch([*sags, low, sags[0]], {"beta": [1.0, 1.0, 1.0, 1.0, 1.3], "H": 1.0})
    assert len(looked) == 2
    assert len(set(found.status[:3])) == 1
    assert found.status[0].startswith("gfl: no equilibrium")
    assert found.status[3] != found.status[0]  # its residuals are others
    assert found.status[4].startswith("completed")
    assert list(found.started) == [False] * 4 + [True]
