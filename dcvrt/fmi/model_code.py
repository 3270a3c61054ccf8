"""From a :class:`~dcvrt.dae.Dae` to the C text that the files in `sources` work on: functions and tables."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import casadi as ca
import numpy as np

from dcvrt.fmi.variables import Layout, nominals

TOKEN = "@TOKEN@"
"""Stands for the instantiation token until the text, and with it the token, is complete."""
ARGUMENTS = "const double **argument, double **result, int *iw, double *w, int memory"

HEADER = """\
/* Sizes of {name}, and what its model.c holds. Written by dcvrt. */

#ifndef MODEL_H
#define MODEL_H

#include <stdbool.h>

#define MODEL_NAME {quoted}
#define MODEL_TOKEN "{token}"

enum {{
{sizes}
    START_AT_EQUILIBRIUM = {at_rest}
}};

/* Functions of (t, x, z, u, p, q, c) and, for slopes, a direction (t, x, z, u, p); see hybrid.h. */
typedef int model_function({arguments});

model_function model_evaluate;    /* f, g, y, h */
model_function model_slope;       /* f, g, y, h along a direction */
model_function model_algebra;     /* g, g_z */
model_function model_rest;        /* (f, g) and its Jacobian by (x, z) */
model_function model_start;       /* (u, p) -> first guess of (x, z) */
model_function model_start_slope; /* (u, p, du, dp) -> the same along a direction */
model_function model_held;        /* (p) -> dwell time of every row */
model_function model_together;    /* (p) -> what is tied to them, then width and limits of every gap */

struct input {{ const char *name; double value; }};
struct parameter {{ const char *name, *unit; double value, low, high; }};
struct automaton {{ int start, n_flags; const double *flags; /* mode after mode */ }};
struct row {{ int automaton, source, target; model_function *resets; const char *text; }};
struct bound {{ const char *what, *where; }};
struct tied {{ const char *what, *unit; double low, high; }};
struct gap {{ const char *rows; int n_limits; const char *const *limits; }};

extern const struct input model_inputs[];
extern const struct parameter model_parameters[];
extern const struct automaton model_automata[];
extern const struct row model_rows[];
extern const struct bound model_bounds[];
extern const struct tied model_tied[];
extern const struct gap model_gaps[];
extern const bool model_reads_input[]; /* per event indicator */
extern const double model_nominals[];
extern const char *const model_states[];
extern const char *const model_residuals[];
extern const char *const model_algebraics; /* all names in one line */

