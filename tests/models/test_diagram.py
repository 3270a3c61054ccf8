"""Wiring: what compiles, and every refusal on its full text."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from dcvrt.errors import InputError, ModelError
from dcvrt.models import (
    Algebraic,
    Block,
    CurrentReference,
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


class Gain(Block):
    """y = k u."""

    k = Parameter(2.0, "1", (-10, 10), "gain", "test")
    u = Input("1", "in")
    y = Output("1", "out")

    def equations(self, s):
        return Equations(out={"y": s.k * s.u})


class Lag(Block):
    """T x' = u - x; y is the state, z passes u through beside it."""

    T = Parameter(0.5, "s", (0.01, 10), "time constant", "test")
    u = Input("1", "in")
    through = Output("1", "u + x")
    x = State(0.0, "1", "lagged")

    def equations(self, s):
        return Equations(der={"x": (s.u - s.x) / s.T}, out={"through": s.u + s.x})

    def rest(self, s):
        return {"x": s.u}


class Sum(Block):
    """y = a - b."""

    a = Input("1", "plus")
    b = Input("1", "minus")
    y = Output("1", "difference")

    def equations(self, s):
        return Equations(out={"y": s.a - s.b})


def feedback(**wire):
    """u - k y -> gain -> y: a loop of two blocks without a lag."""
    d = Diagram("ring")
    u = d.input("u", "1", rest=1.0)
    a, b = d.add("a", Sum()), d.add("b", Gain())
    d.connect(u, a.a)
    d.connect(a.y, b.u)
    d.connect(b.y, a.b, **wire)
    d.output("y", b.y)
    return d


def refusal(diagram, kind=ModelError):
    with pytest.raises(kind) as error:
        diagram.compile()
    return str(error.value)


def numbers(dae, x=(), z=(), u=(), **changes):
    f = ca.Function("f", [dae.x, dae.z, dae.u, dae.p], [dae.f, dae.g, dae.y])
    return [np.array(v).ravel() for v in f(list(x), list(z), list(u), dae.parameter_values(**changes))]


def test_a_chain_computes_what_its_blocks_say():
    d = Diagram("chain")
    k = d.parameter("k", 3.0, "1")
    u = d.input("u", "1", rest=1.0)
    g, lag = d.add("g", Gain()), d.add("lag", Lag())
    d.connect(u, g.u)
    d.connect(g.y, lag.u)
    d.bind(g, k=2 * k)
    d.output("x", lag.x)
    d.output("through", lag.through)
    d.output("u", u)
    dae = d.compile()
    assert dae.p_names == ("k", "lag.T")
    assert (dae.x_names, dae.u_names, dae.y_names) == (("lag.x",), ("u",), ("x", "through", "u"))
    f, _, y = numbers(dae, x=[1.0], u=[0.5])
    assert f == pytest.approx([(2 * 3.0 * 0.5 - 1.0) / 0.5])
    assert y == pytest.approx([1.0, 4.0, 0.5])
    start = ca.Function("s", [dae.u, dae.p], [dae.start])
    assert float(start(0.5, dae.parameter_values(k=4.0))) == pytest.approx(4.0)


def test_feedthrough_is_exact_so_that_a_loop_through_a_state_is_no_loop():
    d = Diagram("fine")
    u = d.input("u", "1")
    s, lag = d.add("s", Sum()), d.add("lag", Lag())
    d.connect(u, s.a)
    d.connect(s.y, lag.u)
    d.connect(lag.x, s.b)
    assert numbers(d.compile(), x=[0.25], u=[1.0])[0] == pytest.approx([(1 - 0.25 - 0.25) / 0.5])


def test_phasor_ports_become_two_scalars():
    d = Diagram("d")
    v = d.input("v_poi", "pu(V)", Phasor)
    pll = d.add("pll", Pll())
    ref = d.add("ref", CurrentReference())
    p, q = d.input("p", "pu(S)"), d.input("q", "pu(S)")
    d.connect(v, pll.v, ref.v)
    d.connect(pll.delta, ref.delta)
    d.connect(p, ref.p_c)
    d.connect(q, ref.q_c)
    d.output("i", ref.i)
    dae = d.compile()
    assert dae.u_names == ("v_poi.re", "v_poi.im", "p", "q")
    assert [row.value for row in dae.inputs] == [1.0, 0.0, 0.0, 0.0]
    assert dae.y_names == ("i.re", "i.im")
    assert numbers(dae, x=[0, 0], u=[1, 0, 0.8, 0.3])[2] == pytest.approx([0.8, -0.3])


