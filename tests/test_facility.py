"""The facility variants as whole systems: rest, stability, faults, balances."""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.errors import InputError
from dcvrt.models import Cooling, Diagram, Phasor, Pll
from tests.models.ride import System, ride, sag

VARIANTS = ("gfl", "gfm")
OUTPUTS = (
    "v_it",
    "p_g",
    "q_g",
    "i_g",
    "i_max",
    "p_b",
    "soc",
    "w_dc",
    "p_load",
    "p_out",
    "p_it",
    "p_cool",
    "mode",
    "stored",
    "p_loss",
    "i.re",
    "i.im",
)
SYSTEMS = {name: System(facility.get(name).compile()) for name in VARIANTS}


def system(name: str, **changes: float) -> System:
    return SYSTEMS[name].set(**changes)


def volts(magnitude: float, angle: float = 0.0, g_it: float = 1.0) -> np.ndarray:
    return np.array([magnitude * np.cos(angle), magnitude * np.sin(angle), g_it])


def outputs(s: System, x: np.ndarray, u: np.ndarray) -> dict[str, float]:
    return dict(zip(s.dae.y_names, s.out(x, u, "NORMAL"), strict=True))


# ---- what a variant is ----------------------------------------------------------------------------------


def test_names_and_get():
    assert set(VARIANTS) <= set(facility.names())
    assert facility.get("gfm").name == "gfm"
    with pytest.raises(InputError) as error:
        facility.get("gfl2")
    known = ", ".join(facility.names())
    assert str(error.value) == f"there is no facility variant 'gfl2'. Did you mean 'gfl'? Known: {known}."


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_has_the_fixed_names(name):
    dae = SYSTEMS[name].dae
    assert dae.u_names == ("v_poi.re", "v_poi.im", "g_it")
    assert [row.value for row in dae.inputs] == [1.0, 0.0, 1.0]
    assert dae.y_names == OUTPUTS
    assert dae.p_names[:4] == ("H", "beta", "d", "pf")
    assert dae.automata[0].modes == ("NORMAL", "MIXED", "BATTERY", "RETURN")
    assert dae.z.numel() == 0
    assert len(dae.states) <= 15


@pytest.mark.parametrize("name", VARIANTS)
def test_every_parameter_says_where_it_comes_from(name):
    for row in SYSTEMS[name].dae.parameters:
        assert row.doc, row.path
        assert row.source not in ("", "not stated"), row.path
        assert row.bounds[0] <= row.value <= row.bounds[1], row.path


def test_states_that_end_a_run_say_what_it_means():
    bounded = {row.path: row for row in SYSTEMS["gfl"].dae.states if np.isfinite(row.bounds).any()}
    assert set(bounded) == {"dc.w", "bess.soc"}
    assert "link collapsed" in bounded["dc.w"].crossing
    assert "over-voltage" in bounded["dc.w"].crossing


def test_the_modes_differ_in_the_grid_facing_blocks_and_two_gains_only():
    gfl, gfm = (SYSTEMS[name].dae.parameters for name in VARIANTS)
    own = ("pll.", "ref.", "vsm.")
    common = {r.path: r for r in gfl if not r.path.startswith(own)}
    other = {r.path: r for r in gfm if not r.path.startswith(own)}
    assert common.keys() == other.keys()
    different = {path for path in common if common[path].value != other[path].value}
    assert different == {"dc_loop.K_p", "dc_loop.K_i"}
    assert all("unstable" in other[path].source for path in different)


def test_a_variant_can_be_changed_before_it_is_compiled():
    f = facility.gfm()
    f.replace("cooling", Cooling(T=120.0, rho=0.8))
    f.set("vsm.H_v", 1.0)
    dae = f.compile()
    values = dict(zip(dae.p_names, dae.parameter_values(), strict=True))
    assert (values["cooling.T"], values["cooling.rho"], values["vsm.H_v"]) == (120.0, 0.8, 1.0)
    assert "cooling.H" not in values  # the binding to H stayed


def test_a_diagram_is_wired_from_nothing():
    d = Diagram("mine")
    d.parameter("H", 1.0, "pu(S)")
    v = d.input("v_poi", "pu(V)", Phasor)
    pll = d.add("pll", Pll(K_p=60.0, K_i=1400.0))
    d.connect(v, pll.v)
    d.output("omega", pll.omega)
    dae = d.compile()
    assert dae.y_names == ("omega",)
    lines = str(dae.parameters).splitlines()
    assert lines[0].split() == ["parameter", "value", "unit", "bounds", "meaning", "source"]
    assert "proportional gain" in lines[2]
    assert lines[2].endswith("set by the user")


