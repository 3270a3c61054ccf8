r"""Affine lower bounds of the ride-through margins, for the hosting programme.

Two forms are fitted to the same samples:

`paper`   eq. (linear_vrt_surrogate): one fit per site, fault, mode and target over all periods and ratings,

    .. math:: \hat m = a + \sum_j b_j d_t H_j + c\, \beta H_i - \delta

    with the loss margin in MW and the voltage margin in pu.
    Differs: c is kept from going below 0 (`scipy.optimize.lsq_linear`). More converter rating never hurts a
    margin, and with that the capacity never falls as beta rises.

`share`   natural variables: one fit per site, fault, mode, target and beta, the loss margin as a share of the
    import, with an intercept of its own for each period,

    .. math:: \hat m_t = a_t + \sum_j b_j d_t H_j - \delta_t

Both are tightened by the largest overprediction on the fitting set (eqs. (surrogate_overprediction),
(surrogate_tightening)). A run that failed has no margin: it is left out of every fit and counted in
`n_excluded`. Where no run of a rating and period has a margin, or too few have one for a fit, the surrogate
says nothing and the site counts as one that does not pass (`Surrogate.unknown`). A run of the validation set
that failed where the surrogate does say something has no error either, but counts in the violation rate: as
a false pass when the surrogate passes it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError, first_sentence, raise_all

Floats = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

TARGETS = ("voltage", "loss")


# -- one fit -------------------------------------------------------------------------------------------------


def least_squares(x: Floats, m: Floats, not_negative: Sequence[int] = ()) -> Floats:
    """Coefficients k that minimise |x k - m|, some of them kept from going below 0.

    Columns are scaled to unit length first, so that MW and pu regressors weigh alike; columns that depend on
    each other share the effect (the solution of least norm in the scaled variables).

    >>> x = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    >>> least_squares(x, np.array([1.0, 3.0, 5.0])).round(9).tolist()
    [1.0, 2.0]
    """
    from scipy.optimize import lsq_linear

    scale = np.linalg.norm(x, axis=0)
    scale[scale == 0.0] = 1.0
    free, *_ = np.linalg.lstsq(x / scale, m, rcond=1e-10)
    if all(free[k] >= 0.0 for k in not_negative):
        return np.asarray(free / scale)
    lower = np.full(x.shape[1], -np.inf)
    lower[list(not_negative)] = 0.0
    bounded = lsq_linear(x / scale, m, bounds=(lower, np.inf), method="bvls", tol=1e-12)
    return np.asarray(bounded.x / scale)


def overprediction(predicted: Floats, m: Floats) -> float:
    """Largest amount by which a prediction exceeds its margin; 0 where none does. Eq.
    (surrogate_overprediction)."""
    return float(np.maximum(predicted - m, 0.0).max(initial=0.0))


@dataclass(frozen=True)
class Scores:
    """How a tightened surrogate does on points that it has not seen.

    Attributes
    ----------
    n : number of points whose simulation has a margin; errors are taken over these.
    n_failed : number of further points, whose simulation failed.
    mae, rmse : mean absolute and root-mean-square error.
    worst_over, worst_under : largest amount predicted above and below the true margin; 0 where there is none.
    violation_rate : false passes over all `n + n_failed` points: predicted to pass (>= 0), and the margin is
        negative or the simulation failed.
    """

    n: int
    n_failed: int
    mae: float
    rmse: float
    worst_over: float
    worst_under: float
    violation_rate: float


def false_passes(predicted: npt.ArrayLike, m: npt.ArrayLike) -> Booleans:
    """Which points are predicted to pass and do not: their margin is negative, or NaN, as their run failed.

    >>> false_passes([0.1, 0.1, 0.1, -0.1], [0.2, -0.1, float("nan"), float("nan")]).tolist()
    [False, True, True, False]
    """
    guess, true = np.asarray(predicted, dtype=float), np.asarray(m, dtype=float)
    return np.asarray((guess >= 0.0) & ~(true >= 0.0))


def score(predicted: npt.ArrayLike, m: npt.ArrayLike) -> Scores:
    """Compare predictions with true margins; a margin of NaN stands for a run that failed.

    >>> score([0.1, -0.1], [-0.1, 0.1])
    Scores(n=2, n_failed=0, mae=0.2, rmse=0.2, worst_over=0.2, worst_under=0.2, violation_rate=0.5)
    >>> score([0.1, 0.1], [0.1, float("nan")]).violation_rate
    0.5
    """
    guess, true = np.asarray(predicted, dtype=float), np.asarray(m, dtype=float)
    known = ~np.isnan(true)
    g, t = guess[known], true[known]
    nan = float("nan")
    return Scores(
        n=len(t),
        n_failed=len(true) - len(t),
        mae=float(np.abs(g - t).mean()) if len(t) else nan,
        rmse=float(np.sqrt(((g - t) ** 2).mean())) if len(t) else nan,
        worst_over=overprediction(g, t) if len(t) else nan,
        worst_under=overprediction(t, g) if len(t) else nan,
        violation_rate=float(false_passes(guess, true).mean()) if len(true) else nan,
    )


# -- the data of one study -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class MarginData:
    """Checked facility runs, one entry per (hosting vector, period, fault, site, mode, beta); arrays of one
    length.

    Attributes
    ----------
    sites : candidate buses, the order of `hosting`'s columns.
    hosting : H of every site, MW (runs, sites).
    d : data-centre factor of the period.
    period, fault, mode : labels.
    site : bus number.
    beta : rating ratio.
    voltage : voltage margin, pu.
    loss_share, loss_mw : loss margin as a share of the import before the fault, and in MW.
    ok : False for a run that failed; its margins are not read.
    status : how the run ended; of a failed run the reason.
    sequence : modes that the supervisor passed through.
    fit : True for a hosting vector of the fitting set.
    name : name of the hosting vector.
    """

    sites: tuple[int, ...]
    hosting: Floats
    d: Floats
    period: npt.NDArray[np.str_]
    fault: npt.NDArray[np.str_]
    mode: npt.NDArray[np.str_]
    site: npt.NDArray[np.int64]
    beta: Floats
    voltage: Floats
    loss_share: Floats
    loss_mw: Floats
    ok: Booleans
    status: npt.NDArray[np.str_]
    sequence: npt.NDArray[np.str_]
    fit: Booleans
    name: npt.NDArray[np.str_]

    def __post_init__(self) -> None:
        n = len(self.site)
        problems = [
            f"{key} has {len(value)} entries for {n} runs."
            for key, value in vars(self).items()
            if key != "sites" and len(value) != n
        ]
        if not problems and self.hosting.shape[1] != len(self.sites):
            problems.append(f"hosting has {self.hosting.shape[1]} columns for {len(self.sites)} sites.")
        if not problems:
            for key in ("voltage", "loss_share", "loss_mw"):
                bad = int((self.ok & ~np.isfinite(getattr(self, key))).sum())
                if bad:
                    problems.append(f"{key} is not finite in {bad} run(s) that are marked ok.")
        raise_all(problems, "margins", InputError)

    @cached_property
    def _coded(self) -> dict[str, tuple[int, npt.NDArray[np.int64]]]:
        return {}

    def grouped(self, *columns: str) -> list[npt.NDArray[np.int64]]:
        """Positions of the runs that are alike in some columns, in the order of their values."""
        group = np.zeros(len(self.site), dtype=np.int64)
        for name in columns:
            if name not in self._coded:  # comparing texts once is what takes the time
                values, code = np.unique(getattr(self, name), return_inverse=True)
                self._coded[name] = (len(values), code)
            count, code = self._coded[name]
            group = group * count + code
        order = np.argsort(group, kind="stable")
        return list(np.split(order, np.flatnonzero(np.diff(group[order])) + 1))

    def margin(self, target: str, method: str) -> Floats:
        """The margin that `method` fits for `target`."""
        if target == "voltage":
            return self.voltage
        return self.loss_mw if method == "paper" else self.loss_share


@dataclass(frozen=True, eq=False)
class Surrogate:
    """One tightened affine margin of one site, fault, mode and target.

    Attributes
    ----------
    method, site, fault, mode, target : what it stands for.
    period, beta : '' and 0.0 where it is pooled over them.
    intercept : tightened intercept.
    slopes : per MW of data-centre load P_j = d_t H_j, in the order of the sites.
    rating_slope : per MVA of the site's own rating, 0 in method 'share'.
    tightening : how much the intercept was lowered.
    unknown : the reason by (beta, period), where every run of the fitting set failed or too few are left.
    n_fit, n_excluded : points fitted; points of the fitting set left out because their run failed.
    n_mixed, n_sequences : fitting points whose event sequence is not the most common one; how many sequences.
    scores : on the validation set.
    validation : (names, margins, predictions) of the validation points; margins of failed runs are NaN.
    """

    method: str
    site: int
    fault: str
    mode: str
    target: str
    period: str
    beta: float
    intercept: float
    slopes: Floats
    rating_slope: float
    tightening: float
    unknown: Mapping[tuple[float, str], str]
    n_fit: int
    n_excluded: int
    n_mixed: int
    n_sequences: int
    scores: Scores
    validation: tuple[npt.NDArray[np.str_], Floats, Floats]

    def at(self, beta: float, d: float, own: int) -> tuple[Floats, float]:
        """Coefficients over H and bound of the row `coefficients @ H >= bound` at a rating and a period.

        Parameters
        ----------
        beta : rating ratio.
        d : data-centre factor of the period.
        own : position of the surrogate's site.
        """
        coefficients = d * self.slopes
        coefficients[own] += self.rating_slope * beta
        return coefficients, -self.intercept

    def predict(self, hosting: Floats, d: Floats | float, beta: Floats | float, own: int) -> Floats:
        """Predicted margin for hosting vectors (points, sites)."""
        load = hosting * np.reshape(d, (-1, 1))
        return np.asarray(
            self.intercept + load @ self.slopes + self.rating_slope * np.asarray(beta) * hosting[:, own]
        )


def fit_surrogates(data: MarginData, method: str) -> list[Surrogate]:
    """Fit and tighten every margin of a study.

    Parameters
    ----------
    data : the checked runs.
    method : 'paper' or 'share'.

    Returns
    -------
    list of Surrogate
        One for each site, fault, mode and target ('paper'); for each of these at every beta and period
        ('share').

    Raises
    ------
    InputError
        For an unknown method.
    """
    if method not in ("paper", "share"):
        raise InputError(f"surrogate method {method!r}: must be 'paper' or 'share'.")
    fit = _fit_paper if method == "paper" else _fit_share
    return [
        surrogate
        for chosen in data.grouped("mode", "site", "fault", *(["beta"] if method == "share" else []))
        for target in TARGETS
        for surrogate in fit(data, chosen, target)
    ]


def _fit_paper(data: MarginData, chosen: npt.NDArray[np.int64], target: str) -> list[Surrogate]:
    own = data.sites.index(int(data.site[chosen[0]]))
    load = data.hosting[chosen] * data.d[chosen, None]
    rating = data.beta[chosen] * data.hosting[chosen, own]
    x = np.column_stack([np.ones(len(chosen)), load, rating])
    m = data.margin(target, "paper")[chosen]
    fitted = data.fit[chosen] & data.ok[chosen]
    k = _coefficients(x, m, fitted, not_negative=[x.shape[1] - 1])
    return [
        _tightened(
            "paper", data, chosen, target, m, _predict(x, k), k[0], k[1:-1], k[-1], period="", beta=0.0
        )
    ]


def _fit_share(data: MarginData, chosen: npt.NDArray[np.int64], target: str) -> list[Surrogate]:
    load = data.hosting[chosen] * data.d[chosen, None]
    periods = sorted(set(data.period[chosen].tolist()))
    fitted = data.fit[chosen] & data.ok[chosen]
    seen = [period for period in periods if (fitted & (data.period[chosen] == period)).any()]
    x = np.column_stack([*[(data.period[chosen] == period).astype(float) for period in seen], load])
    m = data.margin(target, "share")[chosen]
    k = _coefficients(x, m, fitted)
    known = bool(np.isfinite(k).all())
    fits = []
    for period in periods:
        here = data.period[chosen] == period
        intercept = k[seen.index(period)] if period in seen and known else -np.inf
        fits.append(
            _tightened(
                "share",
                data,
                chosen[here],
                target,
                m[here],
                _predict(x[here], k),
                intercept,
                k[len(seen) :] if known else np.zeros(load.shape[1]),
                0.0,
                period=period,
                beta=float(data.beta[chosen[0]]),
            )
        )
    return fits


def _coefficients(x: Floats, m: Floats, fitted: Booleans, not_negative: Sequence[int] = ()) -> Floats:
    """Least squares over the fitted points; an intercept of -inf (nothing passes) where they are too few."""
    if fitted.sum() >= x.shape[1]:
        return least_squares(x[fitted], m[fitted], not_negative)
    k = np.zeros(x.shape[1])
    k[0] = -np.inf
    return k


def _predict(x: Floats, k: Floats) -> Floats:
    return x @ k if np.isfinite(k).all() else np.full(len(x), -np.inf)


def _tightened(
    method: str,
    data: MarginData,
    chosen: npt.NDArray[np.int64],
    target: str,
    m: Floats,
    predicted: Floats,
    intercept: float,
    slopes: Floats,
    rating_slope: float,
    period: str,
    beta: float,
) -> Surrogate:
    """Tighten a fit on its fitting points and put it together with the counts and scores of its points."""
    ok, fit = data.ok[chosen], data.fit[chosen]
    known = bool(np.isfinite(intercept))
    tightening = overprediction(predicted[fit & ok], m[fit & ok]) if known else 0.0
    sequences = Counter(data.sequence[chosen[fit & ok]].tolist())
    places = list(zip(data.beta[chosen].tolist(), data.period[chosen].tolist(), strict=True))
    good = {place for place, usable in zip(places, fit & ok, strict=True) if usable}
    silent = sorted(set(places) - good if known else set(places))
    spoken = np.array([place not in silent for place in places], dtype=bool)
    unseen = ~fit & spoken
    seen = np.where(ok, m, np.nan)[unseen]
    first = chosen[0]
    return Surrogate(
        method=method,
        site=int(data.site[first]),
        fault=str(data.fault[first]),
        mode=str(data.mode[first]),
        target=target,
        period=period,
        beta=beta,
        intercept=float(intercept - tightening),
        slopes=slopes,
        rating_slope=float(rating_slope),
        tightening=tightening,
        unknown={
            place: _why_unknown(data.status[at], data.ok[at])
            for place in silent
            for at in [chosen[fit & np.array([other == place for other in places])]]
        },
        n_fit=int((fit & ok).sum()),
        n_excluded=int((fit & ~ok).sum()),
        n_mixed=sum(sequences.values()) - max(sequences.values(), default=0),
        n_sequences=len(sequences),
        scores=score(predicted[unseen] - tightening, seen),
        validation=(data.name[chosen[unseen]], seen, predicted[unseen] - tightening),
    )


def _why_unknown(status: npt.NDArray[np.str_], ok: Booleans) -> str:
    """Reason why nothing is known at a rating and period, from its runs in the fitting set."""
    reasons = Counter(first_sentence(str(text)) for text in status[~ok])
    if not reasons:
        return f"{len(ok)} runs in the fitting set are too few for a fit"
    most = f"{'most often' if len(reasons) > 1 else 'the reason'}: {reasons.most_common(1)[0][0]}"
    if ok.any():
        good = f"{int(ok.sum())} of {len(ok)} runs in the fitting set have a margin"
        return f"{good}, too few for a fit; {most}"
    return f"every run of the fitting set failed; {most}"
