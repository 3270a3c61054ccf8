"""A ride-through envelope in the plane of voltage and time, with the verdict on every trial."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dcvrt.envelopes import MARKS, Envelope
from dcvrt.envelopes.table import Band, joined
from dcvrt.studies.style import FAILED, GREY, INK, PAGE, PALETTE, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from dcvrt.studies.against import Outcome

SHORTEST, LONGEST = 0.01, 100.0
"""Ends of the time axis, s."""
TOP = 1.4
COVERED = "#e8f1f8"
SYMBOLS: dict[bool | None, dict[str, Any]] = {
    True: {"marker": "o", "color": PALETTE[2], "markersize": 5.5},
    False: {"marker": "X", "color": FAILED, "markersize": 6.5},
    None: {"marker": "D", "color": GREY, "markersize": 4.5, "markerfacecolor": "white"},
}
IN_THE_PLANE = ("low", "high", "continuous", "recovery", "reclosing")
WIDTH = 62
"""Characters of a line of the list."""


def draw(envelope: Envelope, outcomes: Sequence[Outcome], title: str) -> Figure:
    """The envelope with every trial, numbered, and a list of what each trial showed."""
    texts = [_told(o) for o in outcomes]
    lines = sum(1.25 + 1.0 * len(text) for text in texts)
    figure = new_figure(PAGE, max(3.6, 0.118 * lines + 0.9), arranged=False)
    height = figure.get_figheight()
    figure.text(0.015, 1 - 0.1 / height, title, fontsize=8.5, va="top")
    evidence = joined(*(o.trial.mark for o in outcomes), envelope.marks)
    figure.text(
        0.015,
        0.06 / height,
        textwrap.fill(
            "Evidence: " + "; ".join(f"{m} = {MARKS[m]}" for m in evidence.split(", ") if m) + ".", 150
        ),
        fontsize=6.0,
        color=GREY,
        va="bottom",
    )
    bottom, top = 0.72 / height, 1 - 0.42 / height
    plane = figure.add_axes((0.075, bottom, 0.40, top - bottom))
    listed = figure.add_axes((0.505, 0.30 / height, 0.485, 1 - 0.72 / height))
    _plane(plane, envelope, outcomes)
    _list(listed, outcomes, texts, lines)
    return figure


def _plane(axes: Axes, envelope: Envelope, outcomes: Sequence[Outcome]) -> None:
    low, high = _corners(envelope, envelope.low, -1), _corners(envelope, envelope.high, 1)
    if envelope.kind == "envelope" and low and high:
        outline = [*low, *reversed(high)]
        axes.fill(*zip(*outline, strict=True), facecolor=COVERED, edgecolor="none", zorder=0)
        for corners in (low, high):
            axes.plot(*zip(*corners, strict=True), color=INK, linewidth=1.1, zorder=2)
        inside = "stay connected" if envelope.side == "poi" else "servers stay on"
        axes.text(SHORTEST * 1.2, 1.0, inside, va="center", fontsize=7.0, color=GREY, zorder=1)
    elif not (envelope.low or envelope.high):
        axes.text(SHORTEST * 1.2, 1.0, "no voltage curve known", va="center", fontsize=7.0, color=GREY)
    for number, o in enumerate(outcomes, 1):
        if o.trial.kind not in IN_THE_PLANE:
            continue
        time = o.trial.held if o.trial.kind == "continuous" else o.trial.time
        time = min(max(time, SHORTEST * 1.15), LONGEST * 0.9)
        symbol = SYMBOLS[o.verdict.passed]
        axes.plot([time], [o.trial.level], linestyle="none", zorder=4, clip_on=False, **symbol)
        inwards = -1 if o.trial.level > 1.0 else 1
        axes.annotate(
            str(number),
            (time, o.trial.level),
            xytext=(-5, 3 * inwards),
            textcoords="offset points",
            ha="right",
            va="bottom" if inwards > 0 else "top",
            fontsize=7.0,
            zorder=5,
        )
    axes.set_xscale("log")
    axes.set_xlim(SHORTEST, LONGEST)
    axes.set_ylim(-0.03, TOP)
    axes.set_xticks([0.01, 0.1, 1.0, 10.0, 100.0], ["0.01", "0.1", "1", "10", "100"])
    axes.set_xlabel("time since the voltage left the continuous range (s)")
    axes.set_ylabel(
        "voltage at the point of interconnection (pu)" if envelope.side == "poi" else "supply voltage (pu)"
    )


def _corners(envelope: Envelope, bands: Sequence[Band], side: int) -> list[tuple[float, float]]:
    """Corners of the curve from left to right; none where it is not known."""
    steady = envelope.continuous
    if steady is None and not bands:
        return []
    level = (steady.low if side < 0 else steady.high) if steady is not None else None
    corners: list[tuple[float, float]] = []
    begin = SHORTEST
    for band in sorted(bands, key=lambda b: b.time):
        far = 2 * TOP if band.severe is None else band.severe
        corners += [(begin, far), (band.time, far)]
        begin = band.time
    if level is not None and begin < LONGEST:
        corners += [(begin, level), (LONGEST, level)]
    return corners


def _told(outcome: Outcome) -> list[str]:
    parts = [outcome.connection, outcome.return_]
    if outcome.verdict.passed is False:
        parts.append(outcome.mechanism)
    told = "; ".join(part for part in parts if part)
    return textwrap.wrap(told, WIDTH) or [""]


def _list(axes: Axes, outcomes: Sequence[Outcome], texts: Sequence[list[str]], lines: float) -> None:
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    axes.set_ylim(max(lines, 22.0), 0)
    row = 0.6
    for number, (o, text) in enumerate(zip(outcomes, texts, strict=True), 1):
        axes.plot([0.055], [row], linestyle="none", clip_on=False, **SYMBOLS[o.verdict.passed])
        axes.text(0.03, row, str(number), ha="right", va="center", fontsize=7.0)
        label = o.trial.label
        if o.trial.shortened:
            label += f" (run for {o.trial.held:g} s)"
        axes.text(0.08, row, f"{label}  [{o.trial.mark}]", va="center", fontsize=7.0)
        for k, line in enumerate(text, 1):
            axes.text(0.08, row + k, line, va="center", fontsize=6.3, color=GREY)
        row += 1.25 + len(text)
    if not outcomes:
        axes.text(0.08, row, "no number that can be simulated", va="center", fontsize=7.0, color=GREY)
