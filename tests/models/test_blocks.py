"""The blocks: closed forms, equilibria, and for every block one code path on numbers and symbols."""

from __future__ import annotations

import importlib
import pkgutil
from math import atan2, cos, exp, hypot, pi, sin, sqrt

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import models
from dcvrt.models import (
    ActivePriorityLimiter,
    AuxiliaryLoad,
    Bess,
    BessWithLosses,
    Block,
    ContactorCooling,
    Cooling,
    CurrentLag,
    CurrentReference,
    DcEnergyLoop,
    DcLink,
    DriveCooling,
    Droop,
    FacilityLoad,
    ItLoad,
    Parameter,
    Phasor,
    Pll,
    Poi,
    ProtectedBus,
    ReactiveSupport,
    ServerSupply,
    SplitCooling,
    Supervisor,
    TrainingLoad,
    VoltageFilter,
    Vsm,
)
from dcvrt.models.limiter import active_priority
from dcvrt.models.testing import assert_consistent

approx = pytest.approx


def kinds_of(base):
    for kind in base.__subclasses__():
        yield kind
        yield from kinds_of(kind)


for module in pkgutil.walk_packages(models.__path__, f"{models.__name__}."):
    importlib.import_module(module.name)
BLOCKS = sorted(
    {
        kind
        for kind in kinds_of(Block)
        if kind.__module__.startswith(f"{models.__name__}.") and kind.equations is not Block.equations
    },
    key=lambda kind: kind.__name__,
)
"""Every block in the package, whether or not somebody has thought of naming it in `dcvrt.models`."""


@pytest.mark.parametrize("kind", BLOCKS, ids=lambda b: b.__name__)
def test_it_can_be_imported_from_its_package(kind):
    package = importlib.import_module(kind.__module__.rpartition(".")[0])
    assert getattr(package, kind.__name__) is kind
    assert kind.__name__ in package.__all__


@pytest.mark.parametrize("kind", BLOCKS, ids=lambda b: b.__name__)
def test_equations_are_the_same_on_numbers_and_symbols_and_have_their_derivatives(kind):
    assert_consistent(kind())


@pytest.mark.parametrize("kind", BLOCKS, ids=lambda b: b.__name__)
def test_every_symbol_is_documented(kind):
    assert kind.__doc__
    assert kind.__doc__.strip()
    for name, d in kind._declared.items():
        assert d.doc, f"{kind.__name__}.{name} says nothing of its meaning"
        if isinstance(d, Parameter):
            low, high = d.bounds
            assert low <= d.value <= high
            assert np.isfinite([low, high]).all(), f"{kind.__name__}.{name} has no bounds"
            assert d.source != "not stated", f"{kind.__name__}.{name} does not say where its value comes from"


FEEDTHROUGH = {
    Pll: {"omega": {"v"}, "error": {"v"}},
    CurrentReference: {"i": {"v", "delta", "p_c", "q_c"}, "v_dq": {"v", "delta"}},
    ActivePriorityLimiter: {
        "i": {"ask", "v", "share", "w"},
        "i_max": set(),
        "shortfall": {"ask", "v", "share", "w"},
    },
    CurrentLag: {"i": {"delta"}},
    Poi: {"p": {"v", "i"}, "q": {"v", "i"}, "i_mag": {"i"}, "drawn": {"i"}},
    Cooling: {"p": set()},
    DcLink: {"drain": {"p_out"}, "energy": set(), "loss": {"p_out"}},
    DcEnergyLoop: {"p_c": {"w", "p_ref", "v", "share"}, "q_c": {"w", "p_ref", "v", "share"}},
    Vsm: {"i": {"v"}, "v_dq": {"v"}, "error": {"v"}},
    Droop: {
        "i": {"v", "q_c"},
        "v_dq": {"v"},
        "error": {"v"},
        "omega": {"p_c", "shortfall", "resync"},
        "E": {"q_c"},
    },
    DriveCooling: {
        "p": set(),
        "i": {"v"},
        "i_max": set(),
        "demand": set(),
        "energy": set(),
        "loss": set(),
        "mode": set(),
    },
    ContactorCooling: {"p": set(), "demand": set(), "mode": set()},
    SplitCooling: {"p": set()},
    TrainingLoad: {"p": {"g_it"}},
    ReactiveSupport: {"q": {"q_c", "v_f"}},
    BessWithLosses: {"energy": set(), "loss": set()},
    Supervisor: {
        "share": set(),
        "assist": set(),
        "charge": set(),
        "trim": set(),
        "resync": set(),
        "mode": set(),
    },
}


