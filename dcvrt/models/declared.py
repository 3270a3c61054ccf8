"""What a part of a diagram declares by name: parameters, ports, states; and the part itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING, Any, TypeVar

from dcvrt.errors import ModelError, did_you_mean

if TYPE_CHECKING:
    from dcvrt.models.diagram import Diagram


class UnknownNameError(ModelError, AttributeError):
    """A symbol or port that a block or a diagram does not declare."""


@dataclass(eq=False)
class Declared:
    """Something that a block declares by name."""

    name: str = field(default="", init=False)
    unit: str = ""
    doc: str = ""
    kind: type = field(default=float, kw_only=True)

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, block: Any, owner: type | None = None) -> Any:
        return self if block is None else Port(block, self)


@dataclass(eq=False)
class Parameter(Declared):
    """A constant of the block: value, unit, range it may be set in, meaning, source of the value."""

    value: float = 0.0
    bounds: tuple[float, float] = (-inf, inf)
    source: str = "not stated"

    def __init__(
        self,
        value: float,
        unit: str,
        bounds: tuple[float, float] = (-inf, inf),
        doc: str = "",
        source: str = "not stated",
    ) -> None:
        self.name, self.unit, self.doc, self.kind = "", unit, doc, float
        self.value, self.bounds, self.source = float(value), bounds, source

    def __get__(self, block: Any, owner: type | None = None) -> Any:
        return self if block is None else block.values[self.name]


@dataclass(eq=False)
class Input(Declared):
    """A signal that another block, or the diagram, must feed."""


@dataclass(eq=False)
class Output(Declared):
    """A signal that the block computes."""


@dataclass(eq=False)
class State(Declared):
    """A variable with a derivative.

    `start` is the value that the search of the equilibrium begins with, unless the block's `rest` gives a
    better one. `bounds` is the range in which the equations are valid, `crossing` what it means to leave it.

    `time` names the parameter that is its time constant T. Its equation is then given as the right side of
    T dx/dt = ..., and on a block where T is 0 it is no state but the variable that 0 = ... defines.
    """

    start: float = 0.0
    bounds: tuple[float, float] = (-inf, inf)
    crossing: str = ""
    time: str = ""

    def __init__(
        self,
        start: float,
        unit: str,
        doc: str = "",
        bounds: tuple[float, float] = (-inf, inf),
        crossing: str = "",
        time: str = "",
    ) -> None:
        self.name, self.unit, self.doc, self.kind = "", unit, doc, float
        self.start, self.bounds, self.crossing, self.time = float(start), bounds, crossing, time


@dataclass(eq=False)
class Algebraic(Declared):
    """A variable defined by an equation 0 = residual."""

    start: float = 0.0

    def __init__(self, start: float, unit: str, doc: str = "") -> None:
        self.name, self.unit, self.doc, self.kind, self.start = "", unit, doc, float, float(start)


@dataclass(frozen=True)
class Port:
    """One named signal of one part, or of the diagram itself (`block` is None), as `connect` takes it."""

    block: Part | None
    declared: Declared

    def __str__(self) -> str:
        return f"{self.block.where}.{self.declared.name}" if self.block is not None else self.declared.name


D = TypeVar("D", bound=Declared)


class Part:
    """What stands in a diagram under a name: a block, or a diagram that is used as one."""

    name: str = ""
    home: Diagram | None = None
    """The diagram that it was added to."""

    @property
    def label(self) -> str:
        """What it is, as messages and sheets print it."""
        return type(self).__name__

    @property
    def anew(self) -> str:
        """How to make another one, as messages say it."""
        return f"{self.label}()"

    @property
    def where(self) -> str:
        """Its path from the outermost diagram, or what it is while it stands in none."""
        if self.home is None:
            return self.label
        return f"{self.home.where}.{self.name}" if self.home.home is not None else self.name

    def declared(self, kind: type[D]) -> dict[str, D]:
        """What it declares of one kind, in order."""
        raise NotImplementedError

    def unknown(self, name: str) -> UnknownNameError:
        """The error for a name that it does not declare."""
        who = self.label if self.home is None else f"{self.where} ({self.label})"
        return UnknownNameError(f"{who} has no {name!r}.{did_you_mean(name, self.declared(Declared))}")
