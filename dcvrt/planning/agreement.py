"""Agreement of the linear voltage screen with AC power flow at the optimum of the master programme."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dcvrt.errors import SimulationError
from dcvrt.planning.master import Cut, Master, Solution
from dcvrt.planning.plan import VoltageInfo
from dcvrt.planning.voltage_screen import Tangent, VoltageScreen

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

GUARD = 5e-4
"""Hours with a linear voltage closer to a limit than this are solved by AC power flow, pu."""
WIDENING = 2.5
"""The band of a bus is at least this times the largest error found at the bus."""
AGREED_EVERYWHERE = 1e-4
"""Difference of screen and AC power flow that is let pass within the guard bands where no limit binds, pu."""
AGREED_AT_LIMITS = 1e-7
"""The same where a limit binds, and the AC violation that is let pass, pu."""
STEEP = 3e-4
"""Hours closer to a limit than this get new slopes, pu."""
PASSES = 40


class Agreement:
    """Moves the screen to the optimum, pass by pass, until AC power flow says the same.

    Only hours near a limit are solved. The guard band of a bus is at least `WIDENING` times the largest error
    found there, so an hour left out would need an error that much larger to reach a limit; `check_ac`
    solves all. Tangents from earlier passes stay as cuts while they exclude nothing that AC power flow
    allows (`Tangent.bounds`); with voltages concave in H that is always so, and the passes converge also
    where fewer limits bind than there are sites.
    """

    def __init__(self, screen: VoltageScreen, repeat: bool) -> None:
        self.screen, self.repeat = screen, repeat
        self.passes, self.checked = 0, 0
        self.guard = np.full(len(screen.pq), GUARD)
        self.error, self.lowest, self.highest = 0.0, np.nan, np.nan

    def reached(self, solution: Solution, master: Master) -> bool:
        """Compare at the optimum; if they differ, linearise again and renew the cuts of `master`."""
        screen, H = self.screen, solution.H
        hours, v = self._solve_near_limits(H)
        if not self.repeat:
            return True
        size = abs(v[screen.pq])
        room = np.minimum(size - screen.lower[:, hours], screen.upper[:, hours] - size)
        place = {int(hour): k for k, hour in enumerate(hours)}
        tangents = [cut.origin for cut in master.cuts if isinstance(cut.origin, Tangent)]
        tight = [t for t in tangents if t.side * (t.limit - t.constant - t.slope @ H) < AGREED_AT_LIMITS]
        at_limits = max(
            (abs(t.constant + t.slope @ H - size[t.bus, place[t.hour]]) for t in tight), default=0.0
        )
        if max(-room.min(), at_limits) <= AGREED_AT_LIMITS and self.error <= AGREED_EVERYWHERE:
            return True
        self.passes += 1
        if self.passes > PASSES:
            bus, k = np.unravel_index(room.argmin(), room.shape)
            raise SimulationError(
                "Voltage screen and AC power flow still differ by "
                f"{max(-room.min(), at_limits):.2g} pu after {PASSES} linearisations, most at bus "
                f"{screen.network.bus[screen.pq[bus]]} in hour {screen.year.hours[hours[k]]}. "
                "Ways out: a smaller h_max, or voltage_screen='one-shot' with check_ac."
            )
        screen.relinearise(H, hours, v, np.flatnonzero(room.min(axis=0) < STEEP))
        kept = [
            cut
            for cut in master.cuts
            if not isinstance(cut.origin, Tangent)
            or cut.origin.hour not in place
            or cut.origin.bounds(H, size[cut.origin.bus, place[cut.origin.hour]])
        ]
        moved = dict.fromkeys(t.key for t in tangents if t.hour in place)
        renewed = [screen.tangent(*key) for key in moved]
        master.cuts = kept + [Cut(*t.cut(), origin=t) for t in renewed]
        return False

    def _solve_near_limits(self, H: Floats) -> tuple[Integers, npt.NDArray[np.complex128]]:
        """AC voltages of every hour near a limit, with guard bands that the errors found justify."""
        screen = self.screen
        linear = screen.voltages(H)
        room = np.minimum(linear - screen.lower, screen.upper - linear)
        hours = np.unique(room.argmin(axis=1))  # the worst hour of each bus, to see what errors there are
        v = np.zeros((len(screen.network.bus), 0), dtype=complex)
        solved = np.zeros(0, dtype=np.int64)
        error = np.zeros(len(screen.pq))
        while len(hours):
            fresh = screen.ac.solve(H, hours).require().v
            error = np.maximum(error, abs(abs(fresh[screen.pq]) - linear[:, hours]).max(axis=1))
            solved, v = np.r_[solved, hours], np.hstack([v, fresh])
            self.guard = np.maximum(GUARD, WIDENING * error)
            if not self.repeat:
                break  # a sample is enough to tell how wrong it is
            near: npt.NDArray[np.bool_] = np.any(room < self.guard[:, None], axis=0)
            near[solved] = False
            hours = np.flatnonzero(near)
        size = abs(v[screen.pq])
        self.checked = len(solved)
        close = room[:, solved] < self.guard[:, None]
        self.error = float(abs(size - linear[:, solved])[close].max(initial=0.0))
        self.lowest, self.highest = float(size.min()), float(size.max())
        return solved, v

    def info(self, H: Floats) -> VoltageInfo:
        """What to tell about the last comparison."""
        linear = self.screen.voltages(H)
        room = np.minimum(linear - self.screen.lower, self.screen.upper - linear).min(axis=0)
        return VoltageInfo(
            "relinearised" if self.repeat else "one-shot",
            self.passes,
            float(self.guard.max()),
            self.checked,
            self.error,
            self.lowest,
            self.highest,
            self.screen.widened,
            room,
        )
