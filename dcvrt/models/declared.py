"""What a part of a diagram declares by name: parameters, ports, states; and the part itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import casadi as ca

from dcvrt.errors import ModelError, did_you_mean, is_number, outside, refusal
from dcvrt.models.phasor import Phasor
from dcvrt.units import BASES, dimension

if TYPE_CHECKING:
    from dcvrt.models.diagram import Diagram


class UnknownNameError(ModelError, AttributeError):
    """A symbol or port that a block or a diagram does not declare."""


def as_float(value: Any) -> Any:
    """A number as a float; anything else as it is, for :meth:`Declared.problems` to tell."""
    return float(value) if is_number(value) else value


@dataclass(eq=False)
class Declared:
    """Something that a block declares by name."""

    form: ClassVar[str] = ""
    """How it is written, for messages."""

    name: str = field(default="", init=False)
    unit: str = ""
    doc: str = ""
    kind: type = float

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, block: Any, owner: type | None = None) -> Any:
        return self if block is None else Port(block, self)

    def problems(self) -> Iterator[str]:
        """What is wrong with the declaration itself."""
        if not isinstance(self.unit, str):
            yield f"{self.name}: the unit is {self.unit!r}, not a text. Write {self.form}."
        else:
            try:
                dimension(self.unit)
            except ModelError as error:
                yield f"{self.name}: {error}"
                if self.doc in BASES:
                    yield f"{self.name}: unit and meaning have changed places. Write {self.form}."
        if not isinstance(self.doc, str):
            yield f"{self.name}: the meaning is {self.doc!r}, not a text. Write {self.form}."
        if self.kind not in (float, Phasor):
            yield f"{self.name}: the kind is {self.kind!r}. It is float, for a number, or Phasor."

    def value_problems(self, value: Any, bounds: Any, what: str) -> Iterator[str]:
        """What is wrong with a value and the range that it is to lie in."""
        pair = tuple(bounds) if isinstance(bounds, tuple | list) else ()
        if not is_number(value):
            yield f"{self.name}: the {what} is {value!r}, not a number. Write {self.form}."
        if len(pair) != 2 or not all(map(is_number, pair)) or not pair[0] <= pair[1]:
            yield f"{self.name}: the bounds are {bounds!r}, not two numbers (low, high). Write {self.form}."
        elif is_number(value) and not pair[0] <= value <= pair[1]:
            yield outside(self.name, value, self.unit, bounds)


@dataclass(eq=False)
class Parameter(Declared):
    """A constant of the block: value, unit, range it may be set in, meaning, source of the value."""

    form: ClassVar[str] = "Parameter(1.0, 's', (0.1, 10.0), 'meaning', 'source')"

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
        self.value, self.bounds, self.source = as_float(value), bounds, source

    def problems(self) -> Iterator[str]:
        yield from super().problems()
        yield from self.value_problems(self.value, self.bounds, "value")

    def refusal(self, value: Any, path: str) -> str:
        """Why it cannot have this value, at this path; an empty text when it can."""
        if isinstance(value, ca.SX):
            return f"{path} = {value} is an expression; a value is a number. Tie it with the diagram's bind."
        return refusal(path, value, self.unit, self.bounds)

    def __get__(self, block: Any, owner: type | None = None) -> Any:
        return self if block is None else block.values[self.name]


@dataclass(eq=False)
class Input(Declared):
    """A signal that another block, or the diagram, must feed."""

    form: ClassVar[str] = "Input('pu(V)', 'meaning')"


@dataclass(eq=False)
class Output(Declared):
    """A signal that the block computes."""

    form: ClassVar[str] = "Output('pu(V)', 'meaning')"


@dataclass(eq=False)
class State(Declared):
    """A variable with a derivative.

    `start` is the value that the search of the equilibrium begins with, unless the block's `rest` gives a
    better one. `bounds` is the range in which the equations are valid, `crossing` what it means to leave it.

    `time` names the parameter that is its time constant T. Its equation is then given as the right side of
    T dx/dt = ..., and on a block where T is 0 it is no state but the variable that 0 = ... defines.
    """

    form: ClassVar[str] = "State(0.0, 'pu(V)', 'meaning')"

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
        self.start, self.bounds, self.crossing, self.time = as_float(start), bounds, crossing, time

    def problems(self) -> Iterator[str]:
        yield from super().problems()
        yield from self.value_problems(self.start, self.bounds, "start value")


@dataclass(eq=False)
class Algebraic(Declared):
    """A variable defined by an equation 0 = residual."""

    form: ClassVar[str] = "Algebraic(1.0, 'pu(V)', 'meaning')"

    start: float = 0.0

    def __init__(self, start: float, unit: str, doc: str = "") -> None:
        self.name, self.unit, self.doc, self.kind, self.start = "", unit, doc, float, as_float(start)

    def problems(self) -> Iterator[str]:
        yield from super().problems()
        yield from self.value_problems(self.start, (-inf, inf), "start value")


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
