"""Several automata in one facility, wired from blocks: each has its clock and may read the others' flags."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest

from dcvrt import Simulator, Waveform
from dcvrt.errors import SimulationError
from dcvrt.integrators import Casadi
from dcvrt.models import (
    Block,
    Diagram,
    Equations,
    Go,
    Input,
    Output,
    Parameter,
    Phasor,
    State,
    above,
    always,
    below,
)

approx = pytest.approx
TIGHT = Casadi("erk", 1e-10, 1e-12)


class Magnitude(Block):
    """Real part of the voltage: all that the waveforms here have."""

    v = Input("pu(V)", "voltage", kind=Phasor)
    m = Output("pu(V)", "its real part")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(m=s.v.re))


class Contactor(Block):
    """Drops out `T_out` after the voltage fell below `low`, comes back `T_in` after it is above `high`."""

    modes = ("IN", "OUT")
    start = "IN"
    flags: ClassVar = {"closed": (1, 0)}

    low = Parameter(0.7, "pu(V)", (0, 1), "drops out below")
    high = Parameter(0.9, "pu(V)", (0, 1), "comes back above")
    T_out = Parameter(0.05, "s", (0, 10), "time to drop out")
    T_in = Parameter(0.2, "s", (0, 10), "time to come back")
    m = Input("pu(V)", "voltage")
    closed_now = Output("1", "1 while closed")
    age = Output("s", "time in the present mode")
    x = State(0.0, "s", "time spent open")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return (
            Go("IN", "OUT", below(s.m, s.low), held=s.T_out),
            Go("OUT", "IN", above(s.m, s.high), held=s.T_in),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(der=dict(x=1 - s.closed), out=dict(closed_now=s.closed, age=s.clock))


class Restart(Block):
    """Runs; stops when its supply is open; waits for it, then starts anew after `T_start`."""

    modes = ("RUN", "STOP", "START")
    start = "RUN"
    flags: ClassVar = {"running": (1, 0, 0)}

    T_start = Parameter(0.1, "s", (0, 10), "time to start")
    supply = Input("1", "1 while the supply is closed")
    run = Output("1", "1 while running")
    age = Output("s", "time in the present mode")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return (
            Go("RUN", "STOP", below(s.supply, 0.5)),
            Go("STOP", "START", above(s.supply, 0.6)),
            Go("START", "STOP", below(s.supply, 0.5)),
            Go("START", "RUN", always(), held=s.T_start),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(run=s.running, age=s.clock))


def hall(**second: float) -> Diagram:
    """Two contactors on one voltage, and a machine behind the first."""
    d = Diagram("hall")
    v = d.input("v_poi", "pu(V)", Phasor)
    meter, one, two, fan = (
        d.add("meter", Magnitude()), d.add("one", Contactor()), d.add("two", Contactor(**second)),
        d.add("fan", Restart()),
    )  # fmt: skip
    d.connect(v, meter.v)
    d.connect(meter.m, one.m, two.m)
    d.connect(one.closed_now, fan.supply)
    for name, port in (("open_1", one.x), ("age_1", one.age), ("age_2", two.age), ("age_fan", fan.age)):
        d.output(name, port)
    return d


def walk(run: Any) -> list[tuple[str, str, float]]:
    return [(e.automaton, e.target, e.time) for e in run.events]


SAG = Waveform.sag(0.5, 0.1, 0.3, until=1.0)


def test_automata_at_the_same_instant_all_move_and_pass_it_on() -> None:
    run = Simulator(hall().compile(), TIGHT)(SAG)
    assert walk(run) == [
        ("one", "OUT", approx(0.15, abs=1e-9)),
        ("two", "OUT", approx(0.15, abs=1e-9)),
        ("fan", "STOP", approx(0.15, abs=1e-9)),  # reads the flag that the first has just changed
        ("one", "IN", approx(0.6, abs=1e-9)),
        ("two", "IN", approx(0.6, abs=1e-9)),
        ("fan", "START", approx(0.6, abs=1e-9)),
        ("fan", "RUN", approx(0.7, abs=1e-9)),
    ]
    assert run["open_1"][-1] == approx(0.45, abs=1e-8)
    # one break for all that happens at one instant: two voltage jumps, 0.15 s, 0.6 s, 0.7 s
    assert len(run.breaks) == 5


def test_automata_at_different_instants_leave_each_other_alone() -> None:
    run = Simulator(hall(T_out=0.12, T_in=0.05, high=0.8).compile(), TIGHT)(SAG)
    assert walk(run) == [
        ("one", "OUT", approx(0.15)),
        ("fan", "STOP", approx(0.15)),
        ("two", "OUT", approx(0.22)),
        ("two", "IN", approx(0.45)),
        ("one", "IN", approx(0.6)),
        ("fan", "START", approx(0.6)),
        ("fan", "RUN", approx(0.7)),
    ]


def test_every_automaton_has_its_own_clock() -> None:
    run = Simulator(hall(T_out=0.12, T_in=0.05, high=0.8).compile(), TIGHT)(SAG)
    for t, one, two, fan in (
        (0.14, 0.14, 0.14, 0.14), (0.20, 0.05, 0.20, 0.05), (0.30, 0.15, 0.08, 0.15),
        (0.50, 0.35, 0.05, 0.35), (0.65, 0.05, 0.20, 0.05), (0.90, 0.30, 0.45, 0.20),
    ):  # fmt: skip
        ages = [float(run.at(name, t)) for name in ("age_1", "age_2", "age_fan")]
        assert ages == approx([one, two, fan], abs=1e-9)


def test_times_of_passed_on_events_have_the_gradient_of_their_cause() -> None:
    run = Simulator(hall().compile(), TIGHT, wrt=("one.T_out", "one.T_in", "fan.T_start"))(SAG)
    events = {(e.automaton, e.target): e.grad for e in run.events}
    assert events["fan", "STOP"] == approx({"one.T_out": 1.0, "one.T_in": 0.0, "fan.T_start": 0.0})
    assert events["fan", "RUN"] == approx({"one.T_out": 0.0, "one.T_in": 1.0, "fan.T_start": 1.0})
    # x' = 1 while open
    assert [run.sens["open_1", n][-1] for n in run.wrt] == approx([-1.0, 1.0, 0.0], abs=1e-8)


def test_two_automata_that_chase_each_other_are_stopped_and_named() -> None:
    class Chaser(Block):
        """Takes the mode that the other has not."""

        modes = ("A", "B")
        start = "A"
        flags: ClassVar = {"on": (0, 1)}
        sign = Parameter(1.0, "1", (-1, 1), "1: agree with the other, -1: differ from it")
        m = Input("pu(V)", "voltage")
        other = Input("1", "flag of the other")
        y = Output("1", "own flag")

        def transitions(self, s: Any) -> tuple[Go, ...]:
            wish = s.sign * (s.other - 0.5)
            return (
                Go("A", "B", above(wish, 0.25) & below(s.m, 0.9)),
                Go("B", "A", below(wish, -0.25) & below(s.m, 0.9)),
            )

        def equations(self, s: Any) -> Equations:
            return Equations(out=dict(y=s.on))

    d = Diagram("hall")
    v = d.input("v_poi", "pu(V)", Phasor)
    meter, one, two = d.add("meter", Magnitude()), d.add("one", Chaser()), d.add("two", Chaser(sign=-1.0))
    d.connect(v, meter.v)
    d.connect(meter.m, one.m, two.m)
    d.connect(one.y, two.other)
    d.connect(two.y, one.other)
    x = d.add("x", Contactor())
    d.connect(meter.m, x.m)
    with pytest.raises(SimulationError) as error:
        Simulator(d.compile())(SAG)
    assert str(error.value) == (
        "hall on sag to 0.5 pu for 300 ms: more than 50 jumps at 0.1 s between one: A -> B, one: B -> A, "
        "two: A -> B, two: B -> A: the guards of these modes are true together; give them hysteresis or a "
        "dwell time (held)"
    )


def test_a_batch_tells_the_sequence_of_every_automaton() -> None:
    dae = hall(T_out=0.12).compile()
    result = Simulator(dae).batch([SAG], {"one.T_out": [0.05, 1.0]}, keep=True)
    assert all(run is not None for run in result.runs)
    first, second = (run.sequence for run in result.runs if run is not None)
    assert first[:3] == ("one: IN", "two: IN", "fan: RUN")
    assert [line.split(" [")[0] for line in second[3:]] == ["two: IN -> OUT", "two: OUT -> IN"]
