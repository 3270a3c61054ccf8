"""What codes leave open and we had to choose: about the waveforms of trials, and about their verdicts."""

from __future__ import annotations

from dataclasses import dataclass, fields

from dcvrt.errors import did_you_mean, raise_all

OWN = "own"
"""Mark of evidence of whatever rests on these choices."""


def options_of(kind: type, given: dict[str, float]) -> dict[str, float]:
    """Check the names of options.

    Raises
    ------
    InputError
        an unknown name.
    """
    known = [f.name for f in fields(kind)]
    raise_all([f"no option {name!r}.{did_you_mean(name, known)}" for name in given if name not in known],
              "envelope")  # fmt: skip
    return given


@dataclass(frozen=True)
class Choices:
    """What a code leaves open about its waveforms; all values are our own.

    Parameters
    ----------
    depth : place in a band: 1 at its severe edge, 0 at its mild one.
    inside : distance kept from the edges of a band, pu; 0 pu itself is used as it stands.
    inside_hz : the same for frequency, Hz.
    before, after : time at nominal voltage before and after the disturbance, s.
    longest : longest time that one voltage or frequency is held, s; what is required for longer is run for
        this long, and says so.
    open_end : voltage used where a high-voltage band has no upper end, pu.
    ramp : rate at which the frequency goes to a band, Hz/s.
    ramp_time : how long a required rate of change of frequency lasts, s.
    last_step : time of a staircase's last step, s.
    sags, sag_time, gap : number of sags in the trial for counting, their length and distance, s.
    shots, dead_time, shot_voltage : reclosing: number of shots, time between them, s, voltage in them, pu.
    reference_voltage, reference_time : sag for codes that ask for recovery without a voltage curve, pu and s.
    """

    depth: float = 1.0
    inside: float = 1e-3
    inside_hz: float = 0.01
    before: float = 0.5
    after: float = 5.0
    longest: float = 30.0
    open_end: float = 1.20
    ramp: float = 1.0
    ramp_time: float = 0.5
    last_step: float = 5.0
    sags: float = 6
    sag_time: float = 0.10
    gap: float = 5.0
    shots: float = 3
    dead_time: float = 2.0
    shot_voltage: float = 0.0
    reference_voltage: float = 0.40
    reference_time: float = 0.10

    def __post_init__(self) -> None:
        problems = [
            f"{name} = {value:g} must lie in [{low:g}, {high:g}]."
            for name, low, high in (
                ("depth", 0, 1), ("inside", 0, 0.02), ("inside_hz", 0, 0.2), ("before", 0.05, 60),
                ("after", 0.5, 600), ("longest", 0.05, 3600), ("open_end", 1, 2), ("ramp", 0.01, 50),
                ("ramp_time", 0.01, 10), ("last_step", 0.1, 3600), ("sags", 2, 50), ("sag_time", 0.01, 60),
                ("gap", 0.2, 600), ("shots", 1, 20), ("dead_time", 0.1, 600), ("shot_voltage", 0, 1),
                ("reference_voltage", 0, 1), ("reference_time", 0.01, 60),
            )
            if not low <= (value := getattr(self, name)) <= high
        ]  # fmt: skip
        problems += [
            f"{name} = {value:g} must be a whole number."
            for name in ("sags", "shots")
            if (value := getattr(self, name)) != int(value)
        ]
        raise_all(problems, "envelope")

    @classmethod
    def of(cls, **options: float) -> Choices:
        """Choices by name.

        Raises
        ------
        InputError
            an unknown name, a value outside its range.
        """
        return cls(**options_of(cls, options))


@dataclass(frozen=True)
class Yardstick:
    """What a code leaves open about its verdict; all values are our own.

    Parameters
    ----------
    connected_share : share of a constant-current import below which a facility counts as disconnected.
    tolerance : time, s, for which it may be below.
    v_floor : voltage, pu, below which no import is asked for.
    share, above : of the recovery, where a code gives none; `share` of the IT power, too.
    """

    connected_share: float = 0.10
    tolerance: float = 0.020
    v_floor: float = 0.10
    share: float = 0.90
    above: float = 0.90

    def __post_init__(self) -> None:
        raise_all(
            [
                f"{name} = {value:g} must lie in [{low:g}, {high:g}]."
                for name, low, high in (
                    ("connected_share", 0.0, 1.0), ("tolerance", 0.0, 1.0), ("v_floor", 1e-3, 0.5),
                    ("share", 0.0, 1.0), ("above", 0.5, 1.0),
                )
                if not low <= (value := getattr(self, name)) <= high
            ],
            "envelope",
        )  # fmt: skip

    @classmethod
    def of(cls, **options: float) -> Yardstick:
        """Yardstick by name.

        Raises
        ------
        InputError
            an unknown name, a value outside its range.
        """
        return cls(**options_of(cls, options))
