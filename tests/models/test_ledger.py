"""The ledger adds; what it is told stores and loses energy is counted once."""

from __future__ import annotations

import pytest

from dcvrt.models import Bess, DcLink, Input, UpsAndDriveLedger, UpsLedger

approx = pytest.approx


@pytest.mark.parametrize("kind", [UpsLedger, UpsAndDriveLedger])
def test_it_adds_energies_and_losses_apart(kind):
    ledger = kind()
    entries = ledger.declared(Input)
    values = {name: 10.0**k for k, name in enumerate(entries)}
    out = ledger.equations(ledger.at(**values)).out
    stored = sum(v for name, v in values.items() if name.endswith("_energy"))
    lost = sum(v for name, v in values.items() if name.endswith("_loss"))
    assert (out["stored"], out["loss"]) == (approx(stored), approx(lost))
    assert stored + lost == approx(sum(values.values()))


def test_the_dc_link_and_the_battery_tell_what_they_store():
    dc = DcLink(T_hold=0.04, H=2.0, eta=0.9)
    eq = dc.equations(dc.at(w=0.8, p_g=1.0, p_b=0.3, p_out=0.9))
    assert eq.out["energy"] == approx(0.04 * 2.0 * 0.8)
    assert eq.out["loss"] == approx(0.1)
    assert eq.der["w"] * 0.04 * 2.0 == approx(1.0 + 0.3 - 0.9 - eq.out["loss"])
    bess = Bess(T_E=100.0, H=2.0)
    eq = bess.equations(bess.at(w=1.0, drain=0.9, p_g=0.9, assist=0.0, charge=1.0, p=0.4, soc=0.7))
    assert (eq.out["energy"], eq.out["loss"]) == (approx(140.0), 0.0)
    assert eq.der["soc"] * 100.0 * 2.0 == approx(-0.4)
