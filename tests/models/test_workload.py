"""Stochastic and measured IT workloads."""

from __future__ import annotations

import numpy as np
import pytest

from dcvrt.errors import InputError
from dcvrt.models import workload
from dcvrt.models.workload import Component, measured, synthetic


def test_a_seed_is_a_record():
    t, g = synthetic(120.0, seed=3)
    again = synthetic(120.0, seed=3)[1]
    np.testing.assert_array_equal(g, again)
    assert t[0] == 0.0
    assert t[-1] == pytest.approx(120.0)
    assert np.abs(g - synthetic(120.0, seed=4)[1]).max() > 0.01


def test_the_mean_is_one_and_the_gain_scales_the_rest():
    _, g = synthetic(300.0, gain=1.0, seed=1)
    _, half = synthetic(300.0, gain=0.5, seed=1)
    assert g.mean() == pytest.approx(1.0)
    np.testing.assert_allclose(half - 1, 0.5 * (g - 1), atol=1e-12)
    np.testing.assert_array_equal(synthetic(300.0, gain=0.0, seed=1)[1], 1.0)


def test_a_component_without_chance_is_a_square_wave_of_known_mean():
    square = Component("square", share=1.0, cycle=10.0, low=0.4, depth=0.5, jitter=0.0, noise=0.0)
    t, g = synthetic(1000.0, step=0.01, components=[square], seed=2)
    assert np.unique(np.round(g, 6)).size == 2
    assert g.min() / g.max() == pytest.approx(0.5)
    assert np.mean(g == g.min()) == pytest.approx(0.4, abs=0.002)
    falls = t[1:][np.diff(g) < 0]
    assert np.diff(falls) == pytest.approx(10.0, abs=0.011)


def test_components_are_drawn_apart():
    base, work = workload.DEFAULT[0], workload.DEFAULT[1]
    alone = synthetic(60.0, components=[base], seed=5)[1]
    pair = synthetic(60.0, components=[base, Component("none", 0.0)], seed=5)[1]
    np.testing.assert_allclose(alone, pair, atol=1e-12)
    assert work.source.startswith("public GPU power measurements")


def test_default_workload_stays_near_the_measured_swing():
    """A fully synchronised fleet was measured at peak over mean 1.44; the mixture must stay below."""
    peaks = [synthetic(300.0, seed=s)[1].max() for s in range(5)]
    assert 1.02 < max(peaks) < 1.44


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (dict(duration=1.0, step=0.0),
         "workload: duration = 1 s, step = 0 s: need step > 0 and duration of two steps at least."),
        (dict(duration=60.0, gain=-1.0), "workload: gain = -1 is negative."),
        (dict(duration=60.0, components=[]), "workload: no component has a share above 0."),
        (dict(duration=60.0, components=[Component("x", 1.0, low=1.0)]),
         "workload: component 'x': share, cycle, jitter, noise >= 0, 0 <= low < 1 and 0 <= depth <= 1."),
        (dict(duration=60.0, gain=9.0),
         "workload: gain = 9 makes the load negative; the highest for this seed is 6.21."),
    ],
)  # fmt: skip
def test_bad_workloads_are_refused(arguments, text):
    with pytest.raises(InputError) as error:
        synthetic(**arguments)
    assert str(error.value) == text


TIMES, POWERS = [0.0, 0.1, 0.2, 0.3], [2.0, 3.0, 1.0, 2.0]
EXPECTED = np.array(POWERS) / 2.0  # the trapezoidal mean over time: (1 + 3 + 1 + 1) / 3


@pytest.mark.parametrize(
    "text",
    [
        "0.0,2\n0.1,3\n0.2,1\n0.3,2\n",
        "\ufefftime,power\n10.0,2\n10.1,3\n10.2,1\n10.3,2\n",
        "4 samples\nt;p\n0,0;2,0\n0,1;3,0\n0,2;1,0\n0,3;2,0\n",
        "t\tp\n0\t2\n0.1\t3\n\n0.2\t1\n0.3\t2\n",
    ],
    ids=[
        "plain",
        "byte-order mark and header",
        "count line, semicolons, decimal commas",
        "tabs and an empty line",
    ],
)
def test_traces_in_the_forms_that_occur(tmp_path, text):
    path = tmp_path / "trace.csv"
    path.write_text(text, encoding="utf-8")
    t, g = measured(path)
    np.testing.assert_allclose(t, TIMES, atol=1e-9)
    np.testing.assert_allclose(g, EXPECTED)


def test_traces_by_column_name_and_from_npy(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text("site,when,watts\nA,0,2\nA,0.1,3\nA,0.2,1\nA,0.3,2\n", encoding="utf-8")
    np.testing.assert_allclose(measured(path, "when", "watts")[1], EXPECTED)
    array = tmp_path / "trace.npy"
    np.save(array, np.column_stack([TIMES, POWERS]))
    np.testing.assert_allclose(measured(array, gain=0.5)[1], 1 + 0.5 * (EXPECTED - 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,p\n0,1\n1,nan\n2,1\n", "1 sample(s) not finite, first in line 3. Remove or fill them."),
        ("t,p\n0,1\n2,1\n1,1\n", "times must increase; in line 4 1 s follows 2 s. Sort or clean the file."),
        ("t,p\n0,1\n1,1\n2,1\n50,1\n51,1\n",
         "gap of 48 s after 2 s (line 4); the usual step is 1 s. "
         "Fill the gap or give the part before or after it."),
        ("t,p\n0,1\n1,x\n2,1\n", "line 3, column 'p': 'x' is not a number."),
        ("t,p\n0,1\n1\n2,1\n", "line 3 has 1 cells, the table 2."),
        ("t,p\n0,1\n", "a trace needs two samples or more; it has 1."),
        ("hello\n", "no line has two columns or more."),
        ("t,p\n0,-1\n1,-1\n", "the mean power is -1; it must be positive. Is the column the right one?"),
        ("t,p\n0,1\n1,1\n2,-1\n3,1\n4,1\n",
         "with gain = 1 the load falls to -2, below 0. Take a smaller gain."),
    ],
)  # fmt: skip
def test_bad_traces_are_refused(tmp_path, text, message):
    path = tmp_path / "trace.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        measured(path)
    assert str(error.value) == f"{path}: {message}"


def test_columns_and_files_that_are_not_there(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text("t,p\n0,1\n1,1\n", encoding="utf-8")
    for arguments, message in (
        ((0, "power"), "there is no column 'power'. The columns are: t, p."),
        ((0, 7), "there is no column 7; it has 2, numbered from 0."),
    ):
        with pytest.raises(InputError) as error:
            measured(path, *arguments)
        assert str(error.value) == f"{path}: {message}"
    with pytest.raises(InputError) as error:
        measured(tmp_path / "none.csv")
    assert str(error.value) == f"{tmp_path / 'none.csv'}: there is no such file."
    np.save(tmp_path / "flat.npy", np.arange(3.0))
    with pytest.raises(InputError, match="need an array of two columns"):
        measured(tmp_path / "flat.npy")
