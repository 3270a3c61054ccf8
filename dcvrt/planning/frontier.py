r"""The largest plan that passes: hosting programme, exact margins and replay, in turn, until nothing is left
to gain.

For one facility mode and rating the frontier is

.. math::
    \max \sum_i H_i \quad\text{s.t. the network's limits in every hour,}\quad
    m_{i,f,t}(H) \ge 0 \text{ for every fault } f, \text{ period } t \text{ and open site } i,

with margins m that only a simulation can tell. Each candidate of the hosting programme is simulated where a
margin may be near; what fails becomes a cut (`dcvrt.planning.cuts`), what passes goes to the replay, which
simulates every fault in every period and has the last word. The search of a mode and rating ends when the
hosting programme, the cuts known in the trust region around the best plan, promises no more than
`Options.gain`. Before that, candidates of the whole box are tried, until they promise nothing or have led
nowhere `Options.leaps` times.

All modes and ratings are searched side by side: in each round their questions are put together, so that a
hosting vector is simulated once, and every search learns from all that was simulated. A round waits for all
its answers: the result does not depend on who computes them, nor on how many.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.planning.cuts import Knowledge, separation, worst_over
from dcvrt.planning.exact import TARGETS, Exact, Key, Place, Run
from dcvrt.planning.plan import Plan, Row

Floats = npt.NDArray[np.float64]
Rows = list[dict[str, Any]]


class Problem(Protocol):
    """A hosting programme, as `dcvrt.planning.HostingProblem` is one."""

    @property
    def sites(self) -> tuple[int, ...]:
        """Candidate buses."""

    def solve(
        self, rows: Iterable[Row] = ..., bounds: Mapping[int, tuple[float, float]] | None = ...
    ) -> Plan:
        """The largest plan under rows and bounds."""


@dataclass(frozen=True)
class Options:
    """How the frontier is searched.

    Parameters
    ----------
    gain : share of the best total that is not worth another candidate.
    watch : predicted margin, pu or share, from which on a fault of a period is left to the replay.
    trust : radius of the trust region around the best plan, as a share of the box.
    halvings : bisections between a passing and a failing point, where the event sequence changes.
    candidates : hosting vectors that one mode and rating may try.
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

    H: tuple[float, ...]
    places: tuple[Place, ...] | None


@dataclass(frozen=True)
class BindingMargin:
    """A margin that keeps a plan from hosting more.

    Attributes
    ----------
    period, fault, site, target : whose margin it is.
    label : what reports call it.
    price : hosted MW gained per pu or share by which it is relaxed.
    by_beta : hosted MW gained per unit of the rating ratio, through this margin.
    """

    period: str
    fault: str
    site: int
    target: str
    label: str
    price: float
    by_beta: float


