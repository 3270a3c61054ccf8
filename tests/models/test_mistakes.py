"""What is easily got wrong in a new block or variant, and what the kit says of it: the whole text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from dcvrt import Simulator, facility
from dcvrt.errors import DcvrtError, InputError, ModelError
from dcvrt.models import (
    Algebraic,
    Block,
    Cooling,
    Diagram,
    Equations,
    Go,
    Input,
    Output,
    Parameter,
    Phasor,
    State,
    above,
    below,
)


class Lag(Block):
    """T x' = u - x."""

    T = Parameter(1.0, "s", (0.1, 10.0), "time constant", "test")
    u = Input("pu(S)", "in")
    y = Output("pu(S)", "out")
    x = State(0.0, "pu(S)", "lagged")

    def equations(self, s: Any) -> Equations:
        return Equations(der=dict(x=(s.u - s.x) / s.T), out=dict(y=s.x))


def told(attempt: Callable[[], object]) -> str:
    with pytest.raises(DcvrtError) as error:
        attempt()
    return str(error.value)


def alone(block: Block) -> Diagram:
    """The block with every input fed from outside."""
    d = Diagram("mine")
    b = d.add("b", block)
    for name, declared in block.declared(Input).items():
        d.connect(d.input(name, declared.unit, declared.kind), getattr(b, name))
    return d


def of_equations(equations: Callable[[Any, Any], object]) -> str:
    """What is said of a lag with other equations."""

    class Mine(Lag):
        """A lag with a mistake in it."""

    Mine.equations = equations  # type: ignore[assignment,method-assign]
    return told(alone(Mine()).compile)


def of_rows(rows: Callable[[Any, Any], object]) -> str:
    """What is said of a switch with these rows."""

    class Mine(Lag):
        """A lag with modes."""

        modes = ("OFF", "ON")
        start = "OFF"
        v = Input("pu(V)", "voltage", kind=Phasor)

    Mine.transitions = rows  # type: ignore[assignment,method-assign]
    return told(alone(Mine()).compile)


def without_place(text: str) -> str:
    """The text without the line that it shows of this file."""
    return re.sub(r" at '.*' \(test_mistakes\.py, line \d+\)", "", text)


# ---- values -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("2", "T = '2' is not a number."),
        (None, "T = None is not a number."),
        (True, "T = True is not a number."),
        ([1.0], "T = [1.0] is not a number."),
        (ca.SX.sym("H"), "T = H is an expression; a value is a number. Tie it with the diagram's bind."),
        (math.nan, "T = nan s is outside [0.1, 10]."),
    ],
    ids=str,
)
def test_a_value_is_a_number(value, text):
    assert told(lambda: Lag(T=value)) == f"Lag: {text}"
    assert told(lambda: alone(Lag()).set("b.T", value)) == text.replace("T =", "b.T =", 1)
    assert Lag(T=np.float64(2.0)).T == Lag(T=2).T == 2.0


def test_values_have_names():
    assert told(lambda: Lag(2.0)) == "Lag: values are given by name: Lag(T=2.0)."


def test_a_value_of_a_run_is_a_number():
    dae = alone(Lag()).compile()
    for value in ("2", None, [1.0]):
        assert told(lambda value=value: dae.parameter_values(**{"b.T": value})) == (
            f"b.T = {value!r} is not a number."
        )


# ---- declarations -----------------------------------------------------------------------------------------


def declared(name: str, what: object) -> str:
    return told(lambda: type("Mine", (Block,), {name: what}))


def test_a_default_lies_within_its_bounds():
    assert declared("T", Parameter(20.0, "s", (0.1, 10.0))) == "Mine: T = 20 s is outside [0.1, 10]."
    assert declared("x", State(5.0, "1", "", (0.0, 1.0))) == "Mine: x = 5 is outside [0, 1]."