@pytest.mark.parametrize("kind", FEEDTHROUGH, ids=lambda b: b.__name__)
def test_outputs_depend_on_the_inputs_that_the_equations_show(kind):
    assert {name: set(inputs) for name, inputs in kind().feedthrough().items()} == FEEDTHROUGH[kind]


# ---- grid side ------------------------------------------------------------------------------------------


def test_pll_is_at_rest_when_locked():
    pll = Pll()
    eq = pll.equations(pll.at(v=Phasor.polar(0.8, 0.3), delta=0.3, xi=0.0))
    assert eq.der == {"xi": approx(0.0), "delta": approx(0.0)}
    assert pll.rest(pll.at(v=Phasor.polar(0.8, 0.3))) == {"xi": 0.0, "delta": approx(0.3)}


def test_pll_coasts_when_the_voltage_is_gone():
    pll = Pll()
    eq = pll.equations(pll.at(v=Phasor(0.0, 0.0), delta=1.0, xi=0.01))
    assert eq.der["xi"] == 0.0
    assert eq.der["delta"] == approx(pll.K_i * 0.01)


@pytest.mark.parametrize("voltage", [1.0, 0.5])
def test_pll_has_the_eigenvalues_of_its_closed_form(voltage):
    pll, s = Pll(), None
    s = pll.symbols("pll")
    eq = pll.equations(s)
    a = ca.jacobian(ca.vertcat(eq.der["xi"], eq.der["delta"]), ca.vertcat(s.xi, s.delta))
    f = ca.Function("A", [s.v.re, s.v.im, s.xi, s.delta, s.K_p, s.K_i], [a])
    eigenvalues = np.linalg.eigvals(np.array(f(voltage, 0, 0, 0, pll.K_p, pll.K_i)))
    omega_n, zeta = sqrt(pll.K_i * voltage), pll.K_p / 2 * sqrt(voltage / pll.K_i)
    assert np.abs(eigenvalues) == approx(omega_n)
    assert -eigenvalues.real / np.abs(eigenvalues) == approx(zeta)


def test_current_reference_draws_the_commanded_power_from_any_angle():
    ref = CurrentReference(V_eps=0.1, eps=1e-6)
    for angle in (0.0, 2.0, -3.0):
        v = Phasor.polar(0.8, angle)
        out = ref.equations(ref.at(v=v, delta=0.3, p_c=0.7, q_c=0.2)).out
        assert complex(out["v_dq"] * out["i"].conj()) == approx(complex(0.7, 0.2), abs=1e-9)
        assert complex(out["v_dq"]) == approx(complex(v.turn(-0.3)))


def test_current_reference_falls_below_the_voltage_floor():
    ref = CurrentReference(V_eps=0.1, eps=1e-6)
    i = ref.equations(ref.at(v=Phasor(0.05, 0.0), delta=0.0, p_c=1.0, q_c=0.0)).out["i"]
    assert complex(i) == approx(0.05 / 0.01, rel=1e-4)


unit = st.floats(-3, 3)


@given(unit, unit, unit, unit, st.floats(0, 2), st.floats(0, 1), st.sampled_from([1e-2, 1e-3, 1e-4]))
def test_limiter_never_exceeds_its_limit(i_re, i_im, v_re, v_im, i_max, share, eps):
    i = active_priority(Phasor(i_re, i_im), Phasor(v_re, v_im), i_max, (0.0, share * i_max), eps, 1e-3)
    assert hypot(i.re, i.im) <= i_max * (1 + 1e-12)


