"""How far margins move when facilities act back on the network during the fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dcvrt.criteria import Criteria
from dcvrt.grid.grid import Grid
from dcvrt.grid.period import Period
from dcvrt.integrators.simulator import Simulator
from dcvrt.models import Diagram
from dcvrt.waveform import Waveform

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.grid.faults import Fault


def compare(
    grid: Grid,
    hosting: Mapping[int, float],
    facility: Diagram,
    faults: Sequence[Fault],
    period: Period | None = None,
    criteria: Criteria | None = None,
    until: float = 2.5,
) -> pd.DataFrame:
    """Margins of every open site under every fault, open and closed loop.

    In the open loop hosted load is a constant impedance in the fault; in the closed loop the facilities are
    ports of the network, with their control, limits and supervisor. The facility's own run is the same in
    both, on the waveform of its site.

    Parameters
    ----------
    grid : Grid
    hosting : mapping of site to MW
        Sites without capacity have no facility and no row.
    facility : Diagram
        With its rating set: ``facility.set("beta", 1.2)``.
    faults : sequence of BusFault, LineTrip or FaultSequence
    period : Period, optional
        Reference load when not given.
    criteria : Criteria, optional
    until : float
        End, s.

    Returns
    -------
    DataFrame
        One row a fault and site: `fault`, `site`, and for each loop `v_poi_min` (pu), `voltage` (margin, pu),
        `loss` (margin, share of load), `passed`, with endings `_open` and `_closed`; `same_sequence`, whether
        the modes followed one another alike; `status`, empty where both loops have margins.

    Raises
    ------
    InputError, SimulationError, InfeasibleError
        As `Grid.waveforms_of`. A fault that does not reach its end has a row with its status and no margins.
    """
    import pandas as pd

    period, criteria = period or Period(), criteria or Criteria()
    compiled = facility.compile()
    sites = [bus for bus, mw in hosting.items() if mw > 0]
    coupled = dict.fromkeys(sites, compiled)
    loops = {
        "open": grid.waveforms_of(hosting, period, faults, until),
        "closed": grid.waveforms_of(hosting, period, faults, until, facilities=coupled),
    }
    simulator = Simulator(compiled)
    pf = {"pf": grid.pf} if "pf" in compiled.p_names else {}
    rows = []
    for fault in dict.fromkeys(faults):
        runs = {loop: found[fault] for loop, found in loops.items()}
        failed = [run.status for run in runs.values() if not run.completed]
        for site in sites:
            row: dict[str, object] = {"fault": fault.label, "site": site, "status": "; ".join(failed)}
            sequences = []
            for loop, run in runs.items():
                if failed:
                    continue
                margins, status = _margins(simulator, run[site], criteria, {"d": period.dc_factor, **pf})
                row["status"] = row["status"] or status
                row |= {f"{name}_{loop}": value for name, value in margins.items() if name != "sequence"}
                sequences.append(margins.get("sequence"))
            row["same_sequence"] = len(sequences) == 2 and sequences[0] == sequences[1]
            rows.append(row)
    return pd.DataFrame(rows)


def _margins(
    simulator: Simulator, waveform: Waveform, criteria: Criteria, parameters: Mapping[str, float]
) -> tuple[dict[str, object], str]:
    """Margins of one run, and why there are none."""
    result = simulator.batch([waveform], {"H": 1.0, **parameters}, criteria=criteria)
    found = result.margins[0]
    lowest = float(np.abs(waveform.v).min())
    if found is None:
        return {"v_poi_min": lowest}, result.status[0]
    passed = found.voltage.value >= 0 and found.loss.value >= 0
    return {
        "v_poi_min": lowest,
        "voltage": found.voltage.value,
        "loss": found.loss.value,
        "passed": passed,
        "sequence": tuple(entry.split(" [")[0] for entry in found.sequence),
    }, ""
