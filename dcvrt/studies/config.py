"""The study file: what a study consists of, read from TOML, with every fault of the file reported at once.

Units stand in the names (`t_clear_ms`, `h_max_mw`). What a field alone can get wrong is declared here; what
only the fields together, or the network, can tell is in :mod:`dcvrt.studies.checks`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from copy import deepcopy
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from dcvrt.errors import InputError, did_you_mean, raise_all

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(gt=0, lt=1)]
ShareOrAll = Annotated[float, Field(ge=0, le=1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Section(BaseModel):
    """A table of the study file: unknown fields are refused, nothing is converted silently."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, populate_by_name=True)


class StudySection(Section):
    """`[study]`: what it is called, and the seed that every random choice follows from."""

    name: str = Field(min_length=1, description="title of tables, figures and the report")
    seed: int = Field(
        default=1, ge=0, description="seed of the samples and of the split into fitting and validation"
    )


class GridSection(Section):
    """`[grid]`: the network, where data centres may connect, and how faults are simulated."""

    case: str = Field(min_length=1, description="'ieee118' or the path of a case with dynamic data")
    dynamics: str | None = Field(
        default=None, description="path of the dynamic data, where the case keeps them apart (.dyr)"
    )
    sites: list[int] = Field(min_length=1, description="candidate buses")
    engine: Literal["native", "andes"] = Field(
        default="native", description="simulator of the faults of samples and searches"
    )
    coupling: Literal["open", "closed"] = Field(
        default="open",
        description="'closed': samples and searches simulate facilities in the network, and a plan passes "
        "only if it rides through there too; 'open': told of every plan",
    )
    t_end_s: Positive = Field(default=2.0, description="length of every fault simulation")
    step_s: float = Field(default=1 / 120, gt=0, le=0.05, description="step of the fault simulation")
    redispatch: Literal["proportional", "slack"] = Field(
        default="proportional",
        description="who supplies the hosted load: all scheduled units, or the one at the slack bus",
    )


class HostingSection(Section):
    """`[hosting]`: the operating hours and the limits of normal operation."""

    profiles: str = Field(
        default="ieee118", description="'ieee118' or the path of a CSV: hour, load, dc, wind_<bus>_mw"
    )
    hours: list[int] | None = Field(
        default=None, min_length=2, max_length=2, description="first hour and the one after the last"
    )
    pf: float = Field(default=0.98, gt=0, le=1, description="power factor of the data centres")
    rating_scale: Positive = Field(default=0.6, description="factor on every branch rating")
    v_min_pu: Positive = Field(default=0.94, description="lowest voltage in normal operation")
    v_max_pu: Positive = Field(default=1.06, description="highest voltage in normal operation")
    reactive_limits: bool = Field(
        default=True,
        description="whether units keep within their reactive limits, in normal operation and before a fault",
    )
    h_max_mw: NotNegative | list[NotNegative] = Field(
        default=500.0, description="largest capacity of a site: one number, or one for every site"
    )
    min_size_mw: NotNegative | list[NotNegative] = Field(
        default=0.0, description="smallest capacity that is worth opening a site: one number, or one a site"
    )
    n1_rating_factor: Positive | None = Field(
        default=None,
        description="factor on the ratings that holds after the outage of any one branch; default: outages "
        "are not looked at",
    )
    base_violations: Literal["error", "hold"] = Field(
        default="error",
        description="voltages outside the limits with nothing hosted: refused, or 'hold': they must only not "
        "get worse",
    )


class FaultEntry(Section):
    """`[[fault]]`: a three-phase fault at a bus, cleared by itself or by opening a branch."""

    bus: int = Field(description="bus at fault; not a candidate bus")
    t_start_s: Positive = Field(default=0.2, description="inception; the simulation begins before it")
    t_clear_ms: Positive = Field(default=100.0, description="time from inception to clearing")
    x_pu: Positive = Field(default=1e-4, description="fault reactance on the system base")
    opens: list[int] | None = Field(
        default=None,
        min_length=2,
        max_length=2,
        description="ends of the branch that opens with clearing and stays open; default: none does",
    )


class PeriodEntry(Section):
    """`[[period]]`: an operating hour that every fault is simulated in."""

    name: str = Field(min_length=1, description="what tables call it")
    hour: int | Literal["peak", "median", "light"] = Field(
        description="hour of the profiles, or the hour of highest, middle or lowest net load"
    )


