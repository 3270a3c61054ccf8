"""The C text of one structure of unit: source current, rates, guards and resets, on packs of units."""

from __future__ import annotations

import casadi as ca

from dcvrt.grid.native.structure import Structure
from dcvrt.integrators.kernel.emit import Argument, Program

COLUMNS = {"sources", "rates", "guardses", "afters"}
"""Results that are derivatives by theta, one column a direction."""


def program_of(structure: Structure) -> Program:
    """The numbered expressions of all functions of a structure."""
    dae = structure.dae
    inputs = ca.vertcat(structure.v, dae.clocks)
    sizes = {"xs": dae.x.numel(), "us": inputs.numel(), "sp": len(structure.moving)}
    xs, us, sp = (ca.SX.sym(name, n) for name, n in sizes.items())
    seeds = ca.SX.zeros(structure.p.numel())
    for k, path in enumerate(structure.moving):
        seeds[structure.column(path)] = sp[k]

    def along(expression: ca.SX) -> ca.SX:
        moved, by = ca.vertcat(dae.x, inputs, structure.p), ca.vertcat(xs, us, seeds)
        return ca.densify(ca.jtimes(expression, moved, by))

    made = {
        "source": [("source", structure.source)],
        "source_theta": [("source", structure.source), ("sources", along(structure.source))],
        "flow": [("rate", dae.f)],
        "flow_theta": [("rate", dae.f), ("rates", along(dae.f))],
        "look": [("guards", structure.guards)],
        "look_theta": [("guards", structure.guards), ("guardses", along(structure.guards))],
        "source_by_v": [("slope", ca.densify(ca.jacobian(structure.source, structure.v)))],
    }
    for k, (_, row) in enumerate(structure.rows):
        if row.reset:
            after = ca.vertcat(*ca.vertsplit(dae.x)) if dae.x.numel() else ca.SX(0, 1)
            for state, value in row.reset.items():
                after[state] = value
            made[f"reset_{k}"] = [("after", after), ("afters", along(after))]
    fixed, column = {"fixed": True}, {"column": True}
    arguments = [
        Argument("p", structure.p, **fixed), Argument("q", dae.q, **fixed),
        Argument("sp", sp, **fixed, **column),
        Argument("x", dae.x), Argument("u", inputs),
        Argument("xs", xs, **column), Argument("us", us, **column),
    ]  # fmt: skip
    columns = [r for results in made.values() for r, _ in results if r in COLUMNS]
    return Program(arguments, made, columns)


def text_of(structure: Structure) -> str:
    """Contents of `unit.h`."""
    program, dae = program_of(structure), structure.dae
    resets = [k for k, (_, row) in enumerate(structure.rows) if row.reset]
    cases = "".join(f"  case {k}: reset_{k}(at, after, afters); return;\n" for k in resets)
    return "\n".join(
        [
            f"enum {{ NX = {dae.x.numel()}, NA = {len(dae.automata)}, FIXED = {program.sizes['fixed']}, "
            f"FIXED_COLUMNS = {program.sizes['fixed_columns']} }};",
            program.hoisting("hoist"),
            *(program.function(name) for name in program.functions),
            "static void reset_of(long row, const struct point *at, real *after, column *afters) {\n"
            f"  (void)at; (void)after; (void)afters;\n  switch (row) {{\n{cases}  }}\n}}\n",
        ]
    )
