"""The store of a study: one SQLite file that says what was asked, what was done and what came out.

Written by one process only, in transactions of one finished task; WAL and `synchronous = NORMAL`, so that a
killed run leaves whole tasks behind. Readers may look in at any time.

Tables (the read methods of :class:`Store` return them as DataFrames, in an order that does not depend on the
order in which the work was done):

`provenance`   key, value (JSON): study text and hash, versions, platform, compiler, seeds, network, sources.
`tasks`        hash, phase, text, status (open, done, failed, timeout, quarantined), attempts, message,
seconds. `hostings`     name, role ('sample'; 'search': simulated on the way to the frontier; 'candidate':
replayed there and no plan; 'system search', 'system candidate': the same for plans under a system limit;
'plan'), subset ('fit', 'validation' or ''), total_mw, by_site
{bus: MW}. `margins`      one checked facility run: hosting, period, fault, site, mode, beta; h_mw, p_mw
(import before the
               fault); v_margin_pu, loss_margin_share, loss_margin_mw, loss_share, loss_mw; v_poi_min_pu
               (lowest retained voltage); status (a sentence), ok (1 when the run has margins), sequence
               (modes passed through), battery (1 when the supervisor visited BATTERY), diagnostics and
               gradients (JSON; {voltage, loss, v_poi: {beta, H_<bus>: derivative}} where asked for).
               Where ok = 0 the margins are empty and the row counts as a failure, never as a pass; failed_in
               says what failed: 'grid' (no waveform), 'start' (a facility without an equilibrium before the
               fault), 'facility' (a run that ended early) or 'task' (set aside before it ended).
`waveforms`    POI voltages of the replays: hosting, period, fault, site; signals (names with units), values:
               float32, byte-shuffled, zlib. The first signal is always t_s.
`surrogates`   one fitted margin: method, mode, site, fault, target ('voltage' or 'loss'), period ('' where
pooled),
               beta (0 where pooled); intercept (tightened), slopes {bus: per MW}, rating_slope, tightening;
               unknown ([beta, period, why] where no run has a margin: the site counts as not passing there);
               n_fit, n_validation (points with a margin), n_validation_failed (points without one, as their
               run failed), n_excluded (failed runs of the fitting set), n_mixed (fitting points whose event
               sequence is not the most common one), n_sequences; mae, rmse, worst_over, worst_under,
               violation_rate, on the validation set.
`predictions`  validation points of every surrogate, numbered: method, mode, site, fault, target, period,
beta,
               hosting, point, margin (NULL where the run failed), predicted.
`plans`        method ('none' is the plan without ride-through), mode, beta, hosting, total_mw, by_site,
binding and
               closed (JSON), carried_from (the smaller beta it was found at, or empty), ac_passed,
               ac_v_min_pu, ac_v_error_pu, ac_status; replayed (1 once every run of it was made), passed,
               worst_voltage_margin_pu, worst_loss_margin_mw, aggregate_loss_mw, worst {voltage, loss,
               aggregate: where; reactive: {plan, unhosted: units beyond their reactive limits in the AC power
               flow, with the fields of `dcvrt.planning.reactive.ReactiveExcess`}}, n_failed; search (JSON),
               of method 'frontier', how it was found: candidates, refused, gap, settled, by_sequence, margins
               (that bind: period, fault, site, target, label, price, by_beta, mechanism).
`system_plans` the largest plan of a mode and rating whose loss of all sites together stays within a limit
               in every fault; sites may fail singly. mode, beta, limit_name, limit_mw and limit_share (of the
               load before the fault; the other is 0); the columns of `plans` from hosting to ac_status;
               passed, n_failed (faults and periods without a result); aggregate_loss_mw, the largest; losses
               (JSON), one by one: period, fault, loss_mw, limit_mw, whole (buses that are lost whole);
               search as in `plans`.
`system_front` hosting vectors that were replayed, with what all sites together lose at once in the worst
               fault: mode, beta, hosting, total_mw, loss_mw; of each mode and rating those of which no other
               hosts more and loses less.
`sensitivities` of one plan of each mode: mode, number (most at stake first), path, unit, doc, source, value;
               by_unit: MW per unit by gradients, NULL where no margin holds the plan; sides (JSON, low and
               high: value, linear_mw (to first order), gradient_mw (through the hosting programme), refused,
               unseen {bus: what fails that gradients do not see}, stake_mw, rerun_mw, rerun_by_site,
               rerun_settled); stake_mw. Derived from the plans and written as a whole;
               `sensitivities_from` in `provenance` is their digest, `sensitivity_plans` says of which plans
               they are and `sensitivity_runs` what was simulated for them.
`coupling`     margins of plans with the facilities in the network ('closed') beside those without ('open'),
               by the native engine: hosting, mode, beta, period, fault, site; v_poi_min_open and _closed
               (pu), voltage_ (margin, pu), loss_ (margin, share of load), passed_; same_sequence; status,
               empty where both have margins.
"""

