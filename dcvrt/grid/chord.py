r"""Chord Newton: power flow and voltage sensitivities of many hours from one Jacobian.

Residuals are exact, so the Jacobian decides only how many steps it takes. A step turns and stretches the
voltages,

.. math:: V \leftarrow V\, \frac{1 + j\varphi/2}{1 - j\varphi/2}\, \Big(1 + \frac{\Delta |V|}{|V|}\Big),

which keeps the size of a voltage that is only turned, as exp(j phi) would, at a fraction of its time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from dcvrt.grid.steering import Sets, Steering, same_sets
from dcvrt.grid.switching import LOOKS, Limited, switched

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Phasors = npt.NDArray[np.complex128]

TOLERANCE = 1e-9
"""Largest power mismatch of a solution, pu on the system base."""
CLOSE = 3e-3
"""Mismatch below which hours are looked at for buses that switch, pu."""
HOPELESS = 1e3
"""Mismatch from which on an hour is given up, pu."""
CROWDED = 0.7
"""Share of columns still under way below which the others are taken out: copying costs time too."""
RELATIVE = 1e-9
"""Residual of sensitivities, over their right-hand side."""
SENSITIVITY_STEPS = 60
BLOCK = 256
"""Hours whose sensitivities are found together; more would not stay in the cache."""


class Chord:
    """Power flow equations for columns of hours, buses in the order `pq`, `pv`, slack.

    So angles are unknown at all buses but the last, and voltages move at the first `sizes`. Equations are P
    where the angle is unknown, then Q where the voltage moves.

    Parameters
    ----------
    admittance : sparse matrix
        Of the network.
    order : int array (buses,)
        Buses `pq` first, the slack bus last.
    pq : int
        Buses that hold nothing.
    pv : int array (buses that switch,)
        Those that hold their voltage as far as they can; their order is that of all arguments and results.
    q_low, q_high, held : arrays (buses that switch,)
        Reactive limits and set points, pu.
    """

    def __init__(
        self,
        admittance: Any,
        order: Integers,
        pq: int,
        pv: Integers,
        q_low: Floats,
        q_high: Floats,
        held: Floats,
    ) -> None:
        self._y = admittance.tocsr()[order][:, order]
        self._order, self._pq = order, pq
        self._angles, self._sizes = len(order) - 1, pq + len(held)
        place = {int(bus): k for k, bus in enumerate(pv)}
        self._swap = np.array([place[int(bus)] for bus in order[pq : self._sizes]], dtype=np.int64)
        self._q_low, self._q_high, self._held = q_low[self._swap], q_high[self._swap], held[self._swap]
        self.moving = order[: self._sizes]
        """Buses whose voltage moves, in the order of the equations."""

    def solve(
        self, s: Phasors, start: Phasors, steering: Steering, steps: int, limited: Limited
    ) -> tuple[Phasors, Floats, Integers, Limited]:
        """Solve all columns; those that are done leave the loop.

        Parameters
        ----------
        s, start : complex arrays (buses, hours)
            Injections and start values, pu.
        steering : Steering
        steps : int
        limited : int array (buses that switch, hours)
            Limits that buses are at in `start`.

        Returns
        -------
        v : complex array (buses, hours)
        mismatch : array (hours,)
            Largest one, pu; infinite where buses still want to switch.
        bus : int array (hours,)
            Where it is.
        limited : int array (buses that switch, hours)
        """
        count = s.shape[1]
        solved, at_end = np.empty_like(start), np.empty_like(limited)
        mismatch, bus = np.full(count, np.inf), np.zeros(count, dtype=np.int64)
        todo = np.arange(count)
        v, demand, at = start[self._order], s[self._order], limited[self._swap]
        place = self._order[np.r_[: self._angles, : self._sizes]]
        looks = np.zeros(count, dtype=np.int64)
        sets: Sets | None = None
        with np.errstate(all="ignore"):
            for step in range(1, steps + 1):
                rest, q = self._mismatch(v, demand, at)
                level = abs(rest).max(axis=0, initial=0.0)
                if len(self._held) and self._look(v, demand, at, looks, rest, q, level):
                    sets = None
                going = (level >= TOLERANCE) & (level < HOPELESS) & (step < steps)
                if going.mean() < CROWDED or not (level < HOPELESS).all():
                    left = np.flatnonzero(~going)
                    done = todo[left]
                    solved[np.ix_(self._order, done)] = v[:, left]
                    at_end[np.ix_(self._swap, done)] = at[:, left]
                    mismatch[done] = np.where(np.isfinite(level[left]), level[left], np.inf)
                    bus[done] = place[abs(rest[:, left]).argmax(axis=0)]
                    if not going.any():
                        break
                    todo, v, demand, at = todo[going], v[:, going], demand[:, going], at[:, going]
                    looks, rest, sets = looks[going], rest[:, going], None
                sets = same_sets(at != 0) if sets is None else sets
                self._move(v, steering.step(rest, sets))
        return solved, mismatch, bus, at_end

    def _mismatch(self, v: Phasors, demand: Phasors, at: Limited) -> tuple[Floats, Floats]:
        """Missed equations: P where the angle is unknown, Q where the voltage moves (0 where it is held);
        and the reactive output of the buses that switch."""
        power = v * (self._y @ v).conj()
        power -= demand
        n, m = self._angles, self._sizes
        rest = np.empty((n + m, v.shape[1]))
        rest[:n], rest[n:] = power.real[:n], power.imag[:m]
        q = power.imag[self._pq : m]
        if len(q):
            low, high = self._q_low[:, None], self._q_high[:, None]
            rest[n + self._pq :] = np.where(at == 0, 0.0, q - np.where(at > 0, high, low))
        return rest, q

    def _look(
        self,
        v: Phasors,
        demand: Phasors,
        at: Limited,
        looks: Integers,
        rest: Floats,
        q: Floats,
        level: Floats,
    ) -> bool:
        """Switch buses of columns that are close to a solution, and say whether any did; all arguments but
        `demand` and `q` change."""
        close = np.flatnonzero(level < CLOSE)
        if not len(close):
            return False
        size = np.asarray(abs(v[self._pq : self._sizes, close]), dtype=np.float64)
        was = at[:, close]
        now = switched(
            was, q[:, close], size, self._held, self._q_low, self._q_high, looks[close] < LOOKS // 2
        )
        wants = (now != was).any(axis=0)
        level[close[wants & (looks[close] >= LOOKS)]] = np.inf
        wants &= looks[close] < LOOKS
        if not wants.any():
            return False
        changed = close[wants]
        looks[changed] += 1
        at[:, changed] = now = now[:, wants]
        back = np.where(now == 0, self._held[:, None] / size[:, wants], 1.0)
        moved = v[:, changed]
        moved[self._pq : self._sizes] *= back
        v[:, changed] = moved
        rest[:, changed] = self._mismatch(moved, demand[:, changed], now)[0]
        level[changed] = 1.0
        return True

    def _move(self, v: Phasors, move: Floats) -> None:
        """Turn and stretch voltages by a step of angles and sizes."""
        half = -0.5 * move[: self._angles]
        turn = np.empty(half.shape, dtype=np.complex128)
        square = half * half
        over = 1.0 / (1.0 + square)
        np.multiply(1.0 - square, over, out=turn.real)
        np.multiply(2.0 * half, over, out=turn.imag)
        sizes = v[: self._sizes]
        sizes *= 1.0 - move[self._angles :] / abs(sizes)
        v[: self._angles] *= turn

    def sensitivities(
        self,
        v: Phasors,
        right: Floats,
        scale: Floats,
        steering: Steering,
        limited: Limited,
        exactly: Callable[[int, Floats], Floats],
    ) -> Floats:
        r"""Derivatives of the voltages that move, (buses `pq` and `pv`, hours, directions).

        With dV = V z, where Im z are changes of angles and Re z relative changes of sizes, the power changes
        by :math:`S z + V (Y V z)^*`.

        Parameters
        ----------
        v : complex array (buses, hours)
            Solved voltages.
        right : array (rows, directions)
            Change of the injections per unit of each direction, by the equations.
        scale : array (hours,)
            Factor on every direction.
        exactly : callable
            Solution of one column for a right-hand side, where one Jacobian no longer steers all.
        """
        n, m = self._angles, self._sizes
        result = np.empty((m, v.shape[1], right.shape[1]))
        rows = np.r_[: self._pq, self._pq + self._swap]
        for begin in range(0, v.shape[1], BLOCK):
            part = slice(begin, min(begin + BLOCK, v.shape[1]))
            now, at = v[self._order, part], limited[self._swap, part]
            size, power = abs(now[:m]), now * (self._y @ now).conj()
            held, sets = at == 0, same_sets(at != 0)
            z = np.zeros_like(now)
            for j in range(right.shape[1]):
                wanted = np.outer(right[:, j], scale[part])
                wanted[n + self._pq :][held] = 0.0
                enough = RELATIVE * abs(wanted).max(initial=0.0)
                x = steering.step(wanted, sets)
                rest = np.empty_like(wanted)
                for _ in range(SENSITIVITY_STEPS):
                    z.real[:m], z.imag[:n] = x[n:] / size, x[:n]
                    change = power * z + now * (self._y @ (now * z)).conj()
                    rest[:n], rest[n:] = change.real[:n], change.imag[:m]
                    rest[n + self._pq :][held] = 0.0
                    rest -= wanted
                    if abs(rest).max(initial=0.0) <= enough:
                        break
                    x -= steering.step(rest, sets)
                else:  # close to the limit of power transfer
                    for k in range(x.shape[1]):
                        x[:, k] = exactly(begin + k, wanted[:, k])
                result[rows, part, j] = x[n:]
        return result
