"""The C text of one system: sizes and tables, and its functions on the type that holds one case or many.

The functions are those of :class:`~dcvrt.integrators.equations.Equations`, taken apart so that each is
computed where it is needed: inputs and their rates stand for themselves (the driver reads them off the
pieces), the rate of the states is handed on instead of being computed again, and derivatives by theta are
written for one column, with seeds, however many columns there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from dcvrt.integrators.equations import Equations
from dcvrt.integrators.kernel.elimination import Elimination
from dcvrt.integrators.kernel.emit import Argument, Program, literal


class ModelText:
    """C text of the functions of one set of equations.

    Parameters
    ----------
    equations : the system and its thetas.
    watched : outputs that functionals read.
    implicit : whether the method solves with the Jacobian.
    """

    def __init__(self, equations: Equations, watched: Sequence[str] = (), implicit: bool = False) -> None:
        self.equations, self.watched, self.implicit = equations, tuple(watched), implicit
        eq, dae = equations, equations.dae
        self.directions = [k for k, c in enumerate(eq.columns) if c.parameter is not None]
        self.driven = list(eq.voltage or ()) if eq.tangents else []
        nx, nz, na = eq.nx, eq.nz, eq.na
        self.rate = ca.SX.sym("d", nx)
        self.sx, self.sz, self.sd = (ca.SX.sym(n, k) for n, k in (("sx", nx), ("sz", nz), ("sd", nx)))
        self.sp, self.sc = ca.SX.sym("sp", len(self.directions)), ca.SX.sym("sc", na)
        self.su, self.sv = ca.SX.sym("su", len(self.driven)), ca.SX.sym("sv", len(self.driven))
        fixed = {"fixed": True}
        column = {"column": True}
        self.arguments = [
            Argument("p", dae.p, **fixed), Argument("q", dae.q, **fixed),
            Argument("sp", self.sp, **fixed, **column), Argument("sc", self.sc, **fixed, **column),
            Argument("t", dae.t), Argument("x", dae.x), Argument("z", dae.z), Argument("u", dae.u),
            Argument("v", eq.u_rate), Argument("c", dae.clocks), Argument("d", self.rate),
            Argument("xs", self.sx, **column), Argument("zs", self.sz, **column),
            Argument("us", self.su, **column), Argument("vs", self.sv, **column),
            Argument("ds", self.sd, **column),
        ]  # fmt: skip

    # -- derivatives --------------------------------------------------------------------------------------

    def _along_theta(self, expression: ca.SX) -> ca.SX:
        """Total derivative by theta at fixed time, for the seeds of one column."""
        eq, dae = self.equations, self.equations.dae
        dp, du, dv = ca.SX.zeros(eq.np, 1), ca.SX.zeros(eq.nu, 1), ca.SX.zeros(eq.nu, 1)
        for k, column in enumerate(self.directions):
            number = eq.columns[column].parameter
            assert number is not None
            dp[number] = self.sp[k]
        for k, number in enumerate(self.driven):
            du[number], dv[number] = self.su[k], self.sv[k]
        arguments = ca.vertcat(dae.x, dae.z, dae.p, dae.u, eq.u_rate, dae.clocks, self.rate)
        seeds = ca.vertcat(self.sx, self.sz, dp, du, dv, self.sc, self.sd)
        return ca.densify(ca.jtimes(expression, arguments, seeds))

    def _by_theta(self, expression: ca.SX) -> ca.SX:
        """Partial derivative by theta, through parameters and inputs, for the seeds of one column."""
        moved = ca.vertcat(self.sx, self.sz, self.sc)
        return ca.substitute(self._along_theta(expression), moved, ca.SX.zeros(moved.numel()))

    def _along_time(self, expression: ca.SX) -> ca.SX:
        """Total time derivative, along a given rate of the states."""
        eq, dae = self.equations, self.equations.dae
        arguments = ca.vertcat(dae.x, dae.t, dae.u, dae.clocks)
        rates = ca.vertcat(self.rate, 1, eq.u_rate, ca.SX.ones(eq.na, 1))
        if eq.nz:
            known = ca.jtimes(dae.g, arguments, rates)
            z_rate = -ca.solve(ca.densify(ca.jacobian(dae.g, dae.z)), known)
            arguments, rates = ca.vertcat(arguments, dae.z), ca.vertcat(rates, z_rate)
        return ca.densify(ca.jtimes(expression, arguments, rates))

    # -- what an implicit method calls ----------------------------------------------------------------------

    @cached_property
    def jacobian(self) -> ca.SX:
        """d(f, g)/d(x, z), sparse."""
        dae = self.equations.dae
        return ca.sparsify(ca.jacobian(ca.vertcat(dae.f, dae.g), ca.vertcat(dae.x, dae.z)))

    @property
    def _entries(self) -> ca.SX:
        """Nonzeros of the Jacobian, column after column."""
        return self.jacobian.nz[:] if self.jacobian.nnz() else ca.SX(0, 1)

    @cached_property
    def bends(self) -> list[tuple[int, int, ca.SX]]:
        """Row, column and derivative by theta of the entries of the Jacobian that depend on it."""
        rows, columns = self.jacobian.sparsity().get_triplet()
        along = self._along_theta(self._entries)
        entries = zip(rows, columns, ca.vertsplit(along), strict=True)
        return [(i, j, bend) for i, j, bend in entries if not bend.is_zero()]

    def _implicit(self) -> dict[str, list[tuple[str, ca.SX]]]:
        """(f, g) at a stage; with their Jacobian and partial derivative by time at the begin of a step."""
        eq, dae = self.equations, self.equations.dae
        both = ca.vertcat(dae.f, dae.g)
        moved = ca.vertcat(dae.t, dae.u, dae.clocks)
        drift = ca.densify(ca.jtimes(both, moved, ca.vertcat(1, eq.u_rate, ca.SX.ones(eq.na, 1))))
        balance = [("both", both)]
        linear = [*balance, ("jacobian", self._entries), ("drift", drift)]
        made = {"balance": balance, "linear": linear}
        if eq.nw:
            along = [("boths", self._along_theta(both))]
            bends = ca.vertcat(ca.SX(0, 1), *(bend for _, _, bend in self.bends))
            made["balance_theta"] = [*balance, *along]
            made["linear_theta"] = [
                *linear, *along, ("bends", bends), ("drifts", self._along_theta(drift))
            ]  # fmt: skip
        return made

    def elimination(self) -> str:
        """How linear systems with the Jacobian are solved."""
        eq = self.equations
        entries = list(zip(*self.jacobian.sparsity().get_triplet(), strict=True))
        return Elimination(entries, eq.nx, eq.nx + eq.nz).text()

    # -- functions ----------------------------------------------------------------------------------------

    @cached_property
    def guards(self) -> ca.SX:
        """Guards of all rows, then how far each bounded state is beyond its bound."""
        eq = self.equations
        return ca.vertcat(
            ca.SX(0, 1),
            *[r.guard for _, r in eq.rows],
            *[sign * (eq.dae.x[k] - bound) for k, sign, bound in eq.bounds],
        )

    @cached_property
    def functions(self) -> dict[str, list[tuple[str, ca.SX]]]:
        """Results of every function by its name."""
        eq, dae = self.equations, self.equations.dae
        made: dict[str, list[tuple[str, ca.SX]]] = {
            "flow": [("f", dae.f)],
            "look": [("guard", self.guards), ("rate", self._along_time(self.guards))],
            "held_of": [("held", ca.vertcat(ca.SX(0, 1), *[ca.SX(r.held) for _, r in eq.rows]))],
        }
        w = ca.vertcat(dae.x, dae.z)
        still = ca.substitute(ca.vertcat(dae.f, dae.g), ca.vertcat(dae.t, dae.clocks), ca.SX.zeros(1 + eq.na))
        made["rest"] = [("residual", still), ("jacobian", ca.jacobian(still, w))]
        start = dae.start if dae.start.numel() else ca.SX([r.value for r in (*dae.states, *dae.algebraics)])
        made["begin"] = [("w", start)]
        outputs = {"outputs": dae.y}
        if self.watched:
            numbers = [dae.y_names.index(n) for n in self.watched]
            outputs["watch"] = ca.vertcat(*[dae.y[k] for k in numbers])
        for name, y in outputs.items():
            made[name] = [("y", y), ("y_rate", self._along_time(y))]
        if self.watched:
            made["watch_value"] = [("y", outputs["watch"])]
        for k, (_, row) in enumerate(eq.rows):
            if row.reset:
                after = ca.SX(dae.x)
                for state, expression in row.reset.items():
                    after[state] = expression
                made[f"reset_{k}"] = [("after", after), ("rate", self._along_time(after))]
        if eq.nw:
            f, guards, held = dae.f, self.guards, made["held_of"][0][1]
            made["rest_theta"] = [("residuals", self._by_theta(still))]
            made["begin_theta"] = [("ws", self._by_theta(start))]
            made["flow_theta"] = [("f", f), ("fs", self._along_theta(f))]
            made["cross"] = [("guards", self._along_theta(guards))]
            made["held_theta"] = [("helds", self._along_theta(held))]
            for name, y in outputs.items():
                along = [("ys", self._along_theta(y)), ("yrs", self._along_theta(self._along_time(y)))]
                made[f"{name}_theta"] = [*made[name], *along]
            for k, (_, row) in enumerate(eq.rows):
                if row.reset:
                    made[f"reset_{k}_theta"] = [("afters", self._along_theta(made[f"reset_{k}"][0][1]))]
        if self.implicit:
            made |= self._implicit()
        if eq.nz:
            made["algebra"] = [("g", dae.g), ("jacobian", ca.jacobian(dae.g, dae.z))]
            if eq.nw:
                free = ca.substitute(self._along_theta(dae.g), self.sz, ca.SX.zeros(eq.nz))
                made["algebra_theta"] = [("gs", free)]
        return made

    @cached_property
    def program(self) -> Program:
        """The numbered expressions of all functions."""
        columns = [
            r for name in self.functions for r, _ in self.functions[name]
            if name.endswith("_theta") or name == "cross"
        ]  # fmt: skip
        real = {r for name in self.functions for r, _ in self.functions[name] if not name.endswith("_theta")}
        return Program(self.arguments, self.functions, [c for c in columns if c not in real or c == "guards"])

    #: functions that the loop over lanes calls; the others are called on one case at a time
    in_lanes = (
        "flow", "flow_theta", "look", "outputs", "outputs_theta", "watch", "watch_value",
        "balance", "balance_theta", "linear", "linear_theta",
    )  # fmt: skip

    def lanes(self) -> str:
        """Functions on many cases at once."""
        return "\n".join(self.program.function(n) for n in self.functions if n in self.in_lanes)

    def scalar(self) -> str:
        """All functions, and the choice of reset, on one case at a time."""
        resets = [k for k, (_, row) in enumerate(self.equations.rows) if row.reset]
        texts = [self.program.hoisting("hoist"), *(self.program.function(n) for n in self.functions)]
        cases = "".join(f"  case {k}: reset_{k}(at, after, rate); return;\n" for k in resets)
        texts.append(
            "static void reset_of(int row, const struct point *at, real *after, real *rate) {\n"
            f"  (void)at; (void)after; (void)rate;\n  switch (row) {{\n{cases}  }}\n}}\n"
        )
        if self.equations.nw:
            cases = "".join(f"  case {k}: reset_{k}_theta(at, afters); return;\n" for k in resets)
            texts.append(
                "static void reset_theta_of(int row, const struct point *at, column *afters) {\n"
                f"  (void)at; (void)afters;\n  switch (row) {{\n{cases}  }}\n}}\n"
            )
        return "\n".join(texts)

    def header(self) -> str:
        """Sizes and tables."""
        eq, dae = self.equations, self.equations.dae
        kept = self.program.sizes
        moved = ca.vertcat(dae.u, dae.z)  # algebraic variables move with the inputs
        watch_reads = self.watched and any(
            ca.which_depends(self.functions["watch_value"][0][1], moved, 1, True)
        )
        sizes = {
            "NX": eq.nx, "NZ": eq.nz, "NU": eq.nu, "NP": eq.np, "NQ": eq.nq, "NA": eq.na, "NY": dae.y.numel(),
            "NW": eq.nw, "ROWS": len(eq.rows), "BOUNDS": len(eq.bounds), "WATCHED": len(self.watched),
            "WATCH_READS_INPUT": int(bool(watch_reads)),
            "DIRECTIONS": len(self.directions), "DRIVEN": len(self.driven),
            "FIXED": kept["fixed"], "FIXED_COLUMNS": kept["fixed_columns"], "IMPLICIT": int(self.implicit),
        }  # fmt: skip
        lines = [f"#define {name} {size}" for name, size in sizes.items()]
        automata = dae.automata
        wide = [0 if not a.flags.size else a.flags.shape[1] for a in automata]
        flags = [float(v) for a in automata for v in np.asarray(a.flags, dtype=float).ravel()]
        at = np.cumsum([0, *(np.asarray(a.flags).size for a in automata)]).tolist()
        reads = ca.which_depends(self.guards, moved, 1, True) if len(eq.rows) or eq.bounds else []
        integers = {
            "start_mode": [a.mode_number(a.start) for a in automata],
            "flag_width": wide,
            "flag_begin": at[:-1],
            "row_automaton": [a for a, _ in eq.rows],
            "row_source": [automata[a].mode_number(r.source) for a, r in eq.rows],
            "row_target": [automata[a].mode_number(r.target) for a, r in eq.rows],
            "row_resets": [int(bool(r.reset)) for _, r in eq.rows],
            "guard_reads_input": [int(b) for b in reads],
            "bound_state": [k for k, _, _ in eq.bounds],
            "direction_column": self.directions,
        }
        if self.implicit:
            rows, columns = self.jacobian.sparsity().get_triplet()
            bends = self.bends if eq.nw else []
            lines += [f"#define ENTRIES {len(rows)}", f"#define BENT {len(bends)}"]
            integers |= {"entry_row": rows, "entry_column": columns}
            integers |= {"bent_row": [i for i, _, _ in bends], "bent_column": [j for _, j, _ in bends]}
        numbers = {
            "flag_values": flags,
            "bound_sign": [s for _, s, _ in eq.bounds],
            "bound_value": [b for _, _, b in eq.bounds],
            "direction_scale": [eq.columns[k].scale for k in self.directions],
            "theta_scale": [column.scale for column in eq.columns],
        }
        lines += [_table("int", n, [str(v) for v in values]) for n, values in integers.items()]
        lines += [_table("double", n, [literal(v) for v in values]) for n, values in numbers.items()]
        return "\n".join(lines) + "\n"


def _table(kind: str, name: str, values: Sequence[str]) -> str:
    return f"static const {kind} {name}[{max(len(values), 1)}] = {{{', '.join(values) or '0'}}};"
