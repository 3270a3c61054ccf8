"""Hosting capacity over all operating hours: the largest loads that every limit of the network allows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InfeasibleError, did_you_mean, raise_all
from dcvrt.grid.network import Network
from dcvrt.planning import monolith, report
from dcvrt.planning.agreement import Agreement
from dcvrt.planning.certificate import Hours
from dcvrt.planning.hour import FlowCut
from dcvrt.planning.master import Cut, Master, Solution
from dcvrt.planning.plan import AcVerdict, Certificate, Plan, Row, VoltageInfo
from dcvrt.planning.profiles import Year
from dcvrt.planning.voltage_screen import HostedFlow, Tangent, VoltageScreen

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SCREENS = ("relinearised", "one-shot")
BASE_VIOLATIONS = ("error", "hold")
VOLTAGE_ROW_TOLERANCE = 1e-10
"""Violation of a linear voltage limit below which no cut is added, pu."""
TOTAL_TOLERANCE = 1e-7
"""Difference of two totals that does not matter, MW."""


class HostingProblem:
    r"""The largest total load that sites can host while every limit holds in every hour.

    .. math::
        \max \sum_i H_i \quad\text{s.t. in every hour } t:\quad
        |f_l(P^w_t + C_g g_t - P_t - d_t C H)| \le \overline S_l, \quad
        \mathbf 1\cdot g_t = \mathbf 1\cdot(P_t - P^w_t) + d_t \mathbf 1\cdot H, \quad
        \underline g \le g_t \le \overline g, \quad
        \underline V \le V_{\ell,t}(H) \le \overline V

    Paper: eqs. (objective)-(voltage_proxy_limit). Solved exactly by cuts that all hours share: a small master
    over H, one dispatch programme whose dual forbids H in every hour at once, and voltage rows found by one
    product. A plan is returned when every hour is certified. Cuts are kept, so that solving again with other
    rows is quick. Differs: the voltage rows are linearised again at the optimum until AC power flow agrees.

    Parameters
    ----------
    network : Network
    sites : sequence of int
        Bus numbers of the candidate sites.
    hours : Year
        Operating hours, or a window of them.
    rating_scale : float
        Factor on every branch rating.
    voltage : (float, float) or None
        Limits at every `pq` bus in every hour, pu; None leaves voltages out.
    pf : float
        Power factor of the hosted load, lagging.
    h_max, min_size : float or mapping of bus number to float
        Largest capacity of a site, and the smallest that is worth opening it, MW.
    voltage_screen : str
        `relinearised`: repeated until AC power flow agrees. `one-shot`: linearised once with nothing
        hosted, as the paper prints it; it can overstate the capacity.
    base_violations : str
        What to do with voltages outside the limits before anything is hosted. `error`: raise. `hold`: they
        must only not get worse; `plan.voltage.widened` counts them.
    hull : bool
        Look at the corner hours of the convex hull of the operating parameters only, which is exact and
        quicker.

    Raises
    ------
    InputError
        With everything that is wrong with the arguments.
    """

    def __init__(
        self,
        network: Network,
        sites: Sequence[int],
        hours: Year,
        rating_scale: float = 1.0,
        voltage: tuple[float, float] | None = (0.94, 1.06),
        pf: float = 0.98,
        h_max: float | Mapping[int, float] = 500.0,
        min_size: float | Mapping[int, float] = 0.0,
        *,
        voltage_screen: str = "relinearised",
        base_violations: str = "error",
        hull: bool = True,
    ) -> None:
        sites = tuple(sites)
        problems = _argument_faults(
            network, sites, hours, rating_scale, voltage, pf, voltage_screen, base_violations
        )
        upper = _per_site("h_max", h_max, sites, problems)
        lower = _per_site("min_size", min_size, sites, problems)
        problems += [
            f"min_size {low:g} MW at site {bus} exceeds its h_max {high:g} MW."
            for bus, low, high in zip(sites, lower, upper, strict=True)
            if low > high
        ]
        raise_all(problems, "hosting problem")
        lines = network.branches
        self.network = replace(network, branches=replace(lines, rating=lines.rating * rating_scale))
        self.sites, self.year, self.rating_scale = sites, hours, rating_scale
        self.voltage, self.pf, self.voltage_screen = voltage, pf, voltage_screen
        self.lower, self.upper = lower, upper
        self._base_violations, self._hull = base_violations, hull
        self._flow_cuts: list[FlowCut] = []
        self._voltage_keys: dict[tuple[int, int, int], None] = {}

    # -- the pieces, built when first needed ---------------------------------------------------------------

    @cached_property
    def certifier(self) -> Hours:
        """The hours as dispatch problems; raises `InfeasibleError` when the base case has no dispatch."""
        hours = Hours(self.network, self.network.indices(self.sites), self.year, self._hull)
        if hours.certify(np.zeros(len(self.sites))) is not None:
            raise InfeasibleError(report.base_case(hours, self.rating_scale))
        return hours

    @cached_property
    def ac(self) -> HostedFlow:
        """AC power flow of the hours at any capacities."""
        return HostedFlow(self.network, self.sites, self.year, self.pf)

    @cached_property
    def screen(self) -> VoltageScreen | None:
        """The linear voltages; raises `InfeasibleError` when the base case violates the limits."""
        if self.voltage is None:
            return None
        return VoltageScreen(self.ac, self.voltage, self._base_violations)

    # -- solving -------------------------------------------------------------------------------------------

    def solve(
        self, rows: Iterable[Row] = (), bounds: Mapping[int, tuple[float, float]] | None = None
    ) -> Plan:
        """Find the largest plan.

        Parameters
        ----------
        rows : iterable of Row
            Further requirements, for instance ride-through margins. A row that belongs to a site holds only
            while the site is open: where it cannot be met, the site is closed and `plan.closed` says so.
        bounds : mapping of bus number to (low, high), optional
            Range in which an open site must lie, MW, for instance the sampled domain of a surrogate; it
            narrows `min_size` and `h_max`.

        Returns
        -------
        Plan

        Raises
        ------
        InputError
            When a row or a bound names no site or is not finite.
        InfeasibleError
            When the base case breaks a limit, or rows that belong to no site exclude every plan.
        SimulationError
            When voltages do not settle, which happens close to the limit of power transfer.
        """
        rows = tuple(rows)
        lower, upper = self._box(bounds or {})
        raise_all(_row_faults(rows, self.sites), "requirement rows")
        master = Master(self.sites, lower, upper, rows)
        hours, screen = self.certifier, self.screen
        master.cuts = [self._as_cut(cut) for cut in self._flow_cuts]
        if screen is not None:
            master.cuts += [_tangent_cut(screen.tangent(*key)) for key in self._voltage_keys]
        best: tuple[Solution, Certificate, VoltageInfo | None] | None = None
        tried: set[tuple[bool, ...]] = set()
        gap = 0.0
        while True:
            chosen = master.choose() if master.may_close else _all_open(len(self.sites))
            if chosen is None:
                break
            more = np.inf if best is None else chosen.total - best[0].total
            if more <= TOTAL_TOLERANCE or tuple(chosen.open) in tried:
                gap = 0.0 if best is None else max(0.0, more) / max(best[0].total, 1.0)
                break
            tried.add(tuple(chosen.open))
            floor = -np.inf if best is None else best[0].total + TOTAL_TOLERANCE
            agreement = None if screen is None else Agreement(screen, self.voltage_screen == "relinearised")
            settled = self._settle(master, chosen.open, floor, agreement)
            if settled is not None:
                best = settled, hours.certificate, None if agreement is None else agreement.info(settled.H)
            if not master.may_close:
                break
        if best is None:
            raise InfeasibleError(report.no_plan(rows))
        solution, certificate, voltage = best
        return report.plan(self, master, solution, certificate, voltage, gap)

    def _settle(
        self, master: Master, is_open: Flags, floor: float, agreement: Agreement | None
    ) -> Solution | None:
        """Optimum for given open sites, all hours certified; None when there is none above `floor` MW."""
        while True:
            solution = master.solve(is_open)
            if solution is None or solution.total <= floor:
                return None
            if agreement is not None:
                violated = agreement.screen.violated(solution.H, VOLTAGE_ROW_TOLERANCE)
                if violated:
                    master.cuts += [_tangent_cut(tangent) for tangent in violated]
                    self._voltage_keys.update(dict.fromkeys(tangent.key for tangent in violated))
                    continue
            cut = self.certifier.certify(solution.H)
            if cut is not None:
                fresh = self._as_cut(cut)
                if fresh.a @ solution.H <= fresh.b:
                    raise RuntimeError("A dispatch programme is short of power but its dual does not say so.")
                self._flow_cuts.append(cut)
                master.cuts.append(fresh)
                continue
            if agreement is None or agreement.reached(solution, master):
                return solution

    def _as_cut(self, cut: FlowCut) -> Cut:
        """A flow cut in the hour in which it is tightest."""
        return Cut(-cut.pi[self.certifier.sites], float(self.certifier.bound(cut).min()), cut)

    def _box(self, bounds: Mapping[int, tuple[float, float]]) -> tuple[Floats, Floats]:
        lower, upper, problems = self.lower.copy(), self.upper.copy(), []
        for bus, (low, high) in bounds.items():
            if bus not in self.sites:
                problems.append(f"{bus!r} is not a site.{did_you_mean(bus, self.sites)}")
            elif not 0 <= low <= high < np.inf:
                problems.append(
                    f"the range of site {bus} is {low:g} to {high:g} MW; "
                    "it must be ascending and not negative."
                )
            else:
                i = self.sites.index(bus)
                lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
                if lower[i] > upper[i]:
                    problems.append(
                        f"the range of site {bus}, {low:g} to {high:g} MW, has nothing in common with "
                        f"its sizes {self.lower[i]:g} to {self.upper[i]:g} MW."
                    )
        raise_all(problems, "bounds")
        return lower, upper

    # -- checking ------------------------------------------------------------------------------------------

    def dispatch(self, plan: Plan, hour: int) -> Floats:
        """Unit outputs that serve an hour of the year within all limits of branches and units, MW."""
        at = int(self.year.positions([hour])[0])
        found = self.certifier.dispatch(self._vector(plan), at)
        if found.shortfall > self.certifier.certificate.tolerance_mw:
            raise InfeasibleError(
                f"hour {hour}: these capacities have no dispatch, {found.shortfall:.4g} MW are short."
            )
        return found.units

    def check_ac(self, plan: Plan) -> AcVerdict:
        """AC power flow of a plan in every hour, against the voltage limits."""
        return report.ac_verdict(self, plan, self._vector(plan))

    def _vector(self, plan: Plan) -> Floats:
        return np.array([plan.by_site[bus] for bus in self.sites])

    def write_mps(
        self,
        path: str | Path,
        hours: Iterable[int] | None = None,
        rows: Sequence[Row] = (),
        around: Plan | None = None,
    ) -> None:
        """Write the problem whole, angles and all rows, for any solver to check.

        Parameters
        ----------
        path : str or Path
            File to write (.mps).
        hours : iterable of int, optional
            Hours of the year; default all. A week is about 70 000 rows.
        rows : sequence of Row
            As in `solve`.
        around : Plan, optional
            Point at which the voltage rows are linearised; default nothing hosted.
        """
        raise_all(_row_faults(tuple(rows), self.sites), "requirement rows")
        at = np.arange(len(self.year)) if hours is None else self.year.positions(hours)
        point = np.zeros(len(self.sites)) if around is None else self._vector(around)
        monolith.build(self, at, tuple(rows), point).write(path)


def _all_open(count: int) -> Solution:
    """The choice when no site can profit from being closed."""
    nothing = np.zeros(0)
    return Solution(np.zeros(count), np.ones(count, dtype=bool), np.inf, nothing, nothing, nothing)


def _tangent_cut(tangent: Tangent) -> Cut:
    a, b = tangent.cut()
    return Cut(a, b, tangent)


def _argument_faults(
    network: Network,
    sites: tuple[int, ...],
    hours: Year,
    rating_scale: float,
    voltage: tuple[float, float] | None,
    pf: float,
    screen: str,
    base: str,
) -> list[str]:
    known = set(network.bus.tolist())
    problems = [
        f"site {bus!r} is not a bus of {network.name}.{did_you_mean(bus, network.bus)}"
        for bus in sites
        if bus not in known
    ]
    problems += [
        f"wind bus {bus} is not a bus of {network.name}.{did_you_mean(bus, network.bus)}"
        for bus in hours.wind
        if bus not in known
    ]
    if not sites:
        problems.append("needs at least one site.")
    problems += [
        f"site {bus} is listed more than once." for bus in sorted({b for b in sites if sites.count(b) > 1})
    ]
    if not 0 < rating_scale < np.inf:
        problems.append(f"rating_scale is {rating_scale:g}; it must be a finite number above 0.")
    if voltage is not None and not 0 < voltage[0] < voltage[1] < np.inf:
        problems.append(f"voltage limits {voltage[0]:g} to {voltage[1]:g} pu must be positive and ascending.")
    if not 0 < pf <= 1:
        problems.append(f"pf is {pf:g}; it must be above 0 and at most 1.")
    for name, value, choices in (
        ("voltage_screen", screen, SCREENS),
        ("base_violations", base, BASE_VIOLATIONS),
    ):
        if value not in choices:
            problems.append(f"{name} {value!r} is unknown.{did_you_mean(value, choices)}")
    return problems


def _per_site(
    name: str, value: float | Mapping[int, float], sites: tuple[int, ...], problems: list[str]
) -> Floats:
    """A size for every site, from one number or a mapping that names all sites."""
    if isinstance(value, Mapping):
        problems += [
            f"{name} names {bus!r}, which is not a site.{did_you_mean(bus, sites)}"
            for bus in value
            if bus not in sites
        ]
        problems += [f"{name} says nothing about site {bus}." for bus in sites if bus not in value]
        sizes = np.array([float(value.get(bus, 0.0)) for bus in sites])
    else:
        sizes = np.full(len(sites), float(value))
    problems += [
        f"{name} of site {bus} is {mw:g} MW; it must be finite and not negative."
        for bus, mw in zip(sites, sizes, strict=True)
        if not 0 <= mw < np.inf
    ]
    return sizes


def _row_faults(rows: tuple[Row, ...], sites: tuple[int, ...]) -> list[str]:
    problems = []
    for row in rows:
        named = [*row.coefficients, *([] if row.site is None else [row.site])]
        problems += [
            f"row {row.label!r} names {bus!r}, which is not a site.{did_you_mean(bus, sites)}"
            for bus in dict.fromkeys(named)
            if bus not in sites
        ]
        if not np.isfinite([row.lower, *row.coefficients.values()]).all():
            problems.append(f"row {row.label!r} has a coefficient or a limit that is not finite.")
    return problems
