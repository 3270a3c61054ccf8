"""Checks of a diagram that need no equation: ports, units, wires, bindings."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca

from dcvrt.errors import did_you_mean
from dcvrt.models.block import Algebraic, Declared, Input, Output, Parameter, State
from dcvrt.models.diagram import Diagram, End, Wire, path_of
from dcvrt.units import same_unit

SOURCES = (Output, State, Algebraic)


def find(diagram: Diagram, end: End) -> Declared | None:
    """What stands at the end of a wire."""
    block, name = end
    if not block:
        return diagram.inputs[name][0] if name in diagram.inputs else None
    return diagram.blocks[block].declared(Declared).get(name) if block in diagram.blocks else None


def is_source(end: End, declared: Declared | None) -> bool:
    """Whether it can feed an input: output, state or algebraic variable of a block, input of the diagram."""
    return isinstance(declared, SOURCES) or (not end[0] and isinstance(declared, Input))


def show(declared: Declared) -> str:
    """Unit and kind, as errors print them."""
    return f"[{declared.unit}, {declared.kind.__name__}]"


def fits(one: Declared, other: Declared) -> bool:
    """Whether a wire may join them."""
    return same_unit(one.unit, other.unit) and one.kind is other.kind


def structure_problems(diagram: Diagram) -> list[str]:
    """Every problem of the wiring, one line each."""
    problems = list(diagram.problems)
    for target, wire in diagram.wires.items():
        problems += wire_problems(diagram, target, wire)
    for name, end in diagram.outputs.items():
        if not is_source(end, find(diagram, end)):
            problems.append(lost_port(diagram, end, f"output {name!r}"))
    for block_name, block in diagram.blocks.items():
        for name, declared in block.declared(Input).items():
            if (block_name, name) not in diagram.wires:
                what = f"{block_name}.{name} {show(declared)} is not connected"
                meaning = f" ({declared.doc})." if declared.doc else "."
                problems.append(what + meaning + candidates(diagram, declared))
    return problems + binding_problems(diagram)


def wire_problems(diagram: Diagram, target: End, wire: Wire) -> list[str]:
    """Whether both ends of a wire exist and agree."""
    a, b = find(diagram, wire.source), find(diagram, target)
    where = f"{path_of(wire.source)} -> {path_of(target)}"
    if a is None or not is_source(wire.source, a):
        return [lost_port(diagram, wire.source, where)]
    if not isinstance(b, Input):
        return [lost_port(diagram, target, where)]
    if not fits(a, b):
        clash = f"{path_of(wire.source)} {show(a)} cannot drive {path_of(target)} {show(b)}."
        return [clash + candidates(diagram, b)]
    return []


def lost_port(diagram: Diagram, end: End, where: str) -> str:
    """A wire that ends at a port which its block does not have, as after `replace`."""
    block, name = end
    if block not in diagram.blocks:
        return f"{where}: there is no block {block!r}.{did_you_mean(block, diagram.blocks)}"
    owner = diagram.blocks[block]
    ports = [k for k, d in owner.declared(Declared).items() if not isinstance(d, Parameter)]
    return f"{where}: {block} ({type(owner).__name__}) has no such port {name!r}.{did_you_mean(name, ports)}"


def candidates(diagram: Diagram, wanted: Declared) -> str:
    """Sources of the unit and kind that an input needs."""
    found = [path_of(end) for end, declared in sources(diagram) if fits(declared, wanted)]
    return (
        f" It could be fed by: {', '.join(found)}."
        if found
        else " Nothing in the diagram has this unit and kind."
    )


def sources(diagram: Diagram) -> Iterator[tuple[End, Declared]]:
    """Everything that can feed an input."""
    for name, (declared, _) in diagram.inputs.items():
        yield ("", name), declared
    for block_name, block in diagram.blocks.items():
        for name, own in block.declared(Declared).items():
            if isinstance(own, SOURCES):
                yield (block_name, name), own


def binding_problems(diagram: Diagram) -> list[str]:
    """Bindings of unknown parameters, to foreign symbols, or to a parameter of another unit."""
    problems = []
    by_symbol = {str(shared.symbol): shared for shared in diagram.shared.values()}
    for (block_name, name), expression in diagram.bindings.items():
        known = diagram.blocks[block_name].declared(Parameter)
        if name not in known:
            problems.append(f"bind: {block_name} has no parameter {name!r}.{did_you_mean(name, known)}")
            continue
        path = f"{block_name}.{name}"
        foreign = [str(v) for v in ca.symvar(ca.SX(expression)) if str(v) not in by_symbol]
        if foreign:
            problems.append(
                f"{path} is bound to {expression}; {', '.join(foreign)} is not a parameter of the diagram."
                + did_you_mean(foreign[0], by_symbol)
            )
        elif str(expression) in by_symbol:
            shared = by_symbol[str(expression)].declared
            if not same_unit(shared.unit, known[name].unit):
                problems.append(
                    f"{path} [{known[name].unit}] cannot be bound to {shared.name} [{shared.unit}]."
                )
    return problems
