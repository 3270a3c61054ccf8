"""Current limiters: what the converter can deliver of what was asked for."""

from __future__ import annotations

from typing import Any

from dcvrt.models import smooth
from dcvrt.models.block import Block, Equations, Input, Output, Parameter
from dcvrt.models.phasor import Phasor, Scalar


def unit_axis(v: Phasor, eps: Scalar) -> Phasor:
    """Phasor of length 1 along `v`; its length tends to 0 as `v` falls below eps."""
    return v / smooth.mag(v, eps)


def active_priority(
    i: Phasor, v: Phasor, i_max: Scalar, window: tuple[Scalar, Scalar], eps: Scalar, eps_v: Scalar
) -> Phasor:
    """Cut `i` to |i| <= i_max, giving up current across `v` before current along `v`.

    The active part is held within `window`, which must lie within +-i_max. The limit is never exceeded,
    whatever `eps`: both smooth clips stay inside the circle. With `v` = 0 there is no axis and the current
    granted is 0, as of a converter that blocks.
    """
    axis = unit_axis(v, eps_v)
    ask = i * axis.conj()  # re: along the voltage (active), im: across it (reactive)
    along = smooth.sat(ask.re, *window, eps)
    room = smooth.root(i_max * i_max - along * along, eps)
    across = smooth.sat(ask.im, -room, room, eps)
    return Phasor(along, across) * axis


def reactive_priority(
    i: Phasor, v: Phasor, i_max: Scalar, open_share: Scalar, eps: Scalar, eps_v: Scalar
) -> Phasor:
    """Cut `i` to |i| <= i_max, giving up current along `v` before current across `v`.

    The active part is held within 0 and the share `open_share`, in [0, 1], of what the reactive part leaves.
    As with :func:`active_priority` the limit is never exceeded, and without voltage the current is 0.
    """
    axis = unit_axis(v, eps_v)
    ask = i * axis.conj()
    across = smooth.sat(ask.im, -i_max, i_max, eps)
    room = smooth.root(i_max * i_max - across * across, eps)
    along = smooth.sat(ask.re, 0.0, open_share * room, eps)
    return Phasor(along, across) * axis


class ActivePriorityLimiter(Block):
    r"""Circular current limit that sheds reactive before active current.

    .. math::
        i_p' = \operatorname{sat}_{[0,\, \chi I]}(i_p), \qquad
        i_q' = \operatorname{sat}_{\pm\sqrt{I^2 - i_p'^2}}(i_q), \qquad I = \kappa\, \beta H

    .. math::
        \chi = \operatorname{sat}_{[0, 1]}\frac{w_{full} - w}{w_{fade}}

    :math:`\kappa` is the share of the limit that the supervisor grants: 1 when coupled, 0 on battery, in
    between while the import is walked in; :math:`\chi` closes the import as the DC link fills up.
    Paper: eqs. (ups_current_limit), (ups_rating_ratio), with S_B = 1 in per unit; "DC-power limit".
    Smoothed with width eps H; |i| never exceeds I. Algebraic: no equilibrium of its own.
    Differs: the active current stays within [0, chi I]. The paper's circle also admits export, although its
    command never asks for one, and names a DC-power limit without an equation.
    Differs: the paper names the staged reconnection without an equation; here the current limit ramps.
    Differs: at |V| far below eps_v the converter blocks (current 0), since an active axis no longer exists.
    """

    beta = Parameter(1.15, "1", (0.5, 3.0), "converter rating over hosted capacity", "illustrative")
    H = Parameter(1.0, "pu(S)", (1e-6, 1e3), "hosted capacity", "decision of the planner")
    w_full = Parameter(1.25, "1", (1.0, 2.0), "DC energy at which no more is imported", "illustrative")
    w_fade = Parameter(0.10, "1", (1e-3, 0.5), "DC energy over which the import closes", "illustrative")
    eps = Parameter(
        1e-3, "pu(I)/pu(S)", (1e-6, 1e-1), "smoothing width per hosted capacity", "own choice: numerics"
    )
    eps_v = Parameter(
        1e-3, "pu(V)", (1e-6, 1e-1), "voltage below which the converter blocks", "own choice: numerics"
    )

    ask = Input("pu(I)", "current asked for", kind=Phasor)
    v = Input("pu(V)", "voltage that defines the active axis, in the frame of the current", kind=Phasor)
    w = Input("1", "DC energy over its nominal value")
    share = Input("1", "share of the limit that the supervisor grants")
    i = Output("pu(I)", "current granted", kind=Phasor)
    i_max = Output("pu(I)", "limit of a coupled converter")
    shortfall = Output(
        "pu(I)", "active current asked for beyond what is granted; below 0 while there is room"
    )

    def equations(self, s: Any) -> Equations:
        i_max = s.beta * s.H
        limit = s.share * i_max
        top = limit * smooth.sat((s.w_full - s.w) / s.w_fade, 0.0, 1.0, s.eps)
        i = active_priority(s.ask, s.v, limit, (0.0, top), s.eps * s.H, s.eps_v)
        asked = (s.ask * unit_axis(s.v, s.eps_v).conj()).re
        return Equations(out=dict(i=i, i_max=i_max, shortfall=asked - top))


class ReactivePriorityLimiter(ActivePriorityLimiter):
    r"""Circular current limit that sheds active before reactive current.

    .. math::
        i_q' = \operatorname{sat}_{\pm I}(i_q), \qquad
        i_p' = \operatorname{sat}_{[0,\, \chi \sqrt{I^2 - i_q'^2}]}(i_p), \qquad I = \kappa\, \beta H

    Same ports, parameters, kappa and chi as the limiter with active priority, which it replaces:
    ``f.replace("lim", ReactivePriorityLimiter())``. For grid codes that put reactive support first in a sag;
    the battery then covers the active power that yields.
    Smoothed with width eps H; |i| never exceeds I. Algebraic: no equilibrium of its own.
    Differs: the paper has active priority only. The DC-energy loop still takes I |V| for the largest import
    and may wind up while reactive current holds the room.
    """

    def equations(self, s: Any) -> Equations:
        i_max = s.beta * s.H
        limit = s.share * i_max
        chi = smooth.sat((s.w_full - s.w) / s.w_fade, 0.0, 1.0, s.eps)
        i = reactive_priority(s.ask, s.v, limit, chi, s.eps * s.H, s.eps_v)
        ask = s.ask * unit_axis(s.v, s.eps_v).conj()
        across = smooth.sat(ask.im, -limit, limit, s.eps * s.H)
        top = chi * smooth.root(limit * limit - across * across, s.eps * s.H)
        return Equations(out=dict(i=i, i_max=i_max, shortfall=ask.re - top))
