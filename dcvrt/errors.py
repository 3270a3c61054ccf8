"""The kinds of error that dcvrt raises. Each message says what is wrong, where, and the way out."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from numbers import Real
from typing import Any


class DcvrtError(Exception):
    """Base of every error that dcvrt raises on purpose."""


class InputError(DcvrtError, ValueError):
    """What the user gave cannot be used: a value, a name, a file."""


class ModelError(DcvrtError, ValueError):
    """A block, a diagram or an automaton is not well formed."""


class SimulationError(DcvrtError, RuntimeError):
    """A simulation ended without a result; the message is the status sentence."""


class InfeasibleError(DcvrtError, ValueError):
    """The question has no answer: no capacity meets the limits even before any is hosted."""


def did_you_mean(name: object, known: Iterable[object]) -> str:
    """Say which known name is nearest, or list the first of them.

    >>> did_you_mean("Kp", ["K_p", "K_i"])
    " Did you mean 'K_p'? Known: K_p, K_i."
    >>> did_you_mean("zzz", [])
    ''
    """
    names = [str(k) for k in known]
    if not names:
        return ""
    near = difflib.get_close_matches(str(name), names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    listed = ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "")
    return f"{hint} Known: {listed}."


def outside(name: str, value: float, unit: str, bounds: tuple[float, float]) -> str:
    """Say that a value lies outside the range it may have.

    >>> outside("K_p", -3.0, "rad/s", (1.0, 500.0))
    'K_p = -3 rad/s is outside [1, 500].'
    >>> outside("beta", 9.0, "1", (0.8, 2.0))
    'beta = 9 is outside [0.8, 2].'
    """
    measured = f"{value:g}" if unit == "1" else f"{value:g} {unit}"
    return f"{name} = {measured} is outside [{bounds[0]:g}, {bounds[1]:g}]."


def is_number(value: object) -> bool:
    """Whether it is one plain real number: no text, no symbol, no array, no truth value.

    >>> is_number(2), is_number("2"), is_number(True)
    (True, False, False)
    """
    return isinstance(value, Real) and not isinstance(value, bool)


def refusal(name: str, value: Any, unit: str, bounds: tuple[float, float]) -> str:
    """Why something cannot have this value: it is no number, or out of range. An empty text when it can.

    >>> refusal("beta", "1.2", "1", (0.8, 2.0)), refusal("beta", 1.2, "1", (0.8, 2.0))
    ("beta = '1.2' is not a number.", '')
    """
    if not is_number(value):
        return f"{name} = {value!r} is not a number."
    return "" if bounds[0] <= value <= bounds[1] else outside(name, value, unit, bounds)


def first_sentence(message: str) -> str:
    """Shorten a message to its first sentence, without the full stop.

    >>> first_sentence("gfl: no equilibrium at 0.5 pu. Largest residuals:\\n  d(x)/dt = 3")
    'gfl: no equilibrium at 0.5 pu'
    """
    lines = message.splitlines()
    return lines[0].split(". ")[0].rstrip(".") if lines else ""


def raise_all(problems: list[str], where: str, kind: type[DcvrtError] = InputError) -> None:
    """Raise one error that lists every problem found, or return when there is none.

    >>> raise_all([], "study.toml")
    """
    if not problems:
        return
    if len(problems) == 1:
        raise kind(f"{where}: {problems[0]}")
    lines = "\n".join(f"  {problem}" for problem in problems)
    raise kind(f"{where}: {len(problems)} problems\n{lines}")