def test_limiter_keeps_active_current_and_sheds_reactive():
    i = active_priority(Phasor(0.9, -0.8), Phasor(1.0, 0.0), 1.0, (-1.0, 1.0), 1e-6, 1e-6)
    assert complex(i) == approx(complex(0.9, -sqrt(1 - 0.81)), abs=1e-5)
    i = active_priority(Phasor(1.3, -0.8), Phasor(1.0, 0.0), 1.0, (-1.0, 1.0), 1e-6, 1e-6)
    assert complex(i) == approx(1.0, abs=2e-3)


@given(st.floats(-pi, pi), st.floats(-pi, pi), st.floats(0.1, 1.2))
def test_limiter_does_not_care_for_the_frame(turn, angle, voltage):
    ask, v = Phasor.polar(1.4, 0.4), Phasor.polar(voltage, angle)
    here = active_priority(ask, v, 1.1, (0.0, 1.1), 1e-3, 1e-3).turn(turn)
    there = active_priority(ask.turn(turn), v.turn(turn), 1.1, (0.0, 1.1), 1e-3, 1e-3)
    assert complex(here) == approx(complex(there), abs=1e-12)


@given(st.floats(0.05, 1.1), st.floats(0, 2.0), st.floats(-2.0, 2.0))
def test_limiter_grants_the_closed_form(voltage, p_ref, q_ref):
    """P = min(P_ref, V I), |Q| <= sqrt((V I)^2 - P^2)."""
    i_max, v = 1.1, Phasor(voltage, 0.0)
    ask = (Phasor(p_ref, q_ref) / v).conj()
    power = v * active_priority(ask, v, i_max, (0.0, i_max), 1e-5, 1e-6).conj()
    top = voltage * i_max
    assert power.re == approx(min(p_ref, top), abs=1e-4)
    assert abs(power.im) <= sqrt(max(top**2 - power.re**2, 0.0)) + 1e-9
    assert abs(power.im) == approx(min(abs(q_ref), sqrt(max(top**2 - power.re**2, 0.0))), abs=2e-4)


def test_limiter_blocks_without_voltage_and_when_uncoupled():
    lim = ActivePriorityLimiter()
    away = lim.equations(lim.at(ask=Phasor(1.0, 0.3), v=Phasor(0.0, 0.0), share=1.0, w=1.0)).out
    assert complex(away["i"]) == 0
    battery = lim.equations(lim.at(ask=Phasor(1.0, 0.3), v=Phasor(1.0, 0.0), share=0.0, w=1.0)).out
    assert complex(battery["i"]) == 0
    assert battery["i_max"] == approx(1.15)
    assert battery["shortfall"] == approx(1.0, abs=1e-5)


def test_limiter_closes_the_import_of_a_full_dc_link_and_leaves_the_room_to_reactive_current():
    lim = ActivePriorityLimiter(beta=1.0)
    i = lim.equations(lim.at(ask=Phasor(1.0, -1.0), v=Phasor(1.0, 0.0), share=1.0, w=1.3)).out["i"]
    assert complex(i) == approx(-1j, abs=2e-3)


def test_current_lag_rests_at_its_reference_and_turns_with_its_frame():
    lag = CurrentLag(tau=0.01)
    eq = lag.equations(lag.at(ask=Phasor(0.9, -0.2), delta=pi / 2, i_d=0.5, i_q=-0.2))
    assert eq.der == {"i_d": approx(40.0), "i_q": approx(0.0)}
    assert complex(eq.out["i"]) == approx(complex(0.2, 0.5))


def test_poi_measures_import_positive():
    poi = Poi()
    out = poi.equations(poi.at(v=Phasor(1.0, 0.0), i=Phasor(0.8, -0.3))).out
    assert (out["p"], out["q"], out["i_mag"]) == (approx(0.8), approx(0.3), approx(hypot(0.8, 0.3)))


def test_voltage_filter_rests_at_the_magnitude():
    meter = VoltageFilter(T=0.01)
    assert meter.equations(meter.at(v=Phasor(0.6, -0.8), v_f=1.0)).der["v_f"] == approx(0.0, abs=1e-5)
    assert meter.equations(meter.at(v=Phasor(0.0, 0.0), v_f=1.0)).der["v_f"] == approx(-100.0, rel=1e-3)


# ---- grid-forming ---------------------------------------------------------------------------------------


