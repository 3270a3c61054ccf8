"""The network with its sites, wind and faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dcvrt.studies.figures.layout import Floats, positions
from dcvrt.studies.style import FAILED, INK, PAGE, PALETTE, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dcvrt.grid.network import Network


def draw(
    network: Network,
    sites: Sequence[int],
    wind: Sequence[int],
    faults: Sequence[int],
    capacity_mw: Mapping[int, float] | None = None,
) -> Figure:
    """Branches as lines, buses as dots; sites, wind and faults by symbol; the area of a site is its capacity.

    Parameters
    ----------
    network : the network.
    sites, wind, faults : bus numbers.
    capacity_mw : capacity by site; all sites are drawn alike without it.
    """
    place = positions(network)
    at = {int(bus): place[k] for k, bus in enumerate(network.bus)}
    span = np.ptp(place, axis=0)
    figure = new_figure(
        PAGE, float(np.clip(0.55 + (PAGE - 0.2) * (span[1] + 1.0) / (span[0] + 1.0), 3.0, 6.5))
    )
    axes = figure.add_subplot()
    axes.axis("off")
    axes.set_aspect("equal")
    axes.margins(0.02)
    transformer = network.branches.tap != 1.0
    for chosen, style in ((~transformer, "-"), (transformer, (0, (2, 1.2)))):
        for a, b in zip(network.branches.from_bus[chosen], network.branches.to_bus[chosen], strict=True):
            axes.plot(
                *np.array([at[int(a)], at[int(b)]]).T,
                color="#a8a8a8",
                linewidth=0.8,
                linestyle=style,
                zorder=1,
            )
    units = {int(b) for b in network.generators.bus}
    marked = {*sites, *wind, *faults}
    plain = [bus for bus in at if bus not in marked]
    for buses, face in (
        ([b for b in plain if b in units], INK),
        ([b for b in plain if b not in units], "white"),
    ):
        x, y = np.array([at[b] for b in buses]).reshape(-1, 2).T
        axes.scatter(x, y, s=9, facecolor=face, edgecolor=INK, linewidth=0.6, zorder=2)
    ends = [
        (at[int(a)], at[int(b)])
        for a, b in zip(network.branches.from_bus, network.branches.to_bus, strict=True)
    ]
    free = _free_directions(place, ends)
    towards = {int(bus): free[k] for k, bus in enumerate(network.bus)}
    for bus in plain:
        axes.annotate(
            str(bus),
            (at[bus][0], at[bus][1]),
            np.array([3.2 + 1.3 * len(str(bus)), 5.2]) * towards[bus],
            textcoords="offset points",
            fontsize=4.8,
            color="#555555",
            zorder=3,
            ha="center",
            va="center",
        )
    # A bus may have wind and a fault: the triangle is then drawn larger, and the cross on it.
    both = set(wind) & set(faults)
    for bus in both:
        x, y = at[bus]
        axes.scatter(x, y, s=300, marker="^", facecolor=PALETTE[2], edgecolor="white", zorder=4.5)
    _symbols(axes, at, towards, [bus for bus in wind if bus not in both], "^", PALETTE[2], 62, "white")
    for bus in faults:
        _symbols(axes, at, towards, [bus], "X", FAILED, 58, "white", 300 if bus in both else 58)
    area = {site: 70.0 if capacity_mw is None else 30.0 + 1.0 * capacity_mw.get(site, 0.0) for site in sites}
    for site in sites:
        _symbols(axes, at, towards, [site], "s", PALETTE[0], area[site], "white")
    figure.legend(
        handles=_handles(bool(transformer.any())),
        loc="outside lower center",
        ncols=6,
        handletextpad=0.4,
        columnspacing=1.3,
    )
    return figure


def _free_directions(place: Floats, ends: list[tuple[Floats, Floats]]) -> Floats:
    """Unit vector from each bus towards where a number stands farthest from other buses and branches."""
    share = np.linspace(0.0, 1.0, 15)[:, None]
    taken = np.concatenate([place, *[a + share * (b - a) for a, b in ends]])
    turn = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
    ways = np.column_stack([np.cos(turn), np.sin(turn)])
    spots = place[:, None, :] + 0.28 * np.array([1.25, 1.0]) * ways
    room = np.linalg.norm(spots[:, :, None, :] - taken, axis=3).min(axis=2)
    return np.asarray(ways[np.argmax(room, axis=1)])


def _symbols(
    axes: Axes,
    at: Mapping[int, Floats],
    towards: Mapping[int, Floats],
    buses: Sequence[int],
    marker: str,
    colour: str,
    area: float,
    edge: str,
    reach: float | None = None,
) -> None:
    """Mark buses; their numbers stand clear of a symbol of the area `reach`, by default of their own."""
    for bus in buses:
        x, y = at[bus]
        axes.scatter(x, y, s=area, marker=marker, facecolor=colour, edgecolor=edge, linewidth=0.7, zorder=5)
        axes.annotate(
            str(bus),
            (x, y),
            (0.55 * (reach or area) ** 0.5 + np.array([3.0 + 2.2 * len(str(bus)), 5.0])) * towards[bus],
            textcoords="offset points",
            fontsize=7.5,
            ha="center",
            va="center",
            fontweight="bold",
            color=colour,
            zorder=4,
            bbox=dict(boxstyle="round,pad=0.1", facecolor="white", edgecolor="none", alpha=0.75),
        )


def _handles(transformers: bool) -> list[object]:
    from matplotlib.lines import Line2D

    def point(marker: str, colour: str, label: str, size: float = 6.5, edge: str = "white") -> Line2D:
        return Line2D(
            [],
            [],
            linestyle="none",
            marker=marker,
            markerfacecolor=colour,
            markeredgecolor=edge,
            markersize=size,
            markeredgewidth=0.6,
            label=label,
        )

    shown: list[object] = [
        point("s", PALETTE[0], "candidate site"),
        point("X", FAILED, "fault"),
        point("^", PALETTE[2], "wind"),
        point("o", INK, "generator bus", 3.5, INK),
        point("o", "white", "other bus", 3.5, INK),
    ]
    if transformers:
        shown.append(
            Line2D([], [], color="#a8a8a8", linestyle=(0, (2, 1.2)), linewidth=1.0, label="transformer")
        )
    return shown
