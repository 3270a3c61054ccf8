"""Agreement of the linear voltage screen with AC power flow at the optimum of the master programme."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.errors import SimulationError
from dcvrt.grid.powerflow import HourlySolution
from dcvrt.planning.master import Cut, Master, Solution
from dcvrt.planning.plan import VoltageInfo
from dcvrt.planning.voltage_screen import Tangent, VoltageScreen

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

GUARD = 2e-5
"""Hours whose expected voltage is closer to a limit than this are solved by AC power flow, pu."""
WIDENING = 2.5
"""The band is at least this times the largest error of the expectation found near a limit."""
NEAR = 5e-4
"""Distance to a limit within which screen and AC power flow must agree, pu."""
AGREED_EVERYWHERE = 1e-4
"""Difference of screen and AC power flow that is let pass near limits where none binds, pu."""
AGREED_AT_LIMITS = 1e-7
"""The same where a limit binds, and the AC violation that is let pass, pu."""
VALIDATED = 20
"""Hours that are solved to measure the error of the expectation where none is near a limit."""
MARGIN = 0.01
"""Buses that the screen keeps farther from their limits than this in every hour are left out, pu, unless the
screen proves wrong by half of it somewhere."""
STEEP = 3e-4
"""Hours closer to a limit than this get new slopes, pu."""
PASSES = 200
"""Linearisations before it is given up: with fewer limits that bind than sites they come nearer by a constant
factor only."""
TOGETHER = 300
"""Hours that are solved at a time where only the nearest to a limit are looked at."""
HALVINGS = 10
"""Halved steps towards sizes without a solution before they count as out of reach."""


class Agreement:
    """Moves the screen to the optimum, pass by pass, until AC power flow says the same.

    Few hours are solved: a sample tells how voltages fall with the parameters of an hour (`VoltageDrop`), and
    hours that are expected near a limit are solved, with a guard band that the errors of the expectation
    justify; each error is that of an hour before it was solved. `check_ac` solves all hours. Tangents from
    earlier passes stay as cuts while they exclude nothing that AC power flow allows (`Tangent.bounds`); with
    voltages concave in H that is always so, and the passes converge also where fewer limits bind than there
    are sites.

    Parameters
    ----------
    screen : VoltageScreen
    repeat : bool
        Whether the screen is moved at all; else one look tells how wrong it is.
    thorough : bool
        Whether every hour that may be near a limit is solved; else only the hours in which the screen has
        each bus nearest: what it then agrees to is to be confirmed by `allows`. A screen
            that has never agreed in every hour is always looked at thoroughly.
    """

    def __init__(self, screen: VoltageScreen, repeat: bool = True, thorough: bool = True) -> None:
        self.screen, self.repeat = screen, repeat
        self.thorough = thorough or not screen.settled
        self.passes, self.checked = 0, 0
        self.guard = GUARD
        self.error, self.lowest, self.highest = 0.0, np.nan, np.nan
        self.least_room = np.zeros(0)
        self._solvable = np.zeros(screen.slope.shape[-1])

    def reached(self, solution: Solution, master: Master) -> bool:
        """Compare at the optimum; if they differ, linearise again and renew the cuts of `master`."""
        try:
            agrees = self._compare(solution, master)
        except SimulationError:
            if not self.repeat:
                raise
            self._retreat(solution.H, master)
            return False
        self._solvable = solution.H
        return agrees

    def _retreat(self, H: Floats, master: Master) -> None:
        """Where AC power flow has no solution, linearise on the way there from the last sizes that had one.

        Beyond the limit of power transfer there is nothing to linearise; before it voltages fall steeper and
        steeper, so that the tangents there cut off what lies beyond.
        """
        tangents = [cut.origin for cut in master.cuts if isinstance(cut.origin, Tangent)]
        for halvings in range(1, HALVINGS + 1):
            nearer = self._solvable + (H - self._solvable) / 2**halvings
            try:
                look = self._look(nearer, tangents)
            except SimulationError:
                if halvings == HALVINGS:
                    raise
                continue
            self._solvable = nearer
            self._move(nearer, look, master)
            return

    def _compare(self, solution: Solution, master: Master) -> bool:
        tangents = [cut.origin for cut in master.cuts if isinstance(cut.origin, Tangent)]
        look: _Look | None = None
        if self.repeat and tangents:
            look = self._glance(solution.H, tangents)
            if self._overstates(look) > AGREED_AT_LIMITS:
                return self._move(solution.H, look, master)
        if look is None or self.thorough:
            look = self._look(solution.H, tangents)
        self.checked = len(look.hours)
        size = self.screen.sizes(look.solved)
        self.lowest, self.highest = float(size.min()), float(size.max())
        if not self.repeat:
            return True
        apart = self._differs(solution.H, look, tangents)
        if apart <= AGREED_AT_LIMITS and self.error <= AGREED_EVERYWHERE:
            self.screen.settled |= self.thorough
            return True
        return self._move(solution.H, look, master)

    def _overstates(self, look: _Look) -> float:
        """Largest AC violation of a limit, pu."""
        size = self.screen.sizes(look.solved)
        return -float(self.screen.room(size, np.arange(len(size)), look.hours).min())

    def _differs(self, H: Floats, look: _Look, tangents: list[Tangent]) -> float:
        """Largest AC violation, and largest error of a tangent that is met without room, pu."""
        size = self.screen.sizes(look.solved)
        place = {int(hour): k for k, hour in enumerate(look.hours)}
        tight = _tight(tangents, H)
        apart = [abs(t.constant + t.slope @ H - size[t.bus, place[t.hour]]) for t in tight]
        return max([self._overstates(look), *apart])

    def _move(self, H: Floats, look: _Look, master: Master) -> bool:
        """Linearise again at `H` and renew the cuts of `master`."""
        screen, hours = self.screen, look.hours
        size = screen.sizes(look.solved)
        self.passes += 1
        if self.passes > PASSES:
            room = screen.room(size, np.arange(len(size)), hours)
            bus, k = np.unravel_index(room.argmin(), room.shape)
            raise SimulationError(
                f"Voltage screen and AC power flow still differ after {PASSES} linearisations; the voltage "
                "nearest to its limit, or farthest beyond, is at bus "
                f"{screen.network.bus[screen.moving[bus]]} in hour {screen.year.hours[hours[k]]}. "
                "Ways out: a smaller h_max, or voltage_screen='one-shot' with check_ac."
            )
        tangents = [cut.origin for cut in master.cuts if isinstance(cut.origin, Tangent)]
        self._linearise(H, look, tangents)
        place = {int(hour): k for k, hour in enumerate(hours)}

        def stays(cut: Cut) -> bool:
            t = cut.origin
            if not isinstance(t, Tangent):
                return True
            if t.hour not in place:
                return look.expected is None
            return t.bounds(H, size[t.bus, place[t.hour]])

        moved = [t.key for t in tangents if t.hour in place or look.expected is not None]
        renewed = [screen.tangent(*key) for key in dict.fromkeys(moved)]
        master.cuts = [cut for cut in master.cuts if stays(cut)]
        master.cuts += [Cut(*t.cut(), origin=t) for t in renewed]
        return False

    def _linearise(self, H: Floats, look: _Look, tangents: list[Tangent]) -> None:
        """Move the screen to `H`, with new slopes where a voltage is near a limit or a tangent has it there:
        one made beyond the corner at which a unit leaves its limit would come back pass after pass."""
        size = self.screen.sizes(look.solved)
        room = self.screen.room(size, np.arange(len(size)), look.hours)
        tight = np.isin(look.hours, [t.hour for t in _tight(tangents, H)])
        steep = np.flatnonzero((room.min(axis=0) < STEEP) | tight)
        self.screen.relinearise(H, look.hours, look.solved, steep, look.rows, look.expected)

    def allows(self, H: Floats, tangents: list[Tangent]) -> bool:
        """Whether AC power flow keeps every voltage within its limits at `H`, whatever the screen says.

        Where it does not, the screen is moved there and knows from now on.
        """
        try:
            look = self._look(H, tangents)
        except SimulationError:
            return False
        if self._overstates(look) <= AGREED_AT_LIMITS:
            return True
        self._linearise(H, look, tangents)
        return False

    def restart(self, H: Floats, master: Master) -> bool:
        """Move the screen to some sizes, where the master found no plan; whether all limits hold at these.

        A linearisation made elsewhere can understate voltages where a unit leaves its reactive limit.
        """
        tangents = [cut.origin for cut in master.cuts if isinstance(cut.origin, Tangent)]
        try:
            look = self._look(H, tangents)
        except SimulationError:
            return False
        self._move(H, look, master)
        return self._overstates(look) <= AGREED_AT_LIMITS

    def _glance(self, H: Floats, tangents: list[Tangent]) -> _Look:
        """Solve only the hours in which a tangent is met without room and the worst hour of each bus near a
        limit, or the nearest hours of all: enough to see most limits that the screen lets be broken."""
        screen = self.screen
        rows = screen.near(H, 0.0)
        linear = screen.voltages(H, rows)
        room = screen.room(linear, rows)
        self.least_room = np.minimum(room.min(axis=0, initial=MARGIN), MARGIN)
        if self.thorough or not len(rows):
            worst = room.argmin(axis=1)
        else:  # where the screen was made elsewhere it may be wrong in many hours: mend them together
            worst = np.argsort(self.least_room, kind="stable")[:TOGETHER]
        hours = np.unique(np.r_[worst, [t.hour for t in _tight(tangents, H)]].astype(np.int64))
        if not len(hours):
            hours = np.array([tangents[0].hour])
        solved = screen.ac.solve(H, hours).require()
        self.error = _error(screen, rows, hours, screen.sizes(solved)[rows], linear[:, hours])
        return _Look(rows, hours, solved, None)

    def _look(self, H: Floats, tangents: list[Tangent]) -> _Look:
        """Solve the hours that matter at `H`, and say what to expect in the others."""
        screen = self.screen
        rows = screen.near(H, MARGIN)
        linear = screen.voltages(H, rows)
        room = screen.room(linear, rows)
        self.least_room = np.minimum(room.min(axis=0, initial=MARGIN), MARGIN)
        worst = room.argmin(axis=1)
        if not self.repeat:  # a sample is enough to tell how wrong the screen is
            hours = np.array([int(self.least_room.argmin())])
            solved = screen.ac.solve(H, hours).require()
            size = screen.sizes(solved)[rows]
            self.error = _error(screen, rows, hours, size, linear[:, hours])
            return _Look(rows, hours, solved, linear)
        tight = [t.hour for t in _tight(tangents, H)]
        fresh = np.unique(np.r_[screen.interpolation.sample, worst, np.array(tight, dtype=np.int64)])
        hours = np.zeros(0, dtype=np.int64)
        found: list[HourlySolution] = []
        size, missed, expected = np.zeros((len(rows), 0)), 0.0, linear
        while len(fresh):
            solved = screen.ac.solve(H, fresh).require()
            now = screen.sizes(solved)
            if found:  # what was expected before these hours were solved
                missed = max(missed, _missed(screen, rows, fresh, now[rows], expected))
            else:
                off = abs(now - screen.constant[:, fresh] - screen.slope[:, fresh] @ H).max()
                if 2 * off > MARGIN and len(rows) < len(now):
                    rows = np.arange(len(now))  # the screen is too wrong to leave any bus out
                    linear, size = screen.voltages(H), np.zeros((len(rows), 0))
            found.append(solved)
            hours, size = np.r_[hours, fresh], np.hstack([size, now[rows]])
            base = screen.unhosted[rows]
            if len(hours) < len(screen.year):
                expected = base - screen.interpolation.expect(base[:, hours] - size, hours)
            else:
                expected = linear.copy()
            missed = max(missed, _missed(screen, rows, hours, size, expected))
            expected[:, hours] = size
            self.guard = max(GUARD, WIDENING * missed)
            trusted = len(found) == 1 and self.guard <= AGREED_EVERYWHERE
            if (
                trusted
                and self._differs(H, _Look(rows, hours, solved, expected), tangents) > AGREED_AT_LIMITS
            ):
                break  # the optimum will move, and what is expected is good enough to move it
            room = screen.room(expected, rows).min(axis=0, initial=np.inf)
            room[hours] = np.inf
            fresh = np.flatnonzero(room < self.guard)
            if not len(fresh) and len(found) == 1:  # an error must have been measured
                fresh = np.argsort(room, kind="stable")[:VALIDATED]
                fresh = np.sort(fresh[np.isfinite(room[fresh])])
        self.error = _error(screen, rows, slice(None), expected, linear)
        return _Look(rows, hours, _joined(found), expected)

    def info(self) -> VoltageInfo:
        """What to tell about the last comparison."""
        return VoltageInfo(
            "relinearised" if self.repeat else "one-shot",
            self.passes,
            self.guard,
            self.checked,
            self.error,
            self.lowest,
            self.highest,
            self.screen.widened,
            self.least_room,
        )


@dataclass(frozen=True, eq=False)
class _Look:
    """What AC power flow says at some capacities.

    Attributes
    ----------
    rows : int array (rows,)
        Moving buses that may be near a limit in some hour.
    hours : int array (hours,)
        Positions of the hours that were solved.
    solved : HourlySolution
        Of these hours.
    expected : array (rows, all hours) or None
        Voltages, pu: solved where they were, else interpolated; None where only some hours were asked for.
    """

    rows: Integers
    hours: Integers
    solved: HourlySolution
    expected: Floats | None


def _tight(tangents: list[Tangent], H: Floats) -> list[Tangent]:
    """Tangents that are met without room at `H`."""
    return [t for t in tangents if t.side * (t.limit - t.constant - t.slope @ H) < AGREED_AT_LIMITS]


def _missed(screen: VoltageScreen, rows: Integers, hours: Integers, true: Floats, expected: Floats) -> float:
    """Largest error of the expectation among voltages near a limit in some hours."""
    close = screen.room(true, rows, hours) < NEAR
    return float(abs(true - expected[:, hours])[close].max(initial=0.0))


def _error(
    screen: VoltageScreen, rows: Integers, hours: Integers | slice, true: Floats, linear: Floats
) -> float:
    """Largest difference where either voltage is near a limit."""
    room = np.minimum(screen.room(true, rows, hours), screen.room(linear, rows, hours))
    return float(abs(true - linear)[room < NEAR].max(initial=0.0))


def _joined(found: list[HourlySolution]) -> HourlySolution:
    """Solutions of different hours as one."""
    return HourlySolution(
        np.hstack([s.v for s in found]),
        np.concatenate([s.converged for s in found]),
        np.concatenate([s.mismatch_mva for s in found]),
        np.concatenate([s.worst_bus for s in found]),
        np.concatenate([s.hours for s in found]),
        np.hstack([s.limited for s in found]),
    )