def vsm_at_rest(p=0.9, q=0.2, v=None, **changes):
    vsm = Vsm(**changes)
    v = v or Phasor.polar(0.95, 0.7)
    values = dict(v=v, p_c=p, q_c=q, p_g=p, q_g=q, shortfall=-0.3, resync=0.0, trim=1.0)
    return vsm, values, values | vsm.rest(vsm.at(**values))


def test_vsm_rests_where_its_current_draws_the_commanded_power():
    vsm, _, at = vsm_at_rest()
    eq = vsm.equations(vsm.at(**at))
    assert complex(eq.out["v_dq"] * eq.out["i"].conj()) == approx(complex(0.9, 0.2), abs=1e-12)
    # the smooth clip of E* is off by eps^2/4 over its distance to the bounds, seen through tau_E
    slack = vsm.eps**2 / 0.2 / vsm.tau_E
    assert eq.der == {k: approx(0.0, abs=slack) for k in ("omega", "delta", "E", "E_0")}


def test_vsm_phasor_diagram():
    """E = V - Z_v I, by complex numbers of Python."""
    vsm, _, at = vsm_at_rest()
    v = complex(at["v"])
    internal = v - complex(vsm.R_v, vsm.X_v) * (complex(0.9, 0.2) / v).conjugate()
    assert at["E"] == approx(abs(internal))
    assert at["delta"] == approx(atan2(internal.imag, internal.real))


def test_vsm_swings_as_its_closed_form():
    """Eigenvalues of the swing with the current followed at once: 2 H_v s^2 + D s + omega_B K = 0."""
    vsm, _, at = vsm_at_rest(q=0.0, R_v=0.0, v=Phasor(1.0, 0.0))
    omega_B = 2 * pi * 60.0
    K = at["E"] * cos(at["delta"]) / vsm.X_v
    h = 1e-6

    def rate(delta, omega):
        s = at | dict(delta=delta, omega=omega)
        out = vsm.equations(vsm.at(**s)).out
        s["p_g"] = (out["v_dq"] * out["i"].conj()).re
        der = vsm.equations(vsm.at(**s)).der
        return np.array([der["delta"], der["omega"]])

    base = at["delta"]
    a = np.array(
        [
            (rate(base + h, 1.0) - rate(base - h, 1.0)) / (2 * h),
            (rate(base, 1.0 + h) - rate(base, 1.0 - h)) / (2 * h),
        ]
    ).T
    expected = np.roots([2 * vsm.H_v, vsm.D, omega_B * K])
    assert np.sort_complex(np.linalg.eigvals(a)) == approx(np.sort_complex(expected), rel=1e-5)


def test_vsm_matches_power_only_where_the_command_cannot_be_met():
    vsm, _, at = vsm_at_rest()
    rate = lambda **changes: vsm.equations(vsm.at(**(at | changes))).der["omega"]  # noqa: E731
    free = rate(p_g=0.5, shortfall=-0.3)
    assert free == approx((0.5 - 0.9) / (2 * vsm.H_v), rel=1e-3)
    assert rate(p_g=0.5, shortfall=0.3) == approx(0.0, abs=1e-3 * abs(free))
    assert rate(p_g=1.2, shortfall=0.3) == approx((1.2 - 0.9) / (2 * vsm.H_v), rel=1e-3)
    assert rate(p_g=0.0, resync=1.0) == approx(0.0, abs=1e-9)


def test_vsm_turns_onto_the_grid_voltage_while_it_resynchronises():
    vsm, _, at = vsm_at_rest()
    der = vsm.equations(vsm.at(**(at | dict(delta=0.2, resync=1.0)))).der
    assert der["delta"] == approx(vsm.K_s * 0.95 * sin(0.5))


def test_vsm_droop_raises_the_voltage_when_too_much_reactive_power_is_drawn():
    vsm, _, at = vsm_at_rest()
    der = vsm.equations(vsm.at(**(at | dict(q_g=0.4)))).der
    assert der["E"] == approx(vsm.K_Q * 0.2 / vsm.tau_E, rel=1e-3)


# ---- direct-current side --------------------------------------------------------------------------------