def test_an_algebraic_loop_prints_its_ring_and_the_ways_out():
    assert refusal(feedback()) == (
        "ring: algebraic loop\n"
        "  b.y  <- needs b.u\n"
        "  a.y  <- needs a.b\n"
        "  b.y\n"
        "Ways out: put a lag in the path, or mark one wire connect(..., implicit=True) "
        "to solve it as an algebraic variable."
    )


def test_an_implicit_wire_becomes_an_algebraic_variable():
    dae = feedback(implicit=True, start=0.5).compile()
    assert [(r.path, r.unit, r.value) for r in dae.algebraics] == [("a.b", "1", 0.5)]
    y = 2 / (1 + 2)  # y = k (u - y)
    _, g, out = numbers(dae, z=[y], u=[1.0])
    assert g == pytest.approx([0.0])
    assert out == pytest.approx([y])


def test_a_declared_algebraic_variable_is_kept():
    class Cubic(Block):
        u = Input("1", "in")
        a = Algebraic(1.0, "1", "root")

        def equations(self, s):
            return Equations(alg={"a": s.a**3 + s.a - s.u})

    d = Diagram("d")
    u = d.input("u", "1")
    c = d.add("c", Cubic())
    d.connect(u, c.u)
    d.output("a", c.a)
    dae = d.compile()
    assert dae.algebraics[0].path == "c.a"
    assert numbers(dae, z=[2.0], u=[10.0])[1] == pytest.approx([0.0])


def test_a_singular_algebraic_part_names_what_is_left_over():
    class Two(Block):
        u = Input("1", "in")
        a = Algebraic(0.0, "1", "first")
        b = Algebraic(0.0, "1", "second")

        def equations(self, s):
            return Equations(alg={"a": s.a - s.u, "b": 2 * s.a - s.u})

    d = Diagram("d")
    u = d.input("u", "1")
    d.connect(u, d.add("two", Two()).u)
    assert refusal(d) == (
        "d: the algebraic part is singular. No equation determines two.b; "
        "left over is the equation of two.b. Let the equations depend on the variables they are to "
        "determine, or make one of the variables a state."
    )


def test_unconnected_inputs_are_listed_with_what_could_feed_them():
    d = Diagram("half")
    d.input("v_poi", "pu(V)", Phasor)
    d.add("pll", Pll())
    d.add("ref", CurrentReference())
    assert refusal(d) == (
        "half: 5 problems\n"
        "  pll.v [pu(V), Phasor] is not connected (POI voltage, network frame). "
        "It could be fed by: v_poi, ref.v_dq.\n"
        "  ref.v [pu(V), Phasor] is not connected (POI voltage, network frame). "
        "It could be fed by: v_poi, ref.v_dq.\n"
        "  ref.delta [rad, float] is not connected (angle of the dq frame). It could be fed by: pll.delta.\n"
        "  ref.p_c [pu(S), float] is not connected (active-power command). "
        "Nothing in the diagram has this unit and kind: add a block that gives it, or an input().\n"
        "  ref.q_c [pu(S), float] is not connected (reactive-power command). "
        "Nothing in the diagram has this unit and kind: add a block that gives it, or an input()."
    )


def wired():
    d = Diagram("d")
    v = d.input("v", "pu(V)", Phasor)
    pll = d.add("pll", Pll())
    d.connect(v, pll.v)
    return d, v, pll


def test_units_must_agree():
    d, *_ = wired()
    i = d.input("i", "pu(I)", Phasor)
    two = d.add("two", Pll())
    d.connect(i, two.v)
    assert refusal(d) == ("d: i [pu(I), Phasor] cannot drive two.v [pu(V), Phasor]. It could be fed by: v.")


def test_kinds_must_agree():
    d, _, pll = wired()
    two = d.add("two", Pll())
    d.connect(pll.error, two.v)
    assert refusal(d) == (
        "d: pll.error [pu(V), float] cannot drive two.v [pu(V), Phasor]. It could be fed by: v."
    )


def test_an_input_has_one_source():
    d, v, pll = wired()
    d.connect(v, pll.v)
    assert refusal(d) == (
        "d: pll.v is already driven by v; v cannot drive it too. Drop one of the two, or add them in a block."
    )


