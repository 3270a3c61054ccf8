"""Linear systems about a point: closed forms, differences, shares of states in modes, and refusals."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sqrt

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt import Simulator, facility
from dcvrt.errors import InputError, ModelError
from dcvrt.linear import operating_point
from dcvrt.models import Algebraic, Block, Diagram, Equations, Input, Output, Parameter, Phasor, Pll, State

approx = pytest.approx


class Lag(Block):
    """T x' = k u - x."""

    T = Parameter(0.5, "s", (0.01, 10), "time constant", "test")
    k = Parameter(2.0, "1", (-10, 10), "gain", "test")
    u = Input("1", "in")
    x = State(0.0, "1", "lagged")
    y = Output("1", "x + 3 u")

    def equations(self, s):
        return Equations(der={"x": (s.k * s.u - s.x) / s.T}, out={"y": s.x + 3 * s.u})


def lag():
    d = Diagram("lag")
    block = d.add("lag", Lag())
    d.connect(d.input("u", "1"), block.u)
    d.output("y", block.y)
    return d.compile()


def lone_pll(**gains):
    d = Diagram("lone")
    pll = d.add("pll", Pll(**gains))
    d.connect(d.input("v_poi", "pu(V)", Phasor), pll.v)
    d.output("omega", pll.omega)
    return d.compile()


class Algebra(Block):
    """x' = -z + u, 0 = z + a z^3 - x: the slope of z over x is 1/(1 + 3 a z^2)."""

    a = Parameter(0.5, "1", (-10, 10), "bend", "test")
    u = Input("1", "in")
    x = State(0.0, "1", "state")
    z = Algebraic(0.0, "1", "bent state")
    y = Output("1", "z^2 + u")

    def equations(self, s):
        return Equations(
            der={"x": s.u - s.z}, alg={"z": s.z + s.a * s.z**3 - s.x}, out={"y": s.z * s.z + s.u}
        )


def bent():
    d = Diagram("bent")
    block = d.add("b", Algebra())
    d.connect(d.input("u", "1"), block.u)
    d.output("y", block.y)
    return d.compile()


# ---- closed forms ---------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(st.floats(5, 200), st.floats(50, 5000), st.floats(0.2, 1.2), st.floats(-3, 3))
def test_a_pll_is_the_second_order_of_its_closed_form(K_p, K_i, V, angle):
    """w_n = sqrt(K_i V), zeta = K_p/2 sqrt(V/K_i): nothing behind it, so the angle across it is zero."""
    dae = lone_pll(K_p=K_p, K_i=K_i)
    at = Simulator(dae).equilibrium(V * np.exp(1j * angle))
    assert at["pll.delta"] == approx(angle, abs=1e-9)
    linear = dae.linearise(at)
    w_n, zeta = sqrt(K_i * V), K_p / 2 * sqrt(V / K_i)
    np.testing.assert_allclose(
        np.sort_complex(linear.eigenvalues()),
        np.sort_complex(np.roots([1, 2 * zeta * w_n, w_n**2])),
        rtol=1e-6,
    )
    if zeta < 0.99:
        assert linear.damping_ratios() == approx([zeta, zeta], rel=1e-6)
        assert linear.frequencies() == approx([w_n * sqrt(1 - zeta**2) / (2 * pi)] * 2, rel=1e-6)


def test_a_pll_off_its_rest_has_the_stiffness_of_its_angle():
    dae, K_p, K_i = lone_pll(K_p=20.0, K_i=900.0), 20.0, 900.0
    off = 0.7
    point = operating_point(dae, {"pll.delta": -off}, {"v_poi.re": 0.9})
    stiffness = 0.9 * cos(off)
    linear = dae.linearise(point)
    np.testing.assert_allclose(
        np.sort_complex(linear.eigenvalues()),
        np.sort_complex(np.roots([1, K_p * stiffness, K_i * stiffness])),
        rtol=1e-9,
    )


def test_the_transfer_function_of_a_lag():
    dae = lag()
    linear = dae.linearise(Simulator(dae).equilibrium(inputs={"u": 1.0}))
    for w in (0.0, 0.3, 2.0, 50.0):
        assert linear.transfer(1j * w, "y", "u") == approx(2.0 / (1 + 0.5j * w) + 3.0)
    assert linear.transfer(0.0).shape == (1, 1)
    assert linear.frame("A").loc["lag.x", "lag.x"] == -2.0
    assert linear.frame("B").loc["lag.x", "u"] == 4.0
    assert linear.frame("C").loc["y", "lag.x"] == 1.0
    assert linear.frame("D").loc["y", "u"] == 3.0


