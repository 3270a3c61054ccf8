"""How far margins move when facilities act back on the network during the fault."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dcvrt.criteria import Criteria, Margins
from dcvrt.errors import InfeasibleError, SimulationError
from dcvrt.grid.grid import STEP, Grid
from dcvrt.grid.period import Period
from dcvrt.integrators.simulator import Simulator
from dcvrt.models import Diagram
from dcvrt.planning import replay
from dcvrt.waveform import Waveform

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.dae import Dae
    from dcvrt.grid.fault_run import FaultRun
    from dcvrt.grid.faults import Fault

LOOPS = ("open", "closed")


def compare(
    grid: Grid,
    hosting: Mapping[int, float],
    facility: Diagram,
    faults: Sequence[Fault],
    period: Period | None = None,
    criteria: Criteria | None = None,
    until: float = 2.5,
    step: float = STEP,
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
    until, step : float
        End and sample distance, s.

    Returns
    -------
    DataFrame
        One row a fault and site: `fault`, `site`, and for each loop `v_poi_min` (pu), `voltage` (margin, pu),
        `loss` (margin, share of load), `passed`, with endings `_open` and `_closed`; `same_sequence`, whether
        the modes followed one another alike; `status`, empty where both loops have margins. Where a loop has
        no operating point, a fault does not reach its end or a facility fails, it has no margins.

    Raises
    ------
    InputError
        As `Grid.waveforms_of`.
    """
    import pandas as pd

    period = period or Period()
    simulator = Simulator(facility.compile())
    given = (hosting, period, faults, until, step)
    runs = {loop: _runs(grid, given, simulator if loop == "closed" else None, {}) for loop in LOOPS}
    values = {"pf": grid.pf} if "pf" in simulator.dae.p_names else {}
    sites = [bus for bus, mw in hosting.items() if mw > 0]
    labels = {fault: fault.label for fault in faults}
    at = {"H": 1.0, "d": period.dc_factor, **values}
    return pd.DataFrame(_rows(labels, sites, runs, simulator, at, criteria or Criteria()))


def check_hosting(request: Mapping[str, Any]) -> dict[str, Any]:
    """`dcvrt.planning.replay.check_hosting`, in closed loop where `coupling` of the request is 'closed'.

    Then the facilities of each mode and rating are in the network, which has fault simulations of its own for
    them, by the native engine; waveforms are not kept. Derivatives are total, by the rating too: it moves
    the voltage. A facility that does not start, or leaves its bounds, ends a simulation for all sites.
    """
    if request["coupling"] == "open":
        return replay.check_hosting(request)
    period, hosting, labels = _asked_of(request)
    sites = [int(bus) for bus in request["sites"]]
    grid, wrt = replay._grid_of(request), replay.thetas(request)
    all_sites = {bus: hosting.get(bus, 0.0) for bus in sites}
    answer: dict[str, Any] = {"rows": [], "waveforms": [], "grid": 0, "facility": 0}
    for mode, beta in request["runs"]:
        one = {**request, "runs": [[mode, beta]]}
        dae = replay.simulator_of(mode, request["parameters"].get(mode, {})).dae
        coupled = dict.fromkeys(sites if wrt else hosting, dae)
        asked = (all_sites, period, list(labels), float(request["t_end_s"]), float(request["step_s"]))
        runs = _simulated(grid, asked, coupled, {"beta": float(beta)}, wrt)
        answer["grid"] += len(labels)
        found = {}
        for fault, label in labels.items():
            if isinstance(runs, str) or not runs[fault].completed:
                status = runs if isinstance(runs, str) else runs[fault].status
                answer["rows"] += replay.lost_rows(one, status, "grid", faults=[label])
            else:
                found[label] = runs[fault].waveforms
        if found:
            rows = replay.facility_rows(one, mode, [float(beta)], found)
            answer["rows"] += rows
            answer["facility"] += len(rows)
    return answer


