"""Hosting programme: shared cuts against the monolith that HiGHS solves whole, and the year.

The monolith is the file that `HostingProblem.write_mps` writes, with angles, units and voltage rows of every
hour; HiGHS solves it with its simplex method on one thread. Building either side is not timed; base voltages
and sensitivities, which both need, have their own row.
"""

from __future__ import annotations

import resource
import time

import numpy as np

from benchmarks.harness import Result, result
from dcvrt.grid.network import Network
from dcvrt.planning import HostingProblem, Row, profiles
from dcvrt.planning import monolith as whole
from dcvrt.planning.master import Master, highs

SITES = (21, 75, 106, 108)
SCALE = 0.6


def run(smoke: bool = False) -> list[Result]:
    """Rows of the benchmark; `smoke` takes a day in place of weeks and years."""
    network, year = Network.ieee118(), profiles.ieee118()
    windows = [range(8424, 8448)] if smoke else [range(8400, 8568), range(8030, 8760)]
    rows: list[Result] = []
    for hours in windows[:1] if smoke else windows:
        for voltage in ((0.94, 1.06), None):
            rows.append(_against_monolith(network, year.window(hours), voltage))
    return rows + _whole_year(network, year.window(windows[0]) if smoke else year)


def _against_monolith(network: Network, year: profiles.Year, voltage: tuple[float, float] | None) -> Result:
    problem = HostingProblem(network, SITES, year, SCALE, voltage, voltage_screen="one-shot")
    _ = problem.screen
    start = time.perf_counter()
    plan = problem.solve()
    ours = time.perf_counter() - start
    programme = whole.build(
        problem, np.arange(len(year)), Master(SITES, problem.lower, problem.upper, ()), np.zeros(len(SITES))
    )
    solver = highs()
    solver.setOptionValue("solver", "simplex")
    solver.passModel(programme.highs_model())
    start = time.perf_counter()
    solver.run()
    theirs = time.perf_counter() - start
    total = solver.getInfo().objective_function_value
    case = f"{len(year)} h, {'voltage and line limits' if voltage else 'line limits'}"
    return result(
        case, "solve", ours, "s", "monolith, HiGHS simplex", theirs, abs(plan.total_mw - total) / total
    )


def _whole_year(network: Network, year: profiles.Year) -> list[Result]:
    problem = HostingProblem(network, SITES, year, SCALE)
    case = f"{len(year)} h, voltage and line limits"
    rows = []

    start = time.perf_counter()
    _ = problem.screen
    rows.append(
        result(
            case, "AC power flow and voltage sensitivities of every hour", time.perf_counter() - start, "s"
        )
    )

    start = time.perf_counter()
    plan = problem.solve()
    rows.append(
        result(
            case,
            "solve, certified, agreed with AC",
            time.perf_counter() - start,
            "s",
            error=plan.voltage.v_error_pu if plan.voltage else None,
        )
    )
    assert plan.certificate.hours == len(year)

    problem.solve()
    start = time.perf_counter()
    problem.solve()
    rows.append(result(case, "solve again", time.perf_counter() - start, "s"))

    one_shot = HostingProblem(network, SITES, year, SCALE, voltage_screen="one-shot")
    _ = one_shot.screen
    start = time.perf_counter()
    one_shot.solve()
    rows.append(result(case, "solve, certified, linearised once", time.perf_counter() - start, "s"))

    limit = {bus: (0.0, mw) for bus, mw in plan.by_site.items()}
    betas = np.linspace(1.0, 1.5, 4 if smoke_sized(year) else 22)
    start = time.perf_counter()
    for mode in (0.0, 0.03):
        for beta in betas:
            problem.solve(_made_up_rows(float(beta), mode), bounds=limit)
    rows.append(
        result(case, f"{2 * len(betas)} solves with ride-through rows", time.perf_counter() - start, "s")
    )

    lines = HostingProblem(network, SITES, year, SCALE, None)
    start = time.perf_counter()
    lines.solve()
    rows.append(result(f"{len(year)} h, line limits", "solve, certified", time.perf_counter() - start, "s"))
    rows.append(
        result(
            "all of these", "largest memory", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "MB"
        )
    )
    return rows


def smoke_sized(year: profiles.Year) -> bool:
    """Whether this is the smoke run."""
    return len(year) < 8760


def _made_up_rows(beta: float, mode: float) -> list[Row]:
    """Requirement rows of the shape that ride-through surrogates have, two faults a site. Made up."""
    return [
        Row(
            {other: -2e-4 if other == site else -1e-4 for other in SITES},
            0.9 / beta - (0.70 + mode + 0.03 * i + 0.02 * fault),
            f"margin at {site}, fault {fault}",
            site,
        )
        for i, site in enumerate(SITES)
        for fault in range(2)
    ]
