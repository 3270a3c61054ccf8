r"""Stochastic and measured IT workloads, as the normalised multiplier that a facility takes.

The IT power is a superposition of a base, training and fine-tuning components,

.. math::
    P^{IT}(t) = P^{tr,0}(t) + \sum_j P^{tr,j}(t) + \sum_j P^{ft,j}(t),

each alternating between a phase of high and one of low power (paper: eq. (ai_workload)). What is returned is

.. math::
    g(t) = 1 + G \left( \frac{P^{IT}(t)}{\overline{P^{IT}}} - 1 \right)

with a mean of 1 over the record and the gain G that scales the fluctuation: 0 a constant load, 1 as drawn.
Differs: the paper gives no figure for cycles, depths or shares. Cycle times and depths are those of public
measurements where the defaults say so, the rest is illustrative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dcvrt.delimited import read_table
from dcvrt.errors import InputError, raise_all

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Component:
    """One kind of work among the servers.

    Attributes
    ----------
    name : what it is.
    share : share of the IT power while in its high phase, 1.
    cycle : mean duration of a cycle, s; 0 for a component without cycles.
    low : share of the cycle spent in the low phase, 1.
    depth : fall of its power in the low phase, 1.
    jitter : standard deviation of cycle and low-phase durations over their means, 1.
    noise : standard deviation of the short-term perturbation over its power, 1.
    source : where the figures come from.
    """

    name: str
    share: float
    cycle: float = 0.0
    low: float = 0.0
    depth: float = 0.0
    jitter: float = 0.15
    noise: float = 0.01
    source: str = "illustrative"


MEASURED_GPU = "public GPU power measurements (genai-gpu-power-analysis): {}; share illustrative"

DEFAULT = (
    Component("base", share=0.35, noise=0.02),
    Component("training", share=0.35, cycle=13.0, low=0.46, depth=0.16,
              source=MEASURED_GPU.format("checkpoint every 13 s, 5-7 s long, 15-17 % lower")),
    Component("fine-tuning, long cycle", share=0.18, cycle=10.6, low=0.3, depth=0.5,
              source=MEASURED_GPU.format("cycle 10.6 s") + ", phase and depth illustrative"),
    Component("fine-tuning, short cycle", share=0.12, cycle=3.5, low=0.3, depth=0.5,
              source=MEASURED_GPU.format("cycle 3.5 s") + ", phase and depth illustrative"),
)  # fmt: skip
"""The mixture that `synthetic` uses unless told otherwise."""


def synthetic(
    duration: float,
    step: float = 0.05,
    gain: float = 1.0,
    components: Sequence[Component] = DEFAULT,
    seed: int = 0,
) -> tuple[Array, Array]:
    """Draw a workload.

    Parameters
    ----------
    duration : length of the record, s.
    step : time between samples, s.
    gain : scale of the fluctuation around the mean.
    components : what the servers do; see :class:`Component`.
    seed : of the random numbers; the same seed gives the same record, whatever was drawn before.

    Returns
    -------
    t, g : times (s) from 0 to `duration`, and the multiplier, mean 1.

    Raises
    ------
    InputError
        values out of range, or a gain at which the load would turn negative.

    >>> t, g = synthetic(60.0, seed=1)
    >>> len(t), round(float(g.mean()), 9)
    (1201, 1.0)
    """
    problems = []
    if not duration > 0 or not step > 0 or duration < 2 * step:
        problems.append(
            f"duration = {duration:g} s, step = {step:g} s: need step > 0 and duration of two steps at least."
        )
    if gain < 0:
        problems.append(f"gain = {gain:g} is negative.")
    if not components or sum(c.share for c in components) <= 0:
        problems.append("no component has a share above 0.")
    for c in components:
        if min(c.share, c.cycle, c.jitter, c.noise) < 0 or not 0 <= c.low < 1 or not 0 <= c.depth <= 1:
            problems.append(
                f"component {c.name!r}: share, cycle, jitter, noise >= 0, 0 <= low < 1 and 0 <= depth <= 1."
            )
    raise_all(problems, "workload")
    t: Array = step * np.arange(round(duration / step) + 1, dtype=np.float64)
    power: Array = np.zeros(len(t))
    for c, stream in zip(components, np.random.SeedSequence(seed).spawn(len(components)), strict=True):
        power += c.share * _draw(t, c, np.random.default_rng(stream))
    g = 1.0 + gain * (power / power.mean() - 1.0)
    if g.min() < 0:
        highest = 1.0 / (1.0 - power.min() / power.mean())
        raise InputError(
            f"workload: gain = {gain:g} makes the load negative; the highest for this seed is {highest:.3g}."
        )
    return t, g


def _draw(t: Array, c: Component, rng: np.random.Generator) -> Array:
    """Power of one component over its high-phase power: cycles from a random phase, noise of 0.5 s memory."""
    level = np.ones_like(t)
    if c.cycle > 0 and c.low > 0:
        begin = -rng.uniform(0, c.cycle)
        while begin < t[-1]:
            spread = np.maximum(1 + c.jitter * rng.standard_normal(2), 0.1)
            length = c.cycle * spread[0]
            low = min(c.low * c.cycle * spread[1], 0.95 * length)
            level[(t >= begin + length - low) & (t < begin + length)] = 1 - c.depth
            begin += length
    step = t[1] - t[0]
    memory = np.exp(-step / 0.5)
    shocks = rng.standard_normal(len(t))
    noise = np.empty_like(t)
    value = shocks[0]
    for k, shock in enumerate(shocks):
        value = shock if k == 0 else memory * value + np.sqrt(1 - memory**2) * shock
        noise[k] = value
    return np.maximum(level * (1 + c.noise * noise), 0.0)


def measured(
    path: str | Path, time: str | int = 0, power: str | int = 1, gain: float = 1.0
) -> tuple[Array, Array]:
    """Read a measured power trace and normalise it by its mean over time.

    Parameters
    ----------
    path : CSV file, separated by ``,`` ``;`` or tabs, with or without header lines, byte-order mark or
        decimal commas; or a NPY file with two columns.
    time, power : columns, by number from 0 or by header name. Time in s; power in any unit.
    gain : scale of the fluctuation around the mean.

    Returns
    -------
    t, g : times from 0 (s) and the multiplier, mean 1.

    Raises
    ------
    InputError
        file or columns missing, text where a number belongs, NaN, times that do not increase, a gap of more
        than ten times the usual step, a mean that is not positive, a gain that makes the load negative.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        data = _from_npy(path)
        t, p = data[:, 0], data[:, 1]
        lines: NDArray[np.int64] = np.arange(1, len(t) + 1, dtype=np.int64)
    else:
        t, p, lines = _from_csv(path, time, power)
    return _normalise(path, t, p, lines, gain)


