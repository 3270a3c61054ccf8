"""What the controls of UPSs have in common that leave the load on the grid while it is fit."""

from __future__ import annotations

from typing import Any

from dcvrt.models.automaton import Guard, outside, within
from dcvrt.models.block import Block, Input, Output, Parameter

BAND = "illustrative: +-10 % is the usual bypass window"
THREE_DEGREES = "3 degrees: UFGS 16265, static bypass transfer"


class StandbyControl(Block):
    """Window of the grid, charge of the battery, and what the modes say: subclasses give modes and rows.

    Flags that every subclass has: `away`, the load is off the grid; `handed`, it is carried where the walk-in
    takes it, and `handing` while it does; `charging`; `following`, the inverter turns onto the grid;
    `living`, the inverter is on.
    """

    V_low = Parameter(0.90, "pu(V)", (0.3, 1.0), "leave the grid below", BAND)
    V_high = Parameter(1.10, "pu(V)", (1.0, 1.5), "leave the grid above", BAND)
    V_back = Parameter(0.92, "pu(V)", (0.3, 1.05), "grid healthy above", BAND)
    V_calm = Parameter(1.08, "pu(V)", (0.95, 1.5), "grid healthy below", BAND)
    e_sync = Parameter(
        0.052, "pu(V)", (1e-3, 0.5), "largest voltage across the inverter's axis", THREE_DEGREES
    )
    soc_min = Parameter(0.1, "1", (0.0, 0.9), "charge at which the inverter stops", "illustrative")

    v_f = Input("pu(V)", "measured grid voltage")
    error = Input("pu(V)", "grid voltage across the inverter's axis")
    soc = Input("1", "state of charge")
    walked = Input("1", "share of the load walked in")
    done = Input("1", "1 once all of it is")
    transfer = Output("1", "1: switch away from the grid")
    walk = Output("1", "1: walk the load in")
    share = Output("1", "share of the load that is walked in or handed over")
    charge = Output("1", "1: battery may recharge")
    align = Output("1", "1: inverter follows the grid")
    on = Output("1", "1: inverter on")
    mode = Output("1", "number of the mode, from 0")

    def unfit(self, s: Any) -> Guard:
        """The grid is out of tolerance."""
        return outside(s.v_f, s.V_low, s.V_high)

    def healthy(self, s: Any) -> Guard:
        """The grid is back within the narrower window."""
        return within(s.v_f, s.V_back, s.V_calm)

    def synchronous(self, s: Any) -> Guard:
        """The inverter is in step with it."""
        return within(s.error, -s.e_sync, s.e_sync)

    def says(self, s: Any) -> dict[str, Any]:
        """The outputs that all have."""
        return dict(
            transfer=s.away,
            walk=s.handing,
            share=s.handed + s.handing * s.walked,
            charge=s.charging,
            align=s.following,
            on=s.living,
            mode=s.number,
        )
