"""Power supplies of the servers as the grid meets them: hold-up, trip, staggered restart."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.automaton import Go, above, always, below
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.phasor import Phasor

INTEL_HOLD_UP = "Intel R1000SP: 10 ms at full load, 12 ms at 70 %"
INTEL_LIMITS = "Intel SC5650: power off at 75 V, start at 85 V, full load from 180 V up; over 230 V"
INTEL_RESTART = "Intel S1600JP: random delay of 25-300 s after the power is back"


class HoldUpSupply(Block):
    r"""All server power supplies as one: constant power behind an energy store.

    .. math::
        E_N \dot e = P^{in} - P^{IT}, \qquad E_N = \frac{T_{hold} P_N}{1 - e_{min}}, \qquad
        P^{IT} = \varsigma\, P^{dem}

    .. math::
        i = c\, \operatorname{sat}_{[0,\, I_{lim} P_N]} \frac{P^u}{|V|}, \qquad
        P^u = P^{IT} + P_N \operatorname{sat}_{\pm k_{in}} K_e (1 - e), \qquad
        P^{in} = i |V|

    e is the energy of the bulk capacitors over its nominal value, P_N = share H what the supplies are rated
    for, c whether they are connected to their input, :math:`\varsigma` the share of servers that run. The
    current is at the power factor pf, lagging; the limit is on its active part.

    | mode | meaning |
    |---|---|
    | RUN | fed, all servers run |
    | HOLD_UP | input below V_off: servers run from the capacitors |
    | TRIPPED | capacitors empty: servers are off and draw nothing |
    | PRECHARGE | power back for T_restart: capacitors are filled through the inrush limit |
    | RESTART | servers come back, linear in time over T_ramp |

    Where there is no input, P_N lasts T_hold: from e = 1 the load P lasts (1 - e_min) E_N / P. A sag above
    V_off that the current limit cannot make up for, I_lim |V| < P, empties the capacitors too, more slowly.
    A restart after a random delay, uniform between T_restart and T_restart + T_ramp, is this ramp when the
    servers are many. Equilibrium: RUN, e = 1, P_in = P_IT = P_dem.
    Left out: losses (the demand is what the supplies draw), discharge of the capacitors while tripped, and
    the spread of supplies, old and new, loaded more and less: all trip at one instant.
    Differs: the paper names no power supplies. The supply of the double-conversion variants is static.
    """

    modes = ("RUN", "HOLD_UP", "TRIPPED", "PRECHARGE", "RESTART")
    start = "RUN"
    flags = {  # noqa: RUF012
        "number":     (0, 1, 2, 3, 4),
        "connected":  (1, 0, 0, 1, 1),
        "running":    (1, 1, 0, 0, 0),
        "restarting": (0, 0, 0, 0, 1),
    }  # fmt: skip

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    share = Parameter(
        0.77, "1", (0.01, 1.0), "rated power of the supplies over H", "1/PUE, PUE 1.3: illustrative"
    )
    pf = Parameter(0.98, "1", (0.8, 1.0), "power factor, lagging", "illustrative")
    T_hold = Parameter(0.010, "s", (1e-3, 1.0), "hold-up time at rated power", INTEL_HOLD_UP)
    e_min = Parameter(
        0.59,
        "1",
        (0.05, 0.95),
        "energy at which the servers lose power",
        "illustrative: 300 V of 390 V, squared",
    )
    e_full = Parameter(0.95, "1", (0.1, 0.999), "energy at which servers may start", "illustrative")
    I_lim = Parameter(1.28, "1", (0.8, 3.0), "input current limit over rated current", INTEL_LIMITS)
    V_off = Parameter(0.33, "pu(V)", (0.05, 0.95), "input undervoltage", INTEL_LIMITS)
    V_on = Parameter(0.37, "pu(V)", (0.06, 1.0), "input works again above", INTEL_LIMITS)
    V_start = Parameter(0.78, "pu(V)", (0.1, 1.0), "tripped supplies start above", INTEL_LIMITS)
    K_e = Parameter(2.0, "1", (0.1, 50.0), "recharge power over P_N per missing energy", "illustrative")
    k_in = Parameter(0.15, "1", (0.01, 2.0), "inrush limit: largest recharge power over P_N", "illustrative")
    T_restart = Parameter(
        25.0, "s", (0.0, 3600.0), "healthy time before the first servers start", INTEL_RESTART
    )
    T_ramp = Parameter(275.0, "s", (1e-2, 3600.0), "time over which servers come back", INTEL_RESTART)
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width over P_N", "own choice: numerics")
    eps_v = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "rounding of |V| at 0", "own choice: numerics")

    v = Input("pu(V)", "voltage at the supplies, network frame", kind=Phasor)
    v_f = Input("pu(V)", "its measured magnitude")
    demand = Input("pu(S)", "demand of the servers")
    i = Output("pu(I)", "current drawn, network frame", kind=Phasor)
    v_it = Output("pu(V)", "voltage magnitude at the supplies")
    drawn = Output("pu(S)", "power drawn from the input")
    p = Output("pu(S)", "power that the servers get")
    energy = Output("pu(S) s", "energy in the capacitors")
    mode = Output("1", "number of the mode, from 0")

    e = State(1.0, "1", "energy of the capacitors over its nominal value")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        empty, gone = below(s.e, s.e_min), below(s.v_f, s.V_off)
        return (
            Go("RUN", "TRIPPED", empty),
            Go("RUN", "HOLD_UP", gone),
            Go("HOLD_UP", "TRIPPED", empty),
            Go("HOLD_UP", "RUN", above(s.v_f, s.V_on)),
            Go("TRIPPED", "PRECHARGE", above(s.v_f, s.V_start), held=s.T_restart),
            Go("PRECHARGE", "TRIPPED", gone),
            Go("PRECHARGE", "RESTART", above(s.e, s.e_full)),
            Go("RESTART", "TRIPPED", gone | empty),
            Go("RESTART", "RUN", always(), held=s.T_ramp),
        )

    def equations(self, s: Any) -> Equations:
        rated = s.share * s.H
        nominal = s.T_hold * rated / (1 - s.e_min)
        v_it = smooth.mag(s.v, s.eps_v)
        p = (s.running + s.restarting * s.clock / s.T_ramp) * s.demand
        ask = p + rated * smooth.sat(s.K_e * (1 - s.e), -s.k_in, s.k_in, s.eps)
        active = s.connected * smooth.sat(ask / v_it, 0.0, s.I_lim * rated, s.eps * rated)
        drawn = active * s.v.abs2() / v_it
        lagging = Phasor(1.0, -smooth.root(1 / s.pf**2 - 1, 1e-6))
        return Equations(
            der=dict(e=(drawn - p) / nominal),
            out=dict(
                i=s.v * (active / v_it) * lagging,
                v_it=v_it,
                drawn=drawn,
                p=p,
                energy=nominal * s.e,
                mode=s.number,
            ),
        )
