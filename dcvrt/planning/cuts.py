r"""Cuts from exact margins: what is known about a mode at a rating, as rows of the hosting programme.

A simulated margin with its total gradient gives the tangent

.. math:: m(H^k) + \nabla m(H^k) \cdot (H - H^k) \ge e

for its site, where e is the allowance by which the replay has been seen to find less, and a little more than
that. Nothing is assumed about the shape of margins: a tangent that excludes a hosting vector whose margin is
known to be met is wrong there, and is dropped; where the tangent belongs to a point that fails, a cut at the
last passing point of the segment between the two takes its place (`Separation`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dcvrt.planning.exact import TARGETS, UNITS, Exact, Key, Place, Run
from dcvrt.planning.plan import Row

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

NEVER_BINDS = 1e-9
"""Slack, in the unit of the margin, by which a row that holds all over the box is told from one that may
bind."""
BACKOFF = 1e-5
"""What a tangent asks for beyond the margin, pu or share, so that a plan on it passes in spite of its
curvature."""
SETTLED = 2e-3
"""Distance within which a plan takes the capacities of a simulated point, MW: the hosting programme itself
knows its optimum no better, as voltages agree with AC power flow to 1e-7 pu."""
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
    """All that was simulated about one mode at one rating.

    Attributes
    ----------
    sites : candidate buses.
    run : mode and rating ratio.
    exact : simulated margins by period and fault, in the order in which they were made.
    allowance : by margin, how much less the replay has found; 0 where it is not named.
    separations : cuts at changes of the event sequence.
    """

    sites: tuple[int, ...]
    run: Run
    exact: dict[Place, list[Exact]] = field(default_factory=dict)
    allowance: dict[Key, float] = field(default_factory=dict)
    separations: list[Separation] = field(default_factory=list)

    def learn(self, found: Sequence[Exact]) -> None:
        """Take in simulated margins."""
        for one in found:
            self.exact.setdefault(one.place, []).append(one)

    def at(self, H: Floats) -> dict[Place, Exact]:
        """What was simulated at a hosting vector itself."""
        return {place: one for place, points in self.exact.items() for one in points if same(one.H, H)}

    def settle(self, H: Floats) -> Floats:
        """A simulated point that the hosting programme cannot tell from a plan, or the plan itself."""
        points = [one.H for known in self.exact.values() for one in known]
        near = [
            point for point in points if abs(point - H).max() <= SETTLED and ((point > 0) == (H > 0)).all()
        ]
        return min(near, key=lambda point: float(abs(point - H).max())) if near else H

    def nearest(self, place: Place, H: Floats) -> Exact:
        """The simulated point of a period and fault that is nearest to a hosting vector."""
        return min(self.exact[place], key=lambda one: float(abs(one.H - H).max()))

    def short(self, one: Exact, site: int, target: int) -> bool:
        """Whether a margin is not met, a run without a margin included."""
        need = self.allowance.get((*one.place, site, target), 0.0)
        return not one.value[site, target] >= need

    def passing(self, key: Key) -> list[Exact]:
        """Points at which a margin is met."""
        *place, site, target = key
        return [one for one in self.exact[tuple(place)] if not self.short(one, site, target)]  # type: ignore[index]

    def label(self, key: Key) -> str:
        """What reports call a margin."""
        period, fault, site, target = key
        mode, beta = self.run
        return f"{TARGETS[target]} at bus {self.sites[site]}, fault {fault}, {period}, {mode}, beta {beta:g}"

    def separated(self, key: Key, H: Floats) -> bool:
        """Whether a cut at a change of sequence excludes a point already."""
        return any(s.key == key and float(s.normal @ (H - s.passing)) < -SAME_POINT for s in self.separations)

    # -- rows ----------------------------------------------------------------------------------------------

    def unexplained(self, one: Exact, site: int, target: int) -> Exact | None:
        """A point that meets the margin although the tangent at a failing point denies it, or None.

        The nearest such point; with None the tangent may serve as a cut.
        """
        key = (*one.place, site, target)
        met = self.passing(key)
        if not met:
            return None
        need = self.allowance.get(key, 0.0)
        denied = [q for q in met if not one.linear(q.H)[site, target] >= need]
        return min(denied, key=lambda q: float(abs(q.H - one.H).max())) if denied else None

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
        for place, points in self.exact.items():
            needs = self._needs(place)
            serving = self._serving(points, needs)
            if centre is not None:
                serving &= self._local(points, needs, centre, radius)[:, None, None]
            value, slope = np.array([one.value for one in points]), np.array([one.slope for one in points])
            H = np.array([one.H for one in points])
            lower = needs + BACKOFF - value + np.einsum("pitj,pj->pit", slope, H)
            binds = np.einsum("pitj,j->pit", np.minimum(slope, 0.0), box) < lower + NEVER_BINDS
            for k, site, target in zip(*np.nonzero(serving & binds), strict=True):
                key = (*place, int(site), int(target))
                yield self._row(slope[k, site, target], float(lower[k, site, target]), key, self.sites[site])
        for cut in self.separations:
            yield self._row(
                cut.normal, float(cut.normal @ cut.passing), cut.key, self.sites[cut.key[2]], "MW"
            )
        yield from self._without_margin()

    def _needs(self, place: Place) -> Floats:
        """Allowance of every margin of a period and fault, (sites, 2)."""
        n = len(self.sites)
        return np.array([[self.allowance.get((*place, i, t), 0.0) for t in range(2)] for i in range(n)])

    def _serving(self, points: Sequence[Exact], needs: Floats) -> Flags:
        """Which tangents may serve as rows, (points, sites, 2): those that deny no point that meets the
        margin."""
        value, slope = np.array([one.value for one in points]), np.array([one.slope for one in points])
        H = np.array([one.H for one in points])
        predicted = value[:, None] + np.einsum("pitj,pqj->pqit", slope, H[None] - H[:, None])
        denied = ((value >= needs)[None] & (predicted < needs)).any(axis=1)
        return np.asarray(np.isfinite(value) & np.isfinite(slope).all(axis=3) & ~denied)

    def _local(self, points: Sequence[Exact], needs: Floats, centre: Floats, radius: float) -> Flags:
        """Which points count around a centre: the nearest, and those within the radius that fail."""
        away = np.array([abs(one.H - centre).max() for one in points])
        failing = np.array([bool((~(one.value >= needs)).any()) for one in points])
        return (away <= radius) & failing | (np.arange(len(points)) == away.argmin())

    def _without_margin(self) -> Iterator[Row]:
        """A site at which a margin was never obtained does not pass."""
        for place, points in self.exact.items():
            for site, bus in enumerate(self.sites):
                if all(np.isnan(one.value[site]).any() for one in points):
                    key = (*place, site, 0)
                    yield Row(
                        {bus: 0.0}, 1.0, f"no margin known, {self.label(key)}: {points[0].status[site]}", bus
                    )

    def _row(self, a: Floats, lower: float, key: Key, bus: int, unit: str = "") -> Row:
        coefficients = dict(zip(self.sites, a.tolist(), strict=True))
        label = self.label(key)
        if unit == "MW":
            label = f"{label} (by sequence)"
        return Row(coefficients, lower, label, site=bus, unit=unit or UNITS[key[3]])


def same(a: Floats, b: Floats) -> bool:
    """Whether two hosting vectors are one."""
    return bool(abs(a - b).max() < SAME_POINT)


def separation(knowledge: Knowledge, key: Key, passing: Exact, failing: Exact) -> Separation:
    """The cut between two points: across the direction in which the retained voltage changes.

    Supervisors act on the voltage, so its gradient at the site is the natural normal; where it does not tell
    the two points apart, the segment between them is.
    """
    *_, site, _ = key
    step = failing.H - passing.H
    normal = passing.v_slope[site]
    along = float(normal @ step) if np.isfinite(normal).all() else 0.0
    normal = -np.sign(along) * normal if abs(along) > 1e-9 else -step
    before, after = passing.sequence[site], failing.sequence[site]
    if not after:
        why = failing.status[site]
    elif after == before:
        why = "the same modes, but the margin is no concave function of the capacities"
    else:
        why = f"{before} becomes {after}"
    return Separation(key, normal / np.linalg.norm(normal), passing.H, failing.H, why)


def worst_over(places: Mapping[Place, Exact], knowledge: Knowledge, open_sites: Sequence[int]) -> list[Key]:
    """Margins that are not met at a point, at open sites."""
    return [
        (*place, site, target)
        for place, one in places.items()
        for site in open_sites
        for target in range(2)
        if knowledge.short(one, site, target)
    ]
