"""Reactive support in a sag or swell, as grid codes ask of converters."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter


class ReactiveSupport(Block):
    r"""Adds reactive current in proportion to the voltage error beyond a deadband.

    .. math::
        i_q = \operatorname{sat}_{\pm I_q}\left[K \operatorname{dead}_{\Delta V}(V_{ref} - V_f)\right], \qquad
        Q = Q^c - V_f\, H\, i_q

    Import positive: in a sag the facility imports less reactive power, or exports it. K is the current over
    H per pu of voltage error, as grid codes count it, hence V_f in the power.
    It stands between the command of the DC-energy loop and the current reference. K = 0: Q = Q_c.
    Smoothed with width eps. Algebraic; at a voltage within the deadband Q = Q_c.
    Differs: the paper's grid-following mode gives no support. What arrives is what the current limit leaves:
    with active priority little of it in a deep sag.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    K = Parameter(
        2.0,
        "1",
        (0.0, 10.0),
        "support current over H per voltage error",
        "illustrative: usual in grid codes, not checked",
    )
    V_ref = Parameter(1.0, "pu(V)", (0.9, 1.1), "voltage that is supported", "nominal voltage")
    dV = Parameter(0.1, "pu(V)", (0.0, 0.3), "deadband of the voltage error", "illustrative")
    I_q = Parameter(1.0, "1", (0.0, 2.0), "largest support current over H", "illustrative")
    eps = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "smoothing width", "own choice: numerics")

    q_c = Input("pu(S)", "reactive-power command without support")
    v_f = Input("pu(V)", "measured POI voltage")
    q = Output("pu(S)", "reactive-power command with support")

    def equations(self, s: Any) -> Equations:
        error = smooth.dead(s.V_ref - s.v_f, s.dV, s.eps)
        i_q = smooth.sat(s.K * error, -s.I_q, s.I_q, s.eps)
        return Equations(out=dict(q=s.q_c - s.v_f * s.H * i_q))
