"""From a diagram to one flat system: the order of evaluation, the rows, the start values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dcvrt.dae import Automaton, Dae, Row, Tied
from dcvrt.errors import ModelError, did_you_mean, raise_all
from dcvrt.models.algebraic import check_regular
from dcvrt.models.automaton import Go
from dcvrt.models.declared import Algebraic, Declared, Input, Output, Parameter, State
from dcvrt.models.diagram import Diagram
from dcvrt.models.evaluation import Equations, check_equations, on_symbols, stack
from dcvrt.models.expressions import text_of
from dcvrt.models.netlist import Netlist, netlist
from dcvrt.models.phasor import Phasor, Scalar
from dcvrt.models.structure import structure_problems
from dcvrt.models.table import build_automaton
from dcvrt.models.wiring import End, path_of

WAYS_OUT = (
    "Ways out: put a lag in the path, or mark one wire connect(..., implicit=True) "
    "to solve it as an algebraic variable."
)


def parts(name: str, kind: type) -> list[str]:
    """Names of the scalars that a signal consists of."""
    return [f"{name}.re", f"{name}.im"] if kind is Phasor else [name]


def signal(name: str, kind: type) -> Any:
    """A symbol, or a phasor of two, for a signal."""
    symbols = [ca.SX.sym(part) for part in parts(name, kind)]
    return Phasor(*symbols) if kind is Phasor else symbols[0]


@dataclass(frozen=True)
class Unknown:
    """An algebraic variable: its symbol, the residual that defines it, its row."""

    symbol: ca.SX
    residual: ca.SX
    row: Row


class Flattener:
    """Evaluates the blocks in the order of their wires.

    Feedthrough is exact: an output needs an input if and only if its expression depends on it.
    """

    def __init__(self, net: Netlist) -> None:
        self.net = net
        self.s = {path: block.symbols(path) for path, block in net.blocks.items()}
        self.eq: dict[str, Equations] = {}
        self.rows: dict[str, tuple[Go, ...]] = {}
        self.rests: dict[str, Mapping[str, Scalar]] = {}
        problems = []
        for path, block in net.blocks.items():
            given = on_symbols(block, "equations", self.s[path])
            self.rows[path] = on_symbols(block, "transitions", self.s[path])
            self.rests[path] = on_symbols(block, "rest", self.s[path])
            wrong = check_equations(path, block, given)
            problems += wrong
            self.eq[path] = given if wrong else block.reduced(given, self.s[path])
        problems += self.time_problems()
        raise_all(problems, net.name, ModelError)
        self.u = {name: signal(name, declared.kind) for name, (declared, _) in net.inputs.items()}
        self.implicit = {
            target: signal(path_of(target), self.declared(target).kind)
            for target, wire in net.wires.items()
            if wire.implicit
        }
        self._values: dict[End, Any] = {}
        self._open: list[End] = []

    def declared(self, end: End) -> Declared:
        """What stands at the end of a wire; structure_problems has seen that something does."""
        found = self.net.find(end)
        assert found is not None
        return found

    def idle(self, path: str) -> Iterator[str]:
        """Parameters of a block that it does not use: whoever set them would see no effect."""
        block, s, eq = self.net.blocks[path], self.s[path], self.eq[path]
        if block.optional_terms:
            return
        used = [*eq.der.values(), *eq.out.values(), *eq.alg.values(), *self.rests[path].values()]
        for row in self.rows[path]:
            used += [row.when.margin, row.held, *row.reset.values()]
        lags = {state.time for state in block.declared(State).values()}  # a time constant may be 0
        for name in (name for name in block.declared(Parameter) if name not in lags):
            if not ca.depends_on(stack(used), getattr(s, name)):
                yield (
                    f"{path} ({block.label}): nothing depends on the parameter {name!r}. Equations read "
                    f"s.{name}; self.{name} is a number that no run can change. Use it or drop it."
                )

    def time_problems(self) -> list[str]:
        """Time constants that are bound to something whose being 0 or not is another than the block's own."""
        shared = self.net.shared.values()
        symbols, values = [v.symbol for v in shared], [v.declared.value for v in shared]
        problems = []
        for path, block in self.net.blocks.items():
            for name in {state.time for state in block.declared(State).values()} - {""}:
                bound = self.net.bindings.get((path, name))
                if bound is None:
                    continue
                number = float(ca.Function("v", symbols, [ca.SX(bound)])(*values))
                if (number == 0) != (block.values[name] == 0):
                    problems.append(
                        f"{path}.{name} is bound to {text_of(bound)} = {number:g} s, but the block was made "
                        f"with {block.values[name]:g} s. What is a state must be known when the block is "
                        f"made: give it {name} = {number:g} as well."
                    )
        return problems

    # ---- values ---------------------------------------------------------------------------------------

    def needs(self, block: str, value: Any) -> list[str]:
        """Inputs of the block that an expression of its symbols depends on."""
        own = self.s[block]
        inputs = self.net.blocks[block].declared(Input)
        return [name for name in inputs if ca.depends_on(stack([value]), stack([getattr(own, name)]))]

    def at_end(self, end: End) -> Any:
        """Value of a source in terms of states, algebraic variables, inputs, parameters, flags and clocks."""
        block, name = end
        if not block:
            return self.u[name]
        if end in self.net.junctions:
            return self.at_input(end)
        if name not in self.net.blocks[block].declared(Output):
            return getattr(self.s[block], name)
        if end not in self._values:
            if end in self._open:
                raise ModelError(self.ring(self._open[self._open.index(end) :]))
            self._open.append(end)
            self._values[end] = self.resolve(block, self.eq[block].out[name])
            self._open.pop()
        return self._values[end]

    def at_input(self, target: End) -> Any:
        """Value that arrives at an input."""
        if target in self.implicit:
            return self.implicit[target]
        return self.at_end(self.net.wires[target].source)

    def resolve(self, block: str, value: Any) -> Any:
        """An expression of a block's own symbols with its inputs replaced by what feeds them."""
        names = self.needs(block, value)
        if not names:
            return value
        own = stack(getattr(self.s[block], name) for name in names)
        fed = stack(self.at_input((block, name)) for name in names)
        result = ca.substitute(stack([value]), own, fed)
        return Phasor(result[0], result[1]) if isinstance(value, Phasor) else result

    def ring(self, ends: list[End]) -> str:
        """The text of an algebraic loop."""
        lines = []
        for k, (block, name) in enumerate(ends):
            following = ends[(k + 1) % len(ends)]
            through = [
                f"{block}.{port}"
                for port in self.needs(block, self.eq[block].out[name])
                if self.net.origin((block, port)) == following
            ]
            lines.append(f"  {block}.{name}  <- needs {', '.join(through)}")
        lines.append(f"  {path_of(ends[0])}")
        return f"{self.net.name}: algebraic loop\n" + "\n".join(lines) + f"\n{WAYS_OUT}"

    def tie(self, value: Any) -> ca.SX:
        """An expression with the parameters that are bound replaced by their expressions."""
        bindings = {end: value for end, value in self.net.bindings.items() if end[0] in self.s}
        bound = stack(getattr(self.s[block], name) for block, name in bindings)
        tied: ca.SX = (
            ca.substitute(stack([value]), bound, stack(bindings.values())) if bindings else stack([value])
        )
        return tied

    # ---- rows -----------------------------------------------------------------------------------------

    def states(self) -> Iterator[tuple[str, State]]:
        """Every state with the name of its block, in the order of `x`."""
        for name, block in self.net.blocks.items():
            gone = block.lagless()
            for state in block.declared(State).values():
                if state.name not in gone:
                    yield name, state

    def unknowns(self) -> list[Unknown]:
        """Algebraic variables: of blocks, states whose time constant is 0, those of implicit wires."""
        found = []
        for name, block in self.net.blocks.items():
            states = block.declared(State)
            lagless = {key: states[key] for key in block.lagless()}
            for key, d in (block.declared(Algebraic) | lagless).items():
                residual = stack([self.resolve(name, self.eq[name].alg[key])])
                found.append(
                    Unknown(
                        getattr(self.s[name], key), residual, Row(f"{name}.{key}", d.unit, d.start, doc=d.doc)
                    )
                )
        for target, value in self.implicit.items():
            wire, declared = self.net.wires[target], self.declared(target)
            symbol, fed = stack([value]), stack([self.at_end(wire.source)])
            doc = f"implicit wire from {path_of(wire.source)}"
            for k, part in enumerate(parts(path_of(target), declared.kind)):
                found.append(
                    Unknown(symbol[k], fed[k] - symbol[k], Row(part, declared.unit, wire.start, doc=doc))
                )
        return found

    def parameters(self) -> tuple[list[Row], ca.SX]:
        """Rows and symbols of the parameters of the diagram, then of the blocks where they are not bound."""
        rows, symbols = [], []
        for name, shared in self.net.shared.items():
            d = shared.declared
            rows.append(Row(name, d.unit, d.value, d.bounds, d.doc, d.source))
            symbols.append(shared.symbol)
        for name, block in self.net.blocks.items():
            for key, d in block.declared(Parameter).items():
                if (name, key) not in self.net.bindings:
                    value, source = block.values[key], block.sources[key]
                    rows.append(Row(f"{name}.{key}", d.unit, value, block.settable(key), d.doc, source))
                    symbols.append(getattr(self.s[name], key))
        return rows, stack(symbols)

    def tied(self) -> Iterator[Tied]:
        """The parameters of blocks that are bound, each with the range that its block allows."""
        for (path, name), expression in self.net.bindings.items():
            if path in self.net.blocks:
                block = self.net.blocks[path]
                d = block.declared(Parameter)[name]
                what = f"{path}.{name} (bound to {text_of(expression)})"
                yield Tied(what, d.unit, block.settable(name), ca.SX(expression))

    def inputs(self) -> list[Row]:
        """Rows of the inputs with their values at rest."""
        rows = []
        for name, (declared, rest) in self.net.inputs.items():
            rests = (rest.real, rest.imag)
            for part, value in zip(parts(name, declared.kind), rests, strict=False):
                rows.append(Row(part, declared.unit, float(value), doc=declared.doc))
        return rows

    def outputs(self) -> tuple[list[Row], ca.SX]:
        """Rows and expressions of the outputs."""
        rows, values = [], []
        for name, end in self.net.outputs.items():
            declared = self.declared(end)
            rows += [Row(part, declared.unit, doc=declared.doc) for part in parts(name, declared.kind)]
            values.append(self.at_end(end))
        return rows, stack(values)


