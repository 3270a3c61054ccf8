"""Compiler chain: cache, missing compiler, failing compiler."""

from __future__ import annotations

import os
import shlex
import signal
import stat
import subprocess
import sys
import time
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from dcvrt.cache import cache_folder
from dcvrt.errors import InputError
from dcvrt.integrators import Casadi, NoCompilerWarning, Simulator, compiler, find_compiler
from tests.integrators.systems import ball, flat


def square() -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function("square", [x], [x * x])


@pytest.fixture
def _fresh_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DCVRT_CACHE_DIR", str(tmp_path / "cache"))


needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler here")


@needs_compiler
@pytest.mark.usefixtures("_fresh_cache")
def test_an_object_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    functions, told = compiler.compiled([square()])
    assert float(functions["square"](3.0)) == 9.0
    assert told.startswith("compiled by ")
    assert [p.suffix for p in cache_folder().iterdir()] == [".so"]  # no scratch folder is left
    monkeypatch.setattr(compiler.subprocess, "run", lambda *a, **k: pytest.fail("compiled twice"))
    functions, _ = compiler.compiled([square()])
    assert float(functions["square"](4.0)) == 16.0


@needs_compiler
@pytest.mark.usefixtures("_fresh_cache")
def test_processes_may_compile_the_same_object_at_once() -> None:
    code = (
        "import casadi as ca; from dcvrt.integrators.compiler import compiled; x = ca.SX.sym('x');"
        "print(float(compiled([ca.Function('square', [x], [x * x])])[0]['square'](5.0)))"
    )
    workers = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    assert [w.communicate()[0].strip() for w in workers] == ["25.0"] * 3
    assert [p.suffix for p in cache_folder().iterdir()] == [".so"]


@needs_compiler
@pytest.mark.usefixtures("_fresh_cache")
def test_a_killed_compile_leaves_nothing_that_is_taken_for_an_object(
    tmp_path: Path,
) -> None:
    found = find_compiler()
    assert found is not None
    real, slow, started = shlex.join(found.command), tmp_path / "slow-cc", tmp_path / "started"
    slow.write_text(
        f'#!/bin/sh\ncase "$1" in --version|-d*) exec {real} "$@";; esac\n'
        f'for last; do if [ "$before" = -o ]; then echo half > "$last"; fi; before=$last; done\n'
        f"echo $$ > {started}\nexec sleep 600\n"
    )
    slow.chmod(0o755)
    code = (
        "import casadi as ca; from dcvrt.integrators.compiler import compiled; x = ca.SX.sym('x');"
        "print(float(compiled([ca.Function('square', [x], [x * x])])[0]['square'](5.0)))"
    )
    worker = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "CC": str(slow)})
    while not (started.exists() and started.read_text().strip()):
        assert worker.poll() is None
        time.sleep(0.02)
    worker.kill()
    worker.wait()
    os.kill(int(started.read_text()), signal.SIGKILL)
    (left,) = cache_folder().iterdir()
    assert left.is_dir()
    assert (left / "model.so").read_text() == "half\n"
    functions, _ = compiler.compiled([square()])
    assert float(functions["square"](5.0)) == 25.0
    assert left.exists()  # it might still be at work
    os.utime(left, (0, 0))
    x = ca.SX.sym("x")
    functions, _ = compiler.compiled([ca.Function("cube", [x], [x**3])])
    assert float(functions["cube"](2.0)) == 8.0
    assert {p.suffix for p in cache_folder().iterdir()} == {".so"}


@pytest.mark.usefixtures("_fresh_cache")
def test_a_failing_compiler_keeps_its_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "badcc"
    script.write_text(
        "#!/bin/sh\n[ \"$1\" = --version ] && { echo badcc 1.0; exit 0; }\necho 'no space left' >&2\nexit 4\n"
    )
    script.chmod(script.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("CC", str(script))
    with pytest.raises(InputError) as error:
        compiler.compiled([square()])
    assert str(error.value) == (
        f"The C compiler failed ({script}, exit code 4):\nno space left\n"
        "Set CC to another compiler, or CC=none to interpret."
    )
    assert list(cache_folder().iterdir()) == []


def test_a_compiler_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "nocc-anywhere")
    with pytest.raises(InputError) as error:
        find_compiler()
    assert str(error.value) == (
        "CC = 'nocc-anywhere' is not a compiler that runs. Unset CC, or set CC=none to interpret."
    )


def test_a_cache_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DCVRT_CACHE_DIR", str(tmp_path / "file" / "cache"))
    if find_compiler() is None:
        pytest.skip("no C compiler here")
    with pytest.raises(InputError) as error:
        compiler.compiled([square()])
    assert str(error.value) == (
        f"The cache folder {tmp_path / 'file' / 'cache'} cannot be written: Not a directory. "
        "Set DCVRT_CACHE_DIR to one that can."
    )


def test_without_a_compiler_the_interpreter_is_announced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with_compiler = Simulator(ball(), Casadi("erk"), start="given")(flat(1.0))
    monkeypatch.setenv("CC", "none")
    compiler.say_interpreted.cache_clear()
    simulator = Simulator(ball(), start="given")
    with pytest.warns(NoCompilerWarning, match="No C compiler was found"):
        run = simulator(flat(1.0))
    assert simulator.backend == "casadi erk, CasADi interpreter (no C compiler found)"
    assert np.abs(run["height"] - with_compiler["height"]).max() < 1e-12
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulator(ball(), start="given")(flat(1.0))


def test_the_cache_folder_can_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DCVRT_CACHE_DIR", os.sep + "somewhere")
    assert cache_folder() == Path(os.sep + "somewhere")
    monkeypatch.delenv("DCVRT_CACHE_DIR")
    assert cache_folder().name == "dcvrt" or cache_folder().parent.name == "dcvrt"
