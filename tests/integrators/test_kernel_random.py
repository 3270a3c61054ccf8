"""Random parameters and waveforms: the kernel agrees with a tight reference, or says why it ended."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
    "bess.P_dis": (0.4, 1.5), "sup.V_dip": (0.6, 0.91), "sup.w_sag": (0.7, 0.94), "dc_loop.K_p": (1.0, 8.0),
}  # fmt: skip
"""Ranges of the parameters that are drawn, where a variant has them."""
SIGNALS = ("v_it", "p_g", "w_dc", "p_b")


Case = tuple[Waveform, dict[str, float]]


@cache
def system(variant: str) -> Dae:
    return facility.get(variant).compile()


@cache
def simulator(variant: str, rtol: float, method: str) -> Simulator:
    solver = Kernel(rtol=rtol, atol=1e-2 * rtol) if method == "kernel" else Casadi(method, rtol, 1e-2 * rtol)
    # the event loop around CasADi looks at guards on its samples only: coarser ones miss narrow crossings
    return Simulator(system(variant), solver, save_at=2e-4 if method == "kernel" else 5e-5)


def draw(variant: str, seed: int) -> Case:
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


def ended(variant: str, rtol: float, method: str, case: Case) -> Trajectory | str:
    """The run, or why there is no start."""
    wave, values = case
    try:
        return simulator(variant, rtol, method).attempt(wave, None, **values)
    except SimulationError as error:
        return str(error)


def compared(variant: str, case: Case, rtol: float, ours_on: Case | None = None) -> str:
    """How the kernel at this tolerance compares with the reference (`ours_on` another case, if given)."""
    ours, theirs = ended(variant, rtol, "kernel", ours_on or case), ended(variant, 1e-10, "cvodes", case)
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
    wave, values = ours_on or case
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


def verdict(variant: str, case: Case) -> str:
    """As `compared` at the default tolerance.

    Only signals and margins that miss may count as `amplified`, and only if the kernel agrees at a hundredth
    of the tolerance. Another sequence of modes, status or start is a disagreement as it stands.
    """
    found = compared(variant, case, 1e-6)
    if found.startswith(("signals", "margins")) and compared(variant, case, 1e-8) in FINE:
        return "amplified"
    return found


def check(found: list[str]) -> None:
    """No disagreement, few amplified errors, and most cases compared to the end."""
    assert [f for f in found if f not in (*FINE, "amplified")] == []
    assert found.count("amplified") <= AMPLIFIED * len(found)
    assert found.count("agrees") > 0.5 * len(found)


def test_any_case_agrees_or_says_why_it_ended() -> None:
    check([verdict(facility.names()[k % 2], draw(facility.names()[k % 2], 70_000 + k)) for k in range(40)])


def test_a_wrong_kernel_would_be_seen() -> None:
    """The same comparison with a parameter 2 % off, and with a fault that lasts 1 ms longer."""

    def fault(clearing: float) -> Waveform:
        return Waveform.segments([(0.0, 1.0), (0.1, 0.6 * np.exp(-0.2j)), (clearing, 1.0)], until=0.6)

    case = (fault(0.2), {"beta": 1.1})
    assert compared("gfl", case, 1e-6) == "agrees"
    assert compared("gfl", case, 1e-6, (fault(0.2), {"beta": 1.122})) not in FINE
    assert compared("gfl", case, 1e-6, (fault(0.201), {"beta": 1.1})) not in FINE


@st.composite
def cases(draw_one: st.DrawFn) -> tuple[str, Case]:
    """A variant, a waveform of up to seven stretches, stepped or sampled, and values of some parameters.

    Voltages are kept off round numbers, which thresholds are: one that settles on its threshold has no answer
    that two solvers must share.
    """
    variant = draw_one(st.sampled_from(facility.names()))
    ranges = ((0.05, 0.95), (0.85, 1.02), (1.0, 1.25))
    level = st.one_of(*(st.floats(*r).map(lambda size: size + 3.7e-4) for r in ranges))
    angle, length = st.floats(-0.5, 0.5), st.floats(0.01, 0.3)
    levels: list[tuple[float, complex] | tuple[float, complex, complex]] = [(0.0, 1.0 + 0j)]
    t = 0.05
    for _ in range(draw_one(st.integers(1, 6))):
        size, turn = draw_one(level), draw_one(angle)
        begin = size * np.exp(1j * turn)
        ramp = draw_one(st.booleans())
        levels.append((t, begin, size * np.exp(1j * draw_one(angle) / 4)) if ramp else (t, begin))
        t += draw_one(length)
    wave = Waveform.segments([*levels, (t, 1.0 + 0j)], until=t + 0.3)
    sampled = draw_one(st.sampled_from([None, None, 1e-3, 5e-3, 1e-2]))
    wave = wave if sampled is None else wave.resampled(sampled)
    known = [n for n in VARIED if n in system(variant).p_names]
    names = draw_one(st.lists(st.sampled_from(known), unique=True))
    return variant, (wave, {n: draw_one(st.floats(*VARIED[n])) for n in names})


MANY = settings(
    max_examples=2000, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)


@pytest.mark.slow
def test_thousands_of_cases_of_all_variants() -> None:
    found: list[str] = []

    @settings(
        max_examples=2000,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(cases())
    def every(case: tuple[str, Case]) -> None:
        found.append(verdict(*case))
        assert found[-1] in (*FINE, "amplified")

    every()
    assert len(found) >= 2000
    check(found)


@pytest.mark.parametrize("save_at", [1e-3, 2e-4, 2e-5])
def test_a_band_that_is_crossed_between_two_samples_is_seen(save_at: float) -> None:
    """The voltage passes the healthy band in 0.1 ms; whether that is seen must not hang on the samples."""
    wave, values = draw("line-interactive", 50_084)
    run = Simulator(system("line-interactive"), Kernel(), save_at=save_at).attempt(wave, None, **values)
    times = [e.time for e in run.events if e.automaton == "control"]
    assert times == pytest.approx([0.143834609, 0.348360923, 0.348462609, 0.672857477], abs=1e-7)
