"""The equations of a case as the replay evaluates them: those of ANDES's own loop, to the last bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kvxopt import matrix

from dcvrt.grid import andes
from dcvrt.grid.evaluation import BLOCKS, Evaluation, Jacobian
from tests.grid.live import CASES, FURTHER, fresh, package

COMES_BACK = ("ieee39", "exst1")
"""Cases whose limited states are pulled back from beyond a limit, so that no limiter has to hold them."""


def evaluated(system: Any) -> tuple[Any, ...]:
    """What an evaluation leaves behind: equations, states put onto limits, flags of limiters."""
    dae = system.dae
    flags = [
        np.array(getattr(limit, name), dtype=float)
        for model in system.exist.pflow_tds.values()
        for limit in model.discrete.values()
        for name in limit.export_flags
    ]
    return dae.f.copy(), dae.g.copy(), dae.x.copy(), np.concatenate(flags)


@pytest.mark.parametrize("case", ["ieee118", *CASES, *FURTHER])
def test_equations_are_those_of_andes_wherever_the_states_are(case: str) -> None:
    """On two systems alike, since limiters remember the evaluation before."""
    bus = fresh(case).Bus.idx.v[3]
    theirs, ours = fresh(case, fault=bus), fresh(case, fault=bus)
    evaluate, rng = Evaluation(ours), np.random.default_rng(5)
    x0, y0 = theirs.dae.x.copy(), theirs.dae.y.copy()
    pegged = 0
    for trial in range(8):
        x = x0 + 0.2 * trial * rng.standard_normal(len(x0))
        for limiter in theirs.antiwindups if trial else ():  # beyond one limit or the other
            above = rng.random(len(limiter.state.a)) > 0.5
            x[limiter.state.a] = np.where(above, limiter.upper.v + 0.1, limiter.lower.v - 0.1)
        y = y0 + 0.02 * trial * rng.standard_normal(len(y0))
        for system in (theirs, ours):
            system.dae.x[:], system.dae.y[:] = x, y
            system.vars_to_models()
        theirs.TDS.niter = trial % 3
        theirs.TDS.fg_update(models=theirs.exist.pflow_tds)
        evaluate(trial % 3)
        for of_theirs, of_ours in zip(evaluated(theirs), evaluated(ours), strict=True):
            assert np.array_equal(of_theirs, of_ours, equal_nan=True)
        pegged += int((theirs.dae.x != x).sum())
    assert pegged > 0 or case in COMES_BACK


def with_a_bus_alone() -> Any:
    """A case with a bus that no line joins."""
    system = andes.read(package() / CASES["kundur"][0])
    with andes.quiet():
        system.add("Bus", {"idx": 99, "Vn": 230.0})
        system.setup()
        system.PFlow.run()
        system.TDS.config.no_tqdm = 1
        system.TDS.init()
    assert system.Bus.n_islanded_buses == 1
    return system


@pytest.mark.parametrize("case", ["ieee118", *CASES, *FURTHER, "a bus alone"])
def test_the_jacobian_is_that_of_andes(case: str) -> None:
    system = with_a_bus_alone() if case == "a bus alone" else fresh(case)
    jacobian, dae, rng = Jacobian(system), system.dae, np.random.default_rng(3)
    x0, y0, n, m = dae.x.copy(), dae.y.copy(), int(dae.n), int(dae.m)
    for size in (0.0, 0.02):
        dae.x[:], dae.y[:] = x0 + size * rng.standard_normal(n), y0 + size * rng.standard_normal(m)
        system.vars_to_models()
        system.TDS.fg_update(models=system.exist.pflow_tds)
        values = jacobian()
        ours = np.zeros((n + m, n + m))
        np.add.at(ours, (jacobian.row, jacobian.column), values)
        system.j_update(models=system.exist.pflow_tds)
        parts = [np.array(matrix(getattr(dae, block))) for block in BLOCKS]
        theirs = np.block([parts[:2], parts[2:]])
        assert np.abs(ours - theirs).max() <= 1e-13 * np.abs(theirs).max()
        assert jacobian.own_rates(values) == pytest.approx(np.diag(theirs)[:n], abs=1e-12)
