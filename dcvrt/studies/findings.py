"""What a finished study folder holds, read once, and the statements that follow from it.

Figures and report read a study through :class:`Findings` alone. Every sentence made here is computed from the
rows of the summary and the store; none is written for a particular result.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dcvrt.errors import InputError
from dcvrt.studies.config import FaultEntry, StudyFile, load
from dcvrt.studies.store import Store
from dcvrt.studies.style import mode_name

if TYPE_CHECKING:
    import pandas as pd

    from dcvrt.dae import Dae

SAME_SHARE = 1e-3
"""Capacities that differ by less than this share of the plan without ride-through count as equal."""

FILES = ("summary.json", "study.toml", "study.sqlite")

Row = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Findings:
    """Results of one study folder.

    Parameters
    ----------
    folder : the folder of a study that has ended.

    Raises
    ------
    InputError
        When the study has not ended: summary, study file or store are missing.
    """

    folder: Path

    def __post_init__(self) -> None:
        missing = [name for name in FILES if not (self.folder / name).is_file()]
        if missing:
            raise InputError(f"{self.folder}: {' and '.join(missing)} not found, so this is not the folder of a study that "
                             "has ended. Way out: run 'dcvrt study run' with this folder as --out; it resumes.")

    # -- what the folder holds -----------------------------------------------------------------------------

    @cached_property
    def summary(self) -> dict[str, Any]:
        """`summary.json`."""
        return dict(json.loads((self.folder / "summary.json").read_text(encoding="utf-8")))

    @cached_property
    def study(self) -> StudyFile:
        """`study.toml`."""
        path = self.folder / "study.toml"
        return load(path.read_text(encoding="utf-8"), str(path))

    @cached_property
    def provenance(self) -> dict[str, Any]:
        """What the store says about how it was made."""
        with self._store() as store:
            return store.provenance()

    @cached_property
    def margins(self) -> pd.DataFrame:
        """Every checked facility run, of samples and plans."""
        with self._store() as store:
            return store.margins()

    @cached_property
    def hostings(self) -> pd.DataFrame:
        """Every hosting vector."""
        with self._store() as store:
            return store.hostings()

    @cached_property
    def predictions(self) -> pd.DataFrame:
        """Validation points with what the surrogates predict."""
        with self._store() as store:
            return store.predictions()

    @cached_property
    def surrogates(self) -> pd.DataFrame:
        """Fitted margins."""
        with self._store() as store:
            return store.surrogates()

    @cached_property
    def plans(self) -> pd.DataFrame:
        """Plans with their verdicts."""
        with self._store() as store:
            return store.plans()

    @cached_property
    def tasks(self) -> pd.DataFrame:
        """Tasks with their states."""
        with self._store() as store:
            return store.tasks()

    def waveforms(self, **where: Any) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Stored waveforms, see :meth:`Store.waveforms`."""
        with self._store() as store:
            return list(store.waveforms(**where))

    def _store(self) -> Store:
        return Store(self.folder / "study.sqlite")

    # -- its dimensions ------------------------------------------------------------------------------------

    @property
    def sites(self) -> list[int]:
        """Candidate buses in the order of the study file."""
        return list(self.study.grid.sites)

    @property
    def modes(self) -> list[str]:
        """Facility variants in the order of the study file."""
        return list(self.study.facility.modes)

    @property
    def methods(self) -> list[str]:
        """Surrogate methods in the order of the study file."""
        return list(self.study.surrogate.methods)

    @property
    def faults(self) -> list[FaultEntry]:
        """Faults of the study file."""
        return list(self.study.fault)

    @property
    def no_vrt_mw(self) -> float:
        """Total of the plan without ride-through."""
        return float(self.summary["no_vrt"]["total_mw"])

    def rows(self, mode: str | None = None, method: str | None = None) -> list[Row]:
        """Rows of the summary of a mode and a method, by rising beta."""
        chosen = [row for row in self.summary["rows"] if mode in (None, row["mode"]) and method in (None, row["method"])]
        return sorted(chosen, key=lambda row: (row["mode"], row["method"], row["beta"]))

    def facility(self, mode: str) -> Dae:
        """The compiled facility of a mode."""
        from dcvrt import facility

        return facility.get(mode).compile()

    def parameters(self, mode: str) -> dict[str, float]:
        """Parameters that the study sets for a mode, by path."""
        return {**self.study.facility.parameters, **self.study.facility.parameters_by_mode.get(mode, {})}

    # -- statements ----------------------------------------------------------------------------------------

    @property
    def tolerance_mw(self) -> float:
        """Difference below which two capacities count as equal."""
        return SAME_SHARE * max(self.no_vrt_mw, 1.0)

    def best(self) -> Row | None:
        """The replayed and passed row with the largest total; the smaller beta where totals are equal."""
        passed = [row for row in self.rows() if verdict(row) == "passed" and ac_verdict(row) == "passed"]
        if not passed:
            return None
        most = max(float(row["total_mw"]) for row in passed)
        return min((row for row in passed if row["total_mw"] >= most - self.tolerance_mw), key=lambda row: row["beta"])

    def falls(self) -> list[str]:
        """A sentence for each step of beta at which the capacity falls."""
        said = []
        for mode in self.modes:
            for method in self.methods:
                rows = self.rows(mode, method)
                for low, high in zip(rows, rows[1:], strict=False):
                    if high["total_mw"] < low["total_mw"] - self.tolerance_mw:
                        said.append(f"{mode_name(mode)}, method {method}: capacity falls from {low['total_mw']:.1f} MW at "
                                    f"β = {low['beta']:g} to {high['total_mw']:.1f} MW at β = {high['beta']:g}. "
                                    f"What holds it back there: {self.limits_of(high)}")
        return said

    def shortfalls(self) -> list[str]:
        """A sentence for each mode and method whose highest beta stays below the plan without ride-through."""
        said = []
        for mode in self.modes:
            for method in self.methods:
                rows = self.rows(mode, method)
                if rows and rows[-1]["total_mw"] < self.no_vrt_mw - self.tolerance_mw:
                    top = rows[-1]
                    said.append(f"{mode_name(mode)}, method {method}: at the highest β studied ({top['beta']:g}) "
                                f"{top['total_mw']:.1f} MW can be hosted, {self.no_vrt_mw - top['total_mw']:.1f} MW less than "
                                f"without ride-through ({self.no_vrt_mw:.1f} MW). What prevents more: {self.limits_of(top)}")
        return said

    def limits_of(self, row: Row) -> str:
        """What keeps a row from hosting more: its dearest limits and its closed sites."""
        parts = []
        closed = self.closed(row)
        if closed:
            parts.append("; ".join(f"bus {bus} is closed ({reason.rstrip('.')})" for bus, reason in closed.items()))
        binding = [binding_text(entry) for entry in row.get("binding") or []][:3]
        if binding:
            parts.append("the dearest limits are " + "; ".join(binding))
        return (". ".join(part[0].upper() + part[1:] for part in parts) or "No limit is recorded for this row") + "."

    def plan(self, row: Row) -> pd.Series[Any] | None:
        """The row of `plans` that belongs to a row of the summary."""
        plans = self.plans
        found = plans[(plans.method == row["method"]) & (plans["mode"] == row["mode"]) & (abs(plans.beta - row["beta"]) < 1e-9)]
        return None if found.empty else found.iloc[0]

    def closed(self, row: Row) -> dict[str, str]:
        """Sites without a facility in a row, each with the reason."""
        plan = self.plan(row)
        reasons = {} if plan is None or not plan.closed else {str(bus): str(why) for bus, why in dict(plan.closed).items()}
        for bus, mw in row["by_site"].items():
            if float(mw) <= 0.0:
                reasons.setdefault(str(bus), "the programme gives it no capacity")
        return reasons

    def worst_row(self) -> Row | None:
        """The replayed row with the smallest loss or voltage margin, each margin against its own limit."""
        replayed = [row for row in self.rows() if row["replay"].get("worst_voltage_margin_pu") is not None]
        if not replayed:
            return None
        v_limit = self.study.criteria.v_it_min_pu

        def margin(row: Row) -> float:
            total = max(float(row["total_mw"]), 1.0)
            loss = row["replay"].get("worst_loss_margin_mw")
            return min(row["replay"]["worst_voltage_margin_pu"] / v_limit, 0.0 if loss is None else loss / total)

        return min(replayed, key=margin)


