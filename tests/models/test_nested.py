"""A diagram as a block of another: the same system, under longer paths."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from dcvrt.errors import InputError, ModelError
from dcvrt.models import (
    Block,
    Diagram,
    Equations,
    Go,
    Input,
    Output,
    Parameter,
    Phasor,
    Pll,
    State,
    above,
    below,
)


class Lag(Block):
    """T x' = k u - x."""

    T = Parameter(0.5, "s", (0.01, 10), "time constant", "test")
    k = Parameter(1.0, "1", (-10, 10), "gain", "test")
    u = Input("1", "in")
    y = Output("1", "x + u")
    x = State(0.0, "1", "lagged")

    def equations(self, s):
        return Equations(der={"x": (s.k * s.u - s.x) / s.T}, out={"y": s.x + s.u})


class Relay(Block):
    """On above `up`, off below `down`."""

    modes = ("OFF", "ON")
    start = "OFF"
    flags = {"on": (0, 1)}  # noqa: RUF012
    up = Parameter(0.6, "1", (0, 1), "on above")
    down = Parameter(0.4, "1", (0, 1), "off below")
    u = Input("1", "signal")
    y = Output("1", "on")

    def transitions(self, s):
        return (Go("OFF", "ON", above(s.u, s.up)), Go("ON", "OFF", below(s.u, s.down)))

    def equations(self, s):
        return Equations(out={"y": s.on})


def cell(name="cell", T=0.5):
    """Two lags in a row with a common gain, and a relay on the second."""
    d = Diagram(name, "two lags and a relay")
    g = d.parameter("g", 2.0, "1", (0, 10), "gain of both", "test")
    u = d.input("u", "1", doc="what drives it")
    a, b, relay = d.add("a", Lag(T=T)), d.add("b", Lag(T=2 * T)), d.add("relay", Relay())
    d.bind(a, k=g)
    d.bind(b, k=g / 2)
    d.connect(u, a.u)
    d.connect(a.x, b.u)
    d.connect(b.x, relay.u)
    d.output("x", b.x)
    d.output("sum", a.y)
    return d


def site(**inner):
    """Two cells in a row under one gain, the second slower."""
    d = Diagram("site")
    G = d.parameter("G", 3.0, "1", (0, 10))
    u = d.input("u", "1", rest=1.0)
    one, two = d.add("one", cell(**inner)), d.add("two", cell(T=1.0))
    d.bind(one, g=2 * G)
    d.connect(u, one.u)
    d.connect(one.sum, two.u)
    d.output("x", two.x)
    return d


def refusal(diagram, kind=ModelError):
    with pytest.raises(kind) as error:
        diagram.compile()
    return str(error.value)


def rates(dae, x, u):
    f = ca.Function("f", [dae.x, dae.u, dae.p, dae.q, dae.clocks], [dae.f, dae.y])
    return [np.array(v).ravel() for v in f(x, u, dae.parameter_values(), np.zeros(2), np.zeros(2))]


def test_paths_begin_with_the_name_of_the_part():
    dae = site().compile()
    assert dae.x_names == ("one.a.x", "one.b.x", "two.a.x", "two.b.x")
    assert dae.p_names == (
        "G", "two.g", "one.a.T", "one.b.T", "one.relay.up", "one.relay.down", "two.a.T", "two.b.T",
        "two.relay.up", "two.relay.down",
    )  # fmt: skip
    assert [a.path for a in dae.automata] == ["one.relay", "two.relay"]
    assert [row.text for row in dae.automata[1].rows] == ["OFF -> ON: u > up", "ON -> OFF: u < down"]
    assert (dae.u_names, dae.y_names) == (("u",), ("x",))


def test_a_nested_system_is_the_flat_one():
    x, u = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.7])
    f, y = rates(site().compile(), x, u)
    middle = x[0] + u[0]  # one.sum = one.a.y
    expected = [
        (2 * 3.0 * u[0] - x[0]) / 0.5,
        (3.0 * x[0] - x[1]) / 1.0,
        (2.0 * middle - x[2]) / 1.0,
        (1.0 * x[2] - x[3]) / 2.0,
    ]
    assert f == pytest.approx(expected)
    assert y == pytest.approx([0.4])


def test_three_levels_deep():
    outer = Diagram("park")
    s = outer.add("s", site())
    outer.connect(outer.input("u", "1"), s.u)
    outer.output("x", s.x)
    dae = outer.compile()
    assert dae.x_names[0] == "s.one.a.x"
    assert dae.p_names[0] == "s.G"
    x, u = np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.7])
    np.testing.assert_allclose(rates(dae, x, u)[0], rates(site().compile(), x, u)[0])


