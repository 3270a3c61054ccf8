"""Output stage of the UPS: the AC bus that feeds the servers."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Parameter, State


class ProtectedBus(Block):
    r"""Voltage of the protected bus: what is wanted, within what rating and DC link allow.

    .. math::
        T_v \dot V = \min\!\left( V_{set} - k_{line} [1 - V_f]_+,\;
            \frac{\beta H\, \mathit{pf}}{P^{out}},\; m_{max} \sqrt{w} \right) - V

    The three limits are: the set point, which a sag pulls down by k_line; the apparent power that the output
    stage may deliver at the power factor of the load; the voltage that the DC link can modulate.
    Equilibrium: V = V_set while rating and DC link suffice.
    Differs: the paper names an output stage and gives no equation; this is ours, the same in both modes.
    Differs: the rating is shared with the grid side, whose reactive exchange yields to active service
    (eq. ups_current_limit); it therefore takes nothing from the output stage. Subtracted from the rating it
    would starve the servers in a mild swell, when a grid-forming front end absorbs reactive power.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    beta = Parameter(1.15, "1", (0.5, 3.0), "converter rating over hosted capacity", "illustrative")
    pf = Parameter(0.98, "1", (0.8, 1.0), "power factor of the load on the bus", "illustrative")
    V_set = Parameter(1.0, "pu(V)", (0.9, 1.1), "set point", "nominal voltage")
    k_line = Parameter(0.05, "1", (0.0, 1.0), "share of a sag that reaches the bus", "illustrative")
    m_max = Parameter(1.15, "pu(V)", (1.0, 1.5), "highest voltage at nominal DC energy", "illustrative")
    T_v = Parameter(5e-3, "s", (5e-4, 0.1), "lag of the output stage", "illustrative: 2-12 ms")
    eps = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "smoothing width", "own choice: numerics")
    eps_s = Parameter(
        1e-3, "1", (1e-6, 0.1), "power at which the headroom is cut off, over H", "own choice: numerics"
    )

    w = Input("1", "DC energy over its nominal value")
    v_f = Input("pu(V)", "measured POI voltage")
    p_out = Input("pu(S)", "power drawn from the bus")

    v = State(1.0, "pu(V)", "voltage of the protected bus")

    def equations(self, s: Any) -> Equations:
        wanted = s.V_set - s.k_line * smooth.pos(1 - s.v_f, s.eps)
        headroom = s.beta * s.H * s.pf / (s.p_out + s.eps_s * s.H)
        modulated = s.m_max * smooth.root(smooth.pos(s.w, s.eps), s.eps)
        target = smooth.minimum(smooth.minimum(wanted, headroom, s.eps), modulated, s.eps)
        return Equations(der=dict(v=(target - s.v) / s.T_v))

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(v=s.V_set)
