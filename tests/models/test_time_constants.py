"""States that name their time constant, rows that need no gap, and the one variable that is eliminated."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from dcvrt.errors import InputError, ModelError
from dcvrt.models import Block, Diagram, Equations, Go, Input, Output, Parameter, State, above, below


class Lag(Block):
    """T dx/dt = u - x."""

    T = Parameter(0.5, "s", (0.0, 10.0), "time constant", "test")
    u = Input("1", "input")
    y = Output("1", "output")
    x = State(0.3, "1", "state", time="T")

    def equations(self, s):
        return Equations(der=dict(x=s.u - s.x), out=dict(y=2 * s.x))


class Cube(Lag):
    """T dx/dt = u - x - x^3: no explicit solution at T = 0."""

    def equations(self, s):
        return Equations(der=dict(x=s.u - s.x - s.x**3), out=dict(y=s.x))


def chain(*blocks, ring=False):
    d = Diagram("chain")
    signal = d.input("u", "1")
    for k, block in enumerate(blocks):
        part = d.add(f"b{k}", block)
        d.connect(signal, part.u)
        signal = part.y
    d.output("y", signal)
    return d


def outputs(dae, x, u):
    f = ca.Function("f", [dae.x, dae.z, dae.u, dae.p], [dae.f, dae.g, dae.y])
    return [np.array(r).ravel() for r in f(x, dae.z.numel() * [0.1], u, dae.parameter_values())]


def test_the_right_side_is_divided_by_the_time_constant():
    dae = chain(Lag(T=0.25)).compile()
    f, g, y = outputs(dae, [0.4], [1.0])
    assert f == pytest.approx([0.6 / 0.25])
    assert g.size == 0
    assert y == pytest.approx([0.8])


@pytest.mark.parametrize("where", [(0,), (1,), (0, 1), (0, 1, 2)])
def test_a_time_constant_of_zero_leaves_no_variable(where):
    dae = chain(*(Lag(T=0.0 if k in where else 0.5) for k in range(3))).compile()
    assert dae.algebraics == ()
    assert len(dae.states) == 3 - len(where)
    x = [0.4] * len(dae.states)
    _, _, y = outputs(dae, x, [1.0])
    if where == (0, 1, 2):
        assert y == pytest.approx([8.0])
    elif 2 not in where:
        assert y == pytest.approx([0.8])
    assert dae.y_names == ("y",)


def test_one_that_has_no_explicit_solution_stays_as_a_variable():
    dae = chain(Lag(T=0.0), Cube(T=0.0)).compile()
    assert [row.path for row in dae.algebraics] == ["b1.x"]
    _, g, y = outputs(dae, [], [1.0])
    assert g == pytest.approx([2.0 - 0.1 - 0.001])
    assert y == pytest.approx([0.1])


def test_a_zero_stays_zero_and_others_stay_above():
    dae = chain(Lag(T=0.0), Lag(T=0.5)).compile()
    for path, value, text in (
        ("b0.T", 0.1, "b0.T = 0.1 s is outside [0, 0]."),
        ("b1.T", 0.0, "b1.T = 0 s is outside [1e-06, 10]."),
    ):
        with pytest.raises(InputError) as failure:
            dae.parameter_values(**{path: value})
        assert str(failure.value) == text


def test_what_is_a_state_must_be_known_when_the_block_is_made():
    d = chain(Lag(T=0.5))
    T = d.parameter("T", 0.0, "s")
    d.bind(d.blocks["b0"], T=T)
    with pytest.raises(ModelError) as failure:
        d.compile()
    assert str(failure.value) == (
        "chain: b0.T is bound to T = 0 s, but the block was made with 0.5 s. What is a state must be known "
        "when the block is made: give it T = 0 as well."
    )


def test_a_time_constant_must_be_a_parameter_in_seconds():
    with pytest.raises(ModelError) as failure:

        class Wrong(Block):
            K = Parameter(1.0, "1", (0.0, 2.0), "not a time", "test")
            x = State(0.0, "1", "state", time="K")

    assert str(failure.value) == (
        "Wrong: x: its time constant 'K' must be a parameter of the block in s, with bounds from 0 on."
    )


def test_eliminating_the_only_variable_keeps_f_and_y_in_their_places():
    """CasADi gives a row of no entries for none of one, which shifted what came after it."""
    dae = chain(Lag(T=0.0), Lag(T=0.5)).compile(eliminate=True)
    f, g, y = outputs(dae, [0.4], [1.0])
    assert dae.y.shape == (1, 1)
    assert dae.g.shape == (0, 1)
    assert f == pytest.approx([(2.0 - 0.4) / 0.5])
    assert y == pytest.approx([0.8])
    assert g.size == 0


class Limited(Block):
    """A lag that stops at 1."""

    modes = ("FREE", "HELD")
    start = "FREE"
    flags = {"free": (1, 0)}  # noqa: RUF012
    u = Input("1", "input")
    x = State(0.0, "1", "state")
    y = Output("1", "output")

    def equations(self, s):
        return Equations(der=dict(x=s.free * (s.u - s.x)), out=dict(y=s.x))


def compiled(rows):
    kind = type("Limited", (Limited,), {"transitions": lambda self, s: rows(s)})
    return chain(kind()).compile()


def test_a_reset_to_the_limit_needs_no_gap():
    dae = compiled(
        lambda s: (
            Go("FREE", "HELD", above(s.x, 1.0), reset={"x": 1.0}),
            Go("HELD", "FREE", below(s.u - s.x, 0.0)),
        )
    )
    assert dae.automata[0].gaps == ()


@pytest.mark.parametrize(
    "rows",
    [
        lambda s: (Go("FREE", "HELD", above(s.x, 1.0)), Go("HELD", "FREE", below(s.u, 0.0))),
        lambda s: (
            Go("FREE", "HELD", above(s.x, 1.0), reset={"x": 0.99}),
            Go("HELD", "FREE", below(s.u, 0.0)),
        ),
        lambda s: (
            Go("FREE", "HELD", above(s.u, 1.0), settles="only one of the two says so"),
            Go("HELD", "FREE", below(s.u, 1.0)),
        ),
    ],
    ids=["no-reset", "reset-elsewhere", "one-sided"],
)  # fmt: skip
def test_guards_on_different_signals_without_that_are_still_refused(rows):
    with pytest.raises(ModelError, match="leave no gap between them"):
        compiled(rows)


def test_rows_that_say_why_they_settle_need_no_gap():
    why = "the output is continuous over the limit"
    dae = compiled(
        lambda s: (
            Go("FREE", "HELD", above(s.u, 1.0), settles=why),
            Go("HELD", "FREE", below(s.u, 1.0), settles=why),
        )
    )
    assert dae.automata[0].gaps == ()
