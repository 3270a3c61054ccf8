"""Inverter of a UPS that stands beside the grid, ready to carry the load."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.phasor import Phasor


class UpsInverter(Block):
    r"""Voltage source that follows the angle of the grid while there is one, else runs free.

    .. math::
        T_v \dot E = x V_{set} \left(1 - b + b \min\!\left(1, \frac{\beta H}{|I|}\right)\right) - E

    .. math::
        \dot\delta = \omega + a K_p \epsilon, \qquad \dot\omega = a K_i \epsilon, \qquad
        \epsilon = \operatorname{Im}\{V^g e^{-j\delta}\}

    x: inverter on; b: it carries the bus; a: it aligns with the grid. When the load asks for more current
    than the rating, the voltage folds back. On battery it runs on at the frequency last seen. Slow on
    purpose: the loads see the change of frequency. Equilibrium: E = V_set, delta = arg V_g, omega = 0.
    Stuck, as every such loop, where it starts exactly opposite to the grid.
    Differs: not in the paper; the output stage of the double-conversion variants has no angle.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    beta = Parameter(1.15, "1", (0.5, 3.0), "inverter rating over hosted capacity", "illustrative")
    V_set = Parameter(1.0, "pu(V)", (0.9, 1.1), "set point", "nominal voltage")
    T_v = Parameter(1e-3, "s", (1e-4, 0.1), "lag of the output voltage", "illustrative")
    K_p = Parameter(
        3.0, "rad/s/pu(V)", (0.1, 100.0), "pull on the angle", "illustrative: at most 0.5 Hz off the grid"
    )
    K_i = Parameter(2.0, "rad/s2/pu(V)", (0.0, 1e3), "pull on the frequency", "illustrative")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width of the fold-back", "own choice: numerics")

    v_grid = Input("pu(V)", "voltage of the grid, network frame", kind=Phasor)
    i = Input("pu(I)", "current of the bus, network frame", kind=Phasor)
    on = Input("1", "1: inverter on")
    on_inverter = Input("1", "1 while it carries the bus")
    align = Input("1", "1: follow the grid")
    v = Output("pu(V)", "voltage, network frame", kind=Phasor)
    error = Output("pu(V)", "grid voltage across the inverter's axis")

    magnitude = State(1.0, "pu(V)", "voltage magnitude")
    delta = State(0.0, "rad", "angle to the network frame")
    omega = State(0.0, "rad/s", "frequency deviation from omega_0")

    def equations(self, s: Any) -> Equations:
        error = s.v_grid.turn(-s.delta).im
        ratio = s.beta * s.H / smooth.mag(s.i, s.eps * s.H)
        fold_back = 1 - s.on_inverter * (1 - smooth.minimum(ratio, 1.0, s.eps))
        return Equations(
            der=dict(
                magnitude=(s.on * s.V_set * fold_back - s.magnitude) / s.T_v,
                delta=s.omega + s.align * s.K_p * error,
                omega=s.align * s.K_i * error,
            ),
            out=dict(v=Phasor.polar(s.magnitude, s.delta), error=error),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(magnitude=s.V_set, delta=s.v_grid.angle(), omega=0.0)
