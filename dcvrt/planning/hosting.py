"""Hosting capacity over all operating hours: the largest loads that every limit of the network allows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InfeasibleError, InputError, SimulationError, raise_all
from dcvrt.grid.network import Network
from dcvrt.planning import monolith, report
from dcvrt.planning.agreement import Agreement
from dcvrt.planning.arguments import (
    argument_faults,
    hosting_faults,
    per_site,
    unit_faults,
)
from dcvrt.planning.base_case import base_case
from dcvrt.planning.certificate import Hours
from dcvrt.planning.hour import FlowCut
from dcvrt.planning.master import Cut, Master, Solution
from dcvrt.planning.objective import MaxMin, MaxTotal, Objective, Rating
from dcvrt.planning.plan import SETTLED, AcVerdict, Certificate, Plan, Row, VoltageInfo
from dcvrt.planning.profiles import Year
from dcvrt.planning.question import Question, ask
from dcvrt.planning.reasons import refuse_sizes, why_none
from dcvrt.planning.security import N1
from dcvrt.planning.voltage_screen import HostedFlow, Tangent, VoltageScreen

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

VOLTAGE_ROW_TOLERANCE = 1e-10
"""Violation of a linear voltage limit below which no cut is added, pu."""
RESTARTS = 8
"""Linearisations on the way from sizes at which all limits hold to a proposal, where the linear voltages
allow nothing: made elsewhere, with units at other limits, they may understate."""
TOTAL_TOLERANCE = 1e-7
"""Difference of two totals that does not matter, MW."""

Settled = tuple[Solution, Certificate, VoltageInfo | None]
"""An optimum, how its hours were certified, and how voltages agree."""


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
        Limits in every hour at every bus whose voltage can move, pu; None leaves voltages out.
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
    security : N1, optional
        Outages that every hour must survive without redispatch. `plan.security` says what is covered.
    reactive_limits : bool
        Whether the AC power flow keeps units within their reactive limits, by switching buses between
        holding their voltage and giving what they can. Without, voltages at generator buses are held
        whatever that takes, and `check_ac` says how far beyond their limits units are.
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
        security: N1 | None = None,
        reactive_limits: bool = True,
        hull: bool = True,
    ) -> None:
        sites = tuple(sites)
        problems = argument_faults(
            network, sites, hours, rating_scale, voltage, pf, voltage_screen, base_violations
        )
        upper = per_site("h_max", h_max, sites, problems)
        lower = per_site("min_size", min_size, sites, problems)
        problems += [] if security is None else security.faults(network)
        problems += unit_faults(network, hours)
        problems += [
            f"min_size {low:g} MW at site {bus} exceeds its h_max {high:g} MW."
            for bus, low, high in zip(sites, lower, upper, strict=True)
            if low > high
        ]
        raise_all(problems, "hosting problem")
        self.network = network.with_ratings(network.branches.rating * rating_scale)
        self.sites, self.year, self.rating_scale = sites, hours, rating_scale
        self.voltage, self.pf, self.voltage_screen = voltage, pf, voltage_screen
        self.lower, self.upper = lower, upper
        self.security, self.reactive_limits = security, reactive_limits
        self._base_violations, self._hull = base_violations, hull
        self._flow_cuts: list[FlowCut] = []
        self._voltage_keys: dict[tuple[int, int, int], None] = {}
        self._largest: dict[int, float] = {}

    # -- the pieces, built when first needed ---------------------------------------------------------------

    @cached_property
    def certifier(self) -> Hours:
        """The hours as dispatch problems; raises `InfeasibleError` when the base case has no dispatch."""
        hours = Hours(self.network, self.network.indices(self.sites), self.year, self._hull, self.security)
        if hours.certify(np.zeros(len(self.sites))) is not None:
            raise InfeasibleError(base_case(hours, self.rating_scale))
        return hours

    @cached_property
    def ac(self) -> HostedFlow:
        """AC power flow of the hours at any capacities."""
        return HostedFlow(self.network, self.sites, self.year, self.pf, self.reactive_limits)

    @cached_property
    def screen(self) -> VoltageScreen | None:
        """The linear voltages; raises `InfeasibleError` when the base case violates the limits."""
        if self.voltage is None:
            return None
        return VoltageScreen(self.ac, self.voltage, self._base_violations)

    # -- solving -------------------------------------------------------------------------------------------

    def solve(
        self,
        rows: Iterable[Row] = (),
        bounds: Mapping[int, tuple[float, float]] | None = None,
        objective: Objective | None = None,
        rating: Rating | None = None,
        must_open: Sequence[int] = (),
        thorough: bool = True,
    ) -> Plan:
        """Find the best plan. Cuts are kept, so that asking again is quick.

        Parameters
        ----------
        rows : iterable of Row
            Further requirements, for instance ride-through margins or the aggregate loss of a fault. A row
            that belongs to a site holds only while the site is open: where it cannot be met, the site is
            closed and `plan.closed` says so.
        bounds : mapping of bus number to (low, high), optional
            Range in which an open site must lie, MW, for instance the sampled domain of a surrogate or a
            trust region; it narrows `min_size` and `h_max`. A range from 0 to less than `min_size` closes
            the site.
        objective : MaxTotal or MaxMin, optional
            Default the plain total.
        rating : Rating, optional
            Makes the converter ratings unknowns that rows may contain.
        must_open : sequence of int
            Sites that may not be closed: their smallest sizes and their rows hold whatever it costs.
        thorough : bool
            Whether voltages are compared with AC power flow in every hour in which one may be near a limit.
            Without, only the hours are that the screen has nearest: many times quicker, and the plan may
            be too large, which `allows` tells and the next solve then knows.

        Returns
        -------
        Plan

        Raises
        ------
        InputError
            When something names no site or is not finite.
        InfeasibleError
            When the base case breaks a limit, rows that belong to no site exclude every plan, the smallest
            sizes of sites that must be open exceed the limits, or those of all sites do.
        SimulationError
            When voltages do not settle, which happens close to the limit of power transfer.
        """
        question = ask(self.sites, self.lower, self.upper, rows, bounds or {}, objective, rating, must_open)
        plan = self._answer(question, thorough)
        if plan.total_mw == 0 and not (question.rows or bounds):
            refuse_sizes(self, question)
        return plan

    def largest(self, bus: int) -> float:
        """Largest size of a site that the network allows, whatever the other sites then host, MW.

        Asked of a copy, so that the linearisations of this problem stay where they are; kept. Where voltages
        do not settle on the way, nothing is known to be smaller than its `h_max`.
        """
        if bus not in self._largest:
            aside = copy(self)
            aside.__dict__.pop("screen", None)
            aside._flow_cuts, aside._voltage_keys = list(self._flow_cuts), {}
            free, none = np.zeros(len(self.sites)), np.zeros(len(self.sites), dtype=bool)
            only = MaxTotal({other: float(other == bus) for other in self.sites})
            question = Question(self.sites, free, self.upper, (), only, None, none)
            try:
                self._largest[bus] = aside.optimum(question).by_site[bus]
            except SimulationError:
                self._largest[bus] = float(self.upper[self.sites.index(bus)])
        return self._largest[bus]

    def allows(self, hosting: Mapping[int, float]) -> bool:
        """Whether these capacities are sizes that sites may have, and every hour has a dispatch and AC
        voltages within all limits at them.

        What is found to be wrong is kept, so that `solve` knows it from then on.

        Parameters
        ----------
        hosting : mapping of bus number to MW
            Sites that are left out host nothing; capacities may be `SETTLED` too large.

        Raises
        ------
        InputError
            When something names no site, is negative or not finite.
        """
        raise_all(hosting_faults(hosting, self.sites), "capacities")
        given = np.array([hosting.get(bus, 0.0) for bus in self.sites])
        if ((given > 0) & ((given < self.lower - SETTLED) | (given > self.upper + SETTLED))).any():
            return False
        H = np.maximum(given - SETTLED, 0.0)
        hours, screen = self.certifier, self.screen
        cut = hours.certify(H)
        if cut is not None:
            self._flow_cuts.append(cut)
            return False
        if screen is None:
            return True
        return Agreement(screen).allows(H, [screen.tangent(*key) for key in self._voltage_keys])

    def pareto(
        self,
        points: int = 5,
        rows: Iterable[Row] = (),
        bounds: Mapping[int, tuple[float, float]] | None = None,
        shares: Mapping[int, float] | None = None,
    ) -> list[Plan]:
        """Plans between the largest total and the largest least size, each with the largest total at its
        least size.

        Parameters
        ----------
        points : int
            Least sizes that are asked for, at least 2, from that of the largest total to the largest.
        rows, bounds : as in `solve`.
        shares : as in `MaxMin`.

        Returns
        -------
        list of Plan
            Least sizes rise and totals fall from plan to plan. Fewer than `points` where several least sizes
            have one plan: one alone where the largest total has the largest least size.
        """
        if points < 2:
            raise InputError(f"pareto: {points} points; a front has at least 2.")
        rows, fair = tuple(rows), MaxMin(shares or {})
        question = ask(self.sites, self.lower, self.upper, rows, bounds or {}, fair, None, ())
        last = self._answer(question)
        front = [self._answer(replace(question, objective=MaxTotal()))]
        counts = question.shares > 0

        def least(plan: Plan) -> float:
            size = np.array([plan.by_site[bus] for bus in self.sites])
            return float((size[counts] / question.shares[counts]).min(initial=np.inf))

        for mu in np.linspace(least(front[0]), last.objective, points)[1:-1]:
            if mu > least(front[-1]):
                front.append(self._answer(question.with_floor(mu)))
        return [*front, last] if last.objective > least(front[-1]) + SETTLED else front

    def _answer(self, question: Question, thorough: bool = True) -> Plan:
        """Solve; for `MaxMin` the total is maximised once the least size is known."""
        found = self.optimum(question, thorough)
        if not isinstance(question.objective, MaxMin):
            return found
        kept = self.optimum(question.with_floor(found.objective), thorough)
        return replace(kept, objective=found.objective)

    def optimum(self, question: Question, thorough: bool = True) -> Plan:
        """The best plan for a checked question; raises `InfeasibleError` when there is none."""
        master = question.master()
        _, screen = self.certifier, self.screen  # both refuse a base case that breaks a limit, in this order
        master.cuts = [self._as_cut(cut) for cut in self._flow_cuts]
        if screen is not None:
            master.cuts += [_tangent_cut(screen.tangent(*key)) for key in self._voltage_keys]
        best: Settled | None = None
        tried: set[tuple[bool, ...]] = set()
        gap = 0.0
        while True:
            chosen = master.choose() if master.may_close else _all_open(len(self.sites))
            if chosen is None:
                break
            more = np.inf if best is None else chosen.objective - best[0].objective
            if more <= TOTAL_TOLERANCE or tuple(chosen.open) in tried:
                gap = 0.0 if best is None else max(0.0, more) / max(best[0].objective, 1.0)
                break
            tried.add(tuple(chosen.open))
            floor = -np.inf if best is None else best[0].objective + TOTAL_TOLERANCE
            best = self._settled(master, chosen.open, floor, thorough) or best
            if not master.may_close:
                break
        widens = thorough and self.reactive_limits and screen is not None and master.may_close
        while best is not None and widens:
            wider = self._wider(master, best[0])
            if wider is None:
                break
            best = wider
        if best is None:
            raise InfeasibleError(why_none(self, question, master))
        solution, certificate, voltage = best
        return report.plan(self, master, solution, certificate, voltage, gap)

    def _settled(self, master: Master, is_open: Flags, floor: float, thorough: bool) -> Settled | None:
        """Optimum for given open sites above `floor` with what is known of it, or None."""
        repeat = self.voltage_screen == "relinearised"
        agreement = None if self.screen is None else Agreement(self.screen, repeat, thorough)
        found = self._settle(master, is_open, floor, agreement)
        if found is None:
            return None
        return found, self.certifier.certificate, None if agreement is None else agreement.info()

    def _least(self, master: Master, is_open: Flags) -> Floats | None:
        """Smallest sizes of open sites that the requirement rows ask for, voltages aside."""
        kept, master.cuts = master.cuts, [c for c in master.cuts if not isinstance(c.origin, Tangent)]
        try:
            return master.smallest(is_open)
        finally:
            master.cuts = kept

    def _wider(self, master: Master, best: Solution) -> Settled | None:
        """A better plan that opens further sites, or others in place of one, where only voltages linearised
        elsewhere spoke against it.

        With reactive limits these may understate; so the choice is made without them, and they are made anew
        on the way to its optimum, however low that seems in between.
        """
        kept = master.cuts  # the reasons of closed sites rest on them
        master.forbid(best.open)
        for _ in range(len(self.sites)):
            master.cuts = [cut for cut in master.cuts if not isinstance(cut.origin, Tangent)]
            chosen = master.choose(beside=best.open)
            if chosen is None or chosen.objective <= best.objective + TOTAL_TOLERANCE:
                break
            try:
                found = self._settled(master, chosen.open, -np.inf, thorough=True)
            except SimulationError:  # no power flow on the way: this choice is not to be had
                found = None
            if found is not None and found[0].objective > best.objective + TOTAL_TOLERANCE:
                return found
            master.forbid(chosen.open)
        master.cuts = kept
        return None

    def _settle(
        self, master: Master, is_open: Flags, floor: float, agreement: Agreement | None
    ) -> Solution | None:
        """Optimum for given open sites, all hours certified; None when there is none above `floor`."""
        base: Floats | None = None  # sizes at which all limits hold
        last: Floats | None = None
        restarts = 0
        while True:
            solution = master.solve(is_open)
            if solution is None and agreement is not None and restarts < RESTARTS:
                restarts += 1
                if base is None:
                    point = self._least(master, is_open)
                else:
                    point = base if last is None else 0.5 * (base + last)
                if point is not None and agreement.restart(point, master):
                    base = point
                    continue
                if base is not None:
                    last = point
                    continue
            if solution is None or solution.objective <= floor:
                return None
            last = solution.H
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
        *,
        bounds: Mapping[int, tuple[float, float]] | None = None,
        objective: Objective | None = None,
        rating: Rating | None = None,
        must_open: Sequence[int] = (),
    ) -> None:
        """Write the problem whole, angles and all rows, for any solver to check.

        Parameters
        ----------
        path : str or Path
            File to write (.mps).
        hours : iterable of int, optional
            Hours of the year; default all. A week is about 70 000 rows.
        rows, bounds, objective, rating, must_open
            As in `solve`.
        around : Plan, optional
            Point at which the voltage rows are linearised; default nothing hosted.
        """
        question = ask(self.sites, self.lower, self.upper, rows, bounds or {}, objective, rating, must_open)
        at = np.arange(len(self.year)) if hours is None else self.year.positions(hours)
        point = np.zeros(len(self.sites)) if around is None else self._vector(around)
        monolith.build(self, at, question.master(), point).write(path)


def _all_open(count: int) -> Solution:
    """The choice when no site can profit from being closed."""
    nothing = np.zeros(0)
    every = np.ones(count, dtype=bool)
    return Solution(np.zeros(count), nothing, every, np.inf, (), nothing, nothing, nothing, nothing)


def _tangent_cut(tangent: Tangent) -> Cut:
    a, b = tangent.cut()
    return Cut(a, b, tangent)