class FacilitySection(Section):
    """`[facility]`: which variants are compared, over which ratings, with which parameters."""

    modes: list[str] = Field(default=["gfl", "gfm"], min_length=1, description="facility variants")
    beta: list[Positive] = Field(
        default=[1.0, 1.05, 1.1, 1.15, 1.2, 1.25, 1.3, 1.35, 1.4, 1.45, 1.5],
        min_length=1,
        description="converter ratings over hosted capacity, rising",
    )
    parameters: dict[str, Finite] = Field(
        default={}, description="values other than the default, by path, all modes"
    )
    parameters_by_mode: dict[str, dict[str, Finite]] = Field(
        default={}, description="values for one mode only; the report lists them"
    )


class CriteriaSection(Section):
    """`[criteria]`: what riding through means."""

    v_it_min_pu: Positive = Field(default=0.90, description="lowest sustained voltage of the protected bus")
    window_ms: Positive = Field(
        default=20.0, description="how long the voltage must stay below to count as sustained"
    )
    loss_share: Share = Field(
        default=0.25, description="largest loss of import, as a share of the import before the fault"
    )
    loss_window_ms: NotNegative = Field(
        default=40.0, description="how long a loss must last to count; 0: the instantaneous peak"
    )
    voltage_criterion: Literal["sustained", "instantaneous"] = Field(
        default="sustained", description="'instantaneous' is the plain minimum, as the paper prints it"
    )


class SamplingSection(Section):
    """`[sampling]`: the hosting vectors that the surrogates learn from."""

    n: int = Field(default=32, ge=6, le=4096, description="number of hosting vectors")
    validation_share: Share = Field(default=0.25, description="share of them kept out of the fit")
    gradients: bool = Field(
        default=False,
        description="derivatives of the sampled margins too, for margins as the least of affine pieces",
    )
    high_share: float = Field(
        default=0.5, ge=0, le=1, description="share of them drawn from the high-capacity region"
    )
    high_from: float = Field(
        default=0.6, ge=0, lt=1, description="where that region starts, as a share of the sampled box"
    )
    h_max_mw: list[NotNegative] | None = Field(
        default=None,
        description="upper corner of the sampled box by site; default: the plan without ride-through",
    )


class SurrogateSection(Section):
    """`[surrogate]`: how margins become rows of the hosting programme."""

    methods: list[Literal["paper", "share"]] = Field(
        default=["paper", "share"], min_length=1, description="fits to compare"
    )


class FrontierSection(Section):
    """`[frontier]`: the search for the largest plan that passes."""

    search: bool = Field(default=True, description="whether it is searched; needs grid.engine = 'native'")
    samples: int = Field(default=2, ge=2, le=4096, description="coarse hosting vectors that it starts from")
    gain: Share = Field(default=0.005, description="share of the total that is not worth another candidate")
    trust: Share = Field(
        default=0.10, description="radius of the trust region, as a share of the largest site"
    )
    candidates: int = Field(
        default=40, ge=1, description="hosting vectors that a mode and rating may try before it is given up"
    )


class SystemLimitSection(Section):
    """`[system_limit]`: plans whose sites may fail singly, within a limit on the load lost at once."""

    loss_mw: list[NotNegative] = Field(
        default=[], description="limits on the load that all sites together lose in one fault, MW, rising"
    )
    loss_share: list[ShareOrAll] = Field(
        default=[], description="limits as a share of the hosted load before the fault, rising"
    )
    beta: list[Positive] | None = Field(
        default=None, min_length=1, description="ratings that are tried; default: all of facility.beta"
    )


class ReplaySection(Section):
    """`[replay]`: the simulation that has the last word on every plan."""

    engine: Literal["native", "andes"] = Field(default="andes", description="simulator of the faults")


class RunSection(Section):
    """`[run]`: limits of the run itself; they change no result."""

    task_timeout_s: Positive = Field(
        default=600.0, description="longest time for all faults of one hosting vector and period"
    )
    tries: int = Field(
        default=3, ge=1, description="how often a task may kill its worker before it is set aside"
    )


class SensitivitySection(Section):
    """`[sensitivity]`: how far the hosted capacity moves with the assumptions that are illustrative."""

    beta: Positive | None = Field(
        default=None,
        description="rating whose plan is looked at; default: for each mode, the largest of the plans that a "
        "margin holds",
    )
    change: Share = Field(default=0.2, description="relative change of every assumption, to either side")
    ranges: dict[str, Annotated[list[Finite], Field(min_length=2, max_length=2)]] = Field(
        default={},
        description="lowest and highest value instead, by path, as criteria.loss_share",
    )
    reruns: int = Field(
        default=3, ge=0, description="assumptions per mode for which the frontier is searched again"
    )


