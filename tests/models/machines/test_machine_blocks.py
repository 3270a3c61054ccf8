"""Blocks of units: closed forms, equilibria, one code path, what depends on what."""

from __future__ import annotations

import inspect
from math import atan2, pi, radians, sqrt

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.models import Block, Input, Parameter, Phasor, machines
from dcvrt.models.machines import (
    BusFrequency,
    CompoundSource,
    CurrentConverter,
    Esst3aField,
    Esst3aRegulator,
    Exdc2,
    ExponentialLoad,
    Exst1,
    FixedField,
    FixedPower,
    GenCls,
    GenRou,
    Ieeeg1,
    Ieeest,
    IeeestWithWindow,
    Ieeet1,
    Ieeex1,
    Ieeex1BusFed,
    NoStabiliser,
    Sexs,
    St2Cut,
    StaticLoad,
    Tgov1,
    Tgov1N,
    ZipLoad,
    quadratic,
)
from dcvrt.models.testing import assert_consistent
from tests.models.machines.cases import FORMS, magnitude, named, phasor_diagram

approx = pytest.approx
BLOCKS = [
    b for b in vars(machines).values()
    if inspect.isclass(b) and issubclass(b, Block) and b is not machines.UnitBlock
]  # fmt: skip


def test_every_block_is_looked_at():
    assert {kind for kind, _ in FORMS} == set(BLOCKS)


@pytest.mark.parametrize("form", FORMS, ids=named)
def test_numbers_symbols_and_derivatives_agree(form):
    kind, values = form
    assert_consistent(kind(**values))


@pytest.mark.parametrize("kind", BLOCKS, ids=lambda b: b.__name__)
def test_every_symbol_is_documented(kind):
    assert "Equilibrium:" in kind.__doc__
    for name, d in kind._declared.items():
        assert d.doc, f"{kind.__name__}.{name}"
        if isinstance(d, Parameter):
            low, high = d.bounds
            assert low <= d.value <= high
            assert np.isfinite([low, high]).all()
            assert d.source != "not stated", f"{kind.__name__}.{name}"


FEEDTHROUGH = {
    GenRou: {"i": {"v"}, "t_e": {"v"}, "i_f": {"v"}},
    GenCls: {"i": {"v", "v_f"}, "t_e": {"v", "v_f"}, "i_f": {"v_f"}},
    StaticLoad: {"i": {"v"}},
    ExponentialLoad: {"i": {"v"}},
    ZipLoad: {"i": {"v"}},
    CurrentConverter: {"i": set()},
    FixedField: {"v_f": set()},
    FixedPower: {"t_m": set(), "p_set": set()},
    NoStabiliser: {"v_s": set()},
    BusFrequency: {"f": set()},
    Sexs: {"v_f": set()},
    Ieeet1: {"v_f": set()},
    Exdc2: {"v_f": {"omega"}},
    Ieeex1: {"v_f": set()},
    Ieeex1BusFed: {"v_f": set()},
    Exst1: {"v_f": {"i_f"}},
    Esst3aRegulator: {"v_a": set()},
    CompoundSource: {"v_b": {"v", "i", "i_f"}},
    Esst3aField: {"v_f": {"v_b"}},
    Tgov1: {"t_m": {"omega"}, "p_set": set()},
    Tgov1N: {"t_m": {"omega"}, "p_set": set()},
    Ieeeg1: {"t_m": set(), "p_set": set()},
    Ieeest: {"v_s": {"omega"}},
    IeeestWithWindow: {"v_s": {"omega"}},
    St2Cut: {"v_s": set()},
}


@pytest.mark.parametrize("kind", BLOCKS, ids=lambda b: b.__name__)
def test_outputs_depend_on_what_the_equations_say(kind):
    assert {out: set(inputs) for out, inputs in kind().feedthrough().items()} == FEEDTHROUGH[kind]


READS = (set(), {"omega"}, {"f"}, {"t_e"}, {"t_m", "p_set"}, {"v"})


@pytest.mark.parametrize(("signal", "reads"), list(enumerate(READS)))
def test_the_stabiliser_reads_the_signal_it_was_given(signal, reads):
    assert set(Ieeest(signal=signal).feedthrough()["v_s"]) == reads


# -- at rest -------------------------------------------------------------------------------------------------

