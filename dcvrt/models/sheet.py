"""The sheet of a diagram: what an engineer needs to read before trusting it."""

from __future__ import annotations

from collections.abc import Iterator

from dcvrt.errors import InputError, did_you_mean
from dcvrt.models.block import Block
from dcvrt.models.declared import Algebraic, Declared, Input, Output, Parameter, State
from dcvrt.models.diagram import Diagram
from dcvrt.models.evaluation import on_symbols
from dcvrt.models.expressions import text_of
from dcvrt.models.netlist import Netlist, netlist
from dcvrt.models.prose import Heading, Items, Node, Table, Text, parse
from dcvrt.models.table import shortener
from dcvrt.models.wiring import End, path_of

PARAMETERS = ("parameter", "value", "unit", "bounds", "meaning", "source")
PORTS = ("", "name", "unit", "meaning", "from")
FORMS = ("markdown", "latex")


def sheet(diagram: Diagram, form: str = "markdown") -> str:
    """See :meth:`Diagram.sheet`."""
    from dcvrt.models import sheet_forms

    if form not in FORMS:
        raise InputError(f"there is no sheet in the form {form!r}.{did_you_mean(form, FORMS)}")
    nodes = contents(diagram)
    return sheet_forms.markdown(nodes) if form == "markdown" else sheet_forms.latex(nodes)


def contents(diagram: Diagram) -> list[Node]:
    """What the sheet says, whatever form it takes."""
    net = netlist(diagram)
    nodes: list[Node] = [Heading(1, diagram.name)]
    nodes += parse(diagram.page) if diagram.page else [Text(diagram.doc)]
    nodes += _interface(net, "", diagram, 2)
    explained: dict[type, str] = {}
    for path, part in _in_order(net):
        level = 2 + path.count(".")
        if isinstance(part, Block):
            nodes += _block(net, path, part, level, explained)
        else:
            nodes += [Heading(level, f"{path}: {part.label}"), Text(part.doc)]
            nodes += _interface(net, path, part, level + 1)
    notes: dict[tuple[str, str], list[str]] = {}
    for path, block in net.blocks.items():
        for note in block.notes():
            notes.setdefault((block.label, note), []).append(path)
    if notes:
        told = tuple(f"**{', '.join(paths)}**: {note}" for (_, note), paths in notes.items())
        nodes += [Heading(2, "Where it differs from the paper"), Items(told)]
    return [node for node in nodes if not (isinstance(node, Text) and not node.text)]


def _in_order(net: Netlist) -> Iterator[tuple[str, Block | Diagram]]:
    """Blocks, each nested diagram before what is in it."""
    seen: set[str] = set()
    for path, block in net.blocks.items():
        names = path.split(".")
        for k in range(1, len(names)):
            outer = ".".join(names[:k])
            if outer not in seen:
                seen.add(outer)
                yield outer, net.diagrams[outer]
        yield path, block


def _interface(net: Netlist, path: str, diagram: Diagram, level: int) -> list[Node]:
    """Parameters, inputs and outputs of a diagram, the outermost or one in it."""
    rows = [
        _parameter(net, (path, name), declared, declared.value, declared.source)
        for name, declared in diagram.declared(Parameter).items()
    ]
    ports = []
    for name, (declared, _) in diagram.inputs.items():
        ports.append(("input", f"`{name}`", declared.unit, declared.doc, _feed(net, (path, name))))
    for name, out in diagram.declared(Output).items():
        source = f"`{path_of(diagram.outputs[name])}`"
        ports.append(("output", f"`{name}`", out.unit, out.doc, source))
    parts: list[Node] = []
    if rows:
        parts += [Heading(level, "Parameters of the whole"), Table(PARAMETERS, tuple(rows))]
    return [*parts, Heading(level, "Inputs and outputs"), Table(PORTS, tuple(ports))] if ports else parts


def _parameter(
    net: Netlist, end: End, declared: Parameter, value: float, source: str
) -> tuple[str, str, str, str, str, str]:
    """Row of a parameter: its own value and source, or what it is bound to."""
    bound = net.bindings.get(end)
    shown, why = (f"{value:g}", source) if bound is None else (f"`{text_of(bound)}`", "bound")
    bounds = f"[{declared.bounds[0]:g}, {declared.bounds[1]:g}]"
    return f"`{end[1]}`", shown, declared.unit, bounds, declared.doc, why


def _feed(net: Netlist, target: End) -> str:
    """What feeds an input."""
    wire = net.wires.get(target)
    if wire is None:
        return ""
    return f"`{path_of(wire.source)}`"


def _block(net: Netlist, path: str, block: Block, level: int, explained: dict[type, str]) -> list[Node]:
    """Equations, parameters, ports and modes of a block."""
    kind = type(block)
    nodes: list[Node] = [Heading(level, f"{path}: {block.label}")]
    if kind in explained:
        nodes.append(Text(f"As `{explained[kind]}`."))
    else:
        explained[kind] = path
        nodes += parse(kind.__doc__ or "")
    parameters = tuple(
        _parameter(net, (path, name), p, block.values[name], block.sources[name])
        for name, p in block.declared(Parameter).items()
    )
    through = block.feedthrough()
    ports = []
    for label, what in (("input", Input), ("output", Output), ("state", State), ("algebraic", Algebraic)):
        declarations = {name: d for name, d in block.declared(Declared).items() if isinstance(d, what)}
        for name, d in declarations.items():
            cause = _feed(net, (path, name)) if what is Input else ""
            if what is Output:
                cause = ", ".join(f"`{k}`" for k in through[name]) or "states, parameters"
            meaning = d.doc
            if isinstance(d, State) and d.crossing:
                meaning += f"; valid in [{d.bounds[0]:g}, {d.bounds[1]:g}]"
            ports.append((label, f"`{name}`", d.unit, meaning, cause))
    nodes += [Table(head, rows) for head, rows in ((PARAMETERS, parameters), (PORTS, tuple(ports))) if rows]
    return nodes + _modes(path, block)


def _modes(path: str, block: Block) -> list[Node]:
    """Flags of every mode, and the rows that lead from one to another."""
    if not block.modes:
        return []
    flags = tuple(
        (mode, *(f"{column[k]:g}" for column in block.flags.values())) for k, mode in enumerate(block.modes)
    )
    short = shortener(path)
    rows = tuple(
        (row.source, row.target, short(str(row.when)), short(text_of(row.held)))
        for row in on_symbols(block, "transitions", block.symbols(path))
    )
    return [Table(("mode", *block.flags), flags), Table(("from", "to", "when", "held (s)"), rows)]