def verdict(row: Row) -> str:
    """Outcome of the replay of a row: passed, failed or not replayed.

    >>> verdict({"replay": {"passed": None}})
    'not replayed'
    """
    passed = (row.get("replay") or {}).get("passed")
    return "not replayed" if passed is None else "passed" if passed else "failed"


def ac_verdict(row: Row) -> str:
    """Outcome of the AC power flow of a row."""
    passed = (row.get("ac") or {}).get("passed")
    return "not checked" if passed is None else "passed" if passed else "failed"


def binding_text(entry: Any) -> str:
    """A limit as a phrase.

    >>> binding_text({"kind": "line", "label": "80-99", "hour": 12, "price": 0.52, "unit": "MW/MVA"})
    'line 80-99 in hour 12 (0.52 MW/MVA)'
    """
    if not isinstance(entry, Mapping):
        return str(entry)
    text = f"{entry.get('kind', '')} {entry.get('label', '')}".strip()
    if entry.get("hour") is not None:
        text += f" in hour {entry['hour']}"
    if entry.get("price"):
        text += f" ({entry['price']:.3g} {entry.get('unit') or 'MW'})".replace(" )", ")")
    return text


def by_site(row: Row, sites: Sequence[int]) -> list[float]:
    """Capacities of a row in the order of `sites`; JSON has turned the buses into text."""
    capacities = {str(bus): float(mw) for bus, mw in row["by_site"].items()}
    return [capacities.get(str(site), 0.0) for site in sites]
