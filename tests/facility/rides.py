"""What the tests of the variants share: an audit beside the facility, short timers, waveforms."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from dcvrt import Simulator, Waveform, facility
from dcvrt.integrators import Casadi
from dcvrt.models import Block, Diagram, Equations, Input, State
from dcvrt.trajectory import Trajectory

FIXED = (
    "v_it", "p_g", "q_g", "i_g", "i_max", "p_b", "soc", "w_dc", "p_load", "p_out", "p_it", "p_cool", "mode",
    "stored", "p_loss",
)  # fmt: skip
"""Outputs of every variant, in their order."""
TIGHT = Casadi("erk", rtol=1e-9, atol=1e-11)


class Audit(Block):
    """Energy that has come in and not gone out, by the solver that integrates the facility."""

    p_g = Input("pu(S)", "import")
    p_out = Input("pu(S)", "power of the loads")
    p_loss = Input("pu(S)", "losses")
    net = State(0.0, "pu(S) s", "integral of what comes in less what goes out")

    def equations(self, s: Any) -> Equations:
        return Equations(der=dict(net=s.p_g - s.p_out - s.p_loss))


def audited(f: Diagram) -> Diagram:
    """The diagram with the audit added to it, fed by its outputs."""
    audit = f.add("audit", Audit())
    for name in ("p_g", "p_out", "p_loss"):
        path, port = f.outputs[name]
        f.connect(f.port(f"{path}.{port}"), getattr(audit, name))
    f.output("net", audit.net)
    return f


SHORT = {
    "line-interactive": {
        "control.T_qualify": 0.2, "walk.T_walk": 0.3, "supply.T_restart": 0.1, "supply.T_ramp": 0.2,
    },
    "eco-mode": {
        "control.T_start": 0.1, "walk.T_walk": 0.3, "control.T_requalify": 0.3, "supply.T_restart": 0.1,
        "supply.T_ramp": 0.2,
    },
    "no-ups": {
        "supply.T_restart": 0.2, "supply.T_ramp": 0.3, "cooling.T_off": 0.1, "cooling.T_stage": 0.1,
    },
}  # fmt: skip
"""Timers of seconds to minutes made short, so that a test sees the whole cycle."""


@cache
def simulator(name: str, *wrt: str, tight: bool = True) -> Simulator:
    f = audited(facility.get(name))
    return Simulator(f.compile(), TIGHT if tight else None, wrt=wrt, save_at=5e-3)


def ride(name: str, waveform: Waveform, *wrt: str, **parameters: float) -> Trajectory:
    return simulator(name, *wrt)(waveform, **(SHORT[name] | parameters))


def sag(retained: float, length: float = 0.1, until: float = 2.0) -> Waveform:
    return Waveform.sag(retained, 0.1, length, until=until)


def six_sags(retained: float = 0.3, length: float = 0.06, apart: float = 0.4) -> Waveform:
    """Six dips, closer than the units need to come back."""
    steps = [(0.0, 1.0)]
    for k in range(6):
        steps += [(0.1 + k * apart, retained), (0.1 + k * apart + length, 1.0)]
    return Waveform.segments(steps, until=0.1 + 6 * apart + 1.5)


def walk(run: Trajectory, automaton: str) -> list[str]:
    return [e.target for e in run.events if e.automaton == automaton]


def when(run: Trajectory, automaton: str, target: str) -> list[float]:
    return [e.time for e in run.events if (e.automaton, e.target) == (automaton, target)]


def check_slopes(
    run: Trajectory, up: Trajectory, down: Trajectory, step: float, theta: str, signals: tuple[str, ...]
) -> None:
    """Exact derivatives against central differences, at samples away from every event and jump."""
    breaks = np.concatenate([[e.time for r in (run, up, down) for e in r.events], run.t[run.breaks]])
    near = np.abs(np.subtract.outer(run.t, breaks)).min(axis=1)
    at = np.flatnonzero(near > 2e-3)[::5]
    assert len(at) > 10
    for signal in signals:
        by_difference = (up.at(signal, run.t[at]) - down.at(signal, run.t[at])) / (2 * step)
        exact = run.sens[signal, theta][at]
        np.testing.assert_allclose(exact, by_difference, rtol=1e-4, atol=1e-4 * np.abs(exact).max())
        assert np.abs(exact).max() > 0
