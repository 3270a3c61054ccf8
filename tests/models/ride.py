"""A small reference loop for tests: a Dae on a waveform, with SciPy and located mode changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from dcvrt.dae import Dae


class System:
    """Numeric functions of an explicit Dae with at most one automaton."""

    def __init__(self, dae: Dae, **changes: float) -> None:
        assert dae.z.numel() == 0
        self.dae = dae
        self.p = dae.parameter_values(**changes)
        args = [dae.x, dae.u, dae.p, dae.q, dae.clocks]
        self.f = ca.Function("f", args, [dae.f])
        self.y = ca.Function("y", args, [dae.y])
        self.jacobian = ca.Function("A", args, [ca.jacobian(dae.f, dae.x)])
        self.start = ca.Function("start", [dae.u, dae.p], [dae.start])
        self.automaton = dae.automata[0] if dae.automata else None
        rows = self.automaton.rows if self.automaton else ()
        self.rows = rows
        self.guards = ca.Function(
            "guards", args, [ca.vertcat(*[r.guard for r in rows]) if rows else ca.SX(0, 1)]
        )
        self._held = ca.Function(
            "held", [dae.p], [ca.vertcat(*[r.held for r in rows]) if rows else ca.SX(0, 1)]
        )

    def set(self, **changes: float) -> System:
        """Other parameter values, from the defaults."""
        self.p = self.dae.parameter_values(**changes)
        return self

    @property
    def held(self) -> np.ndarray:
        return np.array(self._held(self.p)).ravel()

    def flags(self, mode: str) -> np.ndarray:
        return self.automaton.flags[self.automaton.mode_number(mode)] if self.automaton else np.zeros(0)

    def rate(self, x: np.ndarray, u: np.ndarray, mode: str = "", clock: float = 0.0) -> np.ndarray:
        clocks = [clock] if self.automaton else []
        return np.array(self.f(x, u, self.p, self.flags(mode), clocks)).ravel()

    def out(self, x: np.ndarray, u: np.ndarray, mode: str = "", clock: float = 0.0) -> np.ndarray:
        clocks = [clock] if self.automaton else []
        return np.array(self.y(x, u, self.p, self.flags(mode), clocks)).ravel()

    def matrix(self, x: np.ndarray, u: np.ndarray, mode: str) -> np.ndarray:
        return np.array(self.jacobian(x, u, self.p, self.flags(mode), [0.0]))

    def equilibrium(self, u: np.ndarray, steps: int = 50) -> np.ndarray:
        """Newton from the start values; raises when it does not arrive."""
        mode = self.automaton.start
        x = np.array(self.start(u, self.p)).ravel()
        for _ in range(steps):
            r = self.rate(x, u, mode)
            if np.abs(r).max() < 1e-9:
                return x
            x = x - np.linalg.solve(self.matrix(x, u, mode), r)
        worst = np.argsort(-np.abs(r))[:5]
        raise ArithmeticError(
            "no equilibrium: " + ", ".join(f"{self.dae.x_names[k]} {r[k]:.2e}" for k in worst)
        )


@dataclass
class Ride:
    t: np.ndarray
    x: np.ndarray
    y: dict[str, np.ndarray]
    modes: list[tuple[float, str]] = field(default_factory=list)

    @property
    def walk(self) -> list[str]:
        return [mode for _, mode in self.modes]


def ride(
    system: System,
    voltage: Callable[[float], complex],
    jumps: tuple[float, ...],
    until: float,
    g_it: Callable[[float], float] = lambda t: 1.0,
    step: float = 5e-4,
    rtol: float = 1e-7,
) -> Ride:
    """Integrate in slices of `step`; modes change at the end of the slice in which a row came due."""

    def u(t: float) -> np.ndarray:
        v = voltage(t)
        return np.array([v.real, v.imag, g_it(t)])

    x = system.equilibrium(u(0.0))
    mode, entered = system.automaton.start, 0.0
    since, held = np.full(len(system.rows), np.nan), system.held
    ts, xs, ys, modes = [0.0], [x], [system.out(x, u(0.0), mode)], [(0.0, mode)]
    grid = np.unique(np.concatenate([np.arange(0.0, until + step / 2, step), np.array(jumps)]))
    for a, b in pairwise(grid):
        inside = lambda t, a=a, b=b: u(a + (b - a) * np.clip((t - a) / (b - a), 1e-9, 1 - 1e-9))  # noqa: E731
        for _ in range(20):
            g = np.array(system.guards(x, inside(a), system.p, system.flags(mode), [a - entered])).ravel()
            due = None
            for k, row in enumerate(system.rows):
                if row.source != mode or g[k] <= 0:
                    since[k] = np.nan
                    continue
                if np.isnan(since[k]):
                    since[k] = a
                if due is None and a - max(since[k], entered) >= held[k] - 1e-12:
                    due = row
            if due is None:
                break
            mode, entered = due.target, a
            since[:] = np.nan
            modes.append((a, mode))
        rhs = lambda t, x, mode=mode, start=entered, u=inside: system.rate(x, u(t), mode, t - start)  # noqa: E731
        done = solve_ivp(rhs, (a, b), x, method="LSODA", rtol=rtol, atol=1e-9)
        assert done.success, done.message
        x = done.y[:, -1]
        ts.append(b)
        xs.append(x)
        ys.append(system.out(x, inside(b), mode, b - entered))
    y = np.array(ys)
    return Ride(np.array(ts), np.array(xs), {n: y[:, k] for k, n in enumerate(system.dae.y_names)}, modes)


def sag(retained: float, start: float = 0.1, length: float = 0.1, before: complex = 1.0, jump: float = 0.0):
    """Voltage function and its jumps: a rectangular sag with an optional phase jump (rad)."""
    low = retained * before * np.exp(1j * jump)
    return (lambda t: low if start <= t < start + length else complex(before)), (start, start + length)
