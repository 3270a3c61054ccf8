"""Gaussian elimination of a sparse matrix whose pattern is known, as C text without loops.

The matrix is that of an implicit method, W = diag(d) - J, with d on the rows of the states alone. Pivots are
chosen here, by pattern: the diagonal, with rows of algebraic variables exchanged where it is empty; in the
order in which each elimination fills in least (Markowitz). What the pattern cannot tell - a pivot that is too
small beside the rest of its column - is told by the C code, which watches how rows grow while it eliminates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

Entry = tuple[int, int]


def pivot_rows(entries: Sequence[Entry], states: int, size: int) -> list[int]:
    """Row of the pivot in every column: the diagonal where it may be, else of algebraic columns a matching.

    >>> pivot_rows([(1, 2), (2, 1), (2, 2)], 1, 3)
    [0, 2, 1]
    """
    known = set(entries)
    below = {j: [i for i in range(states, size) if (i, j) in known] for j in range(states, size)}
    owner: dict[int, int] = {}

    def place(column: int, tried: set[int]) -> bool:
        for row in sorted(below[column], key=lambda i: i != column):
            if row not in tried:
                tried.add(row)
                if row not in owner or place(owner[row], tried):
                    owner[row] = column
                    return True
        return False

    for column in range(states, size):
        place(column, set())
    row_of = {column: row for row, column in owner.items()}
    free = [i for i in range(states, size) if i not in owner]
    return [*range(states), *(row_of[j] if j in row_of else free.pop(0) for j in range(states, size))]


class Elimination:
    """Order, fill and C text of the elimination.

    Parameters
    ----------
    entries : rows and columns of J, in the order of its nonzeros.
    states, size : rows with the diagonal d; all rows.
    """

    def __init__(self, entries: Sequence[Entry], states: int, size: int) -> None:
        self.entries, self.states, self.size = list(entries), states, size
        self.rows = pivot_rows(self.entries, states, size)
        #: position in `rows`, and so the column of the pivot, of every row
        at = {row: k for k, row in enumerate(self.rows)}
        self.pattern = {(at[i], j) for i, j in self.entries} | {(k, k) for k in range(size)}
        self.steps: list[tuple[int, list[int], list[int]]] = []
        """Pivot, rows below it, columns right of it; rows are numbered by the column of their pivot."""
        self._eliminate()

    def _eliminate(self) -> None:
        pattern, left = set(self.pattern), list(range(self.size))
        while left:
            rest = {
                k: (
                    [i for i in left if i != k and (i, k) in pattern],
                    [j for j in left if j != k and (k, j) in pattern],
                )
                for k in left
            }
            k = min(left, key=lambda k, rest=rest: len(rest[k][0]) * len(rest[k][1]))  # type: ignore[misc]
            below, right = rest[k]
            pattern |= {(i, j) for i in below for j in right}
            left.remove(k)
            self.steps.append((k, below, right))
        slots: dict[Entry, int] = {}
        for k, below, right in self.steps:
            for entry in ((k, k), *((i, k) for i in below), *((k, j) for j in right)):
                slots[entry] = len(slots)
        self.slots = slots

    def text(self) -> str:
        """`eliminate_in_order`, and `solve_in_order` for reals and for columns."""
        lines = [
            f"enum {{ FACTORS = {len(self.slots)} }};",
            "static lanes_mask eliminate_in_order(const real *restrict jacobian, real d, real *restrict lu)",
            "{",
            "  lanes_mask grown = {0};",
            *(f"  {line}" for line in self._factors()),
            "  return grown;\n}",
        ]
        for name, kind in (("solve_in_order", "real"), ("solve_columns_in_order", "column")):
            lines.append(f"static void {name}(const real *restrict lu, {kind} *restrict b) {{")
            lines += [f"  {line}" for line in self._solution(kind)]
            lines.append("}")
        return "\n".join(lines) + "\n"

    def _factors(self) -> Iterator[str]:
        at = {row: k for k, row in enumerate(self.rows)}
        known: dict[Entry, str] = {}
        for number, (i, j) in enumerate(self.entries):
            diagonal = "d " if i == j and i < self.states else ""
            known[at[i], j] = f"{diagonal}- jacobian[{number}]"
        for k in range(self.states):
            known.setdefault((k, k), "d")
        for (i, j), value in sorted(known.items()):
            yield f"real a{i}_{j} = {value};"
        changed = {i for _, below, _ in self.steps for i in below}
        for i in sorted(changed):
            sizes = [f"absolute(a{i}_{j})" for r, j in sorted(known) if r == i]
            yield f"const real most{i} = {f'GROWTH * {_largest(sizes)}' if sizes else 'd - d'};"
        for k, below, right in self.steps:
            if (k, k) not in known:
                known[k, k] = ""
                yield f"real a{k}_{k} = d - d;"
            yield f"const real p{k} = 1.0 / a{k}_{k};"
            yield f"lu[{self.slots[k, k]}] = p{k};"
            if below:
                sizes = [f"absolute(a{k}_{j})" for j in (k, *right)]
                yield f"const real row{k} = {_largest(sizes)};"
            for j in right:
                yield f"lu[{self.slots[k, j]}] = a{k}_{j};"
            for i in below:
                yield f"const real l{i}_{k} = a{i}_{k} * p{k};"
                yield f"lu[{self.slots[i, k]}] = l{i}_{k};"
                yield f"grown |= not_at_most(absolute(l{i}_{k}) * row{k}, most{i});"
                for j in right:
                    if (i, j) in known:
                        yield f"a{i}_{j} -= l{i}_{k} * a{k}_{j};"
                    else:
                        known[i, j] = ""
                        yield f"real a{i}_{j} = -l{i}_{k} * a{k}_{j};"

    def _solution(self, kind: str) -> Iterator[str]:
        for k in range(self.size):
            yield f"{kind} y{k} = b[{self.rows[k]}];"
        for k, below, _ in self.steps:
            for i in below:
                yield f"y{i} -= lu[{self.slots[i, k]}] * y{k};"
        for k, _, right in reversed(self.steps):
            for j in right:
                yield f"y{k} -= lu[{self.slots[k, j]}] * y{j};"
            yield f"y{k} *= lu[{self.slots[k, k]}];"
        for k in range(self.size):
            yield f"b[{k}] = y{k};"


def _largest(terms: Sequence[str]) -> str:
    text = terms[0]
    for term in terms[1:]:
        text = f"larger({text}, {term})"
    return text
