"""From a diagram to one flat system: the checks, the order of evaluation, the automata as data."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dcvrt.dae import Automaton, Dae, Row, Transition
from dcvrt.errors import ModelError, did_you_mean, raise_all
from dcvrt.models.automaton import Go, check_hysteresis, check_table
from dcvrt.models.block import (
    Algebraic,
    Block,
    Declared,
    Equations,
    Input,
    Output,
    Parameter,
    State,
    check_equations,
)
from dcvrt.models.diagram import Diagram, End, path_of
from dcvrt.models.phasor import Phasor
from dcvrt.units import dimension, same_unit

DIFFUSE = ("Ways out: put a lag in the path, or mark one wire connect(..., implicit=True) "
           "to solve it as an algebraic variable.")


def column(value: Any) -> ca.SX:
    """A number, symbol or phasor as a column of SX."""
    return ca.vertcat(value.re, value.im) if isinstance(value, Phasor) else ca.SX(value)


def parts(name: str, kind: type) -> list[str]:
    """Names of the scalars that a signal consists of."""
    return [f"{name}.re", f"{name}.im"] if kind is Phasor else [name]


def signal(name: str, kind: type) -> Any:
    """A symbol, or a pair of them, for a signal."""
    symbols = [ca.SX.sym(part) for part in parts(name, kind)]
    return Phasor(*symbols) if kind is Phasor else symbols[0]


def show(declared: Declared) -> str:
    return f"[{declared.unit}, {declared.kind.__name__}]"


# ---- structure: everything that can be seen without looking at an equation ------------------------------


def find(diagram: Diagram, end: End) -> Declared | None:
    """What stands at the end of a wire."""
    block, name = end
    if not block:
        return diagram.inputs[name][0] if name in diagram.inputs else None
    return diagram.blocks[block]._declared.get(name) if block in diagram.blocks else None


def sources(diagram: Diagram) -> Iterator[tuple[End, Declared]]:
    """Everything that can feed an input."""
    for name, (declared, _) in diagram.inputs.items():
        yield ("", name), declared
    for block_name, block in diagram.blocks.items():
        for name, declared in block._declared.items():
            if isinstance(declared, (Output, State, Algebraic)):
                yield (block_name, name), declared


def structure_problems(diagram: Diagram) -> list[str]:
    """Unknown ports, units that do not match, loose inputs, bindings that do not fit, tables of modes."""
    problems = list(diagram.problems)
    for target, wire in diagram.wires.items():
        a, b = find(diagram, wire.source), find(diagram, target)
        for end, declared, wanted in ((wire.source, a, (Input, Output, State, Algebraic)), (target, b, (Input,))):
            if not isinstance(declared, wanted) or (end[0] and isinstance(declared, Input) and end == wire.source):
                problems.append(lost_port(diagram, end, f"{path_of(wire.source)} -> {path_of(target)}"))
                break
        else:
            if a is not None and b is not None and not (same_unit(a.unit, b.unit) and a.kind is b.kind):
                problems.append(
                    f"{path_of(wire.source)} {show(a)} cannot drive {path_of(target)} {show(b)}."
                    + candidates(diagram, b)
                )
    for name, end in diagram.outputs.items():
        declared = find(diagram, end)
        if declared is None or (end[0] and not isinstance(declared, (Output, State, Algebraic))):
            problems.append(lost_port(diagram, end, f"output {name!r}"))
    for block_name, block in diagram.blocks.items():
        for name, declared in block.declared(Input).items():
            if (block_name, name) not in diagram.wires:
                problems.append(
                    f"{block_name}.{name} {show(declared)} is not connected: {declared.doc}." + candidates(diagram, declared)
                )
    return problems + binding_problems(diagram)


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
    fits = [
        path_of(end) for end, d in sources(diagram) if same_unit(d.unit, wanted.unit) and d.kind is wanted.kind
    ]
    return f" It could be fed by: {', '.join(fits)}." if fits else " Nothing in the diagram has this unit and kind."


def binding_problems(diagram: Diagram) -> list[str]:
    problems = []
    by_symbol = {str(shared.symbol): shared for shared in diagram.shared.values()}
    for (block_name, name), expression in diagram.bindings.items():
        block = diagram.blocks[block_name]
        known = block.declared(Parameter)
        if name not in known:
            problems.append(f"bind: {block_name} has no parameter {name!r}.{did_you_mean(name, known)}")
            continue
        symbols = [str(v) for v in ca.symvar(ca.SX(expression))]
        foreign = [v for v in symbols if v not in by_symbol]
        if foreign:
            problems.append(
                f"{block_name}.{name} is bound to {expression}, but {', '.join(foreign)} is not a parameter of the "
                f"diagram.{did_you_mean(foreign[0], by_symbol)}"
            )
        elif str(expression) in by_symbol:
            shared = by_symbol[str(expression)].declared
            if dimension(shared.unit) != dimension(known[name].unit):
                problems.append(
                    f"{block_name}.{name} [{known[name].unit}] cannot be bound to {shared.name} [{shared.unit}]."
                )
    return problems


# ---- flattening -----------------------------------------------------------------------------------------


@dataclass
class Unknown:
    """An algebraic variable: its symbol, the residual that defines it, its row."""

    symbol: ca.SX
    residual: Callable[[], ca.SX]
    row: Row


class Flattener:
    """Evaluates the blocks in the order of their wires.

    Feedthrough is exact: an output needs an input if and only if its expression depends on it.
    """

    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram
        self.s = {name: block.symbols(name) for name, block in diagram.blocks.items()}
        self.eq: dict[str, Equations] = {}
        problems = []
        for name, block in diagram.blocks.items():
            self.eq[name] = block.equations(self.s[name])
            problems += check_equations(name, block, self.eq[name])
        raise_all(problems, diagram.name, ModelError)
        self.u = {name: signal(name, declared.kind) for name, (declared, _) in diagram.inputs.items()}
        self.values: dict[End, Any] = {}
        self.open: list[End] = []
        self.implicit: dict[End, tuple[Any, End]] = {}
        for target, wire in diagram.wires.items():
            if wire.implicit:
                declared = diagram.blocks[target[0]]._declared[target[1]]
                self.implicit[target] = (signal(path_of(target), declared.kind), wire.source)

    def needs(self, block: str, value: Any) -> list[str]:
        """Inputs of the block that an expression of its symbols depends on."""
        expression = column(value)
        return [
            name
            for name in self.diagram.blocks[block].declared(Input)
            if ca.depends_on(expression, column(getattr(self.s[block], name)))
        ]

    def at_end(self, end: End) -> Any:
        """Value of a source in terms of states, algebraic variables, inputs, parameters, flags and clocks."""
        block, name = end
        if not block:
            return self.u[name]
        if not isinstance(self.diagram.blocks[block]._declared[name], Output):
            return getattr(self.s[block], name)
        if end in self.values:
            return self.values[end]
        if end in self.open:
            raise ModelError(self.ring(self.open[self.open.index(end) :]))
        self.open.append(end)
        self.values[end] = self.resolve(block, self.eq[block].out[name])
        self.open.pop()
        return self.values[end]

    def at_input(self, target: End) -> Any:
        """Value that arrives at an input."""
        if target in self.implicit:
            return self.implicit[target][0]
        return self.at_end(self.diagram.wires[target].source)

    def resolve(self, block: str, value: Any) -> Any:
        """An expression of a block's own symbols with its inputs replaced by what feeds them."""
        names = self.needs(block, value)
        if not names:
            return value
        own = ca.vertcat(*[column(getattr(self.s[block], name)) for name in names])
        fed = ca.vertcat(*[column(self.at_input((block, name))) for name in names])
        result = ca.substitute(column(value), own, fed)
        return Phasor(result[0], result[1]) if isinstance(value, Phasor) else result

    def ring(self, ends: list[End]) -> str:
        """The text of an algebraic loop."""
        lines = []
        for k, end in enumerate(ends):
            following = ends[(k + 1) % len(ends)]
            through = [
                f"{end[0]}.{name}"
                for name in self.needs(end[0], self.eq[end[0]].out[end[1]])
                if self.diagram.wires[end[0], name].source == following
            ]
            lines.append(f"  {path_of(end)}  <- needs {', '.join(through)}")
        lines.append(f"  {path_of(ends[0])}")
        return f"{self.diagram.name}: algebraic loop\n" + "\n".join(lines) + f"\n{DIFFUSE}"

    # ---- rows -----------------------------------------------------------------------------------------

    def states(self) -> Iterator[tuple[str, State]]:
        for block_name, block in self.diagram.blocks.items():
            for state in block.declared(State).values():
                yield block_name, state

    def unknowns(self) -> list[Unknown]:
        """Algebraic variables: those that blocks declare and those of implicit wires."""
        found = []
        for name, block in self.diagram.blocks.items():
            for key, d in block.declared(Algebraic).items():
                residual = self.eq[name].alg[key]
                found.append(
                    Unknown(
                        getattr(self.s[name], key),
                        lambda name=name, residual=residual: column(self.resolve(name, residual)),
                        Row(f"{name}.{key}", d.unit, d.start, doc=d.doc),
                    )
                )
        for target, (symbol, source) in self.implicit.items():
            declared = self.diagram.blocks[target[0]]._declared[target[1]]
            start = self.diagram.wires[target].start
            for k, part in enumerate(parts(path_of(target), declared.kind)):
                found.append(
                    Unknown(
                        column(symbol)[k],
                        lambda k=k, source=source, symbol=symbol: column(self.at_end(source))[k] - column(symbol)[k],
                        Row(part, declared.unit, start, doc=f"implicit wire from {path_of(source)}"),
                    )
                )
        return found