def test_values_parts_and_ports_by_path():
    d = site()
    d.set("one.a.T", 0.25)
    d.set("two.g", 4.0)
    d.replace("two.b", Lag(T=7.0))
    d.output("inside", d.port("one.a.x"))
    d.output("direct", d.blocks["two"].blocks["b"].x)
    dae = d.compile()
    values = dict(zip(dae.p_names, dae.parameter_values(), strict=True))
    assert (values["one.a.T"], values["two.g"], values["two.b.T"]) == (0.25, 4.0, 7.0)
    _, y = rates(dae, np.array([0.1, 0.2, 0.3, 0.4]), np.array([0.7]))
    assert y == pytest.approx([0.4, 0.1, 0.4])
    assert str(d.port("one.a.x")) == "one.a.x"
    assert str(d.port("one.sum")) == "one.sum"
    assert d.blocks["two"].g == 4.0


def test_a_block_can_take_the_place_of_a_diagram_and_back():
    class Straight(Block):
        """All that a cell shows, without its inside."""

        g = Parameter(1.0, "1", (0, 10), "gain")
        u = Input("1", "in")
        x = Output("1", "out")
        sum = Output("1", "out")

        def equations(self, s):
            return Equations(out={"x": s.g * s.u, "sum": s.u})

    d = site()
    d.replace("one", Straight())
    assert d.compile().x_names == ("two.a.x", "two.b.x")
    d.replace("one", cell())
    assert d.compile().x_names == ("one.a.x", "one.b.x", "two.a.x", "two.b.x")


def test_feedthrough_passes_through_diagrams():
    assert cell().feedthrough() == {"x": (), "sum": ("u",)}
    d = site()
    d.output("sum", d.blocks["two"].sum)
    assert d.feedthrough() == {"x": (), "sum": ("u",)}


def test_a_loop_through_a_diagram_prints_full_paths():
    d = Diagram("ring")
    one, two = d.add("one", cell()), d.add("two", cell())
    d.connect(one.sum, two.u)
    d.connect(two.sum, one.u)
    assert refusal(d) == (
        "ring: algebraic loop\n"
        "  two.a.y  <- needs two.a.u\n"
        "  one.a.y  <- needs one.a.u\n"
        "  two.a.y\n"
        "Ways out: put a lag in the path, or mark one wire connect(..., implicit=True) "
        "to solve it as an algebraic variable."
    )


def test_an_implicit_wire_into_a_diagram():
    d = Diagram("ring")
    one, two = d.add("one", cell()), d.add("two", cell())
    d.connect(one.sum, two.u)
    d.connect(two.x, one.u, implicit=True)
    dae = d.compile()
    assert [row.path for row in dae.algebraics] == ["one.u"]
    assert dae.algebraics[0].doc == "implicit wire from two.x"


def test_units_are_checked_on_both_sides_of_a_diagram():
    d = Diagram("d")
    half = Diagram("half")
    half.connect(half.input("v", "pu(V)", Phasor, doc="voltage"), half.add("pll", Pll()).v)
    half.output("omega", half.port("pll.omega"))
    part = d.add("ups", half)
    other = d.add("other", Pll())
    d.connect(d.input("i", "pu(I)", Phasor), part.v)
    d.connect(part.omega, other.v)
    assert refusal(d) == (
        "d: 2 problems\n"
        "  i [pu(I), Phasor] cannot drive ups.v [pu(V), Phasor]. "
        "Nothing in the diagram has this unit and kind: add a block that gives it, or an input().\n"
        "  ups.omega [rad/s, float] cannot drive other.v [pu(V), Phasor]. "
        "Nothing in the diagram has this unit and kind: add a block that gives it, or an input()."
    )


def test_what_is_missing_inside_or_outside_is_named_by_its_path():
    d = Diagram("d")
    inner = Diagram("inner")
    inner.add("a", Lag())
    inner.input("u", "1")
    inner.output("x", inner.port("a.x"))
    d.add("part", inner)
    d.input("v", "1")
    assert refusal(d) == (
        "d: 2 problems\n"
        "  part.a.u [1, float] is not connected (in). It could be fed by: part.u, part.a.y, part.a.x.\n"
        "  part.u [1, float] is not connected. It could be fed by: v, part.x."
    )


def test_wiring_errors_inside_say_in_which_diagram():
    d = Diagram("d")
    inner = cell()
    inner.connect(inner.port("u"), inner.blocks["a"].u)
    d.connect(d.input("u", "1"), d.add("part", inner).u)
    assert refusal(d) == (
        "d: in part: a.u is already driven by u; u cannot drive it too. "
        "Drop one of the two, or add them in a block."
    )


def test_an_inner_input_is_not_driven_from_outside_as_well():
    d = site()
    d.connect(d.port("u"), d.port("two.b.u"))
    assert refusal(d) == (
        "site: two.b.u is already driven by u; two.a.x cannot drive it too. "
        "Drop one of the two, or add them in a block."
    )


