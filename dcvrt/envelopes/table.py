"""What a ride-through code asks for, as data: voltage and frequency bands, recovery, and their evidence."""

from __future__ import annotations

import importlib.resources
import math
import tomllib
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

from dcvrt.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from dcvrt.envelopes.check import Verdict
    from dcvrt.envelopes.trials import Trial
    from dcvrt.trajectory import Trajectory
    from dcvrt.waveform import Waveform

MARKS = {
    "P": "primary text read",
    "P2": "digest that quotes the primary text",
    "S": "secondary source",
    "K": "background knowledge, NOT verified",
    "D": "derived",
    "own": "our choice, no one's standard",
}
"""Marks of evidence, from the strongest on."""


def joined(*marks: str) -> str:
    """All marks of several pieces of evidence, the strongest first.

    >>> joined("P2", "own", "P, P2")
    'P, P2, own'
    """
    found = {mark for several in marks for mark in several.split(", ") if mark}
    return ", ".join(mark for mark in MARKS if mark in found)


@dataclass(frozen=True)
class Note:
    """A sentence with its evidence."""

    text: str
    mark: str


@dataclass(frozen=True)
class Mark:
    """Evidence of a rule that has no number."""

    mark: str


@dataclass(frozen=True)
class Continuous:
    """Voltages, pu, at which a facility stays connected for any time."""

    low: float
    high: float
    mark: str


@dataclass(frozen=True)
class Band:
    """From `mild` to `severe`, pu, stay connected for `time` s after the voltage left the continuous range.

    Without `mild` it is the one level `severe`; without `severe` its far end is not known.
    """

    time: float
    mark: str
    mild: float | None = None
    severe: float | None = None
    approximate: bool = False

    def __str__(self) -> str:
        about = "about " if self.approximate else ""
        if self.severe is None:
            return f"beyond {self.mild:g} pu for {about}{self.time:g} s"
        if self.mild is None:
            return f"{about}{self.severe:g} pu for {self.time:g} s"
        return f"{self.mild:g} to {about}{self.severe:g} pu for {about}{self.time:g} s"


@dataclass(frozen=True)
class FrequencyBand:
    """From `low` to `high`, Hz, stay connected for `time` s in all."""

    low: float
    high: float
    mark: str
    time: float = math.inf


@dataclass(frozen=True)
class Rocof:
    """Rate of change of frequency, Hz/s, to stay connected through."""

    rate: float
    mark: str


@dataclass(frozen=True)
class PhaseJump:
    """Jump of the voltage angle, degrees either way, to stay connected through."""

    degrees: float
    mark: str


@dataclass(frozen=True)
class Staircase:
    """Voltages, pu, that hold from the times, s, on; the time of the last one is not known."""

    times: tuple[float, ...]
    voltages: tuple[float, ...]
    mark: str


@dataclass(frozen=True)
class Reclosing:
    """Shots of an automatic reclosure that last between two times, s."""

    shortest: float
    longest: float
    mark: str


@dataclass(frozen=True)
class Recovery:
    """The import is back at `share` (at most `highest`) of what it was `within` s of V passing `above`, pu.

    What is None is not known.
    """

    within: float
    mark: str
    share: float | None = None
    above: float | None = None
    highest: float | None = None