def test_the_sheet_shows_equations_parameters_modes_and_deviations():
    text = facility.gfl().sheet()
    assert "| `beta` | 1.15 | 1 | [0.8, 2] | converter rating over H | illustrative |" in text
    assert "| MIXED | BATTERY | v_f < V_deep | T_deep |" in text
    assert r"\dot\delta = K_p e + K_i \xi" in text
    assert "## Where it differs from the paper" in text
    assert text.count("**Differs:**") == text.split("## Where it differs")[1].count("- **")
    assert ".. math::" not in text
    assert ":math:" not in text


# ---- rest -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VARIANTS)
@settings(max_examples=60)
@given(
    voltage=st.floats(0.85, 1.1),
    angle=st.floats(-3.1, 3.1),
    d=st.floats(0.3, 1.0),
    reserve=st.floats(1.01, 1.6),
    g_it=st.floats(0.8, 1.05),
)
def test_an_equilibrium_is_found_wherever_the_demand_can_be_imported(name, voltage, angle, d, reserve, g_it):
    """`reserve` is beta V0 over the demand; near 1 the limiter is active before anything happens."""
    demand = d * (g_it / 1.3 + (1 - 1 / 1.3) * (0.74 * (1 + 0.6 * (g_it - 1)) + 0.26))
    beta = min(max(reserve * demand / voltage, 0.8), 2.0)
    s, u = system(name, beta=beta, d=d), volts(voltage, angle, g_it)
    x = s.equilibrium(u)
    y = outputs(s, x, u)
    assert y["p_load"] == pytest.approx(demand)
    assert y["p_g"] == pytest.approx(y["p_out"], abs=1e-8)
    assert y["w_dc"] == pytest.approx(1.0, abs=0.03)
    assert y["soc"] == pytest.approx(0.8, abs=0.02)
    assert y["i_g"] <= beta + 1e-6
    # reactive power: the load's power factor, or what the current limit leaves
    wanted = demand * np.sqrt(1 / 0.98**2 - 1)
    room = np.sqrt(max((beta * voltage) ** 2 - demand**2, 0.0))
    assert y["q_g"] == pytest.approx(min(wanted, room), abs=0.015)


@settings(max_examples=40)
@given(st.floats(0.9, 1.08), st.floats(-3, 3), st.floats(0.3, 1.0), st.floats(1.0, 1.5))
def test_both_modes_rest_at_the_same_point(voltage, angle, d, beta):
    if beta * voltage < 1.02 * d:
        return
    u = volts(voltage, angle)
    y = []
    for name in VARIANTS:
        s = system(name, beta=beta, d=d)
        y.append(s.out(s.equilibrium(u), u, "NORMAL"))
    np.testing.assert_allclose(*y, atol=2e-3)


@pytest.mark.parametrize("name", VARIANTS)
def test_rest_is_stable_over_the_operating_range(name):
    for beta, d, voltage in product((1.0, 1.1, 1.3, 1.5), (0.4, 0.7, 1.0), (0.9, 0.95, 1.0, 1.05)):
        if beta * voltage <= 1.01 * d:
            continue
        s, u = system(name, beta=beta, d=d), volts(voltage)
        eigenvalues = np.linalg.eigvals(s.matrix(s.equilibrium(u), u, "NORMAL"))
        assert eigenvalues.real.max() < -0.01
        swings = eigenvalues[np.abs(eigenvalues) > 3.0]
        assert (-swings.real / np.abs(swings)).min() > 0.3


def test_the_grid_following_gain_would_not_be_stable_in_grid_forming_mode():
    """Why two gains differ between the modes."""
    s, u = system("gfm", **{"dc_loop.K_p": 4.0, "dc_loop.K_i": 20.0}), volts(1.0)
    assert np.linalg.eigvals(s.matrix(s.equilibrium(u), u, "NORMAL")).real.max() > 1.0


@pytest.mark.parametrize("name", VARIANTS)
def test_rest_stays_at_rest(name):
    r = ride(system(name), lambda t: 0.97 * np.exp(0.5j), (), 1.0, step=0.05, rtol=1e-11)
    assert np.ptp(r.x, axis=0).max() < 1e-8
    assert r.walk == ["NORMAL"]


