r"""How the hosted capacity moves with the assumptions that it rests on, from gradients.

Where a plan is held by margins b with prices :math:`\pi_b` (MW gained for each unit by which the margin is
relaxed), an assumption a moves the total by

.. math:: \frac{d \sum_i H_i}{da} = \sum_b \pi_b \frac{\partial m_b}{\partial a},

with the derivative of each margin on the waveform of the plan, by one sweep backwards for all assumptions at
once. In the open loop the waveforms at given capacities do not depend on the facility, so there is no further
term. This holds while the same margins bind and the order of events stays: where the network alone holds a
plan, or an event is gained or lost, no gradient tells.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dcvrt.criteria import Criteria, margins
from dcvrt.errors import SimulationError
from dcvrt.planning.cuts import NEVER_BINDS
from dcvrt.planning.exact import Exact
from dcvrt.planning.plan import Row
from dcvrt.planning.replay import simulator_of

if TYPE_CHECKING:
    from dcvrt.dae import ParameterTable
    from dcvrt.integrators import Simulator
    from dcvrt.planning.design import Exposure
    from dcvrt.planning.search import Problem

Floats = npt.NDArray[np.float64]
Key = tuple[str, str, int, int]
"""Period, fault, position of the site and of the target: what one margin is the margin of."""

CRITERIA = {
    "criteria.v_it_min_pu": ("pu", "v_it_min", 1.0, "lowest sustained voltage of the protected bus"),
    "criteria.window_ms": ("ms", "window", 1e-3, "how long the voltage must stay below to count"),
    "criteria.loss_share": ("1", "loss_share", 1.0, "largest loss of import"),
    "criteria.loss_window_ms": ("ms", "loss_window", 1e-3, "how long a loss must last to count"),
}
"""Criteria that are assumptions, by path: unit, field of `Criteria`, factor to the field's unit, meaning."""
LEVELS = {"criteria.v_it_min_pu": ("voltage", -1.0), "criteria.loss_share": ("loss", 1.0)}
"""Criteria that shift every margin of a target alike: the target, and the derivative."""
STEP = 0.01
"""Half the relative step of the central difference that stands for the derivative by a window, over one and
the same run."""


@dataclass(frozen=True)
class Assumption:
    """Something that is not known and that a result rests on.

    Attributes
    ----------
    path : parameter of the facility, or `criteria.` and its field.
    unit, doc, source : what it is, and where its value is from.
    value : in the study.
    low, high : between which it is varied.
    """

    path: str
    unit: str
    doc: str
    source: str
    value: float
    low: float
    high: float

    @property
    def field(self) -> str:
        """Field of `Criteria` that it is, or nothing."""
        return CRITERIA[self.path][1] if self.path in CRITERIA else ""


def illustrative(source: str) -> bool:
    """Whether a source says that the value is our own choice of an example."""
    return "illustrative" in source


def assumptions(
    parameters: ParameterTable,
    criteria: Mapping[str, float],
    change: float,
    ranges: Mapping[str, Sequence[float]],
    leave_out: Iterable[str] = (),
) -> list[Assumption]:
    """Every assumption of a facility and of the criteria.

    Parameters
    ----------
    parameters : of the facility, with the values of the study. Those whose source calls them illustrative
        count, and those that `ranges` names.
    criteria : values by path; all of them count.
    change : relative change to either side where `ranges` names no range; kept within the bounds.
    ranges : lowest and highest value by path.
    leave_out : paths that are no assumptions of the facility, as the rating that the result is for.
    """
    skipped = set(leave_out)
    found = [
        (path, *CRITERIA[path][::3], "illustrative", value, (0.0, 1.0 if path.endswith("share") else 1e9))
        for path, value in criteria.items()
    ]
    found += [
        (row.path, row.unit, row.doc, row.source, row.value, row.bounds)
        for row in parameters
        if row.path not in skipped and (illustrative(row.source) or row.path in ranges)
    ]
    result = []
    for path, unit, doc, source, value, bounds in found:
        low, high = ranges.get(path, sorted((value * (1.0 - change), value * (1.0 + change))))
        low, high = max(low, bounds[0]), min(high, bounds[1])
        result.append(Assumption(path, unit, doc, source, value, low, high))
    return result


