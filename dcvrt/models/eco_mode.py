"""Eco mode of a double-conversion UPS: its control and the rectifier that it wakes."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.automaton import Go, below, outside, within
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.command import given
from dcvrt.models.phasor import Phasor
from dcvrt.models.standby_control import StandbyControl

RECTIFIER = "illustrative; a Staco FirstLine carries its rated load down to 0.80"


class EcoModeControl(StandbyControl):
    """Decides between bypass, battery and double conversion.

    | mode | meaning |
    |---|---|
    | ECO | load on the static bypass, inverter and rectifier ready, battery recharging |
    | BATTERY | inverter carries the load from the battery, rectifier off |
    | WALK_IN | rectifier takes over from the battery, little by little |
    | DOUBLE | double conversion: rectifier and inverter carry the load |
    | DOWN | battery empty: the load is dropped until the input is back |

    ECO is left as soon as the measured voltage is outside V_low to V_high, always to BATTERY first, as Eaton
    describes it for the 9395. The rectifier has a wider window than the bypass and starts when the voltage
    has been within it for T_start. Back to ECO: voltage within V_back to V_calm and inverter within e_sync of
    the bypass for T_requalify without a break, counted in DOUBLE.
    Differs: not in the paper, whose UPS is always in double conversion.
    """

    modes = ("ECO", "BATTERY", "WALK_IN", "DOUBLE", "DOWN")
    start = "ECO"
    flags = {  # noqa: RUF012
        "number":     (0, 1, 2, 3, 4),
        "away":       (0, 1, 1, 1, 1),
        "handed":     (0, 0, 0, 1, 0),
        "handing":    (0, 0, 1, 0, 0),
        "charging":   (1, 0, 0, 1, 0),
        "rectifying": (1, 0, 1, 1, 0),
        "following":  (1, 0, 1, 1, 1),
        "living":     (1, 1, 1, 1, 0),
    }  # fmt: skip

    V_stop = Parameter(0.78, "pu(V)", (0.2, 1.0), "rectifier stops below", RECTIFIER)
    V_over = Parameter(1.15, "pu(V)", (1.0, 1.5), "rectifier stops above", RECTIFIER)
    V_go = Parameter(0.80, "pu(V)", (0.2, 1.05), "rectifier starts above", RECTIFIER)
    V_under = Parameter(1.12, "pu(V)", (0.95, 1.5), "rectifier starts below", RECTIFIER)
    T_start = Parameter(
        3.0, "s", (0.0, 600.0), "healthy time before walk-in", "Mitsubishi 9800A: delayed by 3 s at most"
    )
    T_requalify = Parameter(
        300.0, "s", (0.0, 1e5), "healthy time in DOUBLE before ECO",
        "Eaton 9PX: 5 minutes of bypass monitoring; Eaton 9395 on high alert: 1 h",
    )  # fmt: skip

    rectify = Output("1", "1: rectifier on")

    def transitions(self, s: Any) -> tuple[Go, ...]:
        lost = outside(s.v_f, s.V_stop, s.V_over)
        usable = within(s.v_f, s.V_go, s.V_under)
        healthy = self.healthy(s) & self.synchronous(s)
        return (
            Go("ECO", "BATTERY", self.unfit(s)),
            Go("BATTERY", "DOWN", below(s.soc, s.soc_min)),
            Go("BATTERY", "WALK_IN", usable, held=s.T_start),
            Go("WALK_IN", "BATTERY", lost),
            Go("WALK_IN", "DOUBLE", given(s.done)),
            Go("DOUBLE", "BATTERY", lost),
            Go("DOUBLE", "ECO", healthy, held=s.T_requalify),
            Go("DOWN", "ECO", healthy, held=s.T_start),
        )

    def equations(self, s: Any) -> Equations:
        return Equations(out={**self.says(s), "rectify": s.rectifying})


class Rectifier(Block):
    r"""Input of an eco-mode UPS: the bypass current, and what the rectifier draws beside it.

    .. math::
        I^g = g I + (1 - j\tan\varphi)\, x \operatorname{sat}_{\pm \beta H \mathit{pf}}
            \!\left(\frac{r b P + P^{ask}}{|V|}\right) \frac{V}{|V|}

    g, b: bypass or inverter feeds the bus; r: share of the inverter's load that the rectifier carries;
    x: rectifier on; P, I: power and current of the bus. What it cannot draw the battery gives.
    Algebraic: current loop and DC link are left out, they settle within the walk-in; the double-conversion
    variants have them.
    Differs: not in the paper.
    """

    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    beta = Parameter(1.15, "1", (0.5, 3.0), "rectifier rating over hosted capacity", "illustrative")
    pf = Parameter(0.98, "1", (0.8, 1.0), "power factor, lagging", "illustrative")
    eps = Parameter(1e-3, "1", (1e-6, 0.1), "smoothing width over H", "own choice: numerics")
    eps_v = Parameter(1e-3, "pu(V)", (1e-6, 0.1), "rounding of |V| at 0", "own choice: numerics")

    v = Input("pu(V)", "input voltage, network frame", kind=Phasor)
    i_bus = Input("pu(I)", "current of the bus, network frame", kind=Phasor)
    p_bus = Input("pu(S)", "power drawn from the bus")
    on_grid = Input("1", "1 while the bypass feeds the bus")
    on_inverter = Input("1", "1 while the inverter feeds the bus")
    share = Input("1", "share of the inverter's load that the rectifier carries")
    rectify = Input("1", "1: rectifier on")
    ask = Input("pu(S)", "power wanted for charging")
    i = Output("pu(I)", "current drawn from the grid, network frame", kind=Phasor)

    def equations(self, s: Any) -> Equations:
        size = smooth.mag(s.v, s.eps_v)
        wanted = (s.share * s.on_inverter * s.p_bus + s.ask) / size
        limit = s.beta * s.H * s.pf
        active = s.rectify * smooth.sat(wanted, -limit, limit, s.eps * s.H)
        lagging = Phasor(1.0, -smooth.root(1 / s.pf**2 - 1, 1e-6))
        return Equations(out=dict(i=s.i_bus * s.on_grid + s.v * (active / size) * lagging))
