"""What is active at the instant that decides a margin: on made-up signals, and on real runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from dcvrt import Criteria, Simulator, Waveform, facility, margins
from dcvrt.planning.mechanism import AT_LIMIT, SAME_VOLTAGE, mechanism

MODES = ("NORMAL", "MIXED", "BATTERY", "RETURN")
WINDOW = 0.04


class Signals:
    """Signals of a facility at rest for a second, but for what is changed within the window."""

    def __init__(self, m_max: float | None = 1.15, share: float = 1.0, **inside: float) -> None:
        self.t = np.linspace(0.0, 1.0, 501)
        self.parameters = {} if m_max is None else {"bus.m_max": m_max}
        rest = {"mode": 0.0, "i_g": 0.5, "i_max": 1.1, "p_b": 0.0, "p_g": 1.0, "v_it": 1.0, "w_dc": 1.0}
        changed = (self.t >= 0.5) & (self.t <= 0.5 + share * WINDOW)
        self.signals = {
            name: np.where(changed, inside.get(name, value), value) for name, value in rest.items()
        }

    def __getitem__(self, name: str) -> np.ndarray:
        return self.signals[name]


def told(run: Signals, target: str = "loss", time: float = 0.5, window: float = WINDOW) -> str:
    return mechanism(run, MODES, target, time, window)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("inside", "target", "name"),
    [
        ({}, "loss", "control"),
        ({"mode": 2.0}, "loss", "supervisor"),
        ({"mode": 3.0}, "voltage", "supervisor"),
        ({"mode": 1.0}, "loss", "control"),
        ({"i_g": 1.1 * (AT_LIMIT + 1e-6)}, "loss", "limiter"),
        ({"i_g": 1.1 * (AT_LIMIT - 1e-3)}, "loss", "control"),
        ({"p_b": 0.02}, "loss", "BESS"),
        ({"p_b": -0.02}, "loss", "control"),
        ({"v_it": 0.9, "w_dc": (0.9 / 1.15) ** 2}, "voltage", "DC link"),
        ({"v_it": 0.9, "w_dc": (0.9 / 1.15) ** 2}, "loss", "control"),
        ({"v_it": 0.9, "w_dc": ((0.9 + 2 * SAME_VOLTAGE) / 1.15) ** 2}, "voltage", "control"),
    ],
)
def test_each_mechanism_has_its_sign(inside: dict[str, float], target: str, name: str) -> None:
    assert told(Signals(**inside), target) == name


def test_the_first_that_applies_is_told() -> None:
    """On battery the current is no limiter's doing; at the limit the battery only makes up for it."""
    everything = {"i_g": 1.1, "p_b": 0.5, "v_it": 0.8, "w_dc": 0.4}
    assert told(Signals(mode=2.0, **everything), "voltage") == "supervisor"
    assert told(Signals(**everything), "voltage") == "DC link"
    assert told(Signals(**everything), "loss") == "limiter"


def test_most_of_the_window_decides() -> None:
    assert told(Signals(share=0.7, mode=2.0)) == "supervisor"
    assert told(Signals(share=0.3, mode=2.0)) == "control"


def test_time_counts_not_samples() -> None:
    """Samples crowd where signals turn, as in the first milliseconds of a fault."""
    run = Signals(i_g=1.1)
    early = np.linspace(0.5, 0.51, 200, endpoint=False)
    run.signals = {
        name: np.append(np.full(len(early), 0.5 if name == "i_g" else of[250]), of[256:])
        for name, of in run.signals.items()
    }
    run.t = np.append(early, run.t[256:])
    assert told(run) == "limiter"


def test_a_variant_without_a_supervisor_is_never_away() -> None:
    assert mechanism(Signals(mode=2.0, i_g=1.1), (), "loss", 0.5, WINDOW) == "limiter"  # type: ignore[arg-type]


def test_a_window_between_samples_takes_the_nearest() -> None:
    assert told(Signals(i_g=1.1), time=0.5203, window=0.0) == "limiter"
    assert told(Signals(i_g=1.1), time=0.4003, window=0.0) == "control"


def test_a_variant_without_an_output_stage_has_no_ceiling() -> None:
    assert told(Signals(m_max=None, v_it=0.5, w_dc=0.01), "voltage") == "control"


@pytest.mark.parametrize(("retained", "name"), [(0.7, "limiter"), (0.3, "supervisor")])
def test_real_runs_name_what_the_static_law_and_the_supervisor_say(retained: float, name: str) -> None:
    """Once the current loop has settled. beta V < 1: the limit sheds load; V < V_deep for T_deep: battery."""
    sim = Simulator(facility.gfl().compile(), save_at=2e-3)
    run = sim(Waveform.sag(retained=retained, start=0.1, length=0.15, until=1.0), H=1.0, beta=1.05)
    assert margins(run, Criteria(loss_share=0.1)).loss.value < 0
    modes: Sequence[str] = next(a.modes for a in sim.dae.automata if a.path == "sup")
    assert mechanism(run, modes, "loss", 0.2, WINDOW) == name
