"""Imports point one way, and heavy packages stay where they are used."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "dcvrt"

# Who may import whom: module or package of dcvrt -> those it may name; the closure of the design's arrows.
BASE = {"cache", "delimited", "errors"}
MODELS = BASE | {"dae", "units", "models"}
INTEGRATORS = BASE | {"dae", "linear", "waveform", "trajectory", "integrators"}
FUNCTIONALS = {"curve", "functionals"}
CRITERIA = INTEGRATORS | FUNCTIONALS | {"criteria"}
GRID = MODELS | {"waveform", "grid", "integrators", "trajectory"}  # models: the blocks of machines
PLANNING = GRID | CRITERIA | MODELS | {"facility", "planning"}
ALLOWED = {
    "errors": BASE,
    "cache": BASE,
    "threads": {"threads"},
    "units": BASE,
    "dae": BASE | {"linear"},  # Dae.linearise, and the types of points
    "linear": BASE | {"dae"},
    "delimited": BASE,
    "samples": {"errors"},
    "waveform_tables": {"delimited", "errors", "samples"},
    "waveform": {"errors", "samples", "waveform_tables"},
    "scenarios": {"errors", "waveform"},
    "envelopes": {"errors", "waveform", "trajectory", "criteria", "envelopes"},
    "trajectory": BASE | {"dae", "waveform"},
    "models": MODELS,
    "facility": MODELS | {"facility"},
    "curve": {"errors", "trajectory"},
    "functionals": {"curve", "errors", "trajectory"},
    "criteria": BASE | FUNCTIONALS | {"trajectory", "dae", "waveform"},
    "integrators": CRITERIA,
    "fmi": {"errors", "units", "dae", "integrators", "fmi"},  # of the integrators the compiler chain only
    "grid": GRID | MODELS,  # machines are blocks
    "planning": PLANNING,
    "studies": PLANNING | {"studies", "scenarios", "envelopes", "threads"},
    "cli": PLANNING | {"fmi", "studies", "cli", "scenarios", "envelopes", "threads"},
    "__init__": PLANNING | {"studies", "units"},
}
# Heavy packages and the only places that may import them.
OWNERS = {
    "andes": {"grid/andes.py"},
    "highspy": {"planning/"},
    "matplotlib": {"studies/", "trajectory.py"},
    "distributed": {"studies/"},
    "dask": {"studies/"},
}


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Absolute dotted names that a file imports, at any depth."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    return names


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path: Path) -> None:
    home = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    named = {n.split(".")[1] for n in imported(path) if n.startswith("dcvrt.")}
    layers = {n for n in named if (PACKAGE / n).is_dir() or (PACKAGE / f"{n}.py").is_file()}
    assert layers <= ALLOWED[home], f"{path.name} imports {sorted(layers - ALLOWED[home])}"


@pytest.mark.parametrize("path", sources(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_heavy_packages_have_one_home(path: Path) -> None:
    where = path.relative_to(PACKAGE).as_posix()
    for package in {n.split(".")[0] for n in imported(path)} & set(OWNERS):
        assert any(where.startswith(home) for home in OWNERS[package]), f"{where} imports {package}"


def test_package_import_is_light() -> None:
    heavy = ("casadi", "andes", "highspy", "pandas", "matplotlib", "scipy")
    code = f"import sys, dcvrt; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
