"""Dynamic devices of the IEEE 118-bus case, by the rule in `dcvrt/data/ieee118/SOURCE.md`."""

from __future__ import annotations

import csv
import importlib.resources
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dcvrt.errors import InputError
from dcvrt.grid.network import Network

SITES = (21, 75, 106, 108)
"""Candidate buses of the paper."""
WIND = (69, 80, 89)
"""Wind buses of the paper."""

RATED_POWER_FACTOR = 0.9
LARGE_FROM_MVA = 400.0
CONDENSER_MVA = (100.0, 150.0)
CONDENSER_OVER_Q_MAX = 2.0


@dataclass(frozen=True)
class Figure:
    """One entry of the rule table: a value and where it comes from."""

    value: float
    unit: str
    source: str
    note: str


@dataclass(frozen=True)
class Machine:
    """A unit with its controls.

    Parameters
    ----------
    unit : int
        Position among the generators of the network.
    bus : int
        Bus number.
    kind : str
        `large`, `medium` or `condenser`.
    s_n : float
        Rating, MVA.
    models : mapping of model name to mapping of symbol to value
        Per unit on the rating; a condenser has no governor.
    """

    unit: int
    bus: int
    kind: str
    s_n: float
    models: Mapping[str, Mapping[str, float]]


def table() -> dict[str, dict[str, dict[str, Figure]]]:
    """The rule table: class -> model -> symbol -> figure.

    >>> table()["large"]["GENROU"]["xd"].value
    1.8
    """
    source = importlib.resources.files("dcvrt") / "data" / "ieee118" / "machine_classes.csv"
    classes: dict[str, dict[str, dict[str, Figure]]] = {}
    for row in csv.DictReader(
        line for line in source.read_text(encoding="utf-8").splitlines() if line[0] != "#"
    ):
        figure = Figure(float(row["value"]), row["unit"], row["source"], row["note"])
        classes.setdefault(row["class"], {}).setdefault(row["model"], {})[row["symbol"]] = figure
    return classes


def machines(network: Network) -> list[Machine]:
    """Machines of all units of `network`, by the rule.

    Raises
    ------
    InputError
        When a unit has no rating to go by: P_max or Q_max infinite or not positive.

    Examples
    --------
    >>> units = machines(Network.ieee118())
    >>> sorted((kind, sum(m.kind == kind for m in units)) for kind in {m.kind for m in units})
    [('condenser', 35), ('large', 7), ('medium', 12)]
    """
    classes = {
        kind: {
            model: MappingProxyType({symbol: figure.value for symbol, figure in symbols.items()})
            for model, symbols in models.items()
        }
        for kind, models in table().items()
    }
    units, found = network.generators, []
    for k, bus in enumerate(units.bus.tolist()):
        if units.p_set[k] > 0:
            s_n = float(units.p_max[k]) / RATED_POWER_FACTOR
            kind = "large" if s_n >= LARGE_FROM_MVA else "medium"
        else:
            s_n = float(np.clip(CONDENSER_OVER_Q_MAX * units.q_max[k], *CONDENSER_MVA))
            kind = "condenser"
        if not np.isfinite(s_n) or s_n <= 0:
            raise InputError(
                f"unit {units.name[k]}: rating of {s_n:g} MVA from its limits. Way out: give p_max and q_max."
            )
        found.append(Machine(k, bus, kind, s_n, MappingProxyType(classes[kind])))
    return found