def test_dc_link_balances_power():
    dc = DcLink(T_hold=0.03)
    rate = lambda **v: dc.equations(dc.at(w=1.0, **v)).der["w"]  # noqa: E731
    assert rate(p_g=0.7, p_b=0.2, p_out=0.9) == approx(0.0)
    # hold-up: with nothing coming in, energy lasts T_hold at full load
    assert rate(p_g=0.0, p_b=0.0, p_out=1.0) == approx(-1 / 0.03)


def test_dc_link_draws_losses_on_top():
    dc = DcLink(eta=0.9)
    eq = dc.equations(dc.at(w=1.0, p_g=1.0, p_b=0.0, p_out=0.9))
    assert eq.out["drain"] == approx(1.0)
    assert eq.der["w"] == approx(0.0)


def loop_at(**changes):
    loop = DcEnergyLoop(eps=1e-6)
    values = dict(w=1.0, xi=0.0, p_ref=0.9, v=Phasor(1.0, 0.0), share=1.0, steady=1.0) | changes
    return loop, loop.equations(loop.at(**values))


def test_dc_loop_rests_at_its_feedforward_with_the_power_factor():
    loop, eq = loop_at()
    assert eq.der["xi"] == approx(0.0)
    assert eq.out["p_c"] == approx(0.9)
    assert eq.out["p_c"] / hypot(eq.out["p_c"], eq.out["q_c"]) == approx(loop.pf, abs=1e-6)


def test_dc_loop_adds_proportional_and_integral_action():
    loop, eq = loop_at(w=0.98, xi=0.005)
    assert eq.out["p_c"] == approx(0.9 + loop.K_p * 0.02 + loop.K_i * 0.005)
    assert eq.der["xi"] == approx(0.02)


def test_dc_loop_is_held_within_what_can_be_imported():
    assert loop_at(w=0.5)[1].out["p_c"] == approx(1.15)
    assert loop_at(w=0.9, v=Phasor(0.3, 0.4))[1].out["p_c"] == approx(0.575, abs=1e-5)
    assert loop_at(w=1.4)[1].out["p_c"] == approx(0.0, abs=1e-6)
    assert loop_at(share=0.0)[1].out["p_c"] == 0.0


def test_dc_loop_integral_stops_only_where_it_would_wind_up():
    assert loop_at(w=0.8)[1].der["xi"] == approx(0.0, abs=1e-9)  # wants more, gets no more
    assert loop_at(w=1.4)[1].der["xi"] == approx(0.0, abs=1e-9)  # wants less than nothing
    assert loop_at(w=1.01, xi=0.5)[1].der["xi"] == approx(-0.01)  # limited above, but unwinding
    assert loop_at(w=0.9, steady=0.0)[1].der["xi"] == 0.0  # while the battery makes up the balance it holds


def bess_rates(**changes):
    bess = Bess(eps=1e-6)
    values = dict(w=1.0, drain=0.9, p_g=0.9, assist=0.0, charge=1.0, p=0.0, soc=0.8) | changes
    return bess, bess.equations(bess.at(**values)).der


def test_bess_rests_when_nothing_is_missing():
    assert bess_rates()[1] == {"p": approx(0.0, abs=1e-9), "soc": 0.0}


def test_bess_supports_beyond_its_deadband():
    bess, der = bess_rates(w=0.92, charge=0.0)
    assert der["p"] * bess.T_b == approx(bess.K_b * 0.05, rel=1e-4)
    assert bess_rates(w=0.98, charge=0.0)[1]["p"] == approx(0.0, abs=1e-4)


def test_bess_feeds_the_mismatch_forward_when_told():
    bess, der = bess_rates(p_g=0.4, assist=1.0, charge=0.0)
    assert der["p"] * bess.T_b == approx(0.5, rel=1e-4)


def test_bess_keeps_its_limits():
    bess, der = bess_rates(w=0.5, assist=1.0, p_g=0.0)
    assert der["p"] * bess.T_b == approx(bess.P_dis, rel=1e-4)
    assert bess_rates(w=1.4)[1]["p"] * bess.T_b == approx(-bess.P_ch, rel=1e-4)
    assert bess_rates(w=0.5, soc=0.09)[1]["p"] * bess.T_b == approx(0.0, abs=1e-4)
    assert bess_rates(w=1.4, soc=0.96)[1]["p"] * bess.T_b == approx(0.0, abs=1e-4)


