"""Units: wiring, what decides their equations, closed forms of the whole, limits reached and left."""

from __future__ import annotations

from dataclasses import replace
from math import exp, pi, sqrt

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dcvrt.errors import InputError, ModelError
from dcvrt.integrators import Casadi, Simulator
from dcvrt.linear import operating_point
from dcvrt.models import Diagram, Phasor, Pll
from dcvrt.models.machines import (
    Exdc2,
    Exst1,
    GenCls,
    GenRou,
    Ieeeg1,
    Ieeest,
    IeeestWithWindow,
    Ieeet1,
    Ieeex1BusFed,
    Sexs,
    St2Cut,
    Tgov1,
    Tgov1N,
    esst3a,
    setpoints,
    structure,
    unit,
)
from dcvrt.waveform import Waveform
from tests.models.machines.cases import phasor_diagram

approx = pytest.approx


def zeros():
    """Units whose data leave out whatever can be left out, and one with everything."""
    return {
        "everything": lambda: unit(
            GenRou(S_B=0.3), Exdc2(S_B=0.2), Ieeeg1(), Ieeest(A_1=0.1, A_2=0.1, A_4=0.1, A_6=0.1)
        ),
        "sexs": lambda: unit(GenRou(), Sexs(T_B=0.0, T_A=0.0, T_E=0.0), Tgov1(T_1=0.0, T_3=0.0, T_2=0.0)),
        "ieeet1": lambda: unit(GenRou(), Ieeet1(T_R=0.0, T_A=0.0), Tgov1N(), Ieeest(T_2=0.0, T_4=0.0)),
        "ieeex1": lambda: unit(
            GenRou(), Ieeex1BusFed(T_R=0.0, T_B=0.0, T_C=0.0, T_A=0.0), Ieeeg1(T_1=0.0, T_4=0.0, T_7=0.0),
            IeeestWithWindow(signal=2.0, T_5=0.0, T_6=0.0, T_1=0.0, T_2=0.0, T_3=0.0, T_4=0.0),
        ),
        "exst1": lambda: unit(
            GenRou(), Exst1(T_R=0.0, T_A=0.0, K_C=0.0), None,
            St2Cut(T_1=0.0, T_2=0.0, T_3=0.0, T_4=0.0, T_6=0.0, T_8=0.0, T_10=0.0),
        ),
        "esst3a": lambda: unit(GenRou(), esst3a(T_R=0.0, T_A=0.0, T_M=0.0, T_B=0.0, K_C=0.0)),
        "bare": lambda: unit(GenCls()),
    }  # fmt: skip


@pytest.mark.parametrize("name", list(zeros()))
def test_a_compiled_unit_is_explicit_and_finite(name):
    dae = zeros()[name]().compile()
    assert dae.algebraics == ()
    assert dae.y_names == ("i.re", "i.im", "delta", "omega", "v_f", "t_m", "t_e")
    everything = [row.guard for a in dae.automata for row in a.rows]
    everything += [value for a in dae.automata for row in a.rows for value in row.reset.values()]
    column = ca.vertcat(dae.f, dae.y, *everything)
    f = ca.Function("f", [dae.x, dae.u, dae.p, dae.q], [column, ca.densify(ca.jacobian(column, dae.x))])
    p, rng = dae.parameter_values(), np.random.default_rng(3)
    for _ in range(20):
        flags = [a.flags[rng.integers(len(a.modes))] for a in dae.automata]
        x = rng.uniform(0.3, 1.1, len(dae.states))
        values = f(x, rng.uniform(0.2, 0.9, 2), p, np.concatenate([np.zeros(0), *flags]))
        assert all(np.isfinite(np.array(v)).all() for v in values)


@pytest.mark.parametrize("name", list(zeros()))
def test_a_zero_that_decided_the_equations_stays(name):
    dae = zeros()[name]().compile()
    for row in dae.parameter_rows:
        _, _, symbol = row.path.rpartition(".")
        if symbol.startswith("T_") and row.bounds == (0.0, 0.0):
            assert row.value == 0
            with pytest.raises(InputError, match=r"is outside \[0, 0\]\.$"):
                dae.parameter_values(**{row.path: 0.1})
    if name == "everything":
        with pytest.raises(InputError, match=r"T_R = 0 s is outside \[1e-06, 10\]\.$"):
            dae.parameter_values(**{"exciter.T_R": 0.0})