def test_only_inputs_can_be_fed():
    d, v, pll = wired()
    d.connect(v, pll.omega)
    assert refusal(d) == "d: pll.omega is not an input of a block. Write connect(source, target, ...)."


def test_connect_needs_a_target():
    d, v, _ = wired()
    d.connect(v)
    assert refusal(d) == "d: connect(v) names no input to feed. Write connect(source, target, ...)."


def test_only_ports_can_be_connected():
    d, v, _ = wired()
    d.connect(v, "pll.v")
    assert refusal(d) == "d: 'pll.v' is not a port. Take ports from blocks (pll.delta) or from input()."


def test_blocks_must_belong_to_the_diagram():
    d, v, _ = wired()
    stray = Pll()
    d.connect(v, stray.v)
    d.bind(stray, K_p=1.0)
    assert refusal(d) == (
        "d: 2 problems\n"
        "  Pll.v belongs to a block that is not in this diagram. Add the block first.\n"
        "  bind: Pll was not added to this diagram."
    )


def test_inputs_of_another_diagram_are_refused():
    d, _, pll = wired()
    d.connect(Diagram("other").input("v", "pu(V)", Phasor), pll.v)
    assert refusal(d) == "d: the input v belongs to another diagram."


def test_names_are_given_once():
    d, _, pll = wired()
    d.add("pll", Pll())
    d.add("again", pll)
    d.parameter("v", 1.0, "1")
    d.input("pll", "1")
    d.output("w", pll.omega)
    d.output("w", pll.omega)
    assert refusal(d) == (
        "d: 5 problems\n"
        "  the name 'pll' is taken. Add the second Pll under another.\n"
        "  the block added as 'again' is already 'pll' of a diagram. Make a second Pll().\n"
        "  the name 'v' of a parameter is taken.\n"
        "  the name 'pll' of an input is taken.\n"
        "  there are two outputs named 'w'."
    )


def test_unknown_ports_of_a_block():
    with pytest.raises(ModelError) as error:
        _ = Pll().detla
    assert str(error.value) == (
        "Pll has no 'detla'. Did you mean 'delta'? Known: K_p, K_i, v, omega, error, xi, delta."
    )


def test_unknown_and_foreign_bindings():
    d, _, pll = wired()
    H = d.parameter("H", 1.0, "pu(S)")
    d.bind(pll, Kp=1.0)
    assert refusal(d) == "d: bind: pll has no parameter 'Kp'. Did you mean 'K_p'? Known: K_p, K_i."
    d, _, pll = wired()
    d.bind(pll, K_p=2 * ca.SX.sym("G"))
    d.parameter("H", 1.0, "pu(S)")
    assert refusal(d) == (
        "d: pll.K_p is bound to 2*G; G is not a parameter of the diagram. "
        "Bind to what parameter() returned. Known: H."
    )
    d, _, pll = wired()
    H = d.parameter("H", 1.0, "pu(S)")
    d.bind(pll, K_p=H)
    assert refusal(d) == "d: pll.K_p [rad/s/pu(V)] cannot be bound to H [pu(S)]."


def test_missing_and_undeclared_equations():
    class Forgot(Gain):
        """Forgets its output, invents another."""

        x = State(0.0, "1", "a state")

        def equations(self, s):
            return Equations(out={"z": s.u})

    d = Diagram("d")
    d.connect(d.input("u", "1"), d.add("g", Forgot()).u)
    assert refusal(d) == (
        "d: 3 problems\n"
        "  g (Forgot): no equation for the derivative of state 'x'.\n"
        "  g (Forgot): no equation for the output 'y'.\n"
        "  g (Forgot): equation for the output 'z', which is not declared. Known: y."
    )


def test_equations_of_the_wrong_kind():
    class Number(Gain):
        """Declares a phasor, gives a number."""

        y = Output("pu(V)", "a phasor", kind=Phasor)

    d = Diagram("d")
    d.connect(d.input("u", "1"), d.add("g", Number()).u)
    assert refusal(d) == "d: g (Number): the output 'y' is declared as Phasor, but its equation gives SX."


def test_equations_must_be_returned_as_such():
    class Tuple(Gain):
        """Returns something else."""

        def equations(self, s):
            return s.u

    d = Diagram("d")
    d.connect(d.input("u", "1"), d.add("g", Tuple()).u)
    assert refusal(d) == "d: g (Tuple): equations() must return Equations(der=..., out=...), not SX."