@pytest.mark.parametrize(
    ("what", "text"),
    [
        (
            Parameter(1.0, "s", (10.0, 0.1)),
            "q: the bounds are (10.0, 0.1), not two numbers (low, high). "
            "Write Parameter(1.0, 's', (0.1, 10.0), 'meaning', 'source').",
        ),
        (
            Parameter("1", "s"),  # type: ignore[arg-type]
            "q: the value is '1', not a number. Write Parameter(1.0, 's', (0.1, 10.0), 'meaning', 'source').",
        ),
        (
            State("x", "s"),  # type: ignore[arg-type]
            "q: the start value is 'x', not a number. Write State(0.0, 'pu(V)', 'meaning').",
        ),
        (
            Algebraic("x", "s"),  # type: ignore[arg-type]
            "q: the start value is 'x', not a number. Write Algebraic(1.0, 'pu(V)', 'meaning').",
        ),
        (
            Output(0.0, "pu(S)"),  # type: ignore[arg-type]
            "q: the unit is 0.0, not a text. Write Output('pu(V)', 'meaning').",
        ),
        (
            Input("s", 0.0),  # type: ignore[arg-type]
            "q: the meaning is 0.0, not a text. Write Input('pu(V)', 'meaning').",
        ),
        (
            Input("s", "time", kind=complex),
            "q: the kind is <class 'complex'>. It is float, for a number, or Phasor.",
        ),
    ],
    ids=lambda v: v[:30] if isinstance(v, str) else type(v).__name__,
)
def test_declarations_say_how_they_are_written(what, text):
    assert declared("q", what) == f"Mine: {text}"


def test_unit_and_meaning_in_the_wrong_order():
    assert declared("v", Input("POI voltage", "pu(V)")) == (
        "Mine: 2 problems\n"
        "  v: unit 'POI voltage': 'POI' is not known. Known: 1, s, h, rad, deg, Hz, K, pu(V), pu(I), pu(S), "
        "pu(Z), MW, ... (14 in all).\n"
        "  v: unit and meaning have changed places. Write Input('pu(V)', 'meaning')."
    )


def test_declarations_of_a_diagram_are_checked_on_the_spot():
    d = Diagram("mine")
    assert told(lambda: d.input("v", "pu(V)", complex)) == (
        "mine: v: the kind is <class 'complex'>. It is float, for a number, or Phasor."
    )
    assert told(lambda: d.parameter("H", 1.0, "pu")) == (
        "mine: H: unit 'pu': plain 'pu' does not say of what. Write pu(V), pu(I), pu(S) or pu(Z)."
    )
    assert told(lambda: Diagram("")) == "a diagram needs a name: Diagram('mine')."


@pytest.mark.parametrize(
    ("body", "text"),
    [
        ({"modes": "AB"}, "modes = 'AB' must be a tuple of different names: ('OFF', 'ON')."),
        ({"modes": ("A", "A")}, "modes = ('A', 'A') must be a tuple of different names: ('OFF', 'ON')."),
        (
            {"transitions": lambda self, s: ()},
            "there are transitions, but no modes. Declare modes and start.",
        ),
        (
            {"modes": ("A", "B"), "flags": {"on": 1.0}},
            "the flag 'on' is 1.0, not one number for each mode: (0.0, 1.0).",
        ),
    ],
    ids=["text", "twice", "no modes", "flag"],
)
def test_modes_and_flags(body, text):
    assert told(lambda: type("Mine", (Block,), body)) == f"Mine: {text}"


# ---- equations --------------------------------------------------------------------------------------------


def test_no_equations():
    class Mine(Block):
        """Says nothing."""

        y = Output("1", "y")

    assert told(alone(Mine()).compile) == (
        "Mine gives no equations. Write equations(self, s), which returns Equations(der=..., out=...)."
    )


def choose(self: Any, s: Any) -> Equations:
    x = s.u if s.u > 0 else 0.0
    return Equations(der=dict(x=x), out=dict(y=s.x))


def test_a_choice_by_the_value_of_a_symbol():
    line = choose.__code__.co_firstlineno + 1
    assert of_equations(choose) == (
        f"b (Mine): equations() fails on symbols at 'x = s.u if s.u > 0 else 0.0' (test_mistakes.py, line "
        f"{line}): RuntimeError: Cannot compute the truth value of a CasADi SXElem symbolic expression. A "
        "symbol is neither true nor false: put a smooth function (dcvrt.models.smooth) in the place of if, "
        "max, min and comparisons, or make the cases modes."
    )