def _from_npy(path: Path) -> Array:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file.")
    data = np.load(path, allow_pickle=False)
    if data.ndim != 2 or data.shape[1] != 2:
        raise InputError(
            f"{path}: need an array of two columns, time (s) and power; it has shape {data.shape}."
        )
    return np.asarray(data, dtype=float)


def _from_csv(path: Path, time: str | int, power: str | int) -> tuple[Array, Array, NDArray[np.int64]]:
    table = read_table(path)
    columns = []
    for what in (time, power):
        if isinstance(what, int):
            if not 0 <= what < table.width:
                raise InputError(f"{path}: there is no column {what}; it has {table.width}, numbered from 0.")
            columns.append(what)
        elif what not in table.header:
            raise InputError(
                f"{path}: there is no column {what!r}. "
                f"The columns are: {', '.join(table.header) or 'unnamed'}."
            )
        else:
            columns.append(table.header.index(what))
    data = table.numbers(columns)
    return data[:, 0], data[:, 1], table.lines


def _normalise(path: Path, t: Array, p: Array, lines: NDArray[np.int64], gain: float) -> tuple[Array, Array]:
    if len(t) < 2:
        raise InputError(f"{path}: a trace needs two samples or more; it has {len(t)}.")
    bad = np.flatnonzero(~np.isfinite(t) | ~np.isfinite(p))
    if len(bad):
        raise InputError(
            f"{path}: {len(bad)} sample(s) not finite, first in line {lines[bad[0]]}. Remove or fill them."
        )
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        k = back[0] + 1
        raise InputError(
            f"{path}: times must increase; in line {lines[k]} {t[k]:g} s follows {t[k - 1]:g} s. "
            "Sort or clean the file."
        )
    wide = np.flatnonzero(steps > 10 * np.median(steps))
    if len(wide):
        k = wide[0]
        raise InputError(
            f"{path}: gap of {steps[k]:g} s after {t[k]:g} s (line {lines[k]}); the usual step is "
            f"{np.median(steps):g} s. Fill the gap or give the part before or after it."
        )
    mean = float(np.sum((p[1:] + p[:-1]) / 2 * steps) / (t[-1] - t[0]))
    if mean <= 0:
        raise InputError(
            f"{path}: the mean power is {mean:g}; it must be positive. Is the column the right one?"
        )
    g = 1.0 + gain * (p / mean - 1.0)
    if g.min() < 0:
        raise InputError(
            f"{path}: with gain = {gain:g} the load falls to {g.min():.3g}, below 0. Take a smaller gain."
        )
    return t - t[0], g
