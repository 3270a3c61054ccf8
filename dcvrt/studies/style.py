"""One look for every figure: a journal's column widths, colours that colour-blind readers can tell apart.

Colours are those of Okabe and Ito. Nothing is told by colour alone: modes differ in marker, methods in line
and filling, sites in hatching, a failed replay in its cross.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMN = 3.5
"""Width of one column, inches."""

PAGE = 7.16
"""Width of two columns, inches."""

INK = "#222222"
GREY = "#767676"
PALE = "#d9d9d9"
FAILED = "#c1121f"

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a5195", "#8c6d31")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "h")
HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\", "----", "++++", "oooo")

MODE_BANDS = {"NORMAL": "#ffffff", "MIXED": "#fff1c2", "BATTERY": "#f6cfc4", "RETURN": "#d3e6f5"}
"""Shades of the supervisor's modes; other modes take the spare shades in turn."""

SPARE_BANDS = ("#e3e3e3", "#dcefdc", "#eadcf0", "#f0e6d6")

_RULES: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so that a figure is the same on every machine
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.9,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.5,
    "hatch.linewidth": 0.5,
    "text.color": INK,
    "mathtext.fontset": "dejavusans",
    "figure.dpi": 100,
    "savefig.dpi": 200,
    "svg.fonttype": "path",
    "svg.hashsalt": "dcvrt",
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw in the project's style, without a display; the caller's settings come back afterwards."""
    import matplotlib

    with matplotlib.rc_context(_RULES):
        yield


def new_figure(width: float = COLUMN, height: float = 2.6, arranged: bool = True) -> Figure:
    """Return an empty figure of a size in inches, in no window; `arranged` lays out its panels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained" if arranged else None)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as SVG and PNG, the same bytes for the same data; return both paths."""
    folder.mkdir(parents=True, exist_ok=True)
    svg, png = folder / f"{name}.svg", folder / f"{name}.png"
    figure.savefig(svg, metadata={"Date": None, "Creator": "dcvrt", "Format": None, "Type": None})
    figure.set_layout_engine("none")  # stays as it was laid out: that takes as long as drawing
    figure.savefig(png, metadata={"Software": "dcvrt"})
    return [svg, png]


def mode_band(mode: str, modes: Sequence[str]) -> str:
    """Shade of a supervisor mode."""
    spare = [m for m in modes if m not in MODE_BANDS]
    return MODE_BANDS.get(mode) or SPARE_BANDS[spare.index(mode) % len(SPARE_BANDS)]


def mode_colour(mode: str, modes: Sequence[str]) -> str:
    """Colour of a facility variant: the same in every figure of a study."""
    return PALETTE[list(modes).index(mode) % len(PALETTE)]


def mode_marker(mode: str, modes: Sequence[str]) -> str:
    """Marker of a facility variant."""
    return MARKERS[list(modes).index(mode) % len(MARKERS)]


def site_colour(site: int, sites: Sequence[int]) -> str:
    """Colour of a candidate bus: the same in every figure of a study."""
    return PALETTE[list(sites).index(site) % len(PALETTE)]


def site_marker(site: int, sites: Sequence[int]) -> str:
    """Marker of a candidate bus; where colours come round again, a marker beside another colour."""
    return MARKERS[_turned(site, sites, len(MARKERS))]


def site_hatch(site: int, sites: Sequence[int]) -> str:
    """Hatch of a candidate bus; where colours come round again, a hatch beside another colour."""
    return HATCHES[_turned(site, sites, len(HATCHES))]


def _turned(site: int, sites: Sequence[int], count: int) -> int:
    """Place among `count` shapes, one further after each round of the colours."""
    k = list(sites).index(site)
    return (k + k // len(PALETTE)) % count


def mode_name(mode: str) -> str:
    """What a reader calls a variant: the paper's abbreviations in capitals, other names as they are.

    >>> mode_name("gfl"), mode_name("line-interactive")
    ('GFL', 'line-interactive')
    """
    return mode.upper() if len(mode) <= 3 else mode


def panel(axes: Axes, letter: str, title: str) -> None:
    """Head a panel with its letter and what it shows."""
    axes.set_title(f"({letter}) {title}", fontweight="normal", fontsize=8.0)


def letters() -> Iterator[str]:
    """Letters of panels in order."""
    yield from "abcdefghijklmnopqrstuvwxyz"
