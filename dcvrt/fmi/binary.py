"""Compile the sources of an FMU to the library of this machine's platform."""

from __future__ import annotations

import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from dcvrt.errors import InputError
from dcvrt.integrators.compiler import Compiler, find_compiler

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-I.")
SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}
PROCESSORS = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}


def platform_of(system: str = sys.platform, machine: str = "") -> tuple[str, str]:
    """Folder among `binaries` and suffix of a library.

    >>> platform_of("linux", "x86_64"), platform_of("win32", "AMD64")
    (('x86_64-linux', '.so'), ('x86_64-windows', '.dll'))
    """
    name, suffix = SYSTEMS.get(system, (system, ".so"))
    machine = (machine or platform.machine()).lower()
    return f"{PROCESSORS.get(machine, machine)}-{name}", suffix


def required_compiler() -> Compiler:
    """The C compiler of the chain.

    Raises
    ------
    InputError
        there is none.
    """
    compiler = find_compiler()
    if compiler is None:
        raise InputError(
            "No C compiler was found, and an FMU holds a compiled library. Way out: install gcc or clang, or "
            "pip install 'dcvrt[compiler]', and unset CC if it is 'none'."
        )
    return compiler


def compile_library(sources: Mapping[str, str], compiler: Compiler, suffix: str) -> bytes:
    """Contents of the library made of C files and headers, by their paths.

    The compiler runs inside a folder of its own and sees relative paths only, so that nothing of this machine
    stands in the result.

    Raises
    ------
    InputError
        the compiler fails; its own message is kept.
    """
    with tempfile.TemporaryDirectory(prefix="dcvrt-fmu-") as scratch:
        for path, text in sources.items():
            target = Path(scratch, path)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
        made = f"model{suffix}"
        files = sorted(path for path in sources if path.endswith(".c"))
        done = subprocess.run(
            [*compiler.command, *FLAGS, *files, "-o", made, "-lm"],
            cwd=scratch,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            raise InputError(
                f"The C compiler failed ({' '.join(compiler.command)}, exit code {done.returncode}):\n"
                f"{done.stderr.strip()[-2000:]}\nWay out: set CC to another compiler."
            )
        return Path(scratch, made).read_bytes()
