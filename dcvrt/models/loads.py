"""The loads of the facility and the power supplies between them and the protected bus."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter

H_DOC = "hosted capacity"
D_DOC = "load factor: facility demand over hosted capacity at g = 1"


class ItLoad(Block):
    r"""Demand of the servers.

    .. math::
        P^{IT} = \varphi_{IT}\, d\, H\, g_{IT}

    Paper: eq. (ai_workload); its superposition of workloads arrives as the multiplier g_IT, mean 1.
    Differs: the servers take what their supplies pass on; see the block of the supply.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), H_DOC, "decision of the planner")
    d = Parameter(1.0, "1", (0.0, 1.2), D_DOC, "full load")
    share = Parameter(0.77, "1", (0.0, 1.0), "share of the demand at g = 1", "1/PUE, PUE 1.3: illustrative")

    g_it = Input("1", "normalised IT load")
    p = Output("pu(S)", "demand of the servers")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(p=s.share * s.d * s.H * s.g_it))


class AuxiliaryLoad(Block):
    r"""Constant demand of everything that is neither server nor cooling, losses of the UPS included.

    .. math::
        P^{aux} = \varphi_{aux}\, d\, H

    Paper: eq. (dc_dynamic_load). PUE counts conversion losses, so they are inside this share.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), H_DOC, "decision of the planner")
    d = Parameter(1.0, "1", (0.0, 1.2), D_DOC, "full load")
    share = Parameter(
        0.06, "1", (0.0, 1.0), "share of the demand at g = 1", "PUE 1.3, a quarter of the rest: illustrative"
    )

    p = Output("pu(S)", "auxiliary demand")

    def equations(self, s: Any) -> Equations:
        return Equations(out=dict(p=s.share * s.d * s.H))


class ServerSupply(Block):
    r"""Server power supplies: constant power while they can, constant resistance below.

    .. math::
        P = \sigma(V_{IT})\, P^{IT}, \qquad \sigma(V) = \min(1, V/V_{psu})^2

    Differs: the paper has no supply; without one the servers would draw full power from a dead bus.
    """

    V_psu = Parameter(0.85, "pu(V)", (0.3, 1.0), "bus voltage below which power falls", "illustrative")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width", "own choice: numerics")

    demand = Input("pu(S)", "demand of the servers")
    v_it = Input("pu(V)", "voltage of the protected bus")
    p = Output("pu(S)", "power drawn by the servers")

    def equations(self, s: Any) -> Equations:
        ratio = smooth.minimum(s.v_it / s.V_psu, 1.0, s.eps)
        return Equations(out=dict(p=ratio * ratio * s.demand))


class FacilityLoad(Block):
    r"""Sum of what the facility demands and of what it draws.

    .. math::
        P^{dc} = P^{IT} + P^{cool} + P^{aux}, \qquad
        P^{out} = \sigma P^{IT} + P^{cool} + P^{aux}

    Paper: eq. (dc_dynamic_load).
    """

    it_demand = Input("pu(S)", "demand of the servers")
    it = Input("pu(S)", "power drawn by the servers")
    cooling = Input("pu(S)", "cooling power")
    auxiliary = Input("pu(S)", "auxiliary power")
    demand = Output("pu(S)", "facility demand P^dc, the power it would draw at a healthy protected bus")
    p = Output("pu(S)", "power drawn from the protected bus")

    def equations(self, s: Any) -> Equations:
        other = s.cooling + s.auxiliary
        return Equations(out=dict(demand=s.it_demand + other, p=s.it + other))


class SplitFacilityLoad(Block):
    r"""Sum of the loads where cooling is fed beside the protected bus, not from it.

    .. math::
        P^{dc} = P^{IT} + P^{cool,\,dem} + P^{aux}, \qquad
        P^{bus} = \sigma P^{IT} + P^{aux}, \qquad
        P^{out} = P^{bus} + P^{cool}

    Differs: the paper feeds all of the load from the protected bus, eq. (dc_dynamic_load).
    """

    it_demand = Input("pu(S)", "demand of the servers")
    it = Input("pu(S)", "power drawn by the servers")
    auxiliary = Input("pu(S)", "auxiliary power")
    cooling_demand = Input("pu(S)", "power that the cooling asks for")
    cooling = Input("pu(S)", "power that the cooling gets")
    demand = Output("pu(S)", "facility demand P^dc, the power it would draw with everything healthy")
    p = Output("pu(S)", "power drawn from the protected bus")
    served = Output("pu(S)", "power that all loads get")

    def equations(self, s: Any) -> Equations:
        p = s.it + s.auxiliary
        return Equations(
            out=dict(demand=s.it_demand + s.auxiliary + s.cooling_demand, p=p, served=p + s.cooling)
        )
