r"""The search of one mode and rating for the largest plan that meets a requirement.

.. math::
    \max \sum_i H_i \quad\text{s.t. the network's limits in every hour,}\quad
    m_{k,f,t}(H) \ge 0 \text{ for every margin } k \text{ that counts, fault } f \text{ and period } t,

with margins m that only a simulation can tell (`dcvrt.planning.requirement`). Each candidate of the hosting
programme is simulated where a margin may be near; what fails becomes a cut (`dcvrt.planning.cuts`), what
passes goes to the replay, which simulates every fault in every period and has the last word. The search ends
when the hosting programme, the cuts known in the trust region around the best plan, promises no more than
`Options.gain`. Before that, candidates of the whole box are tried, until they promise nothing or have led
nowhere `Options.leaps` times.

The result is a plan that passed, and a local optimum: where margins jump as the event sequence changes, the
search keeps to the side that it has seen pass, and a larger plan beyond the jump may escape it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.planning.cuts import Key, Knowledge, separation
from dcvrt.planning.exact import Exact, Place
from dcvrt.planning.plan import SETTLED, Plan, Row
from dcvrt.planning.requirement import Margins

Floats = npt.NDArray[np.float64]
Vector = tuple[float, ...]
"""Capacities in the order of the sites, MW."""


class Problem(Protocol):
    """A hosting programme, as `dcvrt.planning.HostingProblem` is one."""

    @property
    def sites(self) -> tuple[int, ...]:
        """Candidate buses."""

    def solve(
        self,
        rows: Iterable[Row] = ...,
        bounds: Mapping[int, tuple[float, float]] | None = ...,
        *,
        thorough: bool = ...,
    ) -> Plan:
        """The largest plan under rows and bounds; without `thorough` possibly too large."""

    def allows(self, hosting: Mapping[int, float]) -> bool:
        """Whether the network can host as much, faults aside."""


@dataclass(frozen=True)
class Options:
    """How the frontier is searched.

    Parameters
    ----------
    gain : share of the best total that is not worth another candidate.
    watch : predicted margin, as a share of its size (pu or share of a site's load; share of all load), from
        which on a fault of a period is left to the replay.
    trust : radius of the trust region around the best plan, as a share of the box.
    halvings : bisections between a passing and a failing point, where the event sequence changes.
    candidates : hosting vectors that one search may try.
    leaps : candidates of the whole box from which nothing better that passes was reached, before the search
        keeps to the trust region.
    margin : allowance beside the difference seen between search and replay, as a share of it.
    """

    gain: float = 0.005
    watch: float = 0.03
    trust: float = 0.10
    halvings: int = 5
    candidates: int = 40
    leaps: int = 3
    margin: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise InputError(f"frontier: {name} = {value:g} must be above 0.")


@dataclass(frozen=True)
class Ask:
    """What a search wants to know of a hosting vector.

    Attributes
    ----------
    H : capacities in the order of the sites, MW.
    places : periods and faults to simulate with gradients; None asks for the replay of all of them.
    """

    H: Vector
    places: tuple[Place, ...] | None


@dataclass(frozen=True)
class BindingMargin:
    """A margin that keeps a plan from hosting more.

    Attributes
    ----------
    period, fault, target : whose margin it is.
    site : its bus; None for a margin of the system as a whole.
    label : what reports call it.
    price : hosted MW gained per unit of the margin (pu, share, MW) by which it is relaxed.
    by_beta : hosted MW gained per unit of the rating ratio, through this margin.
    """

    period: str
    fault: str
    site: int | None
    target: str
    label: str
    price: float
    by_beta: float


@dataclass(frozen=True, eq=False)
class Passed:
    """A plan with the replay that it passed.

    Attributes
    ----------
    plan : the plan; of nothing where none has passed yet.
    H : array (sites,)
        Its capacities, MW.
    certificate : margins of the replay under every fault in every period, all of which are met.
    """

    plan: Plan
    H: Floats
    certificate: tuple[Margins, ...] = ()


@dataclass(frozen=True, eq=False)
class Found:
    """The frontier of one mode and rating.

    Attributes
    ----------
    mode, beta : what it is the frontier of.
    plan : the largest plan that passed the replay; of nothing where none did.
    closed : sites without a facility, each with the reason.
    certificate : margins of the replay under every fault in every period, all of which are met.
    gap : share of the total by which the cuts inside the trust region still allow a larger plan.
    candidates : hosting vectors tried.
    failed : candidates that passed where they were simulated and failed the replay.
    by_sequence : margins whose limit was set by bisection, where the event sequence changes: a safe bound,
        which no gradient confirms.
    settled : whether the search ended because nothing was left to gain.
    binding : margins that bind.
    """

    mode: str
    beta: float
    plan: Plan
    closed: dict[int, str]
    certificate: tuple[Margins, ...]
    gap: float
    candidates: int
    failed: int
    by_sequence: tuple[str, ...]
    settled: bool
    binding: tuple[BindingMargin, ...]


class Search:
    """The search of one mode and rating: a generator of questions, which its owner answers.

    Parameters
    ----------
    problem : hosting programme.
    box : array (sites,)
        Largest capacities, MW.
    knowledge : what was simulated for the mode and rating; its owner adds to it.
    replayed : what was replayed for them, by whichever search; its owner adds to it.
    nothing : the plan that hosts nothing, which it starts from.
    options : Options
    """

    def __init__(
        self,
        problem: Problem,
        box: Floats,
        knowledge: Knowledge,
        replayed: Mapping[Vector, Sequence[Exact]],
        nothing: Plan,
        options: Options,
    ) -> None:
        self.problem, self.box, self.knowledge = problem, box, knowledge
        self.replayed, self.options = replayed, options
        self.tried = self.refused = 0
        self.best = Passed(nothing, np.zeros(len(box)))

    def run(self) -> Generator[Ask, None, Found]:
        """Ask until nothing is left to gain; to be run again when `overtaken`."""
        settled, gap, leaps = False, 0.0, 0
        self._adopt()
        while self.tried < self.options.candidates:
            plan, leap = self._propose(), True
            if not self._worth(plan) or leaps >= self.options.leaps:
                if not self.best.plan.total_mw > 0:
                    settled = not self._worth(plan)
                    break
                plan, leap = self._propose(self.best.H, local=True), False
                gap = max(0.0, plan.total_mw / self.best.plan.total_mw - 1.0)
                if not self._worth(plan):
                    settled = True
                    break
            better = yield from self._approach(plan)
            leaps += leap and not better
            self._adopt()
        return self._found(gap, settled)

    def overtaken(self) -> tuple[Floats, tuple[Margins, ...]] | None:
        """The largest vector that was replayed, meets the requirement and hosts more than the best plan.

        Only where the network allows it: coarse samples need not keep to that.
        """
        for H in sorted(self.replayed, key=sum, reverse=True):
            if sum(H) <= self.best.plan.total_mw + 1e-6:
                return None
            judged = self._judged(H)
            if self._passes_replay(judged) and self._allowed(np.array(H)):
                return np.array(H), judged
        return None

    def _adopt(self) -> None:
        """Take over a larger plan that was replayed for another search, with the prices around it."""
        larger = self.overtaken()
        if larger is not None:
            H, judged = larger
            plan = self._propose(H, local=True)
            self.best = Passed(at(plan, H, self.problem.sites), H, judged)

    def _approach(self, plan: Plan) -> Generator[Ask, None, bool]:
        """From a candidate to one that passes, in steps that get shorter; whether one larger than the best
        was reached."""
        radius = 1.0
        while self.tried < self.options.candidates and self._worth(plan):
            self.tried += 1
            H = self.knowledge.settle(vector(plan, self.problem.sites))
            if (yield from self._passes(H)) and self._allowed(H):
                judged = yield from self._replay(H)
                if judged is not None:
                    self.best = Passed(at(plan, H, self.problem.sites), H, judged)
                    return True
            plan = self._propose(H, radius)
            radius *= 0.5
        return False

    def _worth(self, plan: Plan) -> bool:
        """Whether a plan is enough larger than the best: by the gain, and by what the programme can tell."""
        told = SETTLED * len(self.problem.sites)
        return plan.total_mw > self.best.plan.total_mw * (1.0 + self.options.gain) + told

    def _propose(self, centre: Floats | None = None, radius: float = 1.0, local: bool = False) -> Plan:
        """The hosting programme under the cuts, in the whole box or in a trust region around a centre.

        `local` leaves out what is known of points elsewhere, where something nearer is known.
        """
        sites, box = self.problem.sites, self.box
        reach = radius * self.options.trust * float(box.max())
        low = np.zeros(len(box)) if centre is None else np.maximum(centre - reach, 0.0)
        high = box if centre is None else np.minimum(centre + reach, box)
        rows = tuple(self.knowledge.rows(box, centre if local else None, reach))
        bounds = {bus: (float(a), float(b)) for bus, a, b in zip(sites, low, high, strict=True)}
        return self.problem.solve(rows=rows, bounds=bounds, thorough=False)

    def _allowed(self, H: Floats) -> bool:
        return self.problem.allows(dict(zip(self.problem.sites, H.tolist(), strict=True)))

    def _passes(self, H: Floats) -> Generator[Ask, None, bool]:
        """Simulate a candidate where a margin may be near; whether all of these are met."""
        yield from self._simulate(H, self._watched(H))
        failing = self.knowledge.missed(H)
        for key in failing:
            yield from self._separate(key, H)
        return not failing

    def _watched(self, H: Floats) -> list[Place]:
        """Periods and faults in which a margin that counts is predicted to be near its limit."""
        know = self.knowledge
        counts = know.requirement.counts(H)
        watched = []
        for place in know.points:
            near = know.nearest(place, H)
            if not (near.linear(H) >= self.options.watch * near.size_at(H))[counts].all():
                watched.append(place)
        return watched

    def _simulate(self, H: Floats, places: Sequence[Place]) -> Generator[Ask, None, None]:
        known = self.knowledge.at(H)
        missing = tuple(place for place in places if place not in known)
        if missing:
            yield Ask(tuple(H.tolist()), missing)

    def _separate(self, key: Key, H: Floats) -> Generator[Ask, None, None]:
        """Cut off a failing point whose tangent does not: at the last passing point on the way from a passing
        one."""
        know, (*_, number) = self.knowledge, key
        failing = know.at(H)[key[:2]]
        met = know.passing(key)
        if not met or know.separated(key, H):
            return
        if np.isfinite(failing.value[number]) and not know.unexplained(failing, number):
            return
        low, high = min(met, key=lambda one: float(abs(one.H - H).max())), failing
        for _ in range(self.options.halvings):
            middle = np.round(0.5 * (low.H + high.H), 6)
            yield from self._simulate(middle, [low.place])
            one = know.at(middle)[low.place]
            low, high = (low, one) if know.short(one, number) else (one, high)
        if low.same_course(high, number) and know.denies(low, number, H):
            return
        know.separations.append(separation(know, key, low, high))

    def _replay(self, H: Floats) -> Generator[Ask, None, tuple[Margins, ...] | None]:
        """Replay a candidate; its margins if all are met, else None, with the allowances raised."""
        asked = tuple(H.tolist())
        if asked not in self.replayed:
            yield Ask(asked, None)
        judged = self._judged(asked)
        if self._passes_replay(judged):
            return judged
        self.refused += 1
        failing = [one for one in judged if one.missed()]
        yield from self._simulate(H, [one.place for one in failing])
        learn_allowance(self.knowledge, failing, self.options.margin)
        for key in self.knowledge.missed(H):
            yield from self._separate(key, H)
        return None

    def _judged(self, H: Vector) -> tuple[Margins, ...]:
        return tuple(map(self.knowledge.requirement.margins, self.replayed[H]))

    def _passes_replay(self, judged: Sequence[Margins]) -> bool:
        """Whether every margin is met, under every fault in every period: one that is missing is none."""
        everywhere = {one.place for one in judged} >= set(self.knowledge.points)
        return everywhere and not any(one.missed() for one in judged)

    def _found(self, gap: float, settled: bool) -> Found:
        know, best, sites = self.knowledge, self.best, self.problem.sites
        reasons = self._propose().closed
        closed = {
            bus: reasons.get(bus, "opening it gains nothing")
            for bus, mw in best.plan.by_site.items()
            if not mw > 0
        }
        prices: dict[str, float] = {}
        for item in best.plan.binding:  # tangents of several points may share a price
            prices[item.label] = prices.get(item.label, 0.0) + item.price
        counts = np.flatnonzero(know.requirement.counts(best.H)).tolist()
        binding = []
        for place, one in know.at(best.H).items():
            for number in counts:
                label, owner = know.label((*place, number)), know.requirement.owners[number]
                if label in prices:
                    gain = prices[label] * float(one.by_beta[number])
                    bus, target = None if owner is None else sites[owner], know.requirement.target(number)
                    binding.append(BindingMargin(*place, bus, target, label, prices[label], gain))
        return Found(
            *know.run,
            best.plan,
            closed,
            best.certificate,
            gap,
            self.tried,
            self.refused,
            tuple(f"{know.label(cut.key)}: {cut.why}" for cut in know.separations),
            settled,
            tuple(binding),
        )


def vector(plan: Plan, sites: Sequence[int]) -> Floats:
    """Capacities of a plan as they are simulated and reported: to 1e-6 MW."""
    return np.array([round(plan.by_site[bus], 6) + 0.0 for bus in sites])


def at(plan: Plan, H: Floats, sites: Sequence[int]) -> Plan:
    """A plan with the capacities that were simulated."""
    by_site = dict(zip(sites, H.tolist(), strict=True))
    return replace(plan, total_mw=float(H.sum()), by_site=by_site)


UNEXPLAINED = 0.01
"""Allowance, as a share of the margin's size, where the search has a margin that the replay has not."""


def learn_allowance(knowledge: Knowledge, replayed: Iterable[Margins], share: float) -> None:
    """Raise allowances by how much less a replay finds than the search, at margins that both know.

    Parameters
    ----------
    knowledge : of the mode and rating that was replayed.
    replayed : margins of replays.
    share : what to ask for beyond the difference, as a share of it.
    """
    for one in replayed:
        searched = knowledge.at(one.H).get(one.place)
        if searched is None:
            continue
        for number, (value, size) in enumerate(zip(searched.value, searched.size, strict=True)):
            if np.isnan(value) or not size > 0:
                continue
            if np.isnan(one.value[number]):
                less = UNEXPLAINED
            elif one.same_course(searched, number) or not one.value[number] >= 0:
                less = (1.0 + share) * float(value - one.value[number]) / float(size)
            else:
                continue
            key = (*one.place, number)
            knowledge.allowance[key] = max(knowledge.allowance.get(key, 0.0), less)
