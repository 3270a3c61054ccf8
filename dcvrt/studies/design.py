"""Design of the facilities at given hosted capacities, for `dcvrt design`: what each site needs, by mode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dcvrt.criteria import Criteria
from dcvrt.errors import InfeasibleError, InputError, SimulationError, did_you_mean, first_sentence, raise_all
from dcvrt.planning import replay
from dcvrt.planning.design import (
    DESIGNED,
    TARGETS,
    Exposure,
    Least,
    Need,
    Trial,
    need,
    parameter_problems,
)
from dcvrt.studies.setting import Setting, criteria

if TYPE_CHECKING:
    from rich.table import Table

RATING_STEP = 0.05
"""Step to which a least rating is rounded up where other parameters are sought with it."""


@dataclass(frozen=True)
class Ask:
    """What is to be designed.

    Attributes
    ----------
    hosting : MW by site; sites that are left out host nothing.
    modes : facility variants.
    parameters : paths; none: converter rating, battery power and DC hold-up, as far as a variant has them.
    rating : rating ratio with which parameters other than it are sought; None: each site's least, rounded up.
    low, high : range; None: the bounds of the parameter.
    engine : simulator of the faults.
    """

    hosting: Mapping[int, float]
    modes: tuple[str, ...]
    parameters: tuple[str, ...]
    rating: float | None
    low: float | None
    high: float | None
    engine: str


@dataclass(frozen=True, eq=False)
class Answer:
    """What one site needs of one parameter.

    Attributes
    ----------
    mode, site, mw : whose need it is.
    rating : rating ratio that it was sought with; None where that is the parameter, or where there is none.
    need : the search with its replay; None where it was not sought.
    exposures : what the site is exposed to.
    """

    mode: str
    site: int
    mw: float
    parameter: str
    rating: float | None
    need: Need | None
    exposures: tuple[Exposure, ...]

    @property
    def value(self) -> float | None:
        """The least value, where there is one that the replay confirms."""
        return self.need.least.value if self.need is not None and self.need.passes else None

    @property
    def why(self) -> str:
        """What the answer rests on, or what stands against one."""
        if self.need is None:
            return "not sought: no rating passes"
        return reason(self.need, self.exposures)

    def as_data(self) -> dict[str, Any]:
        """Plain data, for `--json`."""
        data: dict[str, Any] = {
            "mode": self.mode,
            "site": self.site,
            "mw": self.mw,
            "parameter": self.parameter,
            "rating": self.rating,
            "value": self.value,
            "why": self.why,
        }
        if self.need is None:
            return data
        least = self.need.least
        return data | {
            "unit": self.need.unit,
            "ends_at": least.ends_at,
            "fails_above": list(least.fails_above),
            "runs": least.runs,
            "confirmed": self.need.confirmed,
            "replay": [_trial(trial, self.exposures) for trial in self.need.replayed],
            "best": None if least.value is not None else _trial(least.fails, self.exposures),
        }


# -- questions -----------------------------------------------------------------------------------------------


def hosting_of(texts: Sequence[str]) -> tuple[dict[int, float], list[str]]:
    """Capacities from texts SITE=MW, several of them separated by commas, and what is wrong with them.

    >>> hosting_of(["21=30,75=150"])
    ({21: 30.0, 75: 150.0}, [])
    """
    found: dict[int, float] = {}
    problems = []
    for text in [part.strip() for given in texts for part in given.split(",")]:
        site, equals, value = (part.strip() for part in text.partition("="))
        try:
            bus, mw = int(site), float(value) if equals else math.nan
        except ValueError:
            bus, mw = 0, math.nan
        if math.isnan(mw):
            problems.append(f"--hosting {text}: write SITE=MW, for example --hosting 21=30,75=150.")
        elif bus in found:
            problems.append(f"--hosting {text}: site {bus} has a capacity already. Way out: give it once.")
        else:
            found[bus] = mw
    return found, problems


def problems_of(ask: Ask, setting: Setting) -> list[str]:
    """Everything that is wrong with a question, one line each."""
    from dcvrt import facility as variants

    problems = []
    for bus, mw in ask.hosting.items():
        if bus not in setting.sites:
            problems.append(f"--hosting {bus}={mw:g}: no candidate site.{did_you_mean(bus, setting.sites)}")
        elif not (math.isfinite(mw) and mw >= 0):
            problems.append(f"--hosting {bus}={mw:g}: must be a number of MW, at least 0.")
    if ask.hosting and not any(mw > 0 for mw in ask.hosting.values()) and not problems:
        problems.append("--hosting: nothing is hosted, so there is no facility to design.")
    known = variants.names()
    problems += [
        f"--mode {mode}: no such variant.{did_you_mean(mode, known)}"
        for mode in ask.modes
        if mode not in known
    ]
    # Where none is known, the modes of the study tell what else is wrong, so that all is told at once.
    for mode in [mode for mode in ask.modes if mode in known] or setting.file.facility.modes:
        dae = replay.simulator_of(mode, {}).dae
        for parameter in ask.parameters:
            problems += [
                f"--parameter {line}" for line in parameter_problems(dae, mode, parameter, ask.low, ask.high)
            ]
        if ask.rating is not None:
            problems += [f"--beta: {line}" for line in _refused(dae, ask.rating)]
    if len(ask.parameters) != 1 and (ask.low is not None or ask.high is not None):
        problems.append("--low, --high: of which parameter? Way out: name one with --parameter.")
    if ask.rating is not None and ask.parameters == ("beta",):
        problems.append("--beta: is what is sought. Way out: leave it out, or seek another --parameter.")
    if ask.engine not in ("native", "andes"):
        problems.append(
            f"--engine {ask.engine}: no such simulator.{did_you_mean(ask.engine, ['andes', 'native'])}"
        )
    return list(dict.fromkeys(problems))


def _refused(dae: Any, rating: float) -> list[str]:
    try:
        dae.parameter_values(beta=rating)
    except InputError as error:
        return str(error).splitlines()
    return []


# -- answers -------------------------------------------------------------------------------------------------


def design(setting: Setting, ask: Ask) -> list[Answer]:
    """What the facilities need at given capacities.

    Parameters
    ----------
    setting : hosting programme and periods of a study.
    ask : capacities, variants, parameters.

    Returns
    -------
    list of Answer
        By mode, site and parameter.

    Raises
    ------
    InputError
        Everything that is wrong with the question.
    InfeasibleError
        The grid has no operating point at these capacities.
    SimulationError
        A fault that has no waveform: nothing can be said of any site then.
    """
    raise_all(problems_of(ask, setting), "design")
    exposures = exposures_of(setting, ask)
    answers = []
    for mode in ask.modes:
        has = replay.simulator_of(mode, {}).dae.p_names
        asked = ask.parameters or tuple(path for path in DESIGNED if path in has)
        for site in setting.sites:
            if ask.hosting.get(site, 0.0) > 0:
                answers += _of_site(setting, ask, mode, site, asked, exposures[site])
    return answers


def exposures_of(setting: Setting, ask: Ask) -> dict[int, tuple[Exposure, ...]]:
    """POI voltages of every site under all faults in all periods: one simulation of the grid for each."""
    H = [ask.hosting.get(bus, 0.0) for bus in setting.sites]
    found: dict[int, list[Exposure]] = {bus: [] for bus in setting.sites}
    impossible: list[str] = []
    lost: list[str] = []
    for period in setting.periods:
        for fault, waveforms, status in replay.fault_runs(setting.request(H, period, [], engine=ask.engine)):
            if waveforms is None:
                # A status that names no fault is that of the operating point, from which none could start.
                (lost if fault in status else impossible).append(status)
                continue
            for bus, waveform in waveforms.items():
                found[bus].append(Exposure(period, fault, waveform, setting.d[period]))
    raise_all(list(dict.fromkeys(impossible)), "design", InfeasibleError)
    raise_all(lost, "design", SimulationError)
    return {bus: tuple(there) for bus, there in found.items()}


def _of_site(
    setting: Setting,
    ask: Ask,
    mode: str,
    site: int,
    parameters: Sequence[str],
    exposures: tuple[Exposure, ...],
) -> list[Answer]:
    file, mw = setting.file, ask.hosting[site]
    values = file.facility.parameters | file.facility.parameters_by_mode.get(mode, {})

    def sought(parameter: str, rating: float | None) -> Answer:
        low, high = (ask.low, ask.high) if parameter in ask.parameters else (None, None)
        others = {path: value for path, value in values.items() if path != parameter}
        found = need(
            mode,
            exposures,
            parameter,
            pf=file.hosting.pf,
            criteria=Criteria(**criteria(file)),
            low=low,
            high=high,
            values=others if rating is None else others | {"beta": rating},
        )
        return Answer(mode, site, mw, parameter, rating, found, exposures)

    rating, of_rating = ask.rating, None
    if rating is None or "beta" in parameters:
        of_rating = sought("beta", None)
    if rating is None and of_rating is not None and of_rating.value is not None:
        rating = RATING_STEP * math.ceil(of_rating.value / RATING_STEP - 1e-9)
    answers = []
    for parameter in parameters:
        if parameter == "beta" and of_rating is not None:
            answers.append(of_rating)
        elif rating is None:
            answers.append(Answer(mode, site, mw, parameter, None, None, exposures))
        else:
            answers.append(sought(parameter, rating))
    return answers


# -- in words ------------------------------------------------------------------------------------------------


def reason(found: Need, exposures: Sequence[Exposure]) -> str:
    """What an answer rests on, or why there is none."""
    least = found.least
    if least.value is None:
        assert least.fails is not None
        return (
            f"no value tried from {least.low:g} to {least.high:g} passes; nearest at "
            f"{least.fails.value:g}: {_shortfall(least.fails, least.at, exposures)}"
        )
    if not found.passes:
        trial = found.replayed[0]
        return f"the replay fails at {trial.value:.6g}: {_shortfall(trial, trial.worst, exposures)}"
    k, target = least.at
    where = f"{TARGETS[target]}, fault {exposures[k].fault}, {exposures[k].period}"
    text = {
        "range": "the low end of the range passes",
        "margin": where,
        "jump": f"{where}: the margin jumps",
        "sequence": "",
    }[least.ends_at]
    if least.ends_at == "sequence":
        assert least.fails is not None
        text = (
            f"fault {exposures[k].fault}, {exposures[k].period}: events change; below: "
            f"{_course(least.fails, k)}"
        )
    if not found.confirmed:
        text += "; just below it the replay passes too"
    if least.fails_above:
        text += f"; fails again at {', '.join(f'{value:g}' for value in least.fails_above)}"
    return text


def _shortfall(trial: Trial, at: tuple[int, int], exposures: Sequence[Exposure]) -> str:
    k, target = at
    margin = trial.margin[at]
    said = "" if np.isnan(margin) else f"{TARGETS[target]} margin {margin:+.4f}, "
    return f"{said}fault {exposures[k].fault}, {exposures[k].period}, {_course(trial, k)}"


def _course(trial: Trial, k: int) -> str:
    """Modes that a run passed through, or how it ended where it has no result."""
    if not trial.sequence[k]:
        return first_sentence(trial.status[k])
    return ">".join(replay.modes_passed(trial.sequence[k]))


def _trial(trial: Trial | None, exposures: Sequence[Exposure]) -> dict[str, Any] | None:
    if trial is None:
        return None
    k, target = trial.worst
    margin = float(trial.margin[k, target])
    return {
        "value": trial.value,
        "passed": trial.passed,
        "target": TARGETS[target],
        "margin": None if math.isnan(margin) else margin,
        "fault": exposures[k].fault,
        "period": exposures[k].period,
        "course": _course(trial, k),
    }


FOOTER = """\
Margins by the replay: voltage in pu, loss as a share of the import. Each
parameter alone, the others as in the study. Where events change or a margin
jumps, gradients say nothing; the value is the side that was run and passed.
Open loop: a facility does not act back on the grid in a fault.
Whether the grid can carry these capacities otherwise is a question to a study."""


def header(setting: Setting, ask: Ask) -> str:
    """What was asked, in two lines."""
    hosted = ", ".join(f"bus {bus}: {ask.hosting[bus]:g} MW" for bus in setting.sites if ask.hosting.get(bus))
    file = setting.file
    return (
        f"{file.study.name}\n{hosted}; {len(file.fault)} fault(s) in {len(file.period)} period(s), "
        f"simulated by {ask.engine}"
    )


def table_of(answers: Sequence[Answer]) -> Table:
    """One row for each answer: least value with its margin, the value just below with its own, and what
    decides."""
    from rich import box
    from rich.table import Table

    shown = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading in ("mode", "bus", "MW", "parameter", "beta", "least", "just below"):
        right = heading in ("bus", "MW", "beta", "least", "just below")
        shown.add_column(heading, no_wrap=True, justify="right" if right else "left")
    shown.add_column("what decides")
    for answer in answers:
        found = answer.need
        unit = "" if found is None or found.unit == "1" else f"\n{found.unit}"
        cells = ["none", ""]
        if found is not None and answer.value is not None:
            cells[: len(found.replayed)] = [_cell(trial, found.least) for trial in found.replayed]
        shown.add_row(
            answer.mode,
            str(answer.site),
            f"{answer.mw:g}",
            f"{answer.parameter}{unit}",
            "" if answer.rating is None else f"{answer.rating:g}",
            *cells,
            answer.why,
        )
    return shown


def _cell(trial: Trial, least: Least) -> str:
    """A value over the margin that decides, or that there is no result."""
    margin = trial.margin[least.at] if least.ends_at == "margin" else trial.margin[trial.worst]
    return f"{trial.value:#.4g}\n" + ("no result" if np.isnan(margin) else f"{margin:+.5f}")
