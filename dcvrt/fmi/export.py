"""Write a compiled system as an FMU: description, sources, library and documentation in one archive."""

from __future__ import annotations

import hashlib
import io
import os
import tempfile
import zipfile
from importlib.resources import files
from pathlib import Path

from dcvrt.dae import Dae
from dcvrt.errors import InputError
from dcvrt.fmi import model_code
from dcvrt.fmi.binary import compile_library, platform_of, required_compiler
from dcvrt.fmi.description import build_description, model_description
from dcvrt.fmi.documentation import licence_text, page
from dcvrt.fmi.variables import Layout, identifier

SHIPPED = (
    "equations.c",
    "equilibrium.c",
    "fmi3.c",
    "fmi3_extra.c",
    "fmi3_unused.c",
    "hybrid.h",
    "instance.c",
    "instance.h",
    "jumps.c",
    "linear.c",
    "linear.h",
    "fmi3/fmi3FunctionTypes.h",
    "fmi3/fmi3Functions.h",
    "fmi3/fmi3PlatformTypes.h",
)
"""C files that every FMU holds, beside its own `model.c` and `model.h`."""
EARLIEST = (1980, 1, 1, 0, 0, 0)
"""Time of every file in the archive: the same model makes the same bytes."""


def export(
    dae: Dae,
    path: str | Path,
    *,
    start: str = "equilibrium",
    overwrite: bool = False,
    doc: str = "",
    sheet: str = "",
) -> Path:
    """Write a system as an FMI 3.0 model-exchange FMU.

    The FMU starts at its equilibrium for the inputs and parameters that it is initialised with. Its modes
    change as in a :class:`~dcvrt.integrators.Simulator`; a state that leaves its bounds ends the simulation
    with the reason in the log. It holds the library of this machine's platform, and the C sources for all
    others.

    Parameters
    ----------
    dae : the system, from ``Diagram.compile()``.
    path : file to write, ``*.fmu``.
    start : ``"equilibrium"``, or ``"given"``: the start values of the system as they are, for systems that
        have no rest.
    overwrite : replace a file of this name.
    doc : one line on what the system is.
    sheet : Markdown with its equations (``Diagram.sheet()``), for the documentation inside.

    Returns
    -------
    The path.

    Raises
    ------
    InputError
        a name that does not end in .fmu, a file that exists, a folder that does not, no C compiler, or one
        that fails.
    ModelError
        two variables of the system have the same name.
    """
    if start not in ("equilibrium", "given"):
        raise InputError(f"start = {start!r} must be 'equilibrium' or 'given'.")
    path = usable(Path(path), overwrite)
    compiler = required_compiler()
    layout = Layout(dae)
    layout.check_names()
    platform, suffix = platform_of()
    name = identifier(dae.name)

    sources = {file: (files("dcvrt.fmi") / "sources" / file).read_text("utf-8") for file in SHIPPED}
    sources["model.h"] = model_code.header(layout, start == "equilibrium")
    sources["model.c"] = model_code.source(layout)
    description = model_description(layout, doc)

    token = hashlib.sha256("\0".join((description, *sources.values())).encode()).hexdigest()
    description, sources["model.h"] = (
        text.replace(model_code.TOKEN, token) for text in (description, sources["model.h"])
    )
    library = compile_library(sources, compiler, suffix)
    c_files = sorted(file for file in sources if file.endswith(".c"))
    contents: dict[str, str | bytes] = {
        "modelDescription.xml": description,
        f"binaries/{platform}/{name}{suffix}": library,
        "documentation/index.html": page(layout, doc, sheet),
        "documentation/licenses/license.txt": licence_text(),
        "sources/buildDescription.xml": build_description(dae.name, c_files),
        **{f"sources/{file}": text for file, text in sources.items()},
    }
    write(path, archive(contents))
    return path


def usable(path: Path, overwrite: bool = False) -> Path:
    """The path, if an FMU can be written there.

    Raises
    ------
    InputError
        it cannot, and why.
    """
    if path.suffix.lower() != ".fmu":
        proposed = path.with_suffix(".fmu").name
        raise InputError(f"{path}: the name of an FMU ends in .fmu. Way out: {proposed}.")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder. Way out: make it first.")
    if path.is_dir():
        raise InputError(f"{path} is a folder. Way out: another name; nothing was written.")
    if path.exists() and not overwrite:
        raise InputError(
            f"{path} exists already. Way out: another name, or overwrite it (--overwrite, overwrite=True); "
            "nothing was written."
        )
    return path


def archive(contents: dict[str, str | bytes]) -> bytes:
    """A zip archive whose bytes depend on the contents only."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name, content in sorted(contents.items()):
            entry = zipfile.ZipInfo(name, EARLIEST)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3  # Unix: permissions below
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            zipped.writestr(entry, content)
    return buffer.getvalue()


def write(path: Path, content: bytes) -> None:
    """Write a file by one atomic rename: a killed export leaves nothing that could be taken for an FMU."""
    try:
        handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}. Way out: another folder.") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.chmod(scratch, 0o644)  # mkstemp makes it private
        os.replace(scratch, path)
    except BaseException:
        Path(scratch).unlink(missing_ok=True)
        raise