def flatten(diagram: Diagram) -> Dae:
    """Compile a diagram: see :meth:`Diagram.compile`."""
    raise_all(structure_problems(diagram), diagram.name, ModelError)
    flat = Flattener(diagram)
    blocks = diagram.blocks

    state_rows, x, f = [], [], []
    for name, state in flat.states():
        state_rows.append(
            Row(f"{name}.{state.name}", state.unit, state.start, state.bounds, state.doc, crossing=state.crossing)
        )
        x.append(getattr(flat.s[name], state.name))
        f.append(column(flat.resolve(name, flat.eq[name].der[state.name])))
    unknowns = flat.unknowns()
    z, g = [k.symbol for k in unknowns], [k.residual() for k in unknowns]

    output_rows, y = [], []
    for name, end in diagram.outputs.items():
        declared = find(diagram, end)
        assert declared is not None
        output_rows += [Row(part, declared.unit, doc=declared.doc) for part in parts(name, declared.kind)]
        y.append(column(flat.at_end(end)))
    input_rows, u = [], []
    for name, (declared, rest) in diagram.inputs.items():
        rests = (rest.real, rest.imag) if declared.kind is Phasor else (rest.real,)
        for part, value in zip(parts(name, declared.kind), rests, strict=True):
            input_rows.append(Row(part, declared.unit, float(value), doc=declared.doc))
        u.append(column(flat.u[name]))

    parameter_rows, p, bound, bound_to = [], [], [], []
    for name, shared in diagram.shared.items():
        d = shared.declared
        parameter_rows.append(Row(name, d.unit, d.value, d.bounds, d.doc, d.source))
        p.append(shared.symbol)
    for name, block in blocks.items():
        for key, d in block.declared(Parameter).items():
            symbol = getattr(flat.s[name], key)
            if (name, key) in diagram.bindings:
                bound.append(symbol)
                bound_to.append(ca.SX(diagram.bindings[name, key]))
            else:
                parameter_rows.append(Row(f"{name}.{key}", d.unit, block.values[key], d.bounds, d.doc, block.sources[key]))
                p.append(symbol)

    def tie(expressions: list[ca.SX]) -> ca.SX:
        """Stack, put bound parameters' expressions in their place, and share what is common."""
        stacked = ca.vertcat(*expressions) if expressions else ca.SX(0, 1)
        if bound:
            stacked = ca.substitute(stacked, ca.vertcat(*bound), ca.vertcat(*bound_to))
        return stacked

    stack = lambda symbols: ca.vertcat(*symbols) if symbols else ca.SX(0, 1)  # noqa: E731
    x_, z_, u_, p_ = stack(x), stack(z), stack(u), stack(p)
    shared_nodes = ca.cse(tie([stack(f), stack(g), stack(y)]))
    nx, nz = x_.numel(), z_.numel()
    f_, g_, y_ = shared_nodes[:nx], shared_nodes[nx : nx + nz], shared_nodes[nx + nz :]

    values = np.array([row.value for row in parameter_rows])
    automata = tuple(build_automaton(flat, name, tie, p_, values, x_) for name, b in blocks.items() if b.modes)
    check_regular(diagram.name, g_, z_, unknowns)
    dae = Dae(
        name=diagram.name,
        t=ca.SX.sym("t"),
        x=x_, z=z_, u=u_, p=p_, f=f_, g=g_, y=y_,
        states=tuple(state_rows),
        algebraics=tuple(k.row for k in unknowns),
        inputs=tuple(input_rows),
        parameter_rows=tuple(parameter_rows),
        outputs=tuple(output_rows),
        automata=automata,
        start=start_values(flat, x_, z_, unknowns, automata, tie),
        notes=tuple(f"{name}: {note}" for name, block in blocks.items() for note in block.notes()),
    )  # fmt: skip
    return dae