def compare_plan(request: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The same for a plan in one period, at several modes and ratings, by the native engine.

    Parameters
    ----------
    request : mapping of plain data
        As that of `dcvrt.planning.replay.check_hosting`; `engine` and `gradients` are not looked at.

    Returns
    -------
    list of dict
        The rows of `compare`, each with `period`, `mode` and `beta`.
    """
    period, hosting, labels = _asked_of(request)
    grid = replay._grid_of(request)
    asked = (hosting, period, list(labels), float(request["t_end_s"]), float(request["step_s"]))
    open_loop = _runs(grid, asked, None, {})
    found = []
    for mode, beta in request["runs"]:
        simulator = replay.simulator_of(mode, request["parameters"].get(mode, {}))
        runs = {"open": open_loop, "closed": _runs(grid, asked, simulator, {"beta": float(beta)})}
        at = {"H": 1.0, "d": period.dc_factor, "pf": float(request["pf"]), "beta": float(beta)}
        rows = _rows(labels, list(hosting), runs, simulator, at, Criteria(**request["criteria"]))
        found += [{"period": period.name, "mode": mode, "beta": float(beta), **row} for row in rows]
    return found


def lost_rows(request: Mapping[str, Any], status: str) -> list[dict[str, Any]]:
    """Rows of `compare_plan` that stand for a comparison that was not made."""
    return [
        {"period": request["period"]["name"], "mode": mode, "beta": float(beta), "fault": fault}
        | {"site": int(site), "status": status, "same_sequence": False}
        for mode, beta in request["runs"]
        for fault in _labels(request).values()
        for site, mw in zip(request["sites"], request["hosting"], strict=True)
        if mw > 0
    ]


def _asked_of(request: Mapping[str, Any]) -> tuple[Period, dict[int, float], dict[Fault, str]]:
    """Period, capacities of the sites that host anything, and faults with what tables call them."""
    given = dict(request["period"])
    period = Period(wind={int(bus): mw for bus, mw in given.pop("wind").items()}, **given)
    sizes = zip(request["sites"], request["hosting"], strict=True)
    return period, {int(bus): float(mw) for bus, mw in sizes if mw > 0}, _labels(request)


def _labels(request: Mapping[str, Any]) -> dict[Fault, str]:
    return {replay.fault_of(f): replay.fault_label(f) for f in request["faults"]}


Asked = tuple[Mapping[int, float], Period, Sequence["Fault"], float, float]


def _runs(
    grid: Grid, asked: Asked, facility: Simulator | None, values: Mapping[str, float]
) -> Mapping[Fault, FaultRun] | str:
    """Runs of all faults, with a facility at every site that hosts anything or with none; or why there is
    none."""
    sites = [bus for bus, mw in asked[0].items() if mw > 0]
    coupled = {} if facility is None else dict.fromkeys(sites, facility.dae)
    return _simulated(grid, asked, coupled, values)


def _simulated(
    grid: Grid,
    asked: Asked,
    coupled: Mapping[int, Dae],
    values: Mapping[str, float],
    wrt: Sequence[str] = (),
) -> Mapping[Fault, FaultRun] | str:
    """Runs of all faults by the native engine, or why there is none."""
    hosting, period, faults, until, step = asked
    more = values if coupled else {}
    try:
        return grid.waveforms_of(
            hosting, period, faults, until, step=step, wrt=wrt, facilities=coupled, values=more
        )
    except (SimulationError, InfeasibleError) as error:
        return str(error)


def _rows(
    labels: Mapping[Fault, str],
    sites: Sequence[int],
    runs: Mapping[str, Mapping[Fault, FaultRun] | str],
    simulator: Simulator,
    values: Mapping[str, float],
    criteria: Criteria,
) -> list[dict[str, Any]]:
    """One row a fault and site."""
    waveforms: dict[tuple[str, Fault, int], Waveform] = {}
    why: dict[tuple[str, Fault, int], str] = {}
    for loop, fault, site in itertools.product(LOOPS, labels, sites):
        found = runs[loop]
        if isinstance(found, str):
            why[loop, fault, site] = found
        elif found[fault].completed:
            waveforms[loop, fault, site] = found[fault][site]
        else:
            why[loop, fault, site] = found[fault].status
    margins: dict[tuple[str, Fault, int], Margins] = {}
    if waveforms:
        result = simulator.batch(list(waveforms.values()), values, criteria=criteria)
        for case, status, of_case in zip(waveforms, result.status, result.margins, strict=True):
            if of_case is None:
                why[case] = status
            else:
                margins[case] = of_case
    rows = []
    for fault, site in itertools.product(labels, sites):
        cases = {loop: (loop, fault, site) for loop in LOOPS}
        row: dict[str, Any] = {"fault": labels[fault], "site": site}
        row["status"] = "; ".join(dict.fromkeys(why[case] for case in cases.values() if case in why))
        for loop, case in cases.items():
            if case in waveforms:
                row[f"v_poi_min_{loop}"], _ = replay.lowest_voltage(waveforms[case])
            if case in margins:
                voltage, loss = margins[case].voltage.value, margins[case].loss.value
                row |= {f"voltage_{loop}": voltage, f"loss_{loop}": loss}
                row[f"passed_{loop}"] = bool(voltage >= 0 and loss >= 0)
        passed = [tuple(replay.modes_passed(margins[c].sequence)) for c in cases.values() if c in margins]
        row["same_sequence"] = len(passed) == 2 and passed[0] == passed[1]
        rows.append(row)
    return rows
