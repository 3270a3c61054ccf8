"""What the blocks of a unit share: their form, lags and lead-lags, limits, saturation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from typing import Any, ClassVar

import casadi as ca

from dcvrt.errors import InputError, raise_all
from dcvrt.models.automaton import Go, above, below
from dcvrt.models.block import SHORTEST, Block
from dcvrt.models.declared import State
from dcvrt.models.phasor import Phasor, Scalar

UNLIMITED = 999.0
"""What a limit that the data leave at 0 stands for, where the model says so."""


class UnitBlock(Block):
    """Block of a generating unit: its values decide which terms its equations have.

    - `optional`: parameters of which 0 leaves something out. Once compiled they stay 0, or may be set.
    - `switches`: parameters of which every value is another model. Once compiled they stay.
    - `ordered`: pairs of parameters, lower limit first.

    Time constants need not be named here: 0 always leaves out their state.
    """

    optional_terms: ClassVar[bool] = True
    optional: ClassVar[tuple[str, ...]] = ()
    switches: ClassVar[tuple[str, ...]] = ()
    ordered: ClassVar[tuple[tuple[str, str], ...]] = ()

    def __init__(self, **values: float) -> None:
        super().__init__(**values)
        crossed = [
            f"{low} = {self.values[low]:g} is above {high} = {self.values[high]:g}. Exchange or correct them."
            for low, high in self.ordered
            if self.values[low] > self.values[high]
        ]
        raise_all(crossed, type(self).__name__, InputError)

    def is_off(self, parameter: str) -> bool:
        """Whether the block was made with this parameter at 0, which leaves something out."""
        return self.values[parameter] == 0

    def settable(self, parameter: str) -> tuple[float, float]:
        value = self.values[parameter]
        if parameter in self.switches:
            return value, value
        low, high = super().settable(parameter)
        if parameter in self.optional:
            return (0.0, 0.0) if value == 0 else (max(low, min(value, SHORTEST)) if low == 0 else low, high)
        return low, high

    def traits(self) -> tuple[Any, ...]:
        """What decides the equations beside zeros and switches."""
        return ()

    def form(self) -> tuple[Any, ...]:
        """What decides the equations: blocks of one form have the same ones, with other numbers."""
        times = {state.time for state in self.declared(State).values()} - {""}
        deciding = sorted(times | set(self.optional))
        return (
            type(self).__name__,
            tuple(name for name in deciding if self.is_off(name)),
            tuple(self.values[name] for name in self.switches),
            *self.traits(),
        )


def magnitude(v: Phasor) -> Scalar:
    """Magnitude of a phasor. Its derivative does not exist at 0: a bolted fault at the very terminal."""
    return ca.sqrt(v.abs2())


def lead_lag(u: Scalar, x: Scalar, T_lead: Scalar, T_lag: Scalar, passes: bool) -> Scalar:
    """Output of (1 + s T_lead) / (1 + s T_lag), T_lag dx/dt = u - x; the input itself where it `passes`."""
    return u if passes else x + T_lead / T_lag * (u - x)


# -- limits ------------------------------------------------------------------------------------------------

LIMITED = ("FREE", "UPPER", "LOWER")
LIMIT_FLAGS = {"free": (1, 0, 0), "upper": (0, 1, 0), "lower": (0, 0, 1)}
RELEASE = 1e-9
"""By how much the target must be inside a limit for a state to leave it, pu: above round-off, below accuracy.
At the instant of release the state is on the limit and the rate 0: else its last bit would decide."""
CLIPPED = (
    "a limited signal is continuous over its limit, so that whatever drives it crosses with one and the same "
    "rate before and after"
)


def limited(s: Any, inside: Scalar, low: Scalar, high: Scalar) -> Scalar:
    """The value in the present mode: as it comes, or on a limit."""
    return s.free * inside + s.upper * high + s.lower * low


def lag_side(s: Any, x: Scalar, target: Scalar, low: Scalar, high: Scalar, at_once: bool) -> Scalar:
    """Right side of the limited lag T dx/dt = target - x; `at_once` where T is 0, x the limited target."""
    return limited(s, target, low, high) - x if at_once else s.free * (target - x)


def lag_rows(
    state: str, x: Scalar, target: Scalar, low: Scalar, high: Scalar, at_once: bool
) -> tuple[Go, ...]:
    """Rows of the limited lag."""
    return clip_rows(target, low, high) if at_once else windup_rows(state, x, target, low, high)


def lag_value(s: Any, x: Scalar, low: Scalar, high: Scalar, at_once: bool) -> Scalar:
    """What a lag gives whose limits move: its state, or the limit as it is now."""
    return x if at_once else limited(s, x, low, high)


def clip_rows(signal: Scalar, low: Scalar, high: Scalar) -> tuple[Go, ...]:
    """Rows of a signal without memory that is cut off at two limits."""
    return (
        Go("FREE", "UPPER", above(signal, high), settles=CLIPPED),
        Go("FREE", "LOWER", below(signal, low), settles=CLIPPED),
        Go("UPPER", "FREE", below(signal, high), settles=CLIPPED),
        Go("LOWER", "FREE", above(signal, low), settles=CLIPPED),
    )


def windup_rows(state: str, x: Scalar, target: Scalar, low: Scalar, high: Scalar) -> tuple[Go, ...]:
    """Rows of a lag T dx/dt = target - x that stops on its limits.

    It enters a limit when it is beyond it and still moves outwards, and is put on it; it leaves once the
    rate turns inwards, and starts from the limit as it is then. To come back the rate must first turn
    outwards again, by `RELEASE`, so that it cannot chatter.
    """
    return (
        Go("FREE", "UPPER", above(x, high) & above(target - x, 0.0), reset={state: high}),
        Go("FREE", "LOWER", below(x, low) & below(target - x, 0.0), reset={state: low}),
        Go("UPPER", "FREE", below(target - high, -RELEASE), reset={state: high}),
        Go("LOWER", "FREE", above(target - low, RELEASE), reset={state: low}),
    )


def product(first: Sequence[Go], second: Sequence[Go], of_first: Sequence[str] = LIMITED) -> tuple[Go, ...]:
    """Rows of two limiters that stand in one block; its modes are pairs, `PAIRS` where both have three."""
    rows = [
        replace(row, source=f"{row.source}_{other}", target=f"{row.target}_{other}")
        for other in LIMITED
        for row in first
    ]
    rows += [
        replace(row, source=f"{other}_{row.source}", target=f"{other}_{row.target}")
        for other in of_first
        for row in second
    ]
    return tuple(rows)


PAIRS = tuple(f"{one}_{other}" for one in LIMITED for other in LIMITED)


def pair_flags(first: str, second: str) -> dict[str, tuple[int, ...]]:
    """Flags of two limiters in one block: those of the first with one prefix, of the second with another."""
    n = len(LIMITED)
    return {
        f"{first}{name}": tuple(flag for flag in c for _ in range(n)) for name, c in LIMIT_FLAGS.items()
    } | {f"{second}{name}": c * n for name, c in LIMIT_FLAGS.items()}


class Flags:
    """The flags of one of two limiters in a block, as if it were alone."""

    def __init__(self, s: Any, prefix: str) -> None:
        self.free = getattr(s, f"{prefix}free")
        self.upper = getattr(s, f"{prefix}upper")
        self.lower = getattr(s, f"{prefix}lower")


# -- saturation --------------------------------------------------------------------------------------------


def quadratic(E_1: float, SE_1: float, E_2: float, SE_2: float) -> tuple[float, float]:
    """Onset A and gain B of B (x - A)^2 / x through two points of a saturation curve, S(E_1) and S(E_2).

    Corrections as in ANDES: S(E_2) = 0 becomes 2 at E_2 + 2; no saturation where S(E_1) or E_1 is 0.

    >>> A, B = quadratic(1.0, 0.0392, 1.2, 0.2227)
    >>> round(B * (1.0 - A) ** 2, 6), round(B * (1.2 - A) ** 2 / 1.2, 6)
    (0.0392, 0.2227)
    """
    if SE_2 == 0:
        E_2, SE_2 = E_2 + 2, SE_2 + 2
    products = SE_1 * E_1, SE_2 * E_2
    if products[1] == 0 or products[0] / products[1] < 0:
        raise InputError(
            f"saturation: S({E_1:g}) = {SE_1:g} and S({E_2:g}) = {SE_2:g} do not lie on a curve. "
            "Give two points with the same sign, or S = 0 at the first for none."
        )
    a = sqrt(products[0] / products[1])
    if a == 0:
        return E_2 - (E_2 - E_1), 0.0
    if a == 1 or E_1 == E_2:
        raise InputError(
            f"saturation: S({E_1:g}) = {SE_1:g} and S({E_2:g}) = {SE_2:g} do not fix a curve. "
            "Give two points that differ in E and in E S(E)."
        )
    return E_2 - (E_1 - E_2) / (a - 1), products[1] * (a - 1) ** 2 / (E_1 - E_2) ** 2


def saturation(x: Scalar, onset: Scalar, gain: Scalar) -> Scalar:
    """What saturation adds to a voltage x: gain (x - onset)^2 above the onset, with a continuous slope."""
    beyond = ca.fmax(x - onset, 0.0)
    return gain * beyond * beyond