class StudyFile(BaseModel):
    """A whole study file."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, populate_by_name=True, title="dcvrt study"
    )

    study: StudySection
    grid: GridSection
    hosting: HostingSection = HostingSection()
    facility: FacilitySection = FacilitySection()
    criteria: CriteriaSection = CriteriaSection()
    sampling: SamplingSection = SamplingSection()
    surrogate: SurrogateSection = SurrogateSection()
    frontier: FrontierSection = FrontierSection()
    system_limit: SystemLimitSection = SystemLimitSection()
    replay: ReplaySection = ReplaySection()
    sensitivity: SensitivitySection = SensitivitySection()
    run: RunSection = RunSection()
    fault: list[FaultEntry] = Field(min_length=1, description="the faults that every site must ride through")
    period: list[PeriodEntry] = Field(min_length=1, description="the hours they are simulated in")

    def canonical(self) -> dict[str, Any]:
        """Everything that decides a plan of the study, as plain data: `[run]`, the name, `[system_limit]` and
        `[sensitivity]` do not.

        System limits and sensitivities are asked once the plans are there, so that a folder may be asked
        again for others.
        """
        data = self.model_dump(mode="json")
        del data["run"], data["sensitivity"], data["system_limit"], data["study"]["name"]
        return data

    def quick(self) -> StudyFile:
        """The same study with less of what takes time, to see within minutes that all of it works.

        Fewer samples, periods, ratings and reruns, system limits at one of the ratings that they are asked
        for; every fault, site and mode. The numbers are coarser, and a folder made this way is not continued
        by a full run.
        """
        beta = self.facility.beta
        few = sorted({beta[0], beta[len(beta) // 3], beta[(2 * len(beta)) // 3], beta[-1]})
        limits = self.system_limit
        near = [min(few, key=lambda b: abs(b - wanted)) for wanted in limits.beta or []]
        ends = self.period if len(self.period) < 3 else [self.period[0], self.period[-1]]
        return self.model_copy(
            update={
                "sampling": self.sampling.model_copy(update={"n": min(self.sampling.n, 10)}),
                "facility": self.facility.model_copy(update={"beta": few}),
                "period": ends,
                "system_limit": limits.model_copy(update={"beta": near[len(near) // 2 :][:1] or None}),
                "sensitivity": self.sensitivity.model_copy(
                    update={"beta": None, "reruns": min(self.sensitivity.reruns, 1)}
                ),
            }
        )


def template() -> str:
    """The commented study file of the IEEE-118 study, which `dcvrt study new` writes."""
    return (resources.files("dcvrt.studies") / "ieee118.toml").read_text(encoding="utf-8")


def schema() -> str:
    """JSON Schema of the study file, for editors that complete and check while typing."""
    return json.dumps(StudyFile.model_json_schema(), indent=2)


def read(text: str, where: str) -> tuple[StudyFile | None, dict[str, Any], set[str], list[str]]:
    """Read the text of a study file as far as it can be read.

    Returns
    -------
    file : StudyFile or None
        None when something is wrong.
    sections : dict
        For the checks across fields: sections that can be without the fields that are wrong by themselves.
    withheld : set of str
        These fields, and those that unknown ones were meant for: nothing is to be said of them.
    problems : list of str
        One line each, starting with the path of the field.

    Raises
    ------
    InputError
        When the text is not TOML, with line and column.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: not a TOML file: {error}.") from None
    problems = [
        f"{key}: unknown table.{did_you_mean(key, StudyFile.model_fields)}"
        for key in raw
        if key not in StudyFile.model_fields
    ]
    sections: dict[str, Any] = {}
    withheld: set[str] = set()
    for name in StudyFile.model_fields:
        try:
            sections[name] = _one_field(name, raw)
        except ValidationError as error:
            problems += _merged([_sentence(name, raw, item) for item in error.errors()])
            rest, wrong = _without_wrong_fields(name, raw, error)
            withheld |= wrong
            if rest is not None:
                sections[name] = rest
    return (None if problems else StudyFile(**sections)), sections, withheld, problems


def load(text: str, where: str) -> StudyFile:
    """Read a study file; all that its fields get wrong is one error.

    >>> load('[study]\\nname = "x"', "my.toml")
    Traceback (most recent call last):
    dcvrt.errors.InputError: my.toml: 3 problems
      grid: this table is required.
      fault: at least one [[fault]] is required.
      period: at least one [[period]] is required.
    """
    file, _, _, problems = read(text, where)
    raise_all(problems, where)
    assert file is not None
    return file