@pytest.mark.parametrize("u", [0.2, 1.0])
def test_algebraic_variables_are_eliminated_with_their_slope(u):
    dae = bent()
    at = Simulator(dae).equilibrium(inputs={"u": u})
    assert at["b.z"] == approx(u)
    slope = 1 / (1 + 3 * 0.5 * u**2)
    linear = dae.linearise(at)
    assert approx(-slope) == linear.A[0, 0]
    assert approx(1.0) == linear.B[0, 0]
    assert approx(2 * u * slope) == linear.C[0, 0]
    assert approx(1.0) == linear.D[0, 0]


# ---- a facility -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gfl", "gfm"])
def test_the_matrices_are_the_differences_of_the_equations(name):
    dae = facility.get(name).compile()
    at = Simulator(dae).equilibrium(0.97 * np.exp(0.2j), beta=1.25)
    linear = dae.linearise(at)
    f = ca.Function("f", [dae.x, dae.u, dae.p, dae.q, dae.clocks], [ca.vertcat(dae.f, dae.y)])

    def value(x, u):
        return np.array(f(x, u, at.p, at.flags, np.zeros(len(dae.automata)))).ravel()

    n, step = len(at.x), 1e-6
    for k, matrix in ((0, np.vstack((linear.A, linear.C))), (1, np.vstack((linear.B, linear.D)))):
        for j in range(matrix.shape[1]):
            shift = step * np.eye(matrix.shape[1])[j]
            up = value(at.x + (k == 0) * shift, at.u) if k == 0 else value(at.x, at.u + shift)
            down = value(at.x - shift, at.u) if k == 0 else value(at.x, at.u - shift)
            scale = 1 + np.abs(matrix[:, j])
            # curvature of the blends (widths of 1e-3) limits a difference, not the derivative
            assert np.abs((up - down) / (2 * step) - matrix[:, j]).max() < 1e-4 * scale.max()
    assert linear.states == dae.x_names
    assert linear.A.shape == (n, n)


def test_participation_sums_to_one_over_states_and_over_modes():
    dae = facility.gfm().compile()
    shares = dae.linearise(Simulator(dae).equilibrium(1.0)).participation()
    np.testing.assert_allclose(shares.matrix.sum(axis=0), 1.0, atol=1e-8)
    np.testing.assert_allclose(shares.matrix.sum(axis=1), 1.0, atol=1e-8)
    swing = int(np.argmax(np.abs(shares.eigenvalues.imag)))
    frame = shares.frame()
    assert frame.iloc[:, swing].nlargest(1).index[0] == "vsm.delta"
    assert shares["bess.p"] == approx(shares.matrix[list(shares.states).index("bess.p")])


def test_participation_of_uncoupled_states_is_the_identity():
    d = Diagram("two")
    u = d.input("u", "1")
    a, b = d.add("a", Lag(T=0.1)), d.add("b", Lag(T=1.0))
    d.connect(u, a.u, b.u)
    dae = d.compile()
    linear = dae.linearise(Simulator(dae).equilibrium())
    assert linear.eigenvalues() == approx([-1.0, -10.0])
    assert np.abs(linear.participation().matrix) == approx(np.array([[0.0, 1.0], [1.0, 0.0]]))
    assert str(linear) == (
        "         eigenvalue, 1/s     f, Hz  damping  states that take part\n"
        "                      -1         0    1.000  b.x 1.00\n"
        "                     -10         0    1.000  a.x 1.00"
    )
    assert str(linear.participation()) == (
        "        -1    -10\n"
        "a.x      ·   1.00\n"
        "b.x   1.00      ·"
    )  # fmt: skip


def test_a_point_is_read_by_name_and_printed():
    dae = facility.gfl().compile()
    at = Simulator(dae).equilibrium(0.95, beta=1.3, **{"sup.V_dip": 0.8})
    assert at["p_g"] == approx(0.95, abs=1e-3)
    assert (at["beta"], at["v_poi.re"], at["sup.V_dip"]) == (1.3, 0.95, 0.8)
    assert max(map(abs, at.residuals.values())) < 1e-9
    assert set(at.residuals) == {f"d({n})/dt" for n in dae.x_names}
    first, *rest = str(at).splitlines()
    assert first == "gfl in mode sup NORMAL"
    assert any(line.split()[:2] == ["state", "dc.w"] for line in rest)
    with pytest.raises(InputError) as error:
        at["p_q"]
    assert str(error.value).startswith("the point has no value 'p_q'. Did you mean 'p_g'? Known: H, beta,")


