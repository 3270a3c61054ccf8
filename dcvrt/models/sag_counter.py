"""Sag counter with lock-out: after so many sags in so much time, away from the grid for good."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp
from typing import Any

from dcvrt.models.automaton import Go, Guard, above, below
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State

FADED = exp(-1.0)
"""What is left of the memory of a sag after the window."""
MOST = 6
"""Largest number of sags that the register can count."""


@dataclass(frozen=True)
class ToldGuard(Guard):
    """A guard that rows print in words, since its cases are many."""

    words: str = ""

    def __str__(self) -> str:
        return self.words


class SagCounter(Block):
    r"""Counts sags in a sliding window and locks the UPS on its battery when there are N.

    Each of the last five sags leaves a memory that is 1 when it begins and fades,

    .. math::
        \dot m_k = -m_k / T_{window}, \qquad\text{at a sag:}\quad (m_1, m_2, \dots) := (1, m_1, m_2, \dots)

    A sag that began an age A ago has :math:`m = e^{-A/T_{window}}`. The N-th sag falls within the window of
    the first one exactly when, as it begins, :math:`m_{N-1} > e^{-1}`: a sliding window, no approximation.

    | mode | meaning |
    |---|---|
    | READY | voltage healthy |
    | SAG | a sag that has been counted; the next one counts after recovery |
    | LOCKED | `lock` = 1, until the voltage has been healthy for T_reset; the count starts again |

    Equilibrium: no memory. N = 0 switches the counter off, and it is off unless set: ERCOT's NOGRR282
    forbids the counting of sags. A reset by hand is a T_reset longer than the run.
    A sag is a visit of the measured voltage below V_count; how long it lasts does not matter.
    To wire it: ``connect(meter.v_f, counter.v_f)`` and ``connect(counter.lock, control.lock)``, where the
    table of the control leaves for its battery while :func:`~dcvrt.models.command.given` holds for the lock
    and comes back only while :func:`~dcvrt.models.command.withdrawn` does. Both automata act at the same
    instant.
    """

    modes = ("READY", "SAG", "LOCKED")
    start = "READY"
    flags = {"number": (0, 1, 2), "locked": (0, 0, 1)}  # noqa: RUF012

    N = Parameter(
        0.0,
        "1",
        (0.0, MOST),
        "sags in the window that lock, rounded; 0: off",
        "off; 3 in 1 min is told of the disturbance of July 2024 and not verified",
    )
    T_window = Parameter(60.0, "s", (0.1, 86400.0), "window", "told as 1 min, not verified")
    T_reset = Parameter(
        3600.0,
        "s",
        (0.1, 1e6),
        "healthy time before the lock opens",
        "one hour: default of the Eaton 9395 for staying in double conversion on high alert",
    )
    V_count = Parameter(0.90, "pu(V)", (0.1, 1.0), "a sag is counted below", "illustrative")
    V_clear = Parameter(0.92, "pu(V)", (0.1, 1.05), "a sag is over above", "illustrative")

    v_f = Input("pu(V)", "measured POI voltage")
    lock = Output("1", "1 while the facility must stay on its battery")
    mode = Output("1", "number of the mode, from 0")

    m_1 = State(0.0, "1", "memory of the last sag")
    m_2 = State(0.0, "1", "memory of the sag before it")
    m_3 = State(0.0, "1", "memory of the third sag back")
    m_4 = State(0.0, "1", "memory of the fourth sag back")
    m_5 = State(0.0, "1", "memory of the fifth sag back")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        sag, over = below(s.v_f, s.V_count), above(s.v_f, s.V_clear)
        shift = dict(m_1=1.0, m_2=s.m_1, m_3=s.m_2, m_4=s.m_3, m_5=s.m_4)
        return (
            Go("READY", "LOCKED", self.nth(s, sag), reset=shift),
            Go("READY", "SAG", sag, reset=shift),
            Go("SAG", "READY", over),
            Go("LOCKED", "READY", over, held=s.T_reset, reset={name: 0.0 for name in shift}),
        )

    def nth(self, s: Any, sag: Guard) -> Guard:
        """True while there is a sag that is the N-th within the window."""
        counted = above(s.N, 0.5) & below(s.N, 1.5)
        for n, memory in enumerate((s.m_1, s.m_2, s.m_3, s.m_4, s.m_5), start=2):
            counted = counted | above(s.N, n - 0.5) & below(s.N, n + 0.5) & above(memory, FADED)
        return ToldGuard((sag & counted).cases, f"{sag}, sag number {s.N} in {s.T_window}")

    def equations(self, s: Any) -> Equations:
        return Equations(
            der={name: -getattr(s, name) / s.T_window for name in self.declared(State)},
            out=dict(lock=s.locked, mode=s.number),
        )
