"""What is told about a hosting problem: the plan with its prices, and why there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.planning.agreement import GUARD
from dcvrt.planning.certificate import TOLERANCE_MW, Hours
from dcvrt.planning.hour import FlowCut
from dcvrt.planning.master import Master, Solution
from dcvrt.planning.plan import AcVerdict, Binding, Certificate, Plan, Row, VoltageInfo
from dcvrt.planning.voltage_screen import Tangent

if TYPE_CHECKING:
    from dcvrt.planning.hosting import HostingProblem

Floats = npt.NDArray[np.float64]

NO_PRICE = 1e-7
"""Price below which a limit is not reported, MW per pu, MW, MVA or share of load."""
CLOSED_MW = 1e-7
AC_TOLERANCE = 1e-6
"""Violation of a voltage limit that the AC check lets pass, pu."""
PROGRAMMES = 300
"""Dispatch programmes spent on finding which hours of an infeasible base case are short."""


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
    binding = _binding(problem, master, solution)
    return Plan(
        float(H.sum()),
        by_site,
        binding,
        _closed(master, solution, by_site, binding),
        certificate,
        gap,
        voltage,
    )


def _binding(problem: HostingProblem, master: Master, solution: Solution) -> tuple[Binding, ...]:
    """Every limit with a price; limits that several cuts share are added up."""
    found: dict[tuple[object, ...], Binding] = {}

    def add(binding: Binding) -> None:
        key = (binding.kind, binding.label, binding.hour)
        more = found[key].price if key in found else 0.0
        found[key] = Binding(**{**vars(binding), "price": binding.price + more})

    for cut, price in zip(master.cuts, solution.cut_price, strict=True):
        if price <= NO_PRICE:
            continue
        if isinstance(cut.origin, FlowCut):
            for binding in _flow_bindings(problem, cut.origin, price):
                add(binding)
        elif isinstance(cut.origin, Tangent):
            t, screen = cut.origin, problem.screen
            assert screen is not None
            bus = int(problem.network.bus[screen.pq[t.bus]])
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
    for row, price in zip(master.rows, solution.row_price, strict=True):
        if price > NO_PRICE:
            unit = f"MW per {row.unit or 'unit of the row'}"
            add(Binding("row", row.label, float(price), unit, row.lower, bus=row.site))
    for bus, limit, price in zip(master.sites, master.upper, solution.bound_price, strict=True):
        if price > NO_PRICE:
            add(Binding("bound", f"largest size of site {bus}", float(price), "MW/MW", float(limit), bus=bus))
    return tuple(sorted(found.values(), key=lambda b: (-b.price, b.kind, b.label)))


def _flow_bindings(problem: HostingProblem, cut: FlowCut, price: float) -> list[Binding]:
    """Lines and units behind a flow cut, in the hour in which it is tightest."""
    network, year = problem.network, problem.year
    at = int(problem.certifier.corners[problem.certifier.bound(cut).argmin()])
    hour, per_mw = int(year.hours[at]), price / year.dc[at]
    lines, units = network.branches, network.generators
    found = [
        Binding("line", lines.label(b), float(weight * per_mw), "MW/MVA", float(lines.rating[b]), hour)
        for b, weight in cut.lines
        if weight * per_mw > NO_PRICE
    ]
    for g, weight, at_maximum in cut.units:
        limit = units.p_max[g] if at_maximum else units.p_min[g]
        if weight * per_mw > NO_PRICE and (at_maximum or limit != 0):
            what = "p_max" if at_maximum else "p_min"
            found.append(
                Binding(
                    "generator",
                    f"{units.name[g]} {what}",
                    float(weight * per_mw),
                    "MW/MW",
                    float(limit),
                    hour,
                    int(units.bus[g]),
                )
            )
    return found


def _closed(
    master: Master, solution: Solution, by_site: dict[int, float], binding: tuple[Binding, ...]
) -> dict[int, str]:
    """Sites without a facility, each with the requirement that opening it would break, if any."""
    reasons = {}
    for i, bus in enumerate(master.sites):
        if by_site[bus] > 0:
            continue
        opened = {**by_site, bus: float(master.lower[i])}
        broken = sorted(
            (row for row in master.rows if row.site == bus and row.value(opened) < 0),
            key=lambda row: row.value(opened),
        )
        if broken:
            others = len(broken) - 1
            more = f", and {others} more margin{'s' * (others > 1)} fall{'s' * (others == 1)} short"
            short = f"{-broken[0].value(opened):.4g} {broken[0].unit}".rstrip()
            reasons[bus] = (
                f"{broken[0].label}: {short} short at {opened[bus]:g} MW beside the other sites"
                f"{more if others else ''}"
            )
        elif master.upper[i] == 0:
            reasons[bus] = "its largest size is 0 MW"
        else:
            limits = ", ".join(f"{b.kind} {b.label}" for b in binding[:3]) or "the other sites"
            reasons[bus] = f"hosting here gains nothing within the shared limits ({limits})"
    return reasons


def ac_verdict(problem: HostingProblem, found: Plan, H: Floats) -> AcVerdict:
    """Judge a plan by AC power flow in every hour."""
    solved = problem.ac.solve(H)
    pq = problem.ac.flow.pq
    good = np.flatnonzero(solved.converged)
    size = abs(solved.v[np.ix_(pq, good)])
    screen = problem.screen
    if screen is None:
        low, high = np.zeros(size.shape), np.full(size.shape, np.inf)
    else:
        low, high = screen.lower[:, good], screen.upper[:, good]
    if not len(good):
        return AcVerdict(False, np.nan, np.nan, np.nan, None, None, solved.status)
    room = np.minimum(size - low, high - size)
    row, k = np.unravel_index(room.argmin(), room.shape)
    hour, bus = int(problem.year.hours[good[k]]), int(problem.network.bus[pq[row]])
    error = np.nan
    if found.voltage is not None:
        true, linear = room.min(axis=0), found.voltage.room[good]
        error = float(abs(true - linear)[np.minimum(true, linear) < GUARD].max(initial=0.0))
    inside = bool(room[row, k] >= -AC_TOLERANCE)
    if not solved.converged.all():
        status = solved.status
    elif screen is None:
        status = f"All {len(problem.year)} hours solve; no voltage limits were set."
    elif inside:
        status = f"All {len(problem.year)} hours solve with every voltage within its limits."
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


def base_case(hours: Hours, rating_scale: float) -> str:
    """Say which hours have no dispatch with nothing hosted, where, and by how much."""
    network, year = hours.network, hours.year
    demand = -hours.fixed.sum(axis=0)
    nothing = np.zeros(len(hours.sites))
    todo = np.argsort(-demand, kind="stable")
    short: dict[int, float] = {}
    worst: tuple[float, int, FlowCut] | None = None
    spent = 0
    while len(todo) and spent < PROGRAMMES:
        at = int(todo[0])
        found = hours.dispatch(nothing, at)
        spent += 1
        if found.shortfall > TOLERANCE_MW:
            if worst is None or found.shortfall > worst[0]:
                worst = found.shortfall, at, found.cut
            least = found.cut.pi @ hours.fixed[:, todo] + found.cut.constant
            lost = least > TOLERANCE_MW
            lost[0] = True
            short.update({int(t): float(mw) for t, mw in zip(todo[lost], least[lost], strict=True)})
            todo = todo[~lost]
        else:
            todo = todo[1:]
    assert worst is not None
    amount, at, cut = worst
    count = f"{'at least ' if len(todo) else ''}{len(short)} of {len(year)} hours"
    first = ", ".join(str(h) for h in sorted(int(year.hours[t]) for t in short)[:5]) + (
        ", ..." if len(short) > 5 else ""
    )
    lines = network.branches
    if cut.lines:
        where = ", ".join(
            f"{lines.label(b)} (rated {lines.rating[b]:.4g} MVA)"
            for b, _ in sorted(cut.lines, key=lambda item: -item[1])[:4]
        )
        cause = f"branches are overloaded by {amount:.4g} MW whatever the dispatch: {where}"
        way = f"a larger rating_scale (now {rating_scale:g}), or more generation behind these branches"
    else:
        units = network.generators
        cause = (
            f"units that give {units.p_min.sum():.5g} to {units.p_max.sum():.5g} MW cannot meet a net load "
            f"of {demand[at]:.5g} MW ({amount:.4g} MW off)"
        )
        way = "more units, or other limits of theirs"
    return (
        f"{network.name}: the base case has no dispatch in {count} (hours {first}) with nothing hosted.\n"
        f"  Worst hour {int(year.hours[at])}: {cause}.\nWays out: {way}, or leave these hours out."
    )


def no_plan(rows: tuple[Row, ...]) -> str:
    """Say that rows which belong to no site exclude every plan."""
    general = [row.label for row in rows if row.site is None]
    listed = ", ".join(general[:6]) + (", ..." if len(general) > 6 else "")
    return (
        "No capacities meet all requirement rows, not even with every site closed. Rows that hold for "
        f"every plan: {listed or 'none'}. Ways out: give a row the site that it belongs to, so that the site "
        "can be closed, or relax its limit."
    )
