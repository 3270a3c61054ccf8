"""Does a facility ride through? Margins of a run with their gradients, and the diagnostics beside them.

Both margins rest on one functional, the least level below which a signal stays for a whole window: the IT
voltage may not stay below `v_it_min`, nor the import below its share, for that long. How it and its gradient
come about is in :mod:`dcvrt.curve`; what else is computed of a run, in :mod:`dcvrt.functionals`.

Paper: eqs. (sustained_it_voltage), (voltage_margin), (loss_margin).
Differs: the paper's sustained voltage, min over s of the *min* over the window, does not depend on the
window; it is here as criterion="instantaneous".
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from dcvrt.curve import TIE, Curve, Extremum, sustained_minimum, too_short
from dcvrt.errors import InputError, raise_all
from dcvrt.functionals import (
    Functional,
    Initial,
    Integral,
    Maximum,
    Minimum,
    Outcome,
    RecoveryTime,
    SustainedMinimum,
    TimeBelow,
    evaluate,
)
from dcvrt.trajectory import Trajectory

__all__ = [
    "LIMITED_BEFORE_FAULT",
    "TIE",
    "Criteria",
    "Curve",
    "Extremum",
    "Margin",
    "Margins",
    "margins",
    "margins_of",
    "needed",
    "only_criteria",
    "sustained_minimum",
]
LIMITED_BEFORE_FAULT = 0.999
"""Diagnostic `preload` from which on the current limiter counts as active before the fault."""


@dataclass(frozen=True)
class Criteria:
    """What a facility has to meet.

    Parameters
    ----------
    v_it_min : IT voltage that keeps the servers running, pu.
    window : time that the voltage must stay below a level to count, s.
    loss_share : share of the pre-fault import that may be lost.
    loss_window : time that a loss must last to count, s; 0 takes the peak, which a current lag makes 1 - V at
        fault inception whatever the converter.
    criterion : ``"sustained"``, or ``"instantaneous"``: the plain minimum of the IT voltage.
    recovery_share : share of the pre-fault import that counts as recovered.
    recovery_time : time within which the import must have recovered, s; None asks for nothing.
    """

    v_it_min: float = 0.90
    window: float = 0.020
    loss_share: float = 0.25
    loss_window: float = 0.040
    criterion: Literal["sustained", "instantaneous"] = "sustained"
    recovery_share: float = 0.9
    recovery_time: float | None = None

    def __post_init__(self) -> None:
        problems = [
            f"{name} = {value:g} must lie in [{low:g}, {high:g}]."
            for name, value, low, high in (
                ("v_it_min", self.v_it_min, 0.0, 2.0),
                ("window", self.window, 0.0, 60.0),
                ("loss_share", self.loss_share, 0.0, 1.0),
                ("loss_window", self.loss_window, 0.0, 60.0),
                ("recovery_share", self.recovery_share, 0.0, 1.0),
            )
            if not low <= value <= high
        ]
        if self.criterion not in ("sustained", "instantaneous"):
            problems.append(f"criterion = {self.criterion!r} must be 'sustained' or 'instantaneous'.")
        if self.recovery_time is not None and not self.recovery_time > 0:
            problems.append(f"recovery_time = {self.recovery_time:g} s must be positive.")
        raise_all(problems, "criteria")


class Margin(Outcome):
    """A margin in pu volts or as a share of the pre-fault import; positive: met."""

    __slots__ = ()


@dataclass(frozen=True)
class Margins:
    """Margins of one run, the sequence of modes that they belong to, and diagnostics.

    `sequence` labels the branch: margins of runs with different sequences do not lie on one smooth surface.
    """

    voltage: Margin
    loss: Margin
    sequence: tuple[str, ...]
    diagnostics: Mapping[str, float]
    recovered: bool = True

    @property
    def passed(self) -> bool:
        """Whether every criterion is met."""
        return self.voltage.value >= 0 and self.loss.value >= 0 and self.recovered

    def flat(self) -> dict[str, Any]:
        """One row of a table."""
        row: dict[str, Any] = {}
        for name, margin in (("voltage", self.voltage), ("loss", self.loss)):
            row |= margin.flat(name)
        return {**row, **self.diagnostics, "recovered": self.recovered, "sequence": " | ".join(self.sequence)}


def only_criteria(criteria: object) -> None:
    """Refuse what is no :class:`Criteria`.

    Raises
    ------
    InputError
        With the way to make some.
    """
    if not isinstance(criteria, Criteria):
        raise InputError(f"criteria = {criteria!r}: must be criteria. Way out: criteria=Criteria(...).")


def margins(run: Trajectory, criteria: Criteria | None = None) -> Margins:
    """Margins and diagnostics of a completed run.

    Diagnostics: `v_it_min` (instantaneous), `time_below` (s below the criterion's v_it_min), `loss_share`,
    `loss_pu` (the largest lasting loss), `peak_loss_share` (instantaneous), `recovery_time` (s from the first
    fall below recovery_share to the last return above it; inf if it is still below at the end), `bess_energy`
    (discharged, pu s), `peak_loading` (largest i_g/i_max) and `preload` (i_g/i_max before the fault: at 1 the
    limiter is active from the start, and the import has less reactive power than its power factor says).

    Raises
    ------
    InputError
        `criteria` that are none; the run did not complete, lacks the outputs `v_it` and `p_g`, imports
        nothing before the fault, or is shorter than the windows.
    """
    criteria = Criteria() if criteria is None else criteria
    only_criteria(criteria)
    if not run.completed:
        raise InputError(f"margins: the run has no result to judge: {run.status}.")
    span = float(run.t[-1] - run.t[0])
    longest = longest_window(criteria)
    if span < longest:
        raise InputError(f"margins: {too_short(span, longest)}")
    return margins_of(criteria, evaluate(needed(criteria, run.outputs.names), run), run.sequence)


def longest_window(criteria: Criteria) -> float:
    """Time that a run must last to be judged, s."""
    sustained = criteria.window if criteria.criterion == "sustained" else 0.0
    return max(sustained, criteria.loss_window)


def needed(criteria: Criteria, outputs: Collection[str]) -> dict[str, Functional]:
    """Functionals that margins and diagnostics are made of, for a system with these outputs."""
    functionals: dict[str, Functional] = {
        "voltage": SustainedMinimum("v_it", criteria.window if criteria.criterion == "sustained" else 0.0),
        "v_it_min": Minimum("v_it"),
        "time_below": TimeBelow("v_it", criteria.v_it_min),
        "import": Initial("p_g"),
        "held_import": SustainedMinimum("p_g", criteria.loss_window),
        "least_import": Minimum("p_g"),
        "recovery_time": RecoveryTime("p_g", share=criteria.recovery_share),
    }
    if "p_b" in outputs:
        functionals["bess_energy"] = Integral("p_b", positive=True)
    if "i_g" in outputs and "i_max" in outputs:
        functionals["preload"] = Initial("i_g", per="i_max")
        functionals["peak_loading"] = Maximum("i_g", per="i_max")
    return functionals


def margins_of(criteria: Criteria, found: Mapping[str, Outcome], sequence: tuple[str, ...]) -> Margins:
    """Margins and diagnostics of a completed run from its functionals, those of :func:`needed`.

    With P the import before the fault and p* the held import, the lost share is 1 - p*/P, and
    d(p*/P)/dtheta = (dp*/dtheta - p*/P dP/dtheta)/P.

    Raises
    ------
    InputError
        nothing is imported before the fault.
    """
    low, held, before = found["voltage"], found["held_import"], found["import"]
    if not before.value > 0:
        raise InputError(
            f"margins: the import before the fault is p_g = {before.value:g} pu; "
            "a load loss has no reference."
        )
    kept = held.value / before.value
    kept_theta = {
        theta: (slope - kept * before.grad[theta]) / before.value for theta, slope in held.grad.items()
    }
    recovery = found["recovery_time"].value
    diagnostics = {
        "v_it_min": found["v_it_min"].value,
        "time_below": found["time_below"].value,
        "loss_share": 1.0 - kept,
        "loss_pu": before.value - held.value,
        "peak_loss_share": 1.0 - found["least_import"].value / before.value,
        "recovery_time": recovery,
    }
    diagnostics |= {
        name: found[name].value for name in ("bess_energy", "peak_loading", "preload") if name in found
    }
    return Margins(
        voltage=Margin(low.value - criteria.v_it_min, low.grad, low.time, low.kind, low.tie),
        loss=Margin(criteria.loss_share - (1.0 - kept), kept_theta, held.time, held.kind, held.tie),
        sequence=sequence,
        diagnostics=diagnostics,
        recovered=criteria.recovery_time is None or recovery <= criteria.recovery_time,
    )