from __future__ import annotations

import json
import sqlite3
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from dcvrt.errors import InputError
from dcvrt.waveform import Waveform

if TYPE_CHECKING:
    import pandas as pd

VERSION = 6
"""Of the tables below; a store of another version is refused."""
RUN_FAILED = ("start", "facility")
"""Values of `failed_in` of facility runs that have no result."""

TABLES = {
    "provenance": "key TEXT PRIMARY KEY, value TEXT NOT NULL",
    "tasks": "hash TEXT PRIMARY KEY, phase TEXT NOT NULL, text TEXT NOT NULL, status TEXT NOT NULL DEFAULT "
    "'open', "
    "attempts INTEGER NOT NULL DEFAULT 0, message TEXT NOT NULL DEFAULT '', seconds REAL",
    "hostings": "name TEXT PRIMARY KEY, role TEXT NOT NULL, subset TEXT NOT NULL, total_mw REAL NOT NULL, "
    "by_site TEXT NOT NULL",
    "margins": "hosting TEXT NOT NULL, period TEXT NOT NULL, fault TEXT NOT NULL, site INTEGER NOT NULL, "
    "mode TEXT NOT NULL, beta REAL NOT NULL, h_mw REAL, p_mw REAL, v_margin_pu REAL, loss_margin_share REAL, "
    "loss_margin_mw REAL, loss_share REAL, loss_mw REAL, v_poi_min_pu REAL, status TEXT NOT NULL, "
    "ok INTEGER NOT NULL, failed_in TEXT NOT NULL, sequence TEXT NOT NULL, battery INTEGER NOT NULL, "
    "diagnostics TEXT NOT NULL, gradients TEXT NOT NULL DEFAULT '{}', "
    "PRIMARY KEY (hosting, period, fault, site, mode, beta)",
    "waveforms": "hosting TEXT NOT NULL, period TEXT NOT NULL, fault TEXT NOT NULL, site INTEGER NOT NULL, "
    "signals TEXT NOT NULL, n INTEGER NOT NULL, packed BLOB NOT NULL, "
    "PRIMARY KEY (hosting, period, fault, site)",
    "surrogates": "method TEXT NOT NULL, mode TEXT NOT NULL, site INTEGER NOT NULL, fault TEXT NOT NULL, "
    "target TEXT NOT NULL, period TEXT NOT NULL, beta REAL NOT NULL, intercept REAL, slopes TEXT NOT NULL, "
    "rating_slope REAL, tightening REAL, unknown TEXT NOT NULL, n_fit INTEGER, n_validation INTEGER, "
    "n_validation_failed INTEGER, "
    "n_excluded INTEGER, "
    "n_mixed INTEGER, n_sequences INTEGER, mae REAL, rmse REAL, worst_over REAL, worst_under REAL, "
    "violation_rate REAL, PRIMARY KEY (method, mode, site, fault, target, period, beta)",
    "predictions": "method TEXT NOT NULL, mode TEXT NOT NULL, site INTEGER NOT NULL, fault TEXT NOT NULL, "
    "target TEXT NOT NULL, period TEXT NOT NULL, beta REAL NOT NULL, hosting TEXT NOT NULL, "
    "point INTEGER NOT NULL, margin REAL, predicted REAL NOT NULL, "
    "PRIMARY KEY (method, mode, site, fault, target, period, beta, point)",
    "plans": "method TEXT NOT NULL, mode TEXT NOT NULL, beta REAL NOT NULL, hosting TEXT NOT NULL, total_mw "
    "REAL NOT NULL, "
    "by_site TEXT NOT NULL, binding TEXT NOT NULL, closed TEXT NOT NULL, carried_from REAL, ac_passed "
    "INTEGER, "
    "ac_v_min_pu REAL, ac_v_error_pu REAL, ac_status TEXT, replayed INTEGER NOT NULL DEFAULT 0, passed "
    "INTEGER, "
    "worst_voltage_margin_pu REAL, worst_loss_margin_mw REAL, aggregate_loss_mw REAL, "
    "worst TEXT NOT NULL DEFAULT '{}', n_failed INTEGER NOT NULL DEFAULT 0, "
    "search TEXT NOT NULL DEFAULT '{}', PRIMARY KEY (method, mode, beta)",
    "system_plans": "mode TEXT NOT NULL, beta REAL NOT NULL, limit_name TEXT NOT NULL, "
    "limit_mw REAL NOT NULL, limit_share REAL NOT NULL, hosting TEXT NOT NULL, total_mw REAL NOT NULL, "
    "by_site TEXT NOT NULL, "
    "binding TEXT NOT NULL, closed TEXT NOT NULL, ac_passed INTEGER, ac_v_min_pu REAL, ac_v_error_pu REAL, "
    "ac_status TEXT, worst TEXT NOT NULL DEFAULT '{}', replayed INTEGER NOT NULL DEFAULT 0, passed INTEGER, "
    "n_failed INTEGER NOT NULL DEFAULT 0, aggregate_loss_mw REAL, losses TEXT NOT NULL DEFAULT '[]', "
    "search TEXT NOT NULL, PRIMARY KEY (mode, beta, limit_mw, limit_share)",
    "system_front": "mode TEXT NOT NULL, beta REAL NOT NULL, hosting TEXT NOT NULL, total_mw REAL NOT NULL, "
    "loss_mw REAL NOT NULL, PRIMARY KEY (mode, beta, hosting)",
    "sensitivities": "mode TEXT NOT NULL, number INTEGER NOT NULL, path TEXT NOT NULL, unit TEXT NOT NULL, "
    "doc TEXT NOT NULL, source TEXT NOT NULL, value REAL NOT NULL, by_unit REAL, sides TEXT NOT NULL, "
    "stake_mw REAL NOT NULL, PRIMARY KEY (mode, path)",
    "coupling": "hosting TEXT NOT NULL, mode TEXT NOT NULL, beta REAL NOT NULL, period TEXT NOT NULL, "
    "fault TEXT NOT NULL, site INTEGER NOT NULL, v_poi_min_open REAL, v_poi_min_closed REAL, "
    "voltage_open REAL, voltage_closed REAL, loss_open REAL, loss_closed REAL, passed_open INTEGER, "
    "passed_closed INTEGER, same_sequence INTEGER NOT NULL, status TEXT NOT NULL, "
    "PRIMARY KEY (hosting, mode, beta, period, fault, site)",
}
DETAILS = ("diagnostics", "gradients")
"""Columns of `margins` that many readers do without."""
JSON_COLUMNS = {
    "by_site",
    "binding",
    "closed",
    "slopes",
    "unknown",
    "diagnostics",
    "gradients",
    "worst",
    "search",
    "losses",
    "sides",
}