#endif
"""


def header(layout: Layout, at_rest: bool) -> str:
    """Text of `model.h`."""
    dae = layout.dae
    sizes = {
        "NX": len(dae.states),
        "NZ": len(dae.algebraics),
        "NU": len(dae.inputs),
        "NP": len(dae.parameter_rows),
        "NY": len(dae.outputs),
        "NQ": dae.q.numel(),
        "NA": len(dae.automata),
        "NROWS": len(layout.rows),
        "NBOUNDS": len(layout.bounds),
        "NTIED": len(dae.tied),
        "NGAPS": len(layout.gaps),
        "NTOGETHER": layout.together.numel(),
    }
    return HEADER.format(
        name=comment(dae.name),
        quoted=quoted(dae.name),
        token=TOKEN,
        sizes="\n".join(f"    {name} = {size}," for name, size in sizes.items()),
        at_rest=int(at_rest),
        arguments=ARGUMENTS,
    )


def source(layout: Layout) -> str:
    """Text of `model.c`."""
    generator = ca.CodeGenerator("model.c", {"with_header": False, "with_export": False, "casadi_int": "int"})
    made = functions(layout)
    for function in made:
        generator.add(function)
    resets = "".join(f"model_function {f.name()};\n" for f in made if f.name().startswith("model_reset_"))
    return "\n".join(
        (
            f"/* Equations and tables of {comment(layout.dae.name)}. Written by dcvrt; the functions by",
            "   the code generator of CasADi. */",
            "",
            '#include "model.h"',
            "",
            "#define CASADI_SYMBOL_EXPORT /* seen by the other files only, not outside the library */",
            "",
            generator.dump().strip(),
            "",
            resets + tables(layout),
        )
    )


def functions(layout: Layout) -> list[ca.Function]:
    """The functions of `model.h`, with dense arguments and results."""
    dae, f, g = layout.dae, layout.f, layout.g
    base = [dae.t, dae.x, dae.z, dae.u, dae.p, dae.q, dae.clocks]
    results = [f, g, layout.y, layout.h]
    w = ca.vertcat(dae.x, dae.z)
    both = ca.vertcat(f, g)

    seeds = [ca.SX.sym(f"d{k}", e.numel()) for k, e in enumerate((dae.t, dae.x, dae.z, dae.u, dae.p))]
    moving = ca.vertcat(dae.t, dae.x, dae.z, dae.u, dae.p, dae.clocks)
    moved = ca.vertcat(*seeds, ca.SX.ones(dae.clocks.numel(), 1) * seeds[0])  # clocks run with time
    slopes = split(ca.cse(ca.jtimes(ca.vertcat(*results), moving, moved)), results)

    start = dae.start if dae.start.numel() else ca.SX([row.value for row in (*dae.states, *dae.algebraics)])
    start = ca.SX(start) if w.numel() else ca.SX(0, 1)
    start_slope = ca.jtimes(start, ca.vertcat(dae.u, dae.p), ca.vertcat(seeds[3], seeds[4]))

    held = ca.vertcat(ca.SX(0, 1), *[ca.SX(row.held) for _, row in layout.rows])
    made = [
        dense("model_evaluate", base, split(ca.cse(ca.vertcat(*results)), results)),
        dense("model_slope", base + seeds, slopes),
        dense("model_algebra", base, [g, ca.jacobian(g, dae.z)]),
        dense("model_rest", base, [both, ca.jacobian(both, w)]),
        dense("model_start", [dae.u, dae.p], [start]),
        dense("model_start_slope", [dae.u, dae.p, seeds[3], seeds[4]], [start_slope]),
        dense("model_held", [dae.p], [held]),
        dense("model_together", [dae.p], [layout.together]),
    ]
    for k, (_, row) in enumerate(layout.rows):
        if row.reset:
            after = ca.SX(dae.x)
            for state, expression in row.reset.items():
                after[state] = expression
            made.append(dense(f"model_reset_{k}", base, [after]))
    return made


def dense(name: str, arguments: Sequence[ca.SX], results: Sequence[ca.SX]) -> ca.Function:
    """A function whose results are full columns and matrices, as C reads them."""
    return ca.Function(name, list(arguments), [ca.densify(r) for r in results])


def split(stacked: ca.SX, like: Sequence[ca.SX]) -> list[ca.SX]:
    """Cut a column into pieces of the lengths of others."""
    ends = np.cumsum([e.numel() for e in like])
    return [stacked[int(end) - e.numel() : int(end)] for e, end in zip(like, ends, strict=True)]


def tables(layout: Layout) -> str:
    """The constant tables of `model.h`."""
    dae = layout.dae
    text, automata, rows, bounds, gaps = [], [], [], [], []
    for k, a in enumerate(dae.automata):
        values = ", ".join(number(v) for v in np.asarray(a.flags, dtype=float).ravel())
        text.append(f"static const double flags_{k}[] = {{{values or '0.0'}}};")
        automata.append(entry(a.mode_number(a.start), len(a.flag_names), f"flags_{k}"))
    for k, (owner, row) in enumerate(layout.rows):
        automaton = dae.automata[owner]
        ends = automaton.mode_number(row.source), automaton.mode_number(row.target)
        reset = f"model_reset_{k}" if row.reset else "0"
        rows.append(entry(owner, *ends, reset, quoted(f"{automaton.path}: {row.text}")))
    for b in layout.bounds:
        state = dae.states[b.state]
        what = state.crossing or f"{state.path} left its range"
        where = f"{state.path} {'above' if b.sign > 0 else 'below'} {b.limit:g} {state.unit}"
        bounds.append(entry(quoted(what), quoted(where)))
    for k, (path, gap) in enumerate(layout.gaps):
        text.append(table(f"char *const limits_{k}[]", (quoted(name) for name, _ in gap.limits), "static "))
        pair = f"{path}: '{gap.rows[0]}' and '{gap.rows[1]}'"
        gaps.append(entry(quoted(pair), len(gap.limits), f"limits_{k}"))
    parameters = (
        entry(quoted(r.path), quoted(r.unit), *map(number, (r.value, *r.bounds))) for r in dae.parameter_rows
    )
    tied = (entry(quoted(t.what), quoted(t.unit), *map(number, t.bounds)) for t in dae.tied)
    residuals = [f"d({r.path})/dt" for r in dae.states] + [f"residual of {r.path}" for r in dae.algebraics]
    algebraics = ", ".join(r.path for r in dae.algebraics)
    inputs = (entry(quoted(r.path), number(r.value)) for r in dae.inputs)
    text += [
        table("struct input model_inputs[]", inputs),
        table("struct parameter model_parameters[]", parameters),
        table("struct automaton model_automata[]", automata),
        table("struct row model_rows[]", rows),
        table("struct bound model_bounds[]", bounds),
        table("struct tied model_tied[]", tied),
        table("struct gap model_gaps[]", gaps),
        table("bool model_reads_input[]", (str(flag).lower() for flag in layout.reads_input())),
        table("double model_nominals[]", map(number, nominals(dae))),
        table("char *const model_states[]", (quoted(r.path) for r in dae.states)),
        table("char *const model_residuals[]", map(quoted, residuals)),
        f"const char *const model_algebraics = {quoted(algebraics)};",
    ]
    return "\n".join(text) + "\n"


def entry(*cells: object) -> str:
    """One element of a table."""
    return "{" + ", ".join(map(str, cells)) + "}"


def table(declared: str, items: Iterable[str], linkage: str = "") -> str:
    """A constant array; one zero where it would be empty, since C has no empty arrays."""
    lines = ",\n    ".join(items)
    return f"{linkage}const {declared} = {{\n    {lines or '0'}\n}};"


def number(value: float) -> str:
    """A number as C writes it, to the last bit.

    >>> number(0.1), number(float("inf"))
    ('0.1', 'INFINITY')
    """
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def comment(text: str) -> str:
    """A name as a comment of C may hold it."""
    return text.replace("*/", "").replace("/*", "")


def quoted(text: str) -> str:
    r"""A C string.

    >>> quoted('a "b"')
    '"a \\"b\\""'
    """
    return json.dumps(" ".join(text.split()), ensure_ascii=False).replace("??", "?\\?")
