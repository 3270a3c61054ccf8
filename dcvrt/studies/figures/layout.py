r"""Places for the buses of a network whose geography is not known: stress majorisation (SMACOF).

Minimises the stress

.. math:: \sum_{i<j} d_{ij}^{-2} \left( \lVert x_i - x_j \rVert - d_{ij} \right)^2

over positions x, where d_ij is a power of the number of branches between two buses. Each step replaces x by
the minimum of a quadratic that lies above the stress and touches it at x (the Guttman transform), so the
stress never rises. It starts from classical scaling and draws no random number: the same network gives the
same picture.
"""

from __future__ import annotations

import csv
import importlib.resources
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from dcvrt.grid.network import Network

LONG = 0.85
"""Exponent on path lengths: below 1 it draws long paths shorter, so that crowded parts get more room."""

Floats = npt.NDArray[np.float64]


def positions(network: Network) -> Floats:
    """Coordinates of the buses in bus order: those that ship for the IEEE 118-bus system, else computed ones.

    Returns
    -------
    array (buses, 2)
        One branch is about as long as 1.
    """
    table = importlib.resources.files("dcvrt") / "data" / "layout" / f"{network.name}.csv"
    if table.is_file():
        rows = list(
            csv.DictReader(line for line in table.read_text(encoding="utf-8").splitlines() if line[:1] != "#")
        )
        places = {int(row["bus"]): (float(row["x"]), float(row["y"])) for row in rows}
        if places.keys() == {int(bus) for bus in network.bus}:
            return np.array([places[int(bus)] for bus in network.bus])
    return computed(network)


def computed(network: Network, steps: int = 400) -> Floats:
    """Coordinates by stress majorisation, the longer extent horizontal."""
    from scipy.sparse.csgraph import shortest_path

    links = abs(network.incidence).T @ abs(network.incidence)
    distance = shortest_path(links != 0, unweighted=True, directed=False) ** LONG
    tilt = 0.05 * np.sin(np.arange(2 * len(distance))).reshape(-1, 2)  # parts buses with the same neighbours
    return upright(majorised(distance, classical(distance) + tilt, steps))


def classical(distance: Floats) -> Floats:
    """Classical scaling: the plane in which the distances fit best as inner products."""
    n = len(distance)
    centre = np.eye(n) - 1.0 / n
    values, vectors = np.linalg.eigh(-0.5 * centre @ distance**2 @ centre)
    plane = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    sign = np.sign(plane[np.argmax(abs(plane), axis=0), [0, 1]])  # eigenvectors come with either sign
    return np.asarray(plane * sign)


def stress(distance: Floats, x: Floats) -> float:
    """Weighted sum of squared differences between drawn and graph distances."""
    upper = np.triu_indices(len(x), 1)
    drawn = np.linalg.norm(x[upper[0]] - x[upper[1]], axis=1)
    return float((((drawn - distance[upper]) / distance[upper]) ** 2).sum())


def majorised(distance: Floats, x: Floats, steps: int) -> Floats:
    """Positions after `steps` Guttman transforms from `x`."""
    n = len(x)
    weight = np.where(np.eye(n, dtype=bool), 0.0, 1.0 / np.maximum(distance, 1e-9) ** 2)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    inverse = np.linalg.inv(
        laplacian + 1.0 / n
    )  # the constant vector is its kernel; the added part leaves the rest alone
    for _ in range(steps):
        drawn = np.linalg.norm(x[:, None] - x[None], axis=2)
        ratio = weight * distance / np.where(drawn > 1e-9, drawn, np.inf)
        x = inverse @ ((np.diag(ratio.sum(axis=1)) - ratio) @ x)
        x = x - x.mean(axis=0)
    return x


def upright(x: Floats) -> Floats:
    """Turn so that the greatest extent is horizontal, with a fixed choice of left and right."""
    _, _, axes = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)
    turned = (x - x.mean(axis=0)) @ axes.T
    return np.asarray(turned * np.where(turned[0] > 0, -1.0, 1.0))


def write_table(network: Network, path: str) -> None:
    """Write the coordinates of a network in the form that `positions` reads."""
    lines = [
        "# bus coordinates by dcvrt.studies.figures.layout.computed, no geography; see SOURCE.md",
        "bus,x,y",
    ]
    lines += [f"{bus},{x:.3f},{y:.3f}" for bus, (x, y) in zip(network.bus, computed(network), strict=True)]
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
