"""Units, phasors and smooth functions: what the equations are written with."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.errors import InputError, ModelError
from dcvrt.models import Phasor, smooth
from dcvrt.units import dimension, same_unit

x = st.floats(-3, 3)
width = st.sampled_from([1e-2, 1e-3, 1e-4])


def test_units_are_products_of_bases():
    assert dimension("pu(S) s") == (("pu(S)", 1), ("s", 1))
    assert dimension("rad/s/pu(V)") == (("pu(V)", -1), ("rad", 1), ("s", -1))
    assert same_unit("pu(V)/pu(I)", "pu(I)-1 pu(V)")
    assert not same_unit("pu(V)", "pu(I)")
    assert not same_unit("rad", "1")


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("pu", "unit 'pu': plain 'pu' does not say of what. Write pu(V), pu(I), pu(S) or pu(Z)."),
        ("", "a unit is missing. Write '1' for a ratio."),
        ("pu(W)/s", "unit 'pu(W)/s': 'pu(W)' is not known. Did you mean 'pu(Z)'? Known: 1, s, h, rad, deg, "
                    "Hz, K, pu(V), pu(I), pu(S), pu(Z), MW, ... (14 in all)."),
    ],
)  # fmt: skip
def test_unknown_units_are_refused(unit, text):
    with pytest.raises(ModelError) as error:
        dimension(unit)
    assert str(error.value) == text


@given(x, x, x, x, x)
def test_phasor_arithmetic_is_complex_arithmetic(a, b, c, d, angle):
    p, q = Phasor(a, b), Phasor(c, d)
    z, w = complex(a, b), complex(c, d)
    assert complex(p + q) == pytest.approx(z + w)
    assert complex(p - q) == pytest.approx(z - w)
    assert complex(-p) == -z
    assert complex(p * q) == pytest.approx(z * w)
    assert complex(2.0 * p) == complex(p * 2.0) == 2 * z
    assert complex(p.turn(angle)) == pytest.approx(z * np.exp(1j * angle))
    assert complex(p * p.conj()) == pytest.approx(abs(z) ** 2)
    if abs(w) > 1e-3:
        assert complex(p / q) == pytest.approx(z / w, rel=1e-9)


def test_phasor_of_symbols_is_the_phasor_of_numbers():
    re, im, angle = ca.SX.sym("re"), ca.SX.sym("im"), ca.SX.sym("angle")
    symbolic = (Phasor(re, im).turn(angle) / Phasor(0.3, -0.4)).conj()
    f = ca.Function("f", [re, im, angle], [symbolic.re, symbolic.im])
    number = (Phasor(0.7, 0.2).turn(1.1) / Phasor(0.3, -0.4)).conj()
    assert [float(v) for v in f(0.7, 0.2, 1.1)] == pytest.approx([number.re, number.im])


def test_polar_and_angle_invert_each_other():
    v = Phasor.polar(0.8, 2.5)
    assert v.angle() == pytest.approx(2.5)
    assert v.abs2() == pytest.approx(0.64)


@given(x, x, x, width)
def test_smooth_functions_stay_within_their_width(a, b, c, eps):
    low, high = min(b, c), max(b, c)
    tiny = 1e-12
    assert 0 <= smooth.pos(a, eps) - max(a, 0.0) <= eps / 2 + tiny
    held = smooth.sat(a, low, high, eps)
    assert low - tiny <= held <= high + tiny
    assert abs(held - np.clip(a, low, high)) <= eps / 2 + tiny
    assert 0 <= min(a, b) - smooth.minimum(a, b, eps) <= eps / 2 + tiny
    assert 0 <= smooth.maximum(a, b, eps) - max(a, b) <= eps / 2 + tiny
    assert smooth.dead(a, abs(b), eps) == pytest.approx(-smooth.dead(-a, abs(b), eps), abs=tiny)
    assert 0 <= smooth.root(abs(a), eps) <= np.sqrt(abs(a)) + tiny
    assert 0 <= smooth.step(a, eps) <= 1
    assert smooth.mag(Phasor(a, b), eps) == pytest.approx(np.sqrt(a * a + b * b + eps * eps))


def test_smooth_functions_at_the_values_that_matter():
    assert smooth.sat(0.7, 0.0, 0.0, 1e-3) == 0.0
    assert smooth.dead(0.0, 0.03, 1e-3) == 0.0
    assert smooth.root(0.0, 1e-3) == 0.0
    assert smooth.step(0.0, 1e-3) == 0.5


@pytest.mark.parametrize(
    ("function", "corner"),
    [
        (lambda a, e: smooth.pos(a, e), 0.0),
        (lambda a, e: smooth.sat(a, -0.5, 0.5, e), 0.5),
        (lambda a, e: smooth.dead(a, 0.5, e), 0.5),
        (lambda a, e: smooth.root(a, e), 0.0),
        (lambda a, e: smooth.step(a, e), 0.0),
    ],
    ids=["pos", "sat", "dead", "root", "step"],
)
def test_smooth_functions_have_their_derivative_at_the_corner(function, corner):
    a, eps = ca.SX.sym("a"), 1e-2
    slope = float(ca.Function("slope", [a], [ca.jacobian(function(a, eps), a)])(corner))
    h = 1e-7
    assert slope == pytest.approx((function(corner + h, eps) - function(corner - h, eps)) / (2 * h), rel=1e-5)


def test_the_automaton_behind_an_output_is_that_whose_flags_it_shows():
    dae = facility.get("gfl-vfd-cooling").compile()
    assert dae.automaton_behind("mode").path == "sup"
    assert dae.automaton_behind("mode_cooling").path == "cooling"
    with pytest.raises(InputError) as unknown:
        dae.automaton_behind("mde")
    assert str(unknown.value).startswith("gfl-vfd-cooling has no output 'mde'. Did you mean 'mode'?")
    with pytest.raises(InputError) as none:
        dae.automaton_behind("w_dc")
    assert str(none.value) == ("gfl-vfd-cooling: output 'w_dc' must show one automaton; it shows none.")
