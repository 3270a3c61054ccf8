"""Diagram: add parts, wire their ports, compile to one flat system."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Literal, TypeVar

import casadi as ca

from dcvrt.dae import Dae
from dcvrt.errors import InputError, ModelError, did_you_mean, is_number, raise_all
from dcvrt.models.declared import (
    D,
    Declared,
    Input,
    Output,
    Parameter,
    Part,
    Port,
    UnknownNameError,
)
from dcvrt.models.phasor import Scalar
from dcvrt.models.wiring import End, Wire, driven_twice

P = TypeVar("P", bound=Part)


@dataclass(frozen=True)
class Shared:
    """A parameter of the whole diagram and the symbol that expressions use for it."""

    symbol: ca.SX
    declared: Parameter


@dataclass(eq=False)
class Diagram(Part):
    """Parts and wires under one name. A part is a block, or another diagram that is used as one.

    Nothing is checked until `compile`, which reports every structural error at once; values given to `set`
    and names looked up are checked on the spot. A diagram that is added to another shows its inputs, outputs
    and parameters as ports and parameters; the paths of what is in it begin with its name there.

    `doc` says in a line what it is; `page` is the prose that a sheet begins with: what it is for.

    >>> from dcvrt.models import Diagram, Phasor, Pll
    >>> d = Diagram("mine")
    >>> v = d.input("v_poi", "pu(V)", Phasor)
    >>> pll = d.add("pll", Pll(K_p=60.0))
    >>> d.connect(v, pll.v)
    >>> d.output("omega", pll.omega)
    >>> d.compile().x_names
    ('pll.xi', 'pll.delta')

    >>> site = Diagram("site")
    >>> for name in ("one", "two"):
    ...     part = Diagram("half")
    ...     lock = part.add("pll", Pll())
    ...     part.connect(part.input("v", "pu(V)", Phasor), lock.v)
    ...     _ = site.add(name, part)
    >>> site.connect(site.input("v_poi", "pu(V)", Phasor), site.port("one.v"), site.port("two.v"))
    >>> site.compile().x_names
    ('one.pll.xi', 'one.pll.delta', 'two.pll.xi', 'two.pll.delta')
    """

    name: str
    doc: str = ""
    page: str = ""
    blocks: dict[str, Part] = field(default_factory=dict, init=False)
    inputs: dict[str, tuple[Input, complex]] = field(default_factory=dict, init=False)
    shared: dict[str, Shared] = field(default_factory=dict, init=False)
    bindings: dict[End, Scalar] = field(default_factory=dict, init=False)
    wires: dict[End, Wire] = field(default_factory=dict, init=False)
    outputs: dict[str, End] = field(default_factory=dict, init=False)
    problems: list[str] = field(default_factory=list, init=False)
    """Errors of wiring seen so far; `compile` reports them with its own."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError("a diagram needs a name: Diagram('mine').")
        self.title = self.name

    # ---- parts ----------------------------------------------------------------------------------------

    def add(self, name: str, block: P) -> P:
        """Add a block, or a diagram as one, under a name, and return it."""
        self._check_part(name, block)
        if name in self.blocks or name in self.shared or name in self.inputs:
            self.problems.append(f"the name {name!r} is taken. Add the second {block.label} under another.")
        elif "." in name:
            self.problems.append(
                f"the name {name!r} has a dot, which separates the parts of a path. Drop it."
            )
        elif block.home is not None:
            self.problems.append(
                f"the block added as {name!r} is already {block.name!r} of a diagram. "
                f"Make a second {block.anew}."
            )
        elif block is self or block in self._homes():
            self.problems.append(f"{block.label} cannot be a part of itself, here added as {name!r}.")
        else:
            block.name, block.home = name, self
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
        declared = Parameter(value, unit, bounds, doc, source)
        declared.name = name
        raise_all(list(declared.problems()), self.name, InputError)
        if name in self.shared or name in self.blocks or name in self.inputs:
            self.problems.append(f"the name {name!r} of a parameter is taken.")
        self.shared[name] = Shared(ca.SX.sym(name), declared)
        return self.shared[name].symbol

    def input(
        self, name: str, unit: str, kind: type = float, rest: complex | None = None, doc: str = ""
    ) -> Port:
        """An input of the whole diagram; `rest` is its value before anything happens (phasor 1, number 0)."""
        declared = Input(unit, doc, kind=kind)
        declared.name = name
        raise_all(list(declared.problems()), self.name, InputError)
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
                self.problems.append(driven_twice(end, self.wires[end].source, origin))
            else:
                self.wires[end] = Wire(origin, implicit, start)

    def bind(self, block: Part, **expressions: Scalar) -> None:
        """Tie parameters of a part to expressions of the diagram's parameters."""
        if not isinstance(block, Part):
            self.problems.append(f"bind: {block!r} is not a block. Give the block that add returned.")
            return
        path = self._path(block)
        if not path:
            self.problems.append(f"bind: {block.label} was not added to this diagram.")
            return
        for name, expression in expressions.items():
            if isinstance(expression, ca.SX) or is_number(expression):
                self.bindings[path, name] = expression
            else:
                self.problems.append(
                    f"bind: {path}.{name} = {expression!r} is neither a number nor an expression of what "
                    "parameter() returned."
                )

    def replace(self, name: str, block: P) -> P:
        """Put another part in the place of one: wires and bindings stay, its own values come with it.

        `name` may be a path into a diagram that is a part of this one.
        """
        self._check_part(name, block)
        self._known_part(name)
        outer, _, local = name.rpartition(".")
        owner: Any = self.part(outer) if outer else self
        if block.home is not None:
            raise ModelError(f"the block is already {block.name!r} of a diagram. Make a new {block.anew}.")
        owner.blocks[local].home = None
        block.name, block.home = local, owner
        owner.blocks[local] = block
        return block

    def set(self, path: str, value: float, source: str = "set by the user") -> None:
        """Give a parameter, ``block.symbol`` or a parameter of the diagram, another value.

        Raises
        ------
        InputError
            the name is not known, the value is outside its bounds, or the parameter is bound.
        """
        from dcvrt.models.expressions import text_of
        from dcvrt.models.netlist import netlist

        flat = netlist(self)
        block_path, _, symbol = path.rpartition(".")
        if (expression := flat.bindings.get((block_path, symbol))) is not None:
            behind = [str(v) for v in ca.symvar(ca.SX(expression))]
            instead = (
                f"Set {' or '.join(map(repr, behind))} instead, or bind it anew."
                if behind
                else "Bind it anew."
            )
            raise InputError(f"{path} is bound to {text_of(expression)}. {instead}")
        places = flat.parameters()
        if path not in places:
            near = [known for known in places if known.rpartition(".")[0] == block_path]
            raise InputError(f"{self.name} has no parameter {path!r}.{did_you_mean(path, near or places)}")
        declared = places[path]
        if refusal := declared.refusal(value, path):
            raise InputError(refusal)
        if path in flat.shared:
            declared.value, declared.source = float(value), source
        else:
            block = flat.blocks[block_path]
            block.values[symbol], block.sources[symbol] = float(value), source

    def port(self, path: str) -> Port:
        """The port at ``block.symbol``, or the input of the diagram of that name."""
        if path in self.inputs:
            return Port(None, self.inputs[path][0])
        block, _, name = path.rpartition(".")
        if not block:
            raise InputError(f"{self.name} has no input {path!r}.{did_you_mean(path, self.inputs)}")
        self._known_part(block)
        part: Any = self.part(block)
        known = {n: d for n, d in part.declared(Declared).items() if not isinstance(d, Parameter)}
        if name in known:
            return Port(part, known[name])
        if name in part.declared(Parameter):
            raise InputError(f"{path} is a parameter, not a port. Give it a value with set or bind.")
        raise InputError(
            f"{self.name} has no port {path!r}.{did_you_mean(path, [f'{block}.{n}' for n in known])}"
        )

    def part(self, path: str) -> Part | None:
        """The block or diagram at a path, or None."""
        here: Part | None = self
        for name in path.split("."):
            here = here.blocks.get(name) if isinstance(here, Diagram) else None
        return here

    # ---- results --------------------------------------------------------------------------------------

    def compile(self, eliminate: bool | Sequence[str] = False) -> Dae:
        """Check everything and flatten to a :class:`Dae`.

        Parameters
        ----------
        eliminate : algebraic variables to put in terms of the others, where their equations allow it: paths,
            or True for all. By default every one is kept, to be solved along with the states, but for states
            whose time constant is 0 and whose equation is explicit. An eliminated variable appears in the
            results only if it is an output.

        Raises
        ------
        ModelError
            structural errors, all that are visible at once: inputs without a source, units that do not match,
            inputs driven twice, algebraic loops, missing equations, a singular algebraic part, modes that
            cannot be reached or left, thresholds without hysteresis, unknown names, a variable to eliminate
            whose equation has no explicit solution.
        """
        from dcvrt.models.algebraic import eliminated
        from dcvrt.models.compile import flatten
        from dcvrt.models.netlist import netlist

        lagless = [
            f"{path}.{name}" for path, block in netlist(self).blocks.items() for name in block.lagless()
        ]
        dae = eliminated(flatten(self), lagless, strict=False)
        rest = eliminate if isinstance(eliminate, (bool, str)) else [e for e in eliminate if e not in lagless]
        return eliminated(dae, rest)

    def feedthrough(self) -> dict[str, tuple[str, ...]]:
        """Inputs that each output depends on at once, without a state between: read from the equations."""
        from dcvrt.models.compile import feedthrough

        return feedthrough(self)

    def sheet(self, form: Literal["markdown", "latex"] = "markdown") -> str:
        """What an engineer reads before trusting it: equations, parameters, ports, modes, deviations.

        Parameters
        ----------
        form : ``"markdown"``, or ``"latex"`` for a document that compiles on its own.
        """
        from dcvrt.models.sheet import sheet

        return sheet(self, form)

    # ---- as a part of another diagram -----------------------------------------------------------------

    @property
    def label(self) -> str:
        return self.title

    @property
    def anew(self) -> str:
        return f"diagram {self.title!r}"

    def declared(self, kind: type[D]) -> dict[str, D]:
        """Its parameters, inputs and outputs, as declarations of one kind."""
        table: dict[str, Declared] = {name: shared.declared for name, shared in self.shared.items()}
        table |= {name: declared for name, (declared, _) in self.inputs.items()}
        for name, end in self.outputs.items():
            source = self._find(end)
            if source is not None:
                out = Output(source.unit, source.doc, kind=source.kind)
                out.name = name
                table[name] = out
        return {name: d for name, d in table.items() if isinstance(d, kind)}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "blocks" not in self.__dict__:
            raise AttributeError(name)
        if name in self.shared:
            return self.shared[name].declared.value
        known = self.declared(Declared)
        if name not in known and name in Dae.__dataclass_fields__:
            raise UnknownNameError(
                f"{self.title} is a diagram, and {name!r} belongs to a system. Compile it first: "
                f"{self.title}.compile()."
            )
        if name not in known:
            raise self.unknown(name)
        return Port(self, known[name])

    # ---- helpers --------------------------------------------------------------------------------------

    def _check_part(self, name: Any, part: Any) -> None:
        """Refuse what can be no part of a diagram before it is taken in."""
        if isinstance(part, type) and issubclass(part, Part):
            raise ModelError(
                f"{self.name}: {name!r} is given the class {part.__name__}, not a block. "
                f"Make one: {part.__name__}()."
            )
        if not isinstance(name, str) or not isinstance(part, Part):
            raise ModelError(f"{self.name}: add and replace take a name and a block: add('pll', Pll()).")

    def _find(self, end: End) -> Declared | None:
        """What stands at the end of a wire."""
        path, name = end
        if not path:
            return self.inputs[name][0] if name in self.inputs else None
        part = self.part(path)
        return part.declared(Declared).get(name) if part is not None else None

    def _homes(self) -> Iterator[Part]:
        """The diagrams that it stands in."""
        here = self.home
        while here is not None:
            yield here
            here = here.home

    def _path(self, part: Part) -> str:
        """Path of a part within this diagram; empty when it is not in it."""
        names: list[str] = []
        here: Part | None = part
        while here is not None and here is not self:
            names.insert(0, here.name)
            here = here.home
        return ".".join(names) if here is self else ""

    def _end(self, port: Any) -> End | None:
        if not isinstance(port, Port):
            if isinstance(port, ca.SX):
                told = f"{port} is a parameter of the diagram, not a port. Use bind(block, name={port})."
            elif is_number(port):
                told = f"{port!r} is a number, not a port. A parameter gets its value from set or bind."
            else:
                told = f"{port!r} is not a port. Take ports from blocks (pll.delta) or from input()."
            self.problems.append(told)
            return None
        if port.block is None:
            known = self.inputs.get(port.declared.name)
            if known is None or known[0] is not port.declared:
                self.problems.append(f"the input {port} belongs to another diagram.")
                return None
            return ("", port.declared.name)
        path = self._path(port.block)
        if not path:
            self.problems.append(
                f"{port} belongs to a block that is not in this diagram. Add the block first."
            )
            return None
        return (path, port.declared.name)

    def _known_part(self, path: str) -> None:
        if self.part(path) is None:
            outer, _, _ = path.rpartition(".")
            inside = self.part(outer) if outer else self
            known = inside.blocks if isinstance(inside, Diagram) else self.blocks
            prefix = f"{outer}." if isinstance(inside, Diagram) and outer else ""
            names = [prefix + name for name in known]
            raise InputError(f"{self.name} has no block {path!r}.{did_you_mean(path, names)}")