V = Phasor(0.9, 0.4)
SIZE = magnitude(V)
S = dict(S_A=0.5, S_B=0.2)


def bent(e):
    return 0.2 * (e - 0.5) ** 2


def at_rest(kind, values, **given):
    """Largest right side of a block, and its outputs."""
    block = kind(**values)
    eq = block.equations(block.at(**given))
    return max((abs(float(side)) for side in eq.der.values()), default=0.0), eq.out


RESTS = [
    (BusFrequency, {}, dict(v=V, theta=atan2(0.4, 0.9), x=atan2(0.4, 0.9)), dict(f=1.0)),
    (Sexs, dict(v_ref=SIZE + 0.1), dict(v=V, v_s=0.0, x=0.1, e_f=2.0), dict(v_f=2.0)),
    (
        Ieeet1,
        dict(v_ref=SIZE + (2.0 + bent(2.0)) / 5, **S),
        dict(v=V, v_s=0.0, v_m=SIZE, v_r=2.0 + bent(2.0), e_f=2.0, w=2.0),
        dict(v_f=2.0),
    ),
    (
        Exdc2,
        dict(v_ref=SIZE + (2.0 + bent(2.0)) / 40, **S),
        dict(
            v=V, v_s=0.0, omega=1.0, v_m=SIZE, x=(2.0 + bent(2.0)) / 40, v_r=2.0 + bent(2.0), e_f=2.0, w=2.0
        ),
        dict(v_f=2.0),
    ),
    (
        Ieeex1,
        dict(v_ref=SIZE + (2.0 + bent(2.0)) / 40, **S),
        dict(
            v=V, v_s=0.0, omega=1.0, v_m=SIZE, x=(2.0 + bent(2.0)) / 40, v_r=2.0 + bent(2.0), e_f=2.0, w=2.0
        ),
        dict(v_f=2.0),
    ),
    (
        Exst1,
        dict(v_ref=SIZE + 2.0 / 80),
        dict(v=V, v_s=0.0, i_f=1.8, v_m=SIZE, x=2.0 / 80, v_r=2.0, w=2.0),
        dict(v_f=2.0),
    ),
    (
        Esst3aRegulator,
        dict(v_ref=SIZE + 1.5 / 50),
        dict(v=V, v_s=0.0, v_m=SIZE, x=1.5 / 50, v_r=1.5),
        dict(v_a=1.5),
    ),
    (Esst3aField, dict(K_M=8.0), dict(v_a=0.5 / 8 + 1.5, v_b=3.0, v_k=0.5), dict(v_f=1.5)),
    (Tgov1, dict(p_ref=0.7), dict(omega=1.0, g=0.7, x=0.7), dict(t_m=0.7, p_set=0.7)),
    (Tgov1N, dict(p_ref=0.7), dict(omega=1.0, g=0.7, x=0.7), dict(t_m=0.7)),
    (
        Ieeeg1,
        dict(p_ref=0.7),
        dict(omega=1.0, x=0.0, g=0.7, y_4=0.7, y_5=0.7, y_6=0.7, y_7=0.7),
        dict(t_m=0.7),
    ),
    (
        Ieeest,
        dict(signal=3.0, share=2.0, A_1=0.1, A_2=0.1, A_4=0.1),
        dict(
            omega=1.0, f=1.0, t_e=0.8, t_m=0.8, p_set=0.8, v=V,
            r_1=0.0, y_1=0.4, r_2=0.0, y_2=0.4, x_1=0.4, x_2=0.4, x_3=4.0,
        ),
        dict(v_s=0.0),
    ),
    (
        St2Cut,
        dict(signal_2=5.0, K_2=2.0),
        dict(
            omega=1.0, f=1.0, t_e=0.8, t_m=0.8, p_set=0.8, v=V,
            y_1=0.0, y_2=2 * SIZE, x_0=2 * SIZE, x_1=0.0, x_2=0.0, x_3=0.0,
        ),
        dict(v_s=0.0),
    ),
]  # fmt: skip


@pytest.mark.parametrize("rest", RESTS, ids=lambda r: r[0].__name__)
def test_nothing_moves_at_the_documented_equilibrium(rest):
    kind, values, given, outputs = rest
    rate, out = at_rest(kind, values, **given)
    assert rate < 1e-12
    for name, value in outputs.items():
        assert float(out[name]) == approx(value, abs=1e-12)


