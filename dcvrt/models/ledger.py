"""Ledger of energy: what a facility stores and what it turns into heat, for the audit of its balance."""

from __future__ import annotations

from typing import Any, ClassVar

from dcvrt.models.block import Block, Equations, Input, Output


class EnergyLedger(Block):
    r"""Sum of the energies stored and of the powers lost in the blocks of a facility.

    .. math::
        E = \sum_k E_k, \qquad P^{loss} = \sum_k P^{loss}_k, \qquad
        \dot E = P^g - P^{out} - P^{loss}

    The last equation is not solved: it holds because every block that stores or converts energy keeps its own
    balance, in every mode, and a test of each facility asks for it. Algebraic.
    A ledger for other stores is a subclass that declares one input per entry: inputs in pu(S) s are stored,
    inputs in pu(S) are lost.
    """

    stored = Output("pu(S) s", "energy stored in the facility")
    loss = Output("pu(S)", "power lost inside the facility")

    entries: ClassVar[dict[str, str]] = {"stored": "pu(S) s", "loss": "pu(S)"}

    def equations(self, s: Any) -> Equations:
        def total(unit: str) -> Any:
            return sum(
                (getattr(s, name) for name, d in self.declared(Input).items() if d.unit == unit), start=0.0
            )

        return Equations(out={name: total(unit) for name, unit in self.entries.items()})


class UpsLedger(EnergyLedger):
    """Ledger of a double-conversion UPS: DC link and battery."""

    dc_energy = Input("pu(S) s", "energy of the DC link")
    dc_loss = Input("pu(S)", "loss between DC link and protected bus")
    battery_energy = Input("pu(S) s", "energy of the battery")
    battery_loss = Input("pu(S)", "loss of battery and its converter")


class UpsAndDriveLedger(UpsLedger):
    """Ledger of a double-conversion UPS with the drives of the cooling beside it."""

    drive_energy = Input("pu(S) s", "energy of the DC buses of the drives")
    drive_loss = Input("pu(S)", "loss of the drives")


class SupplyLedger(EnergyLedger):
    """Ledger of servers on AC: what their power supplies hold up."""

    supply_energy = Input("pu(S) s", "energy in the server supplies")


class StandbyLedger(SupplyLedger):
    """Ledger of a UPS that stands beside the grid: its battery, and the server supplies."""

    battery_energy = Input("pu(S) s", "energy of the battery")
    battery_loss = Input("pu(S)", "loss of battery and its converter")