def test_a_symbol_that_is_not_declared_is_named():
    class Typo(Gain):
        """Reads a symbol it has not."""

        def equations(self, s):
            return Equations(out={"y": s.kk * s.u})

    d = Diagram("d")
    d.connect(d.input("u", "1"), d.add("g", Typo()).u)
    assert refusal(d) == "g (Typo) has no symbol or value 'kk'. Did you mean 'k'? Known: k, u."


def test_start_values_that_chase_each_other_are_the_declared_ones():
    d = Diagram("d")
    u = d.input("u", "1", rest=3.0)
    s, lag, after = d.add("s", Sum()), d.add("lag", Lag()), d.add("after", Lag())
    d.connect(u, s.a)
    d.connect(s.y, lag.u)
    d.connect(lag.x, s.b)
    d.connect(lag.through, after.u)
    dae = d.compile()
    start = ca.Function("s", [dae.u, dae.p], [dae.start])
    assert np.array(start(3.0, dae.parameter_values())).ravel() == pytest.approx([0.0, 3.0])


def test_rest_must_name_states():
    class Odd(Lag):
        """Gives a start value for something else."""

        def rest(self, s):
            return {"X": 0.0}

    d = Diagram("d")
    d.connect(d.input("u", "1"), d.add("lag", Odd()).u)
    assert refusal(d) == "d: lag (Odd): rest() gives 'X', not a state. Known: x."


def test_declarations_are_checked_when_the_class_is_written():
    with pytest.raises(ModelError) as error:

        class Wrong(Block):
            a = Input("pu", "in")
            rest = Output("1", "a method of every block")

    assert str(error.value) == (
        "Wrong: 2 problems\n"
        "  a: unit 'pu': plain 'pu' does not say of what. Write pu(V), pu(I), pu(S) or pu(Z).\n"
        "  'rest' is a name that every block has; choose another."
    )


def test_values_are_checked_when_a_block_is_made():
    with pytest.raises(InputError) as error:
        Pll(Kp=1.0, K_i=-1.0)
    assert str(error.value) == (
        "Pll: 2 problems\n"
        "  there is no parameter 'Kp'. Did you mean 'K_p'? Known: K_p, K_i.\n"
        "  K_i = -1 rad/s2/pu(V) is outside [0, 50000]."
    )


def test_set_checks_on_the_spot():
    d, _, pll = wired()
    H = d.parameter("H", 1.0, "1", (0.0, 2.0))
    d.bind(pll, K_i=1400 * H)
    d.set("pll.K_p", 10.0)
    d.set("H", 2.0)
    assert d.compile().parameter_values().tolist() == [2.0, 10.0]
    for path, value, text in (
        ("pll.Kp", 1.0, "d has no parameter 'pll.Kp'. Did you mean 'pll.K_p'? Known: pll.K_p."),
        ("pl.K_p", 1.0, "d has no parameter 'pl.K_p'. Did you mean 'pll.K_p'? Known: H, pll.K_p."),
        ("pll.K_p", 0.0, "pll.K_p = 0 rad/s/pu(V) is outside [1, 500]."),
        ("H", 3.0, "H = 3 is outside [0, 2]."),
        ("pll.K_i", 3.0, "pll.K_i is bound to 1400*H. Set 'H' instead, or bind it anew."),
    ):
        with pytest.raises(InputError) as error:
            d.set(path, value)
        assert str(error.value) == text


def test_replace_keeps_wires_and_bindings():
    d = Diagram("d")
    k = d.parameter("k", 5.0, "1")
    g = d.add("g", Gain())
    d.connect(d.input("u", "1"), g.u)
    d.bind(g, k=k)
    d.output("y", g.y)

    class Offset(Gain):
        """y = k u + 1."""

        def equations(self, s):
            return Equations(out={"y": s.k * s.u + 1})

    d.replace("g", Offset())
    assert numbers(d.compile(), u=[2.0])[2] == pytest.approx([11.0])

    class Other(Block):
        """Has another port."""

        w = Input("1", "in")
        y = Output("1", "out")

        def equations(self, s):
            return Equations(out={"y": s.w})

    d.replace("g", Other())
    assert refusal(d) == (
        "d: 3 problems\n"
        "  u -> g.u: g (Other) has no such port 'u'. Known: w, y.\n"
        "  g.w [1, float] is not connected (in). It could be fed by: u, g.y.\n"
        "  bind: g has no parameter 'k'."
    )


