"""What a study file gets wrong that no single field can tell: fields that contradict each other, names of
another file.

Everything is found before work starts. The built-in case is checked without starting the fault
simulator; any other is read and initialised by it.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dcvrt.errors import DcvrtError, InputError, did_you_mean, outside, raise_all
from dcvrt.grid.faults import islanding
from dcvrt.planning.replay import fault_label, fault_of
from dcvrt.studies.config import (
    CriteriaSection,
    FacilitySection,
    FaultEntry,
    FrontierSection,
    GridSection,
    HostingSection,
    PeriodEntry,
    SamplingSection,
    SensitivitySection,
    StudyFile,
    SystemLimitSection,
    read,
)
from dcvrt.studies.ranges import do_not_go_together, outside_ranges

if TYPE_CHECKING:
    from dcvrt.grid.network import Network
    from dcvrt.planning.profiles import Year

SHARED = ("H", "S_B", "beta", "d", "pf")
"""Parameters that the study itself sets in every run."""


def check(text: str, where: str, folder: Path) -> StudyFile:
    """Read a study file and check all of it.

    Parameters
    ----------
    text : the file.
    where : what messages call it.
    folder : what relative paths in it start from.

    Raises
    ------
    InputError
        One error with every problem.
    """
    file, sections, withheld, problems = read(text, where)
    found = contradictions(sections)
    network, more = read_network(sections.get("grid"), folder)
    found += more
    if network is not None:
        found += unknown_buses(sections, network) + wrong_branches(sections, network)
    hosting = sections.get("hosting")
    year = None
    if hosting is not None and not withheld & {"profiles", "hours"}:
        year, more = _try_profiles(hosting, folder)
        found += more
        if year is not None:
            found += unknown_hours(sections, year, network)
    found += outside_ranges(sections, year, network)
    if "facility" in sections:
        found += unknown_variants(sections["facility"])
        found += wrong_sensitivity(sections)
    # Fields that are wrong by themselves stand at their defaults in these checks.
    problems += [line for line in found if withheld.isdisjoint(re.findall(r"\w+", line))]
    raise_all(problems, where)
    assert file is not None
    return file


def contradictions(sections: Mapping[str, Any]) -> list[str]:
    """Fields that contradict each other."""
    problems: list[str] = []
    grid: GridSection | None = sections.get("grid")
    faults: Sequence[FaultEntry] = sections.get("fault", ())
    if grid is not None:
        problems += [f"grid.sites: bus {bus} is listed more than once." for bus in _repeated(grid.sites)]
        for k, fault in enumerate(faults, start=1):
            if fault.bus in grid.sites:
                problems.append(
                    f"fault[{k}].bus = {fault.bus}: is a candidate bus; a site cannot ride through a fault "
                    f"at "
                    "its own terminals. Way out: take a neighbouring bus, or drop it from grid.sites."
                )
            cleared = fault.t_start_s + 1e-3 * fault.t_clear_ms
            if cleared >= grid.t_end_s:
                problems.append(
                    f"fault[{k}]: is cleared at {cleared:g} s, after the end of the simulation at "
                    f"{grid.t_end_s:g} s. Way out: raise grid.t_end_s."
                )
        if grid.coupling == "closed" and grid.engine == "andes":
            problems.append(
                "grid.coupling = 'closed': grid.engine = 'andes' has no model of a facility. Way out: "
                "grid.engine = 'native', or coupling = 'open'."
            )
        problems += wrong_sizes(sections, grid.sites)
        sampling: SamplingSection | None = sections.get("sampling")
        if sampling is not None:
            kept, needed = (
                sampling.n - max(1, round(sampling.validation_share * sampling.n)),
                len(grid.sites) + 2,
            )
            if kept < needed:
                problems.append(
                    f"sampling.n = {sampling.n}: leaves {kept} hosting vectors to fit a margin of "
                    f"{len(grid.sites)} sites, "
                    f"{needed} are needed. Way out: raise sampling.n or lower sampling.validation_share."
                )
        frontier: FrontierSection | None = sections.get("frontier")
        if sampling is not None and sampling.gradients and grid.engine == "andes":
            problems.append(
                "sampling.gradients = true: grid.engine = 'andes' gives none. Way out: "
                "grid.engine = 'native'."
            )
        if frontier is not None and frontier.search and grid.engine == "andes":
            problems.append(
                "frontier.search = true: needs gradients, which grid.engine = 'andes' does not give. "
                "Way out: grid.engine = 'native', or search = false."
            )
        criteria: CriteriaSection | None = sections.get("criteria")
        if criteria is not None:
            problems += [
                f"criteria.{name} = {value:g}: is longer than grid.t_end_s = {grid.t_end_s:g}."
                for name, value in (
                    ("window_ms", criteria.window_ms),
                    ("loss_window_ms", criteria.loss_window_ms),
                )
                if 1e-3 * value >= grid.t_end_s
            ]
    problems += [
        f"fault: more than one is called {label!r}; results could not tell them apart."
        for label in _repeated([fault_label(fault.model_dump()) for fault in faults])
    ]
    periods: Sequence[PeriodEntry] = sections.get("period", ())
    problems += [
        f"period: the name {name!r} is used more than once." for name in _repeated([p.name for p in periods])
    ]
    hosting: HostingSection | None = sections.get("hosting")
    if hosting is not None:
        if hosting.v_min_pu >= hosting.v_max_pu:
            problems.append(
                f"hosting.v_min_pu = {hosting.v_min_pu:g}: must be below v_max_pu = {hosting.v_max_pu:g}."
            )
        if not _in_order(hosting.hours):
            problems.append(
                f"hosting.hours = {hosting.hours}: must be the first hour and the one after the last."
            )
    facility: FacilitySection | None = sections.get("facility")
    if facility is not None:
        if any(b <= a for a, b in zip(facility.beta, facility.beta[1:], strict=False)):
            problems.append(f"facility.beta = {facility.beta}: must rise from one value to the next.")
        problems += [
            f"facility.modes: {mode!r} is listed more than once." for mode in _repeated(facility.modes)
        ]
    return problems + wrong_limits(sections)


def wrong_sizes(sections: Mapping[str, Any], sites: Sequence[int]) -> list[str]:
    """Sizes by site that are too many or too few, and sites whose least size exceeds the largest."""
    hosting: HostingSection | None = sections.get("hosting")
    sampling: SamplingSection | None = sections.get("sampling")
    largest = None if hosting is None else hosting.h_max_mw
    least = None if hosting is None else hosting.min_size_mw
    given = {
        "hosting.h_max_mw": largest,
        "hosting.min_size_mw": least,
        "sampling.h_max_mw": None if sampling is None else sampling.h_max_mw,
    }
    problems = [
        f"{name}: {len(sizes)} values for {len(sites)} sites."
        for name, sizes in given.items()
        if isinstance(sizes, list) and len(sizes) != len(sites)
    ]
    if problems or largest is None or least is None:
        return problems
    return [
        f"hosting.min_size_mw: {low:g} MW at site {bus} exceeds its h_max_mw {high:g} MW."
        for bus, low, high in zip(sites, _each(least, sites), _each(largest, sites), strict=True)
        if low > high
    ]


def _each(sizes: float | Sequence[float], sites: Sequence[int]) -> Sequence[float]:
    return sizes if isinstance(sizes, Sequence) else [sizes] * len(sites)


def wrong_limits(sections: Mapping[str, Any]) -> list[str]:
    """System limits that are given twice or out of order, or at ratings that the study does not have."""
    limits: SystemLimitSection | None = sections.get("system_limit")
    facility: FacilitySection | None = sections.get("facility")
    frontier: FrontierSection | None = sections.get("frontier")
    if limits is None:
        return []
    listed = {"loss_mw": limits.loss_mw, "loss_share": limits.loss_share, "beta": limits.beta or []}
    problems = [
        f"system_limit.{name} = {values}: must rise from one value to the next."
        for name, values in listed.items()
        if any(b <= a for a, b in itertools.pairwise(values))
    ]
    if (limits.loss_mw or limits.loss_share) and frontier is not None and not frontier.search:
        problems.append(
            "system_limit: its plans are searched after the frontier, and frontier.search = false. Way out: "
            "search = true, or no limits."
        )
    if facility is not None:
        known = ", ".join(f"{beta:g}" for beta in facility.beta)
        problems += [
            f"system_limit.beta[{k}] = {beta:g}: is not in facility.beta, which has {known}."
            for k, beta in enumerate(limits.beta or [], start=1)
            if beta not in facility.beta
        ]
    return problems


def read_network(grid: GridSection | None, folder: Path) -> tuple[Network | None, list[str]]:
    """The network of the case, or what is wrong with it."""
    if grid is None:
        return None, []
    from dcvrt.grid.network import Network

    if grid.case == "ieee118":
        extra = ["grid.dynamics: the case 'ieee118' brings its own dynamic data. Way out: leave it out."]
        return Network.ieee118(), extra if grid.dynamics is not None else []
    path = folder / grid.case
    if not path.is_file():
        hint = did_you_mean(grid.case, ["ieee118"]) if path.suffix == "" else ""
        return None, [
            f"grid.case = {grid.case!r}: no such file and no such built-in case.{hint} Way out: 'ieee118', "
            f"or the "
            "path of a case with dynamic data, from the folder of the study file."
        ]
    if grid.dynamics is not None and not (folder / grid.dynamics).is_file():
        return None, [f"grid.dynamics = {grid.dynamics!r}: no such file."]
    if path.suffix.lower() == ".raw" and grid.dynamics is None and not path.with_suffix(".dyr").is_file():
        return None, [
            f"grid.case = {grid.case!r}: a .raw file has no dynamic data (machines, exciters, governors), "
            f"without "
            'which no fault can be simulated. Way out: give grid.dynamics = "FILE.dyr", or a case that has '
            "both (.xlsx or .json of ANDES)."
        ]
    from dcvrt.grid import Grid

    try:
        dynamics = None if grid.dynamics is None else folder / grid.dynamics
        opened = Grid.from_case(path, sites=tuple(grid.sites), dynamics=dynamics)
        opened.operating_point({})  # machines are there, and power flow and initialisation have a solution
        return opened.network, []
    except DcvrtError as error:
        return None, [f"grid.case = {grid.case!r}: {error}"]


def unknown_buses(sections: Mapping[str, Any], network: Network) -> list[str]:
    """Sites and faults at buses that the network does not have."""
    known = set(network.bus.tolist())
    named = [(f"grid.sites[{k}]", bus) for k, bus in enumerate(sections["grid"].sites, start=1)]
    named += [(f"fault[{k}].bus", fault.bus) for k, fault in enumerate(sections.get("fault", ()), start=1)]
    return [
        f"{path} = {bus}: {network.name} has no such bus.{did_you_mean(bus, network.bus)}"
        for path, bus in named
        if bus not in known
    ]


def wrong_branches(sections: Mapping[str, Any], network: Network) -> list[str]:
    """Branches that are to clear a fault and are not there, or whose opening cuts buses off."""
    problems = []
    for k, fault in enumerate(sections.get("fault", ()), start=1):
        if fault.opens is None:
            continue
        try:
            cut_off = islanding(network, fault_of(fault.model_dump()).stages(network))
        except InputError as error:
            cut_off = str(error).removeprefix(f"{network.name}: ")
        if cut_off:
            problems.append(f"fault[{k}].opens = {fault.opens}: {cut_off}")
    return problems


def unknown_hours(sections: Mapping[str, Any], year: Year, network: Network | None) -> list[str]:
    """Periods outside the hours of the profiles; wind at buses that the network does not have."""
    known = set(year.hours.tolist())
    problems = [
        f"period[{k}].hour = {period.hour}: is not among the {len(year)} operating hours "
        f"({year.hours.min()} to {year.hours.max()})."
        for k, period in enumerate(sections.get("period", ()), start=1)
        if isinstance(period.hour, int) and period.hour not in known
    ]
    if network is not None:
        buses = set(network.bus.tolist())
        problems += [
            f"hosting.profiles: wind at bus {bus}: {network.name} has no such bus."
            for bus in year.wind
            if bus not in buses
        ]
    return problems


def unknown_variants(facility: FacilitySection) -> list[str]:
    """Modes that no variant has, parameters that a variant does not have or that lie outside their bounds."""
    from dcvrt import facility as variants

    problems = []
    known = variants.names()
    for mode in facility.modes:
        if mode not in known:
            problems.append(f"facility.modes: no variant {mode!r}.{did_you_mean(mode, known)}")
    for mode in facility.parameters_by_mode:
        if mode not in facility.modes:
            problems.append(
                f"facility.parameters_by_mode.{mode}: is not among "
                f"facility.modes.{did_you_mean(mode, facility.modes)}"
            )
    for mode in facility.modes:
        if mode not in known:
            continue
        rows = _parameters_of(mode)
        own = facility.parameters_by_mode.get(mode, {})
        wrong = _wrong_parameters("facility.parameters", facility.parameters, mode, rows)
        wrong += _wrong_parameters(f"facility.parameters_by_mode.{mode}", own, mode, rows)
        problems += wrong or do_not_go_together("facility.parameters", mode, facility.parameters | own)
    return list(dict.fromkeys(problems))


def wrong_sensitivity(sections: Mapping[str, Any]) -> list[str]:
    """A rating that is not studied; ranges of what no variant has, or that cannot be."""
    from dcvrt import facility as variants
    from dcvrt.planning.sensitivity import CRITERIA

    asked: SensitivitySection | None = sections.get("sensitivity")
    facility: FacilitySection = sections["facility"]
    if asked is None:
        return []
    problems = []
    if asked.beta is not None and asked.beta not in facility.beta:
        problems.append(
            f"sensitivity.beta = {asked.beta:g}: is not among facility.beta = {facility.beta}. Way out: add "
            "it there, or leave it out here."
        )
    if not asked.ranges:
        return problems
    studied = [mode for mode in facility.modes if mode in variants.names()]
    known = _parameters_of_all(studied)
    if not known.keys() | CRITERIA.keys() >= asked.ranges.keys():  # of a variant that is not studied?
        known = _parameters_of_all(variants.names())
    for path, (low, high) in asked.ranges.items():
        where = f'sensitivity.ranges."{path}"'
        if path in SHARED:
            problems.append(f"{where}: is set by the study in every run and is no assumption of a facility.")
            continue
        if path not in known and path not in CRITERIA:
            problems.append(
                f"{where}: no variant has such a parameter.{did_you_mean(path, [*CRITERIA, *known])}"
            )
            continue
        if not low < high:
            problems.append(f"{where} = [{low:g}, {high:g}]: the first value must be below the second.")
            continue
        bounds, unit = (0.0, math.inf), "1"
        if path in known:
            bounds, unit = known[path].bounds, known[path].unit
        elif path == "criteria.loss_share":
            bounds = (0.0, 1.0)
        problems += [
            f"{where}: {outside(path, end, unit, bounds)}"
            for end in (low, high)
            if not bounds[0] <= end <= bounds[1]
        ]
    return problems


def _parameters_of_all(modes: Sequence[str]) -> dict[str, Any]:
    return {path: row for mode in modes for path, row in _parameters_of(mode).items()}


@lru_cache(maxsize=16)
def _parameters_of(mode: str) -> dict[str, Any]:
    """Parameters of a variant that a study file may set, by path."""
    from dcvrt import facility as variants

    return {row.path: row for row in variants.get(mode).compile().parameters if row.path not in SHARED}


def _wrong_parameters(
    table: str, values: Mapping[str, float], mode: str, rows: Mapping[str, Any]
) -> list[str]:
    """Parameters of a table that the study sets itself, that a variant lacks, or that leave their bounds."""
    problems = []
    for path, value in values.items():
        if path in SHARED:
            problems.append(f'{table}."{path}": is set by the study in every run and cannot be fixed here.')
        elif path not in rows:
            problems.append(
                f'{table}."{path}": variant {mode!r} has no such parameter.{did_you_mean(path, rows)}'
            )
        elif not rows[path].bounds[0] <= value <= rows[path].bounds[1]:
            low, high = rows[path].bounds
            problems.append(
                f'{table}."{path}" = {value:g} {rows[path].unit}: is outside [{low:g}, {high:g}].'
            )
    return problems


def profiles_of(hosting: HostingSection, folder: Path) -> Year:
    """The operating hours that the study is about.

    Raises
    ------
    InputError
        When the file of profiles is missing or cannot be used.
    """
    year = _all_hours(hosting, folder)
    return year if hosting.hours is None else year.window(range(*hosting.hours))


def _all_hours(hosting: HostingSection, folder: Path) -> Year:
    from dcvrt.planning import profiles
    from dcvrt.studies.tables import read_profiles

    return profiles.ieee118() if hosting.profiles == "ieee118" else read_profiles(folder / hosting.profiles)


def _in_order(hours: list[int] | None) -> bool:
    return hours is None or 0 <= hours[0] < hours[1]


def _try_profiles(hosting: HostingSection, folder: Path) -> tuple[Year | None, list[str]]:
    try:
        year = _all_hours(hosting, folder)
    except DcvrtError as error:
        return None, [f"hosting.profiles = {hosting.profiles!r}: {error}"]
    if hosting.hours is None:
        return year, []
    if not _in_order(hosting.hours):
        return None, []  # told among the contradictions
    try:
        return year.window(range(*hosting.hours)), []
    except DcvrtError as error:
        return None, [f"hosting.hours = {hosting.hours}: {error}"]


def _repeated(values: Sequence[Any]) -> list[Any]:
    return sorted({value for value in values if values.count(value) > 1})
