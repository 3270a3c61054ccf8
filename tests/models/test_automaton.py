"""Tables of modes: guards, rows, and the checks before anything runs."""

from __future__ import annotations

import casadi as ca
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.errors import ModelError
from dcvrt.models import (
    Block,
    Diagram,
    Equations,
    Go,
    Input,
    Output,
    Parameter,
    State,
    Supervisor,
    above,
    always,
    below,
    outside,
    within,
)


class Switch(Block):
    """Two modes on one signal."""

    modes = ("LOW", "HIGH")
    start = "LOW"
    flags = {"on": (0, 1)}  # noqa: RUF012

    up = Parameter(0.6, "1", (0, 1), "to HIGH above")
    down = Parameter(0.4, "1", (0, 1), "to LOW below")
    T = Parameter(0.1, "s", (0, 1), "dwell")

    v = Input("1", "signal")
    y = Output("1", "on")
    n = State(0.0, "s", "time spent in HIGH")

    def rows(self, s):
        return (
            Go("LOW", "HIGH", above(s.v, s.up)),
            Go("HIGH", "LOW", below(s.v, s.down), held=s.T, reset={"n": 0}),
        )

    def transitions(self, s):
        return self.rows(s)

    def equations(self, s):
        return Equations(der={"n": s.on}, out={"y": s.on * s.clock})


def compiled(block, **values):
    d = Diagram("d")
    v = d.input("v", "1")
    b = d.add("b", block)
    for name, value in values.items():
        d.set(f"b.{name}", value)
    d.connect(v, b.v)
    d.output("y", b.y)
    return d.compile()


def refusal(rows, **values):
    class Wrong(Switch):
        pass

    Wrong.rows = rows
    with pytest.raises(ModelError) as error:
        compiled(Wrong(), **values)
    return str(error.value)


@given(*[st.floats(-2, 2)] * 4)
def test_a_margin_is_positive_exactly_while_the_guard_is_true(v, w, low, high):
    assert (below(v, low).margin > 0) == (v < low)
    assert (above(v, low).margin > 0) == (v > low)
    assert (within(v, low, high).margin > 0) == (low < v < high)
    assert (outside(v, low, high).margin > 0) == (v < low or v > high)
    assert ((outside(v, low, high) & above(w, low)).margin > 0) == ((v < low or v > high) and w > low)
    assert ((within(v, low, high) | below(w, low)).margin > 0) == ((low < v < high) or w < low)
    assert always().margin > 0


def test_the_table_arrives_in_the_dae_as_data():
    dae = compiled(Switch())
    (a,) = dae.automata
    assert (a.path, a.modes, a.start, a.flag_names) == ("b", ("LOW", "HIGH"), "LOW", ("on",))
    assert a.flags.tolist() == [[0.0], [1.0]]
    assert [row.text for row in a.rows] == ["LOW -> HIGH: v > up", "HIGH -> LOW: v < down held T"]
    assert list(a.rows[1].reset) == [0]
    f = ca.Function("f", [dae.u, dae.p], [a.rows[0].guard, a.rows[1].guard, a.rows[1].held])
    assert [float(v) for v in f(0.7, dae.parameter_values())] == pytest.approx([0.1, -0.3, 0.1])
    y = ca.Function("y", [dae.x, dae.q, dae.clocks], [dae.y, dae.f])
    assert [float(v) for v in y(0, 1, 0.25)] == [0.25, 1.0]


def test_unknown_mode():
    text = refusal(
        lambda self, s: (Go("LOW", "HIHG", above(s.v, s.up)), Go("HIGH", "LOW", below(s.v, s.down)))
    )
    assert text == (
        "d: b (Wrong): LOW -> HIHG: there is no mode 'HIHG'. Did you mean 'HIGH'? Known: LOW, HIGH."
    )


def test_unknown_start_mode():
    class Wrong(Switch):
        start = "LO"

    with pytest.raises(ModelError) as error:
        compiled(Wrong())
    assert str(error.value) == (
        "d: b (Wrong): the start mode 'LO' is not one of its modes. Did you mean 'LOW'? Known: LOW, HIGH."
    )


def test_unreachable_and_dead_end_modes_are_named_together():
    text = refusal(lambda self, s: (Go("HIGH", "LOW", below(s.v, s.down)),))
    assert text == (
        "d: b (Wrong): 2 problems\n"
        "  mode(s) never entered from LOW: HIGH. Add a row that leads there or drop the mode.\n"
        "  mode(s) without a way out: LOW. Add a row that leaves them."
    )


def test_thresholds_without_hysteresis_are_refused():
    with pytest.raises(ModelError) as error:
        compiled(Switch(), down=0.6)
    assert str(error.value) == (
        "d: b: 'LOW -> HIGH: v > up' and 'HIGH -> LOW: v < down held T' leave no gap between them "
        "(up = 0.6, down = 0.6): the modes would chatter. "
        "Set the limit of the way back beyond that of the way out."
    )


def test_hysteresis_of_the_supervisor_is_checked_with_its_present_values():
    d = Diagram("d")
    v, w, e = d.input("v", "pu(V)", rest=1.0), d.input("w", "1", rest=1.0), d.input("e", "pu(V)")
    sup = d.add("sup", Supervisor())
    d.connect(v, sup.v_f)
    d.connect(w, sup.w)
    d.connect(e, sup.error)
    assert d.compile().automata[0].modes == ("NORMAL", "MIXED", "BATTERY", "RETURN")
    d.set("sup.V_back", 0.89)
    with pytest.raises(ModelError, match=r"leave no gap between them .*V_dip = 0.9.*V_back = 0.89"):
        d.compile()