MACHINES = [
    dict(r_a=0.003, x_l=0.2, x_d=1.8, x_q=1.7, x_d1=0.3, x_q1=0.55, x_d2=0.25, x_q2=0.25),
    dict(r_a=0.01, x_l=0.15, x_d=1.8, x_q=1.75, x_d1=0.6, x_q1=0.8, x_d2=0.23, x_q2=0.23, S_A=0.7, S_B=0.4),
]


@pytest.mark.parametrize("values", MACHINES, ids=["linear", "saturated"])
@pytest.mark.parametrize("i", [0.8 - 0.3j, 0.3 + 0.5j, -0.4j])
def test_genrou_rests_in_its_phasor_diagram(values, i):
    m, v = GenRou(**values), 1.02 * np.exp(0.3j)
    states, v_f, t_m = phasor_diagram(m, v, i)
    eq = m.equations(m.at(v=Phasor(v.real, v.imag), v_f=v_f, t_m=t_m, **states))
    assert max(abs(float(side)) for side in eq.der.values()) < 1e-12
    assert complex(eq.out["i"]) == approx(i, abs=1e-12)
    assert float(eq.out["i_f"]) == approx(v_f, abs=1e-12)


def test_genrou_with_saliency_rests_on_its_q_axis():
    m = GenRou(r_a=0.01, x_d2=0.25, x_q2=0.32)
    v, i = 1.02 * np.exp(0.3j), 0.8 - 0.3j
    delta = np.angle(v + complex(m.r_a, m.x_q) * i)
    (v_q, v_d), (i_q, i_d) = (
        ((p * np.exp(-1j * delta)).real, -(p * np.exp(-1j * delta)).imag) for p in (v, i)
    )
    v_f = v_q + m.r_a * i_q + m.x_d * i_d
    states = dict(
        delta=delta,
        omega=1.0,
        e_q1=v_f - (m.x_d - m.x_d1) * i_d,
        e_d1=(m.x_q - m.x_q1) * i_q,
        e_d2=v_f - (m.x_d - m.x_l) * i_d,
        e_q2=(m.x_q - m.x_l) * i_q,
    )
    t_m = v_q * i_q + v_d * i_d + m.r_a * (i_q**2 + i_d**2)
    eq = m.equations(m.at(v=Phasor(v.real, v.imag), v_f=v_f, t_m=t_m, **states))
    assert max(abs(float(side)) for side in eq.der.values()) < 1e-12
    assert complex(eq.out["i"]) == approx(i, abs=1e-12)


def test_gencls_is_a_voltage_behind_a_reactance():
    m, v, i = GenCls(r_a=0.02), 1.02 * np.exp(0.3j), 0.8 - 0.3j
    inner = v + complex(m.r_a, m.x_d1) * i
    t_m = ((v + m.r_a * i) * np.conj(i)).real
    eq = m.equations(
        m.at(v=Phasor(v.real, v.imag), v_f=abs(inner), t_m=t_m, delta=np.angle(inner), omega=1.0)
    )
    assert complex(eq.out["i"]) == approx(i, abs=1e-14)
    assert max(abs(float(side)) for side in eq.der.values()) < 1e-14


# -- closed forms --------------------------------------------------------------------------------------------


def test_a_step_of_the_voltage_meets_the_subtransient_impedance():
    m, v, i = GenRou(**MACHINES[0]), 1.02 * np.exp(0.3j), 0.8 - 0.3j
    states, v_f, t_m = phasor_diagram(m, v, i)
    after = 0.3 * np.exp(0.1j)
    eq = m.equations(m.at(v=Phasor(after.real, after.imag), v_f=v_f, t_m=t_m, **states))
    assert complex(eq.out["i"]) == approx(i + (v - after) / complex(m.r_a, m.x_d2), abs=1e-12)


