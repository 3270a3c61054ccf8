"""The supervisor as a diagram, drawn from the transition table that the integrators run."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dcvrt.studies.style import GREY, INK, PAGE, mode_band, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dcvrt.dae import Automaton, Dae

_BOX = (1.25, 0.62)
_HEIGHT = 3.1
_KEY = (
    "Numbers: order in which transitions are tried. 'for': the guard must hold that long without a break.\n"
    "Bold frame: start. $v_f$: measured POI voltage. $w$: DC energy over nominal."
)


def draw(dae: Dae, automaton: str | None = None) -> Figure:
    """Modes as boxes, transitions as arrows with guard and dwell time, in the order in which they are tried.

    Parameters
    ----------
    dae : compiled facility.
    automaton : path of the automaton; the first one unless given.
    """
    table = next(a for a in dae.automata if automaton in (None, a.path))
    values = _values(dae, table)
    figure = new_figure(PAGE, _HEIGHT + 0.36 + 0.15 * math.ceil(len(values) / 6), arranged=False)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    bottom = -(figure.get_figheight() - _HEIGHT)
    axes.set(xlim=(0, PAGE), ylim=(bottom, _HEIGHT))
    axes.axis("off")
    places = _places(len(table.modes))
    for mode, place in zip(table.modes, places, strict=True):
        _box(axes, mode, _set_flags(table, mode), place, mode_band(mode, table.modes), mode == table.start)
    lines: dict[tuple[str, str], list[str]] = {}
    for number, row in enumerate(table.rows, 1):
        lines.setdefault((row.source, row.target), []).append(f"{number}  {guard_text(row.text)}")
    for (source, target), texts in lines.items():
        ends = places[table.modes.index(source)], places[table.modes.index(target)]
        _edge(axes, *ends, "\n".join(texts), paired=(target, source) in lines)
    for k in range(0, len(values), 6):
        axes.text(
            PAGE / 2,
            -0.02 - 0.15 * (k // 6),
            "     ".join(values[k : k + 6]),
            ha="center",
            va="center",
            fontsize=6.8,
            color=INK,
        )
    axes.text(PAGE / 2, bottom + 0.15, _KEY, ha="center", va="center", fontsize=6.5, color=GREY)
    return figure


def guard_text(text: str) -> str:
    r"""Text of a transition as it stands on its arrow, in mathematical type.

    >>> guard_text("MIXED -> BATTERY: v_f < V_deep held T_deep")
    '$v_f$ < $V_{\\mathrm{deep}}$ for $T_{\\mathrm{deep}}$'
    >>> guard_text("B -> R: v_f > V_back and v_f < V_calm and error > (-e_sync) and error < e_sync")
    '$V_{\\mathrm{back}}$ < $v_f$ < $V_{\\mathrm{calm}}$ and |error| < $e_{\\mathrm{sync}}$'
    >>> guard_text("RETURN -> NORMAL: always held T_ramp")
    'after $T_{\\mathrm{ramp}}$'
    """
    condition = text.split(": ", 1)[1]
    guard, _, held = condition.partition(" held ")
    if guard == "always":
        return f"after {_symbols(held)}" if held else "at once"
    cases = [_merged(case.split(" and ")) for case in guard.split(" or ")]
    dwell = f" for {_symbols(held)}" if held else ""
    return _symbols(" or ".join(" and ".join(case) for case in cases)) + dwell


def _merged(comparisons: Sequence[str]) -> list[str]:
    """Join 'x > a' and 'x < b' of one case into 'a < x < b', and into '|x| < b' where a = -b."""
    parts = [c.split(" ", 2) for c in comparisons]
    merged, used = [], set()
    for k, (signal, side, limit) in enumerate(parts):
        if k in used:
            continue
        other = next(
            (j for j in range(k + 1, len(parts)) if parts[j][0] == signal and parts[j][1] != side), None
        )
        if other is None:
            merged.append(f"{signal} {side} {limit}")
            continue
        used.add(other)
        low, high = (limit, parts[other][2]) if side == ">" else (parts[other][2], limit)
        merged.append(
            f"|{signal}| < {high}" if low in (f"(-{high})", f"-{high}") else f"{low} < {signal} < {high}"
        )
    return merged


def _symbols(text: str) -> str:
    """Names with an underscore, and single letters, in mathematical type."""
    return re.sub(
        r"\b([A-Za-z]+)_([A-Za-z0-9]+)\b|\b([A-Za-z])\b",
        lambda m: (
            f"${m[3]}$"
            if m[3]
            else f"${m[1]}_{{\\mathrm{{{m[2]}}}}}$"
            if len(m[2]) > 1
            else f"${m[1]}_{m[2]}$"
        ),
        text,
    )


def _values(dae: Dae, table: Automaton) -> list[str]:
    """Thresholds and dwell times that the guards name, with their values."""
    found = []
    names = dict.fromkeys(re.findall(r"\b[A-Za-z]+_[A-Za-z0-9]+\b", " ".join(row.text for row in table.rows)))
    by_path = {row.path: row for row in dae.parameter_rows}
    for name in names:
        row = by_path.get(f"{table.path}.{name}", by_path.get(name))
        if row is not None:
            unit = {"1": "", "pu(V)": " pu"}.get(row.unit, f" {row.unit}")
            found.append(f"{_symbols(name)} = {row.value:g}{unit}")
    return found


def _set_flags(table: Automaton, mode: str) -> str:
    """Names of the on/off flags that a mode sets."""
    values = table.flags[table.mode_number(mode)]
    switches = [k for k in range(len(table.flag_names)) if set(table.flags[:, k]) <= {0.0, 1.0}]
    return ", ".join(table.flag_names[k] for k in switches if values[k])


def _places(n: int) -> list[tuple[float, float]]:
    """Centres of the boxes: the corners of a wide rectangle for four modes, an ellipse for other numbers."""
    left, right, low, high = (
        0.10 + _BOX[0] / 2,
        PAGE - 0.10 - _BOX[0] / 2,
        0.26 + _BOX[1] / 2,
        _HEIGHT - 0.27 - _BOX[1] / 2,
    )
    if n == 4:
        return [(left, high), (right, high), (right, low), (left, low)]
    turns = [math.pi * (0.75 - 2 * k / n) for k in range(n)]
    middle = ((left + right) / 2, (low + high) / 2)
    return [
        (middle[0] + (right - left) / 2 * math.cos(a), middle[1] + (high - low) / 2 * math.sin(a))
        for a in turns
    ]


def _box(axes: Axes, mode: str, note: str, centre: tuple[float, float], shade: str, start: bool) -> None:
    from matplotlib.patches import FancyBboxPatch

    x, y = centre
    axes.add_patch(
        FancyBboxPatch(
            (x - _BOX[0] / 2 + 0.05, y - _BOX[1] / 2 + 0.05),
            _BOX[0] - 0.1,
            _BOX[1] - 0.1,
            boxstyle="round,pad=0.05",
            facecolor=shade,
            edgecolor=INK,
            linewidth=1.8 if start else 0.9,
            zorder=3,
        )
    )
    axes.text(x, y + 0.10, mode, ha="center", va="center", fontsize=9, fontweight="bold", zorder=4)
    axes.text(x, y - 0.13, note, ha="center", va="center", fontsize=6.3, zorder=4)


def _edge(axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str, paired: bool) -> None:
    """Draw an arrow from box to box, beside its counterpart, with its text outside or towards the middle."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    side = (-dy / length, dx / length)  # to the left of the direction of travel
    lane = 0.11 if paired else 0.0
    shift = (side[0] * lane, side[1] * lane)
    reach = [
        min(
            _BOX[0] / 2 / abs(dx / length) if dx else math.inf,
            _BOX[1] / 2 / abs(dy / length) if dy else math.inf,
        )
    ] * 2
    a = (start[0] + dx / length * reach[0] + shift[0], start[1] + dy / length * reach[0] + shift[1])
    b = (end[0] - dx / length * reach[1] + shift[0], end[1] - dy / length * reach[1] + shift[1])
    axes.annotate(
        "",
        b,
        a,
        arrowprops=dict(arrowstyle="-|>", color=INK, linewidth=1.1, shrinkA=0, shrinkB=1, mutation_scale=10),
    )
    middle = ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)
    style: dict[str, Any] = dict(fontsize=7.2, linespacing=1.45, zorder=5)
    if abs(dy) < 1e-9:  # along a side of the rectangle: above the upper lane, below the lower one
        above = shift[1] > 0 or (lane == 0 and start[1] < _HEIGHT / 2)
        axes.text(
            middle[0],
            middle[1] + (0.06 if above else -0.06),
            text,
            ha="center",
            va="bottom" if above else "top",
            **style,
        )
    elif abs(dx) < 1e-9:  # up or down: towards the middle of the figure, where there is room
        inner = -1 if middle[0] > PAGE / 2 else 1
        axes.text(
            middle[0] + inner * 0.10,
            middle[1],
            text,
            ha="right" if inner < 0 else "left",
            va="center",
            **style,
        )
    else:
        axes.text(
            *middle,
            text,
            ha="center",
            va="center",
            bbox=dict(facecolor="white", edgecolor="none", pad=1.5, alpha=0.9),
            **style,
        )
