"""dcvrt: how much data-centre load a grid can host when every site must ride through the grid's faults.

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dcvrt import facility
    from dcvrt.criteria import Criteria, margins
    from dcvrt.integrators import Simulator
    from dcvrt.models import Block, Diagram, Phasor
    from dcvrt.trajectory import Trajectory
    from dcvrt.waveform import Waveform

__version__ = "0.1.0"

_HOMES = {
    "Block": "dcvrt.models",
    "Diagram": "dcvrt.models",
    "Phasor": "dcvrt.models",
    "Criteria": "dcvrt.criteria",
    "margins": "dcvrt.criteria",
    "Simulator": "dcvrt.integrators",
    "Trajectory": "dcvrt.trajectory",
    "Waveform": "dcvrt.waveform",
}

__all__ = [
    "Block",
    "Criteria",
    "Diagram",
    "Phasor",
    "Simulator",
    "Trajectory",
    "Waveform",
    "__version__",
    "facility",
    "margins",
]


def __getattr__(name: str) -> Any:
    if name == "facility":
        return import_module("dcvrt.facility")
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'dcvrt' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
