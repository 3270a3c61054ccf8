"""Studies: a TOML file in, a folder of results out. The names are loaded when they are first used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dcvrt.studies.config import StudyFile
    from dcvrt.studies.store import Store
    from dcvrt.studies.study import Result, Study

_HOMES = {
    "Result": "dcvrt.studies.study",
    "Store": "dcvrt.studies.store",
    "Study": "dcvrt.studies.study",
    "StudyFile": "dcvrt.studies.config",
}

__all__ = ["Result", "Store", "Study", "StudyFile"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'dcvrt.studies' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
