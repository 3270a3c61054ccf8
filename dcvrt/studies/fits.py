"""The fits of a study: margins of the samples as arrays, surrogates, and forms of the margins judged side by
side."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.planning.kept import one_sided, side_by_side
from dcvrt.planning.surrogate import TARGETS, MarginData, Surrogate, fit_surrogates
from dcvrt.studies.setting import Setting
from dcvrt.studies.store import Store

Floats = npt.NDArray[np.float64]


def margin_data(store: Store, sites: Sequence[int], d: Mapping[str, float]) -> tuple[MarginData, Floats]:
    """The checked runs of the samples as arrays, and the derivatives of voltage margin and loss share by
    every site's capacity, (runs, 2, sites), NaN where they were not asked for."""
    frame = store.margins("sample")
    if frame.empty:
        raise InputError(f"{store.path}: holds no sampled runs. Way out: run the study first.")
    slopes = np.full((len(frame), 2, len(sites)), np.nan)
    for k, gradients in enumerate(frame.gradients):
        if gradients:
            slopes[k] = [[gradients[target][f"H_{bus}"] for bus in sites] for target in TARGETS]
    samples = store.hostings().set_index("name")
    vectors = {name: [by_site[str(bus)] for bus in sites] for name, by_site in samples.by_site.items()}
    return MarginData(
        sites=tuple(sites),
        hosting=np.array([vectors[name] for name in frame.hosting]),
        d=np.array([d[name] for name in frame.period]),
        period=frame.period.to_numpy(dtype=str),
        fault=frame.fault.to_numpy(dtype=str),
        mode=frame["mode"].to_numpy(dtype=str),
        site=frame.site.to_numpy(dtype=np.int64),
        beta=frame.beta.to_numpy(dtype=float),
        voltage=frame.v_margin_pu.to_numpy(dtype=float),
        loss_share=frame.loss_margin_share.to_numpy(dtype=float),
        loss_mw=frame.loss_margin_mw.to_numpy(dtype=float),
        ok=frame.ok.to_numpy(dtype=bool),
        status=frame.status.to_numpy(dtype=str),
        sequence=frame.sequence.to_numpy(dtype=str),
        fit=(samples.subset[frame.hosting] == "fit").to_numpy(dtype=bool),
        name=frame.hosting.to_numpy(dtype=str),
    ), slopes


def run_fits(store: Store, setting: Setting) -> list[Surrogate]:
    """Fit every method to the samples and write surrogates and validation points."""
    data, slopes = margin_data(store, setting.sites, setting.d)
    fits = [fit for method in setting.file.surrogate.methods for fit in fit_surrogates(data, method)]
    with store.transaction():
        store.clear("surrogates", "predictions")
        store.note(one_sided=one_sided(data))
        judge_forms(store, data, slopes if setting.file.sampling.gradients else None)
        for fit in fits:
            key = {
                name: getattr(fit, name)
                for name in ("method", "mode", "site", "fault", "target", "period", "beta")
            }
            scores = {k: value for k, value in asdict(fit.scores).items() if k not in ("n", "n_failed")}
            store.put(
                "surrogates",
                [
                    key
                    | scores
                    | {
                        "intercept": fit.intercept,
                        "slopes": dict(zip(map(str, setting.sites), fit.slopes.tolist(), strict=True)),
                        "rating_slope": fit.rating_slope,
                        "tightening": fit.tightening,
                        "unknown": [[*place, why] for place, why in fit.unknown.items()],
                        "n_fit": fit.n_fit,
                        "n_validation": fit.scores.n,
                        "n_validation_failed": fit.scores.n_failed,
                        "n_excluded": fit.n_excluded,
                        "n_mixed": fit.n_mixed,
                        "n_sequences": fit.n_sequences,
                    }
                ],
            )
            names, margins, predicted = fit.validation
            # Pooled fits hold a hosting vector several times: number the points within each.
            store.put(
                "predictions",
                [
                    key | {"hosting": str(name), "point": k, "margin": float(m), "predicted": float(p)}
                    for k, (name, m, p) in enumerate(zip(names, margins, predicted, strict=True))
                ],
            )
    return fits


def judge_forms(store: Store, data: MarginData, slopes: Floats | None) -> None:
    """Note how much of what is feasible each form of the margins keeps, unless it stands there already."""
    made_from = hashlib.sha256(data.voltage.tobytes() + data.loss_share.tobytes()).hexdigest()
    if store.provenance().get("forms_from") != made_from and not data.fit.all():
        store.note(forms_from=made_from, forms=[asdict(found) for found in side_by_side(data, slopes)])