def test_replace_names_the_blocks_there_are():
    d, _, pll = wired()
    with pytest.raises(InputError) as error:
        d.replace("pl", Pll())
    assert str(error.value) == "d has no block 'pl'. Did you mean 'pll'? Known: pll."
    with pytest.raises(ModelError) as used:
        d.replace("pll", pll)
    assert str(used.value) == "the block is already 'pll' of a diagram. Make a new Pll()."


def test_ports_by_path():
    d, *_ = wired()
    assert str(d.port("v")) == "v"
    assert str(d.port("pll.delta")) == "pll.delta"
    with pytest.raises(InputError) as error:
        d.port("w")
    assert str(error.value) == "d has no input 'w'. Known: v."


def test_a_shared_parameter_starts_within_its_bounds():
    with pytest.raises(InputError) as error:
        Diagram("d").parameter("beta", 3.0, "1", (0.8, 2.0))
    assert str(error.value) == "d: beta = 3 is outside [0.8, 2]."


def test_deviations_from_the_paper_are_collected():
    class Odd(Gain):
        """y = k u.

        Differs: the gain is
        ours.
        Differs: so is the name.

        Nothing else.
        """

    d = Diagram("d")
    d.connect(d.input("u", "1"), d.add("g", Odd()).u)
    assert d.compile().notes == ("g: the gain is ours.", "g: so is the name.")


# ---- units of bindings ------------------------------------------------------------------------------------


class Rated(Block):
    """Parameters of every per-unit kind."""

    v_max = Parameter(1.0, "pu(V)", (0, 10), "voltage")
    i_max = Parameter(1.0, "pu(I)", (0, 10), "current")
    p_max = Parameter(1.0, "pu(S)", (0, 10), "power")
    z = Parameter(1.0, "pu(V)/pu(I)", (0, 10), "impedance")
    K = Parameter(60.0, "rad/s/pu(V)", (0, 1e3), "gain")
    y = Output("1", "out")

    def equations(self, s):
        return Equations(out={"y": s.v_max + s.i_max + s.p_max + s.z + s.K})


def bound(**expressions):
    d = Diagram("d")
    known = {
        "H": d.parameter("H", 2.0, "pu(S)"), "V": d.parameter("V", 1.1, "pu(V)"),
        "X": d.parameter("X", 0.2, "pu(Z)"), "beta": d.parameter("beta", 1.2, "1"),
    }  # fmt: skip
    block = d.add("b", Rated())
    d.bind(block, **{name: make(**known) for name, make in expressions.items()})
    return d


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("p_max", lambda H, beta, **_: 1.5 * beta * H),
        ("p_max", lambda H, beta, **_: ca.fmin(H, 0.5) + 0.1 * H / beta),
        (
            "p_max",
            lambda V, X, **_: V**2 / (2 * X),
        ),  # a power is voltage times current, whatever it is called
        ("i_max", lambda H, V, **_: H / V),
        ("z", lambda X, **_: X),
        ("v_max", lambda H, X, **_: ca.sqrt(H * X)),
        ("K", lambda beta, **_: 60 * beta),  # a number may carry the unit
        ("K", lambda beta, **_: 60 * (1 - 1 / beta)),
        ("v_max", lambda **_: 0.9),
    ],
)
def test_bindings_of_the_right_unit(name, make):
    assert len(bound(**{name: make}).compile().parameters) == 8


@pytest.mark.parametrize(
    ("name", "make", "text"),
    [
        ("v_max", lambda H, **_: 2 * H, "b.v_max [pu(V)] cannot be bound to 2*H [pu(S)]."),
        ("i_max", lambda V, beta, **_: beta * V, "b.i_max [pu(I)] cannot be bound to beta*V [pu(V)]."),
        ("p_max", lambda H, **_: H**2, "b.p_max [pu(S)] cannot be bound to H**2 [pu(S)2]."),
        ("v_max", lambda H, V, **_: H + V, "b.v_max is bound to H + V, which adds [pu(S)] and [pu(V)]."),
        ("v_max", lambda V, X, **_: ca.fmax(V, X), "b.v_max is bound to max(V, X), which compares [pu(V)] "
                                                   "and [pu(Z)]."),
        ("v_max", lambda V, **_: ca.sqrt(V), "b.v_max is bound to sqrt(V), which takes the root of [pu(V)]."),
        ("K", lambda V, **_: 60 * ca.exp(V), "b.K is bound to 60*exp(V), which takes a function of [pu(V)]; "
                                             "divide by its base first."),
        ("K", lambda V, **_: V**0.3, "b.K is bound to V**0.3, which raises [pu(V)] to a power that is no "
                                     "whole number."),
    ],
)  # fmt: skip
def test_bindings_of_the_wrong_unit(name, make, text):
    assert refusal(bound(**{name: make})) == f"d: {text}"


