"""Cooling motors on variable-speed drives, straight on the grid voltage."""

from __future__ import annotations

from typing import Any

import casadi as ca

from dcvrt.models import smooth
from dcvrt.models.automaton import Go, always, outside, within
from dcvrt.models.block import Equations, Input, Output, Parameter, State
from dcvrt.models.cooling import Cooling
from dcvrt.models.phasor import Phasor


class DriveCooling(Cooling):
    r"""Cooling on variable-speed drives: rectifier, DC bus, inverter with the motor.

    .. math::
        i_r = P_r\operatorname{sat}_{[0,\, I_r]}\left[K_r(|V| - \sqrt{w})\right], \qquad
        I = i_r \frac{V}{|V|} (1 - j\tan\varphi), \qquad P_r = \varphi_{cool}\, d\, H

    .. math::
        T_{dc} P_r\, \dot w = \operatorname{Re}\{V I^*\} - P^{cool}/\eta, \qquad
        P^{cool} = r\, P_r\, g, \qquad T\, \dot g = 1 + \rho\,(g_{IT} - 1) - g

    w is the energy of the DC bus over its nominal value, the square of its voltage in pu. The rectifier
    conducts while the grid voltage is above that of the bus. Between them lie the drops of feeder and
    commutation, 1/K_r at nominal current; they cost no energy. The motor takes constant power until the drive
    trips; r is the share that runs: 1, 0, or rising in RAMP with the time in it over T_ramp.

    | mode | meaning |
    |---|---|
    | RUN | motors follow the heat |
    | TRIPPED | inverter blocked: the DC bus was too low or too high |
    | RAMP | restarted, on the way up |

    Import positive. Equilibrium: RUN, :math:`\sqrt{w} = |V| - g/(\eta K_r |V|)`.
    Hold-up without grid from energy w: (w - w_trip) T_dc P_r eta/P_cool.
    Differs: the paper's cooling hangs on the protected bus and cannot trip. Left out: energy of the rotating
    masses, flying restart, harmonics, drives that trip one by one.
    """

    modes = ("RUN", "TRIPPED", "RAMP")
    start = "RUN"
    flags = {"running": (1, 0, 0), "ramping": (0, 0, 1), "number": (0, 1, 2)}  # noqa: RUF012

    pf = Parameter(0.98, "1", (0.8, 1.0), "power factor of the rectifier, lagging", "illustrative")
    K_r = Parameter(
        20.0, "1/pu(V)", (2.0, 200.0), "current over nominal per voltage drop", "illustrative: drop of 5 %"
    )
    I_r = Parameter(2.0, "1", (1.05, 10.0), "largest rectifier current over nominal", "illustrative")
    T_dc = Parameter(
        0.03, "s", (1e-3, 1.0), "nominal energy of the DC bus over nominal power", "illustrative: 10-50 ms"
    )
    eta = Parameter(1.0, "1", (0.8, 1.0), "efficiency from the DC bus to the motor", "PUE counts the losses")
    w_trip = Parameter(0.50, "1", (0.05, 0.9), "trips below: 0.71 pu of voltage", "illustrative")
    w_over = Parameter(1.56, "1", (1.1, 3.0), "trips above: 1.25 pu of voltage", "illustrative")
    w_back = Parameter(0.72, "1", (0.1, 1.0), "may restart above: 0.85 pu of voltage", "illustrative")
    w_calm = Parameter(1.30, "1", (1.0, 2.5), "may restart below: 1.14 pu of voltage", "illustrative")
    T_restart = Parameter(5.0, "s", (0.0, 3600.0), "healthy time until restart", "illustrative")
    T_ramp = Parameter(10.0, "s", (0.01, 3600.0), "time to ramp up", "illustrative")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width", "own choice: numerics")
    eps_v = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "rounding of |V| at 0", "own choice: numerics")

    v = Input("pu(V)", "grid voltage, network frame", kind=Phasor)
    i = Output("pu(I)", "current drawn, network frame", kind=Phasor)
    i_max = Output("pu(I)", "largest current that the drives draw")
    demand = Output("pu(S)", "power that the motors ask for")
    energy = Output("pu(S) s", "energy of the DC bus")
    loss = Output("pu(S)", "power lost between DC bus and motor")
    mode = Output("1", "number of the mode, from 0")

    w = State(0.9, "1", "energy of the DC bus over its nominal value")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        return (
            Go("RUN", "TRIPPED", outside(s.w, s.w_trip, s.w_over)),
            Go("TRIPPED", "RAMP", within(s.w, s.w_back, s.w_calm), held=s.T_restart),
            Go("RAMP", "TRIPPED", outside(s.w, s.w_trip, s.w_over)),
            Go("RAMP", "RUN", always(), held=s.T_ramp),
        )

    def equations(self, s: Any) -> Equations:
        plain = super().equations(s)
        nominal = s.share * s.d * s.H
        magnitude = smooth.mag(s.v, s.eps_v)
        bus = ca.sqrt(smooth.pos(s.w, s.eps))
        i_r = nominal * smooth.sat(s.K_r * (magnitude - bus), 0.0, s.I_r, s.eps)
        tan = smooth.root(1 / s.pf**2 - 1, 1e-6)
        i = s.v * Phasor(i_r, -i_r * tan) / magnitude
        p_in = (s.v * i.conj()).re
        demand = plain.out["p"]
        p = (s.running + s.ramping * s.clock / s.T_ramp) * demand
        return Equations(
            der=dict(g=plain.der["g"], w=(p_in - p / s.eta) / (s.T_dc * nominal)),
            out=dict(
                p=p,
                i=i,
                i_max=nominal * s.I_r / s.pf,
                demand=demand,
                energy=s.T_dc * nominal * s.w,
                loss=p / s.eta - p,
                mode=s.number,
            ),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        plain = super().rest(s)
        magnitude = smooth.mag(s.v, s.eps_v)
        bus = magnitude - plain["g"] / (s.eta * s.K_r * magnitude)
        return dict(plain) | dict(w=bus * bus)
