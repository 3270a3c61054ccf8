"""The driver under the address and undefined-behaviour sanitizers, as a program of its own."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.functionals import (
    Functional,
    Integral,
    Maximum,
    Minimum,
    RecoveryTime,
    SustainedMinimum,
    TimeBelow,
)
from dcvrt.integrators import Kernel, Simulator, find_compiler
from dcvrt.integrators.kernel.build import UNITS, sources
from dcvrt.integrators.kernel.functionals import Table
from dcvrt.integrators.kernel.library import InputTable
from dcvrt.integrators.kernel.model import ModelText
from dcvrt.waveform import Waveform
from tests.integrators.systems import ball, crossed, decay, flat

SANITIZE = ("-std=gnu11", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-w")
COMPILER = shutil.which("gcc") or shutil.which("clang")

MAIN = """
#include "model.h"
#include "kernel.h"
#include <stdio.h>
#include <stdlib.h>
#include "data.h"

struct keep;
struct keep *keep_new(void);
void keep_free(struct keep *);
int keep_run(struct keep *, const struct task *, const struct options *, struct result *, struct record *);
void keep_states(struct keep *, long, const double *, const long *, double *, double *);
int keep_samples(struct keep *, const struct corners *, struct record *);
void results_free(struct result *, long);
void rests_of(long, const double *, const double *, const double *, double *, double *, int *);

