"""Hosting plans over ratings and modes: surrogate margins as rows of the hosting programme."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.planning.hosting import HostingProblem
from dcvrt.planning.plan import Plan, Row
from dcvrt.planning.surrogate import Surrogate

NEVER_BINDS = 1e-9
"""Slack, in the unit of the margin, by which a row that holds all over the box is told from one that may
bind."""
GAIN = 1e-6
"""MW by which an earlier plan must be larger to be carried over."""


@dataclass(frozen=True, eq=False)
class SweptPlan:
    """The plan of one method, mode and rating.

    Attributes
    ----------
    method, mode, beta : what it is the plan for.
    plan : the hosting plan.
    closed : sites without a facility, each with the reason.
    carried_from : the smaller rating that the plan was found at, or None. A plan that is feasible at a
        smaller rating stays a candidate: more converter rating never hurts a margin.
    """

    method: str
    mode: str
    beta: float
    plan: Plan
    closed: dict[int, str]
    carried_from: float | None = None


def margin_rows(
    fits: Sequence[Surrogate], sites: Sequence[int], beta: float, d: Mapping[str, float], upper: npt.ArrayLike
) -> tuple[list[Row], dict[int, str]]:
    """Rows of the hosting programme, and the sites that they close whatever the programme does.

    Eq. (embedded_vrt_constraints): every margin of every open site is non-negative in every representative
    period. Rows that hold everywhere in the box are left out.

    Parameters
    ----------
    fits : surrogates of one mode; of those fitted per rating, the ones of `beta`.
    sites : order of the surrogates' slopes.
    beta : rating ratio.
    d : data-centre factor by period.
    upper : upper corner of the sampled box, MW.

    Returns
    -------
    rows, closed : list of Row, dict of site to reason
    """
    box = np.asarray(upper, dtype=float)
    rows: list[Row] = []
    closed: dict[int, str] = {}
    for fit in fits:
        if fit.site in closed:
            continue
        for period in (fit.period,) if fit.period else d:
            if (beta, period) in fit.unknown:
                closed[fit.site] = _why_unknown(fits, fit, period, beta)
                break
            a, lower = fit.at(beta, d[period], sites.index(fit.site))
            if float(np.minimum(a, 0.0) @ box) >= lower + NEVER_BINDS:
                continue
            label = f"{fit.target} at bus {fit.site}, fault {fit.fault}, {period}, {fit.mode}, beta {beta:g}"
            if float(np.maximum(a, 0.0) @ box) < lower:
                closed[fit.site] = f"no capacity in the sampled box passes: {label}"
                break
            coefficients = dict(zip(sites, a.tolist(), strict=True))
            rows.append(
                Row(
                    coefficients,
                    lower,
                    label,
                    site=fit.site,
                    unit=_unit(fit),
                    fault=str(fit.fault),
                    mode=fit.mode,
                    target=fit.target,
                    period=period,
                )
            )
    return [row for row in rows if row.site not in closed], closed


def _unit(fit: Surrogate) -> str:
    """Unit of the margin that a surrogate gives."""
    if fit.target == "voltage":
        return "pu"
    return "MW" if fit.method == "paper" else "share of load"


def _why_unknown(fits: Sequence[Surrogate], fit: Surrogate, period: str, beta: float) -> str:
    """Why a site is closed at a period and rating; the fault is named unless it is so at every fault."""
    same = [f for f in fits if f.site == fit.site and f.period in ("", period)]
    silent = {f.fault: f.unknown[beta, period] for f in same if (beta, period) in f.unknown}
    everywhere = len(silent) == len({f.fault for f in same})
    why = Counter(silent.values()).most_common(1)[0][0] if everywhere else silent[fit.fault]
    fault = "" if everywhere else f"fault {fit.fault}, "
    return f"no margin known at {fault}{period}, {fit.mode}, beta {beta:g}: {why}"


def sweep(
    problem: HostingProblem,
    fits: Sequence[Surrogate],
    modes: Sequence[str],
    betas: Sequence[float],
    d: Mapping[str, float],
    upper: npt.ArrayLike,
    progress: Callable[[str, str, float], None] = lambda method, mode, beta: None,
) -> Iterator[SweptPlan]:
    """Solve the hosting programme for every method, mode and rating, ratings rising.

    Parameters
    ----------
    problem : the hosting programme; its cuts are kept from one solve to the next.
    fits : surrogates of all methods.
    modes, betas : facility modes and rising rating ratios.
    d : data-centre factor by representative period.
    upper : upper corner of the sampled box, MW: plans stay inside it (paper: no extrapolation).

    Yields
    ------
    SweptPlan
    """
    sites = problem.sites
    box = np.asarray(upper, dtype=float)
    for method in dict.fromkeys(fit.method for fit in fits):
        for mode in modes:
            best: SweptPlan | None = None
            for beta in betas:
                progress(method, mode, beta)
                here = [f for f in fits if (f.method, f.mode) == (method, mode) and f.beta in (0.0, beta)]
                rows, closed = margin_rows(here, sites, beta, d, box)
                bounds = {
                    bus: (0.0, 0.0 if bus in closed else float(high))
                    for bus, high in zip(sites, box, strict=True)
                }
                plan = problem.solve(rows=rows, bounds=bounds)
                found = SweptPlan(method, mode, beta, plan, {**plan.closed, **closed})
                if best is not None and best.plan.total_mw > plan.total_mw + GAIN:
                    origin = best.beta if best.carried_from is None else best.carried_from
                    found = SweptPlan(method, mode, beta, best.plan, best.closed, origin)
                best = found
                yield found