def checked(diagram: Diagram) -> Netlist:
    """The netlist of a diagram whose wiring is in order."""
    net = netlist(diagram)
    raise_all(structure_problems(net), diagram.name, ModelError)
    return net


def feedthrough(diagram: Diagram) -> dict[str, tuple[str, ...]]:
    """See :meth:`Diagram.feedthrough`."""
    flat = Flattener(checked(diagram))
    return {
        name: tuple(k for k, u in flat.u.items() if ca.depends_on(stack([flat.at_end(end)]), stack([u])))
        for name, end in diagram.outputs.items()
    }


def flatten(diagram: Diagram) -> Dae:
    """Compile a diagram: see :meth:`Diagram.compile`."""
    flat = Flattener(checked(diagram))
    unknowns = flat.unknowns()
    output_rows, y = flat.outputs()
    parameter_rows, p = flat.parameters()
    f = stack(flat.resolve(name, flat.eq[name].der[state.name]) for name, state in flat.states())
    x = stack(getattr(flat.s[name], state.name) for name, state in flat.states())
    z = stack(unknown.symbol for unknown in unknowns)
    g = stack(unknown.residual for unknown in unknowns)

    # what f, g and y have in common is computed once
    together = ca.cse(flat.tie(stack([f, g, y])))
    nx, nz = x.numel(), z.numel()
    f, g, y = together[:nx], together[nx : nx + nz], together[nx + nz :]
    algebraics = tuple(unknown.row for unknown in unknowns)
    check_regular(diagram.name, g, z, algebraics)
    automata = tuple(build_automaton(flat, name, p) for name, b in flat.net.blocks.items() if b.modes)
    raise_all([problem for path in flat.net.blocks for problem in flat.idle(path)], diagram.name, ModelError)
    dae = Dae(
        name=diagram.name,
        t=ca.SX.sym("t"),
        x=x,
        z=z,
        u=stack(flat.u.values()),
        p=p,
        f=f,
        g=g,
        y=y,
        states=tuple(
            Row(f"{name}.{d.name}", d.unit, d.start, d.bounds, d.doc, crossing=d.crossing)
            for name, d in flat.states()
        ),
        algebraics=algebraics,
        inputs=tuple(flat.inputs()),
        parameter_rows=tuple(parameter_rows),
        outputs=tuple(output_rows),
        automata=automata,
        start=start_values(flat, x, z, unknowns, automata),
        notes=tuple(f"{name}: {note}" for name, block in flat.net.blocks.items() for note in block.notes()),
        tied=(*flat.tied(), *dwell_times(automata)),
    )
    raise_all(dae.conflicts(dae.parameter_values()), diagram.name, ModelError)
    return dae


