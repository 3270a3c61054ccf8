"""One block on its own, driven by inputs that jump: for closed forms of its modes."""

from __future__ import annotations

from typing import Any

import numpy as np

from dcvrt import Simulator, Waveform
from dcvrt.integrators import Casadi
from dcvrt.models import Block, Diagram, Equations, Input, Output, Phasor, State
from dcvrt.trajectory import Trajectory

TIGHT = Casadi("erk", rtol=1e-10, atol=1e-12)


class Nothing(Block):
    """No current."""

    i = Output("pu(I)", "no current", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(i=Phasor(0.0, 0.0)))


class Idle(Block):
    """A state that rests, for a block that has none: integrators need one."""

    x = State(0.0, "1", "at rest")

    def equations(self, s: Any) -> Equations:
        return Equations(der=dict(x=-s.x))


def alone(block: Block) -> Simulator:
    """Simulator of a diagram that holds nothing but `block`, under the name b.

    Its inputs are inputs of the diagram, with the same names; those that are phasors are the waveform.
    """
    d = Diagram("alone")
    d.add("idle", Idle())
    b = d.add("b", block)
    v_poi = d.input("v_poi", "pu(V)", Phasor)
    for name, port in b.declared(Input).items():
        if port.kind is Phasor and port.unit == "pu(V)":
            d.connect(v_poi, getattr(b, name))
        elif port.kind is Phasor:
            nothing = d.add(f"no_{name}", Nothing())
            d.connect(nothing.i, getattr(b, name))
        else:
            d.connect(d.input(name, port.unit, rest=1.0), getattr(b, name))
    for name in b.declared(Output):
        d.output(name, getattr(b, name))
    return Simulator(d.compile(), TIGHT, save_at=0.05)


def steps(*values: tuple[float, float], until: float) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a stair: from each time on its value."""
    t, y = [], []
    for (a, value), b in zip(values, [*(time for time, _ in values[1:]), until], strict=True):
        t += [a, b]
        y += [value, value]
    return np.array(t), np.array(y)


def flat(until: float) -> Waveform:
    return Waveform.segments([(0.0, 1.0)], until=until)


def walk(run: Trajectory, automaton: str = "b") -> list[tuple[float, str]]:
    """Times and modes entered."""
    return [(e.time, e.target) for e in run.events if e.automaton == automaton]


def times(run: Trajectory, target: str, automaton: str = "b") -> list[float]:
    return [t for t, mode in walk(run, automaton) if mode == target]


def modes(run: Trajectory, automaton: str = "b") -> list[str]:
    return [mode for _, mode in walk(run, automaton)]


def rates(block: Block, **values: object) -> dict[str, float]:
    return dict(block.equations(block.at(**values)).der)
