"""The scripts that users write, as they write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest


def test_build_a_variant_from_blocks() -> None:
    from dcvrt import Diagram, Phasor, facility
    from dcvrt.models import Cooling, Pll

    dae = facility.gfl().compile()
    table = str(dae.parameters)
    assert "pll.K_p" in table
    assert "rad/s/pu(V)" in table

    f = facility.gfm()
    f.replace("cooling", Cooling(T=120.0, rho=0.8))
    f.set("vsm.H_v", 1.0)
    changed = f.compile()
    assert changed.parameter_values()[changed.parameter_number("vsm.H_v")] == 1.0
    assert "vsm.H_v" in str(changed.parameters)
    assert f.sheet().startswith("# gfm")

    d = Diagram("mine")
    d.parameter("H", 1.0, "pu(S)")
    v = d.input("v_poi", "pu(V)", Phasor)
    pll = d.add("pll", Pll(K_p=60.0, K_i=1400.0))
    d.connect(v, pll.v)
    d.output("omega", pll.omega)
    assert d.compile().y_names == ("omega",)


def test_run_it_with_sensitivities(tmp_path: Path) -> None:
    from dcvrt import Criteria, Simulator, Waveform, facility, margins

    sim = Simulator(facility.gfl().compile(), wrt=("beta", "H"), save_at=1e-3)
    sag = Waveform.sag(retained=0.5, start=0.10, length=0.15, until=3.0)
    run = sim(sag, H=1.0, beta=1.10)
    assert run.t.shape == run["v_it"].shape == run.sens["v_it", "beta"].shape
    assert [event.target for event in run.events][:2] == ["MIXED", "NORMAL"]
    assert run.status == "completed"
    run.plot(tmp_path / "ride.svg")
    assert (tmp_path / "ride.svg").stat().st_size > 1000

    c = Criteria(v_it_min=0.90, window=0.020, loss_share=0.25)
    m = margins(run, c)
    assert m.voltage.value > 0
    assert m.loss.value == pytest.approx(
        0.25 - (1 - 1.10 * 0.5 / 0.95), abs=5e-3
    )  # the static law at d = 0.95
    assert m.loss.grad["beta"] == pytest.approx(0.5 / 0.95, rel=0.02)
    assert m.sequence
    assert m.diagnostics["peak_loading"] <= 1.0 + 1e-6

    res = sim.batch([sag] * 3, {"H": 1.0, "beta": [1.0, 1.15, 1.3]}, criteria=c)
    table = res.table()
    assert len(table) == 3
    assert table["loss"].is_monotonic_increasing


def test_waveforms_from_the_grid() -> None:
    from dcvrt import facility
    from dcvrt.grid import BusFault, Grid

    grid = Grid.from_case("ieee118", sites=(21, 75, 106, 108))
    hosting = {21: 31.4, 75: 153.9, 106: 102.4, 108: 104.1}
    fault = BusFault(23, start=1.0, clear=0.1)
    w = grid.waveforms(hosting, fault, until=6.0, engine="native", wrt=("H",))
    assert abs(w[75].at(1.05)) < abs(w[75].at(0.5))
    assert w[75].t.shape == w[75].v.shape == w[75].tangents["H_21"].shape
    assert np.iscomplexobj(w[75].tangents["H_21"])
    coupled = grid.waveforms(hosting, fault, facilities={75: facility.gfm()})
    assert abs(coupled[75].at(1.05)) < abs(coupled[75].at(0.5))


def test_hosting_capacity(tmp_path: Path) -> None:
    from dcvrt.grid import Grid
    from dcvrt.planning import HostingProblem, profiles

    grid = Grid.from_case("ieee118", sites=(21, 75, 106, 108))
    year = profiles.ieee118()
    day = year.window(range(0, 24))
    hp = HostingProblem(
        grid.network, sites=(21, 75, 106, 108), hours=day, rating_scale=0.6, voltage=(0.94, 1.06), pf=0.98
    )
    plan = hp.solve()
    assert plan.total_mw == pytest.approx(sum(plan.by_site.values()))
    assert plan.binding
    hp.write_mps(tmp_path / "check.mps", hours=range(24))
    assert np.isfinite(plan.total_mw)
    assert (tmp_path / "check.mps").stat().st_size > 10_000
