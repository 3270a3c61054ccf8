"""The algebraic part of a system: what determines its variables, and putting some in terms of others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.dae import Dae, Row
from dcvrt.errors import InputError, ModelError, did_you_mean


def matching(pattern: NDArray[np.bool_]) -> dict[int, int]:
    """Which equation (row) determines which variable (column): as many pairs as there can be.

    A variable keeps the equation that was given for it where that depends on it; others are found by
    augmenting paths.
    """
    variable_of = {k: k for k in range(len(pattern)) if pattern[k, k]}

    def assign(variable: int, tried: set[int]) -> bool:
        for equation in (int(k) for k in np.flatnonzero(pattern[:, variable])):
            if equation not in tried:
                tried.add(equation)
                if equation not in variable_of or assign(variable_of[equation], tried):
                    variable_of[equation] = variable
                    return True
        return False

    for variable in sorted(set(range(pattern.shape[1])) - set(variable_of.values())):
        assign(variable, set())
    return variable_of


def structure(g: ca.SX, z: ca.SX) -> NDArray[np.bool_]:
    """Which equation (row) depends on which variable (column)."""
    pattern: NDArray[np.bool_] = np.array(ca.DM(ca.jacobian(g, z).sparsity(), 1).full()) != 0
    return pattern


def check_regular(name: str, g: ca.SX, z: ca.SX, rows: Sequence[Row]) -> None:
    """Refuse an algebraic part in which some variable has no equation of its own to determine it."""
    if not rows:
        return
    variable_of = matching(structure(g, z))
    lost = [row.path for k, row in enumerate(rows) if k not in variable_of.values()]
    idle = [row.path for k, row in enumerate(rows) if k not in variable_of]
    if lost:
        raise ModelError(
            f"{name}: the algebraic part is singular. No equation determines {', '.join(lost)}; "
            f"left over is the equation of {', '.join(idle)}. Let the equations depend on the variables "
            "they are to determine, or make one of the variables a state."
        )


def eliminated(dae: Dae, wanted: bool | Sequence[str], strict: bool = True) -> Dae:
    """The system with algebraic variables put in terms of the others: see :meth:`Diagram.compile`.

    Equations are taken in block-triangular order. A block of one or several must be affine in its variables,
    0 = a z + b, and is solved as z = -b/a. Those that are not are an error, or kept when not `strict`.
    """
    paths = tuple(row.path for row in dae.algebraics)
    if isinstance(wanted, str):
        raise InputError(
            f"eliminate = {wanted!r} must be a tuple of paths, or True: eliminate=({wanted!r},)."
        )
    chosen = list(paths) if wanted is True else list(wanted or ())
    unknown = [path for path in chosen if path not in paths]
    if unknown:
        raise InputError(
            "\n".join(
                f"eliminate: {dae.name} has no algebraic variable {path!r}.{did_you_mean(path, paths)}"
                for path in unknown
            )
        )
    if not chosen:
        return dae
    # An equation is used up with the variable it determines.
    equation_of = {variable: equation for equation, variable in matching(structure(dae.g, dae.z)).items()}
    gone = [k for k, path in enumerate(paths) if path in chosen]
    used = [equation_of[k] for k in gone]
    z, g = dae.z[gone], dae.g[used]
    solution, stuck = _solve(g, z)
    if stuck and not strict:
        return eliminated(dae, [paths[k] for j, k in enumerate(gone) if j not in stuck], strict=False)
    if stuck:
        names = [paths[gone[k]] for k in stuck]
        others = tuple(path for path in chosen if path not in names)
        keep = f"eliminate={others!r}" if others else "leave `eliminate` out"
        raise ModelError(
            f"{dae.name}: {', '.join(names)} cannot be eliminated: "
            f"{'its equation is' if len(names) == 1 else 'their equations are'} not linear in "
            f"{'it' if len(names) == 1 else 'them'}. Way out: keep {'it' if len(names) == 1 else 'them'} as "
            f"algebraic ({keep}), or write the block with an explicit solution."
        )

    def put(*expressions: ca.SX) -> list[ca.SX]:
        placed: list[ca.SX] = ca.substitute(list(expressions), [z], [solution])
        return placed

    left = [k for k in range(len(paths)) if k not in gone]
    rest = [k for k in range(len(paths)) if k not in used]
    together = ca.cse(put(ca.vertcat(dae.f, dae.g[rest], dae.y))[0])
    nx, nz = dae.x.numel(), len(left)
    automata = tuple(
        replace(
            a,
            rows=tuple(
                replace(row, guard=put(row.guard)[0], reset={k: put(e)[0] for k, e in row.reset.items()})
                for row in a.rows
            ),
        )
        for a in dae.automata
    )
    return replace(
        dae,
        z=dae.z[left],
        g=together[nx : nx + nz],
        f=together[:nx],
        y=together[nx + nz :],
        algebraics=tuple(dae.algebraics[k] for k in left),
        automata=automata,
        start=put(dae.start[[*range(nx), *(nx + k for k in left)]])[0],
    )


def _solve(g: ca.SX, z: ca.SX) -> tuple[ca.SX, list[int]]:
    """Explicit solution of g = 0 in z, and the positions in z of those that have none."""
    pattern = ca.jacobian(g, z).sparsity()
    blocks, rows, columns, row_ends, column_ends, *_ = pattern.btf()
    solution = ca.SX(z)
    stuck: list[int] = []
    done: list[int] = []
    for k in range(blocks):
        equations = [rows[j] for j in range(row_ends[k], row_ends[k + 1])]
        variables = [columns[j] for j in range(column_ends[k], column_ends[k + 1])]
        residual, own = g[equations], z[variables]
        if done:
            residual = ca.substitute(residual, z[done], solution[done])
        slope = ca.jacobian(residual, own)
        if ca.depends_on(slope, own):
            stuck += variables
            continue
        constant = ca.substitute(residual, own, ca.SX.zeros(len(variables)))
        explicit = -constant / slope if len(variables) == 1 else ca.solve(ca.densify(slope), -constant)
        for j, variable in enumerate(variables):
            solution[variable] = explicit[j]
        done += variables
    return solution, sorted(stuck)