def test_saturation_passes_through_both_points():
    onset, gain = quadratic(1.0, 0.09, 1.2, 0.38)
    for e, factor in ((1.0, 0.09), (1.2, 0.38)):
        assert gain * (e - onset) ** 2 / e == approx(factor, rel=1e-12)
    assert quadratic(1.0, 0.0, 1.2, 1.0) == (1.0, 0.0)
    assert quadratic(0.0, 0.0, 1.0, 1.0) == (0.0, 0.0)
    # S = 0 at the second point is read as 2, two further on
    onset, gain = quadratic(1.0, 0.1, 1.2, 0.0)
    assert gain * (3.2 - onset) ** 2 / 3.2 == approx(2.0)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (
            (1.0, -0.1, 1.2, 0.3),
            "saturation: S(1) = -0.1 and S(1.2) = 0.3 do not lie on a curve. Give two points with the same "
            "sign, or S = 0 at the first for none.",
        ),
        (
            (1.0, 0.3, 1.0, 0.4),
            "saturation: S(1) = 0.3 and S(1) = 0.4 do not fix a curve. Give two points that differ in E and "
            "in E S(E).",
        ),
    ],
)
def test_saturation_without_a_curve_is_refused(points, message):
    with pytest.raises(InputError) as failure:
        quadratic(*points)
    assert str(failure.value) == message


def test_a_lead_lag_jumps_by_the_ratio_of_its_times():
    sexs = Sexs(K=10.0, T_A=2.0, T_B=8.0, T_E=0.5, v_ref=1.1)
    given = dict(v=Phasor(1.0, 0.0), v_s=0.0, x=0.02, e_f=0.5)
    eq = sexs.equations(sexs.at(**given))
    assert eq.der["x"] == approx(0.1 - 0.02)  # the right side of T_B dx/dt
    assert eq.der["e_f"] == approx(10 * (0.02 + 2 / 8 * 0.08) - 0.5)


def test_limits_of_a_regulator_fed_from_the_bus_fall_with_the_voltage():
    block = Ieeex1BusFed(V_Rmax=5.0)
    given = dict(v=Phasor(0.3, 0.4), v_s=0.0, omega=1.0, v_m=0.5, x=0.0, v_r=4.0, e_f=2.0, w=2.0)
    rate = [block.equations(block.at(mode=mode, **given)).der["e_f"] for mode in ("FREE", "UPPER", "LOWER")]
    assert rate == approx([4.0 - 2.0, 2.5 - 2.0, -3.65 - 2.0])


def test_the_field_of_exdc2_follows_the_speed():
    block = Exdc2()
    given = dict(v=Phasor(1.0, 0.0), v_s=0.0, v_m=1.0, x=0.0, v_r=2.0, e_f=2.0, w=2.0)
    assert block.equations(block.at(omega=1.1, **given)).out["v_f"] == approx(2.2)


def test_exst1_is_limited_by_its_field_current():
    block = Exst1(V_Rmax=8.0, V_Rmin=-3.0, K_C=0.2)
    given = dict(v=Phasor(1.0, 0.0), v_s=0.0, i_f=5.0, v_m=1.0, x=0.0, v_r=9.0, w=2.0)
    for mode, v_f in (("FREE_FREE", 9.0), ("FREE_UPPER", 7.0), ("FREE_LOWER", -4.0)):
        assert block.equations(block.at(mode=mode, **given)).out["v_f"] == approx(v_f)


def test_the_compound_source_adds_voltage_and_current():
    block = CompoundSource(K_P=3.67, theta_P=radians(3.33), K_I=0.435, X_L=0.0098, K_C=0.1, V_Bmax=5.0)
    v, i, i_f = 1.02 * np.exp(0.3j), 0.8 - 0.3j, 2.5
    gain = 3.67 * np.exp(1j * radians(3.33))
    v_e = abs(gain * v + 1j * (0.435 + gain * 0.0098) * i)
    given = dict(v=Phasor(v.real, v.imag), i=Phasor(i.real, i.imag), i_f=i_f)
    assert float(block.equations(block.at(**given)).out["v_b"]) == approx(
        v_e * (1 - 0.577 * 0.1 * i_f / v_e), rel=1e-14
    )
    assert float(block.equations(block.at(mode="UPPER", **given)).out["v_b"]) == 5.0


