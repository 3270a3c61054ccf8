"""The network-coupled ride-through check (paper: Algorithm 1, lines 3 to 7): one hosting vector in one
period.

The grid is rebuilt with the hosted load, every fault is simulated, and the voltage at every site drives the
facility. Samples and replays of plans go through the same function. It takes and gives plain data, so that it
can run in any process.

A facility model is proportional to its size, so it runs on the base S_B = H (H = 1 pu); the size acts through
the voltage waveform. Megawatts are shares times P = d_t H, the load that the grid sees before the fault.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dcvrt.errors import InfeasibleError, SimulationError

if TYPE_CHECKING:
    from dcvrt.criteria import Criteria
    from dcvrt.grid import BusFault, Grid, Period
    from dcvrt.integrators import Simulator
    from dcvrt.waveform import Waveform

MAIN = ("sup", "control")
"""Blocks whose modes say how a facility is fed: a variant has one of them, or is fed in one way only."""
SAVE_AT = 2e-3
"""Distance of the samples of a facility's run, s."""


def check_hosting(request: Mapping[str, Any]) -> dict[str, Any]:
    """Simulate all faults of one hosting vector in one period, and every wanted facility on every waveform.

    Parameters
    ----------
    request : mapping of plain data
        `case`, `dynamics`, `sites`, `pf`, `redispatch`, `reactive_limits`, `step_s`, `t_end_s`: the grid;
        `hosting`: MW by site, in the order of `sites`;
        `period`: {name, hour, load_scale, wind {bus: MW}, dc_factor};
        `faults`: [{bus, t_start_s, t_clear_ms, x_pu}];
        `runs`: [[mode, beta], ...]; `parameters`: {mode: {path: value}}; `criteria`: keywords of `Criteria`;
        `engine`: simulator of the faults, `native` or `andes`;
        `gradients`: True for the derivatives of every margin, with the native engine;
        `keep`: True to give back the voltages of all faults too.

    Returns
    -------
    dict
        `rows`: one for each fault, site and run, with the columns of the store's `margins` (no hosting name);
        with gradients, `gradients` = {`voltage`, `loss`, `v_poi`: {theta: derivative}}, of the voltage margin
        in pu, the loss margin as a share, the lowest POI voltage in pu, by `beta` and every `H_<bus>` in MW;
        `waveforms`: those kept, as keywords of `Store.put_waveform` with `signals`;
        `grid`, `facility`: simulations made.
        A simulation that failed gives rows with ok = 0, its status and no margins.

    Notes
    -----
    The derivative by H_j is total: through power flow, equilibrium of the machines, fault and clearing into
    the voltage, and through the facility into the margin. On its own base the facility does not change with
    its size, so there is no further term by the site's own H.
    """
    period = period_of(request)
    runs = [(mode, float(beta)) for mode, beta in request["runs"]]
    answer: dict[str, Any] = {"rows": [], "waveforms": [], "grid": 0, "facility": 0}
    found: dict[str, Mapping[int, Waveform]] = {}
    for label, waveforms, status in fault_runs(request):
        answer["grid"] += 1
        if waveforms is None:
            answer["rows"] += lost_rows(request, status, "grid", faults=[label])
        else:
            found[label] = waveforms
    for mode in dict.fromkeys(mode for mode, _ in runs) if found else ():
        betas = [beta for m, beta in runs if m == mode]
        rows = facility_rows(request, mode, betas, found)
        answer["rows"] += rows
        answer["facility"] += len(rows)
    if request.get("keep", False):
        answer["waveforms"] = [
            {
                "period": period.name,
                "fault": label,
                "site": site,
                "signals": {"t_s": w.t, "v_re_pu": np.real(w.v), "v_im_pu": np.imag(w.v)},
            }
            for label, waveforms in found.items()
            for site, w in waveforms.items()
        ]
    return answer