# ---- feedthrough ------------------------------------------------------------------------------------------


def test_feedthrough_is_read_from_the_equations():
    assert Gain().feedthrough() == {"y": ("u",)}
    assert Lag().feedthrough() == {"through": ("u",)}
    assert Pll().feedthrough() == {"omega": ("v",), "error": ("v",)}
    d = Diagram("d")
    u, w = d.input("u", "1"), d.input("w", "1")
    s, lag = d.add("s", Sum()), d.add("lag", Lag())
    d.connect(u, s.a)
    d.connect(w, lag.u)
    d.connect(lag.x, s.b)
    d.output("y", s.y)
    d.output("x", lag.x)
    d.output("z", lag.through)
    assert d.feedthrough() == {"y": ("u",), "x": (), "z": ("w",)}


# ---- algebraic variables, kept or eliminated --------------------------------------------------------------


class Cubic(Block):
    """0 = c a^3 + a - u."""

    c = Parameter(1.0, "1", (0, 10), "bend", "test")
    u = Input("1", "in")
    a = Algebraic(1.0, "1", "root")

    def equations(self, s):
        return Equations(alg={"a": s.c * s.a**3 + s.a - s.u})


class Pair(Block):
    """Two unknowns in two linear equations, written in the wrong order on purpose."""

    u = Input("1", "in")
    a = Algebraic(0.0, "1", "first")
    b = Algebraic(0.0, "1", "second")
    y = Output("1", "sum")

    def equations(self, s):
        return Equations(alg={"a": s.a + 2 * s.b - s.u, "b": 3 * s.a - s.b}, out={"y": s.a + s.b})


def chain():
    """A loop through an implicit wire, a linear pair behind it, a lag at the end."""
    d = feedback(implicit=True, start=0.5)
    pair, lag = d.add("pair", Pair()), d.add("lag", Lag())
    d.connect(d.blocks["b"].y, pair.u)
    d.connect(pair.y, lag.u)
    d.output("pair", pair.y)
    d.output("x", lag.x)
    return d


def test_algebraic_variables_are_kept_unless_asked():
    assert [r.path for r in chain().compile().algebraics] == ["pair.a", "pair.b", "a.b"]


@pytest.mark.parametrize(
    ("eliminate", "left"),
    [
        (True, []),
        (("a.b",), ["pair.a", "pair.b"]),
        (("pair.a", "pair.b"), ["a.b"]),
        (["pair.a"], ["pair.b", "a.b"]),
    ],
)
def test_eliminated_variables_are_put_in_terms_of_the_others(eliminate, left):
    dae = chain().compile(eliminate=eliminate)
    assert [r.path for r in dae.algebraics] == left
    u = 0.7
    b = 2 * u / (1 + 2)  # y = k (u - y)
    values = {"a.b": b, "pair.a": b / 7, "pair.b": 3 * b / 7}
    f, g, y = numbers(dae, x=[0.1], z=[values[name] for name in left], u=[u])
    assert g == pytest.approx([0.0] * len(left), abs=1e-12)
    assert y == pytest.approx([b, 4 * b / 7, 0.1])
    assert f == pytest.approx([(4 * b / 7 - 0.1) / 0.5])
    assert dae.start.numel() == 1 + len(left)


