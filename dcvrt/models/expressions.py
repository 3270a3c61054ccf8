"""Expressions of parameters: their unit, where that can be told, and how they are written.

A number in an expression may carry any unit ("1400 * beta" is a gain), unless it multiplies something that
has one. So the unit of an expression is a dimension, or open.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from dcvrt.units import Dimension, dimension, product, reduced, unit_text

OPEN = None
"""Dimension of a number, and of what is a number times ratios."""

ALIKE = {ca.OP_ADD: "adds", ca.OP_SUB: "subtracts", ca.OP_FMIN: "compares", ca.OP_FMAX: "compares"}
SAME = {ca.OP_NEG, ca.OP_FABS, ca.OP_TWICE, ca.OP_ASSIGN}
FUNCTIONS = {
    ca.OP_EXP, ca.OP_LOG, ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_SINH,
    ca.OP_COSH, ca.OP_TANH,
}  # fmt: skip


class MixedUnitsError(Exception):
    """Two terms of an expression have units that cannot stand together; the text says which."""


def unit_of(expression: ca.SX, units: Mapping[int, str]) -> str | None:
    """Unit of a scalar expression, or None where a number leaves it open.

    Parameters
    ----------
    expression : of the symbols of parameters.
    units : unit of every symbol by its `element_hash`.

    Raises
    ------
    MixedUnitsError
        a sum of different units, a root of something that has none, a function of something with a unit.

    >>> H, beta = ca.SX.sym("H"), ca.SX.sym("beta")
    >>> known = {H.element_hash(): "pu(S)", beta.element_hash(): "1"}
    >>> unit_of(2 * beta * H, known), unit_of(60 * beta, known), unit_of(1 / H**2, known)
    ('pu(S)', None, '1/pu(S)2')
    """
    symbols = ca.symvar(expression)
    function = ca.Function("e", symbols, [expression])
    work: dict[int, Dimension | None] = {}
    exact: dict[int, float] = {}
    result: Dimension | None = OPEN
    for k in range(function.n_instructions()):
        op, into, of = (
            function.instruction_id(k),
            function.instruction_output(k),
            function.instruction_input(k),
        )
        if op == ca.OP_INPUT:
            work[into[0]] = dimension(units[symbols[of[0]].element_hash()])
            exact.pop(into[0], None)
        elif op == ca.OP_CONST:
            work[into[0]], exact[into[0]] = OPEN, function.instruction_constant(k)
        elif op == ca.OP_OUTPUT:
            result = work[of[0]]
        else:
            work[into[0]] = _result(op, [work[j] for j in of], [exact.get(j) for j in of])
            exact.pop(into[0], None)
    return None if result is OPEN else unit_text(result)


def _result(op: int, terms: list[Dimension | None], numbers: list[float | None]) -> Dimension | None:
    """Dimension that an operation gives."""
    a, b = terms[0], terms[-1]
    if op in SAME:
        return a
    if op in ALIKE:
        if a is not OPEN and b is not OPEN and reduced(a) != reduced(b):
            raise MixedUnitsError(f"{ALIKE[op]} [{unit_text(a)}] and [{unit_text(b)}]")
        return a if b is OPEN else b
    if op in (ca.OP_MUL, ca.OP_DIV):
        if (a is OPEN and not b) or (b is OPEN and not a):
            return OPEN
        return product((a or (), 1), (b or (), 1 if op == ca.OP_MUL else -1))
    if op == ca.OP_INV:
        return OPEN if a is OPEN else product((a, -1))
    if op == ca.OP_SQ:
        return OPEN if a is OPEN else product((a, 2))
    if op in (ca.OP_POW, ca.OP_CONSTPOW) and a:
        exponent = numbers[-1]
        if exponent is None or exponent != int(exponent):
            raise MixedUnitsError(f"raises [{unit_text(a)}] to a power that is no whole number")
        return product((a, int(exponent)))
    if op == ca.OP_SQRT and a:
        if any(n % 2 for _, n in reduced(a)):
            raise MixedUnitsError(f"takes the root of [{unit_text(a)}]")
        return tuple((base, n // 2) for base, n in reduced(a))
    if op in FUNCTIONS and a and a != dimension("rad"):
        raise MixedUnitsError(f"takes a function of [{unit_text(a)}]; divide by its base first")
    return OPEN if a is OPEN else ()


INFIX = {
    ca.OP_ADD: (" + ", 1), ca.OP_SUB: (" - ", 1), ca.OP_MUL: ("*", 2), ca.OP_DIV: ("/", 2),
    ca.OP_POW: ("**", 3), ca.OP_CONSTPOW: ("**", 3),
}  # fmt: skip
"""How tightly an operator binds; what binds less tightly inside it stands in parentheses."""
CALLS = {
    ca.OP_SQRT: "sqrt", ca.OP_FABS: "abs", ca.OP_EXP: "exp", ca.OP_LOG: "log", ca.OP_SIN: "sin",
    ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_ATAN: "atan", ca.OP_ATAN2: "atan2", ca.OP_FMIN: "min",
    ca.OP_FMAX: "max", ca.OP_TANH: "tanh", ca.OP_ACOS: "acos", ca.OP_ASIN: "asin",
}  # fmt: skip
ATOM = 4


def text_of(expression: Any) -> str:
    """A number, symbol or expression as a person writes it.

    >>> a, b = ca.SX.sym("a"), ca.SX.sym("b")
    >>> text_of((1 - 1 / a) * (1 - b)), text_of(a - (b - 0.5)), text_of(2 * ca.sqrt(a) ** 2), text_of(0.25)
    ('(1 - 1/a)*(1 - b)', 'a - (b - 0.5)', '2*a', '0.25')
    """
    if not isinstance(expression, ca.SX):
        return f"{expression:g}" if isinstance(expression, (int, float)) else str(expression)
    symbols = ca.symvar(expression)
    function = ca.Function("e", symbols, [ca.densify(expression)])
    work: dict[int, tuple[str, int]] = {}
    result = "0"
    for k in range(function.n_instructions()):
        op, into, of = (
            function.instruction_id(k),
            function.instruction_output(k),
            function.instruction_input(k),
        )
        if op == ca.OP_INPUT:
            work[into[0]] = str(symbols[of[0]]), ATOM
        elif op == ca.OP_CONST:
            number = function.instruction_constant(k)
            work[into[0]] = f"{number:g}", ATOM if number >= 0 else 1
        elif op == ca.OP_OUTPUT:
            result = work[of[0]][0]
        else:
            work[into[0]] = _written(op, [work[j] for j in of])
    return result


def _written(op: int, terms: list[tuple[str, int]]) -> tuple[str, int]:
    """Text of an operation and how tightly it binds."""

    def inside(term: tuple[str, int], least: int) -> str:
        return term[0] if term[1] >= least else f"({term[0]})"

    first, last = terms[0], terms[-1]
    if op in INFIX:
        sign, strength = INFIX[op]
        # what comes after a minus or a slash keeps its parentheses
        after = strength + (op in (ca.OP_SUB, ca.OP_DIV, ca.OP_POW, ca.OP_CONSTPOW))
        return inside(first, strength) + sign + inside(last, after), strength
    if op == ca.OP_NEG:
        return "-" + inside(first, 2), 1
    if op == ca.OP_INV:
        return "1/" + inside(first, 3), 2
    if op == ca.OP_SQ:
        return inside(first, ATOM) + "**2", 3
    if op == ca.OP_TWICE:
        return "2*" + inside(first, 2), 2
    if op == ca.OP_ASSIGN:
        return first
    name = CALLS.get(op, f"operation {op} of ")
    return f"{name}({', '.join(term[0] for term in terms)})", ATOM
