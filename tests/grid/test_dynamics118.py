"""The rule table of the IEEE 118-bus case: complete, sourced, and physically in order."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.grid import Network
from dcvrt.grid.dynamics118 import RATED_POWER_FACTOR, machines, table

CLASSES = ("large", "medium", "condenser")


def values(kind: str, model: str) -> dict[str, float]:
    return {symbol: figure.value for symbol, figure in table()[kind][model].items()}


def test_every_figure_has_a_unit_and_a_source() -> None:
    for models in table().values():
        for model, symbols in models.items():
            for symbol, figure in symbols.items():
                assert figure.unit, (model, symbol)
                assert figure.source == "illustrative" or "(19" in figure.source, (
                    model,
                    symbol,
                    figure.source,
                )
                assert figure.source != "illustrative" or figure.note or symbol == "Dt", (model, symbol)


@pytest.mark.parametrize("kind", CLASSES)
def test_machine_reactances_and_time_constants_are_in_order(kind: str) -> None:
    g = values(kind, "GENROU")
    assert 0 < g["xl"] < g["xd2"] < g["xd1"] < g["xd"]
    assert g["xl"] < g["xq2"] < g["xq1"] <= g["xq"] <= g["xd"]
    assert 0 < g["Td20"] < g["Td10"]
    assert 0 < g["Tq20"] < g["Tq10"]
    assert 0 <= g["ra"] < 0.02
    assert 0 < g["S10"] < g["S12"]
    assert 1.0 <= g["H_m"] <= 10.0


@pytest.mark.parametrize("kind", CLASSES)
def test_one_subtransient_reactance_in_both_axes(kind: str) -> None:
    g = values(kind, "GENROU")
    assert g["xd2"] == g["xq2"]


def test_saturation_is_that_of_the_cited_exponential() -> None:
    """S = A exp(B (psi - psi_T)) / psi with A = 0.015, B = 9.6, psi_T = 0.9."""
    g = values("large", "GENROU")
    for symbol, psi in (("S10", 1.0), ("S12", 1.2)):
        assert g[symbol] == pytest.approx(0.015 * np.exp(9.6 * (psi - 0.9)) / psi, abs=5e-5)


def test_who_has_what() -> None:
    network = Network.ieee118()
    units = machines(network)
    assert len(units) == 54
    assert {unit.bus for unit in units} == set(network.generators.bus.tolist())
    scheduled = network.generators.p_set > 0
    assert scheduled.sum() == 19
    for unit, generates in zip(units, scheduled, strict=True):
        assert ("TGOV1" in unit.models) == generates
        assert (unit.kind != "condenser") == generates
        assert {"GENROU", "SEXS"} <= set(unit.models)


def test_a_turbine_can_open_as_far_as_its_unit_may_generate() -> None:
    network = Network.ieee118()
    for unit in machines(network):
        if "TGOV1" in unit.models:
            valve = unit.models["TGOV1"]["VMAX"] * unit.s_n
            assert valve > network.generators.p_max[unit.unit] >= network.generators.p_set[unit.unit]
            assert unit.s_n == pytest.approx(network.generators.p_max[unit.unit] / RATED_POWER_FACTOR)


def test_a_unit_without_limits_has_no_rating() -> None:
    network = Network.ieee118()
    units = network.generators
    q_max = units.q_max.copy()
    q_max[0] = np.nan
    object.__setattr__(units, "q_max", q_max)
    with pytest.raises(InputError) as failure:
        machines(network)
    assert str(failure.value) == (
        f"unit {units.name[0]}: rating of nan MVA from its limits. Way out: give p_max and q_max."
    )
