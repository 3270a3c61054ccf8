r"""Surrogates side by side: on the same samples, how much of what is truly feasible does each keep?

Four forms of a margin, each a lower bound on the samples that it was fitted to:

`paper`    affine in load and rating, MW, least squares, tightened (`dcvrt.planning.surrogate`);
`share`    affine in H per rating, pu volts and loss share, least squares, tightened (the same module);
`bound`    affine in H per rating, period and margin, the highest lower bound of the samples:

    .. math:: \max_k \sum_s x_s^T k \quad\text{s.t.}\quad x_s^T k \le m_s \text{ for every sample } s;

`pieces`   the least of several affine pieces, per rating, period and margin. Samples of one event sequence
and
    similar gradient share a piece: its slope is their mean gradient, its intercept the highest that exceeds
    none of their margins.

A site and a hosting vector are feasible together when every margin of the site is met there, in all periods
and under all faults. Sites count one by one, as a plan may open each by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.planning.master import highs, model
from dcvrt.planning.surrogate import TARGETS, MarginData, Scores, fit_surrogates, score

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

METHODS = ("paper", "share", "bound", "pieces")
LIKE = 0.25
"""Gradients that differ by less, over the largest of the margin, share a piece."""
MOST_PIECES = 6


def lower_bound(x: Floats, m: Floats) -> Floats:
    """Coefficients of the affine function below all samples whose sum over them is largest.

    Parameters
    ----------
    x : array (samples, coefficients)
        Regressors; one column of ones keeps the programme feasible.
    m : array (samples,)

    Examples
    --------
    >>> x = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    >>> lower_bound(x, np.array([0.0, 2.0, 1.0])).round(6).tolist() == [0.0, 0.5]
    True
    """
    import highspy
    import scipy.sparse as sp

    scale = np.maximum(abs(x).max(axis=0), 1e-300)
    n = x.shape[1]
    solver = highs()
    solver.passModel(
        model(
            (x / scale).sum(axis=0),
            np.full(n, -1e6),
            np.full(n, 1e6),
            sp.csr_matrix(x / scale),
            np.full(len(m), -np.inf),
            m,
        )
    )
    solver.run()
    if solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
        raise RuntimeError(f"HiGHS ended a lower bound with {solver.getModelStatus()}.")
    k = np.array(solver.getSolution().col_value) / scale
    k[0] -= max(0.0, float((x @ k - m).max()))  # the solver's own tolerance
    return np.asarray(k)


def pieces(H: Floats, m: Floats, slope: Floats, sequence: Sequence[str]) -> list[Floats]:
    """Affine pieces [intercept, slopes] whose least lies below every sample that it was made from.

    Parameters
    ----------
    H, slope : array (samples, sites)
        Hosting vectors, MW, and gradients of the margin there.
    m : array (samples,)
    sequence : event sequence of each sample.

    Examples
    --------
    >>> H = np.array([[0.0], [1.0], [2.0], [3.0]])
    >>> m, slope = np.array([1.0, 1.0, 1.0, 0.0]), np.array([[0.0], [0.0], [-1.0], [-1.0]])
    >>> [piece.tolist() for piece in pieces(H, m, slope, ["a"] * 4)]
    [[1.0, 0.0], [3.0, -1.0]]
    """
    largest = max(float(abs(slope).max(initial=0.0)), 1e-12)
    groups: list[list[int]] = []
    for k in range(len(m)):
        for group in groups:
            first = group[0]
            alike = abs(slope[k] - slope[first]).max() <= LIKE * largest
            if sequence[k] == sequence[first] and (alike or len(groups) >= MOST_PIECES):
                group.append(k)
                break
        else:
            groups.append([k])
    found = []
    for group in groups:
        mean = slope[group].mean(axis=0)
        found.append(np.r_[float((m[group] - H[group] @ mean).min()), mean])
    return found


@dataclass(frozen=True)
class Kept:
    """How one form of the margins does on hosting vectors that it has not seen.

    Attributes
    ----------
    method : the form.
    feasible : pairs of site and held-out vector that truly pass, over all modes and ratings.
    kept : how many of them it lets pass.
    false_passes : pairs that it lets pass and that do not.
    scores : of its margins one by one, by target; in MW for the loss margin of `paper`.
    """

    method: str
    feasible: int
    kept: int
    false_passes: int
    scores: dict[str, Scores]

    @property
    def share(self) -> float:
        """Share of what is feasible that it keeps; NaN where nothing is."""
        return self.kept / self.feasible if self.feasible else float("nan")


def side_by_side(data: MarginData, slopes: Floats | None = None) -> list[Kept]:
    """Fit every form to the fitting set and judge it on the validation set.

    Parameters
    ----------
    data : checked runs.
    slopes : array (runs, 2, sites), optional
        Gradients of voltage margin and loss share at each run, per MW; without them there is no `pieces`.

    Raises
    ------
    InputError
        When no hosting vector was held out.
    """
    if data.fit.all():
        raise InputError("surrogates side by side: no hosting vector was held out to judge them on.")
    methods = METHODS if slopes is not None else METHODS[:-1]
    margin = {"voltage": data.voltage, "loss": data.loss_share}
    met = np.asarray(data.ok & (data.voltage >= 0.0) & (data.loss_share >= 0.0))
    own = data.hosting[np.arange(len(data.site)), [data.sites.index(bus) for bus in data.site]]
    unseen = np.asarray(~data.fit & (own > 0.0))  # a site that hosts nothing has nothing that could pass
    found = []
    for method in methods:
        predicted = (
            _fitted(data, method)
            if method in ("paper", "share")
            else _per_margin(data, method, slopes, margin)
        )
        passes = np.asarray((predicted >= 0.0).all(axis=1))
        true, guess = _together(data, met, unseen), _together(data, passes, unseen)
        scores = {
            target: score(
                predicted[spoken, t], np.where(data.ok, data.margin(target, method), np.nan)[spoken]
            )
            for t, target in enumerate(TARGETS)
            for spoken in [unseen & np.isfinite(predicted[:, t])]
        }
        found.append(
            Kept(method, int(true.sum()), int((true & guess).sum()), int((guess & ~true).sum()), scores)
        )
    return found


def one_sided(data: MarginData) -> list[str]:
    """Margins of which the fitting set has seen one side only, by site, target, mode and rating.

    A fit to such samples is an extrapolation wherever it says the other side.
    """
    said = []
    for place in data.grouped("mode", "beta", "site", "fault"):
        here = place[data.fit[place] & data.ok[place]]
        first = place[0]
        what = (
            f"bus {data.site[first]}, fault {data.fault[first]}, {data.mode[first]}, "
            f"beta {data.beta[first]:g}"
        )
        if not len(here):
            said.append(f"{what}: no run of the fitting set has a margin")
            continue
        for target in TARGETS:
            m = data.margin(target, "share")[here]
            if (m >= 0).all() or (m < 0).all():
                said.append(f"{target} at {what}: every sample {'meets' if m[0] >= 0 else 'misses'} it")
    return said


def _fitted(data: MarginData, method: str) -> Floats:
    """Predictions of the tightened least-squares fits at every run, (runs, 2); -inf where they say
    nothing."""
    predicted = np.full((len(data.site), 2), -np.inf)
    columns = ["site", "fault", "mode", *([] if method == "paper" else ["period", "beta"])]
    places = {tuple(getattr(data, c)[at[0]] for c in columns): at for at in data.grouped(*columns)}
    for fit in fit_surrogates(data, method):
        at = places[tuple(getattr(fit, c) for c in columns)]
        own = data.sites.index(fit.site)
        values = fit.predict(data.hosting[at], data.d[at], data.beta[at], own)
        silent = [(b, p) in fit.unknown for b, p in zip(data.beta[at], data.period[at], strict=True)]
        predicted[at, TARGETS.index(fit.target)] = np.where(silent, -np.inf, values)
    return predicted


def _per_margin(data: MarginData, method: str, slopes: Floats | None, margin: dict[str, Floats]) -> Floats:
    """Predictions of the forms that are fitted to each margin by itself."""
    predicted = np.full((len(data.site), 2), -np.inf)
    for place in data.grouped("mode", "beta", "site", "fault", "period"):
        used = place[data.fit[place] & data.ok[place]]
        if len(used) < data.hosting.shape[1] + 2:
            continue
        x = np.column_stack([np.ones(len(place)), data.hosting[place]])
        for t, target in enumerate(TARGETS):
            m = margin[target]
            if method == "bound":
                k = lower_bound(np.column_stack([np.ones(len(used)), data.hosting[used]]), m[used])
                predicted[place, t] = x @ k
            else:
                assert slopes is not None
                found = pieces(data.hosting[used], m[used], slopes[used, t], data.sequence[used].tolist())
                predicted[place, t] = np.min([x @ k for k in found], axis=0)
    return predicted


def _together(
    data: MarginData, holds: npt.NDArray[np.bool_], where: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Whether something holds in every period and fault, for each vector, site, mode and rating."""
    groups = [at[where[at]] for at in data.grouped("name", "site", "mode", "beta")]
    return np.array([holds[at].all() for at in groups if len(at)], dtype=bool)
