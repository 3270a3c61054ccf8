"""Inner current control, seen from outside: a lag."""

from __future__ import annotations

from typing import Any

from dcvrt.models.block import Block, Equations, Input, Output, Parameter, State
from dcvrt.models.phasor import Phasor


class CurrentLag(Block):
    r"""First-order response of the current to its reference, in the converter's dq frame.

    .. math::
        \tau_I \dot I_{dq} = I^{\star}_{dq} - I_{dq}, \qquad I = I_{dq} e^{j\delta}

    Paper: eq. (gfl_current_loop).
    Equilibrium: the reference. The current stays within the limit that its reference keeps.
    Differs: the paper's grid-forming current has no lag; here both modes have the same one, so that they
    differ in control only.
    """

    tau = Parameter(
        4e-3, "s", (1e-4, 0.1), "time constant of the closed current loop", "illustrative: 1-10 ms"
    )

    ask = Input("pu(I)", "current reference, dq frame", kind=Phasor)
    delta = Input("rad", "angle of the dq frame")
    i = Output("pu(I)", "current drawn at the POI, network frame", kind=Phasor)

    i_d = State(1.0, "pu(I)", "current along the d axis")
    i_q = State(0.0, "pu(I)", "current along the q axis")

    def equations(self, s: Any) -> Equations:
        return Equations(
            der=dict(i_d=(s.ask.re - s.i_d) / s.tau, i_q=(s.ask.im - s.i_q) / s.tau),
            out=dict(i=Phasor(s.i_d, s.i_q).turn(s.delta)),
        )

    def rest(self, s: Any) -> dict[str, Any]:
        return dict(i_d=s.ask.re, i_q=s.ask.im)