def test_the_rectifier_falls_in_three_pieces_without_a_step():
    from dcvrt.models.machines.esst3a import rectifier

    for load, printed in ((0.2, 1 - 0.577 * 0.2), (0.6, sqrt(0.75 - 0.36)), (0.9, 1.732 * 0.1)):
        assert float(rectifier(load)) == approx(printed, abs=3e-4)
    fine = np.linspace(-0.2, 1.2, 1401)
    values = np.array([float(rectifier(x)) for x in fine])
    assert (np.diff(values) <= 0).all()
    assert np.abs(np.diff(values)).max() < 2e-3


def test_the_valve_of_ieeeg1_moves_no_faster_than_it_can():
    block = Ieeeg1(p_ref=0.7, U_o=0.1, U_c=-0.2)
    given = dict(omega=0.98, x=0.02, g=0.7, y_4=0.7, y_5=0.6, y_6=0.5, y_7=0.4)
    rates = [block.equations(block.at(mode=mode, **given)).der["g"] for mode in block.modes]
    assert rates == approx([20 * 0.02 / 0.1, 0.1, -0.2, 0.0, 0.0])
    assert block.equations(block.at(**given)).out["t_m"] == approx(0.5 * 0.7 + 0.5 * 0.6)


def test_the_frequency_is_that_of_a_turning_voltage():
    """With the voltage ahead by a constant slip, filter and derivative lag behind by slip times time."""
    meter, slip = BusFrequency(T_f=0.02, T_w=0.1), 2 * pi * 0.5
    angle = 3.1  # just before pi: theta and x lie on the other side of nothing
    theta, x = angle - slip * 0.02, angle - slip * 0.12
    for turn in (0.0, 0.1):  # the second has crossed pi
        v = Phasor.polar(0.8, angle + turn)
        eq = meter.equations(meter.at(v=v, theta=theta + turn, x=x + turn))
        assert float(eq.out["f"]) == approx(1 + 0.5 / 60, rel=1e-12)
        assert float(eq.der["theta"]) / 0.02 == approx(slip, rel=1e-9)
        assert float(eq.der["x"]) / 0.1 == approx(slip, rel=1e-9)


@pytest.mark.parametrize("omega", [0.3, 2.0, 20.0])
def test_a_stabiliser_has_the_frequency_response_of_its_formula(omega):
    """States of a harmonic input are harmonic: the right sides must be j omega times T times the states."""
    block = Ieeest(
        A_1=0.1, A_2=0.02, A_3=0.15, A_4=0.01, A_5=0.3, A_6=0.004, T_1=0.2, T_2=0.03, T_3=0.3, T_4=0.02,
        T_5=3.0, T_6=2.5, K_S=7.0,
    )  # fmt: skip
    s, u = 1j * omega, 1.0
    y1 = u / (1 + 0.1 * s + 0.02 * s**2)
    inner = y1 / (1 + 0.15 * s + 0.01 * s**2)
    y2 = inner * (1 + 0.3 * s + 0.004 * s**2)
    x1 = y2 / (1 + 0.03 * s)
    y3 = x1 * (1 + 0.2 * s)
    x2 = y3 / (1 + 0.02 * s)
    y4 = 7.0 * x2 * (1 + 0.3 * s)
    x3 = y4 / (1 + 2.5 * s)
    states = dict(r_1=s * y1, y_1=y1, r_2=s * inner, y_2=inner, x_1=x1, x_2=x2, x_3=x3)
    times = dict(r_1=1, y_1=1, r_2=1, y_2=1, x_1=0.03, x_2=0.02, x_3=2.5)
    for part in (np.real, np.imag):  # linear: real and imaginary part each obey the equations
        given = {name: float(part(value)) for name, value in states.items()}
        eq = block.equations(
            block.at(omega=1 + float(part(u)), f=1.0, t_e=0.0, t_m=0.0, p_set=0.0, v=V, **given)
        )
        for name, value in states.items():
            assert float(eq.der[name]) == approx(float(part(s * value)) * times[name], abs=1e-9)
        assert float(eq.out["v_s"]) == approx(float(part(3.0 * s * x3)), abs=1e-9)