def test_bindings_across_levels():
    d = site()
    d.bind(d.blocks["two"], gg=1.0)
    assert refusal(d) == "site: bind: two has no parameter 'gg'. Did you mean 'g'? Known: g."

    d = site()
    d.bind(d.blocks["two"], g=d.blocks["two"].shared["g"].symbol)
    assert refusal(d) == (
        "site: two.g is bound to g; g is not a parameter of the diagram. "
        "Bind to what parameter() returned. Known: G."
    )

    d = site()
    d.bind(d.part("two.a"), k=5.0)  # from outside, past what two binds
    f, _ = rates(d.compile(), np.zeros(4), np.array([1.0]))
    assert f[2] == pytest.approx(5.0 * 1.0 / 1.0)


@pytest.mark.parametrize(
    ("path", "value", "text"),
    [
        ("one.g", 1.0, "one.g is bound to 2*G. Set 'G' instead, or bind it anew."),
        ("two.a.k", 1.0, "two.a.k is bound to two.g. Set 'two.g' instead, or bind it anew."),
        ("two.g", 11.0, "two.g = 11 is outside [0, 10]."),
        ("two.a.t", 1.0, "site has no parameter 'two.a.t'. Did you mean 'two.a.T'? Known: two.a.T."),
    ],
)
def test_set_by_path_is_checked_on_the_spot(path, value, text):
    with pytest.raises(InputError) as error:
        site().set(path, value)
    assert str(error.value) == text


def test_unknown_parts_and_ports_by_path():
    d = site()
    for call, text in (
        (lambda: d.replace("one.c", Lag()), "site has no block 'one.c'. Did you mean 'one.b'? "
                                            "Known: one.a, one.b, one.relay."),
        (lambda: d.port("one.a.z"), "site has no port 'one.a.z'. Did you mean 'one.a.y'? "
                                    "Known: one.a.u, one.a.y, one.a.x."),
        (lambda: d.port("one.a.T"), "one.a.T is a parameter, not a port. Give it a value with set or bind."),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == text
    with pytest.raises(ModelError) as unknown:
        _ = d.blocks["one"].summ
    assert str(unknown.value) == "one (cell) has no 'summ'. Did you mean 'sum'? Known: g, u, x, sum."


def test_a_diagram_is_in_one_place_and_not_in_itself():
    d, inner = Diagram("d"), Diagram("inner")
    d.add("one", inner)
    d.add("two", inner)
    inner.add("me", d)
    d.add("a.b", Lag())
    inner_problems = (
        "d: 4 problems\n"
        "  the block added as 'two' is already 'one' of a diagram. Make a second diagram 'inner'.\n"
        "  the name 'a.b' has a dot, which separates the parts of a path. Drop it.\n"
    )
    text = refusal(d)
    assert text.startswith(inner_problems.replace("4 problems", "3 problems"))
    assert text.endswith("  in one: d cannot be a part of itself, here added as 'me'.")


def test_hysteresis_inside_is_named_by_its_path():
    d = site()
    d.set("two.relay.down", 0.7)
    assert refusal(d) == (
        "site: two.relay: 'OFF -> ON: u > up' and 'ON -> OFF: u < down' leave no gap between them "
        "(up = 0.6, down = 0.7): the modes would chatter. "
        "Set the limit of the way back beyond that of the way out."
    )


def test_the_sheet_shows_the_nesting():
    text = site().sheet()
    assert text.index("## one: cell") < text.index("### one.a: Lag") < text.index("## two: cell")
    assert "| `g` | `2*G` | 1 | [0, 10] | gain of both | bound |" in text
    assert "| `k` | `two.g/2` | 1 | [-10, 10] | gain | bound |" in text
    assert text.count("T x' = k u - x.") == 1  # equations once
    assert "As `one.a`." in text
    assert "| input | `u` | 1 | what drives it | `one.sum` |" in text


def test_a_nested_facility_runs_as_it_does_alone():
    from dcvrt import Simulator, Waveform, facility

    alone = facility.gfl()
    d = Diagram("site")
    part = d.add("hall", facility.gfl())
    H = d.parameter("H", 1.0, "pu(S)", (1e-6, 1e3))
    d.bind(part, H=H)
    d.connect(d.input("v_poi", "pu(V)", Phasor), part.v_poi)
    d.connect(d.input("g_it", "1", rest=1.0), part.g_it)
    for name in ("v_it", "p_g", "mode"):
        d.output(name, d.port(f"hall.{name}"))
    sag = Waveform.sag(0.45, 0.05, 0.1, until=0.4)
    nested, flat = Simulator(d.compile())(sag, H=2.0), Simulator(alone.compile())(sag, H=2.0)
    assert [(e.time, e.target) for e in nested.events] == [(e.time, e.target) for e in flat.events]
    assert {e.automaton for e in nested.events} == {"hall.sup"}
    for name in ("v_it", "p_g", "mode"):
        common, k, j = np.intersect1d(nested.t, flat.t, return_indices=True)
        assert len(common) > 400
        np.testing.assert_allclose(nested[name][k], flat[name][j], atol=1e-12)
