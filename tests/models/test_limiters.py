"""Both limiters: never more than the limit; what yields to what."""

from __future__ import annotations

from math import hypot, pi, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt import facility
from dcvrt.models import ActivePriorityLimiter, Input, Output, Parameter, Phasor, ReactivePriorityLimiter
from dcvrt.models.limiter import reactive_priority

approx = pytest.approx
part = st.floats(-3, 3)
BOTH = (ActivePriorityLimiter, ReactivePriorityLimiter)


@pytest.mark.parametrize("kind", BOTH, ids=lambda k: k.__name__)
@given(ask=st.tuples(part, part), v=st.tuples(part, part), share=st.floats(0, 1), w=st.floats(0.3, 1.5),
       beta=st.floats(0.5, 3.0), eps=st.sampled_from([1e-1, 1e-2, 1e-3, 1e-6]))  # fmt: skip
def test_the_limit_is_never_exceeded(kind, ask, v, share, w, beta, eps):
    lim = kind(beta=beta, eps=eps)
    out = lim.equations(lim.at(ask=Phasor(*ask), v=Phasor(*v), share=share, w=w)).out
    assert hypot(out["i"].re, out["i"].im) <= share * beta * (1 + 1e-12)
    assert out["i_max"] == approx(beta)


@given(st.floats(0.05, 1.1), st.floats(0, 2.0), st.floats(-2.0, 2.0))
def test_reactive_priority_grants_the_closed_form(voltage, p_ref, q_ref):
    """|Q| = min(|Q_ref|, V I), P = min(P_ref, sqrt((V I)^2 - Q^2))."""
    i_max, v = 1.1, Phasor(voltage, 0.0)
    ask = (Phasor(p_ref, q_ref) / v).conj()
    power = v * reactive_priority(ask, v, i_max, 1.0, 1e-5, 1e-6).conj()
    top = voltage * i_max
    assert abs(power.im) == approx(min(abs(q_ref), top), abs=1e-4)
    assert power.re == approx(min(p_ref, sqrt(max(top**2 - power.im**2, 0.0))), abs=2e-4)


@given(st.floats(-pi, pi), st.floats(-pi, pi), st.floats(0.1, 1.2))
def test_reactive_priority_does_not_care_for_the_frame(turn, angle, voltage):
    ask, v = Phasor.polar(1.4, 0.4), Phasor.polar(voltage, angle)
    here = reactive_priority(ask, v, 1.1, 1.0, 1e-3, 1e-3).turn(turn)
    there = reactive_priority(ask.turn(turn), v.turn(turn), 1.1, 1.0, 1e-3, 1e-3)
    assert complex(here) == approx(complex(there), abs=1e-12)


def test_what_yields_is_what_the_name_does_not_say():
    ask = dict(ask=Phasor(0.9, -0.8), v=Phasor(1.0, 0.0), share=1.0, w=1.0)
    active, reactive = (kind(beta=1.0, eps=1e-6) for kind in BOTH)
    first = active.equations(active.at(**ask)).out["i"]
    second = reactive.equations(reactive.at(**ask)).out["i"]
    assert complex(first) == approx(complex(0.9, -sqrt(1 - 0.81)), abs=1e-4)
    assert complex(second) == approx(complex(0.6, -0.8), abs=1e-4)


def test_within_the_limit_both_grant_what_is_asked():
    ask = dict(ask=Phasor(0.6, -0.3), v=Phasor(1.0, 0.0), share=1.0, w=1.0)
    for kind in BOTH:
        lim = kind(eps=1e-5)
        assert complex(lim.equations(lim.at(**ask)).out["i"]) == approx(0.6 - 0.3j, abs=1e-5)


def test_a_full_dc_link_and_the_supervisor_close_the_import():
    lim = ReactivePriorityLimiter(beta=1.0)
    at = dict(ask=Phasor(1.0, -0.5), v=Phasor(1.0, 0.0))
    full = lim.equations(lim.at(**at, share=1.0, w=1.4)).out["i"]
    assert complex(full) == approx(-0.5j, abs=1e-3)
    off = lim.equations(lim.at(**at, share=0.0, w=1.0)).out
    assert complex(off["i"]) == 0
    assert off["shortfall"] == approx(1.0, abs=1e-5)
    assert complex(lim.equations(lim.at(ask=Phasor(1, 1), v=Phasor(0, 0), share=1.0, w=1.0)).out["i"]) == 0


def test_shortfall_changes_sign_where_active_current_starts_to_yield():
    lim = ReactivePriorityLimiter(beta=1.0, eps=1e-6)
    short = lambda p, q: lim.equations(  # noqa: E731
        lim.at(ask=Phasor(p, q), v=Phasor(1.0, 0.0), share=1.0, w=1.0)
    ).out["shortfall"]
    assert short(0.5, -0.8) == approx(0.5 - 0.6, abs=1e-3)
    assert short(0.9, -0.8) == approx(0.9 - 0.6, abs=1e-3)
    assert short(0.9, 0.0) == approx(0.9 - 1.0, abs=1e-3)


def test_one_limiter_takes_the_place_of_the_other():
    for kind in (Input, Output, Parameter):
        one, other = (k.declared(kind) for k in BOTH)
        assert one.keys() == other.keys()
    f = facility.gfl()
    before = f.compile()
    f.replace("lim", ReactivePriorityLimiter())
    after = f.compile()
    assert after.p_names == before.p_names
    np.testing.assert_array_equal(after.parameter_values(), before.parameter_values())