def test_bess_charge_counts_energy():
    bess, der = bess_rates(p=0.9)
    assert der["soc"] == approx(-0.9 / bess.T_E)


def test_bess_recharges_slowly():
    bess, der = bess_rates(soc=0.79)
    assert der["p"] * bess.T_b == approx(-bess.K_c * 0.01, rel=1e-3)


# ---- load side ------------------------------------------------------------------------------------------


def test_loads_add_up_to_the_demand():
    it, aux, cooling, total = ItLoad(share=0.7), AuxiliaryLoad(share=0.1), Cooling(share=0.2), FacilityLoad()
    p_it = it.equations(it.at(g_it=1.1)).out["p"]
    p_cool = cooling.equations(cooling.at(g_it=1.1, g=1.0)).out["p"]
    p_aux = aux.equations(aux.at()).out["p"]
    out = total.equations(total.at(it_demand=p_it, it=0.5 * p_it, cooling=p_cool, auxiliary=p_aux)).out
    assert out["demand"] == approx(0.77 + 0.2 + 0.1)
    assert out["p"] == approx(0.385 + 0.2 + 0.1)


def test_server_supply_is_constant_power_above_and_quadratic_below():
    psu = ServerSupply(eps=1e-6)
    power = lambda v: psu.equations(psu.at(demand=0.8, v_it=v)).out["p"]  # noqa: E731
    assert power(1.0) == approx(0.8)
    assert power(0.9) == approx(0.8)
    assert power(0.425) == approx(0.8 / 4)
    assert power(0.0) == approx(0.0, abs=1e-9)


def test_cooling_step_is_the_exponential():
    cooling = Cooling(T=30.0, rho=0.6)
    rate = lambda g: cooling.equations(cooling.at(g_it=1.2, g=g)).der["g"]  # noqa: E731
    closed = lambda t: 1 + 0.6 * 0.2 * (1 - exp(-t / 30.0))  # noqa: E731
    for t in (0.0, 10.0, 60.0):
        h = 1e-4
        assert rate(closed(t)) == approx((closed(t + h) - closed(t - h)) / (2 * h), abs=1e-9)
    assert rate(cooling.rest(cooling.at(g_it=1.2))["g"]) == approx(0.0)


def bus_target(**changes):
    bus = ProtectedBus(eps=1e-6, eps_s=1e-6)
    values = dict(w=1.0, v_f=1.0, p_out=0.95, v=0.0) | changes
    return bus, bus.equations(bus.at(**values)).der["v"] * bus.T_v


def test_protected_bus_takes_the_least_of_its_three_limits():
    bus, target = bus_target()
    assert target == approx(1.0, abs=1e-5)
    assert bus_target(v_f=0.4)[1] == approx(1 - bus.k_line * 0.6, abs=1e-5)
    assert bus_target(p_out=1.4)[1] == approx(1.15 * bus.pf / 1.4, rel=1e-4)
    assert bus_target(w=0.5)[1] == approx(bus.m_max * sqrt(0.5), rel=1e-4)


# ---- supervisor -----------------------------------------------------------------------------------------


def test_supervisor_sets_what_each_mode_means():
    sup = Supervisor()
    out = {m: sup.equations(sup.at(mode=m, clock=0.1, v_f=1.0, w=1.0, error=0.0)).out for m in sup.modes}
    assert [out[m]["mode"] for m in sup.modes] == [0, 1, 2, 3]
    assert [out[m]["share"] for m in sup.modes] == [1, 1, 0, approx(0.1 / sup.T_ramp)]
    assert [out[m]["assist"] for m in sup.modes] == [0, 1, 1, 1]
    assert [out[m]["charge"] for m in sup.modes] == [1, 0, 0, 0]
    assert [out[m]["resync"] for m in sup.modes] == [0, 0, 1, 0]


def test_the_ramp_ends_where_normal_begins():
    sup = Supervisor(T_ramp=0.7)
    end = sup.equations(sup.at(mode="RETURN", clock=0.7)).out["share"]
    assert end == approx(sup.equations(sup.at(mode="NORMAL")).out["share"])