def test_values_do_not_decide_the_equations_but_zeros_do():
    def make(machine=None, exciter=None, governor=None, stabiliser=None):
        return unit(
            GenRou(**(machine or {})),
            Ieeet1(**(exciter or {})),
            Tgov1(**(governor or {})),
            Ieeest(**(stabiliser or {})),
        )

    one = make()
    other = make(dict(x_d=1.5, M=3.0), dict(K_A=99.0, T_A=0.3), dict(R=0.01), dict(T_1=0.5, K_S=3.0))
    assert structure(one) == structure(other)
    assert hash(structure(one)) == hash(structure(other))
    f, g = (
        ca.Function("f", [d.x, d.u, d.p, d.q], [ca.vertcat(d.f, d.y)])
        for d in (one.compile(), other.compile())
    )
    assert f.serialize() == g.serialize()
    different = [
        make(dict(x_q2=0.3)),
        make(dict(S_B=0.2)),
        make(exciter=dict(T_R=0.0)),
        make(exciter=dict(S_B=0.2)),
        make(governor=dict(T_3=0.0)),
        make(stabiliser=dict(signal=3.0)),
        make(stabiliser=dict(A_1=0.1)),
        make(stabiliser=dict(T_5=0.0)),
        unit(GenRou(), Ieeet1(), Tgov1N(), Ieeest()),
        unit(GenRou(), Ieeet1(), Tgov1()),
    ]
    keys = {structure(one), *(structure(d) for d in different)}
    assert len(keys) == 1 + len(different)


@pytest.mark.parametrize("machine", [GenRou, GenCls])
def test_without_saliency_the_admittance_is_constant(machine):
    dae = unit(machine(r_a=0.01)).compile()
    slope = ca.jacobian(dae.y[:2], dae.u)
    assert not ca.depends_on(slope, ca.vertcat(dae.x, dae.u))
    x = "x_d2" if machine is GenRou else "x_d1"
    values = dae.parameter_values()
    y = -1 / complex(0.01, values[dae.parameter_number(f"machine.{x}")])
    number = np.array(ca.Function("y", [dae.p], [slope])(values))
    np.testing.assert_allclose(number, [[y.real, -y.imag], [y.imag, y.real]], rtol=1e-14)


def test_saliency_gives_the_general_form_which_tends_to_the_other():
    dae = unit(GenRou(x_q2=0.3)).compile()
    assert ca.depends_on(ca.jacobian(dae.y[:2], dae.u), dae.x)
    outputs = []
    for x_q2 in (0.25, 0.25 + 1e-9):
        d = unit(GenRou(r_a=0.01, x_q2=x_q2, S_A=0.7, S_B=0.4)).compile()
        f = ca.Function("f", [d.x, d.u, d.p], [d.f, d.y])
        x = [0.4, 1.01, 1.0, 0.3, 0.9, -0.4]
        outputs.append([np.array(r).ravel() for r in f(x, [0.9, 0.2], d.parameter_values())])
    for one, other in zip(*outputs, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    ("exciter", "field"),
    [
        (None, "exciter.v_f0"),
        (Sexs, "exciter.v_ref"),
        (esst3a, "exciter.regulator.v_ref"),
    ],
)
def test_setpoints_are_found_by_path(exciter, field):
    dae = unit(GenRou(), exciter() if exciter else None, Tgov1()).compile()
    assert setpoints(dae) == (field, "governor.p_ref")


def test_errors_say_what_to_do():
    d = Diagram("mine")
    pll = d.add("pll", Pll())
    d.connect(d.input("v", "pu(V)", Phasor), pll.v)
    with pytest.raises(InputError) as failure:
        setpoints(d.compile())
    assert str(failure.value) == (
        "mine: not the system of one unit: it has 0 set-points of the field (exciter.v_ref, "
        "exciter.regulator.v_ref, exciter.v_f0, device.p_0) and 0 of the power (governor.p_ref, device.q_0). "
        "Compile what machines.unit() returned."
    )
    with pytest.raises(InputError) as failure:
        structure(d)
    assert str(failure.value) == (
        "pll (Pll) does not say what decides its equations. Derive it from UnitBlock."
    )
    with pytest.raises(InputError) as failure:
        unit(GenRou(), None, None, Ieeest())
    assert str(failure.value) == (
        "unit: the stabiliser Ieeest has nothing to act on: FixedField takes no signal. Give the unit an "
        "exciter, or leave the stabiliser out."
    )
    with pytest.raises(ModelError) as failure:
        unit(GenRou(), None, Pll())
    assert str(failure.value).startswith("governor (Pll) has no 't_m'.")


