"""What holds for every variant that ships on every scenario that ships; new ones of both are taken in."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dcvrt import Criteria, Simulator, Waveform, facility, margins, scenarios
from dcvrt.integrators import Kernel
from tests.facility.rides import FIXED, audited

approx = pytest.approx
every_variant = pytest.mark.parametrize("name", facility.names())


@cache
def simulator(name: str, rtol: float = 1e-8) -> Simulator:
    return Simulator(audited(facility.get(name)).compile(), Kernel("dp5", rtol, rtol / 100), save_at=5e-3)


@cache
def scenario(name: str) -> Waveform:
    return scenarios.get(name)


# ---- what they are ----------------------------------------------------------------------------------------


@every_variant
def test_it_has_a_page_a_sheet_and_the_fixed_outputs(name):
    diagram = facility.get(name)
    dae = diagram.compile()
    assert dae.y_names[: len(FIXED)] == FIXED
    assert dae.name == name
    assert dae.u_names == ("v_poi.re", "v_poi.im", "g_it")
    assert diagram.doc
    for part in ("What it is:", "What for:", "Left out:"):
        assert part in diagram.page
    sheet = diagram.sheet()
    assert ".. math::" not in sheet
    for row in dae.parameter_rows:
        assert row.doc, row.path
        assert row.source not in ("", "not stated"), row.path
        symbol = row.path.rpartition(".")[2]
        assert re.search(rf"^\| `{symbol}` \| {row.value:g} \| .*{re.escape(row.source)}", sheet, re.M), (
            row.path
        )
    for automaton in dae.automata:
        assert all(re.search(rf"^\| {mode} \|", sheet, re.M) for mode in automaton.modes)


@every_variant
def test_a_flat_start_stays_flat(name):
    run = simulator(name, 1e-10)(Waveform.segments([(0.0, 0.97 * np.exp(0.6j))], until=5.0))
    assert not run.events
    for signal in FIXED:
        assert np.ptp(run[signal]) < 1e-9, signal
    assert np.ptp(run.x[:, :-1], axis=0).max() < 1e-9  # but for the integral of the audit


@every_variant
@pytest.mark.parametrize(("voltage", "d"), [(1.0, 0.95), (0.96, 0.6), (1.04, 0.8)])
def test_all_draw_the_same_at_rest(name, voltage, d):
    """Whatever feeds it, a site at rest imports its demand at its power factor, and loses nothing."""
    ours, gfl = (simulator(n).equilibrium(voltage, d=d) for n in (name, "gfl"))
    same = ("p_g", "q_g", "p_out", "p_load", "p_it", "p_cool", "p_loss", "w_dc")
    if name.startswith("gf"):  # the others let the grid's voltage through, or have no battery
        same += ("v_it", "soc")
    for signal in same:
        assert ours[signal] == approx(gfl[signal], abs=2e-4), signal


# ---- energy -----------------------------------------------------------------------------------------------


@every_variant
@pytest.mark.parametrize("kind", scenarios.names())
def test_the_energy_balance_closes(name, kind):
    """stored = in - out to the integrator's tolerance, both integrated by it."""
    run = simulator(name).attempt(scenario(kind))
    change = run["stored"] - run["stored"][0]
    assert np.abs(change - run["net"]).max() < 1e-8 * (1 + np.abs(run["stored"]).max())  # rtol of the energy
    assert run["p_loss"].min() > -1e-12
    assert run.completed or "collapsed" in run.status or "left" in run.status, run.status


# ---- properties -------------------------------------------------------------------------------------------

sags = st.tuples(st.floats(0.0, 1.25), st.floats(0.03, 0.4), st.floats(-0.5, 0.5))


def shaped(retained: float, length: float, jump: float) -> Waveform:
    return Waveform.segments(
        [(0.0, 1.0), (0.1, retained * np.exp(1j * jump)), (0.1 + length, 1.0)], until=1.0
    )


@every_variant
@settings(max_examples=10)
@given(sag=sags, beta=st.floats(1.05, 1.6))
def test_charge_and_link_stay_within_their_limits(name, sag, beta):
    run = simulator(name).attempt(shaped(*sag), beta=beta)
    assert run["soc"].min() >= 0.0
    assert run["soc"].max() <= 1.0
    if run.completed:
        assert run["w_dc"].min() >= -1e-9


@pytest.mark.parametrize("name", ["line-interactive", "eco-mode", "no-ups"])
@settings(max_examples=10)
@given(sag=sags, beta=st.floats(1.05, 1.5), more=st.floats(0.01, 0.4))
def test_a_larger_rating_never_worsens_the_loss_margin_where_the_grid_is_passed_through(
    name, sag, beta, more
):
    small, large = (simulator(name).attempt(shaped(*sag), beta=b) for b in (beta, beta + more))
    assume(small.completed and large.completed)
    one, other = margins(small, Criteria()), margins(large, Criteria())
    assume(one.sequence == other.sequence)
    assert other.loss.value >= one.loss.value - 2e-3