# -- what is refused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Sexs(E_min=3.0, E_max=-3.0),
            "Sexs: E_min = 3 is above E_max = -3. Exchange or correct them.",
        ),
        (
            lambda: GenRou(x_l=0.302),
            "GenRou: x_d1 and x_l are both 0.302. The equations divide by their difference: make x_l "
            "smaller.",
        ),
        (
            lambda: Ieeest(signal=6.0),
            "Ieeest: signal = 6 is the derivative of the voltage, which has none at a fault. Choose among 0: "
            "none, 1: speed, 2: bus frequency, 3: electrical power, 4: accelerating power, 5: voltage.",
        ),
        (
            lambda: St2Cut(signal_2=1.5),
            "St2Cut: signal_2 = 1.5 is not an input. Choose among 0: none, 1: speed, 2: bus frequency, "
            "3: electrical power, 4: accelerating power, 5: voltage.",
        ),
        (
            lambda: Ieeest(T_6=0.0),
            "Ieeest: T_6 = 0 with T_5 = 5 s makes the washout a pure derivative. Give T_6 a value above 0 s, "
            "or set T_5 = 0 as well.",
        ),
        (
            lambda: machines.esst3a(KA=3.0),
            "esst3a: there is no parameter 'KA'. Did you mean 'K_A'? Known: v_ref, T_R, V_Imin, V_Imax, T_C, "
            "T_B, K_A, T_A, V_Rmin, V_Rmax, K_P, theta_P, ... (22 in all).",
        ),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(InputError) as failure:
        make()
    assert str(failure.value) == message


def test_inputs_are_fed_by_name_in_a_unit():
    """`unit` wires by name: every input of every block has a source."""
    for kind in BLOCKS:
        for name in kind.declared(Input):
            assert name in {
                "v", "i", "delta", "omega", "t_e", "i_f", "v_f", "t_m", "p_set", "v_s", "f", "v_a", "v_b",
            }  # fmt: skip


# -- loads and converters ------------------------------------------------------------------------------------


def power(block, v):
    """Power into the network at a terminal voltage."""
    return complex(v * block.equations(block.at(v=v)).out["i"].conj())


@pytest.mark.parametrize("m", [0.3, 0.69, 0.71, 0.95, 1.1])
def test_loads_take_what_their_forms_say(m):
    v = Phasor.polar(m, 0.4)
    held = max(m, 0.7)
    below = (m / held) ** 2
    exponential = ExponentialLoad(p_0=0.9, q_0=0.4, alpha=1.3, beta=2.4)
    assert power(exponential, v) == approx(-(0.9 * held**1.3 + 0.4j * held**2.4) * below)
    mixed = ZipLoad(p_0=0.9, q_0=0.4, a_z=0.3, a_i=0.3, b_z=0.5, b_i=0.1)
    shape = 0.9 * (0.3 * held**2 + 0.3 * held + 0.4) + 0.4j * (0.5 * held**2 + 0.1 * held + 0.4)
    assert power(mixed, v) == approx(-shape * below)


def test_exponents_two_one_and_zero_are_impedance_current_and_power():
    v = Phasor.polar(0.9, -0.2)
    for exponent, parts in ((2.0, (1.0, 0.0)), (1.0, (0.0, 1.0)), (0.0, (0.0, 0.0))):
        a = ExponentialLoad(p_0=0.9, q_0=0.4, alpha=exponent, beta=exponent)
        b = ZipLoad(p_0=0.9, q_0=0.4, a_z=parts[0], a_i=parts[1], b_z=parts[0], b_i=parts[1])
        assert power(a, v) == approx(power(b, v))


def test_the_converter_rests_at_its_power_and_is_limited_in_a_sag():
    block = CurrentConverter(p_0=0.8, q_0=-0.2, k_max=1.1)
    v = Phasor.polar(1.02, 0.3)
    i = Phasor(0.8, 0.2) * v / v.abs2()
    eq = block.equations(block.at(v=v, i_re=i.re, i_im=i.im))
    assert abs(eq.der["i_re"]) < 1e-3
    assert abs(eq.der["i_im"]) < 1e-3
    low = Phasor.polar(0.4, -0.1)  # what would be asked for is twice what the limit grants
    rate = block.equations(block.at(v=low, i_re=0.0, i_im=0.0)).der
    granted = Phasor(rate["i_re"] * block.T_i, rate["i_im"] * block.T_i)
    size = sqrt(0.8**2 + 0.2**2)
    assert sqrt(granted.abs2()) == approx(1.1 * size, rel=1e-4)
    assert complex(low * granted.conj()).real == approx(0.4 * 1.1 * size, rel=1e-3)  # all of it active
