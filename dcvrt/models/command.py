"""Commands between automata: a flag of one block, 0 or 1, that the table of another one reads."""

from __future__ import annotations

from dcvrt.models.automaton import Guard, above, below
from dcvrt.models.phasor import Scalar

LOW, HIGH = 0.4, 0.6
"""A flag is 0 or 1, never between. Two limits, so that a table that reads it both ways has hysteresis."""


def given(command: Scalar) -> Guard:
    """True while the command is 1."""
    return above(command, HIGH)


def withdrawn(command: Scalar) -> Guard:
    """True while the command is 0."""
    return below(command, LOW)
