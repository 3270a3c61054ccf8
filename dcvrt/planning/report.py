"""What is told about a hosting problem: the plan with its prices, and why there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.planning.agreement import NEAR
from dcvrt.planning.certificate import Hours
from dcvrt.planning.hour import INTACT, FlowCut
from dcvrt.planning.master import Master, Solution
from dcvrt.planning.plan import AcVerdict, Binding, Certificate, Plan, VoltageInfo
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
    S = np.where(H > 0, solution.S, 0.0) if len(solution.S) else solution.S
    rating = dict(zip(problem.sites, S.tolist(), strict=False))
    binding = _binding(problem, master, solution)
    return Plan(
        float(H.sum()),
        by_site,
        binding,
        _closed(master, by_site, rating, binding),
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
                )
            )
    if len(solution.S):
        worth = -solution.row_dual @ master.coefficients[:, master.count : 2 * master.count]
        for bus, price, mva in zip(master.sites, worth, solution.S, strict=True):
            if abs(price) > NO_PRICE:
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


def _closed(
    master: Master, by_site: dict[int, float], rating: dict[int, float], binding: tuple[Binding, ...]
) -> dict[int, str]:
    """Sites without a facility, each with the requirement that opening it would break, if any."""
    reasons = {}
    for i, bus in enumerate(master.sites):
        if by_site[bus] > 0:
            continue
        opened = {**by_site, bus: float(master.lower[i])}
        own = [(row.value(opened, rating), row) for row in master.rows if row.site == bus]
        broken = sorted(((room, row) for room, row in own if room < 0), key=lambda found: found[0])
        if broken:
            others = len(broken) - 1
            more = f", and {others} more margin{'s' * (others > 1)} fall{'s' * (others == 1)} short"
            room, worst = broken[0]
            short = (
                f": {-room:.4g} {worst.unit}".rstrip()
                + f" short at {opened[bus]:g} MW beside the other sites"
            )
            said = short if any([*worst.coefficients.values(), *worst.rating.values()]) else ""
            reasons[bus] = f"{worst.label}{said}{more if others else ''}"
        elif master.upper[i] == 0:
            reasons[bus] = "its largest size is 0 MW"
        elif (alone := _alone(master, i)) < master.lower[i]:
            reasons[bus] = (
                f"its smallest size is {master.lower[i]:g} MW, but the limits leave it at most "
                f"{alone:.4g} MW even alone"
            )
        else:
            limits = ", ".join(f"{b.kind} {b.label}" for b in binding[:3]) or "the other sites"
            reasons[bus] = f"hosting here gains nothing within the shared limits ({limits})"
    return reasons


def _alone(master: Master, i: int) -> float:
    """Largest size that the cuts leave a site when no other is open, MW: no less than it can host."""
    bounds = [cut.b / cut.a[i] for cut in master.cuts if cut.a[i] > 0]
    return float(min([*bounds, master.upper[i]]))


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
        if found.cut is not None and found.shortfall > hours.tolerance:
            if worst is None or found.shortfall > worst[0]:
                worst = found.shortfall, at, found.cut
            least = hours.shortfall(found.cut, todo)
            lost = least > hours.tolerance
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
            f"{lines.label(line.branch)} (rated {hours.limit(line):.4g} MVA"
            + (")" if line.outage == INTACT else f" after the outage of {lines.label(line.outage)})")
            for line in sorted(cut.lines, key=lambda line: -line.weight)[:4]
        )
        cause = f"branches are overloaded by {amount:.4g} MW whatever the dispatch: {where}"
        way = f"a larger rating_scale (now {rating_scale:g}), or more generation behind these branches"
    else:
        low, high = hours.unit_limits(at)
        cause = (
            f"units that give {low.sum():.5g} to {high.sum():.5g} MW cannot meet a net load "
            f"of {demand[at]:.5g} MW ({amount:.4g} MW off)"
        )
        way = "more units, or other limits of theirs"
    return (
        f"{network.name}: the base case has no dispatch in {count} (hours {first}) with nothing hosted.\n"
        f"  Worst hour {int(year.hours[at])}: {cause}.\nWays out: {way}, or leave these hours out."
    )


def no_plan(master: Master) -> str:
    """Say which of the rows that hold for every plan exclude every one, and by how much."""
    general = [row for row, holds in zip(master.rows, master.always, strict=True) if holds]
    forced = [bus for bus, must in zip(master.sites, master.must_open, strict=True) if must]
    missed = master.least_violations()
    if missed is None or not (missed > NO_PRICE).any():
        listed = ", ".join(row.label for row in general[:6]) + (", ..." if len(general) > 6 else "")
        named = f"Rows that hold for every plan: {listed or 'none'}."
    else:
        worst = np.argsort(-missed)
        parts = [
            f"{master.rows[r].label} ({missed[r]:.4g} {master.rows[r].unit}".rstrip() + " short at least)"
            for r in worst[:6].tolist()
            if missed[r] > NO_PRICE
        ]
        named = f"Missed: {', '.join(parts)}."
    others = "every other site" if forced else "every site"
    return (
        f"No capacities meet all requirement rows, not even with {others} closed. {named} "
        "Ways out: give a row the site that it belongs to, so that the site can be closed, "
        + (f"let site {', '.join(map(str, forced))} be closed, " if forced else "")
        + "or relax its limit."
    )


def sizes_too_large(sizes: dict[int, float], share: float) -> str:
    """Say that sites which must be open cannot all have their smallest size."""
    listed = ", ".join(f"{mw:g} MW at {bus}" for bus, mw in sizes.items())
    return (
        f"The smallest sizes of the sites that must be open exceed the limits: {listed}. At most "
        f"{100 * share:.1f} % of them fit together. Ways out: smaller sizes, or let a site close."
    )