@dataclass(frozen=True, eq=False)
class Found:
    """The frontier of one mode and rating.

    Attributes
    ----------
    mode, beta : what it is the frontier of.
    plan : the largest plan that passed the replay; of nothing where none did.
    closed : sites without a facility, each with the reason.
    certificate : the replayed runs of its open sites, all of which meet their margins.
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
    certificate: Rows
    gap: float
    candidates: int
    failed: int
    by_sequence: tuple[str, ...]
    settled: bool
    binding: tuple[BindingMargin, ...]


# -- one mode and rating -------------------------------------------------------------------------------------


class Search:
    """The search of one mode and rating: a generator of questions, which its owner answers.

    Parameters
    ----------
    problem : hosting programme.
    box : array (sites,)
        Largest capacities, MW.
    knowledge : what was simulated for the mode and rating; its owner adds to it.
    options : Options

    Attributes
    ----------
    replays : list of rows
        The owner puts the rows of each replay asked for here.
    """

    def __init__(self, problem: Problem, box: Floats, knowledge: Knowledge, options: Options) -> None:
        self.problem, self.box, self.knowledge, self.options = problem, box, knowledge, options
        self.replays: list[Rows] = []
        self.tried = self.refused = 0

    def run(self) -> Generator[Ask, None, Found]:
        """Ask until nothing is left to gain."""
        best, certificate, settled, gap, leaps = self._nothing(), Rows(), False, 0.0, 0
        centre: Floats | None = None
        while self.tried < self.options.candidates:
            plan, leap = self._propose(), True
            if not self._worth(plan, best) or leaps >= self.options.leaps:
                if centre is None:
                    settled = not self._worth(plan, best)
                    break
                plan, leap = self._propose(centre, local=True), False
                gap = max(0.0, plan.total_mw / best.total_mw - 1.0)
                if not self._worth(plan, best):
                    settled = True
                    break
            better = yield from self._approach(plan, best)
            if better is not None:
                best, centre, certificate = better
            leaps += leap and better is None
        return self._found(best, certificate, gap, settled)

    def _approach(self, plan: Plan, best: Plan) -> Generator[Ask, None, tuple[Plan, Floats, Rows] | None]:
        """From a candidate to one that passes, in steps that get shorter; None where nothing larger does."""
        radius = 1.0
        while self.tried < self.options.candidates and self._worth(plan, best):
            self.tried += 1
            H = self.knowledge.settle(vector(plan, self.problem.sites))
            if (yield from self._passes(H)):
                rows = yield from self._replay(H)
                if rows is not None:
                    return at(plan, H, self.problem.sites), H, rows
            plan = self._propose(H, radius)
            radius *= 0.5
        return None

    def _worth(self, plan: Plan, best: Plan) -> bool:
        return plan.total_mw > best.total_mw * (1.0 + self.options.gain) + 1e-6

    def _nothing(self) -> Plan:
        return self.problem.solve(rows=(), bounds={bus: (0.0, 0.0) for bus in self.problem.sites})

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
        return self.problem.solve(rows=rows, bounds=bounds)

    def _open(self, H: Floats) -> list[int]:
        return np.flatnonzero(H > 0).tolist()

    def _passes(self, H: Floats) -> Generator[Ask, None, bool]:
        """Simulate a candidate where a margin may be near; whether all of these are met."""
        yield from self._simulate(H, self._watched(H))
        failing = worst_over(self.knowledge.at(H), self.knowledge, self._open(H))
        for key in failing:
            yield from self._separate(key, self.knowledge.at(H)[key[:2]])
        return not failing

    def _watched(self, H: Floats) -> list[Place]:
        """Periods and faults in which a margin of an open site is predicted to be near its limit."""
        sites = self._open(H)
        watched = []
        for place in self.knowledge.exact:
            near = self.knowledge.nearest(place, H)
            predicted = near.linear(H)[sites]
            if not (predicted >= self.options.watch).all():
                watched.append(place)
        return watched

    def _simulate(self, H: Floats, places: Sequence[Place]) -> Generator[Ask, None, None]:
        known = self.knowledge.at(H)
        missing = tuple(place for place in places if place not in known)
        if missing:
            yield Ask(tuple(H.tolist()), missing)

    def _separate(self, key: Key, failing: Exact) -> Generator[Ask, None, None]:
        """Cut off a failing point whose tangent does not: at the last passing point on the way from a passing
        one."""
        know = self.knowledge
        *_, site, target = key
        met = know.passing(key)
        if not met or know.separated(key, failing.H):
            return
        smooth = np.isfinite(failing.value[site, target]) and know.unexplained(failing, site, target) is None
        if smooth:
            return
        low, high = min(met, key=lambda one: float(abs(one.H - failing.H).max())), failing
        for _ in range(self.options.halvings):
            middle = np.round(0.5 * (low.H + high.H), 6)
            yield from self._simulate(middle, [low.place])
            one = know.at(middle)[low.place]
            low, high = (low, one) if know.short(one, site, target) else (one, high)
        know.separations.append(separation(know, key, low, high))

    def _replay(self, H: Floats) -> Generator[Ask, None, Rows | None]:
        """Replay a candidate; its rows if every margin is met, else None, with the allowances raised."""
        yield Ask(tuple(H.tolist()), None)
        rows = self.replays[-1]
        sites = [self.problem.sites[k] for k in self._open(H)]
        here = [row for row in rows if row["site"] in sites]
        failing = [row for row in here if not meets(row)]
        if not failing:
            return here
        self.refused += 1
        yield from self._simulate(H, list(dict.fromkeys((row["period"], row["fault"]) for row in failing)))
        self._allow(H, failing)
        for key in worst_over(self.knowledge.at(H), self.knowledge, self._open(H)):
            yield from self._separate(key, self.knowledge.at(H)[key[:2]])
        return None

    def _allow(self, H: Floats, failing: Rows) -> None:
        """Where search and replay differ, ask the search for more by what they differ."""
        learn_allowance(self.knowledge, H, failing, self.options.margin)

    def _found(self, best: Plan, certificate: Rows, gap: float, settled: bool) -> Found:
        know = self.knowledge
        mode, beta = know.run
        reasons = self._propose().closed
        closed = {
            bus: reasons.get(bus, "opening it gains nothing")
            for bus, mw in best.by_site.items()
            if not mw > 0
        }
        H = vector(best, self.problem.sites)
        prices = {item.label: item.price for item in best.binding}
        binding = []
        for place, one in know.at(H).items():
            for site in self._open(H):
                for target, word in enumerate(TARGETS):
                    label = know.label((*place, site, target))
                    if label in prices:
                        gain = prices[label] * float(one.by_beta[site, target])
                        bus = self.problem.sites[site]
                        binding.append(BindingMargin(*place, bus, word, label, prices[label], gain))
        return Found(
            mode,
            beta,
            best,
            closed,
            certificate,
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
    """A plan with the capacities that were simulated, which are within `SETTLED` of it."""
    by_site = dict(zip(sites, H.tolist(), strict=True))
    return replace(plan, total_mw=float(H.sum()), by_site=by_site)


def meets(row: Mapping[str, Any]) -> bool:
    """Whether a checked run meets both margins; one that failed does not."""
    return bool(row["ok"] and row["v_margin_pu"] >= 0.0 and row["loss_margin_share"] >= 0.0)


UNEXPLAINED = 0.01
"""Allowance, pu or share, where the search passes a run that the replay has no margin of."""


def learn_allowance(knowledge: Knowledge, H: Floats, rows: Rows, share: float) -> None:
    """Raise allowances by how much less a replay finds than the search, at margins that both know.

    Parameters
    ----------
    knowledge : of the mode and rating of the rows.
    H : hosting vector of both, MW.
    rows : replayed runs.
    share : what to ask for beyond the difference, as a share of it.
    """
    known = knowledge.at(H)
    position = {bus: k for k, bus in enumerate(knowledge.sites)}
    for row in rows:
        place, site = (str(row["period"]), str(row["fault"])), position[int(row["site"])]
        if place not in known:
            continue
        one = known[place]
        for target, column in enumerate(("v_margin_pu", "loss_margin_share")):
            value = one.value[site, target]
            if np.isnan(value):
                continue
            if not row["ok"]:
                less = UNEXPLAINED
            elif row["sequence"] == one.sequence[site] or not row[column] >= 0:
                less = (1.0 + share) * (value - row[column])
            else:
                continue
            key = (*place, site, target)
            knowledge.allowance[key] = max(knowledge.allowance.get(key, 0.0), less)


# -- all modes and ratings -----------------------------------------------------------------------------------

Simulate = Callable[[Sequence[tuple[Ask, Sequence[Run]]]], list[Mapping[Run, Sequence[Exact]]]]
"""Answers questions about margins: for each, what was simulated by mode and rating."""
Replay = Callable[[Sequence[tuple[Ask, Sequence[Run]]]], list[Rows]]
"""Answers questions for a replay: for each, the rows of all faults, periods, sites and asked modes and
ratings."""


def frontiers(
    problem: Problem,
    runs: Sequence[Run],
    box: npt.ArrayLike,
    samples: npt.ArrayLike,
    places: Sequence[Place],
    simulate: Simulate,
    replay: Replay,
    options: Options | None = None,
    progress: Callable[[int, int], None] = lambda ended, total: None,
) -> list[Found]:
    """The frontier of every mode and rating.

    Parameters
    ----------
    problem : hosting programme.
    runs : modes and ratings.
    box : array (sites,)
        Largest capacities, MW.
    samples : array (samples, sites)
        Coarse samples, MW, simulated in every place with gradients; the first is replayed too, to see how far
        search and replay differ.
    places : every period and fault.
    simulate, replay : do the simulations.
    options : Options, optional
    progress : is told how many searches have ended.

    Returns
    -------
    list of Found
        In the order of `runs`.

    Raises
    ------
    InputError
        No runs, places or samples; samples that do not fit the sites.
    """
    options = options or Options()
    upper = np.asarray(box, dtype=float)
    points = np.atleast_2d(np.asarray(samples, dtype=float))
    for name, length in (("runs", len(runs)), ("places", len(places)), ("samples", points.size)):
        if not length:
            raise InputError(f"frontier: there are no {name}.")
    if points.shape[1] != len(problem.sites) or len(upper) != len(problem.sites):
        raise InputError(
            f"frontier: {points.shape[1]} and {len(upper)} capacities in samples and box for "
            f"{len(problem.sites)} sites."
        )
    knowledge = {run: Knowledge(problem.sites, run) for run in runs}
    coarse = [(Ask(tuple(point), tuple(places)), tuple(runs)) for point in points.tolist()]
    for found in simulate(coarse):
        for run, exact in found.items():
            knowledge[run].learn(exact)
    seen: dict[tuple[float, ...], dict[Run, Rows]] = {}
    first = Ask(tuple(points[0].tolist()), None)
    _keep(seen, first, replay([(first, tuple(runs))])[0])
    for run, rows in seen[first.H].items():
        learn_allowance(knowledge[run], points[0], rows, options.margin)

    searches = {run: Search(problem, upper, knowledge[run], options) for run in runs}
    going = {run: search.run() for run, search in searches.items()}
    results: dict[Run, Found] = {}
    asked: dict[Run, Ask] = {}
    while going:
        for run in list(going):
            try:
                while True:
                    asked[run] = next(going[run])
                    ask = asked[run]
                    if ask.places is not None or run not in seen.get(ask.H, {}):
                        break
                    searches[run].replays.append(seen[ask.H][run])
            except StopIteration as end:
                results[run] = end.value
                del going[run]
                asked.pop(run, None)
                progress(len(results), len(runs))
        _answer(asked, knowledge, searches, simulate, replay, seen)
    return [results[run] for run in runs]


def _answer(
    asked: Mapping[Run, Ask],
    knowledge: Mapping[Run, Knowledge],
    searches: Mapping[Run, Search],
    simulate: Simulate,
    replay: Replay,
    seen: dict[tuple[float, ...], dict[Run, Rows]],
) -> None:
    """Put the questions of a round together and give every search its answers."""
    wanted: dict[tuple[float, ...], dict[Place, None]] = {}
    replays: dict[tuple[float, ...], None] = {}
    for ask in asked.values():
        if ask.places is None:
            replays[ask.H] = None
        else:
            wanted.setdefault(ask.H, {}).update(dict.fromkeys(ask.places))
    everyone = tuple(asked)
    questions = [(Ask(H, tuple(places)), everyone) for H, places in wanted.items()]
    for found in simulate(questions) if questions else ():
        for run, exact in found.items():
            fresh = [one for one in exact if one.place not in knowledge[run].at(one.H)]
            knowledge[run].learn(fresh)
    # Those still searching may come to the same vector: a fault is replayed once for all of them.
    asks = [(Ask(H, None), tuple(run for run in asked if run not in seen.get(H, {}))) for H in replays]
    for (ask, _), rows in zip(asks, replay(asks) if asks else [], strict=True):
        _keep(seen, ask, rows)
    for run, ask in asked.items():
        if ask.places is None:
            searches[run].replays.append(seen[ask.H][run])


def _keep(seen: dict[tuple[float, ...], dict[Run, Rows]], ask: Ask, rows: Rows) -> None:
    by_run = seen.setdefault(ask.H, {})
    for row in rows:
        by_run.setdefault((str(row["mode"]), float(row["beta"])), []).append(row)