def test_equilibrium_and_trajectory_are_the_same_both_ways():
    from dcvrt import Simulator, Waveform
    from dcvrt.integrators import Casadi
    from dcvrt.models import Feeder, Poi, VoltageFilter

    def system(**how):
        """A current against a feeder, with a mode that hangs on the voltage behind the feeder."""

        class Load(Block):
            """Constant admittance, cut to a third while the voltage is low."""

            modes = ("FULL", "THIRD")
            start = "FULL"
            flags = {"part": (1.0, 1 / 3)}  # noqa: RUF012
            low = Parameter(0.8, "pu(V)", (0, 1), "cut below")
            v = Input("pu(V)", "voltage", kind=Phasor)
            v_f = Input("pu(V)", "measured voltage")
            i = Output("pu(I)", "current", kind=Phasor)

            def transitions(self, s):
                return (
                    Go("FULL", "THIRD", below(s.v.re, s.low) & below(s.v_f, s.low)),
                    Go("THIRD", "FULL", above(s.v_f, 0.9)),
                )

            def equations(self, s):
                return Equations(out={"i": s.v * Phasor(0.8, -0.3) * s.part})

        d = Diagram("feeder")
        e = d.input("e", "pu(V)", Phasor)
        feeder, load, meter, poi = (
            d.add("feeder", Feeder(X=0.3, R=0.05)), d.add("load", Load()), d.add("meter", VoltageFilter()),
            d.add("poi", Poi()),
        )  # fmt: skip
        d.connect(e, feeder.e)
        d.connect(load.i, feeder.i, poi.i)
        d.connect(feeder.v, load.v, implicit=True, start=1.0)
        d.connect(feeder.v, meter.v, poi.v)
        d.connect(meter.v_f, load.v_f)
        for name, port in (("v_f", meter.v_f), ("p", poi.p)):
            d.output(name, port)
        return d.compile(**how)

    kept, gone = system(), system(eliminate=True)
    assert [r.path for r in kept.algebraics] == ["load.v.re", "load.v.im"]
    assert not gone.algebraics
    tight = {"rtol": 1e-9, "atol": 1e-11}
    sag = Waveform.sag(0.6, 0.05, 0.1, until=0.4)
    one = Simulator(kept, Casadi("rosenbrock", **tight), wrt=("feeder.X",))(sag)
    two = Simulator(gone, Casadi("erk", **tight), wrt=("feeder.X",))(sag)
    assert [e.target for e in one.events] == ["THIRD", "FULL"]
    assert [e.time for e in one.events] == pytest.approx([e.time for e in two.events], abs=1e-8)
    t = np.linspace(0.0, 0.4, 333)
    for name in ("v_f", "p"):
        np.testing.assert_allclose(one.at(name, t), two.at(name, t), atol=1e-6)
    assert one.sens["p", "feeder.X"][-1] == pytest.approx(two.sens["p", "feeder.X"][-1], rel=1e-5)
    rest = [Simulator(dae).equilibrium(0.95)["p"] for dae in (kept, gone)]
    assert rest[0] == pytest.approx(rest[1], abs=1e-12)


def test_a_variable_without_an_explicit_solution_is_named():
    d = chain()
    cubic = d.add("cubic", Cubic())
    d.connect(d.port("u"), cubic.u)
    d.output("a", cubic.a)
    with pytest.raises(ModelError) as error:
        d.compile(eliminate=True)
    assert str(error.value) == (
        "ring: cubic.a cannot be eliminated: its equation is not linear in it. Way out: keep it as algebraic "
        "(eliminate=('pair.a', 'pair.b', 'a.b')), or write the block with an explicit solution."
    )
    assert [r.path for r in d.compile(eliminate=("pair.a", "pair.b", "a.b")).algebraics] == ["cubic.a"]
    with pytest.raises(ModelError) as error:
        d.compile(eliminate=["cubic.a"])
    assert str(error.value) == (
        "ring: cubic.a cannot be eliminated: its equation is not linear in it. Way out: keep it as algebraic "
        "(leave `eliminate` out), or write the block with an explicit solution."
    )


def test_what_to_eliminate_is_given_by_paths():
    for given, text in (
        ("a.b", "eliminate = 'a.b' must be a tuple of paths, or True: eliminate=('a.b',)."),
        (("a.c",), "eliminate: ring has no algebraic variable 'a.c'. Did you mean 'a.b'? "
                   "Known: pair.a, pair.b, a.b."),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            chain().compile(eliminate=given)
        assert str(error.value) == text


def test_numbers_of_a_block_are_checked_by_name():
    with pytest.raises(InputError) as error:
        Gain().at(u=1.0, uu=2.0)
    assert str(error.value) == "Gain: there is no 'uu'. Did you mean 'u'? Known: k, u, y."
