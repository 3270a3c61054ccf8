"""The table of modes of a block, checked and put into the terms of the flat system."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from dcvrt.dae import Automaton, Gap, Transition
from dcvrt.errors import ModelError, did_you_mean, raise_all
from dcvrt.models.automaton import check_table, gaps
from dcvrt.models.declared import State
from dcvrt.models.evaluation import NO_NUMBER, holds_nan

if TYPE_CHECKING:
    from dcvrt.models.compile import Flattener


def build_automaton(flat: Flattener, name: str, p: ca.SX) -> Automaton:
    """The automaton of one block."""
    block, s = flat.net.blocks[name], flat.s[name]
    rows = flat.rows[name]
    who = f"{flat.net.name}: {name} ({block.label})"
    short = shortener(name)
    problems = check_table(block.modes, block.start, rows)
    raise_all(problems, who, ModelError)

    states = [key for key in block.declared(State) if key not in block.lagless()]
    for row in rows:
        step = f"{row.source} -> {row.target}"
        for value in (row.when.margin, row.held, *row.reset.values()):
            if holds_nan(value):
                problems.append(f"{step}: {short(str(value))} {NO_NUMBER}")
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

    def of_parameters(value: Any) -> ca.SX | None:
        """A value in terms of the parameters, or None where it varies."""
        tied = settled(value)
        others = ca.vertcat(ca.SX(0, 1), *[v for v in ca.symvar(tied) if varies(v, p)])
        if not ca.jacobian(tied, others).is_zero():
            return None
        constant: ca.SX = ca.substitute(tied, others, ca.SX.zeros(others.numel()))
        return constant

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
        gaps=tuple(
            Gap(
                (short(gap.rows[0]), short(gap.rows[1])),
                gap.width,
                tuple((short(n), v) for n, v in gap.limits),
            )
            for gap in gaps(rows, of_parameters, {key: getattr(s, key) for key in states})
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
