"""Blocks that drive other blocks in tests: the imposed waveform as any signal, constants, an integral."""

from __future__ import annotations

from typing import Any

from dcvrt import Simulator, Waveform
from dcvrt.integrators import Casadi
from dcvrt.models import Block, Diagram, Equations, Input, Output, Parameter, Phasor, State
from dcvrt.models.block import Port
from dcvrt.trajectory import Trajectory

TIGHT = Casadi("erk", 1e-10, 1e-12)


class Signal(Block):
    """The real part of the waveform as signals of several units; and a lag, since a run needs a state."""

    v = Input("pu(V)", "waveform", kind=Phasor)
    volts = Output("pu(V)", "as a voltage")
    ratio = Output("1", "as a ratio")
    power = Output("pu(S)", "as a power")
    late = State(0.0, "pu(V)", "as a voltage, 10 ms late")

    def equations(self, s: Any) -> Equations:
        return Equations(
            der=dict(late=(s.v.re - s.late) / 0.01), out=dict(volts=s.v.re, ratio=s.v.re, power=s.v.re)
        )


class Constant(Block):
    """Signals that do not change."""

    value = Parameter(0.0, "1", (-10.0, 10.0), "the value", "test")
    ratio = Output("1", "as a ratio")
    power = Output("pu(S)", "as a power")
    current = Output("pu(I)", "as a current")
    volts = Output("pu(V)", "as a voltage")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(ratio=s.value, power=s.value, current=s.value, volts=s.value))


class DqPower(Block):
    """Power of a voltage and a current in one frame."""

    v = Input("pu(V)", "voltage", kind=Phasor)
    i = Input("pu(I)", "current", kind=Phasor)
    p = Output("pu(S)", "active power")
    q = Output("pu(S)", "reactive power")

    def equations(self, s: Any) -> Equations:
        power = s.v * s.i.conj()
        return Equations(out=dict(p=power.re, q=power.im))


class Audit(Block):
    """Integral of what comes in and is neither served nor lost."""

    p_g = Input("pu(S)", "import")
    p_out = Input("pu(S)", "served")
    loss = Input("pu(S)", "lost")
    net = State(0.0, "pu(S) s", "what must have been stored")

    def equations(self, s: Any) -> Equations:
        return Equations(der=dict(net=s.p_g - s.p_out - s.loss))


def bench(block: Block, wires: dict[str, str | float], outputs: tuple[str, ...]) -> Diagram:
    """One block, its inputs fed by the waveform ("v", "volts", "ratio", "power") or by numbers."""
    d = Diagram("bench")
    v = d.input("v_poi", "pu(V)", Phasor)
    source = d.add("source", Signal())
    d.connect(v, source.v)
    d.add("block", block)
    for k, (name, what) in enumerate(wires.items()):
        target: Port = getattr(block, name)
        if isinstance(what, str):
            d.connect(v if what == "v" else getattr(source, what), target)
            continue
        unit = {"1": "ratio", "pu(S)": "power", "pu(I)": "current", "pu(V)": "volts"}[target.declared.unit]
        d.connect(getattr(d.add(f"constant_{k}", Constant(value=what)), unit), target)
    for name in outputs:
        d.output(name, getattr(block, name))
    return d


def steps(*levels: tuple[float, complex], until: float) -> Waveform:
    return Waveform.segments(list(levels), until=until)


def play(diagram: Diagram, waveform: Waveform, save_at: float = 1e-3, **parameters: float) -> Trajectory:
    return Simulator(diagram.compile(), TIGHT, save_at=save_at)(waveform, **parameters)


def walk(run: Trajectory, automaton: str) -> list[tuple[float, str]]:
    """Times and modes of one automaton."""
    return [(e.time, e.target) for e in run.events if e.automaton == automaton]