def lost_rows(
    request: Mapping[str, Any], status: str, failed_in: str, faults: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Rows that stand for runs that were not made: not ok, no margins, and the reason.

    `failed_in` is 'grid' when there was no waveform, 'task' when the whole task was set aside.
    """
    if faults is None:
        faults = [fault_label(f) for f in request["faults"]]
    return [
        _row(request["period"]["name"], fault, int(site), mode, float(beta), float(H), status, failed_in)
        for fault in faults
        for site, H in zip(request["sites"], request["hosting"], strict=True)
        for mode, beta in request["runs"]
    ]


def fault_of(fault: Mapping[str, Any]) -> BusFault:
    """The fault that an entry of a request describes."""
    from dcvrt.grid import BusFault

    opens = fault.get("opens")
    return BusFault(
        fault["bus"],
        start=fault["t_start_s"],
        clear=1e-3 * fault["t_clear_ms"],
        x_f=fault["x_pu"],
        opens=None if opens is None else (opens[0], opens[1]),
    )


def fault_label(fault: Mapping[str, Any]) -> str:
    """What tables call a fault of a request."""
    return fault_of(fault).label


def prepare_facility(request: Mapping[str, Any]) -> str:
    """Compile the facility of the request's first mode, once per machine; and try the values of its runs.

    A run at rest compiles what runs through faults will need, with the margins and derivatives that the
    request asks for.

    Returns
    -------
    str
        How the facility is evaluated: the compiler, or the interpreter and why.

    Raises
    ------
    InputError
        When the compiler fails, or a facility does not take a rating, the power factor or the data-centre
        factor of the request.
    """
    from dcvrt.waveform import Waveform

    mode, wrt = request["runs"][0][0], thetas(request)
    simulator = simulator_of(mode, {}, wrt)
    betas = [float(beta) for m, beta in request["runs"] if m == mode]
    for beta in betas:
        simulator.dae.parameter_values(
            **request["parameters"].get(mode, {}),
            H=1.0,
            beta=beta,
            d=request["period"]["dc_factor"],
            pf=float(request["pf"]),
        )
    rest = Waveform.from_samples([0.0, request["t_end_s"]], [1.0, 1.0], {q: [0.0, 0.0] for q in wrt[1:]})
    facility_rows(request, mode, [max(betas)], {"none": {request["sites"][0]: rest}})
    return simulator_of(mode, {}).backend


def prepare_grid(request: Mapping[str, Any]) -> None:
    """Make the code of the request's grid simulator, once per machine.

    Raises
    ------
    InputError
        When the compiler fails or the cache cannot be written.
    """
    from dcvrt.grid import andes
    from dcvrt.grid.native.build import network_library

    andes.prepare()  # reads the cases of both engines
    if request["engine"] == "native":
        _ = network_library(), _grid_of(request).native.system.layout  # compiles now


def simulator_of(mode: str, parameters: Mapping[str, float], wrt: tuple[str, ...] = ()) -> Simulator:
    """The facility of a mode with some parameters set, as this process runs it; compiled once."""
    return _simulator(mode, _frozen(parameters), wrt)


def thetas(request: Mapping[str, Any]) -> tuple[str, ...]:
    """What the margins of a request are differentiated by: the rating and every site's size, or nothing."""
    return ("beta", *(f"H_{bus}" for bus in request["sites"])) if request["gradients"] else ()


# -- the two halves ------------------------------------------------------------------------------------------


def hosting_of(request: Mapping[str, Any]) -> dict[int, float]:
    """Hosted capacity by site, MW."""
    return dict(zip(map(int, request["sites"]), map(float, request["hosting"]), strict=True))


def period_of(request: Mapping[str, Any]) -> Period:
    """Operating period of a request."""
    from dcvrt.grid import Period

    given = dict(request["period"])
    wind = {int(bus): mw for bus, mw in given.pop("wind").items()}
    return Period(wind=wind, **given)


def fault_runs(request: Mapping[str, Any]) -> list[tuple[str, Mapping[int, Waveform] | None, str]]:
    """Label, waveforms by site (None when there are none) and status of every fault of a request."""
    labels = {fault_of(f): fault_label(f) for f in request["faults"]}
    try:
        found = _grid_of(request).waveforms_of(
            hosting_of(request),
            period_of(request),
            list(labels),
            until=float(request["t_end_s"]),
            engine=request["engine"],
            step=float(request["step_s"]),
            wrt=thetas(request)[1:],
        )
    except (SimulationError, InfeasibleError) as error:  # the operating point itself has no solution
        return [(label, None, str(error)) for label in labels.values()]
    return [
        (label, found[fault].waveforms if found[fault].completed else None, found[fault].status)
        for fault, label in labels.items()
    ]


def facility_rows(
    request: Mapping[str, Any],
    mode: str,
    betas: Sequence[float],
    waveforms: Mapping[str, Mapping[int, Waveform]],
) -> list[dict[str, Any]]:
    """One mode at several ratings on the waveforms of faults, by label and site, in one batch."""
    period, d = str(request["period"]["name"]), float(request["period"]["dc_factor"])
    hosting, wrt = hosting_of(request), thetas(request)
    simulator = simulator_of(mode, {}, wrt)  # values go with the runs: one simulator serves all of them
    cases = [
        (fault, site, beta) for fault, at_sites in waveforms.items() for site in at_sites for beta in betas
    ]
    result = simulator.batch(
        [waveforms[fault][site] for fault, site, _ in cases],
        {
            **request["parameters"].get(mode, {}),
            "H": 1.0,
            "d": d,
            "pf": float(request["pf"]),
            "beta": [beta for *_, beta in cases],
        },
        criteria=_criteria(_frozen(request["criteria"])),
    )
    rows = []
    outcomes = zip(cases, result.status, result.started, result.margins, strict=True)
    for (fault, site, beta), status, started, found in outcomes:
        failed_in = "facility" if started else "start"
        row = _row(period, fault, site, mode, beta, hosting[site], status, failed_in)
        v_min, dv_min = lowest_voltage(waveforms[fault][site], wrt[1:])
        row |= {"p_mw": d * hosting[site], "v_poi_min_pu": v_min}
        if found is not None:
            share, modes = found.diagnostics["loss_share"], modes_passed(found.sequence)
            row |= {
                "v_margin_pu": found.voltage.value,
                "loss_margin_share": found.loss.value,
                "loss_margin_mw": found.loss.value * row["p_mw"],
                "loss_share": share,
                "loss_mw": share * row["p_mw"],
                "ok": 1,
                "failed_in": "",
                "sequence": ">".join(modes),
                "battery": int("BATTERY" in modes),
                "diagnostics": dict(found.diagnostics)
                | {"voltage_time": found.voltage.time, "loss_time": found.loss.time},
            }
            if wrt:
                row["gradients"] = {
                    "voltage": dict(found.voltage.grad),
                    "loss": dict(found.loss.grad),
                    "v_poi": dv_min,
                }
        rows.append(row)
    return rows


def lowest_voltage(waveform: Waveform, wrt: Sequence[str] = ()) -> tuple[float, dict[str, float]]:
    r"""Lowest magnitude among the samples, and its derivative Re(V* dV)/|V| by each tangent.

    >>> from dcvrt import Waveform
    >>> low, slope = lowest_voltage(
    ...     Waveform.from_samples([0, 1, 2], [1, 0.5j, 1], {"H_21": [0, -1e-3j, 0]}), ["H_21"]
    ... )
    >>> low, slope
    (0.5, {'H_21': -0.001})
    """
    size = np.abs(waveform.v)
    at = int(size.argmin())
    v = waveform.v[at]
    return float(size[at]), {
        name: float((v.conjugate() * waveform.tangents[name][at]).real / size[at]) for name in wrt
    }


def modes_passed(sequence: Sequence[str]) -> list[str]:
    """Modes of the block that decides how a facility is fed, in the order in which they were entered.

    What other automata enter stands between them, with the path of its block.

    >>> modes_passed(("sup: NORMAL", "sup: NORMAL -> MIXED [v_f < V_dip]", "sup: MIXED -> NORMAL [calm]"))
    ['NORMAL', 'MIXED', 'NORMAL']
    >>> modes_passed(("sup: NORMAL", "cooling: RUN", "cooling: RUN -> OUT [v < V_drop]"))
    ['NORMAL', 'cooling OUT']
    """
    steps = [entry.split(" [", 1)[0].split(": ", 1) for entry in sequence]
    paths = [path for path, _ in steps]
    first = next((path for path in [*MAIN, *paths] if path in paths), "")
    return [
        step.rsplit(" -> ", 1)[-1] if path == first else f"{path} {step.rsplit(' -> ', 1)[-1]}"
        for path, step in steps
        if path == first or " -> " in step
    ]


# -- what a process keeps ------------------------------------------------------------------------------------


def _grid_of(request: Mapping[str, Any]) -> Grid:
    sites = tuple(int(bus) for bus in request["sites"])
    return _grid(
        request["case"],
        request["dynamics"],
        sites,
        float(request["pf"]),
        request["redispatch"],
        request["reactive_limits"],
    )


@lru_cache(maxsize=4)
def _grid(
    case: str, dynamics: str | None, sites: tuple[int, ...], pf: float, redispatch: str, reactive_limits: bool
) -> Grid:
    from dcvrt.grid import Grid

    return Grid.from_case(
        case if case == "ieee118" else Path(case),
        sites=sites,
        pf=pf,
        dynamics=dynamics,
        redispatch=redispatch,
        reactive_limits=reactive_limits,
    )


@lru_cache(maxsize=16)
def _simulator(mode: str, parameters: tuple[tuple[str, Any], ...], wrt: tuple[str, ...]) -> Simulator:
    from dcvrt import facility
    from dcvrt.integrators import NoCompilerWarning, Simulator
    from dcvrt.integrators.compiler import find_compiler, say_interpreted

    diagram = facility.get(mode)
    for path, value in parameters:
        diagram.set(path, value)
    simulator = Simulator(diagram.compile(), wrt=wrt, save_at=SAVE_AT)
    with warnings.catch_warnings():  # whoever starts a study is told by `prepare`, not by every worker
        warnings.simplefilter("ignore", NoCompilerWarning)
        if find_compiler() is None:
            say_interpreted()
    return simulator


@lru_cache(maxsize=4)
def _criteria(values: tuple[tuple[str, Any], ...]) -> Criteria:
    from dcvrt.criteria import Criteria

    return Criteria(**dict(values))


def _frozen(values: Mapping[str, Any]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted(values.items()))


# -- rows ----------------------------------------------------------------------------------------------------


def _row(
    period: str, fault: str, site: int, mode: str, beta: float, H: float, status: str, failed_in: str
) -> dict[str, Any]:
    nan = math.nan
    return {
        "period": period,
        "fault": fault,
        "site": site,
        "mode": mode,
        "beta": beta,
        "h_mw": H,
        "p_mw": nan,
        "v_margin_pu": nan,
        "loss_margin_share": nan,
        "loss_margin_mw": nan,
        "loss_share": nan,
        "loss_mw": nan,
        "v_poi_min_pu": nan,
        "status": status,
        "ok": 0,
        "failed_in": failed_in,
        "sequence": "",
        "battery": 0,
        "diagnostics": {},
        "gradients": {},
    }