@pytest.mark.parametrize("name", VARIANTS)
@settings(max_examples=30)
@given(h=st.floats(0.01, 50.0), seed=st.integers(0, 1000))
def test_everything_scales_with_the_hosted_capacity(name, h, seed):
    """Powers and currents times h, all else the same: exactly, smoothing included."""
    s = system(name, H=1.0)
    rng = np.random.default_rng(seed)
    x = s.equilibrium(volts(1.0)) + 0.1 * rng.standard_normal(s.dae.x.numel())
    u = volts(rng.uniform(0, 1.1), rng.uniform(-0.5, 0.5))
    scale = np.array([h if row.unit in ("pu(S)", "pu(I)", "pu(S) s") else 1.0 for row in s.dae.states])
    mode = str(rng.choice(s.automaton.modes))
    small, y_small = s.rate(x, u, mode, 0.1), s.out(x, u, mode, 0.1)
    big = system(name, H=h)
    scale_y = np.array([h if row.unit in ("pu(S)", "pu(I)", "pu(S) s") else 1.0 for row in s.dae.outputs])
    np.testing.assert_allclose(
        big.rate(scale * x, u, mode, 0.1), scale * small, rtol=1e-9, atol=1e-9 * max(h, 1)
    )
    current = s.dae.y_names.index("i_g")  # rounded at 0 by a fixed width
    np.testing.assert_allclose(
        np.delete(big.out(scale * x, u, mode, 0.1), current),
        np.delete(scale_y * y_small, current),
        rtol=1e-9,
        atol=1e-12,
    )


# ---- faults ---------------------------------------------------------------------------------------------

CASES = [
    # retained voltage, phase jump in the sag (rad)
    (0.85, 0.0), (0.7, 0.0), (0.5, 0.0), (0.2, 0.0), (0.0, 0.0), (0.7, -0.3), (0.7, 0.3),
]  # fmt: skip


@pytest.fixture(scope="module")
def rides():
    """Each case once for each variant: 100 ms sag at beta 1.15, d 0.95."""
    done = {}
    for name, (retained, jump) in product(VARIANTS, CASES):
        voltage, jumps = sag(retained, jump=jump)
        done[name, retained, jump] = ride(system(name), voltage, jumps, 2.0, step=2e-3, rtol=1e-6)
    return done


EVERY = [(name, *case) for name, case in product(VARIANTS, CASES)]


@pytest.mark.parametrize("case", EVERY, ids=str)
def test_a_sag_is_ridden_through_and_left_behind(rides, case):
    r = rides[case]
    assert np.isfinite(r.x).all()
    assert r.walk[-1] == "NORMAL"
    for name, tolerance in (("p_g", 0.03), ("w_dc", 0.02), ("v_it", 1e-3)):
        assert r.y[name][-1] == pytest.approx(r.y[name][0], abs=tolerance)
    low, high = next(row.bounds for row in SYSTEMS["gfl"].dae.states if row.path == "dc.w")
    assert low < r.y["w_dc"].min()
    assert r.y["w_dc"].max() < high


@pytest.mark.parametrize("case", EVERY, ids=str)
def test_the_current_never_exceeds_the_rating(rides, case):
    y = rides[case].y
    assert (y["i_g"] / y["i_max"]).max() <= 1 + 1e-6


@pytest.mark.parametrize("case", EVERY, ids=str)
def test_energy_is_conserved(rides, case):
    """Stored = in - out, in the DC link and in the battery, by independent quadrature of the outputs."""
    r = rides[case]
    s = SYSTEMS[case[0]]
    values = dict(zip(s.dae.p_names, s.dae.parameter_values(), strict=True))
    weights = np.diff(r.t)

    def integral(y):
        return np.concatenate([[0.0], np.cumsum((y[1:] + y[:-1]) / 2 * weights)])

    out_of_battery = values["bess.T_E"] * (r.y["soc"][0] - r.y["soc"])
    np.testing.assert_allclose(out_of_battery, integral(r.y["p_b"]), atol=2e-3)
    stored = values["dc.T_hold"] * (r.y["w_dc"] - r.y["w_dc"][0])
    balance = integral(r.y["p_g"] + r.y["p_b"] - r.y["p_out"])
    np.testing.assert_allclose(stored, balance, atol=3e-3)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("retained", [0.0, 0.2])
def test_a_deep_dip_walks_through_the_four_regions(rides, name, retained):
    r = rides[name, retained, 0.0]
    assert r.walk == ["NORMAL", "MIXED", "BATTERY", "RETURN", "NORMAL"]
    times = dict(zip(r.walk[1:], [t for t, _ in r.modes[1:]], strict=True))
    assert 0.02 < times["BATTERY"] - 0.1 < 0.03  # T_deep after the measured voltage passed V_deep
    assert times["RETURN"] - 0.2 > 0.4  # T_stable of healthy voltage
    assert times["NORMAL"] - times["RETURN"] == pytest.approx(0.5, abs=5e-3)  # T_ramp
    on_battery = (r.t > times["BATTERY"] + 0.05) & (r.t < times["RETURN"])
    assert np.abs(r.y["p_g"][on_battery]).max() < 1e-3
    assert r.y["p_b"][on_battery] == pytest.approx(r.y["p_out"][on_battery], abs=0.05)


@pytest.mark.parametrize("retained", [0.85, 0.7])
def test_a_sag_that_the_rating_covers_never_visits_battery(rides, retained):
    for name in VARIANTS:
        assert rides[name, retained, 0.0].walk == ["NORMAL", "MIXED", "NORMAL"]