int main(void)
{
    enum { CASES = 11 };
    struct inputs in = {PIECES, SECTIONS, start, table, section};
    double z[NZN + 1], x[N];
    if (REST) {
        int found;
        rests_of(1, p, u, tangent, x, z, &found);
        if (!found) return 3;
    } else {
        for (int i = 0; i < N; i++) x[i] = given[i];
        for (int i = 0; i < NZN; i++) z[i] = given_z[i];
    }
    struct task task = {p, x, z, &in}, tasks[CASES];
    struct options o = {1e-6, 1e-8, 1e-5, 0.1, 5e-3, 0.02, 1e-5, 100000, 1, 1, 0};
    struct result result, results[CASES];
    struct record r;
    struct keep *keep = keep_new();
    if (!keep_run(keep, &task, &o, &result, &r)) return 4;
    double t[2] = {r.step_t[3] + 0.3 * r.step_h[3], r.step_t[r.steps - 1]};
    double again[2 * N], again_z[2 * NZN + 1];
    long step[2] = {3, r.steps - 1};
    keep_states(keep, 2, t, step, again, again_z);
    double *y = malloc(sizeof(double) * r.samples * NY * (2 + 2 * NW));
    long m = r.samples * NY;
    if (!outputs_on(&task, r.phase, r.samples, r.sample_t, r.sample_x, r.sample_z, r.sample_piece,
                    r.sample_phase, y, y + m, y + 2 * m, y + 2 * m + m * NW))
        return 5;
    printf("%d %ld %ld %.17g\\n", result.status, result.events, r.samples, r.sample_x[(r.samples - 1) * N]);
    struct corners corners = {2e-5, 1.5, 8, 5};
    long before = r.samples;
    if (!keep_samples(keep, &corners, &r) || r.samples < before) return 7;
    if (NY && r.sample_y[(r.samples - 1) * NY] != y[(before - 1) * NY]) return 8;
    free(y);
    keep_free(keep);
    for (int k = 0; k < CASES; k++) tasks[k] = task;
    double value[CASES * WANTED + 1], time[CASES * WANTED + 1], gradient[CASES * WANTED * NW + 1];
    unsigned char place[CASES * WANTED + 1], tie[CASES * WANTED + 1];
    o.samples = 0;
    o.steps = o.nodes = WANTED > 0;
    for (int lanes = 0; lanes < 2; lanes++) {
        struct work w = {.task = tasks, .options = &o, .result = results, .functional = wanted,
                         .functionals = WANTED, .functional_results = {value, time, gradient, place, tie},
                         .cases = CASES};
        if (!(lanes ? run_many_lanes(&w) : run_one_lane(&w))) return 6;
        printf("%d %ld %.17g\\n", results[CASES - 1].status, results[CASES - 1].events, results[0].x[0]);
        results_free(results, CASES);
    }
    return 0;
}
"""


def c_array(kind: str, name: str, values: np.ndarray) -> str:
    flat = np.asarray(values).ravel().tolist() or [0]
    return f"static const {kind} {name}[] = {{{', '.join(map(repr, flat))}}};\n"


def c_row(row: tuple[float, ...]) -> str:
    return "{" + ", ".join(str(float(v)).replace("nan", "NAN") for v in row) + "}"


def program(simulator: Simulator, wave: Waveform, wanted: dict[str, Functional]) -> dict[str, str]:
    """Files of a program that runs one system alone, in lanes, with functionals."""
    tangents = any(n in wave.tangents for n in simulator.wrt)
    equations = simulator._kernel(tangents).equations
    functionals = Table.of(wanted) if wanted else None
    assert isinstance(simulator.solver, Kernel)
    method = str(simulator.solver.method)
    watched = functionals.signals if functionals else ()
    text = ModelText(equations, watched, implicit=method == "rosenbrock")
    channels, _ = simulator._table(simulator._kernel(tangents), wave)
    inputs = InputTable(equations, channels)
    rest = simulator.start == "equilibrium"
    p = simulator.dae.parameter_values()
    given, given_z = (np.zeros(1),) * 2 if rest else simulator._begin(equations, channels, p)
    tangent = (channels.first_tangent[list(equations.voltage or ())] * equations.scale).T
    rows = functionals.rows.tolist() if functionals else []
    data = (
        f"enum {{ PIECES = {len(channels.start)}, SECTIONS = {len(channels.sections)}, REST = {int(rest)}, "
        f"WANTED = {len(rows)} }};\n"
        + c_array("double", "p", p) + c_array("double", "u", channels.first)
        + c_array("double", "tangent", tangent)
        + c_array("double", "given", given) + c_array("double", "given_z", given_z)
        + c_array("double", "start", inputs.start) + c_array("double", "table", inputs.table)
        + c_array("long", "section", inputs.section)
        + f"static const struct functional wanted[] = {{{', '.join(map(c_row, rows)) or '{0}'}}};\n"
    )  # fmt: skip
    return {**sources(text, method), "main.c": MAIN, "data.h": data}


FACILITY: dict[str, Functional] = {
    "low": Minimum("w_dc"), "held": SustainedMinimum("v_it", 0.02), "energy": Integral("p_b", positive=True),
    "load": Maximum("i_g", per="i_max"), "below": TimeBelow("v_it", 0.95),
    "back": RecoveryTime("p_g", share=0.9),
}  # fmt: skip


@pytest.mark.skipif(COMPILER is None or find_compiler() is None, reason="no gcc or clang here")
@pytest.mark.parametrize(
    "case", ["facility", "facility with tangents", "facility, implicit", "ball", "algebraic", "exchanges"]
)
def test_the_driver_is_clean_under_sanitizers(case: str, tmp_path: Path) -> None:
    if case == "ball":
        files = program(Simulator(ball(), Kernel(), wrt=("g", "e", "h0"), start="given"), flat(2.0), {})
    elif case == "algebraic":
        sim = Simulator(decay(), Kernel(), wrt=("k", "z_low"), start="given")
        files = program(sim, flat(2.0), {"energy": Integral("z_out"), "least": Minimum("x_out")})
    elif case == "exchanges":
        sim = Simulator(crossed(), Kernel(), wrt=("t_s",), start="given")
        files = program(sim, flat(1.0), {"energy": Integral("a_out")})
    else:
        wave = Waveform.segments([(0.0, 1.0), (0.1, 0.4 - 0.1j), (0.25, 0.9, 1.0), (0.5, 1.0)], until=0.8)
        wrt: tuple[str, ...] = ()
        if "tangents" in case:
            wave, wrt = wave.resampled(0.01), ("beta", "H_75", "dc.T_hold")
            wave = Waveform(wave.t, wave.v, {"H_75": 0.1j + 0 * wave.v})
        solver = Kernel("rosenbrock" if "implicit" in case else "dp5")
        files = program(Simulator(facility.gfm().compile(), solver, wrt=wrt), wave, FACILITY)
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    units = [str(tmp_path / u) for u in (*UNITS, "main.c")]
    command = [str(COMPILER), *SANITIZE, *units, "-o", str(tmp_path / "program"), "-lm"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    if made.returncode != 0 and "cannot find" in made.stderr:
        pytest.skip("the sanitizers' libraries are not here")
    assert made.returncode == 0, made.stderr[-3000:]
    done = subprocess.run([str(tmp_path / "program")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-4000:]
    single, one, many = (line.split() for line in done.stdout.splitlines())
    assert single[0] == one[0] == many[0] == "0"
    assert single[1] == one[1] == many[1] != "0"
    assert float(many[2]) == pytest.approx(float(one[2]), rel=1e-6, abs=1e-9)
