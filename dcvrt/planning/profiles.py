"""Hourly operating conditions: load level, wind and data-centre factor over a year."""

from __future__ import annotations

import gzip
import importlib.resources
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, raise_all
from dcvrt.grid.network import Network

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

HOURS = 8760

WEEKLY = (
    86.2, 90.0, 87.8, 83.4, 88.0, 84.1, 83.2, 80.6, 74.0, 73.7, 71.5, 72.7, 70.4,
    75.0, 72.1, 80.0, 75.4, 83.7, 87.0, 88.0, 85.6, 81.1, 90.0, 88.7, 89.6, 86.1,
    75.5, 81.6, 80.1, 88.0, 72.2, 77.6, 80.0, 72.9, 72.6, 70.5, 78.0, 69.5, 72.4,
    72.4, 74.3, 74.4, 80.0, 88.1, 88.5, 90.9, 94.0, 89.0, 94.2, 97.0, 100.0, 95.2,
)  # fmt: skip
"""RTS-79 weekly peak, per cent of the annual peak. `data/profiles/SOURCE.md` says which ordering this is."""

DAILY = (93, 100, 98, 96, 94, 77, 75)
"""RTS-79 daily peak from Monday to Sunday, per cent of the weekly peak."""

HOURLY = {
    ("winter", "weekday"): (
        67, 63, 60, 59, 59, 60, 74, 86, 95, 96, 96, 95,
        95, 95, 93, 94, 99, 100, 100, 96, 91, 83, 73, 63,
    ),
    ("winter", "weekend"): (
        78, 72, 68, 66, 64, 65, 66, 70, 80, 88, 90, 91,
        90, 88, 87, 87, 91, 100, 99, 97, 94, 92, 87, 81,
    ),
    ("summer", "weekday"): (
        64, 60, 58, 56, 56, 58, 64, 76, 87, 95, 99, 100,
        99, 100, 100, 97, 96, 96, 93, 92, 92, 93, 87, 72,
    ),
    ("summer", "weekend"): (
        74, 70, 66, 65, 64, 62, 62, 66, 81, 86, 91, 93,
        93, 92, 91, 91, 92, 94, 95, 95, 100, 93, 88, 80,
    ),
    ("between", "weekday"): (
        63, 62, 60, 58, 59, 65, 72, 85, 95, 99, 100, 99,
        93, 92, 90, 88, 90, 92, 96, 98, 96, 90, 80, 70,
    ),
    ("between", "weekend"): (
        75, 73, 69, 66, 65, 65, 68, 74, 83, 89, 92, 94,
        91, 90, 90, 86, 85, 88, 92, 100, 97, 95, 90, 85,
    ),
}  # fmt: skip
"""RTS-79 hourly peak from midnight on, per cent of the daily peak."""

ILLUSTRATIVE_WIND = {69: 200.0, 80: 200.0, 89: 200.0}
"""Wind capacity by bus, MW. Illustrative: the paper names the buses, not the sizes."""


@dataclass(frozen=True)
class Hour:
    """One operating hour.

    Parameters
    ----------
    hour : int
        Hour of the year, from 0.
    load : float
        Factor on every load of the network, active and reactive.
    wind : mapping
        Wind injection by bus number, MW, at unity power factor.
    dc : float
        Data-centre load over hosted capacity, d_t.
    """

    hour: int
    load: float
    wind: Mapping[int, float]
    dc: float


