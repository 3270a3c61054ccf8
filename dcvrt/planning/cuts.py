r"""Cuts from exact margins: what is known about a mode at a rating, as rows of the hosting programme.

A simulated margin with its total gradient gives the tangent

.. math:: m(H^k) + \nabla m(H^k) \cdot (H - H^k) \ge e\, p(H)

where e is the allowance by which the replay has been seen to find less, and a little more than that, as a
share of the size p of the margin. The row of a margin that belongs to a site holds while the site is open.
Nothing is assumed about the shape of margins: a tangent that excludes a hosting vector whose margin is
known to be met is wrong there, and is dropped. So is one at a point that fails, from beyond a jump of the
margin. Where the tangent belongs to a point that fails, a cut at the last passing point of the segment
between the two takes its place (`Separation`), unless the tangent there does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dcvrt.errors import first_sentence
from dcvrt.planning.exact import Exact, Place, Run
from dcvrt.planning.plan import SETTLED, Row
from dcvrt.planning.requirement import Margins, Requirement

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Key = tuple[str, str, int]
"""Period, fault and number of a margin of the requirement: what one margin is the margin of."""

NEVER_BINDS = 1e-9
"""Slack, in the unit of the margin, by which a row that holds all over the box is told from one that may
bind."""
BACKOFF = 1e-5
"""What a tangent asks for beyond the margin, as a share of its size, so that a plan on it passes in spite of
its curvature."""
JUMP = 0.1
"""Error of a tangent at a point of another event sequence, as a share of the margin's size, from which on the
two do not belong to one piece: loss shares move by a few hundredths over all sizes, and by much more where a
site is lost whole."""
SAME_POINT = 1e-6
"""Hosting vectors that differ by less are one, MW."""


@dataclass(frozen=True, eq=False)
class Separation:
    """A cut between a point that meets a margin and one that does not, at the last point seen to meet it.

    It stands where gradients say nothing: the run passes through other modes of the supervisor, or failed.

    Attributes
    ----------
    key : the margin.
    normal : array (sites,)
        Direction of the side that is kept, of length 1.
    passing, failing : array (sites,)
        The two points after bisection, MW.
    why : how the run differs beyond the cut.
    """

    key: Key
    normal: Floats
    passing: Floats
    failing: Floats
    why: str


@dataclass(eq=False)
class Knowledge:
    """All that was simulated about one mode at one rating, as margins of a requirement.

    Attributes
    ----------
    requirement : what has to be met.
    run : mode and rating ratio.
    points : margins by period and fault, in the order in which they were simulated.
    allowance : by margin, how much less the replay has found, as a share of its size; 0 where not named.
    separations : cuts at changes of the event sequence.
    """

    requirement: Requirement
    run: Run
    points: dict[Place, list[Margins]] = field(default_factory=dict)
    allowance: dict[Key, float] = field(default_factory=dict)
    separations: list[Separation] = field(default_factory=list)

    @property
    def sites(self) -> tuple[int, ...]:
        """Candidate buses."""
        return self.requirement.sites

    def learn(self, found: Sequence[Exact]) -> None:
        """Take in what was simulated, where it is new."""
        for one in found:
            known = self.points.setdefault(one.place, [])
            if not any(same(one.H, other.H) for other in known):
                known.append(self.requirement.margins(one))

    def at(self, H: Floats) -> dict[Place, Margins]:
        """What was simulated at a hosting vector itself."""
        return {place: one for place, points in self.points.items() for one in points if same(one.H, H)}

    def settle(self, H: Floats) -> Floats:
        """A simulated point that the hosting programme cannot tell from a plan, or the plan itself."""
        points = [one.H for known in self.points.values() for one in known]
        near = [
            point for point in points if abs(point - H).max() <= SETTLED and ((point > 0) == (H > 0)).all()
        ]
        return min(near, key=lambda point: float(abs(point - H).max())) if near else H

    def nearest(self, place: Place, H: Floats) -> Margins:
        """The simulated point of a period and fault that is nearest to a hosting vector."""
        return min(self.points[place], key=lambda one: float(abs(one.H - H).max()))

    def needs(self, place: Place) -> Floats:
        """Allowance of every margin of a period and fault, (margins,)."""
        return np.array([self.allowance.get((*place, k), 0.0) for k in range(len(self.requirement.owners))])

    def missed(self, H: Floats) -> list[Key]:
        """Margins that are not met at a point, by what was simulated there."""
        return [(*place, k) for place, one in self.at(H).items() for k in one.missed(self.needs(place))]

    def short(self, one: Margins, number: int) -> bool:
        """Whether a margin is not met, one without a value included."""
        need = self.allowance.get((*one.place, number), 0.0)
        return not one.value[number] >= need * one.size[number]

    def passing(self, key: Key) -> list[Margins]:
        """Points at which a margin is met."""
        period, fault, number = key
        return [one for one in self.points[period, fault] if not self.short(one, number)]

    def label(self, key: Key) -> str:
        """What reports call a margin."""
        return f"{self.requirement.label(key[2])}, {self._where(key[:2])}"

    def _where(self, place: Place) -> str:
        period, fault = place
        mode, beta = self.run
        return f"fault {fault}, {period}, {mode}, beta {beta:g}"

    def separated(self, key: Key, H: Floats) -> bool:
        """Whether a cut at a change of sequence excludes a point already."""
        return any(s.key == key and float(s.normal @ (H - s.passing)) < -SAME_POINT for s in self.separations)

    # -- rows ----------------------------------------------------------------------------------------------

    def unexplained(self, one: Margins, number: int) -> bool:
        """Whether the tangent at a point is wrong at one that meets the margin: it denies that point, or,
        where it fails itself, misses the margin by `JUMP` after another sequence of events.

        If not, the tangent may serve as a cut.
        """
        points = self.points[one.place]
        k = next(i for i, other in enumerate(points) if other is one)
        return bool(self._wrong(points, self.needs(one.place))[k, number])

    def denies(self, one: Margins, number: int, H: Floats) -> bool:
        """Whether the tangent at a point serves as a cut that excludes a hosting vector."""
        need = self.needs(one.place)[number] + BACKOFF
        excludes = one.linear(H)[number] < need * one.size_at(H)[number]
        return bool(excludes) and not self.unexplained(one, number)

    def rows(self, box: Floats, centre: Floats | None = None, radius: float = np.inf) -> Iterator[Row]:
        """Rows of the hosting programme.

        Parameters
        ----------
        box : array (sites,)
            Largest capacities, MW; rows that hold all over it are left out.
        centre : array (sites,), optional
            With it, only what is known there counts, or nearest to it, beside points that fail within the
            radius.
        radius : float
            MW.
        """
        for place, points in self.points.items():
            needs = self.needs(place)
            value, slope, H = _tangents(points)
            serving = self._serving(points, needs)
            if centre is not None:
                serving &= self._local(points, needs, centre, radius)[:, None]
            more = needs + BACKOFF
            slope = slope - more[:, None] * np.array([one.size_slope for one in points])
            value = value - more * np.array([one.size for one in points])
            lower = np.einsum("pmj,pj->pm", slope, H) - value
            binds = np.einsum("pmj,j->pm", np.minimum(slope, 0.0), box) < lower + NEVER_BINDS
            for k, number in zip(*np.nonzero(serving & binds), strict=True):
                yield self._row(slope[k, number], float(lower[k, number]), (*place, int(number)))
        for cut in self.separations:
            yield self._row(cut.normal, float(cut.normal @ cut.passing), cut.key, by_sequence=True)
        yield from self._without_margin()

    def _serving(self, points: Sequence[Margins], needs: Floats) -> Flags:
        """Which tangents may serve as rows, (points, margins): those that are whole, and not wrong."""
        value, slope, _ = _tangents(points)
        return np.asarray(np.isfinite(value) & np.isfinite(slope).all(axis=2) & ~self._wrong(points, needs))

    def _wrong(self, points: Sequence[Margins], needs: Floats) -> Flags:
        """Tangents that are wrong at a point that meets the margin, (points, margins)."""
        value, slope, H = _tangents(points)
        size = np.array([one.size for one in points])
        predicted = value[:, None] + np.einsum("pmj,pqj->pqm", slope, H[None] - H[:, None])
        met = value >= needs * size
        words = np.array([one.words for one in points])
        deciding = np.zeros((len(needs), len(self.sites)), dtype=bool)
        for number in range(len(needs)):
            deciding[number, list(self.requirement.involved(number))] = True
        elsewhere = (words[:, None] != words[None]) @ deciding.T  # by another sequence of events
        low = predicted < value[None] - JUMP * size[None]
        denied = predicted < (needs * size)[None]
        return np.asarray((met[None] & (denied | (~met[:, None] & elsewhere & low))).any(axis=1))

    def _local(self, points: Sequence[Margins], needs: Floats, centre: Floats, radius: float) -> Flags:
        """Which points count around a centre: the nearest, and those within the radius that fail.

        A site may always be closed, however far that is, so that closed sites tell no distance.
        """
        away = np.array([abs(np.where(one.H > 0, one.H - centre, 0.0)).max() for one in points])
        failing = np.array([bool((~(one.value >= needs * one.size)).any()) for one in points])
        return (away <= radius + SAME_POINT) & failing | (np.arange(len(points)) == away.argmin())

    def _without_margin(self) -> Iterator[Row]:
        """A site that is unknown wherever it was simulated does not pass."""
        for place, points in self.points.items():
            for site in np.flatnonzero(np.all([one.unknown for one in points], axis=0)).tolist():
                bus, why = self.sites[site], first_sentence(points[0].at.status[site])
                yield Row({bus: 0.0}, 1.0, f"no margin known, bus {bus}, {self._where(place)}: {why}", bus)

    def _row(self, a: Floats, lower: float, key: Key, by_sequence: bool = False) -> Row:
        owner, unit = self.requirement.owners[key[2]], self.requirement.unit(key[2])
        if owner is None:  # nothing hosted meets it, so that no row may ask for more than that
            lower = min(lower, 0.0)
        return Row(
            dict(zip(self.sites, a.tolist(), strict=True)),
            lower,
            f"{self.label(key)} (by sequence)" if by_sequence else self.label(key),
            site=None if owner is None else self.sites[owner],
            unit="MW" if by_sequence else unit,
            period=key[0],
            fault=key[1],
            mode=self.run[0],
            target=self.requirement.target(key[2]),
        )


def _tangents(points: Sequence[Margins]) -> tuple[Floats, Floats, Floats]:
    """Values, slopes and hosting vectors of some points."""
    return (
        np.array([one.value for one in points]),
        np.array([one.slope for one in points]),
        np.array([one.H for one in points]),
    )


def same(a: Floats, b: Floats) -> bool:
    """Whether two hosting vectors are one."""
    return bool(abs(a - b).max() < SAME_POINT)


def separation(knowledge: Knowledge, key: Key, passing: Margins, failing: Margins) -> Separation:
    """The cut between two points: across the direction in which the retained voltage changes.

    Supervisors act on the voltage, so its gradient at the sites whose sequence changes is the natural normal;
    where it does not tell the two points apart, the segment between them is.
    """
    involved = knowledge.requirement.involved(key[2])
    changed = [i for i in involved if passing.words[i] != failing.words[i]]
    step = failing.H - passing.H
    normal = passing.at.v_slope[changed or list(involved)].sum(axis=0)
    along = float(normal @ step) if np.isfinite(normal).all() else 0.0
    normal = -np.sign(along) * normal if abs(along) > 1e-9 else -step
    named = [f"bus {knowledge.sites[i]}: " if len(involved) > 1 else "" for i in changed]
    courses = [
        f"{name}{passing.words[i]} becomes {failing.words[i]}" for name, i in zip(named, changed, strict=True)
    ]
    why = "; ".join(courses) or "the same modes, but the margin is no concave function of the capacities"
    return Separation(key, normal / np.linalg.norm(normal), passing.H, failing.H, why)