class Store:
    """The SQLite file of a study folder.

    Parameters
    ----------
    path : path of the file.
    write : open for writing: the file is made when it is not there, and no other writer is let in.
    check : look through the pages of the file; false where that has just been done.

    Raises
    ------
    InputError
        When there is no store to read, it is damaged, it was made by another version, or another run is
        writing.
    """

    def __init__(self, path: str | Path, write: bool = False, check: bool = True) -> None:
        self.path = Path(path)
        if not write and not self.path.is_file():
            raise InputError(
                f"{self.path}: no study store. Way out: name a folder that 'dcvrt study run' has made."
            )
        self._guard = _only_writer(self.path) if write else None
        self._base = sqlite3.connect(self.path, isolation_level=None, timeout=30.0)
        try:
            version = self._base.execute("PRAGMA user_version").fetchone()[0]
            if write:
                self._base.execute("PRAGMA journal_mode = WAL")
                self._base.execute("PRAGMA synchronous = NORMAL")
        except sqlite3.DatabaseError as error:
            self.close()
            raise InputError(
                f"{self.path}: not a study store ({error}). Way out: run into a new folder."
            ) from None
        if write and version == 0:
            with self.transaction():
                for name, columns in TABLES.items():
                    self._base.execute(f"CREATE TABLE {name} ({columns})")
                self._base.execute(f"PRAGMA user_version = {VERSION}")
        elif version != VERSION:
            self.close()
            raise InputError(
                f"{self.path}: store version {version}, this dcvrt reads version {VERSION}. "
                "Way out: run the study again into a new folder."
            )
        if check and (damage := self.integrity()) != "ok":
            self.close()
            raise InputError(
                f"{self.path}: the file is damaged ({damage}). Way out: put a copy of it back, or run the "
                "study again into a new folder."
            )

    def close(self) -> None:
        """Close the file and let other writers in."""
        self._base.close()
        if self._guard is not None:
            self._guard.close()
            self._guard = None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All or nothing of what is written inside."""
        self._base.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._base.execute("ROLLBACK")
            raise
        self._base.execute("COMMIT")

    # -- writing -------------------------------------------------------------------------------------------

    def put(self, table: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write rows, in place of those with the same key."""
        for row in rows:
            plain = {key: json.dumps(value) if key in JSON_COLUMNS else value for key, value in row.items()}
            marks = ", ".join("?" * len(plain))
            self._base.execute(
                f"INSERT OR REPLACE INTO {table} ({', '.join(plain)}) VALUES ({marks})",
                [_plain(value) for value in plain.values()],
            )

    def clear(self, *tables: str) -> None:
        """Empty tables that are derived from others and are about to be derived again."""
        for table in tables:
            self._base.execute(f"DELETE FROM {table}")

    def note(self, **values: Any) -> None:
        """Record facts about the run in `provenance`."""
        self._base.executemany(
            "INSERT OR REPLACE INTO provenance VALUES (?, ?)",
            [(key, json.dumps(value)) for key, value in values.items()],
        )

    def put_waveform(
        self, signals: Mapping[str, npt.ArrayLike], *, hosting: str, period: str, fault: str, site: int
    ) -> None:
        """Write signals over one time axis, `t_s` first."""
        row = dict(hosting=hosting, period=period, fault=fault, site=site, **pack(signals))
        self.put("waveforms", [row])

    # -- tasks ---------------------------------------------------------------------------------------------

    def add_tasks(self, tasks: Iterable[tuple[str, str, str]]) -> None:
        """Enter (hash, phase, text); those already there keep their state."""
        with self.transaction():
            self._base.executemany("INSERT OR IGNORE INTO tasks (hash, phase, text) VALUES (?, ?, ?)", tasks)

    def task_states(self, phase: str | None = None) -> dict[str, tuple[str, int]]:
        """Status and attempts of each task, by hash."""
        rows = self._base.execute(
            "SELECT hash, status, attempts FROM tasks WHERE ?1 IS NULL OR phase = ?1", (phase,)
        )
        return {key: (status, attempts) for key, status, attempts in rows}

    def set_task(self, key: str, status: str, message: str = "", seconds: float | None = None) -> None:
        """Write how a task ended."""
        self._base.execute(
            "UPDATE tasks SET status = ?, message = ?, seconds = ? WHERE hash = ?",
            (status, message, seconds, key),
        )

    def count_attempt(self, key: str, by: int = 1) -> None:
        """Count a start of a task before it starts, so that a death of this very process counts too."""
        self._base.execute("UPDATE tasks SET attempts = attempts + ? WHERE hash = ?", (by, key))

    def reopen(self, *statuses: str) -> int:
        """Make tasks of these statuses open again; how many."""
        marks = ", ".join("?" * len(statuses))
        return self._base.execute(
            f"UPDATE tasks SET status = 'open', attempts = 0, message = '' WHERE status IN ({marks})",
            statuses,
        ).rowcount

    # -- reading -------------------------------------------------------------------------------------------

    def tasks(self) -> pd.DataFrame:
        """Every task with its state."""
        return self._frame("tasks", order="phase, text")

    def hostings(self) -> pd.DataFrame:
        """Every hosting vector: samples and plans."""
        return self._frame("hostings", order="role DESC, name")

    def margins(
        self,
        role: str | None = None,
        hosting: str | Sequence[str] | None = None,
        leave: Collection[str] = (),
    ) -> pd.DataFrame:
        """Every checked facility run; of hosting vectors of a role only, or of one vector or some.

        The columns `leave` are left out: reading `gradients` and `diagnostics` takes most of the time.
        """
        names = [hosting] if isinstance(hosting, str) else hosting
        conditions = {
            "hosting IN (SELECT name FROM hostings WHERE role = ?)": role,
            "hosting IN (SELECT value FROM json_each(?))": None if names is None else json.dumps(list(names)),
        }
        given = {text: value for text, value in conditions.items() if value is not None}
        return self._frame(
            "margins",
            f"WHERE {' AND '.join(given)}" if given else "",
            tuple(given.values()),
            order="hosting, period, fault, site, mode, beta",
            leave=leave,
        )

    def surrogates(self) -> pd.DataFrame:
        """Every fitted margin with its validation figures."""
        return self._frame("surrogates", order="method, mode, target, site, fault, period, beta")

    def predictions(self) -> pd.DataFrame:
        """Margins of the validation set beside what the surrogates predict."""
        return self._frame("predictions", order="method, mode, target, site, fault, period, beta, hosting")

    def plans(self) -> pd.DataFrame:
        """Every plan with its power-flow check and its replay."""
        return self._frame("plans", order="method, mode, beta")

    def system_plans(self) -> pd.DataFrame:
        """Every plan under a system limit."""
        return self._frame("system_plans", order="mode, beta, limit_share, limit_mw")

    def system_front(self) -> pd.DataFrame:
        """Capacity against the load lost at once, of what was replayed."""
        return self._frame("system_front", order="mode, beta, loss_mw")

    def sensitivities(self) -> pd.DataFrame:
        """Sensitivities of one plan of each mode to the assumptions, those with most at stake first."""
        return self._frame("sensitivities", order="mode, number")

    def coupling(self) -> pd.DataFrame:
        """Margins of plans with the facilities in the network beside those without."""
        return self._frame("coupling", order="hosting, mode, beta, period, fault, site")

    def waveforms(self, **where: Any) -> list[tuple[dict[str, Any], dict[str, npt.NDArray[np.float32]]]]:
        """Stored waveforms whose columns have the given values, e.g. `waveforms(site=75, period="peak")`.

        Returns
        -------
        list of (key, signals)
            `key` has hosting, period, fault, site; `signals` maps name to array, `t_s` first.
        """
        condition = " AND ".join(f"{column} = ?" for column in where) or "1"
        rows = self._base.execute(
            "SELECT hosting, period, fault, site, signals, n, packed FROM waveforms "
            f"WHERE {condition} ORDER BY hosting, period, fault, site",
            list(where.values()),
        )
        keys = ("hosting", "period", "fault", "site")
        return [(dict(zip(keys, row[:4], strict=True)), unpack(*row[4:])) for row in rows]

    def voltage(self, hosting: str, period: str, fault: str, site: int) -> Waveform | None:
        """POI voltage of a replay; None where the fault has no result or was not replayed."""
        kept = self.waveforms(hosting=hosting, period=period, fault=fault, site=site)
        if not kept:
            return None
        _, signals = kept[0]
        return Waveform(signals["t_s"].astype(np.float64), signals["v_re_pu"] + 1j * signals["v_im_pu"])

    def provenance(self) -> dict[str, Any]:
        """What the study is and what it was made with."""
        return {
            key: json.loads(value)
            for key, value in self._base.execute("SELECT key, value FROM provenance ORDER BY key")
        }

    def integrity(self) -> str:
        """'ok', or the first of what SQLite finds wrong with the pages of the file."""
        try:
            found = str(self._base.execute("PRAGMA quick_check(1)").fetchone()[0])
        except sqlite3.DatabaseError as error:
            return str(error)
        return found.splitlines()[-1]

    def _frame(
        self,
        table: str,
        where: str = "",
        values: Sequence[Any] = (),
        order: str = "1",
        leave: Collection[str] = (),
    ) -> pd.DataFrame:
        import pandas as pd

        columns = [row[1] for row in self._base.execute(f"PRAGMA table_info({table})")]
        frame = pd.read_sql_query(
            f"SELECT {', '.join(c for c in columns if c not in leave)} FROM {table} {where} ORDER BY {order}",
            self._base,
            params=list(values),
        )
        for column in JSON_COLUMNS & set(frame.columns):
            frame[column] = [json.loads(text) for text in frame[column]]
        return frame


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as plain mappings."""
    return [{str(key): value for key, value in row.items()} for row in frame.to_dict("records")]


def pack(signals: Mapping[str, npt.ArrayLike]) -> dict[str, Any]:
    """Signals of one length as float32, byte by byte, compressed.

    >>> got = unpack(**pack({"t_s": [0.0, 1.0], "v_pu": [1.0, 0.5]}))
    >>> got["v_pu"].tolist()
    [1.0, 0.5]
    """
    table = np.stack([np.asarray(values, dtype="<f4") for values in signals.values()])
    shuffled = np.frombuffer(table.tobytes(), np.uint8).reshape(-1, 4).T.tobytes()
    return {
        "signals": json.dumps(list(signals)),
        "n": int(table.shape[1]),
        "packed": zlib.compress(shuffled, 1),
    }


def unpack(signals: str, n: int, packed: bytes) -> dict[str, npt.NDArray[np.float32]]:
    """Undo `pack`."""
    names = json.loads(signals)
    values = (
        np.frombuffer(zlib.decompress(packed), np.uint8)
        .reshape(4, -1)
        .T.copy()
        .view("<f4")
        .reshape(len(names), n)
    )
    return dict(zip(names, values, strict=True))


def _plain(value: Any) -> Any:
    """NumPy scalars as Python's, NaN as NULL: SQLite stores nothing else faithfully."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and value != value else value


def _only_writer(path: Path) -> sqlite3.Connection:
    """Hold a lock that the system lets go of when this process ends, however it ends."""
    lock = sqlite3.connect(path.with_name(f".{path.name}.lock"), isolation_level=None, timeout=0.0)
    try:
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError:
        lock.close()
        raise InputError(
            f"{path.parent}: another run is writing into this folder. "
            "Way out: wait for it to end, or choose another folder with --out."
        ) from None
    return lock