@dataclass(frozen=True)
class Priced:
    """A margin that holds a plan.

    Attributes
    ----------
    site : whose facility it is.
    target : `voltage` or `loss`.
    price : MW gained per pu or share by which it is relaxed.
    exposure : POI voltage in the period and under the fault.
    """

    site: int
    target: str
    price: float
    exposure: Exposure


def margin_gradient(
    variant: str,
    paths: Sequence[str],
    exposure: Exposure,
    target: str,
    criteria: Criteria,
    values: Mapping[str, float],
) -> dict[str, float]:
    """Derivatives of one margin by parameters of the facility and by the criteria.

    Parameters
    ----------
    variant : facility variant.
    paths : parameters of the facility, or of `CRITERIA`.
    exposure : what it rides through.
    target : `voltage` or `loss`.
    criteria : what riding through means.
    values : parameters that differ from the variant's own; `beta` and `pf` among them.

    Raises
    ------
    SimulationError
        When the run has no result.
    """
    of_facility = tuple(path for path in paths if path not in CRITERIA)
    given = {**values, "H": 1.0, "d": exposure.d}
    run = _backwards(variant, of_facility).attempt(exposure.waveform, None, **given)
    if not run.completed:
        raise SimulationError(f"sensitivity: the run has no result: {run.status}")
    gradient = dict(getattr(margins(run, criteria), target).grad)
    for path in [path for path in paths if path in CRITERIA]:
        if path in LEVELS:
            moved, derivative = LEVELS[path]
            gradient[path] = derivative if moved == target else 0.0
        else:  # a window
            _, field, scale, _ = CRITERIA[path]
            at = getattr(criteria, field)
            plain = simulator_of(variant, {})(exposure.waveform, None, **given)
            ends = [
                getattr(margins(plain, replace(criteria, **{field: at * factor})), target).value
                for factor in (1.0 - STEP, 1.0 + STEP)
            ]
            gradient[path] = scale * (ends[1] - ends[0]) / (2.0 * STEP * at) if at > 0 else 0.0
    return gradient


@lru_cache(maxsize=8)
def _backwards(variant: str, wrt: tuple[str, ...]) -> Simulator:
    """A simulator whose gradients cost one sweep for all parameters, and nothing to compile."""
    from dcvrt import facility
    from dcvrt.integrators import Simulator

    return Simulator(facility.get(variant).compile(), wrt=wrt, mode="adjoint", save_at=2e-3)


def first_order(binding: Sequence[Priced], gradients: Sequence[Mapping[str, float]], path: str) -> float:
    """Hosted MW per unit of an assumption: prices times derivatives, over the margins that bind."""
    return sum(one.price * gradient[path] for one, gradient in zip(binding, gradients, strict=True))


def resolved(
    problem: Problem,
    H: Floats,
    tangents: Sequence[Exact],
    held_by: Collection[Key],
    shifts: Mapping[Key, float],
    box: Floats,
) -> float:
    """Total of the hosting programme under the tangents at a plan, with some margins shifted, MW.

    What :func:`first_order` is the derivative of, for changes of any size: the network may not let a relaxed
    margin be used up, and a site that a tightened margin would make smaller than nothing closes. Without
    shifts, the margins that hold the plan keep their values, and others may fall to 0. Sites that the plan
    closes stay closed. Voltages agree with AC power flow in the hours that are nearest to their limits.

    Parameters
    ----------
    problem : hosting programme.
    H : array (sites,)
        The plan, MW.
    tangents : margins with total gradients at the plan.
    held_by : margins that hold the plan, each by period, fault, site and target.
    shifts : change of margins; of those that are not named, none.
    box : array (sites,)
        Largest capacities, MW.
    """
    rows = []
    for one in tangents:
        for site, target in itertools.product(np.flatnonzero(H > 0).tolist(), range(2)):
            key, slope = (*one.place, site, target), one.slope[site, target]
            room = (0.0 if key in held_by else float(one.value[site, target])) + shifts.get(key, 0.0)
            lower = float(slope @ H) - room
            if np.isfinite(lower) and np.minimum(slope, 0.0) @ box < lower + NEVER_BINDS:
                coefficients = dict(zip(problem.sites, slope.tolist(), strict=True))
                rows.append(Row(coefficients, lower, str(key), site=problem.sites[site]))
    most = np.where(H > 0, box, 0.0)
    bounds = {bus: (0.0, float(mw)) for bus, mw in zip(problem.sites, most, strict=True)}
    return problem.solve(rows=rows, bounds=bounds, thorough=False).total_mw
