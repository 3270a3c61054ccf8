"""Functionals of the kernel's driver on signals in closed form: brute force, curves, differences."""

from __future__ import annotations

import ctypes
import subprocess
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.criteria import Criteria, needed
from dcvrt.curve import Curve
from dcvrt.functionals import (
    Functional,
    Initial,
    Integral,
    Maximum,
    Minimum,
    Outcome,
    RecoveryTime,
    SustainedMaximum,
    SustainedMinimum,
    TimeAbove,
    TimeBelow,
    evaluate,
)
from dcvrt.integrators import Casadi, Simulator
from dcvrt.integrators.compiler import find_compiler
from dcvrt.integrators.kernel.functionals import PLACES, Table
from dcvrt.trajectory import Trajectory
from dcvrt.waveform import Waveform

HERE = Path(__file__).resolve().parent
DRIVER = HERE.parents[1] / "dcvrt" / "integrators" / "kernel" / "driver"
WAVES = 2
PARAMETERS = 3 + 4 * WAVES
INSIDE, EVENT, JUMP, END = range(4)

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def compiled(target: Path, *flags: str) -> Path:
    compiler = find_compiler()
    assert compiler is not None
    source = str(HERE / "functionals_probe.c")
    command = [*compiler.command, "-O2", "-Wall", "-Wno-unused-function", f"-I{DRIVER}", *flags, source]
    done = subprocess.run([*command, "-o", str(target), "-lm"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return target


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return load(tmp_path_factory.mktemp("probe"))


@cache
def load(folder: Path) -> ctypes.CDLL:
    return ctypes.CDLL(str(compiled(folder / "probe.so", "-shared", "-fPIC")))


# -- signals in closed form ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Signals:
    """Stretches between breaks; every number is `base + slope . theta`.

    A parameter row is level, slope, origin, then size, damping, frequency and phase of each wave.
    """

    base: np.ndarray  # (stretches, outputs, PARAMETERS)
    slope: np.ndarray  # (stretches, outputs, PARAMETERS, thetas)
    breaks: np.ndarray  # (stretches + 1)
    dbreaks: np.ndarray  # (stretches + 1, thetas)
    spacing: float = 0.01

    def at(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.base + self.slope @ theta, self.breaks + self.dbreaks @ theta

    def value(self, theta: np.ndarray, stretch: int, output: int, t: np.ndarray) -> np.ndarray:
        p = self.at(theta)[0][stretch, output]
        u = t - p[2]
        y = p[0] + p[1] * u
        for size, damping, frequency, phase in p[3:].reshape(WAVES, 4):
            y = y + size * np.exp(-damping * u) * np.cos(frequency * u + phase)
        return y

    def nodes(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        _, breaks = self.at(theta)
        t, step, kind, brk = [], [], [], []
        last = len(breaks) - 2
        for s, (begin, end) in enumerate(pairwise(breaks)):
            n = max(int(np.ceil((self.breaks[s + 1] - self.breaks[s]) / self.spacing)), 1) + 1
            t.append(np.linspace(begin, end, n))
            step.append(np.full(n, s))
            kinds, numbers = np.full(n, INSIDE), np.full(n, -1)
            for place, number, outer in ((0, s - 1, s == 0), (-1, s, s == last)):
                moved = self.dbreaks[number + 1].any()
                kinds[place] = END if outer else EVENT if moved else JUMP
                numbers[place] = -1 if outer else number
            kind.append(kinds)
            brk.append(numbers)
        join = np.concatenate
        return {
            "t": join(t),
            "step": join(step).astype(np.int64),
            "kind": join(kind).astype(np.uint8),
            "brk": join(brk).astype(np.int64),
        }


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def run(
    driver: ctypes.CDLL,
    signals: Signals,
    functionals: dict[str, Functional],
    theta: np.ndarray | None = None,
    still: bool = False,
    nw: int | None = None,
) -> dict[str, Outcome]:
    """Outcomes by the driver; `still` leaves out that breaks move with theta."""
    ny, thetas = signals.base.shape[1], signals.slope.shape[3]
    theta = np.zeros(thetas) if theta is None else theta
    nw = thetas if nw is None else nw
    names = [f"y{k}" for k in range(ny)]
    table = Table.of(functionals, names)
    results = table.results(1, nw)
    nodes = signals.nodes(theta)
    parameter = np.ascontiguousarray(signals.at(theta)[0])
    by = np.ascontiguousarray(signals.slope[..., :nw])
    dbreak = np.ascontiguousarray((0.0 if still else 1.0) * signals.dbreaks[1:-1, :nw])
    calls = ctypes.c_long()
    status = driver.probe(
        ny, nw, pointer(parameter), pointer(by), ctypes.c_long(len(nodes["t"])), pointer(nodes["t"]),
        pointer(nodes["step"]), pointer(nodes["kind"]), pointer(nodes["brk"]), pointer(dbreak),
        len(table), pointer(table.rows), pointer(results.value), pointer(results.time),
        pointer(results.gradient), pointer(results.place), pointer(results.tie), ctypes.byref(calls),
        ctypes.c_long(1),
    )  # fmt: skip
    assert status == 0
    wrt = [f"theta_{k}" for k in range(nw)]
    return next(results.outcomes(table, wrt, np.ones(nw)))


def one(driver: ctypes.CDLL, signals: Signals, f: Functional, **options: object) -> Outcome:
    return run(driver, signals, {"f": f}, **options)["f"]  # type: ignore[arg-type]


def on_curve(signals: Signals, functionals: dict[str, Functional], spacing: float) -> dict[str, Outcome]:
    """The same by the Python side, on cubics through fine nodes; rates and derivatives by differences."""
    fine = replace(signals, spacing=spacing)
    thetas = signals.slope.shape[3]
    theta = np.zeros(thetas)
    nodes = fine.nodes(theta)
    step, t = nodes["step"], nodes["t"]

    def values(output: int, moved: np.ndarray, shift: float = 0.0) -> np.ndarray:
        parts = [fine.value(moved, s, output, t[step == s] + shift) for s in range(len(fine.base))]
        return np.concatenate(parts)

    def rates(output: int, moved: np.ndarray) -> np.ndarray:
        e = 1e-3
        d = [values(output, moved, k * e) - values(output, moved, -k * e) for k in (1, 2, 3)]
        return (45 * d[0] - 9 * d[1] + d[2]) / (60 * e)

    def by_theta(f: object, output: int) -> np.ndarray:
        e, columns = 1e-3, []
        for k in range(thetas):
            d = np.eye(thetas)[k] * e
            first = f(output, d) - f(output, -d)  # type: ignore[operator]
            second = f(output, 2 * d) - f(output, -2 * d)  # type: ignore[operator]
            columns.append((8 * first - second) / (12 * e))
        return np.column_stack(columns)

    kind = np.array(["extremum", "event", "jump", "end"])[nodes["kind"]]
    t_theta = np.where(nodes["brk"][:, None] >= 0, fine.dbreaks[nodes["brk"] + 1], 0.0)
    outcomes = {}
    for name, f in functionals.items():
        k = int(f.signal[1:])
        columns = (values(k, theta), rates(k, theta), by_theta(values, k), by_theta(rates, k))
        curve = Curve.with_extrema(t, *(f.sign * c for c in columns), t_theta, kind)
        found = f.on(curve)
        sign = f.sign if found.kind else 1.0
        grad = {f"theta_{j}": float(sign * g) for j, g in enumerate(found.gradient)}
        outcomes[name] = Outcome(sign * found.value, grad, found.time, found.kind, found.tie)
    return outcomes


def parameters(*waves: tuple[float, float, float, float], level: float = 0.0, slope: float = 0.0) -> list:
    flat = [level, slope, 0.0]
    for wave in (*waves, *[(0.0, 0.0, 0.0, 0.0)] * (WAVES - len(waves))):
        flat += wave
    return flat


def piecewise(*stretches: tuple[list, dict[int, float]], breaks: list, moves: dict[int, float]) -> Signals:
    """One output, one theta: parameter rows with the parameters that theta moves; breaks, and which move."""
    base = np.array([[row] for row, _ in stretches])
    slope = np.zeros((*base.shape, 1))
    for s, (_, moved) in enumerate(stretches):
        for k, v in moved.items():
            slope[s, 0, k, 0] = v
    dbreaks = np.zeros((len(breaks), 1))
    for k, v in moves.items():
        dbreaks[k, 0] = v
    return Signals(base, slope, np.array(breaks, dtype=float), dbreaks)


def check_gradient(
    driver: ctypes.CDLL, signals: Signals, f: Functional, kind: str | None = None, h: float = 1e-4
) -> Outcome:
    """Against central differences of fourth order, whose error is far below the claim of 1e-5."""
    found = one(driver, signals, f)
    if kind is not None:
        assert found.kind == kind
    values = [one(driver, signals, f, theta=np.array([k * h])).value for k in (-2, -1, 1, 2)]
    difference = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * h)
    assert found.grad["theta_0"] == pytest.approx(difference, rel=1e-7, abs=1e-9)
    return found


WAVE = parameters((1.0, 0.7, 11.0, 0.3), (0.4, 0.2, 29.0, 1.0))
FALLS = parameters(level=1.0, slope=-1.0)


# -- closed forms, and every way to be active ---------------------------------------------------------------


def test_minimum_inside(driver: ctypes.CDLL) -> None:
    """level - cos(w t) with theta in the level and the frequency: the minimum moves with the level alone."""
    y = piecewise(
        (parameters((-1.0, 0.0, 5.0, -2.0), level=3.0), {0: 0.7, 5: 1.0}), breaks=[0.0, 1.0], moves={}
    )
    found = check_gradient(driver, y, Minimum("y0"), "extremum")
    assert found.value == pytest.approx(2.0, abs=1e-14)
    assert found.time == pytest.approx(0.4, abs=1e-12)
    assert found.grad["theta_0"] == pytest.approx(0.7, rel=1e-12)


def test_extrema_at_an_event_need_its_time(driver: ctypes.CDLL) -> None:
    """Falls to the event, rises after it: leaving out that the event moves gives another sign."""
    rises = [0.5, 2.0, 0.5, *[0.0] * 8]
    y = piecewise((FALLS, {0: 0.3}), (rises, {0: -0.7, 2: 1.0}), breaks=[0.0, 0.5, 1.0], moves={1: 1.0})
    found = check_gradient(driver, y, Minimum("y0"), "event")
    assert found.value == pytest.approx(0.5, abs=1e-14)
    assert found.grad["theta_0"] == pytest.approx(-0.7, rel=1e-12)
    without = one(driver, y, Minimum("y0"), still=True)
    assert without.grad["theta_0"] != pytest.approx(-0.7, rel=0.5)


def test_extremum_at_a_jump_and_at_the_ends(driver: ctypes.CDLL) -> None:
    after = [0.2, 1.0, 0.3, *[0.0] * 8]
    y = piecewise((FALLS, {0: 0.3}), (after, {0: 2.0, 1: 0.5}), breaks=[0.0, 0.3, 0.7], moves={})
    assert check_gradient(driver, y, Minimum("y0"), "jump").grad["theta_0"] == pytest.approx(2.0, rel=1e-12)
    assert check_gradient(driver, y, Maximum("y0"), "end").grad["theta_0"] == pytest.approx(0.3, rel=1e-12)
    assert check_gradient(driver, y, Initial("y0"), "").value == 1.0


def test_window_with_two_free_ends(driver: ctypes.CDLL) -> None:
    """-cos: the least level with a stretch D around the trough is -cos(w D/2)."""
    y = piecewise((parameters((-1.0, 0.0, 5.0, -2.0)), {5: 1.0, 3: 0.1}), breaks=[0.0, 1.0], moves={})
    found = check_gradient(driver, y, SustainedMinimum("y0", 0.2), "window")
    assert found.value == pytest.approx(-np.cos(0.5), abs=1e-13)
    assert found.time == pytest.approx(0.3, abs=1e-12)
    skewed = piecewise((WAVE, {3: 1.0, 5: -2.0, 8: 0.5}), breaks=[0.0, 1.5], moves={})
    check_gradient(driver, skewed, SustainedMinimum("y0", 0.08), "window")
    check_gradient(driver, skewed, SustainedMaximum("y0", 0.08), "window")


@pytest.mark.parametrize("moves", [{1: 1.0}, {2: 1.0}, {1: 0.5, 2: -2.0}, {}])
def test_window_held_at_a_break(driver: ctypes.CDLL, moves: dict[int, float]) -> None:
    """Down at the first break, up at the second; rising or falling between: held at one of them."""
    for slope, end in ((0.8, 1), (-0.8, 2)):
        low = [0.3, slope, 0.3, 0.05, 0.0, 9.0, 0.0, *[0.0] * 4]
        y = piecewise(
            (parameters(level=1.0), {}), (low, {0: 0.4, 3: 1.0}), (parameters(level=1.0), {}),
            breaks=[0.0, 0.3, 0.8, 1.0], moves=moves,
        )  # fmt: skip
        found = check_gradient(driver, y, SustainedMinimum("y0", 0.1), "window")
        assert found.time == pytest.approx(0.3 if end == 1 else 0.7, abs=1e-12)
        without = one(driver, y, SustainedMinimum("y0", 0.1), still=True)
        missed = abs(without.grad["theta_0"] - found.grad["theta_0"])
        assert (missed > 0.05) == (moves.get(end, 0.0) != 0.0)


def test_window_held_at_the_ends_of_the_run(driver: ctypes.CDLL) -> None:
    for slope, time in ((1.0, 0.0), (-1.0, 0.9)):
        y = piecewise((parameters(level=1.0, slope=slope), {1: 1.0}), breaks=[0.0, 1.0], moves={})
        found = check_gradient(driver, y, SustainedMinimum("y0", 0.1), "window")
        assert found.time == pytest.approx(time, abs=1e-12)


def test_window_parted_by_a_hump(driver: ctypes.CDLL) -> None:
    """-cos over two troughs: a window longer than a trough climbs to the crest between them."""
    y = piecewise((parameters((-1.0, 0.0, 20.0, 0.0)), {3: 1.0, 0: 0.25}), breaks=[-0.1, 0.42], moves={})
    found = check_gradient(driver, y, SustainedMinimum("y0", 0.33), "extremum")
    assert found.value == pytest.approx(1.0, abs=1e-13)
    assert found.time == pytest.approx(np.pi / 20, abs=1e-12)


def test_window_parted_by_a_corner_at_an_event(driver: ctypes.CDLL) -> None:
    rises = [0.4, 1.0, 0.3, *[0.0] * 8]
    falls = [0.5, -2.0, 0.4, *[0.0] * 8]
    back = [0.1, 5.0, 0.6, *[0.0] * 8]
    y = piecewise(
        (parameters(level=1.0), {}), (rises, {}), (falls, {0: 1.0, 2: 1.0}), (back, {}),
        breaks=[0.0, 0.3, 0.4, 0.6, 0.8], moves={2: 1.0},
    )  # fmt: skip
    found = check_gradient(driver, y, SustainedMinimum("y0", 0.3), "event")
    assert found.value == pytest.approx(0.5, abs=1e-13)
    assert found.grad["theta_0"] == pytest.approx(1.0, rel=1e-12)


def test_window_that_lasts_exactly_as_long_as_the_sag(driver: ctypes.CDLL) -> None:
    """0.12 - 0.1 is a little less than 0.02 in floating point; such a sag still counts."""
    y = piecewise(
        (parameters(level=1.0), {}), (parameters(level=0.5), {0: 1.0}), (parameters(level=1.0), {}),
        breaks=[0.0, 0.1, 0.12, 0.5], moves={},
    )  # fmt: skip
    assert 0.12 - 0.1 < 0.02
    for outcome in (
        one(driver, y, SustainedMinimum("y0", 0.02)),
        on_curve(y, {"f": SustainedMinimum("y0", 0.02)}, 0.01)["f"],
    ):
        assert outcome.value == pytest.approx(0.5, abs=1e-9)
        assert outcome.grad["theta_0"] == pytest.approx(1.0, rel=1e-9)


def test_plateaus(driver: ctypes.CDLL) -> None:
    """A constant signal and a flat sag: the level is that of the plateau, and no tie."""
    flat = piecewise((parameters(level=0.7), {0: 1.0}), breaks=[0.0, 1.0], moves={})
    sag = piecewise(
        (parameters(level=1.0), {}), (parameters(level=0.4), {0: 1.0}), (parameters(level=1.0), {}),
        breaks=[0.0, 0.3, 0.6, 1.0], moves={1: 1.0},
    )  # fmt: skip
    for y, value in ((flat, 0.7), (sag, 0.4)):
        for f in (Minimum("y0"), SustainedMinimum("y0", 0.1), SustainedMinimum("y0", 0.2999)):
            found = one(driver, y, f)
            assert found.value == pytest.approx(value, abs=1e-13)
            assert found.grad["theta_0"] == pytest.approx(1.0, rel=1e-12)
            assert not found.tie
    assert one(driver, flat, SustainedMinimum("y0", 1.0)).value == pytest.approx(0.7, abs=1e-13)
    assert one(driver, flat, TimeBelow("y0", 0.7)).value == 0.0


def test_ties_are_flagged(driver: ctypes.CDLL) -> None:
    """Two equal troughs of a wave, or of different depth once it is damped."""
    troughs = parameters((-1.0, 0.0, 20.0, 0.0), level=2.0)
    damped = parameters((-1.0, 0.01, 20.0, 0.0), level=2.0)
    for row, tie in ((troughs, True), (damped, False)):
        y = piecewise((row, {}), breaks=[-0.1, 0.42], moves={})
        for f in (Minimum("y0"), SustainedMinimum("y0", 0.05)):
            assert one(driver, y, f).tie == tie, f
        assert not one(driver, y, SustainedMinimum("y0", 0.33)).tie


def test_times_in_closed_form(driver: ctypes.CDLL) -> None:
    """cos(5 t) over two periods: below 1/2 for two thirds of the time."""
    period = 2 * np.pi / 5
    y = piecewise((parameters((1.0, 0.0, 5.0, 0.0)), {5: 1.0}), breaks=[0.0, 2 * period], moves={})
    found = check_gradient(driver, y, TimeBelow("y0", 0.5))
    assert found.value == pytest.approx(2 * period * 2 / 3, abs=1e-12)
    assert (found.kind, found.tie) == ("", False)
    assert np.isnan(found.time)
    above = check_gradient(driver, y, TimeAbove("y0", 0.5))
    assert above.value == pytest.approx(2 * period / 3, abs=1e-12)
    assert above.grad["theta_0"] == pytest.approx(-found.grad["theta_0"], rel=1e-10)
    recovery = check_gradient(driver, y, RecoveryTime("y0", 0.5))
    assert recovery.value == pytest.approx(period * (1 + 2 / 3), abs=1e-12)


def test_levels_that_move_with_the_first_value(driver: ctypes.CDLL) -> None:
    """(1 + theta) cos: a share of the first value is met at times that do not depend on theta."""
    y = piecewise((parameters((1.0, 0.0, 5.0, 0.0)), {3: 1.0}), breaks=[0.0, 1.2], moves={})
    for kind in (TimeBelow, RecoveryTime):
        assert check_gradient(driver, y, kind("y0", share=0.5)).grad["theta_0"] == pytest.approx(0, abs=1e-12)
        assert abs(check_gradient(driver, y, kind("y0", 0.5)).grad["theta_0"]) > 0.1


def test_times_with_ends_at_events(driver: ctypes.CDLL) -> None:
    low = parameters(level=0.5)
    high = parameters(level=1.0)
    y = piecewise(
        (high, {}), (low, {}), (high, {}), (low, {}), (high, {}),
        breaks=[0.0, 0.2, 0.3, 0.6, 0.65, 1.0], moves={1: 1.0, 2: 3.0, 4: -0.5},
    )  # fmt: skip
    assert check_gradient(driver, y, TimeBelow("y0", 0.9)).grad["theta_0"] == pytest.approx(1.5, rel=1e-12)
    found = check_gradient(driver, y, RecoveryTime("y0", 0.9))
    assert found.value == pytest.approx(0.45, abs=1e-13)
    assert found.grad["theta_0"] == pytest.approx(-1.5, rel=1e-12)
    assert one(driver, y, TimeBelow("y0", 0.9), still=True).grad["theta_0"] == 0.0


def test_recovery_that_does_not_happen_and_that_is_not_needed(driver: ctypes.CDLL) -> None:
    y = piecewise((FALLS, {0: 1.0}), breaks=[0.0, 0.5], moves={})
    never = one(driver, y, RecoveryTime("y0", 0.9))
    assert never.value == np.inf
    assert np.isnan(never.grad["theta_0"])
    not_needed = one(driver, y, RecoveryTime("y0", 0.2))._replace(time=pytest.approx(np.nan, nan_ok=True))
    assert one(driver, y, RecoveryTime("y0", 0.1)) == not_needed
    assert one(driver, y, RecoveryTime("y0", 0.1)).value == 0.0
    assert one(driver, y, TimeBelow("y0", 0.9)).value == pytest.approx(0.4, abs=1e-13)


def test_a_level_that_is_only_touched(driver: ctypes.CDLL) -> None:
    """The crest of a cosine grazes the level from below: time above it is 0, time below all of it."""
    y = piecewise((parameters((1.0, 0.0, 5.0, -2.0)), {3: 1.0}), breaks=[0.0, 1.0], moves={})
    assert one(driver, y, TimeAbove("y0", 1.0 + 1e-9)).value == 0.0
    below = one(driver, y, TimeBelow("y0", 1.0 + 1e-9))
    assert (below.value, below.grad["theta_0"]) == (1.0, 0.0)
    grazed = one(driver, y, TimeAbove("y0", 1.0 - 1e-10))  # 1 - (5 u)^2/2
    assert grazed.value == pytest.approx(2 * np.sqrt(2e-10) / 5, rel=1e-4)


def test_integrals_in_closed_form(driver: ctypes.CDLL) -> None:
    w = 5.0
    y = piecewise((parameters((1.0, 0.0, w, 0.0)), {5: 1.0, 3: 0.2}), breaks=[0.0, 1.1], moves={})
    assert check_gradient(driver, y, Integral("y0")).value == pytest.approx(np.sin(w * 1.1) / w, abs=1e-8)
    positive = check_gradient(driver, y, Integral("y0", positive=True))
    assert positive.value == pytest.approx((2 + np.sin(w * 1.1)) / w, abs=1e-8)


def test_integrals_across_an_event_need_its_time(driver: ctypes.CDLL) -> None:
    """Steps of height 1, then -2, then 3: d/dtheta is the height of the step times the move of its time."""
    y = piecewise(
        (parameters(level=1.0), {}), (parameters(level=-2.0), {}), (parameters(level=3.0), {}),
        breaks=[0.0, 0.2, 0.5, 1.0], moves={1: 1.0, 2: -0.5},
    )  # fmt: skip
    found = check_gradient(driver, y, Integral("y0"))
    assert found.value == pytest.approx(0.2 - 0.6 + 1.5, abs=1e-13)
    assert found.grad["theta_0"] == pytest.approx(3.0 + 2.5, rel=1e-12)
    positive = check_gradient(driver, y, Integral("y0", positive=True))
    assert positive.value == pytest.approx(1.7, abs=1e-13)
    assert positive.grad["theta_0"] == pytest.approx(1.0 + 1.5, rel=1e-12)
    assert one(driver, y, Integral("y0"), still=True).grad["theta_0"] == 0.0


def test_integrals_of_what_the_nodes_are_too_coarse_for(driver: ctypes.CDLL) -> None:
    """A wave with three nodes a period: the interval is halved until the cubics agree."""
    w = 40.0
    y = piecewise((parameters((1.0, 0.5, w, 0.0), level=0.5), {5: 1.0, 4: 1.0}), breaks=[0.0, 2.0], moves={})
    coarse = replace(y, spacing=0.05)
    exact = np.real((1 - np.exp((-0.5 + 1j * w) * 2.0)) / (0.5 - 1j * w)) + 1.0
    assert one(driver, coarse, Integral("y0")).value == pytest.approx(exact, abs=1e-7)
    check_gradient(driver, replace(y, spacing=0.02), Integral("y0"), h=1e-3)


def test_one_signal_over_another(driver: ctypes.CDLL) -> None:
    base = np.array(
        [[parameters((1.0, 0.7, 11.0, 0.3), level=2.0), parameters((0.3, 0.0, 7.0, 0.0), level=1.5)]]
    )
    slope = np.zeros((1, 2, PARAMETERS, 1))
    slope[0, 0, 3], slope[0, 1, 0], slope[0, 1, 5] = 1.0, 0.5, 1.0
    y = Signals(base, slope, np.array([0.0, 1.0]), np.zeros((2, 1)))
    t = np.linspace(0.0, 1.0, 200001)
    quotient = y.value(np.zeros(1), 0, 0, t) / y.value(np.zeros(1), 0, 1, t)
    found = check_gradient(driver, y, Maximum("y0", per="y1"), h=1e-3)
    assert found.value == pytest.approx(quotient.max(), abs=1e-9)
    assert check_gradient(driver, y, Initial("y0", per="y1")).value == pytest.approx(quotient[0], rel=1e-14)
    check_gradient(driver, y, SustainedMinimum("y0", 0.1, per="y1"), "window", h=1e-3)
    found = check_gradient(driver, y, Integral("y0", per="y1"), h=1e-3)
    assert found.value == pytest.approx(np.trapezoid(quotient, t), abs=1e-7)


def test_bad_numbers_stay_bad(driver: ctypes.CDLL) -> None:
    y = piecewise((parameters(level=np.nan), {}), breaks=[0.0, 1.0], moves={})
    for f in (Minimum("y0"), TimeBelow("y0", 1.0), Integral("y0"), SustainedMinimum("y0", 0.1)):
        found = one(driver, y, f)
        assert np.isnan(found.value)
        assert np.isnan(found.grad["theta_0"])
        assert (found.kind, found.tie) == ("", False)
    short = piecewise((FALLS, {}), breaks=[0.0, 1.0], moves={})
    assert np.isnan(one(driver, short, SustainedMinimum("y0", 1.5)).value)


def test_without_thetas(driver: ctypes.CDLL) -> None:
    y = piecewise((WAVE, {3: 1.0}), breaks=[0.0, 1.5], moves={})
    for f in (
        Minimum("y0"),
        SustainedMinimum("y0", 0.05),
        TimeBelow("y0", 0.2),
        Integral("y0", positive=True),
    ):
        with_theta, without = one(driver, y, f), one(driver, y, f, nw=0)
        agreed = 1e-6 if isinstance(f, Integral) else 1e-13  # a value alone is integrated less finely
        assert without.value == pytest.approx(with_theta.value, rel=agreed)
        assert without.grad == {}


# -- random signals -----------------------------------------------------------------------------------------


@st.composite
def random_signals(draw: st.DrawFn) -> Signals:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    stretches = draw(st.integers(1, 4))
    base = rng.uniform(-1, 1, (stretches, 1, PARAMETERS))
    base[:, :, 3::4] *= 0.5
    base[:, :, 4::4] *= 2.0
    base[:, :, 5::4] = rng.uniform(0, 40, base[:, :, 5::4].shape)
    base[:, :, 6::4] *= np.pi
    slope = rng.uniform(-1, 1, (stretches, 1, PARAMETERS, 1))
    breaks = np.concatenate(([0.0], np.cumsum(rng.uniform(0.02, 0.5, stretches))))
    dbreaks = rng.uniform(-1, 1, (stretches + 1, 1)) * rng.integers(0, 2, (stretches + 1, 1))
    dbreaks[[0, -1]] = 0.0
    return Signals(base, slope, breaks, dbreaks, spacing=draw(st.sampled_from([0.004, 0.01])))


def every_kind(window: float, level: float) -> dict[str, Functional]:
    return {
        "minimum": Minimum("y0"),
        "maximum": Maximum("y0"),
        "low": SustainedMinimum("y0", window),
        "high": SustainedMaximum("y0", window),
        "below": TimeBelow("y0", level),
        "above": TimeAbove("y0", level),
        "integral": Integral("y0"),
        "positive": Integral("y0", positive=True),
        "recovery": RecoveryTime("y0", level),
    }


@settings(max_examples=150, deadline=None, derandomize=True)
@given(random_signals(), st.floats(0.01, 0.3), st.floats(-1.0, 1.0))
def test_random_signals_by_brute_force(driver: ctypes.CDLL, y: Signals, window: float, level: float) -> None:
    """Samples 1/8000 s apart: what they miss is bounded by the steepest slope."""
    assume(y.breaks[-1] > window + 0.01)
    found = run(driver, y, every_kind(window, level))
    h = 1 / 8000
    parts, rate = [], 0.0
    for s, (a, b) in enumerate(zip(y.breaks[:-1], y.breaks[1:], strict=True)):
        t = np.arange(np.ceil(a / h), np.ceil(b / h)) * h
        parts.append(y.value(np.zeros(1), s, 0, t))
        rate = max(
            rate, np.abs(np.diff(y.value(np.zeros(1), s, 0, np.linspace(a, b, 500)))).max() / (b - a) * 499
        )
    v = np.concatenate(parts)
    slack = 3 * rate * h
    assert found["minimum"].value == pytest.approx(v.min(), abs=slack)
    assert found["maximum"].value == pytest.approx(v.max(), abs=slack)
    n = round(window / h)
    for sign, name in ((1.0, "low"), (-1.0, "high")):
        tops = np.lib.stride_tricks.sliding_window_view(sign * v, n - 2).max(axis=1)
        longer = np.lib.stride_tricks.sliding_window_view(sign * v, n + 3).max(axis=1)
        assert tops.min() - slack <= sign * found[name].value <= longer.min() + slack
    fuzzy = np.sum(np.abs(v - level) <= slack) * h + 12 * h
    assert found["below"].value == pytest.approx(np.sum(v < level) * h, abs=fuzzy)
    assert found["above"].value == pytest.approx(np.sum(v > level) * h, abs=fuzzy)
    jumps = 8 * h * (np.abs(v).max() + slack)
    assert found["integral"].value == pytest.approx(np.sum(v) * h, abs=jumps + slack)
    assert found["positive"].value == pytest.approx(np.sum(np.maximum(v, 0)) * h, abs=jumps + slack)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(random_signals(), st.floats(0.01, 0.3), st.floats(-1.0, 1.0))
def test_random_signals_against_fine_curves(
    driver: ctypes.CDLL, y: Signals, window: float, level: float
) -> None:
    """The Python side on cubics through nodes 0.5 ms apart is another way to the same numbers."""
    assume(y.breaks[-1] > window + 0.01)
    wanted = every_kind(window, level)
    found, expected = run(driver, y, wanted), on_curve(y, wanted, 5e-4)
    for name, there in expected.items():
        here = found[name]
        assert here.value == pytest.approx(there.value, rel=1e-6, abs=2e-7), name
        if not (here.tie or there.tie) and here.kind == there.kind and np.isfinite(there.value):
            assert here.grad["theta_0"] == pytest.approx(there.grad["theta_0"], rel=1e-5, abs=1e-5), name
        if not (here.tie or there.tie) and name in ("minimum", "maximum", "low", "high"):
            assert here.kind == there.kind


@settings(max_examples=150, deadline=None, derandomize=True)
@given(random_signals(), st.floats(0.01, 0.3), st.floats(-1.0, 1.0))
def test_gradients_of_random_signals(driver: ctypes.CDLL, y: Signals, window: float, level: float) -> None:
    """Central differences where nothing switches; their own error is estimated from two steps."""
    assume(y.breaks[-1] > window + 0.01)
    wanted = every_kind(window, level)
    steps = np.array([-2, -1, 1, 2])
    by_step = {}
    for h in (2e-5, 4e-5):
        by_step[h] = [run(driver, y, wanted, theta=np.array([k * h])) for k in steps]
    found = run(driver, y, wanted)
    compared = 0
    for name, here in found.items():
        around = [o[name] for results in by_step.values() for o in results]
        same = all(o.kind == here.kind and not o.tie and abs(o.time - here.time) < 0.01 for o in around)
        if (here.kind and not same) or here.tie or not np.isfinite(here.value):
            continue
        differences = []
        for h, results in by_step.items():
            v = [o[name].value for o in results]
            differences.append((8 * (v[2] - v[1]) - (v[3] - v[0])) / (12 * h))
        if abs(differences[0] - differences[1]) > 1e-7 * (1 + abs(differences[0])):
            continue  # a crossing appeared, or differences have no digits here
        assert here.grad["theta_0"] == pytest.approx(differences[0], rel=1e-5, abs=1e-6), name
        compared += 1
    assert compared >= 3


# -- signals of a facility ----------------------------------------------------------------------------------


def of_samples(
    driver: ctypes.CDLL, run: Trajectory, functionals: dict[str, Functional], still: bool = False
) -> dict[str, Outcome]:
    """Functionals by the driver on the samples of a run, whose cubics it takes for the solution."""
    table = Table.of(functionals)
    results = table.results(1, len(run.wrt))
    columns = [run.outputs.names.index(name) for name in table.signals]
    signals = run.outputs
    assert signals.rate is not None
    assert signals.sens is not None
    assert signals.rate_sens is not None
    given_arrays = [
        np.ascontiguousarray(a[:, columns])
        for a in (signals.value, signals.rate, signals.sens, signals.rate_sens)
    ]
    n = len(run.t)
    step = np.minimum(np.arange(n), n - 2)
    kind, brk = np.full(n, INSIDE, dtype=np.uint8), np.full(n, -1)
    kind[[0, -1]] = END
    event_times = {e.time for e in run.events}
    for number, left in enumerate(run.breaks):
        kind[left : left + 2] = EVENT if float(run.t[left]) in event_times else JUMP
        brk[left : left + 2] = number
        step[left] = max(left - 1, 0)
    dbreak = np.ascontiguousarray((0.0 if still else 1.0) * run.break_grad)
    t = np.ascontiguousarray(run.t)
    arrays = [t, *given_arrays, step, kind, brk, dbreak]
    status = driver.probe_samples(
        len(columns), len(run.wrt), ctypes.c_long(n), *map(pointer, arrays), len(table), pointer(table.rows),
        pointer(results.value), pointer(results.time), pointer(results.gradient), pointer(results.place),
        pointer(results.tie),
    )  # fmt: skip
    assert status == 0
    return next(results.outcomes(table, run.wrt, np.ones(len(run.wrt))))


THETAS = ("beta", "dc.T_hold", "bess.T_b")
WAVEFORMS = {
    "deep": Waveform.segments(
        [(0.0, 1.0), (0.1, 0.4 * np.exp(-0.3j)), (0.25, 0.97, 1.0), (0.6, 1.0)], until=0.7
    ),
    "dip": Waveform.segments([(0.0, 1.0), (0.1, 0.82), (0.3, 1.0)], until=0.6),
    "twice": Waveform.segments(
        [(0.0, 0.98), (0.1, 0.3), (0.2, 0.95), (0.4, 0.3), (0.5, 1.05), (0.8, 1.0)], until=1.2
    ),
}


@cache
def facility_simulator(mode: str) -> Simulator:
    return Simulator(getattr(facility, mode)().compile(), Casadi("erk", 1e-8, 1e-10), wrt=THETAS)


@pytest.mark.parametrize("wave", WAVEFORMS)
@pytest.mark.parametrize("mode", ["gfl", "gfm"])
def test_driver_and_python_agree_on_facilities(driver: ctypes.CDLL, mode: str, wave: str) -> None:
    """Both on the same cubics: two ways of search and of derivatives, one result.

    The driver's integrals go beyond the cubics by a term that it keeps below 1e-6 of span and integrand.
    """
    run = facility_simulator(mode)(WAVEFORMS[wave], beta=1.1)
    asked: dict[str, Functional] = {
        **needed(Criteria(), run.outputs.names),
        "high": SustainedMaximum("p_b", 0.05),
        "import": Integral("p_g"),
        "over": TimeAbove("v_it", 1.0),
        "longer": SustainedMinimum("p_g", 0.12),
    }
    here, there = of_samples(driver, run, asked), evaluate(asked, run)
    assert any(e.grad[theta] != 0 for e in run.events for theta in THETAS)
    for name, expected in there.items():
        found = here[name]
        span = 0.0
        if isinstance(asked[name], Integral):
            span = float(run.t[-1])
        largest = float(np.abs(run[asked[name].signal]).max())
        assert found.value == pytest.approx(expected.value, rel=1e-9, abs=1e-9 + 1e-6 * span * largest), name
        assert (found.kind, found.tie) == (expected.kind, expected.tie), name
        if expected.tie or not np.isfinite(expected.value):
            continue
        for theta in THETAS:
            largest = float(np.abs(run.sens[asked[name].signal, theta]).max())
            near = pytest.approx(expected.grad[theta], rel=1e-7, abs=1e-7 + 1e-6 * span * largest)
            assert found.grad[theta] == near, name


# -- robustness ---------------------------------------------------------------------------------------------


def test_no_memory_is_misused(tmp_path: Path) -> None:
    """Thousands of random runs, odd ones among them, under the sanitizers."""
    program = compiled(
        tmp_path / "probe",
        "-g", "-DPROBE_MAIN", "-fsanitize=address,undefined", "-fno-sanitize-recover=all",
    )  # fmt: skip
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert int(done.stdout) > 50_000


def test_places_are_those_of_the_header() -> None:
    text = (DRIVER / "functionals.h").read_text(encoding="utf-8")
    order = ("INSIDE", "EVENT", "JUMP", "END", "WINDOW", "NONE")
    assert all(f"PLACE_{name} = {k}" in text for k, name in enumerate(order))
    assert len(PLACES) == len(order)
