"""The notebooks run from top to bottom, and are what jupytext takes them for."""

from __future__ import annotations

from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
QUICK = ("01_first_block", "02_build_a_facility", "03_ride_through", "04_fault_on_the_grid")
LONG = ("05_hosting_study",)


def execute(name: str, folder: Path) -> None:
    """Run a notebook in a fresh kernel; an error in a cell is an error here."""
    import jupytext
    import nbformat
    from nbclient import NotebookClient

    notebook = jupytext.read(NOTEBOOKS / f"{name}.py")
    assert any(cell.cell_type == "code" for cell in notebook.cells)
    nbformat.validate(notebook)
    NotebookClient(
        notebook, timeout=540, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()


def test_every_notebook_is_run_by_a_test() -> None:
    assert {p.stem for p in NOTEBOOKS.glob("*.py")} >= {*QUICK, *LONG}


# Both filters: warnings that the notebook machinery itself gives when it starts a kernel.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("name", QUICK)
def test_notebook_runs(name: str, tmp_path: Path) -> None:
    execute(name, tmp_path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("name", LONG)
def test_long_notebook_runs(name: str, tmp_path: Path) -> None:
    execute(name, tmp_path)
