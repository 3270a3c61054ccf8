"""Writing an FMU: what is refused, and that nothing half-made is left; the sources under the sanitizers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dcvrt import facility
from dcvrt.cli import BAD_INPUT, main
from dcvrt.errors import InputError, ModelError
from dcvrt.fmi import export
from dcvrt.integrators.compiler import find_compiler
from dcvrt.models import Diagram
from tests.fmi.tools import Unit
from tests.integrators.systems import Sketch


def small() -> object:
    s = Sketch({"x": 0.0}, {"k": 1.0})
    return s.dae({"x": -s.p["k"] * s.x["x"]}, {"x_out": s.x["x"]})


def refused(path: Path, **options: object) -> str:
    with pytest.raises(InputError) as error:
        export(small(), path, **options)
    return str(error.value)


def test_a_name_without_the_ending_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "site.zip"
    assert refused(path) == f"{path}: the name of an FMU ends in .fmu. Way out: site.fmu."


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    assert refused(tmp_path / "no" / "a.fmu") == f"{tmp_path / 'no'}: no such folder. Way out: make it first."


def test_a_file_that_exists_is_kept_unless_asked(tmp_path: Path) -> None:
    path = tmp_path / "a.fmu"
    path.write_text("mine")
    assert refused(path) == (
        f"{path} exists already. Way out: another name, or overwrite it (--overwrite, overwrite=True); "
        "nothing was written."
    )
    assert path.read_text() == "mine"
    assert export(small(), path, overwrite=True) == path
    assert path.read_bytes()[:2] == b"PK"


def test_a_folder_of_that_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.fmu"
    path.mkdir()
    assert refused(path) == f"{path} is a folder. Way out: another name; nothing was written."


def test_without_a_compiler_it_says_how_to_get_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "none")
    assert refused(tmp_path / "a.fmu") == (
        "No C compiler was found, and an FMU holds a compiled library. Way out: install gcc or clang, or "
        "pip install 'dcvrt[compiler]', and unset CC if it is 'none'."
    )
    assert not list(tmp_path.iterdir())


def test_a_compiler_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "broken-cc"
    broken.write_text('#!/bin/sh\ntest "$1" = --version && echo broken 1 && exit\necho no luck >&2\nexit 3\n')
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    message = refused(tmp_path / "a.fmu")
    assert message == (
        f"The C compiler failed ({broken}, exit code 3):\nno luck\nWay out: set CC to another compiler."
    )
    assert [f.name for f in tmp_path.iterdir()] == ["broken-cc"]


def test_an_unknown_start_is_refused(tmp_path: Path) -> None:
    assert refused(tmp_path / "a.fmu", start="cold") == "start = 'cold' must be 'equilibrium' or 'given'."


def test_two_variables_of_one_name_are_refused(tmp_path: Path) -> None:
    s = Sketch({"x": 0.0}, {"k": 1.0})
    with pytest.raises(ModelError) as error:
        export(s.dae({"x": 0.0}, {"x": s.x["x"]}), tmp_path / "a.fmu")
    assert str(error.value) == (
        "sketch: an FMU needs a name of its own for each variable; two are called x. "
        "Way out: give the output (Diagram.output) another name."
    )


# -- command line -------------------------------------------------------------------------------------------


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return int(ended.value.code or 0)


def test_the_command_writes_a_variant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "out.fmu"
    assert run("facility", "export", "gfl", "--fmu", str(path)) == 0
    assert capsys.readouterr().out == (
        f"{path}: gfl as FMI 3.0 model exchange; documentation/index.html inside tells how to use it\n"
    )
    assert path.read_bytes()[:2] == b"PK"
    assert run("facility", "export", "gfl", "--fmu", str(path)) == BAD_INPUT
    assert "exists already" in capsys.readouterr().err


def test_the_command_knows_the_variants(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("facility", "export", "gfll", "--fmu", str(tmp_path / "out.fmu")) == BAD_INPUT
    message = capsys.readouterr().err
    assert message.startswith("there is no facility variant 'gfll'. Did you mean 'gfl'?")


# -- sources ------------------------------------------------------------------------------------------------

DRIVER = r"""
/* Rides a sag with Euler steps and event handling by signs; prints the final state of charge and mode. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "fmi3/fmi3Functions.h"
#include "model.h"

static void check(fmi3Status status) { if (status > fmi3Warning) { printf("status %d\n", status); exit(1); } }

static void settle(fmi3Instance fmu)
{
    fmi3Boolean again = true, end, nominals, states, timed;
    fmi3Float64 next;
    check(fmi3EnterEventMode(fmu));
    while (again) check(fmi3UpdateDiscreteStates(fmu, &again, &end, &nominals, &states, &timed, &next));
    check(fmi3EnterContinuousTimeMode(fmu));
}

int main(void)
{
    enum { NH = NROWS + NBOUNDS };
    const fmi3ValueReference volt = 1 + 2 * NX, mode = 1 + 2 * NX + NU + NP + NY + NZ + NH;
    fmi3Instance fmu = fmi3InstantiateModelExchange("unit", MODEL_TOKEN, "", false, false, NULL, NULL);
    check(fmi3EnterInitializationMode(fmu, false, 0.0, 0.0, false, 0.0));
    check(fmi3ExitInitializationMode(fmu));
    double x[NX], f[NX], h[NH], dt = 1e-4;
    fmi3Int64 modes[NA];
    int seen = 0;
    settle(fmu);
    check(fmi3GetContinuousStates(fmu, x, NX));
    for (int k = 0; k < 15000; ++k) {
        fmi3Boolean event, end;
        if (k == 1000 || k == 3000) {
            double v = k == 1000 ? 0.2 : 1.0;
            check(fmi3EnterEventMode(fmu));
            check(fmi3SetFloat64(fmu, &volt, 1, &v, 1));
            settle(fmu);
        }
        check(fmi3GetContinuousStateDerivatives(fmu, f, NX));
        check(fmi3GetEventIndicators(fmu, h, NH));
        for (int i = 0; i < NX; ++i) x[i] += dt * f[i];
        check(fmi3SetTime(fmu, (k + 1) * dt));
        check(fmi3SetContinuousStates(fmu, x, NX));
        check(fmi3CompletedIntegratorStep(fmu, true, &event, &end));
        if (event) settle(fmu);
        check(fmi3GetInt64(fmu, &mode, 1, modes, NA));
        seen |= 1 << modes[0];
        fmi3ValueReference knowns[] = {1}, unknowns[] = {1 + NX};
        double seed = 1.0, slope;
        if (k % 1000 == 0)
            check(fmi3GetDirectionalDerivative(fmu, unknowns, 1, knowns, 1, &seed, 1, &slope, 1));
    }
    fmi3FMUState state = NULL;
    check(fmi3GetFMUState(fmu, &state));
    check(fmi3FreeFMUState(fmu, &state));
    check(fmi3Terminate(fmu));
    check(fmi3Reset(fmu));
    fmi3FreeInstance(fmu);
    printf("modes seen %d, last %d\n", seen, (int)modes[0]);
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the sanitizers are looked for where CI runs")
def test_the_sources_are_clean_under_the_sanitizers(tmp_path: Path) -> None:
    compiler = find_compiler()
    assert compiler is not None
    flags = ["-std=c99", "-O1", "-g", "-Wall", "-Wextra", "-Wno-unused", "-Wno-unused-parameter", "-I."]
    flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    command = [*compiler.command, "-fsanitize=address,undefined", str(probe), "-o", str(tmp_path / "probe")]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("this compiler has no sanitizers")
    sources = Unit.of(facility.gfl().compile(), tmp_path).folder / "sources"
    (sources / "driver.c").write_text(DRIVER)
    files = sorted(f.name for f in sources.glob("*.c"))
    built = subprocess.run(
        [*compiler.command, *flags, *files, "-o", "driver", "-lm"],
        cwd=sources,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    assert "warning" not in built.stderr
    done = subprocess.run(["./driver"], cwd=sources, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("modes seen 15, last 0\n", "")


def test_a_diagram_that_is_no_facility_can_be_exported(tmp_path: Path) -> None:
    d = Diagram("two wires")
    d.output("angle", d.input("u", "rad"))
    unit = Unit.of(d.compile(), tmp_path)  # no states, no parameters, no automata
    assert unit.description.modelExchange.modelIdentifier == "two_wires"
    with unit.instance() as fmu:
        fmu.setFloat64(unit.references("u"), [0.7])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        assert fmu.getFloat64(unit.references("angle")) == [0.7]
