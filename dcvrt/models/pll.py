"""Synchronous-reference-frame phase-locked loop of the grid-following UPS."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.phasor import Phasor


class Pll(Block):
    r"""SRF-PLL that turns a dq frame until the q-axis voltage vanishes.

    .. math::
        e = \operatorname{Im}\{V e^{-j\delta}\}, \qquad
        \dot\xi = e, \qquad
        \dot\delta = K_p e + K_i \xi

    `delta` is the angle of the dq frame to the network frame, which turns at :math:`\omega_0`.
    Paper: eqs. (gfl_pll_error)-(gfl_pll).
    Valid for positive sequence. With V = 0 the error is 0 and the angle coasts at its last frequency.
    Equilibrium: delta = arg V, xi = 0. Small signal at voltage V: :math:`\omega_n = \sqrt{K_i V}`,
    :math:`\zeta = \tfrac{1}{2} K_p \sqrt{V / K_i}`.
    """

    K_p = Parameter(
        60.0, "rad/s/pu(V)", (1.0, 500.0), "proportional gain", "illustrative: damping 0.8 at 6 Hz"
    )
    K_i = Parameter(1400.0, "rad/s2/pu(V)", (0.0, 5e4), "integral gain", "illustrative: damping 0.8 at 6 Hz")

    v = Input("pu(V)", "POI voltage, network frame", kind=Phasor)
    omega = Output("rad/s", "frequency deviation from omega_0")
    error = Output("pu(V)", "voltage across the frame: 0 when synchronised")

    xi = State(0.0, "pu(V) s", "integral of the q-axis voltage")
    delta = State(0.0, "rad", "angle of the dq frame")

    def equations(self, s: Any) -> Equations:
        e = s.v.turn(-s.delta).im
        omega = s.K_p * e + s.K_i * s.xi
        return Equations(der=dict(xi=e, delta=omega), out=dict(omega=omega, error=e))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(xi=0.0, delta=s.v.angle())
