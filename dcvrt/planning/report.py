"""What is told about a hosting problem: the plan with its prices, and what AC power flow says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.planning.agreement import NEAR
from dcvrt.planning.hour import INTACT, FlowCut
from dcvrt.planning.master import Master, Solution
from dcvrt.planning.plan import AcVerdict, Binding, Certificate, Plan, VoltageInfo
from dcvrt.planning.reasons import why_closed
from dcvrt.planning.security import SecurityInfo
from dcvrt.planning.voltage_screen import Tangent

if TYPE_CHECKING:
    from dcvrt.planning.hosting import HostingProblem

Floats = npt.NDArray[np.float64]

NO_PRICE = 1e-7
"""Price below which a limit is not reported, MW per pu, MW, MVA or share of load."""
CLOSED_MW = 1e-7
AC_TOLERANCE = 1e-6
"""Violation of a voltage limit that the AC check lets pass, pu."""


def plan(
    problem: HostingProblem,
    master: Master,
    solution: Solution,
    certificate: Certificate,
    voltage: VoltageInfo | None,
    gap: float,
) -> Plan:
    """Put the optimum into words and numbers."""
    H = np.where(solution.H > CLOSED_MW, solution.H, 0.0)
    by_site = {bus: float(mw) for bus, mw in zip(problem.sites, H, strict=True)}
    S = np.where(H > 0, solution.S, 0.0) if len(solution.S) else solution.S
    rating = dict(zip(problem.sites, S.tolist(), strict=False))
    binding = _binding(problem, master, solution)
    closed = {
        bus: why_closed(problem, master, site, by_site, rating, _in_the_way(problem, master, solution, site))
        for site, bus in enumerate(problem.sites)
        if by_site[bus] == 0
    }
    return Plan(
        float(H.sum()),
        by_site,
        binding,
        closed,
        certificate,
        gap,
        voltage,
        rating,
        solution.objective,
        _security(problem),
    )


def _security(problem: HostingProblem) -> SecurityInfo | None:
    """What N-1 security covers."""
    outages, rule = problem.certifier.outages, problem.security
    if rule is None:
        return None
    pairs = problem.certifier.dispatcher.pairs
    return SecurityInfo(rule.emergency, len(outages), outages.islanding, pairs)


def _binding(problem: HostingProblem, master: Master, solution: Solution) -> tuple[Binding, ...]:
    """Every limit with a price; limits that several cuts share are added up."""
    found: dict[tuple[object, ...], Binding] = {}

    def add(binding: Binding) -> None:
        key = (binding.kind, binding.label, binding.hour, binding.outage)
        more = found[key].price if key in found else 0.0
        found[key] = Binding(**{**vars(binding), "price": binding.price + more})

    for cut, price in zip(solution.cuts, solution.cut_price, strict=True):
        if price <= NO_PRICE:
            continue
        if isinstance(cut.origin, FlowCut):
            for binding in _flow_bindings(problem, cut.origin, price):
                add(binding)
        elif isinstance(cut.origin, Tangent):
            t, screen = cut.origin, problem.screen
            assert screen is not None
            bus = int(problem.network.bus[screen.moving[t.bus]])
            side = "at least" if t.side < 0 else "at most"
            add(
                Binding(
                    "voltage",
                    f"bus {bus} {side} {t.limit:g} pu",
                    float(price),
                    "MW/pu",
                    t.limit,
                    int(problem.year.hours[t.hour]),
                    bus,
                )
            )
    for row, dual in zip(master.rows, solution.row_dual, strict=True):
        if abs(dual) > NO_PRICE:
            unit = f"MW per {row.unit or 'unit of the row'}"
            limit = row.lower if dual < 0 else row.upper
            price = float(abs(dual))
            add(
                Binding(
                    "row",
                    row.label,
                    price,
                    unit,
                    limit,
                    bus=row.site,
                    fault=row.fault,
                    mode=row.mode,
                    target=row.target,
                    period=row.period,
                )
            )
    if len(solution.S):
        helps = -solution.row_dual[:, None] * master.coefficients[:, master.count : 2 * master.count]
        worth = np.maximum(helps, 0.0).sum(
            axis=0
        )  # what a budget of ratings takes for it stands with the budget
        for bus, price, mva in zip(master.sites, worth, solution.S, strict=True):
            if price > NO_PRICE:
                add(Binding("rating", f"rating of site {bus}", float(price), "MW/MVA", float(mva), bus=bus))
    for what, prices, limits in (
        ("largest", solution.bound_price, master.upper),
        ("smallest", solution.floor_price, master.lower),
    ):
        for bus, limit, price in zip(master.sites, limits, prices, strict=True):
            if price > NO_PRICE:
                add(
                    Binding(
                        "bound", f"{what} size of site {bus}", float(price), "MW/MW", float(limit), bus=bus
                    )
                )
    return tuple(sorted(found.values(), key=lambda b: (-b.price, b.kind, b.label)))


def _flow_bindings(problem: HostingProblem, cut: FlowCut, price: float) -> list[Binding]:
    """Lines and units behind a flow cut, in the hour in which it is tightest."""
    network, hours = problem.network, problem.certifier
    at = int(hours.corners[hours.bound(cut).argmin()])
    hour, per_mw = int(problem.year.hours[at]), price / problem.year.dc[at]
    lines, units = network.branches, network.generators
    found = [
        Binding(
            "line",
            lines.label(line.branch),
            float(line.weight * per_mw),
            "MW/MVA",
            float(hours.limit(line)),
            hour,
            outage="" if line.outage == INTACT else lines.label(line.outage),
        )
        for line in cut.lines
        if line.weight * per_mw > NO_PRICE
    ]
    low, high = hours.unit_limits(at)
    reduced = cut.pi[network.generator_index]
    for g in np.flatnonzero(abs(reduced) * per_mw > NO_PRICE).tolist():
        at_maximum = reduced[g] < 0
        limit = high[g] if at_maximum else low[g]
        if at_maximum or limit != 0:
            found.append(
                Binding(
                    "generator",
                    f"{units.name[g]} {'p_max' if at_maximum else 'p_min'}",
                    float(abs(reduced[g]) * per_mw),
                    "MW/MW",
                    float(limit),
                    hour,
                    int(units.bus[g]),
                )
            )
    return found


def _in_the_way(problem: HostingProblem, master: Master, solution: Solution, site: int) -> Sequence[Binding]:
    """Limits with a price that hosting at a site would lean on, those first that a MW there costs most."""
    cost = np.array([max(cut.a[site], 0.0) for cut in solution.cuts])
    leans = master.coefficients[:, site].copy()
    if len(solution.S):  # a capacity takes a rating with it
        leans += master.coefficients[:, master.count + site]
    per_mw = replace(
        solution,
        S=np.zeros(0),
        cut_price=solution.cut_price * cost,
        row_dual=np.where(solution.row_dual * leans > 0, solution.row_dual * abs(leans), 0.0),
        bound_price=np.zeros(master.count),
        floor_price=np.zeros(master.count),
    )
    return _binding(problem, master, per_mw)


def ac_verdict(problem: HostingProblem, found: Plan, H: Floats) -> AcVerdict:
    """Judge a plan by AC power flow in every hour."""
    solved = problem.ac.solve(H)
    moving = problem.ac.flow.moving
    good = np.flatnonzero(solved.converged)
    size = abs(solved.v[np.ix_(moving, good)])
    screen = problem.screen
    if screen is None:
        low, high = np.zeros(size.shape), np.full(size.shape, np.inf)
    else:
        low, high = screen.lower[:, good], screen.upper[:, good]
    if not len(good):
        return AcVerdict(False, np.nan, np.nan, np.nan, None, None, solved.status)
    room = np.minimum(size - low, high - size)
    row, k = np.unravel_index(room.argmin(), room.shape)
    hour, bus = int(problem.year.hours[good[k]]), int(problem.network.bus[moving[row]])
    error = np.nan
    if found.voltage is not None:
        true, linear = room.min(axis=0), found.voltage.room[good]
        error = float(abs(true - linear)[np.minimum(true, linear) < NEAR].max(initial=0.0))
    inside = bool(room[row, k] >= -AC_TOLERANCE)
    if not solved.converged.all():
        status = solved.status
    elif screen is None:
        status = f"All {len(problem.year)} hours solve; no voltage limits were set."
    elif inside:
        status = f"All {len(problem.year)} hours solve with every voltage within its limits."
        if screen.widened:
            status = (
                f"{status[:-1]}, but for {screen.widened} bus-hours that are outside with nothing hosted and "
                "do not get worse."
            )
    else:
        outside = int((room.min(axis=0) < -AC_TOLERANCE).sum())
        status = (
            f"{outside} of {len(problem.year)} hours have a voltage outside its limits; the worst is "
            f"{size[row, k]:.5f} pu at bus {bus} in hour {hour}."
        )
    reactive, unhosted = problem.ac.reactive_excess(H, solved.v[:, good], good), problem.ac.reactive_unhosted
    if reactive or unhosted:
        status += (
            " Units beyond their reactive limits in the worst hours (the limits are not enforced): "
            f"{reactive}. With nothing hosted: {unhosted}."
        )
    return AcVerdict(
        inside and bool(solved.converged.all()),
        float(size.min()),
        float(size.max()),
        error,
        hour,
        bus,
        status,
        reactive,
        unhosted,
    )