@dataclass(frozen=True)
class Envelope:
    """What one code asks of a facility; every item carries the mark of its evidence (see :data:`MARKS`).

    Attributes
    ----------
    name, title, jurisdiction, applies_to : what it is and for whom.
    status : how far it is in force; None where that was not recorded.
    kind : ``"envelope"``, or ``"cases"``: a list of tests that are run as they stand.
    side : ``"poi"``, or ``"server"``: a curve for the voltage that the servers get.
    continuous, low, high : voltage range without a time limit, and the bands beyond it, mild to severe.
    frequency, rocof, phase_jump, staircase, reclosing : further things to stay connected through.
    recovery : what the import has to do after a disturbance; None where nothing is known.
    counting_prohibited : evidence that a facility may not leave the grid because of the number of sags.
    notes : what else is known.
    """

    name: str
    title: str
    jurisdiction: str
    applies_to: str
    nominal_hz: float
    status: Note | None = None
    kind: Literal["envelope", "cases"] = "envelope"
    side: Literal["poi", "server"] = "poi"
    continuous: Continuous | None = None
    low: tuple[Band, ...] = ()
    high: tuple[Band, ...] = ()
    frequency: tuple[FrequencyBand, ...] = ()
    rocof: Rocof | None = None
    phase_jump: PhaseJump | None = None
    staircase: Staircase | None = None
    reclosing: Reclosing | None = None
    recovery: Recovery | None = None
    counting_prohibited: Mark | None = None
    notes: tuple[Note, ...] = ()

    @property
    def marks(self) -> str:
        """Every mark of evidence in it, the strongest first."""
        items = (
            self.continuous, *self.low, *self.high, *self.frequency, self.rocof, self.phase_jump,
            self.staircase, self.reclosing, self.recovery, self.counting_prohibited,
        )  # fmt: skip
        return joined(*(item.mark for item in items if item is not None))

    def trials(self, **options: float) -> tuple[Trial, ...]:
        """One trial per item, with its waveform; options as for :class:`~dcvrt.envelopes.choices.Choices`."""
        from dcvrt.envelopes.choices import Choices
        from dcvrt.envelopes.trials import trials_of

        return trials_of(self, Choices.of(**options))

    def waveforms(self, **options: float) -> dict[str, Waveform]:
        """The waveforms of :meth:`trials` by label."""
        return {trial.label: trial.waveform for trial in self.trials(**options)}

    def check(self, run: Trajectory, waveform: Waveform, **options: float) -> Verdict:
        """Judge a response; options as for :class:`~dcvrt.envelopes.choices.Yardstick`."""
        from dcvrt.envelopes.check import check
        from dcvrt.envelopes.choices import Yardstick

        return check(self, run, waveform, Yardstick.of(**options))


KINDS: dict[str, type] = {
    "status": Note, "continuous": Continuous, "low": Band, "high": Band, "frequency": FrequencyBand,
    "rocof": Rocof, "phase_jump": PhaseJump, "staircase": Staircase, "reclosing": Reclosing,
    "recovery": Recovery, "counting_prohibited": Mark, "notes": Note,
}  # fmt: skip


@cache
def shipped() -> dict[str, Envelope]:
    """The envelopes that ship, by name."""
    source = importlib.resources.files("dcvrt") / "data" / "envelopes" / "envelopes.toml"
    codes = tomllib.loads(source.read_text(encoding="utf-8"))
    return {name: envelope_of(name, rows) for name, rows in codes.items()}


def envelope_of(name: str, rows: dict[str, Any]) -> Envelope:
    """Envelope from a table in the form of the data file."""
    return Envelope(name=name, **{key: _item(KINDS.get(key), value) for key, value in rows.items()})


def _item(kind: type | None, value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_item(kind, entry) for entry in value)
    if kind is None or not isinstance(value, dict):
        return value
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in value.items()})


def names() -> tuple[str, ...]:
    """Names of the shipped envelopes.

    >>> names()[0]
    'ercot-nogrr282'
    """
    return tuple(shipped())


def get(name: str) -> Envelope:
    """The envelope `name`.

    Raises
    ------
    InputError
        no envelope has this name.

    Examples
    --------
    >>> [str(band) for band in get("ercot-nogrr282").low][:2]
    ['0.9 to 0.8 pu for 2 s', '0.8 to 0.5 pu for 0.5 s']
    """
    if name not in shipped():
        raise InputError(f"there is no envelope {name!r}.{did_you_mean(name, shipped())}")
    return shipped()[name]
