"""What the methods of a block give on symbols: evaluated, checked, put in columns."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Any

import casadi as ca

from dcvrt.errors import DcvrtError, ModelError, did_you_mean, is_number
from dcvrt.models.declared import Algebraic, Output, Part, State
from dcvrt.models.phasor import Phasor, Scalar


@dataclass(frozen=True)
class Equations:
    """What a block's equations give: derivatives by state, outputs, residuals by algebraic variable.

    For a state that names its time constant T, `der` holds the right side of T dx/dt = ...
    """

    der: Mapping[str, Scalar] = field(default_factory=dict)
    out: Mapping[str, Scalar | Phasor] = field(default_factory=dict)
    alg: Mapping[str, Scalar] = field(default_factory=dict)


def scalars(value: Any) -> list[Scalar]:
    """The numbers or symbols that a value consists of: one, or two of a phasor; none of anything else."""
    flat = [value.re, value.im] if isinstance(value, Phasor) else [value]
    return flat if all(is_number(v) or (isinstance(v, ca.SX) and v.numel() == 1) for v in flat) else []


def stack(columns: Iterable[Any]) -> ca.SX:
    """Numbers, symbols, columns and phasors in one column of SX."""
    flat: list[Any] = []
    for value in columns:
        flat += [value.re, value.im] if isinstance(value, Phasor) else [value]
    joined: Any = ca.vertcat(*flat) if flat else ca.SX(0, 1)
    return ca.SX(joined)


def on_symbols(block: Part, method: str, s: Any) -> Any:
    """What a method of a block gives on symbols.

    Raises
    ------
    ModelError
        the method fails there; the message shows the line, and what to write instead.
    """
    try:
        return getattr(block, method)(s)
    except DcvrtError:
        raise
    except Exception as error:
        where = ""
        for frame in traceback.extract_tb(error.__traceback__)[1:2]:  # that of the method
            where = f" at {frame.line!r} ({Path(frame.filename).name}, line {frame.lineno})"
        told = re.sub(r"^\S+:\d+: ", "", next((line for line in str(error).splitlines() if line.strip()), ""))
        way_out = next((way for sign, way in WAYS_OUT.items() if sign in told), "")
        raise ModelError(
            f"{s._owner}: {method}() fails on symbols{where}: "
            f"{type(error).__name__}: {told.rstrip('.')}.{way_out}"
        ) from error


WAYS_OUT = {
    "guard": " Compare with below, above, within or outside, and join guards with & and |.",
    "truth value": " A symbol is neither true nor false: put a smooth function (dcvrt.models.smooth) in the "
    "place of if, max, min and comparisons, or make the cases modes.",
    "Port": " `self` holds ports, `s` their values: write s.name.",
    "Phasor": " A phasor v has the parts v.re and v.im and the magnitude smooth.mag(v, eps).",
    "attribute 're'": " A phasor is added to phasors only: Phasor(1.0, 0.0). A number has no parts.",
    "numpy": " Take functions from casadi, which know numbers and symbols: ca.exp(x), ca.sin(x).",
}
"""What to do about an error in the equations, by a part of its text."""


def holds_nan(value: Any) -> bool:
    """Whether NaN stands somewhere in an expression, as ``math.exp`` of a symbol leaves it."""
    expression = stack([value])
    f = ca.Function("look", [stack(ca.symvar(expression))], [expression])
    return any(
        f.instruction_id(k) == ca.OP_CONST and isnan(f.instruction_constant(k))
        for k in range(f.n_instructions())
    )


NO_NUMBER = "holds NaN. Functions of `math` turn symbols into it: take them from casadi, as ca.exp(x)."


def check_equations(path: str, block: Part, eq: Any) -> list[str]:
    """Problems of what `equations` gave: missing, undeclared, of the wrong kind."""
    who = f"{path} ({block.label})"
    if not isinstance(eq, Equations):
        return [f"{who}: equations() must return Equations(der=..., out=...), not {type(eq).__name__}."]
    problems = []
    for what, given, wanted in (
        ("the derivative of state", eq.der, block.declared(State)),
        ("the output", eq.out, block.declared(Output)),
        ("the residual of algebraic variable", eq.alg, block.declared(Algebraic)),
    ):
        for name in wanted:
            if name not in given:
                problems.append(f"{who}: no equation for {what} {name!r}.")
            elif not (parts := scalars(given[name])) or (wanted[name].kind is Phasor) != (len(parts) == 2):
                value: Any = given[name]
                found = type(value).__name__
                if isinstance(value, ca.SX) and value.numel() != 1:
                    found = f"a column of {value.numel()}"
                problems.append(
                    f"{who}: {what} {name!r} is declared as {wanted[name].kind.__name__}, "
                    f"but its equation gives {found}."
                )
            elif holds_nan(given[name]):
                problems.append(f"{who}: the equation for {what} {name!r} {NO_NUMBER}")
        for name in given:
            if name not in wanted:
                problems.append(
                    f"{who}: equation for {what} {name!r}, which is not declared.{did_you_mean(name, wanted)}"
                )
    return problems
