"""Checks that every block must pass, for the tests of those who write new ones."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dcvrt.models.block import Block, Equations
from dcvrt.models.declared import Algebraic, Declared, Input, Parameter, State
from dcvrt.models.evaluation import check_equations, on_symbols, scalars, stack
from dcvrt.models.phasor import Phasor

Array = NDArray[np.float64]
STEP = 1e-6
"""Relative step of the differences."""


def assert_consistent(
    block: Block, ranges: Mapping[str, tuple[float, float]] | None = None, points: int = 20, seed: int = 0
) -> None:
    """Check a block at random points: the same on numbers and on symbols, derivatives equal to differences.

    Parameters
    ----------
    block : with the parameter values to check it at.
    ranges : of inputs, states and algebraic variables. Without one a phasor lies within +-1.2 in both parts,
        a state within its bounds, all else between 0.2 and 1.2. Flags take the values of a random mode.
    points, seed : how many points, and which.

    Raises
    ------
    AssertionError
        an equation is missing or undeclared; numbers and symbols disagree; a derivative is wrong or not
        finite. The message names the equation and the values at which it was looked at.

    >>> from dcvrt.models import Pll
    >>> assert_consistent(Pll())
    """
    s = block.symbols(block.label)
    equations = on_symbols(block, "equations", s)
    problems = check_equations(block.label, block, equations)
    assert not problems, "\n".join(problems)
    names = _variables(block)
    column = stack(getattr(s, name) for name in names)
    results, labels = _results(equations)
    parameters = stack(getattr(s, name) for name in block.declared(Parameter))
    slopes = ca.densify(ca.jacobian(results, column))
    function = ca.Function("block", [column, parameters], [ca.densify(results), slopes])
    rng = np.random.default_rng(seed)
    for _ in range(points):
        at = _point(block, names, rng, ranges or {})
        by_symbols, derivatives = (
            np.array(r) for r in function(at, [block.values[n] for n in block.declared(Parameter)])
        )
        on_numbers = _numbers(block, names, at)
        parts = _parts(block, names)
        where = ", ".join(f"{part} = {value:.6g}" for part, value in zip(parts, at, strict=True))
        for label, number, symbol in zip(labels, on_numbers, by_symbols[:, 0], strict=True):
            assert isfinite(number), f"{block.label}: {label} is {number} at {where}."
            assert abs(number - symbol) <= 1e-12 * (1 + abs(number)), (
                f"{block.label}: {label} is {number} on numbers and {symbol} on symbols, at {where}."
            )
        for j, part in enumerate(parts):
            shift = np.zeros(len(at))
            shift[j] = STEP * (1 + abs(at[j]))
            up, down = (_numbers(block, names, at + sign * shift) for sign in (1, -1))
            for k, label in enumerate(labels):
                slope, difference = derivatives[k, j], (up[k] - down[k]) / (2 * shift[j])
                assert abs(difference - slope) <= 1e-5 * (1 + abs(slope) + abs(on_numbers[k])), (
                    f"{block.label}: the derivative of {label} by {part} is {slope:.6g}, a difference gives "
                    f"{difference:.6g}, at {where}."
                )


def _variables(block: Block) -> list[str]:
    """Names of all that varies in a run."""
    names = [name for kind in (Input, State, Algebraic) for name in block.declared(kind)]
    return names + ([*block.flags, "clock"] if block.modes else [])


def _parts(block: Block, names: list[str]) -> list[str]:
    """Names of the numbers that they consist of."""
    declared = block.declared(Declared)
    return [
        part
        for name in names
        for part in (
            (f"{name}.re", f"{name}.im") if name in declared and declared[name].kind is Phasor else (name,)
        )
    ]


def _point(
    block: Block, names: list[str], rng: np.random.Generator, ranges: Mapping[str, tuple[float, float]]
) -> Array:
    """Random values of all that varies."""
    mode = int(rng.integers(len(block.modes))) if block.modes else 0
    values: list[float] = []
    declared = block.declared(Declared)
    for name in names:
        d = declared.get(name)
        low, high = ranges.get(name, (-1.2, 1.2) if d is not None and d.kind is Phasor else (0.2, 1.2))
        if name in block.flags:
            values.append(float(block.flags[name][mode]))
        elif d is not None and d.kind is Phasor:
            values += rng.uniform(low, high, 2).tolist()
        else:
            if isinstance(d, State) and name not in ranges:
                low, high = max(low, d.bounds[0]), min(high, d.bounds[1])
            values.append(float(rng.uniform(low, high)))
    return np.array(values)


def _numbers(block: Block, names: list[str], at: Array) -> Array:
    """What the equations give on numbers."""
    declared, numbers = block.declared(Declared), iter(at.tolist())
    given: dict[str, Any] = {}
    for name in names:
        phasor = name in declared and declared[name].kind is Phasor
        given[name] = Phasor(next(numbers), next(numbers)) if phasor else next(numbers)
    results = block.equations(block.at(**given))
    flat: list[float] = []
    for value in (*results.der.values(), *results.out.values(), *results.alg.values()):
        flat += map(float, scalars(value))
    return np.array(flat)


def _results(equations: Equations) -> tuple[ca.SX, list[str]]:
    """All that the equations give in one column, and what each entry is."""
    labels = [f"d({name})/dt" for name in equations.der]
    for name, value in equations.out.items():
        labels += [f"{name}.re", f"{name}.im"] if isinstance(value, Phasor) else [name]
    labels += [f"residual of {name}" for name in equations.alg]
    return stack([*equations.der.values(), *equations.out.values(), *equations.alg.values()]), labels
