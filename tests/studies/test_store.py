"""The store: whole transactions, one writer, waveforms that come back, rows in an order of their own."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.studies.store import Store, pack, unpack


def margin(hosting: str, beta: float, **more) -> dict:
    return {
        "hosting": hosting,
        "period": "peak",
        "fault": "bus 32, 100 ms",
        "site": 75,
        "mode": "gfl",
        "beta": beta,
        "h_mw": 10.0,
        "p_mw": 9.0,
        "v_margin_pu": 0.01,
        "loss_margin_share": 0.1,
        "loss_margin_mw": 0.9,
        "loss_share": 0.0,
        "loss_mw": 0.0,
        "v_poi_min_pu": 0.7,
        "status": "completed",
        "ok": 1,
        "failed_in": "",
        "sequence": "NORMAL",
        "battery": 0,
        "diagnostics": {"peak_loading": 0.8},
    } | more


def test_waveforms_come_back_to_single_precision() -> None:
    rng = np.random.default_rng(0)
    signals = {"t_s": np.linspace(0, 3, 3001), "v_re_pu": rng.normal(size=3001), "v_im_pu": np.zeros(3001)}
    packed = pack(signals)
    found = unpack(**packed)
    assert list(found) == list(signals)
    for name, values in signals.items():
        np.testing.assert_array_equal(found[name], values.astype(np.float32))
    assert len(packed["packed"]) < 0.8 * 3 * 3001 * 4


def test_rows_are_read_in_an_order_that_does_not_depend_on_writing(tmp_path: Path) -> None:
    rows = [margin(h, b) for h in ("s0000", "s0001") for b in (1.0, 1.25)]
    frames = []
    for name, order in (("a", rows), ("b", rows[::-1])):
        with Store(tmp_path / name, write=True) as store:
            store.put(
                "hostings",
                [
                    {"name": h, "role": "sample", "subset": "fit", "total_mw": 1.0, "by_site": {"75": 1.0}}
                    for h in ("s0001", "s0000")
                ],
            )
            store.put("margins", order)
            frames.append(store.margins("sample"))
    assert frames[0].equals(frames[1])
    assert frames[0].diagnostics[0] == {"peak_loading": 0.8}


def test_a_missing_margin_is_null_not_a_number(tmp_path: Path) -> None:
    with Store(tmp_path / "s", write=True) as store:
        store.put("margins", [margin("s0000", 1.0, v_margin_pu=float("nan"), ok=0, status="diverged")])
    with sqlite3.connect(tmp_path / "s") as base:
        assert base.execute("SELECT v_margin_pu, status FROM margins").fetchone() == (None, "diverged")


def test_a_transaction_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    with Store(tmp_path / "s", write=True) as store:
        with pytest.raises(ZeroDivisionError):
            fail_half_way(store)
        assert store.margins().empty


def fail_half_way(store: Store) -> None:
    with store.transaction():
        store.put("margins", [margin("s0000", 1.0)])
        raise ZeroDivisionError


def test_a_second_writer_is_refused_and_a_reader_is_not(tmp_path: Path) -> None:
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.note(seed=1)
        with pytest.raises(InputError) as caught:
            Store(tmp_path / "study.sqlite", write=True)
        assert str(caught.value) == (
            f"{tmp_path}: another run is writing into this folder. "
            "Way out: wait for it to end, or choose another folder with --out."
        )
        with Store(tmp_path / "study.sqlite") as reader:
            assert reader.provenance() == {"seed": 1}
    Store(tmp_path / "study.sqlite", write=True).close()


def test_what_is_no_store_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        Store(tmp_path / "study.sqlite")
    assert str(caught.value) == (
        f"{tmp_path / 'study.sqlite'}: no study store. Way out: name a folder that "
        "'dcvrt study run' has made."
    )
    (tmp_path / "study.sqlite").write_text(
        "something else, long enough to be looked at as a data base header"
    )
    with pytest.raises(InputError) as caught:
        Store(tmp_path / "study.sqlite")
    assert str(caught.value) == (
        f"{tmp_path / 'study.sqlite'}: not a study store (file is not a database). "
        "Way out: run into a new folder."
    )


def test_damaged_pages_are_told_when_the_store_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "study.sqlite"
    with Store(path, write=True) as store, store.transaction():
        store.put("margins", [margin(f"s{k:04}", 1.0) for k in range(200)])
    whole = path.read_bytes()
    path.write_bytes(whole[:40960] + b"\x5a" * 8192 + whole[49152:])
    for write in (False, True):
        with pytest.raises(InputError) as caught:
            Store(path, write=write)
        told = str(caught.value)
        assert told.startswith(f"{path}: the file is damaged (")
        assert told.endswith("). Way out: put a copy of it back, or run the study again into a new folder.")
    path.write_bytes(whole)
    Store(path, write=True).close()  # and the lock was let go of


def test_another_version_is_refused(tmp_path: Path) -> None:
    Store(tmp_path / "s", write=True).close()
    with sqlite3.connect(tmp_path / "s") as base:
        base.execute("PRAGMA user_version = 7")
    with pytest.raises(InputError) as caught:
        Store(tmp_path / "s")
    assert str(caught.value) == (
        f"{tmp_path / 's'}: store version 7, this dcvrt reads version 6. "
        "Way out: run the study again into a new folder."
    )


WRITER = """
import sys
from dcvrt.studies.store import Store
with Store(sys.argv[1], write=True) as store:
    first = len(store.hostings())
    for batch in range(first // 10, 10**6):
        with store.transaction():
            store.put("hostings", [dict(name=f"{batch:05}-{k}", role="sample", subset="", total_mw=0.0,
            by_site={})
                                   for k in range(10)])
"""


def test_a_killed_writer_leaves_whole_transactions(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    seen = 0
    for _ in range(3):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path / "s")], env=environment)
        deadline = time.monotonic() + 30
        count = seen
        while count <= seen and time.monotonic() < deadline:
            time.sleep(0.05)
            if (tmp_path / "s").exists():
                try:
                    with Store(tmp_path / "s") as store:
                        count = len(store.hostings())
                except InputError:
                    continue  # being made
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        with Store(tmp_path / "s") as store:
            assert store.integrity() == "ok"
            now = len(store.hostings())
        assert now % 10 == 0
        assert now > seen
        seen = now
