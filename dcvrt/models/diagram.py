"""Diagram: add blocks, wire their ports, compile to one flat system."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Any, TypeVar

import casadi as ca

from dcvrt.dae import Dae
from dcvrt.errors import InputError, ModelError, did_you_mean, outside
from dcvrt.models.block import Block, Input, Parameter, Port
from dcvrt.models.phasor import Scalar
from dcvrt.units import dimension

End = tuple[str, str]
"""Block name and port name; the block name is empty for an input of the diagram. Wires hold names, not
objects, so that `replace` keeps them."""

B = TypeVar("B", bound=Block)


def path_of(end: End) -> str:
    """``block.port``, or the name alone for an input of the diagram."""
    return f"{end[0]}.{end[1]}" if end[0] else end[1]


@dataclass(frozen=True)
class Wire:
    """What feeds an input; `implicit` makes the wire an unknown of the system, to be solved with it."""

    source: End
    implicit: bool = False
    start: float = 0.0


@dataclass(frozen=True)
class Shared:
    """A parameter of the whole diagram and the symbol that expressions use for it."""

    symbol: ca.SX
    declared: Parameter


@dataclass
class Diagram:
    """Blocks and wires under one name.

    Nothing is checked until `compile`, which reports every structural error at once; values given to `set`
    and names looked up are checked on the spot.

    >>> from dcvrt.models import Diagram, Phasor, Pll
    >>> d = Diagram("mine")
    >>> v = d.input("v_poi", "pu(V)", Phasor)
    >>> pll = d.add("pll", Pll(K_p=60.0))
    >>> d.connect(v, pll.v)
    >>> d.output("omega", pll.omega)
    >>> d.compile().x_names
    ('pll.xi', 'pll.delta')
    """

    name: str
    doc: str = ""
    blocks: dict[str, Block] = field(default_factory=dict, init=False)
    inputs: dict[str, tuple[Input, complex]] = field(default_factory=dict, init=False)
    shared: dict[str, Shared] = field(default_factory=dict, init=False)
    bindings: dict[End, Scalar] = field(default_factory=dict, init=False)
    wires: dict[End, Wire] = field(default_factory=dict, init=False)
    outputs: dict[str, End] = field(default_factory=dict, init=False)
    problems: list[str] = field(default_factory=list, init=False)
    """Errors of wiring seen so far; `compile` reports them with its own."""

    # ---- parts ----------------------------------------------------------------------------------------

    def add(self, name: str, block: B) -> B:
        """Add a block under a name, and return it."""
        if name in self.blocks or name in self.shared or name in self.inputs:
            self.problems.append(
                f"the name {name!r} is taken. Add the second {type(block).__name__} under another."
            )
            return block
        if block.name:
            self.problems.append(
                f"the block added as {name!r} is already {block.name!r} of a diagram. "
                f"Make a second {type(block).__name__}()."
            )
            return block
        block.name = name
        self.blocks[name] = block
        return block

    def parameter(
        self,
        name: str,
        value: float,
        unit: str,
        bounds: tuple[float, float] = (-inf, inf),
        doc: str = "",
        source: str = "not stated",
    ) -> ca.SX:
        """A parameter of the whole diagram, as a symbol for the expressions that `bind` takes."""
        dimension(unit)
        declared = Parameter(value, unit, bounds, doc, source)
        declared.name = name
        if name in self.shared or name in self.blocks or name in self.inputs:
            self.problems.append(f"the name {name!r} of a parameter is taken.")
        if not bounds[0] <= value <= bounds[1]:
            raise InputError(outside(name, value, unit, bounds))
        self.shared[name] = Shared(ca.SX.sym(name), declared)
        return self.shared[name].symbol

    def input(
        self, name: str, unit: str, kind: type = float, rest: complex | None = None, doc: str = ""
    ) -> Port:
        """An input of the whole diagram; `rest` is its value before anything happens (phasor 1, number 0)."""
        dimension(unit)
        declared = Input(unit, doc, kind=kind)
        declared.name = name
        if name in self.inputs or name in self.blocks or name in self.shared:
            self.problems.append(f"the name {name!r} of an input is taken.")
        self.inputs[name] = (declared, rest if rest is not None else 0.0 if kind is float else 1.0)
        return Port(None, declared)

    def output(self, name: str, source: Port) -> None:
        """Give a signal of a block, or an input, a name among the outputs of the diagram."""
        if name in self.outputs:
            self.problems.append(f"there are two outputs named {name!r}.")
        if (end := self._end(source)) is not None:
            self.outputs[name] = end

    # ---- wiring ---------------------------------------------------------------------------------------

    def connect(self, source: Port, *targets: Port, implicit: bool = False, start: float = 0.0) -> None:
        """Feed inputs from an output, a state, an algebraic variable or an input of the diagram.

        Parameters
        ----------
        source : what feeds.
        targets : the inputs it feeds.
        implicit : solve these wires as algebraic variables: the way to keep a loop without a lag in it.
        start : value an implicit wire is first tried with.
        """
        origin = self._end(source)
        if not targets:
            self.problems.append(
                f"connect({source}) names no input to feed. Write connect(source, target, ...)."
            )
        for target in targets:
            end = self._end(target)
            if origin is None or end is None:
                continue
            if not isinstance(target.declared, Input) or target.block is None:
                self.problems.append(
                    f"{target} is not an input of a block. Write connect(source, target, ...)."
                )
            elif end in self.wires:
                self.problems.append(
                    f"{target} is already driven by {path_of(self.wires[end].source)}; {source} cannot "
                    "drive it too. Drop one of the two, or add them in a block."
                )
            else:
                self.wires[end] = Wire(origin, implicit, start)

    def bind(self, block: Block, **expressions: Scalar) -> None:
        """Tie parameters of a block to expressions of the diagram's parameters."""
        if self.blocks.get(block.name) is not block:
            self.problems.append(f"bind: {type(block).__name__} was not added to this diagram.")
            return
        for name, expression in expressions.items():
            self.bindings[block.name, name] = expression

    def replace(self, name: str, block: B) -> B:
        """Put another block in the place of one: wires and bindings stay, its own values come with it."""
        self._known_block(name)
        if block.name:
            raise ModelError(
                f"the block is already {block.name!r} of a diagram. Make a new {type(block).__name__}()."
            )
        block.name = name
        self.blocks[name].name = ""
        self.blocks[name] = block
        return block

    def set(self, path: str, value: float, source: str = "set by the user") -> None:
        """Give a parameter, ``block.symbol`` or a parameter of the diagram, another value.

        Raises
        ------
        InputError
            the name is not known, the value is outside its bounds, or the parameter is bound.
        """
        if path in self.shared:
            declared = self.shared[path].declared
            low, high = declared.bounds
            if not low <= value <= high:
                raise InputError(outside(path, value, declared.unit, declared.bounds))
            declared.value, declared.source = float(value), source
            return
        block_name, _, symbol = path.partition(".")
        if not symbol or block_name not in self.blocks:
            known = [
                *self.shared,
                *(f"{n}.{k}" for n, b in self.blocks.items() for k in b.declared(Parameter)),
            ]
            raise InputError(f"{self.name} has no parameter {path!r}.{did_you_mean(path, known)}")
        block = self.blocks[block_name]
        if (block_name, symbol) in self.bindings:
            raise InputError(
                f"{path} is bound to {self.bindings[block_name, symbol]}. Set "
                f"{' or '.join(repr(k) for k in self._behind(block_name, symbol))} instead, or bind it anew."
            )
        if problem := block.problem_of(symbol, value):
            raise InputError(f"{block_name}: {problem}")
        block.values[symbol], block.sources[symbol] = float(value), source

    def port(self, path: str) -> Port:
        """The port at ``block.symbol``, or the input of the diagram of that name."""
        if path in self.inputs:
            return Port(None, self.inputs[path][0])
        block, _, name = path.partition(".")
        if not name:
            raise InputError(f"{self.name} has no input {path!r}.{did_you_mean(path, self.inputs)}")
        self._known_block(block)
        port: Port = getattr(self.blocks[block], name)
        return port

    # ---- results --------------------------------------------------------------------------------------

    def compile(self) -> Dae:
        """Check everything and flatten to a :class:`Dae`.

        Raises
        ------
        ModelError
            structural errors, all that are visible at once: inputs without a source, units that do not match,
            inputs driven twice, algebraic loops, missing equations, a singular algebraic part, modes that
            cannot be reached or left, thresholds without hysteresis, unknown names.
        """
        from dcvrt.models.compile import flatten

        return flatten(self)

    def sheet(self) -> str:
        """Markdown with the equations, parameters, ports, modes and deviations of every block."""
        from dcvrt.models.sheet import sheet

        return sheet(self)

    # ---- helpers --------------------------------------------------------------------------------------

    def _end(self, port: Any) -> End | None:
        if not isinstance(port, Port):
            self.problems.append(
                f"{port!r} is not a port. Take ports from blocks (pll.delta) or from input()."
            )
            return None
        if port.block is None:
            known = self.inputs.get(port.declared.name)
            if known is None or known[0] is not port.declared:
                self.problems.append(f"the input {port} belongs to another diagram.")
                return None
            return ("", port.declared.name)
        if self.blocks.get(port.block.name) is not port.block:
            self.problems.append(
                f"{port} belongs to a block that is not in this diagram. Add the block first."
            )
            return None
        return (port.block.name, port.declared.name)

    def _known_block(self, name: str) -> None:
        if name not in self.blocks:
            raise InputError(f"{self.name} has no block {name!r}.{did_you_mean(name, self.blocks)}")

    def _behind(self, block: str, symbol: str) -> list[str]:
        return [str(v) for v in ca.symvar(ca.SX(self.bindings[block, symbol]))] or ["the binding"]
