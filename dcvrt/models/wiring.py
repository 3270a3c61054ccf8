"""Wires by name: what their ends are, and what is said of them."""

from __future__ import annotations

from dataclasses import dataclass

End = tuple[str, str]
"""Path of a part and name of its port; the path is empty for an input of the diagram. Wires hold names, not
objects, so that `replace` keeps them."""


def path_of(end: End) -> str:
    """``part.port``, or the name alone for an input of the diagram."""
    return f"{end[0]}.{end[1]}" if end[0] else end[1]


@dataclass(frozen=True)
class Wire:
    """What feeds an input; `implicit` makes the wire an unknown of the system, to be solved with it."""

    source: End
    implicit: bool = False
    start: float = 0.0


def driven_twice(target: End, source: End, other: End) -> str:
    """The text of the error for an input with two sources."""
    return (
        f"{path_of(target)} is already driven by {path_of(source)}; {path_of(other)} cannot "
        "drive it too. Drop one of the two, or add them in a block."
    )