@pytest.mark.parametrize(
    ("retained", "beta", "d"), [(0.7, 1.15, 0.95), (0.6, 1.3, 0.9), (0.8, 1.0, 0.9), (0.9, 1.2, 0.95)]
)
def test_import_in_a_sag_follows_the_static_law(retained, beta, d):
    """P_POI / P_load = min(1, beta V / d): what a current limit with active priority lets through."""
    voltage, jumps = sag(retained)
    r = ride(system("gfl", beta=beta, d=d), voltage, jumps, 0.2, step=2e-3, rtol=1e-6)
    late = r.y["p_g"][(r.t > 0.17) & (r.t < 0.2)] / d
    assert late == pytest.approx(min(1.0, beta * retained / d), abs=0.035)
    assert late.min() >= min(1.0, beta * retained / d) - 0.003


def test_the_loss_of_both_modes_settles_at_the_same_value(rides):
    for retained in (0.85, 0.7):
        late = [
            rides[n, retained, 0.0].y["p_g"][np.searchsorted(rides[n, retained, 0.0].t, 0.195)]
            for n in VARIANTS
        ]
        assert late[0] == pytest.approx(late[1], abs=0.06)


def test_more_rating_never_imports_less_while_the_modes_stay_the_same():
    voltage, jumps = sag(0.65)
    imports, walks = [], []
    for beta in (1.0, 1.1, 1.2, 1.3, 1.4):
        r = ride(system("gfl", beta=beta), voltage, jumps, 0.2, step=2e-3, rtol=1e-6)
        imports.append(r.y["p_g"][(r.t > 0.13) & (r.t < 0.2)].min())
        walks.append(tuple(r.walk))
    assert set(walks) == {("NORMAL", "MIXED")}
    assert (np.diff(imports) > 0.02).all()


def test_a_long_shallow_dip_ends_on_battery_and_a_swell_in_mixed():
    voltage, jumps = sag(0.85, length=0.4)
    long = ride(system("gfl"), voltage, jumps, 0.5, step=2e-3, rtol=1e-6)
    assert long.walk == ["NORMAL", "MIXED", "BATTERY"]
    assert long.modes[2][0] - long.modes[1][0] == pytest.approx(0.25, abs=5e-3)
    voltage, jumps = sag(1.15, length=0.1)
    swell = ride(system("gfl"), voltage, jumps, 0.4, step=2e-3, rtol=1e-6)
    assert swell.walk == ["NORMAL", "MIXED", "NORMAL"]


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("swell", [1.1, 1.2, 1.3])
def test_a_swell_does_not_starve_the_servers(name, swell):
    """Reactive power that the front end absorbs takes nothing from the active service of the output stage."""
    voltage, jumps = sag(swell, length=0.5)
    r = ride(system(name), voltage, jumps, 1.0, step=2e-3, rtol=1e-6)
    assert r.y["v_it"].min() > 0.98
    assert r.y["p_it"].min() == pytest.approx(r.y["p_it"][0], rel=1e-3)


def test_the_battery_empties_and_the_charge_stays_within_bounds():
    """No grid and a battery of one second: discharge ends near soc_min, and the link goes down with it."""
    s = system("gfl", **{"bess.T_E": 1.0})
    r = ride(s, lambda t: 0.0 if t >= 0.1 else 1.0 + 0j, (0.1,), 1.2, step=5e-3, rtol=1e-6)
    assert r.y["soc"].min() > 0.05
    assert r.y["w_dc"][-1] < 0.36  # out of bounds: a simulator ends the run here and says so


def test_facility_is_smooth_where_it_must_be():
    """No branch in the equations: derivatives at V = 0 are finite."""
    for name in VARIANTS:
        s = system(name)
        x = s.equilibrium(volts(1.0))
        assert np.isfinite(s.matrix(x, np.array([0.0, 0.0, 1.0]), "NORMAL")).all()
        full = ca.Function(
            "J", [s.dae.x, s.dae.u, s.dae.p, s.dae.q, s.dae.clocks], [ca.jacobian(s.dae.f, s.dae.p)]
        )(x, [0, 0, 1], s.p, s.flags("NORMAL"), [0])
        assert np.isfinite(np.array(full)).all()


def test_unknown_names_in_a_variant():
    f = facility.gfl()
    with pytest.raises(InputError) as error:
        f.set("pll.Kp", 50.0)
    assert str(error.value) == (
        "gfl has no parameter 'pll.Kp'. Did you mean 'pll.K_p'? Known: pll.K_p, pll.K_i."
    )
    with pytest.raises(InputError, match="Did you mean 'pll'"):
        f.replace("pl", Pll())
    with pytest.raises(InputError, match=r"lim.beta is bound to beta. Set 'beta' instead"):
        f.set("lim.beta", 1.2)
