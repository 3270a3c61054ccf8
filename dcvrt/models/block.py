"""Block: parameters, ports and states declared once by name, equations given once.

The same `equations` run on numbers (in tests, by hand) and on CasADi symbols (when a diagram compiles).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, ClassVar

import casadi as ca

from dcvrt.errors import InputError, ModelError, did_you_mean, is_number, raise_all
from dcvrt.models.automaton import Go
from dcvrt.models.declared import (
    Algebraic,
    D,
    Declared,
    Input,
    Output,
    Parameter,
    Part,
    Port,
    State,
    UnknownNameError,
)
from dcvrt.models.evaluation import Equations, on_symbols, stack
from dcvrt.models.phasor import Phasor, Scalar

__all__ = [
    "Algebraic",
    "Block",
    "Declared",
    "Equations",
    "Input",
    "Output",
    "Parameter",
    "Port",
    "State",
    "UnknownNameError",
]

RESERVED = {"values", "sources", "clock", "mode"}
"""Names that mean something to every block, beside those of the class."""

SHORTEST = 1e-6
"""Time constants that are not 0 may be set down to here, s, once they are compiled."""


class Namespace(SimpleNamespace):
    """The symbols, or numbers, that a block's equations see as `s`."""

    def __getattr__(self, name: str) -> Any:
        known = [k for k in vars(self) if not k.startswith("_")]
        raise UnknownNameError(f"{self._owner} has no symbol or value {name!r}.{did_you_mean(name, known)}")