@pytest.mark.parametrize(
    ("rate", "text"),
    [
        (
            lambda self, s: self.u - s.x,
            "TypeError: unsupported operand type(s) for -: 'Port' and 'SX'. `self` holds ports, `s` their "
            "values: write s.name.",
        ),
        (
            lambda self, s: abs(Phasor(s.u, s.x)),
            "TypeError: bad operand type for abs(): 'Phasor'. A phasor v has the parts v.re and v.im and the "
            "magnitude smooth.mag(v, eps).",
        ),
        (
            lambda self, s: Phasor(s.u, s.x) + 1,
            "AttributeError: 'int' object has no attribute 're'. A phasor is added to phasors only: "
            "Phasor(1.0, 0.0). A number has no parts.",
        ),
        (
            lambda self, s: np.exp(s.u),
            "FutureWarning: casadi: a numpy function was called on a casadi value (issue #2959). Take "
            "functions from casadi, which know numbers and symbols: ca.exp(x), ca.sin(x).",
        ),
    ],
    ids=["self", "abs", "add", "numpy"],
)
def test_what_symbols_cannot_do(rate, text):
    found = of_equations(lambda self, s: Equations(der=dict(x=rate(self, s)), out=dict(y=s.x)))
    assert without_place(found) == f"b (Mine): equations() fails on symbols: {text}"


def test_a_function_that_leaves_nan():
    """math.exp takes a symbol for NaN, and says nothing."""
    found = of_equations(lambda self, s: Equations(der=dict(x=math.exp(s.u) - s.x), out=dict(y=s.x)))
    assert found == (
        "mine: b (Mine): the equation for the derivative of state 'x' holds NaN. Functions of `math` turn "
        "symbols into it: take them from casadi, as ca.exp(x)."
    )


@pytest.mark.parametrize(
    ("value", "found"), [("x", "str"), (None, "NoneType"), (ca.SX(2, 1), "a column of 2")], ids=str
)
def test_what_is_no_number(value, found):
    text = of_equations(lambda self, s: Equations(der=dict(x=s.u / s.T), out=dict(y=value)))
    assert text == f"mine: b (Mine): the output 'y' is declared as float, but its equation gives {found}."


def test_a_parameter_that_equations_read_from_self_would_never_change():
    found = of_equations(lambda self, s: Equations(der=dict(x=(s.u - s.x) / self.T), out=dict(y=s.x)))
    assert found == (
        "mine: b (Mine): nothing depends on the parameter 'T'. Equations read s.T; self.T is a number that "
        "no run can change. Use it or drop it."
    )


def test_a_block_with_optional_terms_may_leave_a_parameter_out():
    class Plain(Lag):
        """A lag with a bend that is only there when b is not 0."""

        optional_terms = True
        b = Parameter(0.0, "1", (0.0, 1.0), "bend", "test")

    assert alone(Plain()).compile().p_names == ("b.T", "b.b")
    Plain.optional_terms = False
    assert "nothing depends on the parameter 'b'" in told(alone(Plain()).compile)


