"""The scripts of the README run as they are written, and its files and commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
SCRIPTS = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)


@pytest.mark.parametrize("script", SCRIPTS, ids=[s.splitlines()[-1].split("#")[0].strip() for s in SCRIPTS])
def test_script_runs_as_written(script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "README.md", "exec"), {"__name__": "__main__"})


def test_there_are_five_scripts() -> None:
    assert len(SCRIPTS) == 5


def test_files_that_it_points_to_exist() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", TEXT):
        assert (ROOT / target).is_file(), target


def test_commands_of_the_table_exist() -> None:
    import typer

    from dcvrt.cli import app

    known = typer.main.get_command(app)
    for words in re.findall(r"`dcvrt ([a-z]+(?: [a-z]+)?)", TEXT):
        command = known
        for word in words.split():
            commands = getattr(command, "commands", None)
            if commands is None:
                break
            assert word in commands, f"dcvrt {words}"
            command = commands[word]


def test_licence_is_the_one_of_the_package() -> None:
    assert 'license = "GPL-3.0-or-later"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert "GPL-3.0-or-later" in TEXT