class Block(Part):
    """Base of every block.

    A subclass declares :class:`Parameter`, :class:`Input`, :class:`Output`, :class:`State` and
    :class:`Algebraic` as class attributes and gives `equations`. A block that switches also declares

    - `modes`, the names, and `start`, the mode that a run begins in;
    - `flags`, for each flag one number per mode; the equations read ``s.<flag>``, and ``s.clock``, the time
      since the present mode was entered;
    - `transitions`, a method that returns the rows.

    Lines of the docstring that start with ``Differs:`` say where the block departs from the paper.
    """

    values: dict[str, float]
    sources: dict[str, str]
    modes: ClassVar[tuple[str, ...]] = ()
    start: ClassVar[str] = ""
    flags: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    optional_terms: ClassVar[bool] = False
    """Whether its values decide which terms the equations have, so that a parameter may be without effect."""
    _declared: ClassVar[dict[str, Declared]] = {}

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls._declared = {
            name: d
            for base in reversed(cls.__mro__)
            for name, d in vars(base).items()
            if isinstance(d, Declared)
        }
        problems: list[str] = []
        for name, d in cls._declared.items():
            problems += d.problems()
            if hasattr(Block, name) or name in RESERVED - ({"mode"} if isinstance(d, Output) else set()):
                problems.append(f"{name!r} is a name that every block has; choose another.")
            if isinstance(d, State) and d.time:
                lag = cls._declared.get(d.time)
                if not isinstance(lag, Parameter) or lag.unit != "s" or lag.bounds[0] < 0:
                    problems.append(
                        f"{name}: its time constant {d.time!r} must be a parameter of the block in s, "
                        "with bounds from 0 on."
                    )
        if isinstance(cls.modes, str) or len(set(cls.modes)) < len(cls.modes):
            problems.append(f"modes = {cls.modes!r} must be a tuple of different names: ('OFF', 'ON').")
        elif not cls.modes and cls.transitions is not Block.transitions:
            problems.append("there are transitions, but no modes. Declare modes and start.")
        for flag, column in cls.flags.items():
            if flag in cls._declared:
                problems.append(f"the flag {flag!r} has the name of a symbol of the block.")
            if not isinstance(column, tuple | list) or not all(map(is_number, column)):
                problems.append(f"the flag {flag!r} is {column!r}, not one number for each mode: (0.0, 1.0).")
            elif len(column) != len(cls.modes):
                problems.append(f"the flag {flag!r} has {len(column)} values for {len(cls.modes)} modes.")
        raise_all(problems, cls.__name__, ModelError)

    def __init__(self, *unnamed: float, **values: float) -> None:
        if unnamed:
            first = next(iter(self.declared(Parameter)), "name")
            raise InputError(
                f"{type(self).__name__}: values are given by name: "
                f"{type(self).__name__}({first}={unnamed[0]!r})."
            )
        self.values = {name: p.value for name, p in self.declared(Parameter).items()}
        self.sources = {name: p.source for name, p in self.declared(Parameter).items()}
        problems = [problem for name, value in values.items() if (problem := self.problem_of(name, value))]
        raise_all(problems, type(self).__name__, InputError)
        self.values.update({name: float(value) for name, value in values.items()})
        self.sources.update({name: "set by the user" for name in values})

    @classmethod
    def declared(cls, kind: type[D]) -> dict[str, D]:
        """What the block declares of one kind, in the order of the class body."""
        return {name: d for name, d in cls._declared.items() if isinstance(d, kind)}

    def problem_of(self, parameter: str, value: float) -> str:
        """Why `parameter` cannot be `value`, or an empty text when it can."""
        known = self.declared(Parameter)
        if parameter not in known:
            return f"there is no parameter {parameter!r}.{did_you_mean(parameter, known)}"
        return known[parameter].refusal(value, parameter)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise self.unknown(name)

    # ---- what a subclass gives -------------------------------------------------------------------------

    def equations(self, s: Any) -> Equations:
        """Derivatives, outputs and residuals as pure functions of the namespace `s`."""
        raise ModelError(
            f"{type(self).__name__} gives no equations. Write equations(self, s), which returns "
            "Equations(der=..., out=...)."
        )

    def transitions(self, s: Any) -> tuple[Go, ...]:
        """Rows of the table of modes, tried from top to bottom."""
        return ()

    def rest(self, s: Any) -> Mapping[str, Scalar]:
        """Start values of states as functions of inputs and parameters, for the search of the equilibrium.

        Where these lead in a ring from a state back to itself, the declared `start` is taken instead.
        """
        return {}

    # ---- time constants that are 0 --------------------------------------------------------------------

    def lagless(self) -> tuple[str, ...]:
        """States that are none on this block, because their time constant is 0.

        >>> from dcvrt.models import CurrentLag
        >>> CurrentLag().lagless()
        ()
        """
        states = self.declared(State).items()
        return tuple(name for name, state in states if state.time and self.values[state.time] == 0)

    def settable(self, parameter: str) -> tuple[float, float]:
        """Range that a parameter keeps once the block is compiled.

        A time constant that is 0 stays 0, and one that is not stays above 0: otherwise the system would be
        another one.
        """
        low, high = self.declared(Parameter)[parameter].bounds
        value = self.values[parameter]
        if not any(state.time == parameter for state in self.declared(State).values()):
            return low, high
        return (max(low, min(value, SHORTEST)), high) if value else (0.0, 0.0)

    def reduced(self, eq: Equations, s: Any) -> Equations:
        """The equations with time constants divided out, and those that are 0 among the residuals."""
        gone, states = self.lagless(), self.declared(State)
        return Equations(
            der={
                name: side / getattr(s, states[name].time) if states[name].time else side
                for name, side in eq.der.items()
                if name not in gone
            },
            out=eq.out,
            alg={**eq.alg, **{name: eq.der[name] for name in gone}},
        )

    # ---- use ------------------------------------------------------------------------------------------

    def at(self, **values: Any) -> Namespace:
        """Namespace with these numbers, the block's parameters and, by default, the flags of its start mode.

        >>> from dcvrt.models import Pll
        >>> pll = Pll(K_p=50.0)
        >>> pll.equations(pll.at(v=Phasor(1.0, 0.2), xi=0.0, delta=0.0)).der["delta"]
        10.0
        """
        mode = values.pop("mode", self.start)
        known = [*self._declared, *self.flags, *(["clock", "mode"] if self.modes else [])]
        problems = [
            f"there is no {name!r}.{did_you_mean(name, known)}" for name in values if name not in known
        ]
        if mode and mode not in self.modes:
            problems.append(f"there is no mode {mode!r}.{did_you_mean(mode, self.modes)}")
        raise_all(problems, type(self).__name__, InputError)
        given = dict(self.values)
        if self.modes:
            given |= {flag: column[self.modes.index(mode)] for flag, column in self.flags.items()} | {
                "clock": 0.0
            }
        return Namespace(_owner=type(self).__name__, **(given | values))

    def symbols(self, path: str) -> Namespace:
        """CasADi symbols for everything declared but the outputs, and for the flags and the clock."""

        def symbol(name: str, kind: type) -> Any:
            if kind is Phasor:
                return Phasor(ca.SX.sym(f"{path}.{name}.re"), ca.SX.sym(f"{path}.{name}.im"))
            return ca.SX.sym(f"{path}.{name}")

        table = {
            name: symbol(name, d.kind) for name, d in self._declared.items() if not isinstance(d, Output)
        }
        if self.modes:
            table |= {name: symbol(name, float) for name in (*self.flags, "clock")}
        return Namespace(_owner=f"{path} ({type(self).__name__})", **table)

    def feedthrough(self) -> dict[str, tuple[str, ...]]:
        """Inputs that each output depends on at once, without a state between: read from the equations.

        >>> from dcvrt.models import CurrentReference
        >>> CurrentReference().feedthrough()
        {'i': ('v', 'delta', 'p_c', 'q_c'), 'v_dq': ('v', 'delta')}
        """
        s = self.symbols(self.name or type(self).__name__)
        out = on_symbols(self, "equations", s).out
        inputs = self.declared(Input)
        return {
            name: tuple(k for k in inputs if ca.depends_on(stack([out[name]]), stack([getattr(s, k)])))
            for name in self.declared(Output)
        }

    def notes(self) -> list[str]:
        """The deviations from the paper: the ``Differs:`` lines of the docstring, each joined to one line."""
        notes: list[str] = []
        inside = False
        for line in (type(self).__doc__ or "").splitlines():
            text = line.strip()
            if text.startswith("Differs:"):
                notes.append(text.removeprefix("Differs:").strip())
                inside = True
            elif inside and text and not text.startswith(".. "):
                notes[-1] += " " + text
            else:
                inside = False
        return notes