# ---- modes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (
            lambda self, s: (Go("OFF", "ON", s.u > 0.5), Go("ON", "OFF", below(s.u, 0.4))),
            "b (Mine): transitions() fails on symbols: TypeError: OFF -> ON: (0.5<b.u) is no guard. Compare "
            "with below, above, within or outside, and join guards with & and |.",
        ),
        (
            lambda self, s: (Go("OFF", "ON", above(s.u, 0.5) and above(s.x, 0.5)),),
            "b (Mine): transitions() fails on symbols: TypeError: a guard is neither true nor false while "
            "the table is written. Compare with below, above, within or outside, and join guards with & and "
            "|.",
        ),
        (
            lambda self, s: (Go("OFF", "ON", below(s.v, 0.5)),),
            "b (Mine): transitions() fails on symbols: TypeError: a Phasor is neither above nor below a "
            "limit. A phasor v has the parts v.re and v.im and the magnitude smooth.mag(v, eps).",
        ),
        (
            lambda self, s: Go("OFF", "ON", above(s.u, 0.5)),
            "mine: b (Mine): transitions() must return a tuple of rows: (Go('OFF', 'ON', guard), ...).",
        ),
        (
            lambda self, s: (
                Go("OFF", "ON", above(s.u, 0.5), held=-1.0),
                Go("ON", "OFF", below(s.u, 0.4)),
            ),
            "mine: b: the dwell time of 'OFF -> ON: u > 0.5 held -1' = -1 s is outside [0, inf].",
        ),
        (
            lambda self, s: (
                Go("OFF", "ON", above(s.u, math.exp(s.T))),
                Go("ON", "OFF", below(s.u, 0.4)),
            ),
            "mine: b (Mine): OFF -> ON: (u-nan) holds NaN. Functions of `math` turn symbols into it: take "
            "them from casadi, as ca.exp(x).",
        ),
    ],
    ids=["comparison", "and", "phasor", "one row", "dwell time", "nan"],
)
def test_rows(rows, text):
    assert without_place(of_rows(rows)) == text


# ---- diagrams ---------------------------------------------------------------------------------------------


def test_a_class_is_no_block():
    f = facility.gfl()
    for attempt in (lambda: f.add("more", Cooling), lambda: f.replace("cooling", Cooling)):
        assert told(attempt).endswith(" is given the class Cooling, not a block. Make one: Cooling().")
    assert f.compile().name == "gfl"  # nothing was taken in
    assert told(lambda: Diagram("d").add(Lag(), "lag")) == (  # type: ignore[arg-type,type-var]
        "d: add and replace take a name and a block: add('pll', Pll())."
    )


@pytest.mark.parametrize(
    ("port", "text"),
    [
        ("u", "'u' is not a port. Take ports from blocks (pll.delta) or from input()."),
        (1.0, "1.0 is a number, not a port. A parameter gets its value from set or bind."),
        (ca.SX.sym("H"), "H is a parameter of the diagram, not a port. Use bind(block, name=H)."),
    ],
    ids=str,
)
def test_what_is_no_port(port, text):
    d = alone(Lag())
    d.output("again", port)
    assert told(d.compile) == f"mine: {text}"


@pytest.mark.parametrize(
    ("block", "value", "text"),
    [
        ("b", 1.0, "bind: 'b' is not a block. Give the block that add returned."),
        (
            None,
            "H",
            "bind: b.T = 'H' is neither a number nor an expression of what parameter() returned.",
        ),
        (None, 20.0, "b.T (bound to 20) = 20 s is outside [0.1, 10]."),
    ],
)
def test_what_cannot_be_bound(block, value, text):
    d = alone(Lag())
    d.bind(block or d.blocks["b"], T=value)
    assert told(d.compile) == f"mine: {text}"


def test_a_bound_parameter_stays_within_the_bounds_of_its_block():
    d = alone(Lag())
    H = d.parameter("H", 2.0, "s", (0.0, 100.0))
    d.bind(d.blocks["b"], T=3 * H)
    dae = d.compile()
    simulator = Simulator(dae)
    text = "mine: b.T (bound to 3*H) = 60 s is outside [0.1, 10]."
    assert told(lambda: dae.parameter_values(H=20.0)) == text
    assert told(lambda: simulator.equilibrium(H=20.0)) == text
    assert dae.parameter_values(H=3.0).tolist() == [3.0]


@pytest.mark.parametrize("name", facility.names())
def test_the_range_of_every_shared_parameter_fits_the_blocks_it_is_bound_to(name):
    dae = facility.get(name).compile()
    for row in dae.parameter_rows:
        if "." not in row.path:
            for bound in row.bounds:
                assert dae.parameter_values(**{row.path: bound})[dae.parameter_number(row.path)] == bound


def test_a_diagram_is_not_yet_a_system():
    assert told(lambda: Simulator(facility.gfl())) == (  # type: ignore[arg-type]
        "gfl is a diagram, and 'z' belongs to a system. Compile it first: gfl.compile()."
    )
    assert issubclass(InputError, DcvrtError)
    assert issubclass(ModelError, DcvrtError)