def build_automaton(
    flat: Flattener, name: str, tie: Callable[[list[ca.SX]], ca.SX], p: ca.SX, values: Any, x: ca.SX
) -> Automaton:
    """The table of modes of one block, checked, as data."""
    block, s = flat.diagram.blocks[name], flat.s[name]
    rows = block.transitions(s)
    who = f"{flat.diagram.name}: {name} ({type(block).__name__})"
    raise_all(check_table(block.modes, block.start, rows), who, ModelError)

    def number(limit: Any) -> float:
        tied = tie([ca.SX(limit)])
        return float(ca.Function("limit", [p], [tied], {"allow_free": True})(values)) if not _varies(tied, p) else np.nan

    short = _shortener(name)
    problems = check_hysteresis(rows, number)
    raise_all([short(problem) for problem in problems], who, ModelError)
    positions = {state: k for k, (owner, state) in enumerate((o, d.name) for o, d in flat.states()) if owner == name}
    return Automaton(
        path=name,
        modes=block.modes,
        start=block.start,
        q=ca.vertcat(*[getattr(s, flag) for flag in block.flags]),
        flag_names=tuple(block.flags),
        flags=np.array([block.flags[flag] for flag in block.flags], dtype=float).T,
        clock=s.clock,
        rows=tuple(
            Transition(
                source=row.source,
                target=row.target,
                guard=tie([column(flat.resolve(name, ca.SX(row.when.margin)))]),
                held=tie([column(flat.resolve(name, ca.SX(row.held)))]),
                text=short(str(row)),
                reset={positions[k]: tie([column(flat.resolve(name, ca.SX(v)))]) for k, v in row.reset.items()},
            )
            for row in checked_rows(who, rows, block, p, tie)
        ),
    )