def test_the_modes_of_the_automata_enter_the_matrices():
    dae = facility.gfl().compile()
    simulator = Simulator(dae)
    normal = simulator.equilibrium(1.0)
    uncoupled = replace(normal, modes={"sup": "BATTERY"})  # the same values: what would move them now?
    reacts = (dae.x_names.index("lag.i_d"), dae.x_names.index("dc_loop.xi"))
    assert abs(dae.linearise(normal).A[reacts]) > 100
    assert abs(dae.linearise(uncoupled).A[reacts]) < 1e-6
    assert uncoupled.residuals["d(lag.i_d)/dt"] < -100


# ---- refusals -------------------------------------------------------------------------------------------


def test_points_of_another_system_are_refused():
    with pytest.raises(InputError) as error:
        lag().linearise(Simulator(bent()).equilibrium())
    assert str(error.value) == (
        "the point is one of another system (bent). Way out: Simulator(dae).equilibrium(...) or "
        "operating_point(dae, ...) with this one."
    )


def test_unknown_names_of_a_point_are_told_together():
    with pytest.raises(InputError) as error:
        operating_point(lag(), {"lag.y": 1.0}, {"v": 1.0})
    assert str(error.value) == (
        "lag has no state 'lag.y'. Did you mean 'lag.x'? Known: lag.x.\nlag has no input 'v'. Known: u."
    )
    with pytest.raises(InputError) as error:
        operating_point(facility.gfl().compile(), {}, modes={"sop": "NORMAL"})
    assert str(error.value) == "gfl has no automaton 'sop'. Did you mean 'sup'? Known: sup."
    with pytest.raises(InputError) as error:
        operating_point(facility.gfl().compile(), {}, modes={"sup": "NORMA"})
    assert str(error.value) == (
        "sup has no mode 'NORMA'. Did you mean 'NORMAL'? Known: NORMAL, MIXED, BATTERY, RETURN."
    )


def test_a_singular_point_names_the_variables():
    dae = bent()
    fold = sqrt(1 / 3)  # 1 + 3 a z^2 = 0 at a = -1
    with pytest.raises(ModelError) as error:
        dae.linearise(operating_point(dae, {}, z={"b.z": fold}, **{"b.a": -1.0}))
    assert str(error.value) == (
        "bent: the algebraic equations do not determine b.z at this point (g_z is singular: a voltage "
        "collapse, or a loop with gain 1). Way out: another point, or a lag in the loop."
    )


def test_a_derivative_that_is_not_finite_is_named():
    class Root(Block):
        """x' = -sqrt(x)."""

        x = State(0.0, "1", "emptying")

        def equations(self, s):
            return Equations(der={"x": -ca.sqrt(s.x)})

    d = Diagram("d")
    d.add("r", Root())
    dae = d.compile()
    with pytest.raises(ModelError) as error:
        dae.linearise(operating_point(dae, {"r.x": 0.0}))
    assert str(error.value) == (
        "d: no linear system at this point: the derivative of the equation of r.x is no finite number there."
    )


def test_a_defective_matrix_has_no_shares():
    d = Diagram("row")
    a, b = d.add("a", Lag(k=1.0)), d.add("b", Lag(k=1.0))
    d.connect(d.input("u", "1"), a.u)
    d.connect(a.x, b.u)
    dae = d.compile()
    linear = dae.linearise(Simulator(dae).equilibrium())
    with pytest.raises(ModelError) as error:
        linear.participation()
    assert str(error.value) == (
        "row: no participation factors: the eigenvalues -2+0j, -2+0j coincide and share an eigenvector. "
        "Way out: change a parameter a little."
    )
    assert "-2         0    1.000" in str(linear)


def test_unknown_entries_of_a_linear_system():
    dae = lag()
    linear = dae.linearise(Simulator(dae).equilibrium())
    for call, text in (
        (lambda: linear.transfer(0.0, "z"), "lag has no output 'z'. Known: y."),
        (lambda: linear.transfer(0.0, "y", "v"), "lag has no input 'v'. Known: u."),
        (lambda: linear.frame("E"), "there is no matrix 'E'. Known: A, B, C, D."),
        (lambda: linear.participation()["lag.z"], "there is no state 'lag.z'. Did you mean 'lag.x'? "
                                                  "Known: lag.x."),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == text


def test_an_angle_that_a_swing_rests_at_is_that_of_its_power():
    """The VSM's own swing against its closed form is in the tests of whole systems; here its rest."""
    dae = facility.gfm().compile()
    at = Simulator(dae).equilibrium(1.0, beta=2.0)
    E, X, R = at["vsm.E"], at["vsm.X_v"], at["vsm.R_v"]
    internal = E * np.exp(1j * at["vsm.delta"])
    power = 1.0 * np.conj((1.0 - internal) / (R + 1j * X))
    assert power.real == approx(at["p_g"], abs=1e-6)
