"""Checks of a diagram that need no equation: ports, units, wires, bindings."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca

from dcvrt.errors import did_you_mean
from dcvrt.models.declared import Algebraic, Declared, Input, Output, Parameter, Part, State
from dcvrt.models.expressions import MixedUnitsError, text_of, unit_of
from dcvrt.models.netlist import Netlist
from dcvrt.models.wiring import End, Wire, path_of
from dcvrt.units import same_unit

SOURCES = (Output, State, Algebraic)


def is_source(flat: Netlist, end: End) -> bool:
    """Whether it can feed an input: output, state or algebraic variable, input of a diagram."""
    declared = flat.find(end)
    return isinstance(declared, SOURCES) or (
        isinstance(declared, Input) and (not end[0] or end in flat.junctions)
    )


def show(declared: Declared) -> str:
    """Unit and kind, as errors print them."""
    return f"[{declared.unit}, {declared.kind.__name__}]"


def fits(one: Declared, other: Declared) -> bool:
    """Whether a wire may join them."""
    return same_unit(one.unit, other.unit) and one.kind is other.kind


def structure_problems(flat: Netlist) -> list[str]:
    """Every problem of the wiring, one line each."""
    problems = list(flat.problems)
    for target, wire in flat.wires.items():
        problems += wire_problems(flat, target, wire)
    for name, end in flat.outputs.items():
        if not is_source(flat, end):
            problems.append(lost_port(flat, end, f"output {name!r}"))
    wanted = [
        ((path, name), d) for path, block in flat.blocks.items() for name, d in block.declared(Input).items()
    ]
    wanted += [(end, d) for end, d in flat.junctions.items() if isinstance(d, Input)]
    for end, declared in wanted:
        if end not in flat.wires:
            what = f"{path_of(end)} {show(declared)} is not connected"
            meaning = f" ({declared.doc})." if declared.doc else "."
            problems.append(what + meaning + candidates(flat, end, declared))
    return problems + binding_problems(flat)


def wire_problems(flat: Netlist, target: End, wire: Wire) -> list[str]:
    """Whether both ends of a wire exist and agree."""
    a, b = flat.find(wire.source), flat.find(target)
    where = f"{path_of(wire.source)} -> {path_of(target)}"
    if a is None or not is_source(flat, wire.source):
        return [lost_port(flat, wire.source, where)]
    if b is None or not (isinstance(b, Input) or target in flat.junctions):
        return [lost_port(flat, target, where)]
    if not fits(a, b):
        clash = f"{path_of(wire.source)} {show(a)} cannot drive {path_of(target)} {show(b)}."
        return [clash + candidates(flat, target, b)]
    return []


def lost_port(flat: Netlist, end: End, where: str) -> str:
    """A wire that ends at a port which its part does not have, as after `replace`."""
    path, name = end
    owner: Part | None = flat.blocks.get(path) or flat.diagrams.get(path)
    if owner is None:
        return f"{where}: there is no block {path!r}.{did_you_mean(path, [*flat.blocks, *flat.diagrams])}"
    ports = [k for k, d in owner.declared(Declared).items() if not isinstance(d, Parameter)]
    return f"{where}: {path} ({owner.label}) has no such port {name!r}.{did_you_mean(name, ports)}"


def candidates(flat: Netlist, target: End, wanted: Declared) -> str:
    """Sources of the unit and kind that an input needs, in the diagram in which it stands."""
    scope = target[0].rpartition(".")[0]
    found = [path_of(end) for end, declared in sources(flat, scope) if fits(declared, wanted)]
    return (
        f" It could be fed by: {', '.join(found)}."
        if found
        else " Nothing in the diagram has this unit and kind: add a block that gives it, or an input()."
    )


def sources(flat: Netlist, scope: str) -> Iterator[tuple[End, Declared]]:
    """Everything that can feed an input in the diagram at the path `scope`."""
    if not scope:
        for name, (entry, _) in flat.inputs.items():
            yield ("", name), entry
    for end, declared in flat.junctions.items():
        inward = isinstance(declared, Input) and end[0] == scope
        outward = isinstance(declared, Output) and end[0].rpartition(".")[0] == scope
        if inward or outward:
            yield end, declared
    for path, block in flat.blocks.items():
        if path.rpartition(".")[0] == scope:
            for name, own in block.declared(Declared).items():
                if isinstance(own, SOURCES):
                    yield (path, name), own


def binding_problems(flat: Netlist) -> list[str]:
    """Bindings of unknown parameters, to foreign symbols, or to a parameter of another unit."""
    problems = []
    reported: set[int] = set()  # a foreign symbol passes on into what is bound further in
    own = {shared.symbol.element_hash(): shared.declared for shared in flat.shared.values()}
    for (part_path, name), expression in flat.bindings.items():
        part: Part | None = flat.blocks.get(part_path) or flat.diagrams.get(part_path)
        if part is None:
            names = [*flat.blocks, *flat.diagrams]
            problems.append(f"bind: there is no block {part_path!r}.{did_you_mean(part_path, names)}")
            continue
        known = part.declared(Parameter)
        if name not in known:
            problems.append(f"bind: {part_path} has no parameter {name!r}.{did_you_mean(name, known)}")
            continue
        path = f"{part_path}.{name}"
        symbols = ca.symvar(ca.SX(expression))
        strange = [v for v in symbols if v.element_hash() not in own]
        foreign = [str(v) for v in strange if v.element_hash() not in reported]
        reported |= {v.element_hash() for v in strange}
        if foreign:
            problems.append(
                f"{path} is bound to {text_of(expression)}; {', '.join(foreign)} is not a parameter of the "
                f"diagram. Bind to what parameter() returned.{did_you_mean(foreign[0], flat.shared)}"
            )
        if strange:
            continue
        units = {v.element_hash(): own[v.element_hash()].unit for v in symbols}
        try:
            unit = unit_of(ca.SX(expression), units)
        except MixedUnitsError as mixed:
            problems.append(f"{path} is bound to {text_of(expression)}, which {mixed}.")
            continue
        if unit is not None and not same_unit(unit, known[name].unit):
            problems.append(f"{path} [{known[name].unit}] cannot be bound to {text_of(expression)} [{unit}].")
    return problems