@dataclass(frozen=True, eq=False)
class Year:
    """Operating hours: all of a year, or some of them with their numbers kept.

    Parameters
    ----------
    hours : int array (hours,)
        Hour of the year of each entry, from 0; every result names hours by these.
    load : float array (hours,)
        Factor on every load of the network.
    wind : mapping of bus number to float array (hours,)
        Wind injection, MW.
    dc : float array (hours,)
        Data-centre load over hosted capacity d_t, above 0 and at most 1.
    sources : mapping of str to str
        Where `load`, `wind` and `dc` come from.
    p_min, p_max : mapping of unit name to float array (hours,)
        Limits of units that vary from hour to hour, MW: maintenance, must-run, water. They replace those of
        the network in the dispatch of the hosting programme.

    Raises
    ------
    InputError
        Naming every column with NaN, a wrong length or a value out of range, with the hour.
    """

    hours: Integers
    load: Floats
    wind: Mapping[int, Floats]
    dc: Floats
    sources: Mapping[str, str] = field(default_factory=dict)
    p_min: Mapping[str, Floats] = field(default_factory=dict)
    p_max: Mapping[str, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "hours", np.array(self.hours, dtype=np.int64))
        object.__setattr__(self, "load", np.array(self.load, dtype=float))
        object.__setattr__(self, "dc", np.array(self.dc, dtype=float))
        object.__setattr__(
            self, "wind", {int(bus): np.array(mw, dtype=float) for bus, mw in self.wind.items()}
        )
        for side in ("p_min", "p_max"):
            limits = {str(unit): np.array(mw, dtype=float) for unit, mw in getattr(self, side).items()}
            object.__setattr__(self, side, limits)
        columns = {
            "load": self.load,
            "dc": self.dc,
            **{f"wind[{bus}]": mw for bus, mw in self.wind.items()},
            **{f"p_min[{unit}]": mw for unit, mw in self.p_min.items()},
            **{f"p_max[{unit}]": mw for unit, mw in self.p_max.items()},
        }
        problems = []
        if len(self.hours) == 0:
            problems.append("has no hours.")
        if len(set(self.hours.tolist())) < len(self.hours):
            problems.append("lists an hour more than once.")
        for name, values in columns.items():
            if values.shape != self.hours.shape:
                problems.append(f"{name} has {values.size} values for {len(self.hours)} hours.")
                continue
            rule, wrong = {
                "load": ("must be a finite number above 0", ~(np.isfinite(values) & (values > 0))),
                "dc": ("must be above 0 and at most 1", ~((values > 0) & (values <= 1))),
            }.get(name, ("must be a finite number of MW, 0 or more", ~(np.isfinite(values) & (values >= 0))))
            if name.startswith("p_m"):
                rule, wrong = "must be a finite number of MW", ~np.isfinite(values)
            if wrong.any():
                k = int(np.flatnonzero(wrong)[0])
                more = f" ({int(wrong.sum())} hours in all)" if wrong.sum() > 1 else ""
                problems.append(f"{name} {rule}; it is {values[k]:g} in hour {self.hours[k]}{more}.")
        raise_all(problems, "operating hours")
        for column in (self.hours, *columns.values()):
            column.flags.writeable = False

    def __len__(self) -> int:
        return len(self.hours)

    @cached_property
    def _position(self) -> dict[int, int]:
        return {int(hour): k for k, hour in enumerate(self.hours)}

    def positions(self, hours: Iterable[int]) -> Integers:
        """Places of the given hours of the year in the arrays.

        Raises
        ------
        InputError
            When an hour is not among these.
        """
        wanted = [int(hour) for hour in hours]
        strange = [hour for hour in wanted if hour not in self._position]
        if strange:
            raise InputError(
                f"hour {strange[0]} is not among the {len(self)} operating hours "
                f"({self.hours.min()} to {self.hours.max()})."
            )
        return np.array([self._position[hour] for hour in wanted], dtype=np.int64)

    def window(self, hours: Iterable[int]) -> Year:
        """Take some hours, under their own numbers.

        >>> week = ieee118().window(range(8400, 8568))
        >>> len(week), int(week.hours[0])
        (168, 8400)
        """
        at = self.positions(hours)
        return Year(
            self.hours[at],
            self.load[at],
            {bus: mw[at] for bus, mw in self.wind.items()},
            self.dc[at],
            self.sources,
            {unit: mw[at] for unit, mw in self.p_min.items()},
            {unit: mw[at] for unit, mw in self.p_max.items()},
        )

    def at(self, hour: int) -> Hour:
        """One hour, by its number in the year."""
        k = int(self.positions([hour])[0])
        return Hour(
            int(hour),
            float(self.load[k]),
            {bus: float(mw[k]) for bus, mw in self.wind.items()},
            float(self.dc[k]),
        )

    def net_load(self, network: Network) -> Floats:
        """System load less wind in each hour, MW, with nothing hosted."""
        return self.load * network.p_load.sum() - sum(self.wind.values(), np.zeros(len(self)))

    def representative(self, network: Network) -> dict[str, int]:
        """Choose hours for the dynamic study: `peak`, `median` and `light` net load.

        The hour of the largest, of the middle (lower median) and of the smallest net load; the earliest hour
        wins a tie. The smallest net load comes with high wind and few units loaded.

        Returns
        -------
        dict of str to int
            Hours of the year.
        """
        order = np.lexsort((self.hours, self.net_load(network)))
        largest = self.net_load(network).max()
        peak = self.hours[self.net_load(network) == largest].min()
        return {
            "peak": int(peak),
            "median": int(self.hours[order[(len(order) - 1) // 2]]),
            "light": int(self.hours[order[0]]),
        }


def rts79_load(hours: int = HOURS) -> Floats:
    """Load factor of each hour: weekly x daily x hourly factor of RTS-79, hour 0 on a Monday.

    The tables cover 52 weeks, 8736 hours; the day that a year has more is the Monday of week 1 again.
    Winter is weeks 1-8 and 44-52, summer weeks 18-30.

    >>> float(rts79_load().max()), int(rts79_load().argmax()) // 168 + 1
    (1.0, 51)
    """
    factors = np.empty(52 * 168)
    for week, weekly in enumerate(WEEKLY, start=1):
        season = "winter" if week <= 8 or week >= 44 else "summer" if 18 <= week <= 30 else "between"
        for day, daily in enumerate(DAILY):
            shape = np.array(HOURLY[season, "weekend" if day >= 5 else "weekday"])
            start = (week - 1) * 168 + day * 24
            factors[start : start + 24] = weekly * daily * shape / 1e6
    return factors[np.arange(hours) % len(factors)]


def rts_gmlc_wind() -> Floats:
    """Wind over installed capacity in each hour, one column a plant.

    Returns
    -------
    array (8760, 3)
        RTS-GMLC plants 309_WIND_1, 317_WIND_1 and 303_WIND_1; origin and terms in `data/profiles`.
    """
    packed = (importlib.resources.files("dcvrt") / "data" / "profiles" / "rts_gmlc_wind.csv.gz").read_bytes()
    _, *rows = gzip.decompress(packed).decode().split()
    return np.array([row.split(",") for row in rows], dtype=float)


def data_centre_factor(hours: int = HOURS) -> Floats:
    r"""Load of a data centre over its hosted capacity, hour 0 at midnight on a Monday. Illustrative.

    .. math:: d_t = w_t \left(0.94 + 0.06 \cos\frac{2\pi (h_t - 15)}{24}\right)

    with h_t the hour of the day and w_t = 1 on weekdays, 0.97 at weekends: flat, as such loads are, highest
    in the afternoon when cooling is hardest, and 1 at its maximum.

    >>> d = data_centre_factor()
    >>> float(d.max()), round(float(d.min()), 4)
    (1.0, 0.8536)
    """
    t = np.arange(hours)
    weekday = np.where(t // 24 % 7 < 5, 1.0, 0.97)
    return weekday * (0.94 + 0.06 * np.cos(2 * np.pi * (t % 24 - 15) / 24))


def ieee118(wind_mw: Mapping[int, float] | None = None) -> Year:
    """The 8760 hours of the IEEE-118 study.

    Parameters
    ----------
    wind_mw : mapping, optional
        Wind capacity by bus, MW; at most three buses, each with a plant of `rts_gmlc_wind` in order.
        Default `ILLUSTRATIVE_WIND`.

    Notes
    -----
    The three series share only their hour number: the wind year is 2020 and starts on a Wednesday.
    """
    capacity = ILLUSTRATIVE_WIND if wind_mw is None else wind_mw
    plants = rts_gmlc_wind()
    if len(capacity) > plants.shape[1]:
        raise InputError(
            f"ieee118: {len(capacity)} wind buses, but only {plants.shape[1]} wind series ship. "
            "Way out: build a Year with your own series."
        )
    wrong = [
        f"wind capacity at bus {bus} is {mw:g} MW; it must be 0 or more."
        for bus, mw in capacity.items()
        if not mw >= 0
    ]
    raise_all(wrong, "ieee118")
    return Year(
        hours=np.arange(HOURS),
        load=rts79_load(),
        dc=data_centre_factor(),
        wind={bus: mw * plants[:, k] for k, (bus, mw) in enumerate(capacity.items())},
        sources={
            "load": "IEEE Reliability Test System 1979, weekly x daily x hourly factors; "
            "week order as in data/profiles/SOURCE.md",
            "wind": "RTS-GMLC day-ahead wind 2020 without 29 February (DOE/NREL/ALLIANCE), per unit; "
            "capacities " + ("illustrative" if wind_mw is None else "given by the user"),
            "dc": "illustrative: own daily and weekly curve with maximum 1",
        },
    )


RANGES = 10
"""Runs of hours that a message lists."""


def in_ranges(hours: npt.ArrayLike) -> str:
    """Ascending hours in words, runs of them as their ends.

    >>> in_ranges([3, 4, 5, 9])
    '3-5, 9'
    >>> in_ranges(range(0, 26, 2))
    '0, 2, 4, 6, 8, 10, 12, 14, 16, 18 and 3 more'
    """
    runs = np.split(at := np.asarray(hours, dtype=np.int64), np.flatnonzero(np.diff(at) > 1) + 1)
    listed = ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:RANGES])
    left = sum(map(len, runs[RANGES:]))
    return f"{listed} and {left} more" if left else listed
