"""Every block of a diagram and of the diagrams in it, under its full path: where nesting ends.

All that follows (checks, flattening, sheets) sees one flat list. The ports of a diagram that is used as a
block stay as *junctions*: points that a signal passes through, so that units are checked on both sides and
messages can name them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca

from dcvrt.models.block import Block
from dcvrt.models.declared import Declared, Input, Output, Parameter
from dcvrt.models.diagram import Diagram, Shared
from dcvrt.models.phasor import Scalar
from dcvrt.models.wiring import End, Wire, driven_twice


@dataclass
class Netlist:
    """The parts of a diagram with its nesting dissolved.

    Attributes
    ----------
    diagram : where it comes from.
    blocks, diagrams : by full path, in the order in which they were added.
    shared : parameters of the diagram, then those of nested ones that nothing is bound to, by full path.
    bindings : what parameters of blocks and nested diagrams are tied to, in terms of `shared`.
    wires : what feeds each input and each junction.
    junctions : inputs and outputs of nested diagrams.
    problems : what was wrong before anything is looked up.
    """

    diagram: Diagram
    blocks: dict[str, Block] = field(default_factory=dict)
    diagrams: dict[str, Diagram] = field(default_factory=dict)
    shared: dict[str, Shared] = field(default_factory=dict)
    bindings: dict[End, Scalar] = field(default_factory=dict)
    wires: dict[End, Wire] = field(default_factory=dict)
    junctions: dict[End, Declared] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.diagram.name

    @property
    def inputs(self) -> dict[str, tuple[Input, complex]]:
        """Inputs of the outermost diagram with their values at rest."""
        return self.diagram.inputs

    @property
    def outputs(self) -> dict[str, End]:
        """Outputs of the outermost diagram."""
        return self.diagram.outputs

    def find(self, end: End) -> Declared | None:
        """What stands at the end of a wire."""
        path, name = end
        if not path:
            return self.inputs[name][0] if name in self.inputs else None
        if end in self.junctions:
            return self.junctions[end]
        return self.blocks[path].declared(Declared).get(name) if path in self.blocks else None

    def origin(self, target: End) -> End:
        """Where the signal at an input comes from, past the junctions on its way."""
        source = self.wires[target].source
        while source in self.junctions and not self.wires[source].implicit:
            source = self.wires[source].source
        return source

    def parameters(self) -> dict[str, Parameter]:
        """Declarations of the parameters that can be set, by path: the shared ones, then those of blocks."""
        table = {path: shared.declared for path, shared in self.shared.items()}
        for path, block in self.blocks.items():
            for name, declared in block.declared(Parameter).items():
                if (path, name) not in self.bindings:
                    table[f"{path}.{name}"] = declared
        return table

    def dissolve(self, diagram: Diagram, path: str) -> None:
        """Take in a diagram that stands at `path`; the outermost one stands at the empty path."""

        def inside(end: End) -> End:
            return (join(path, end[0]), end[1])

        self.problems += [f"in {path}: {problem}" if path else problem for problem in diagram.problems]
        own, meaning = [], []
        for name, shared in diagram.shared.items():
            expression = self.bindings.get((path, name)) if path else None
            if expression is None:
                symbol = ca.SX.sym(join(path, name)) if path else shared.symbol
                self.shared[join(path, name)] = Shared(symbol, shared.declared)
                expression = symbol
            own.append(shared.symbol)
            meaning.append(ca.SX(expression))
        for end, expression in diagram.bindings.items():
            tied = ca.substitute([ca.SX(expression)], own, meaning)[0] if path and own else expression
            self.bindings.setdefault(inside(end), tied)  # what is bound from further out holds
        for target, wire in diagram.wires.items():
            self.feed(inside(target), Wire(inside(wire.source), wire.implicit, wire.start))
        if path:
            self.diagrams[path] = diagram
            self.junctions |= {(path, name): declared for name, (declared, _) in diagram.inputs.items()}
            for name, end in diagram.outputs.items():
                self.junctions[path, name] = diagram.declared(Output).get(name, Output("1"))
                self.feed((path, name), Wire(inside(end)))
        for name, part in diagram.blocks.items():
            if isinstance(part, Diagram):
                self.dissolve(part, join(path, name))
            elif isinstance(part, Block):
                self.blocks[join(path, name)] = part

    def feed(self, target: End, wire: Wire) -> None:
        """Take in a wire; a diagram and one that it stands in may both have tried to drive an input."""
        if target in self.wires:
            self.problems.append(driven_twice(target, self.wires[target].source, wire.source))
        else:
            self.wires[target] = wire


def join(path: str, name: str) -> str:
    """``path.name``; either may be empty."""
    return f"{path}.{name}" if path and name else path or name


def netlist(diagram: Diagram) -> Netlist:
    """Dissolve the nesting of a diagram."""
    flat = Netlist(diagram)
    flat.dissolve(diagram, "")
    return flat