def test_values_of_a_run_that_take_the_hysteresis_away_are_refused_before_it():
    from dcvrt import Simulator, Waveform, facility
    from dcvrt.errors import InputError

    dae = facility.gfl().compile()
    simulator, sag = Simulator(dae), Waveform.sag(0.7, 0.1, 0.1, until=0.3)
    told = (
        "gfl: sup: 'NORMAL -> MIXED: v_f < V_dip or v_f > V_swell or w < w_sag' and "
        "'MIXED -> NORMAL: v_f > V_back and v_f < V_calm and w > w_back held T_mixed' leave no gap between "
        "them (V_dip = 0.9, V_back = 0.86): the modes would chatter. "
        "Set the limit of the way back beyond that of the way out."
    )
    for call in (
        lambda: simulator(sag, **{"sup.V_back": 0.86}),
        lambda: simulator.equilibrium(1.0, **{"sup.V_back": 0.86}),
        lambda: dae.parameter_values(**{"sup.V_back": 0.86}),
    ):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == told
    both = {"sup.V_back": 0.86, "sup.V_dip": 0.8}  # the gap counts, not the single values
    assert simulator(sag, **both).completed


class Referred(Block):
    """Two modes on a signal and a reference that varies in time."""

    modes = ("LOW", "HIGH")
    start = "LOW"
    v = Input("1", "signal")
    ref = Input("1", "reference")
    x = State(0.0, "s", "integral of the signal")

    def equations(self, s):
        return Equations(der={"x": s.v})


class Follower(Referred):
    """Limits that vary in time, a fixed distance apart."""

    gap = Parameter(0.1, "1", (-1, 1), "distance of the limits")

    def transitions(self, s):
        return (Go("LOW", "HIGH", above(s.v, s.ref)), Go("HIGH", "LOW", below(s.v, s.ref - s.gap)))


def following(block, **values):
    d = Diagram("d")
    v, ref = d.input("v", "1"), d.input("ref", "1")
    b = d.add("b", block)
    d.connect(v, b.v)
    d.connect(ref, b.ref)
    for name, value in values.items():
        d.set(f"b.{name}", value)
    return d.compile()


def test_the_distance_of_limits_that_move_together_is_checked():
    assert [gap.rows for gap in following(Follower()).automata[0].gaps] == [
        ("LOW -> HIGH: v > ref", "HIGH -> LOW: v < ref - gap")
    ]
    with pytest.raises(ModelError) as error:
        following(Follower(), gap=-0.1)
    assert str(error.value) == (
        "d: b: 'LOW -> HIGH: v > ref' and 'HIGH -> LOW: v < ref - gap' leave no gap between them "
        "(gap = -0.1): the modes would chatter. Set the limit of the way back beyond that of the way out."
    )


def test_limits_that_vary_on_their_own_are_left_to_the_run():
    class Free(Referred):
        """Nothing can be said of the distance before a run."""

        down = Parameter(0.4, "1", (0, 1), "to LOW below")

        def transitions(self, s):
            return (Go("LOW", "HIGH", above(s.v, s.ref)), Go("HIGH", "LOW", below(s.v, s.down)))

    assert following(Free()).automata[0].gaps == ()


def test_guards_on_different_signals_that_can_be_true_together_are_refused():
    class Blind(Referred):
        """Leaves on one signal, comes back on another."""

        up = Parameter(0.6, "1", (0, 1), "to HIGH above")
        down = Parameter(0.4, "1", (0, 1), "to LOW below")

        def transitions(self, s):
            return (Go("LOW", "HIGH", above(s.v, s.up)), Go("HIGH", "LOW", below(s.ref, s.down)))

    with pytest.raises(ModelError) as error:
        following(Blind())
    assert str(error.value) == (
        "d: b: 'LOW -> HIGH: v > up' and 'HIGH -> LOW: ref < down' leave no gap between them (up = 0.6, "
        "down = 0.4): the modes would chatter. Set the limit of the way back beyond that of the way out."
    )


def test_a_dwell_time_must_not_depend_on_signals():
    text = refusal(
        lambda self, s: (Go("LOW", "HIGH", above(s.v, s.up), held=s.v), Go("HIGH", "LOW", always(), held=1))
    )
    assert text == "d: b (Wrong): LOW -> HIGH: held may depend on parameters only, not v."


def test_a_reset_must_name_a_state():
    text = refusal(
        lambda self, s: (Go("LOW", "HIGH", above(s.v, s.up)), Go("HIGH", "LOW", always(), reset={"m": 0}))
    )
    assert text == ("d: b (Wrong): HIGH -> LOW: reset of 'm', not a state of the block. Known: n.")


def test_flags_must_have_a_value_for_every_mode_and_names_of_their_own():
    with pytest.raises(ModelError) as error:

        class Wrong(Switch):
            flags = {"on": (0, 1, 2), "v": (0, 1)}  # noqa: RUF012

    assert str(error.value) == (
        "Wrong: 2 problems\n"
        "  the flag 'on' has 3 values for 2 modes.\n"
        "  the flag 'v' has the name of a symbol of the block."
    )
