"""C text of CasADi SX expressions: one statement an operation, on a type that holds one case or many.

Every expression of a model is numbered in one table, where equal operations on equal operands are one value.
A value belongs to one of four classes, and is computed where its class is:

* *fixed*: it depends on parameters and flags alone. It is computed on entry to a mode and kept in an array.
* *moving*: it depends on time, states or inputs, and is computed in every call, on type ``real``.
* a *column* of either: it depends on the seeds of a derivative, and is computed once for every group of
  columns, on type ``column``, in a loop behind the rest of the function.

A quotient by a value that is fixed, that divides more than one numerator, or that divides columns becomes a
product with its reciprocal: one division instead of many, at an error of one more rounding.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from dcvrt.errors import ModelError

# Operations as C: {0} and {1} are the operands. Those in INFIX take a number and a vector together;
# the others are functions of lanes.h, whose operands must have the type of the result.
INFIX = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
}
CALLS = {
    ca.OP_SQRT: "root",
    ca.OP_SIN: "sine",
    ca.OP_COS: "cosine",
    ca.OP_TAN: "tangent",
    ca.OP_ASIN: "arcsine",
    ca.OP_ACOS: "arccosine",
    ca.OP_ATAN: "arctangent",
    ca.OP_ATAN2: "angle",
    ca.OP_SINH: "hyperbolic_sine",
    ca.OP_COSH: "hyperbolic_cosine",
    ca.OP_TANH: "hyperbolic_tangent",
    ca.OP_ASINH: "area_sine",
    ca.OP_ACOSH: "area_cosine",
    ca.OP_ATANH: "area_tangent",
    ca.OP_EXP: "exponential",
    ca.OP_LOG: "logarithm",
    ca.OP_EXPM1: "exponential_less_one",
    ca.OP_LOG1P: "logarithm_of_one_more",
    ca.OP_POW: "power",
    ca.OP_CONSTPOW: "power",
    ca.OP_HYPOT: "hypotenuse",
    ca.OP_ERF: "error_function",
    ca.OP_FABS: "absolute",
    ca.OP_SIGN: "sign_of",
    ca.OP_COPYSIGN: "with_sign_of",
    ca.OP_FLOOR: "down",
    ca.OP_CEIL: "up",
    ca.OP_FMOD: "remainder_of",
    ca.OP_FMIN: "smaller",
    ca.OP_FMAX: "larger",
    ca.OP_LT: "is_less",
    ca.OP_LE: "is_at_most",
    ca.OP_EQ: "is_equal",
    ca.OP_NE: "is_other",
    ca.OP_NOT: "is_false",
    ca.OP_AND: "both",
    ca.OP_OR: "either",
    ca.OP_IF_ELSE_ZERO: "where",
}
SYMMETRIC = {ca.OP_ADD, ca.OP_MUL, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR}
NAMES = {v: k for k, v in vars(ca).items() if k.startswith("OP_") and isinstance(v, int)}


@dataclass(frozen=True)
class Argument:
    """Symbols that the functions read: where the C text finds them, and the class that they belong to."""

    place: str
    symbols: ca.SX
    fixed: bool = False
    column: bool = False


@dataclass(frozen=True)
class Value:
    """One operation, constant or argument; equal ones are one value."""

    op: int
    operands: tuple[int, ...] = ()
    number: float = 0.0
    source: tuple[int, int] = (-1, -1)


class Program:
    """C functions of common arguments with common subexpressions.

    Parameters
    ----------
    arguments : the symbols, each a dense column.
    functions : results by function name, each a list of ``(name, expression)``. Matrices are written column
        after column. A result that depends on a column seed is written once for every group of columns.
    columns : results that are columns even where they depend on no seed (a derivative that is zero).

    Raises
    ------
    ModelError
        an operation that has no C text.
    """

    def __init__(
        self,
        arguments: Sequence[Argument],
        functions: Mapping[str, Sequence[tuple[str, ca.SX]]],
        columns: Sequence[str] = (),
    ) -> None:
        self.arguments = list(arguments)
        self.functions = {name: [r for r, _ in results] for name, results in functions.items()}
        self.columns = set(columns)
        flat = [ca.densify(ca.vec(e)) for results in functions.values() for _, e in results]
        whole = ca.Function("whole", [a.symbols for a in arguments], flat or [ca.SX(0, 1)])
        self.values: list[Value] = []
        outputs = self._numbered(whole)
        self.outputs: dict[str, list[list[int]]] = {}
        k = 0
        for name, results in self.functions.items():
            self.outputs[name] = [
                [outputs[k + r][i] for i in range(flat[k + r].numel())] for r in range(len(results))
            ]
            k += len(results)
        self._classify()
        self._reciprocals()
        self._classify()
        self._hoist()

    # -- the table ----------------------------------------------------------------------------------------

    def _numbered(self, whole: ca.Function) -> list[dict[int, int]]:
        """Walk the instructions; for each result the value of each element."""
        self.values = []
        self._known: dict[Value, int] = {}
        work: dict[int, int] = {}
        outputs: list[dict[int, int]] = [{} for _ in range(whole.n_out())]
        for k in range(whole.n_instructions()):
            op, into = whole.instruction_id(k), whole.instruction_output(k)
            if op == ca.OP_CONST:
                work[into[0]] = self._constant(whole.instruction_constant(k))
            elif op == ca.OP_INPUT:
                argument, element = whole.instruction_input(k)
                work[into[0]] = self._value(Value(op, source=(argument, element)))
            elif op == ca.OP_OUTPUT:
                outputs[into[0]][into[1]] = work[whole.instruction_input(k)[0]]
            else:
                work[into[0]] = self._operation(op, *(work[i] for i in whole.instruction_input(k)))
        return outputs

    def _value(self, value: Value) -> int:
        if value not in self._known:
            self._known[value] = len(self.values)
            self.values.append(value)
        return self._known[value]

    def _constant(self, number: float) -> int:
        return self._value(Value(ca.OP_CONST, number=number))

    def _number(self, k: int) -> float | None:
        value = self.values[k]
        return value.number if value.op == ca.OP_CONST else None

    def _operation(self, op: int, *operands: int) -> int:
        """Number an operation, simplified where that is exact (or one rounding away, for reciprocals)."""
        if op not in INFIX and op not in CALLS:
            raise ModelError(
                f"the operation {NAMES.get(op, op)} has no C text. Way out: write the equation without it, "
                "or solve with Casadi(interpreted=True)."
            )
        numbers = [self._number(k) for k in operands]
        a, b = operands[0], operands[-1]
        if op in (ca.OP_SIN, ca.OP_COS) and self.values[a].op == ca.OP_NEG:
            inner = self._operation(op, self.values[a].operands[0])
            return inner if op == ca.OP_COS else self._operation(ca.OP_NEG, inner)
        if op in (ca.OP_POW, ca.OP_CONSTPOW) and numbers[1] is not None:
            simple = self._power(a, numbers[1])
            if simple is not None:
                return simple
        if op == ca.OP_NEG and self.values[a].op == ca.OP_NEG:
            return self.values[a].operands[0]
        if op == ca.OP_DIV and numbers[1] not in (None, 0.0):
            return self._operation(ca.OP_MUL, a, self._constant(1.0 / float(numbers[1] or 1.0)))
        if op == ca.OP_ADD and self.values[b].op == ca.OP_NEG:
            return self._operation(ca.OP_SUB, a, self.values[b].operands[0])
        if op == ca.OP_SUB and self.values[b].op == ca.OP_NEG:
            return self._operation(ca.OP_ADD, a, self.values[b].operands[0])
        if op in SYMMETRIC:
            operands = tuple(sorted(operands))
        return self._value(Value(op, operands))

    def _power(self, a: int, exponent: float) -> int | None:
        """Small whole and half powers as products and roots."""
        if exponent == 0.5:
            return self._operation(ca.OP_SQRT, a)
        if exponent != round(exponent) or not 1 <= abs(exponent) <= 16:
            return None
        if exponent < 0:
            whole = self._power(a, -exponent)
            return None if whole is None else self._operation(ca.OP_INV, whole)
        result, square, left = -1, a, int(exponent)
        while left:
            if left & 1:
                result = square if result < 0 else self._operation(ca.OP_MUL, result, square)
            left >>= 1
            if left:
                square = self._operation(ca.OP_SQ, square)
        return result

    def _classify(self) -> None:
        self.fixed: list[bool] = []
        self.column: list[bool] = []
        for value in self.values:
            if value.op == ca.OP_INPUT:
                argument = self.arguments[value.source[0]]
                self.fixed.append(argument.fixed)
                self.column.append(argument.column)
            else:
                self.fixed.append(all(self.fixed[k] for k in value.operands))
                self.column.append(any(self.column[k] for k in value.operands))

    def _reciprocals(self) -> None:
        """Turn quotients into products where their divisor is fixed, shared, or not a column as they are."""
        old, roots = self.values, self.outputs
        divisors = Counter(v.operands[1] for v in old if v.op == ca.OP_DIV)
        divisors.update(v.operands[0] for v in old if v.op == ca.OP_INV)
        fixed, column = self.fixed, self.column
        self.values, self._known = [], {}
        new: list[int] = []
        for k, value in enumerate(old):
            if value.op == ca.OP_DIV:
                a, b = value.operands
                if (fixed[b] and not fixed[a]) or divisors[b] > 1 or (column[a] and not column[b]):
                    inverse = self._value(Value(ca.OP_INV, (new[b],)))
                    new.append(self._value(Value(ca.OP_MUL, tuple(sorted((new[a], inverse))))))
                    continue
            new.append(
                self._value(
                    Value(value.op, tuple(new[i] for i in value.operands), value.number, value.source)
                )
            )
            assert len(new) == k + 1
        self.outputs = {n: [[new[i] for i in r] for r in results] for n, results in roots.items()}

    def _reachable(self, name: str) -> list[int]:
        """Values that a function needs, in order; fixed ones are read, not computed."""
        seen: set[int] = set()
        stack = [k for r in self.outputs[name] for k in r]
        while stack:
            k = stack.pop()
            if k not in seen:
                seen.add(k)
                if not self.fixed[k]:
                    stack += self.values[k].operands
        return sorted(seen)

    def _hoist(self) -> None:
        """Places of the fixed values that some function reads."""
        kept = sorted(
            {
                k
                for name in self.functions
                for k in self._reachable(name)
                if self.fixed[k] and self.values[k].op != ca.OP_CONST
            }
        )
        self.kept = {k: n for n, k in enumerate(k for k in kept if not self.column[k])}
        self.kept_columns = {k: n for n, k in enumerate(k for k in kept if self.column[k])}

    # -- text ---------------------------------------------------------------------------------------------

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of fixed values kept: `fixed`, and `fixed_columns` for every group."""
        return {"fixed": len(self.kept), "fixed_columns": len(self.kept_columns)}

    def hoisting(self, name: str) -> str:
        """Function that computes the fixed values, on one case."""
        needed: set[int] = set()
        stack = [*self.kept, *self.kept_columns]
        while stack:
            k = stack.pop()
            if k not in needed:
                needed.add(k)
                stack += self.values[k].operands
        order = sorted(needed)
        body = list(self._statements([k for k in order if not self.column[k]], False, "  "))
        body += [f"  m[{n}] = {self._operand(k, False)};" for k, n in self.kept.items()]
        if self.kept_columns:
            body.append("  for (int g = 0; g < GROUPS; g++) {")
            body += self._statements([k for k in order if self.column[k]], False, "    ")
            stride = len(self.kept_columns)
            body += [
                f"    mc[g * {stride} + {n}] = {self._operand(k, False)};"
                for k, n in self.kept_columns.items()
            ]
            body.append("  }")
        places = sorted({a.place for a in self.arguments if a.fixed and not a.column})
        seeds = sorted({a.place for a in self.arguments if a.fixed and a.column})
        given = ", ".join([f"const real *{p}" for p in places] + [f"const column *{p}" for p in seeds])
        unused = "".join(f" (void){p};" for p in (*places, *seeds, "m", "mc"))
        return (
            f"static void {name}({given}, real *m, column *mc) {{\n "
            + unused
            + "\n"
            + "\n".join(body)
            + "\n}\n"
        )

    def function(self, name: str) -> str:
        """One function: results of type real, then columns, group after group."""
        reach = [k for k in self._reachable(name) if not self.fixed[k]]
        results = list(zip(self.functions[name], self.outputs[name], strict=True))
        wide = {r for r, elements in results if r in self.columns or any(self.column[k] for k in elements)}
        body = list(self._statements([k for k in reach if not self.column[k]], True, "  "))
        for result, elements in results:
            if result not in wide:
                body += [f"  {result}[{i}] = {self._as(k, 'real', True)};" for i, k in enumerate(elements)]
        if wide:
            body.append("  for (int g = 0; g < GROUPS; g++) {")
            body += self._statements([k for k in reach if self.column[k]], True, "    ")
            for result, elements in results:
                if result in wide:
                    body += [
                        f"    {result}[g * {len(elements)} + {i}] = {self._as(k, 'column', True)};"
                        for i, k in enumerate(elements)
                    ]
            body.append("  }")
        given = ", ".join(f"{'column' if r in wide else 'real'} *restrict {r}" for r, _ in results)
        unused = " ".join(f"(void){r};" for r in ("at", *(r for r, _ in results)))
        return (
            f"static void {name}(const struct point *restrict at, {given}) {{\n  {unused}\n"
            + "\n".join(body)
            + "\n}\n"
        )

    def _statements(self, order: Sequence[int], in_function: bool, indent: str) -> Iterator[str]:
        for k in order:
            value = self.values[k]
            if value.op in (ca.OP_CONST, ca.OP_INPUT):
                continue
            kind = "column" if self.column[k] else "real"
            if value.op in INFIX:
                text = INFIX[value.op].format(*(self._operand(i, in_function) for i in value.operands))
                if all(self.values[i].op == ca.OP_CONST for i in value.operands):
                    text = f"{self._splat(kind)}({text})"
            else:
                given = ", ".join(self._as(i, kind, in_function) for i in value.operands)
                text = f"{CALLS[value.op]}({given})"
            yield f"{indent}const {kind} v{k} = {text};"

    def _operand(self, k: int, in_function: bool) -> str:
        """How a value is written where it is used."""
        value = self.values[k]
        if value.op == ca.OP_CONST:
            return literal(value.number)
        if in_function and self.fixed[k]:
            if self.column[k]:
                return f"at->mc[g * {len(self.kept_columns)} + {self.kept_columns[k]}]"
            return f"at->m[{self.kept[k]}]"
        if value.op == ca.OP_INPUT:
            argument = self.arguments[value.source[0]]
            at = "at->" if in_function else ""
            if argument.column:
                return f"{at}{argument.place}[g * {argument.symbols.numel()} + {value.source[1]}]"
            return f"{at}{argument.place}[{value.source[1]}]"
        return f"v{k}"

    def _as(self, k: int, kind: str, in_function: bool) -> str:
        """A value as an operand of exactly this type."""
        text = self._operand(k, in_function)
        if self.values[k].op == ca.OP_CONST:
            return f"{self._splat(kind)}({text})"
        return f"widened({text})" if kind == "column" and not self.column[k] else text

    @staticmethod
    def _splat(kind: str) -> str:
        return "all_columns" if kind == "column" else "all_lanes"


def literal(number: float) -> str:
    """A number as C text that reads back as the same double.

    >>> literal(0.1), literal(3.0), literal(-1e300), literal(float("inf"))
    ('0.1', '3.0', '(-1e+300)', 'INFINITY')
    """
    if math.isnan(number):
        return "NAN"
    if math.isinf(number):
        return "INFINITY" if number > 0 else "(-INFINITY)"
    text = repr(float(number))
    return text if number >= 0 and not text.startswith("-") else f"({text})"
