"""Random parameters and waveforms: the kernel agrees with a tight reference, or says why it ended."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.criteria import Criteria, margins
from dcvrt.dae import Dae
from dcvrt.errors import SimulationError
from dcvrt.integrators import Casadi, Kernel, Simulator, find_compiler
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")
VARIED = {
    "beta": (0.8, 1.6), "H": (0.2, 4.0), "dc.T_hold": (0.008, 0.05), "bess.T_b": (0.01, 0.08),
    "bess.P_dis": (0.4, 1.5), "sup.V_dip": (0.6, 0.91), "sup.w_sag": (0.7, 0.95), "dc_loop.K_p": (1.0, 8.0),
}  # fmt: skip
"""Ranges of the parameters that are drawn, where a variant has them."""
SIGNALS = ("v_it", "p_g", "w_dc", "p_b")


@cache
def system(variant: str) -> Dae:
    return facility.get(variant).compile()


@cache
def simulator(variant: str, rtol: float, method: str) -> Simulator:
    solver = Kernel(rtol=rtol, atol=1e-2 * rtol) if method == "kernel" else Casadi(method, rtol, 1e-2 * rtol)
    # the event loop around CasADi looks at guards on its samples only: coarser ones miss narrow crossings
    return Simulator(system(variant), solver, save_at=2e-4 if method == "kernel" else 5e-5)


def draw(variant: str, seed: int) -> tuple[Waveform, dict[str, float]]:
    """A waveform of up to seven stretches with jumps and ramps, stepped or sampled, and values."""
    rng = np.random.default_rng(seed)
    levels, t = [(0.0, 1.0 + 0j)], 0.05
    for _ in range(rng.integers(1, 7)):
        size = rng.choice([rng.uniform(0.05, 0.95), rng.uniform(0.85, 1.02), rng.uniform(1.0, 1.25)])
        level = size * np.exp(1j * rng.normal(0.0, 0.2))
        if rng.random() < 0.3:
            levels.append((t, level, size * np.exp(1j * rng.normal(0.0, 0.05))))
        else:
            levels.append((t, level))
        t += rng.uniform(0.01, 0.3)
    levels.append((t, 1.0 + 0j))
    wave = Waveform.segments(levels, until=t + 0.3)
    if rng.random() < 0.3:
        wave = wave.resampled(rng.choice([1e-3, 5e-3, 1e-2]))
    names = set(system(variant).p_names)
    drawn = {n: float(rng.uniform(*r)) for n, r in VARIED.items() if rng.random() < 0.6}
    return wave, {n: v for n, v in drawn.items() if n in names}


def largest_difference(run: Trajectory, reference: Trajectory) -> float:
    """Over the largest value of each signal, 2 ms away from jumps."""
    edges = reference.t[reference.breaks]
    t = np.linspace(run.t[0], min(run.t[-1], reference.t[-1]), 400)
    if len(edges):
        t = t[np.abs(t[:, None] - edges).min(axis=1) > 2e-3]
    worst = 0.0
    for name in SIGNALS:
        a, b = run.at(name, t), reference.at(name, t)
        worst = max(worst, float(np.abs(a - b).max() / max(np.abs(b).max(), 1.0)))
    return worst


def ended(variant: str, rtol: float, method: str, seed: int) -> Trajectory | str:
    """The run, or why there is no start."""
    wave, values = draw(variant, seed)
    try:
        return simulator(variant, rtol, method).attempt(wave, None, **values)
    except SimulationError as error:
        return str(error)


def compared(variant: str, seed: int, rtol: float) -> str:
    """How the kernel at this tolerance compares with the reference."""
    ours, theirs = ended(variant, rtol, "kernel", seed), ended(variant, 1e-10, "cvodes", seed)
    if isinstance(ours, str) or isinstance(theirs, str):
        return "no start" if ours == theirs else f"start: {ours!r} and {theirs!r}"
    if (ours.sequence, ours.completed) != (theirs.sequence, theirs.completed):
        return f"sequence: {ours.status} {ours.sequence} and {theirs.status} {theirs.sequence}"
    off = largest_difference(ours, theirs)
    if off > 1e-3:
        return f"signals differ by {off:.1e}"
    if not ours.completed:
        same = ours.status.split(" at ")[0] == theirs.status.split(" at ")[0]
        return "status" if same else f"status: {ours.status} and {theirs.status}"
    wave, values = draw(variant, seed)
    result = simulator(variant, rtol, "kernel").batch([wave], values, Criteria())
    found, reference = result.margins[0], margins(theirs)
    if found is None or found.sequence != reference.sequence:
        return f"lanes: {result.status[0]}"
    pairs = ((found.voltage, reference.voltage), (found.loss, reference.loss))
    worst = max(0.0 if a.value == b.value else abs(a.value - b.value) for a, b in pairs)
    return "agrees" if worst < 1e-4 else f"margins differ by {worst:.1e}"


FINE = ("agrees", "status", "no start")
AMPLIFIED = 0.05
"""Largest share of cases that may miss at the default tolerance by what steps multiply; 31 of 1843 (1.7 %)
did in other draws of gfl and gfm."""


def verdict(variant: str, seed: int) -> str:
    """As `compared` at the default tolerance.

    Only signals and margins that miss may count as `amplified`, and only if the kernel agrees at a hundredth
    of the tolerance. Another sequence of modes, status or start is a disagreement as it stands.
    """
    found = compared(variant, seed, 1e-6)
    if found.startswith(("signals", "margins")) and compared(variant, seed, 1e-8) in FINE:
        return "amplified"
    return found


def check(found: list[str]) -> None:
    """No disagreement, few amplified errors, and most cases compared to the end."""
    assert [f for f in found if f not in (*FINE, "amplified")] == []
    assert found.count("amplified") <= AMPLIFIED * len(found)
    assert found.count("agrees") > 0.5 * len(found)


def test_any_case_agrees_or_says_why_it_ended() -> None:
    check([verdict(facility.names()[k % 2], 70_000 + k) for k in range(40)])


@pytest.mark.slow
def test_hundreds_of_cases_of_all_variants() -> None:
    check([verdict(facility.names()[k % len(facility.names())], 50_000 + k) for k in range(400)])


@pytest.mark.parametrize("save_at", [1e-3, 2e-4, 2e-5])
def test_a_band_that_is_crossed_between_two_samples_is_seen(save_at: float) -> None:
    """The voltage passes the healthy band in 0.1 ms; whether that is seen must not hang on the samples."""
    wave, values = draw("line-interactive", 50_084)
    run = Simulator(system("line-interactive"), Kernel(), save_at=save_at).attempt(wave, None, **values)
    times = [e.time for e in run.events if e.automaton == "control"]
    assert times == pytest.approx([0.143834609, 0.348360923, 0.348462609, 0.672857477], abs=1e-7)
