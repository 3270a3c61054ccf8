"""The table of modes of a block, checked and put into the terms of the flat system."""

from __future__ import annotations

import re
from collections.abc import Callable
from math import nan
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from dcvrt.dae import Array, Automaton, Transition
from dcvrt.errors import ModelError, did_you_mean, raise_all
from dcvrt.models.automaton import check_hysteresis, check_table
from dcvrt.models.block import State

if TYPE_CHECKING:
    from dcvrt.models.compile import Flattener


def build_automaton(flat: Flattener, name: str, p: ca.SX, values: Array) -> Automaton:
    """The automaton of one block; `values` are those of the parameters `p`, for the check of the limits."""
    block, s = flat.diagram.blocks[name], flat.s[name]
    rows = block.transitions(s)
    who = f"{flat.diagram.name}: {name} ({type(block).__name__})"
    short = shortener(name)
    raise_all(check_table(block.modes, block.start, rows), who, ModelError)

    def number(limit: Any) -> float:
        """Value of a limit; NaN, which compares as never apart, for one that varies in time."""
        tied = flat.tie(limit)
        return nan if varies(tied, p) else float(ca.Function("limit", [p], [tied])(values))

    problems = [short(problem) for problem in check_hysteresis(rows, number)]
    states = list(block.declared(State))
    for row in rows:
        step = f"{row.source} -> {row.target}"
        if varies(flat.tie(row.held), p):
            problems.append(f"{step}: held may depend on parameters only, not {short(str(row.held))}.")
        problems += [
            f"{step}: reset of {key!r}, not a state of the block.{did_you_mean(key, states)}"
            for key in row.reset
            if key not in states
        ]
    raise_all(problems, who, ModelError)

    positions = {state.name: k for k, (owner, state) in enumerate(flat.states()) if owner == name}
    flags: Any = ca.vertcat(*[getattr(s, flag) for flag in block.flags])

    def settled(value: Any) -> ca.SX:
        return flat.tie(flat.resolve(name, ca.SX(value)))

    return Automaton(
        path=name,
        modes=block.modes,
        start=block.start,
        q=flags,
        flag_names=tuple(block.flags),
        flags=np.array(list(block.flags.values()), dtype=float).T.reshape(len(block.modes), -1),
        clock=s.clock,
        rows=tuple(
            Transition(
                source=row.source,
                target=row.target,
                guard=settled(row.when.margin),
                held=settled(row.held),
                text=short(str(row)),
                reset={positions[key]: settled(value) for key, value in row.reset.items()},
            )
            for row in rows
        ),
    )


def varies(expression: ca.SX, p: ca.SX) -> bool:
    """Whether it depends on anything but parameters."""
    known = {str(v) for v in ca.symvar(p)} if p.numel() else set()
    return any(str(v) not in known for v in ca.symvar(expression))


def shortener(name: str) -> Callable[[str], str]:
    """Takes the block's path off its own symbols: the reader knows which block it is."""
    pattern = re.compile(rf"\b{re.escape(name)}\.")
    return lambda text: pattern.sub("", text)