def dwell_times(automata: tuple[Automaton, ...]) -> Iterator[Tied]:
    """The dwell times of all rows, which must not be negative."""
    for a in automata:
        for row in a.rows:
            if not row.held.is_zero():
                yield Tied(f"{a.path}: the dwell time of '{row.text}'", "s", (0.0, np.inf), row.held)


def start_values(
    flat: Flattener, x: ca.SX, z: ca.SX, unknowns: list[Unknown], automata: tuple[Automaton, ...]
) -> ca.SX:
    """Start values as functions of `u` and `p`: what the blocks say of their rest, through the wires."""
    rests = flat.rests
    problems = []
    for name, block in flat.net.blocks.items():
        states = block.declared(State)
        problems += [
            f"{name} ({type(block).__name__}): rest() gives {key!r}, not a state.{did_you_mean(key, states)}"
            for key in rests[name]
            if key not in states
        ]
    raise_all(problems, flat.net.name, ModelError)
    guesses = [
        flat.resolve(name, ca.SX(rests[name].get(state.name, state.start))) for name, state in flat.states()
    ]
    guess = flat.tie(stack([*guesses, *[unknown.row.value for unknown in unknowns]]))
    for a in automata:
        flags = a.flags[a.mode_number(a.start)]
        guess = ca.substitute(guess, stack([a.q, a.clock]), stack([*flags, 0.0]))
    # a guess may rest on other guesses: put them in; those in a ring begin at their declared start
    xz = stack([x, z])
    n = xz.numel()
    reach = np.array(ca.DM(ca.jacobian(guess, xz).sparsity(), 1).full()) != 0
    for k in range(n):
        reach |= np.outer(reach[:, k], reach[k])
    declared = [state.start for _, state in flat.states()] + [unknown.row.value for unknown in unknowns]
    guess = stack(ca.SX(declared[k]) if reach[k, k] else guess[k] for k in range(n))
    for _ in range(n):
        guess = ca.substitute(guess, xz, guess)
    done: ca.SX = ca.cse(guess)
    return done