def _one_field(name: str, raw: Mapping[str, Any]) -> Any:
    """Validate one top-level table by itself, so that one bad table does not hide the others' faults."""
    field = StudyFile.model_fields[name]
    if name not in raw and not field.is_required():
        return field.get_default()
    kind: Any = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    return TypeAdapter(kind).validate_python(raw.get(name, _Missing))


def _without_wrong_fields(name: str, raw: Mapping[str, Any], error: ValidationError) -> tuple[Any, set[str]]:
    """A table without the fields that are wrong by themselves, and their names; None where it needs them."""
    data: Any = deepcopy(raw.get(name))
    wrong: set[str] = set()
    for item in error.errors():
        path: list[Any] = list(item["loc"])
        entry = data
        if isinstance(data, list) and path and isinstance(path[0], int):
            entry = data[path.pop(0)]
        if not path or not isinstance(entry, dict):
            return None, set()
        entry.pop(path[0], None)
        wrong.add(str(path[0]))
        if item["type"] == "extra_forbidden":
            wrong.update(get_close_matches(str(path[0]), _known_fields(name), n=1))
    try:
        return _one_field(name, {name: data}), wrong
    except ValidationError:
        return None, set()


class _Missing:
    """Stands for a table that is not there: fails every validation."""


_LIMITS = {
    "greater_than": ("gt", "must be above"),
    "greater_than_equal": ("ge", "must be at least"),
    "less_than": ("lt", "must be below"),
    "less_than_equal": ("le", "must be at most"),
}
_WANTED = {
    "string_type": "text in quotes",
    "int_type": "a whole number",
    "float_type": "a number",
    "list_type": "a list [..]",
    "dict_type": "a table",
    "finite_number": "a finite number",
    "model_type": "a table",
    "bool_type": "true or false",
}


def _sentence(name: str, raw: Mapping[str, Any], item: Mapping[str, Any]) -> str:
    """One problem, in our words: path = value: what is wrong, and the way out where one can be named."""
    steps = [
        step
        for step in item["loc"]
        if step not in ("int", "constrained-str") and not str(step).startswith("literal[")
    ]
    path = name + "".join(f"[{step + 1}]" if isinstance(step, int) else f".{step}" for step in steps)
    kind, context = item["type"], item.get("ctx", {})
    if not item["loc"] and item["input"] is _Missing:
        return (
            f"{name}: at least one [[{name}]] is required."
            if name in ("fault", "period")
            else f"{name}: this table is required."
        )
    if kind == "extra_forbidden":
        return f"{path}: unknown field.{did_you_mean(steps[-1], _known_fields(name))}"
    if kind == "missing":
        return f"{path}: required."
    value = f"{path} = {item['input']!r}"
    if kind in _LIMITS:
        key, words = _LIMITS[kind]
        return f"{value}: {words} {context[key]:g}."
    if kind == "too_short":
        entries = "entry" if context["min_length"] == 1 else "entries"
        return f"{path}: needs at least {context['min_length']} {entries}."
    if kind == "too_long":
        return f"{path}: takes at most {context['max_length']} entries."
    if kind == "literal_error":
        return f"{value}: must be {context['expected']}."
    if kind in _WANTED:
        return f"{value}: must be {_WANTED[kind]}."
    return f"{value}: {item['msg'][0].lower()}{item['msg'][1:]}."


def _merged(sentences: list[str]) -> list[str]:
    """One line for a field that may be of two kinds and is of neither."""
    merged: dict[str, list[str]] = {}
    for sentence in sentences:
        field, _, rule = sentence.partition(": must be ")
        merged.setdefault(field if rule else sentence, []).append(rule)
    return [
        field + (": must be " + ", or ".join(rule.rstrip(".") for rule in rules) + "." if rules[0] else "")
        for field, rules in merged.items()
    ]


def _known_fields(name: str) -> list[str]:
    entries = {"fault": FaultEntry, "period": PeriodEntry}
    entry: Any = entries.get(name, StudyFile.model_fields[name].annotation)
    return list(entry.model_fields)


def read_text(path: Path) -> str:
    """Text of a study file; raises `InputError` when there is no such file or it is not UTF-8."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(
            f"{path}: no such study file. Way out: 'dcvrt study new {path}' writes one to edit."
        ) from None
    except IsADirectoryError:
        raise InputError(
            f"{path} is a folder, not a study file. Way out: name the TOML file in it."
        ) from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}). Way out: save it as UTF-8.") from None