# -- closed forms of the whole ------------------------------------------------------------------------------


def test_gencls_swings_with_its_frequency():
    machine = GenCls(M=7.0, x_d1=0.3, D=0.5)
    v, i = 1.0 + 0.0j, 0.8 - 0.2j
    inner = v + 0.3j * i
    dae = unit(machine).compile()
    point = operating_point(
        dae,
        {"machine.delta": float(np.angle(inner)), "machine.omega": 1.0},
        {"v.re": 1.0, "v.im": 0.0},
        **{"exciter.v_f0": float(abs(inner)), "governor.p_ref": 0.8},
    )
    K = abs(inner) / 0.3 * np.cos(np.angle(inner))
    alpha, square = 0.5 / (2 * 7.0), 2 * pi * 60 * K / 7.0
    eigenvalues = np.sort_complex(np.array(dae.linearise(point).eigenvalues()))
    expected = [complex(-alpha, sign * sqrt(square - alpha**2)) for sign in (-1, 1)]
    np.testing.assert_allclose(eigenvalues, expected, rtol=1e-12)


def flow(dae, q=None):
    """f and y on numbers."""
    f = ca.Function("f", [dae.x, dae.u, dae.p, dae.q], [dae.f, dae.y])
    flags = np.concatenate([np.zeros(0), *[a.flags[a.mode_number(a.start)] for a in dae.automata]])
    flags = flags if q is None else q
    return lambda x, u, p: [np.array(r).ravel() for r in f(x, u, p, flags)]


def test_the_open_field_decays_with_its_time_constants():
    """Terminals open, rotor fixed: e_q' follows T_d0', and the damper e_d'' T_d0'', to first order."""
    m = GenRou(x_d2=0.25, x_q2=0.25, T_d1=8.0, T_d2=0.04)
    eq = lambda e_q1, e_d2: m.equations(  # noqa: E731 - a table of slopes reads better
        m.at(
            # the terminal voltage that drives no current is the internal one
            v=Phasor((0.1 / 0.152) * e_q1 + (1 - 0.1 / 0.152) * e_d2, 0.0),
            v_f=0.0, t_m=0.0, delta=0.0, omega=1.0, e_q1=e_q1, e_d1=0.0, e_d2=e_d2, e_q2=0.0,
        )
    ).der  # fmt: skip
    start = eq(1.0, 1.0)
    assert float(start["e_q1"]) == approx(-1 / 8.0)  # equal voltages: no current in the damper
    assert float(start["e_d2"]) == approx(0.0, abs=1e-12)
    assert float(eq(1.0, 0.9)["e_d2"]) == approx(0.1 / 0.04)
    decay = solve_ivp(
        lambda t, y: [float(eq(*y)["e_q1"]), float(eq(*y)["e_d2"])], (0, 8), [1.0, 1.0], method="LSODA",
        rtol=1e-9, atol=1e-12, t_eval=[4.0, 8.0],
    )  # fmt: skip
    # after the damper has settled the flux falls with the slow eigenvalue of the open circuit
    ratio = decay.y[0, 1] / decay.y[0, 0]
    g2 = (0.302 - 0.25) / 0.152**2
    a = np.array([[-(1 + (1.9 - 0.302) * g2) / 8, (1.9 - 0.302) * g2 / 8], [1 / 0.04, -1 / 0.04]])
    slow = max(np.linalg.eigvals(a).real)
    assert ratio == approx(exp(4 * slow), rel=1e-6)
    assert -1 / slow == approx(8.0, rel=0.05)


