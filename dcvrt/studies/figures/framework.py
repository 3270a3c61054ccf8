"""The chain of a study, drawn: from a hosting proposal to a replayed plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dcvrt.studies.style import GREY, INK, PAGE, PALETTE, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# (text, what passes on to the next box), in the order of the chain
STEPS = (
    ("Hosting proposal", "H at each site, MW", "samples, or candidates of the frontier"),
    ("Fault simulation", "network fault, operating hour", "the grid is rebuilt for every H and period"),
    ("POI waveform", "complex voltage over time", "one at each site"),
    ("Facility model", "GFL or GFM, rating β H", "loads, DC link, UPS, battery, supervisor"),
    ("Margins", "sustained voltage, load loss", "failed runs are labelled, never a pass"),
    ("Ride-through rows", "affine in H", "fits of samples, tightened, or exact cuts at candidates"),
    ("Hosting programme", "largest total H", "every hour of the year, every limit, every row"),
    ("Replay", "pass or fail", "the whole chain again, at the plan itself"),
)
_WIDTH, _HEIGHT = 1.50, 0.86
_X = (0.03, 1.88, 3.73, 5.58)
_Y = (1.52, 0.07)


def draw() -> Figure:
    """Two rows of boxes: simulate and measure above, fit, optimise and replay below."""
    figure = new_figure(PAGE, 2.45, arranged=False)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, PAGE), ylim=(0, 2.45))
    axes.axis("off")
    corners = [(x, _Y[0]) for x in _X] + [(x, _Y[1]) for x in reversed(_X)]
    colours = [PALETTE[2]] + [PALETTE[0]] * 4 + [PALETTE[4]] * 2 + [PALETTE[1]]
    for (title, passes, note), corner, colour in zip(STEPS, corners, colours, strict=True):
        _box(axes, corner, title, passes, note, colour)
    middle = _HEIGHT / 2
    for k in range(3):
        _arrow(axes, (_X[k] + _WIDTH, _Y[0] + middle), (_X[k + 1], _Y[0] + middle))
        _arrow(axes, (_X[3 - k], _Y[1] + middle), (_X[2 - k] + _WIDTH, _Y[1] + middle))
    _arrow(axes, (_X[3] + _WIDTH / 2, _Y[0]), (_X[3] + _WIDTH / 2, _Y[1] + _HEIGHT))
    _arrow(axes, (_X[0] + _WIDTH / 2, _Y[1] + _HEIGHT), (_X[0] + _WIDTH / 2, _Y[0]), dashed=True)
    axes.text(
        _X[0] + _WIDTH / 2 + 0.08,
        (_Y[0] + _Y[1] + _HEIGHT) / 2,
        "each plan goes\nthrough the chain again",
        fontsize=6.8,
        color=GREY,
        va="center",
    )
    axes.text(
        _X[3] + _WIDTH / 2 - 0.08,
        (_Y[0] + _Y[1] + _HEIGHT) / 2,
        "for each sample, period,\nfault, site, mode and β",
        fontsize=6.8,
        color=GREY,
        va="center",
        ha="right",
    )
    return figure


def _box(axes: Axes, corner: tuple[float, float], title: str, passes: str, note: str, colour: str) -> None:
    import textwrap

    from matplotlib.patches import FancyBboxPatch

    x, y = corner
    axes.add_patch(
        FancyBboxPatch(
            (x + 0.04, y + 0.04),
            _WIDTH - 0.08,
            _HEIGHT - 0.08,
            boxstyle="round,pad=0.04",
            facecolor="white",
            edgecolor=colour,
            linewidth=1.4,
        )
    )
    axes.text(
        x + _WIDTH / 2, y + _HEIGHT - 0.15, title, ha="center", va="center", fontsize=8.4, fontweight="bold"
    )
    axes.text(x + _WIDTH / 2, y + _HEIGHT - 0.34, passes, ha="center", va="center", fontsize=6.8)
    axes.text(
        x + _WIDTH / 2,
        y + 0.25,
        "\n".join(textwrap.wrap(note, 27, break_on_hyphens=False)),
        ha="center",
        va="center",
        fontsize=6.4,
        color=GREY,
        linespacing=1.15,
    )


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], dashed: bool = False) -> None:
    axes.annotate(
        "",
        end,
        start,
        arrowprops=dict(
            arrowstyle="-|>",
            color=GREY if dashed else INK,
            linewidth=1.0,
            shrinkA=1,
            shrinkB=1,
            linestyle=(0, (4, 2)) if dashed else "-",
            mutation_scale=9,
        ),
    )
