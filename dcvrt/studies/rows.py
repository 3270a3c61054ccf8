"""Rows of `summary.json`: their verdicts, what binds in them, which sites they close."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def verdict(row: Row) -> str:
    """Outcome of the replay of a row: passed, failed, or nothing hosted and so nothing replayed.

    >>> verdict({"total_mw": 0.0, "replay": {"passed": None}})
    'nothing hosted'
    >>> verdict({"total_mw": 9.0, "replay": {"passed": False}})
    'failed'
    """
    if not row["total_mw"] > 0:
        return "nothing hosted"
    return "passed" if row["replay"]["passed"] else "failed"


def ac_verdict(row: Row) -> str:
    """Outcome of the AC power flow of a row."""
    return "passed" if row["ac"]["passed"] else "failed"


def closed(row: Row) -> dict[str, str]:
    """Sites without a facility in a row, each with the reason."""
    return {str(entry["bus"]): str(entry["label"]) for entry in row["binding"] if entry["kind"] == "closed"}


def carried(row: Row) -> str:
    """Where a plan comes from that was found at a smaller rating; empty for others."""
    return next((str(entry["label"]) for entry in row["binding"] if entry["kind"] == "carried"), "")


def binding(row: Row) -> list[Row]:
    """Limits that bind in a row, highest price first."""
    return [entry for entry in row["binding"] if entry["kind"] not in ("closed", "carried")]


def binding_text(entry: Row) -> str:
    """A limit as a phrase.

    >>> binding_text({"kind": "line", "label": "80-99", "hour": 12, "price": 0.52, "unit": "MW/MVA"})
    'line 80-99 in hour 12 (0.52 MW/MVA)'
    >>> binding_text({"kind": "row", "label": "loss at bus 75", "hour": None, "price": 3.0, "unit": "MW"})
    'loss at bus 75 (3 MW)'
    """
    bare = entry["kind"] in ("row", "bound")
    text = str(entry["label"]) if bare else f"{entry['kind']} {entry['label']}"
    if entry.get("hour") is not None:
        text += f" in hour {entry['hour']}"
    price = entry.get("price")
    if not price:
        return text
    return f"{text} ({f'{price:,.0f}' if price >= 100 else f'{price:.3g}'} {entry['unit']})"


def by_site(row: Row, sites: Sequence[int]) -> list[float]:
    """Capacities of a row in the order of `sites`; JSON has turned the buses into text."""
    capacities = {str(bus): float(mw) for bus, mw in row["by_site"].items()}
    return [capacities.get(str(site), 0.0) for site in sites]