def checked_rows(who: str, rows: tuple[Go, ...], block: Block, p: ca.SX, tie: Callable[[list[ca.SX]], ca.SX]) -> tuple[Go, ...]:
    """Rows whose `held` depends on parameters only and whose resets name states of the block."""
    problems = []
    states = block.declared(State)
    for row in rows:
        if _varies(tie([ca.SX(row.held)]), p):
            problems.append(f"{row.source} -> {row.target}: held depends on more than parameters: {row.held}.")
        for key in row.reset:
            if key not in states:
                problems.append(f"{row.source} -> {row.target}: reset of {key!r}, not a state.{did_you_mean(key, states)}")
    raise_all(problems, who, ModelError)
    return rows


def _varies(expression: ca.SX, p: ca.SX) -> bool:
    known = {str(v) for v in ca.symvar(p)} if p.numel() else set()
    return any(str(v) not in known for v in ca.symvar(expression))


def _shortener(name: str) -> Callable[[str], str]:
    """Names of a block's own symbols without the block's path: the reader knows which block it is."""
    pattern = re.compile(rf"\b{re.escape(name)}\.")
    return lambda text: pattern.sub("", text)


def check_regular(name: str, g: ca.SX, z: ca.SX, unknowns: list[Unknown]) -> None:
    """Refuse an algebraic part in which some variable has no equation of its own to determine it."""
    if not unknowns:
        return
    pattern = np.array(ca.DM(ca.jacobian(g, z).sparsity(), 1).full()) != 0
    of_equation: dict[int, int] = {}

    def assign(variable: int, tried: set[int]) -> bool:
        for equation in np.flatnonzero(pattern[:, variable]):
            if equation not in tried:
                tried.add(int(equation))
                if int(equation) not in of_equation or assign(of_equation[int(equation)], tried):
                    of_equation[int(equation)] = variable
                    return True
        return False

    lost = [k for k in range(len(unknowns)) if not assign(k, set())]
    if lost:
        idle = [k for k in range(len(unknowns)) if k not in of_equation]
        raise ModelError(
            f"{name}: the algebraic part is singular. No equation determines "
            f"{', '.join(unknowns[k].row.path for k in lost)}; left over is the equation of "
            f"{', '.join(unknowns[k].row.path for k in idle)}. Let the equations depend on the variables they are to "
            "determine, or make one of the variables a state."
        )