def test_a_unit_of_four_blocks_rests_where_its_parts_do():
    m = GenRou(r_a=0.01, S_A=0.7, S_B=0.4)
    v, i = 1.02 * np.exp(0.3j), 0.8 - 0.3j
    states, v_f, t_m = phasor_diagram(m, v, i)
    governor = Tgov1(p_ref=t_m)
    exciter = Sexs(v_ref=abs(v) + v_f / 20)
    stabiliser = Ieeest(signal=3.0, T_1=0.0, T_2=0.0, K_S=-2.0)
    dae = unit(m, exciter, governor, stabiliser).compile()
    at = {f"machine.{k}": value for k, value in states.items()}
    at |= {"exciter.x": v_f / 20, "exciter.e_f": v_f, "governor.g": t_m, "governor.x": t_m}
    at |= {"stabiliser.x_2": t_m, "stabiliser.x_3": -2 * t_m}
    x = [at[name] for name in dae.x_names]
    f, y = flow(dae)(x, [v.real, v.imag], dae.parameter_values())
    assert np.abs(f).max() < 1e-12
    assert complex(*y[:2]) == approx(i, abs=1e-12)
    assert y[2:] == approx([states["delta"], 1.0, v_f, t_m, t_m], abs=1e-12)


# -- limits that are reached and left -----------------------------------------------------------------------

STEADY = Waveform.from_samples([0.0, 5.0], [1.0, 1.0])


def alone(block, outputs, **inputs):
    """A block in a diagram of its own; voltage from the waveform, other inputs constant or over time."""
    d = Diagram("alone")
    d.add("b", block)
    from dcvrt.models.declared import Input

    for name, declared in block.declared(Input).items():
        if declared.kind is Phasor:
            d.connect(d.input(name, declared.unit, Phasor), getattr(block, name))
        else:
            d.connect(d.input(name, declared.unit, rest=inputs.get(name, 0.0)), getattr(block, name))
    for name in outputs:
        d.output(name, getattr(block, name))
    return d.compile()


def run(dae, start, waveform=STEADY, inputs=None):
    begin = ca.SX(ca.DM([start[name] for name in dae.x_names]))
    simulator = Simulator(
        replace(dae, start=begin), Casadi("erk", rtol=1e-9, atol=1e-11, interpreted=True), save_at=1e-3,
        start="given",
    )  # fmt: skip
    return simulator(waveform, inputs)


def moves(trajectory):
    return [(e.source, e.target) for e in trajectory.events]


def pulse(size, begin=1.0, end=2.0, until=5.0):
    """A signal that steps up and back."""
    t = np.array([0.0, begin, begin, end, end, until])
    return t, np.array([0.0, 0.0, size, size, 0.0, 0.0])


def test_a_limited_lag_stops_on_its_limit_and_leaves_when_the_rate_turns():
    """SEXS with K = 10, T_E = 0.5 s, a step of 0.3 for 1 s: closed forms of entry, rest and release."""
    dae = alone(Sexs(K=10.0, T_B=0.0, T_E=0.5, E_max=2.5, E_min=-1.0, v_ref=1.1), ["v_f"])
    r = run(dae, {"b.e_f": 1.0}, inputs={"v_s": pulse(0.3)})
    assert moves(r) == [("FREE", "UPPER"), ("UPPER", "FREE")]
    # target 4 from 1: 4 - 3 exp(-t/T) = 2.5 at t = T ln 2
    assert r.events[0].time == approx(1 + 0.5 * np.log(2), abs=1e-8)
    assert r.events[1].time == approx(2.0, abs=1e-9)
    resting = (r.t > 1.4) & (r.t < 1.99)
    assert np.abs(r["v_f"][resting] - 2.5).max() < 1e-12
    after = r.t > 2.001
    np.testing.assert_allclose(r["v_f"][after], 1 + 1.5 * np.exp(-(r.t[after] - 2) / 0.5), atol=1e-6)


