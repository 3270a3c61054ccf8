"""Work-precision curves as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks._precision import Curve

COLOURS = {
    "dcvrt": "#d62728",
    "CasADi, generated C": "#1f77b4",
    "CasADi": "#7fb3d9",
    "CasADi, jit": "#17a2b8",
    "SciPy": "#8c8c8c",
    "scikit-SUNDAE": "#2ca02c",
    "diffrax": "#9467bd",
}
MARKERS = "osD^vP*X"


def work_precision(
    curves: Mapping[str, Sequence[Curve]], error: str, targets: Sequence[float], path: Path
) -> None:
    """One panel a case: error to the right the smaller, time upwards; written as SVG and PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(5.2 * len(curves) + 3.4, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    handles: dict[str, Any] = {}
    for axis, (title, found) in zip(axes, curves.items(), strict=True):
        count: dict[str, int] = {}
        for curve in found:
            k = count[curve.family] = count.get(curve.family, -1) + 1
            ours = curve.family == "dcvrt"
            order = sorted(zip(curve.error, curve.seconds, strict=True))
            front: list[tuple[float, float]] = []
            for e, s in reversed(order):  # runs that are both slower and less exact than another do not count
                front = [(x, y) for x, y in front if y < s]
                front.append((e, s))
            line = axis.plot(
                [e for e, _ in front], [1e3 * s for _, s in front],
                color=COLOURS.get(curve.family, "black"), marker=MARKERS[k % len(MARKERS)],
                markersize=5.5 if ours else 4, linewidth=2.4 if ours else 1.1, zorder=3 if ours else 2,
                label=curve.name,
            )[0]  # fmt: skip
            handles.setdefault(curve.name, line)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.invert_xaxis()
        axis.grid(True, which="major", color="0.9", linewidth=0.8)
        for target in targets:
            axis.axvline(target, color="0.55", linewidth=0.8, linestyle=":", zorder=1)
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xlabel(error + "  (smaller to the right)", fontsize=9)
    axes[0].set_ylabel("processor time of a run, ms", fontsize=9)
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8, frameon=False)
    for suffix in (".svg", ".png"):
        figure.savefig(path.with_suffix(suffix), dpi=130)