def start_values(
    flat: Flattener,
    x: ca.SX,
    z: ca.SX,
    unknowns: list[Unknown],
    automata: tuple[Automaton, ...],
    tie: Callable[[list[ca.SX]], ca.SX],
) -> ca.SX:
    """Start values as functions of `u` and `p`: what blocks say of their rest, through the wires."""
    guesses = []
    problems = []
    rests = {}
    for name, block in flat.diagram.blocks.items():
        rests[name] = block.rest(flat.s[name])
        states = block.declared(State)
        problems += [
            f"{name} ({type(block).__name__}): rest() gives {k!r}, not a state.{did_you_mean(k, states)}"
            for k in rests[name]
            if k not in states
        ]
    raise_all(problems, flat.diagram.name, ModelError)
    for name, state in flat.states():
        guesses.append(column(flat.resolve(name, ca.SX(rests[name].get(state.name, state.start)))))
    guess = tie([*guesses, *[ca.SX(k.row.value) for k in unknowns]])
    for a in automata:
        flags = a.flags[a.mode_number(a.start)]
        guess = ca.substitute(guess, ca.vertcat(a.q, a.clock), ca.vertcat(*flags, 0.0))
    xz = ca.vertcat(x, z)
    for _ in range(xz.numel() + 1):
        if xz.numel() == 0 or not ca.depends_on(guess, xz):
            return ca.cse(guess)
        guess = ca.cse(ca.substitute(guess, xz, guess))
    names = [f"{name}.{state.name}" for name, state in flat.states()]
    circular = [n for k, n in enumerate(names) if ca.depends_on(guess[k], xz)]
    raise ModelError(
        f"{flat.diagram.name}: start values depend on each other: {', '.join(circular)}. "
        "Let rest() of one of these blocks give a number."
    )