def test_a_limited_lag_that_has_no_lag_is_cut_off():
    dae = alone(Sexs(K=10.0, T_A=1.0, T_B=1.0, T_E=0.0, E_max=2.5, E_min=-1.0, v_ref=1.1), ["v_f"])
    fine = np.linspace(0.0, 5.0, 501)
    ramp = fine, np.interp(fine, [0.0, 1.0, 2.0, 5.0], [0.0, 0.0, 0.3, 0.0])
    r = run(dae, {"b.x": 0.1}, inputs={"v_s": ramp})
    assert moves(r) == [("FREE", "UPPER"), ("UPPER", "FREE")]
    assert [e.time for e in r.events] == approx([1.5, 3.5], abs=1e-8)
    v_s = np.interp(r.t, *ramp)
    bends = np.abs(r.t[:, None] - [1.0, 2.0]).min(axis=1) < 0.03  # the input is smooth between samples
    limited = np.minimum(10 * (0.1 + v_s), 2.5)
    np.testing.assert_allclose(r["v_f"][~bends], limited[~bends], atol=1e-9)


def test_a_lower_limit_works_as_an_upper_one():
    dae = alone(Tgov1(p_ref=0.5, R=0.05, T_1=0.2, T_2=1.0, T_3=5.0, V_min=0.2, V_max=1.0), ["t_m"])
    over = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 5.0]), np.array([1.0, 1.0, 1.03, 1.03, 1.0, 1.0])
    r = run(dae, {"b.g": 0.5, "b.x": 0.5}, inputs={"omega": over})
    assert moves(r) == [("FREE", "LOWER"), ("LOWER", "FREE")]
    # target -0.1 from 0.5: 0.6 exp(-t/T) - 0.1 = 0.2
    assert r.events[0].time == approx(1 + 0.2 * np.log(2), abs=1e-8)
    assert np.abs(r["b.g"][(r.t > 1.2) & (r.t < 1.99)] - 0.2).max() < 1e-12
    after = r.t > 2.001
    np.testing.assert_allclose(r["b.g"][after], 0.5 - 0.3 * np.exp(-(r.t[after] - 2) / 0.2), atol=1e-6)


def test_a_limit_that_moves_takes_the_output_with_it():
    block = Ieeex1BusFed(
        T_R=0.0, T_B=0.0, T_C=0.0, K_A=10.0, T_A=0.1, V_Rmax=1.0, V_Rmin=-1.0, K_E=0.0, K_F=0.0, T_E=1.0,
        v_ref=1.05,
    )  # fmt: skip
    dae = alone(block, ["v_f"])
    w = Waveform.from_samples([0.0, 1.0, 1.0, 2.0, 2.0, 5.0], [1.0, 1.0, 0.4, 0.6, 1.1, 1.1])
    r = run(dae, {"b.v_r": 0.5, "b.e_f": 1.0, "b.w": 1.0}, w)
    assert moves(r) == [("FREE", "UPPER"), ("UPPER", "FREE")]
    entry = r.events[0].time
    assert 1.0 <= entry < 1.1
    # at the limit the field is driven by the limit itself, V_Rmax |v|
    on = (r.t > entry + 2e-3) & (r.t < 1.998)
    rate = np.gradient(r["v_f"][on], r.t[on])
    assert np.abs(rate - (0.4 + 0.2 * (r.t[on] - 1))).max() < 2e-3
    assert r.events[1].time == approx(2.0, abs=1e-9)
    # and the lag starts from the limit as it is then: 1.1, towards 10 (1.05 - 1.1)
    after = r.t > 2.001
    np.testing.assert_allclose(r["b.v_r"][after], -0.5 + 1.6 * np.exp(-(r.t[after] - 2) / 0.1), atol=1e-6)


def test_a_state_that_rests_exactly_on_its_limit_does_not_chatter():
    """The governor of a unit at its least power: the speed rises and falls back, slowly."""
    dae = alone(Tgov1(p_ref=0.3, R=0.05, T_1=0.05, V_min=0.3), ["t_m"])
    t = np.linspace(0.0, 5.0, 501)
    r = run(dae, {"b.g": 0.3, "b.x": 0.3}, inputs={"omega": (t, 1 + 0.01 * np.sin(2 * pi * 0.4 * t))})
    assert len(r.events) <= 6
    assert {row for row in moves(r)} == {("FREE", "LOWER"), ("LOWER", "FREE")}
    assert r["b.g"].min() >= 0.3 - 1e-9


