"""Compile generated C once and keep it: compiler chain, cache of objects, interpreter when there is no
compiler.

Objects live in the user's cache folder under the hash of C text, compiler, flags and processor. A file
appears there by one atomic rename, so that processes may build the same object at the same time and a killed
compile leaves nothing that could be taken for a result.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import casadi as ca

from dcvrt.cache import cache_folder
from dcvrt.errors import InputError

FLAGS = ("-O2", "-fno-math-errno", "-fPIC", "-shared")
LONG_FLAGS = ("-O1", *FLAGS[1:])
LONG_TEXT = 2_000_000
"""Beyond this many characters of C the optimiser costs more than the runs gain."""
ABANDONED = 3600.0
"""A compile that is older than this, s, was killed."""


class NoCompilerWarning(UserWarning):
    """There is no C compiler: CasADi interprets the model, several times slower, with the same numbers."""


@dataclass(frozen=True)
class Compiler:
    """Command that compiles C, and how it identifies itself."""

    command: tuple[str, ...]
    version: str

    def __str__(self) -> str:
        return self.version


def find_compiler() -> Compiler | None:
    """First of $CC, cc, gcc, clang, ziglang that answers; None when there is none.

    ``CC=none`` says that none is wanted.
    """
    return _find(os.environ.get("CC", ""), os.environ.get("PATH", ""))


@lru_cache(maxsize=8)
def _find(wanted: str, _path: str) -> Compiler | None:
    if wanted == "none":
        return None
    chain: list[tuple[str, ...]] = [tuple(wanted.split())] if wanted else [("cc",), ("gcc",), ("clang",)]
    if not wanted and importlib.util.find_spec("ziglang") is not None:
        chain.append((sys.executable, "-m", "ziglang", "cc"))
    for command in chain:
        if shutil.which(command[0]) is None:
            continue
        answer = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False)
        if answer.returncode == 0 and answer.stdout.strip():
            return Compiler(command, answer.stdout.splitlines()[0].strip())
    if wanted:
        raise InputError(
            f"CC = {wanted!r} is not a compiler that runs. Unset CC, or set CC=none to interpret."
        )
    return None


def compiled(
    functions: Sequence[ca.Function], derivatives: Sequence[int] = ()
) -> tuple[dict[str, ca.Function], str]:
    """Compile functions to one object and load them; without a compiler return them as they are.

    Parameters
    ----------
    functions : what to compile; names must differ.
    derivatives : numbers of directions of forward derivatives of `rhs` to compile too, for implicit
        integrators.

    Returns
    -------
    functions by name, and a description of the backend.

    Raises
    ------
    InputError
        the compiler fails; its own message is kept.
    """
    compiler = find_compiler()
    if compiler is None:
        say_interpreted()
        return {f.name(): f for f in functions}, "CasADi interpreter (no C compiler found)"
    names = [f.name() for f in functions]
    generator = ca.CodeGenerator("model.c", {"with_header": False, "casadi_int": "long long int"})
    for f in functions:
        generator.add(f)
        if f.name() == "rhs":
            for n in derivatives:
                generator.add(f.forward(n), True)
    path = build(generator.dump(), compiler)
    loaded = {name: ca.external(name, str(path)) for name in names}
    return loaded, f"compiled by {compiler}"


def native_flags(compiler: Compiler) -> tuple[str, ...]:
    """Flags that let the compiler use all instructions of this processor, if it knows how.

    ``DCVRT_MARCH=x86-64-v3`` (or any other value that the compiler's ``-march`` takes) chooses the
    instructions instead: ``x86-64-v3`` has four lanes with AVX2, ``x86-64`` two with SSE2.
    """
    wanted = os.environ.get("DCVRT_MARCH", "")
    return (f"-march={wanted}",) if wanted else _flags_of_this_processor(compiler)


@lru_cache(maxsize=8)
def _flags_of_this_processor(compiler: Compiler) -> tuple[str, ...]:
    for flag in ("-march=native", "-mcpu=native"):
        command = [*compiler.command, flag, "-E", "-x", "c", os.devnull]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return (flag,)
    return ()


@lru_cache(maxsize=1)
def processor() -> str:
    """What identifies the processor: an object made for one may use instructions that another lacks."""
    told = [platform.machine(), platform.processor()]
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0].splitlines()
        told += [line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))]
    except OSError:  # not Linux
        pass
    return "\n".join(told)


def build(
    text: str | Mapping[str, str],
    compiler: Compiler,
    flags: Sequence[str] | None = None,
    units: Sequence[str] = ("model.c",),
) -> Path:
    """Object of this C text, from the cache or compiled now.

    Parameters
    ----------
    text : the C text, or several files by name, of which `units` are compiled and the others included.
    flags : for the compiler; by the length of the text unless given.
    """
    files = {"model.c": text} if isinstance(text, str) else dict(text)
    if flags is None:
        flags = FLAGS if sum(map(len, files.values())) < LONG_TEXT else LONG_FLAGS
    named = [f"{name}\n{files[name]}" for name in sorted(files)]
    key = "\n".join((*named, *compiler.command, compiler.version, *flags, *units, processor()))
    folder = cache_folder()
    path = folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
    if path.is_file():
        return path
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _clear_abandoned(folder)
        place = tempfile.TemporaryDirectory(dir=folder, prefix="build-")
    except OSError as error:
        raise InputError(
            f"The cache folder {folder} cannot be written: {error.strerror}. "
            "Set DCVRT_CACHE_DIR to one that can."
        ) from None
    with place as scratch:
        for name, content in files.items():
            (Path(scratch) / name).write_text(content, encoding="utf-8")
        os.replace(_compile_and_link(compiler, flags, units, Path(scratch)), path)
    return path


def _compile_and_link(compiler: Compiler, flags: Sequence[str], units: Sequence[str], folder: Path) -> Path:
    """Shared object of the units in a folder, compiled at the same time.

    Raises
    ------
    InputError
        the compiler fails; its own message is kept.
    """

    def call(*arguments: str) -> None:
        command = [*compiler.command, *flags, *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise InputError(
                f"The C compiler failed ({' '.join(compiler.command)}, exit code {done.returncode}):\n"
                f"{done.stderr.strip()[-2000:]}\nSet CC to another compiler, or CC=none to interpret."
            )

    parts, made = [str(folder / unit) for unit in units], folder / "model.so"
    if len(units) > 1:
        with ThreadPoolExecutor(len(units)) as pool:
            list(pool.map(lambda source: call("-c", source, "-o", f"{source}.o"), parts))
        parts = [f"{source}.o" for source in parts]
    call(*parts, "-o", str(made), "-lm")
    return made


def _clear_abandoned(folder: Path) -> None:
    """Remove what compilers left behind that were killed: an object has its name only when it is whole."""
    for scratch in folder.glob("build-*"):
        with suppress(OSError):  # another process may have been faster
            if time.time() - scratch.stat().st_mtime > ABANDONED:
                shutil.rmtree(scratch)


@lru_cache(maxsize=1)
def say_interpreted() -> None:
    """Warn, once, that there is no compiler."""
    warnings.warn(
        "No C compiler was found: CasADi interprets the model, several times slower with the same numbers. "
        "Install gcc or clang, or pip install 'dcvrt[compiler]'.",
        NoCompilerWarning,
        stacklevel=4,
    )
