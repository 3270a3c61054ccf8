"""The C driver under the address and undefined-behaviour sanitizers, in a process that runs with them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

GCC = shutil.which("gcc")
SANITIZE = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")

PROGRAM = """
import pathlib, sys
from dcvrt.grid.native import build
build.FLAGS = (*(f for f in build.FLAGS if f != "-O3"), *sys.argv[1:])
from dcvrt import facility
from dcvrt.grid import BusFault, LineTrip
from tests.grid.native.cases import TIGHT, run
from tests.grid.native.test_closed_loop import FAULT, small
from tests.grid.native.test_events import behind_a_line, constant_power
from tests.grid.native.test_ports import star
from tests.grid.native.test_swing import pair

assert "libasan" in pathlib.Path("/proc/self/maps").read_text()
every = ("H_3", "load", "wind_3", "clear", "wind_1", "wind_2")
for name, x_q2 in (("gfl", 0.25), ("gfm", 0.33), ("no-ups", 0.33)):
    of, diagram = small(x_q2), facility.get(name)
    for count in (0, 1, 6):
        _, found, _ = run(of, {3: 20.0}, FAULT, 0.4, every[:count], facilities={3: diagram})
        assert not found.status, found.status
        assert found.events
for count in (1, 8, 9):
    for salient in (False, True):
        of, fault = star(count, salient=salient), BusFault(100, x_f=0.05)
        _, found, _ = run(of, {101: 10.0}, fault, 0.3, ("H", "load"))
        assert not found.status, found.status
_, found, _ = run(pair(), {}, BusFault(2, 0.1, 0.6), 4.0)
assert "lost synchronism" in found.status
_, found, _ = run(behind_a_line(), {3: 80.0}, BusFault(2, x_f=0.3), 0.3, facilities={3: constant_power()})
assert "voltage collapse" in found.status
print("done")
"""


@pytest.mark.slow
@pytest.mark.skipif(GCC is None, reason="no gcc here")
def test_the_driver_is_clean_under_sanitizers(tmp_path: Path) -> None:
    found = [
        subprocess.run([str(GCC), f"-print-file-name={n}"], capture_output=True, text=True, check=True)
        for n in ("libasan.so", "libubsan.so")
    ]
    libraries = [run.stdout.strip() for run in found]
    if not all(Path(library).is_absolute() for library in libraries):
        pytest.skip("the sanitizers' libraries are not here")
    own = {
        **os.environ,
        "CC": str(GCC),
        "DCVRT_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": str(Path(__file__).parents[3]),
        "LD_PRELOAD": " ".join(libraries),
        "ASAN_OPTIONS": "detect_leaks=0:verify_asan_link_order=0",
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *SANITIZE], env=own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr[-6000:]
    assert done.stdout.strip() == "done"
    objects = [f for f in tmp_path.rglob("*") if f.suffix in (".so", ".dylib")]
    assert objects
    assert all(b"__asan_report" in f.read_bytes() for f in objects)
