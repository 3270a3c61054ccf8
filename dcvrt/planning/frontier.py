r"""The largest plans that pass, for every mode, rating and requirement: all searches side by side.

In each round the questions of all searches (`dcvrt.planning.search`) are put together, so that a hosting
vector is simulated once, and every search learns from all that was simulated. A round waits for all its
answers: the result does not depend on who computes them, nor on how many.

What one search has replayed is judged by the requirements of the others too. So the frontier never falls as a
limit is raised: a plan that meets the tighter one is at hand for the wider.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.planning.cuts import Knowledge
from dcvrt.planning.exact import Exact, Place, Run
from dcvrt.planning.requirement import Requirement
from dcvrt.planning.search import Ask, Found, Options, Problem, Search, Vector, learn_allowance

Answer = Callable[[Sequence[tuple[Ask, Sequence[Run]]]], list[Mapping[Run, Sequence[Exact]]]]
"""Answers questions about hosting vectors: for each, what was simulated, or replayed, by mode and rating."""


@dataclass(eq=False)
class Known:
    """What was simulated and what was replayed, by mode and rating: what later searches start from.

    Attributes
    ----------
    simulated : with gradients, in the order in which it was made.
    replayed : under all faults in all periods, by hosting vector.
    """

    simulated: dict[Run, list[Exact]] = field(default_factory=dict)
    replayed: dict[Run, dict[Vector, list[Exact]]] = field(default_factory=dict)


def frontiers(
    problem: Problem,
    wanted: Sequence[tuple[Run, Requirement]],
    box: npt.ArrayLike,
    samples: npt.ArrayLike,
    places: Sequence[Place],
    simulate: Answer,
    replay: Answer,
    options: Options | None = None,
    progress: Callable[[int, int], None] = lambda ended, total: None,
    known: Known | None = None,
) -> list[Found]:
    """The frontier of every wanted mode and rating under its requirement.

    Parameters
    ----------
    problem : hosting programme.
    wanted : modes and ratings, each with what its plan has to meet.
    box : array (sites,)
        Largest capacities, MW.
    samples : array (samples, sites)
        Coarse samples, MW, simulated in every place with gradients; the first is replayed too, to see how far
        search and replay differ.
    places : every period and fault.
    simulate, replay : do the simulations.
    options : Options, optional
    progress : is told how many searches have ended.
    known : of earlier searches of the same problem and places; what is simulated now is added. Modes and
        ratings in it are not sampled again.

    Returns
    -------
    list of Found
        In the order of `wanted`.

    Raises
    ------
    InputError
        No runs, places or samples; samples that do not fit the sites.
    """
    options = options or Options()
    known = Known() if known is None else known
    upper = np.asarray(box, dtype=float)
    points = np.atleast_2d(np.asarray(samples, dtype=float))
    runs = tuple(dict.fromkeys(run for run, _ in wanted))
    for name, length in (("runs", len(runs)), ("places", len(places)), ("samples", points.size)):
        if not length:
            raise InputError(f"frontier: there are no {name}.")
    if points.shape[1] != len(problem.sites) or len(upper) != len(problem.sites):
        raise InputError(
            f"frontier: {points.shape[1]} and {len(upper)} capacities in samples and box for "
            f"{len(problem.sites)} sites."
        )
    fresh = tuple(run for run in runs if run not in known.simulated)
    for run in fresh:
        known.simulated[run], known.replayed[run] = [], {}
    if fresh:
        vectors = [tuple(point) for point in points.tolist()]
        for found in simulate([(Ask(H, tuple(places)), fresh) for H in vectors]):
            _learn(known, [], found)
        _keep(known, vectors[0], replay([(Ask(vectors[0], None), fresh)])[0])

    nothing = problem.solve(rows=(), bounds=dict.fromkeys(problem.sites, (0.0, 0.0)))
    searches = []
    for run, requirement in wanted:
        knowledge = Knowledge(requirement, run)
        knowledge.learn(known.simulated[run])
        for seen in known.replayed[run].values():
            learn_allowance(knowledge, map(requirement.margins, seen), options.margin)
        searches.append(Search(problem, upper, knowledge, known.replayed[run], nothing, options))
    results: dict[int, Found] = {}
    begun = list(range(len(searches)))
    while begun:
        results |= _ended(searches, begun, known, simulate, replay, lambda n: progress(n, len(searches)))
        begun = [k for k, search in enumerate(searches) if search.overtaken() is not None]
    return [results[k] for k in range(len(searches))]


def _ended(
    searches: Sequence[Search],
    begun: Iterable[int],
    known: Known,
    simulate: Answer,
    replay: Answer,
    progress: Callable[[int], None],
) -> dict[int, Found]:
    """Run some searches to their ends, in rounds."""
    going = {k: searches[k].run() for k in begun}
    results: dict[int, Found] = {}
    while going:
        asked: dict[int, Ask] = {}
        for k in list(going):
            try:
                asked[k] = next(going[k])
            except StopIteration as end:
                results[k] = end.value
                del going[k]
                progress(len(searches) - len(going))
        _answer(
            [(searches[k].knowledge.run, ask) for k, ask in asked.items()], searches, known, simulate, replay
        )
    return results


def _answer(
    asked: Sequence[tuple[Run, Ask]],
    searches: Sequence[Search],
    known: Known,
    simulate: Answer,
    replay: Answer,
) -> None:
    """Put the questions of a round together and give every search what comes of them."""
    wanted: dict[Vector, dict[Place, None]] = {}
    replays: dict[Vector, None] = {}
    for _, ask in asked:
        if ask.places is None:
            replays[ask.H] = None
        else:
            wanted.setdefault(ask.H, {}).update(dict.fromkeys(ask.places))
    # Those still searching may come to the same vector: a fault is simulated once for all of them.
    everyone = tuple(dict.fromkeys(run for run, _ in asked))
    questions = [(Ask(H, tuple(places)), everyone) for H, places in wanted.items()]
    for found in simulate(questions) if questions else ():
        _learn(known, searches, found)
    # The faults take the time of a replay: what rides through them at other ratings is told as well.
    asks = [(Ask(H, None), tuple(r for r in known.replayed if H not in known.replayed[r])) for H in replays]
    for (ask, _), found in zip(asks, replay(asks) if asks else [], strict=True):
        _keep(known, ask.H, found)


def _learn(known: Known, searches: Sequence[Search], found: Mapping[Run, Sequence[Exact]]) -> None:
    for run, exact in found.items():
        known.simulated[run] += exact
        for search in searches:
            if search.knowledge.run == run:
                search.knowledge.learn(exact)


def _keep(known: Known, H: Vector, found: Mapping[Run, Sequence[Exact]]) -> None:
    for run, exact in found.items():
        known.replayed[run][H] = list(exact)