def test_both_limits_of_a_stabiliser_and_its_window():
    block = IeeestWithWindow(
        T_1=0.0, T_2=0.0, T_3=0.0, T_4=0.0, T_5=5.0, T_6=5.0, K_S=1.0, L_min=-0.04, L_max=0.05, V_CL=0.8,
        V_CU=1.2,
    )  # fmt: skip
    dae = alone(block, ["v_s"], omega=1.0, f=1.0)
    t = np.linspace(0.0, 5.0, 501)
    swing = 0.1 * np.sin(2 * pi * t)
    w = Waveform.from_samples([0.0, 3.1, 3.1, 3.6, 3.6, 5.0], [1.0, 1.0, 0.7, 0.7, 1.0, 1.0])
    r = run(dae, {"b.x_3": 0.0}, w, inputs={"omega": (t, 1 + swing)})
    v_s = r["v_s"]
    assert v_s.max() == approx(0.05, abs=1e-12)
    assert v_s.min() == approx(-0.04, abs=1e-12)
    inside = (r.t > 3.101) & (r.t < 3.599)
    assert np.abs(v_s[inside]).max() == 0
    assert {("FREE", "UPPER"), ("UPPER", "FREE"), ("FREE", "LOWER"), ("LOWER", "FREE")} < set(moves(r))
    assert [m for m in moves(r) if "OUT" in m][-1] == ("OUT", "FREE")
    free = np.clip(np.interp(r.t, t, swing) - r["b.x_3"], -0.04, 0.05)
    assert np.abs(v_s - free)[(r.t < 3.09)].max() < 1e-4


def test_the_valve_of_ieeeg1_reaches_every_limit():
    block = Ieeeg1(
        p_ref=0.5, K=20.0, T_1=0.0, T_2=0.0, T_3=0.1, U_o=0.5, U_c=-0.4, P_min=0.1, P_max=0.9, T_4=0.3,
        T_5=0.0, T_6=0.0, T_7=0.0, K_1=1.0, K_3=0.0,
    )  # fmt: skip
    dae = alone(block, ["t_m"], omega=1.0)
    t = np.array([0.0, 0.5, 0.5, 2.0, 2.0, 4.5, 4.5, 5.0])
    omega = np.array([1.0, 1.0, 0.95, 0.95, 1.05, 1.05, 1.0, 1.0])
    r = run(dae, {"b.g": 0.5, "b.y_4": 0.5}, inputs={"omega": (t, omega)})
    assert moves(r) == [
        ("FREE", "OPENING"),
        ("OPENING", "FULL"),
        ("FULL", "FREE"),
        ("FREE", "CLOSING"),
        ("CLOSING", "SHUT"),
        ("SHUT", "FREE"),
        ("FREE", "OPENING"),
        *moves(r)[7:],
    ]
    assert r.events[1].time == approx(0.5 + 0.4 / 0.5, abs=1e-8)  # at 0.5 pu/s from 0.5 to 0.9
    assert r.events[4].time == approx(2.0 + 0.8 / 0.4, abs=1e-8)
    assert r["b.g"].max() == approx(0.9, abs=1e-12)
    assert r["b.g"].min() == approx(0.1, abs=1e-12)


def test_two_limiters_in_one_block_do_not_disturb_each_other():
    block = Exst1(
        T_R=0.0, T_B=0.0, T_C=0.0, K_A=10.0, T_A=0.1, K_F=0.0, K_C=0.5, V_Imin=-0.1, V_Imax=0.3, V_Rmin=-2.0,
        V_Rmax=3.0, v_ref=1.1,
    )  # fmt: skip
    dae = alone(block, ["v_f"], i_f=1.0)
    r = run(dae, {"b.v_r": 1.0, "b.w": 1.0}, inputs={"v_s": pulse(0.5)})
    assert moves(r)[0] == ("FREE_FREE", "UPPER_FREE")  # the input at once
    assert ("UPPER_FREE", "UPPER_UPPER") in moves(r)  # the output when v_r passes 3 - 0.5
    assert r["b.v_r"].max() == approx(3.0, abs=1e-3)  # v_r follows 10 * 0.3 and is not limited
    assert r["v_f"].max() == approx(2.5, abs=1e-12)
    assert moves(r)[-1][1] == "FREE_FREE"
    # 3 - 2 exp(-t/T) = 2.5
    assert r.events[1].time == approx(1 + 0.1 * np.log(4), abs=1e-8)
