"""How a run ended before its time, in a sentence: the same words whichever solver ran it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from dcvrt.dae import Dae
from dcvrt.trajectory import Event

Array = NDArray[np.float64]
MAX_JUMPS_AT_ONCE = 50
MAX_EVENTS = 10_000


def left_bounds(dae: Dae, state: int, sign: float, bound: float, t: float) -> str:
    """A state crossed its bound."""
    row = dae.states[state]
    side = "above" if sign > 0 else "below"
    what = row.crossing or f"{row.path} left its range"
    return f"{what} at {t:.3f} s ({row.path} {side} {bound:g} {row.unit})"


def chatter(t: float, visited: Iterable[str]) -> str:
    """Guards that are true together send the automata round in a circle."""
    return (
        f"more than {MAX_JUMPS_AT_ONCE} jumps at {t:.6g} s between {', '.join(sorted(set(visited)))}: "
        "the guards of these modes are true together; give them hysteresis or a dwell time (held)"
    )


def too_many_events(t: float) -> str:
    """More events than a run may have."""
    return f"more than {MAX_EVENTS} events up to {t:.6g} s: the automaton chatters"


def not_consistent(dae: Dae, t: float) -> str:
    """No algebraic variables solve 0 = g."""
    return f"no consistent value of {', '.join(r.path for r in dae.algebraics)} at {t:.6g} s"


def failed(
    dae: Dae,
    why: str,
    begin: float,
    end: float,
    modes: Sequence[int],
    x: Array,
    rates: Array,
    last: Event | None,
) -> str:
    """The integrator could not go on: when, in which mode, which state moves fastest, what came before."""
    worst = int(np.argmax(np.where(np.isfinite(rates), np.abs(rates), np.inf)))
    named = ", ".join(a.modes[m] for a, m in zip(dae.automata, modes, strict=True)) or "no automaton"
    return (
        f"integration failed between {begin:.6g} and {end:.6g} s in mode {named}: {why}; fastest state "
        f"{dae.x_names[worst]} = {x[worst]:.4g}, rate {rates[worst]:.4g} 1/s; "
        f"last event: {last if last is not None else 'none'}"
    )
