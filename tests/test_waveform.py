"""Waveforms: what the interpolant keeps, what the constructors build, what is refused and how."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dcvrt.errors import InputError
from dcvrt.waveform import Waveform


def error_of(call) -> str:
    with pytest.raises(InputError) as error:
        call()
    return str(error.value)


# -- interpolation ------------------------------------------------------------------------------------------


def test_steps_and_ramps_are_met_exactly() -> None:
    w = Waveform.segments([(0.0, 1.0), (0.1, 0.5), (0.2, 0.6, 1.0), (0.6, 1.0)], until=1.0)
    t = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.6, 0.9, 5.0])
    assert w.at(t).real == pytest.approx([1.0, 0.5, 0.5, 0.6, 0.7, 1.0, 1.0, 1.0], abs=1e-15)
    assert w.jumps == (0.1, 0.2, 0.6)
    fine = w.at(np.linspace(0, 1, 5001)).real
    assert (fine.min(), fine.max()) == (0.5, 1.0)


def test_smooth_samples_are_interpolated_to_third_order() -> None:
    def error(n: int) -> float:
        t = np.linspace(0, 1, n)
        fine = np.linspace(0.1, 0.9, 997)
        w = Waveform.from_samples(t, np.exp(1j * np.sin(5 * t)))
        return float(np.abs(w.at(fine) - np.exp(1j * np.sin(5 * fine))).max())

    assert np.log2(error(41) / error(81)) == pytest.approx(3.0, abs=0.35)


def test_the_curve_is_c1_between_jumps() -> None:
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.01, 0.1, 20))
    t[8] = t[7]
    w = Waveform.from_samples(t, rng.uniform(0.5, 1, 20) + 1j * rng.uniform(-1, 1, 20))
    p = w.pieces()
    ends = p.coefficients.sum(axis=1)
    slopes = p.coefficients[:, 1] / p.length
    end_slopes = (p.coefficients[:, 1] + 2 * p.coefficients[:, 2] + 3 * p.coefficients[:, 3]) / p.length
    joined = ~p.after_jump[1:]
    assert (~joined).sum() == 1
    assert ends[:-1][joined] == pytest.approx(p.coefficients[1:, 0][joined], abs=1e-12)
    assert end_slopes[:-1][joined] == pytest.approx(slopes[1:][joined], abs=1e-9)


@given(st.integers(0, 10_000))
def test_the_interpolant_is_linear_in_the_samples(seed: int) -> None:
    """So a tangent on the samples is the derivative of the curve."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 15))
    t = np.cumsum(rng.uniform(0.01, 0.3, n))
    v, d = rng.uniform(-1, 1, size=(2, n)) + 1j * rng.uniform(-1, 1, size=(2, n))
    w = Waveform(t, v, {"H": d})
    times = rng.uniform(t[0], t[-1], 30)
    moved = Waveform(t, v + 0.37 * d).at(times)
    assert moved == pytest.approx(w.at(times) + 0.37 * w.pieces("H").at(times), abs=1e-10)


def test_pieces_may_be_refined() -> None:
    w = Waveform.from_samples([0.0, 0.2, 0.5, 0.5, 0.8], [1, 0.9, 0.95, 0.4, 0.6])
    start = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 0.6])
    length = np.diff(np.append(start, 0.8))
    c = w.pieces().on(start, length)
    assert c.sum(axis=1) == pytest.approx([w.at(0.1), w.at(0.2), w.at(0.35), 0.95, w.at(0.6), 0.6], abs=1e-12)
    assert (c @ 0.5 ** np.arange(4)) == pytest.approx(w.at(start + length / 2), abs=1e-12)


# -- constructors -------------------------------------------------------------------------------------------


def test_sag_with_phase_jump() -> None:
    w = Waveform.sag(0.5, 0.1, 0.15, until=1.0, phase_jump=-0.4)
    assert w.at(0.2) == pytest.approx(0.5 * np.exp(-0.4j))
    assert (w.start, w.until, w.jumps) == (0.0, 1.0, (0.1, 0.25))
    assert Waveform.sag(0.5, 0.1, 5.0, until=1.0).at(1.0) == 0.5


def test_jumps_between_samples_can_be_marked() -> None:
    w = Waveform.from_samples([0, 1, 2, 3], [1, 1, 0.5, 0.5], tangents={"H": [0, 0, 2, 2]}, jumps=[1.5])
    assert w.t.tolist() == [0, 1, 1.5, 1.5, 2, 3]
    assert w.magnitude.tolist() == [1, 1, 1, 0.5, 0.5, 0.5]
    assert w.tangents["H"].real.tolist() == [0, 0, 0, 2, 2, 2]
    at_sample = Waveform.from_samples([0, 1, 2, 3], [1, 1, 0.5, 0.5], jumps=[2])
    assert at_sample.t.tolist() == [0, 1, 2, 2, 3]
    assert at_sample.magnitude.tolist() == [1, 1, 1, 0.5, 0.5]


def test_resampling_keeps_values_and_jumps() -> None:
    w = Waveform.from_samples(
        [0, 0.1, 0.3, 0.3, 0.7], [1, 0.8, 0.9, 0.4, 0.5], tangents={"H": [1, 2, 3, 4, 5]}
    )
    r = w.resampled(0.01)
    assert r.jumps == (0.3,)
    assert np.diff(r.t).max() <= 0.01 + 1e-12
    inner = np.array([0.05, 0.2, 0.29, 0.35, 0.6])
    assert r.at(inner) == pytest.approx(w.at(inner), abs=1e-4)
    k = np.flatnonzero(r.t == 0.3)
    assert r.v[k].real == pytest.approx([0.9, 0.4])
    assert r.tangents["H"][k].real == pytest.approx([3, 4])


def test_layout_shift_and_pickle() -> None:
    w = Waveform.sag(0.5, 0.1, 0.1, until=1.0)
    assert w.same_layout(Waveform.sag(0.3, 0.1, 0.1, until=1.0))
    assert not w.same_layout(w.shifted(0.5))
    assert w.shifted(0.5).jumps == (0.6, 0.7)
    again = pickle.loads(pickle.dumps(Waveform(w.t, w.v, {"H": w.v}, "mine")))
    assert again.same_layout(w)
    assert (again.name, list(again.tangents)) == ("mine", ["H"])
    with pytest.raises(ValueError, match="read-only"):
        w.v[0] = 0.0


def test_ercot_style_stands_on_the_published_boundaries() -> None:
    w = Waveform.ercot_style()
    assert "not the official" in w.name
    assert {0.2, 0.5, 0.8, 1.2} <= set(w.magnitude.tolist())
    low = [0.0, *(float(np.ptp(w.t[w.magnitude == level])) for level in (0.2, 0.5))]
    assert low == pytest.approx([0.0, 0.25, 0.25])


# -- files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "t,v_re,v_im\n0,1,0\n0.1,0.3,-0.4\n",
        "\ufefft;v_re;v_im\n0;1;0\n0,1;0,3;-0,4\n",
        "2\ntime [s]\tv_re (pu)\tv_im\n0\t1\t0\n0.1\t0.3\t-0.4\n",
        "# from a recorder\nT, Magnitude, Angle_deg\n0,1,0\n0.1,0.5,-53.13010235415598\n",
    ],
    ids=["plain", "bom-semicolon-decimal-comma", "count-line-tabs-units", "magnitude-angle"],
)
def test_csv_dialects(tmp_path: Path, text: str) -> None:
    (tmp_path / "w.csv").write_text(text, encoding="utf-8")
    w = Waveform.from_csv(tmp_path / "w.csv")
    assert w.v == pytest.approx([1, 0.3 - 0.4j], abs=1e-12)
    assert (w.t.tolist(), w.name) == ([0, 0.1], "w")


def test_three_phases_are_reduced_as_asked(tmp_path: Path) -> None:
    path = tmp_path / "phases.csv"
    path.write_text("t,v_a,v_b,v_c\n0,1,1,1\n1,0.2,0.9,1.0\n", encoding="utf-8")
    assert Waveform.from_csv(path, phases="minimum").magnitude.tolist() == [1, 0.2]
    assert Waveform.from_csv(path, phases="mean").magnitude == pytest.approx([1, 0.7])
    assert error_of(lambda: Waveform.from_csv(path)) == (
        f"{path}: waveform table has three phases v_a, v_b, v_c: say phases='minimum' or phases='mean'; "
        "the model is positive-sequence."
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("u,v\n0,1\n1,1\n", "waveform table has no column 't' (or time, t_s, time_s, seconds). Found: u, v."),
        (
            "t,p\n0,1\n1,1\n",
            "waveform table has no voltage column: v_re and v_im, or one of v, vm, v_mag, v_pu, v_poi, "
            "v_poi_pu, magnitude, voltage (with angle_deg), or v_a, v_b and v_c. Found: t, p.",
        ),
        ("t,v\n0,1\n1,x\n", "line 3, column 'v': 'x' is not a number."),
        ("t,v\n0,1\n1\n", "line 3 has 1 cells, the table 2."),
        ("t,v\n", "waveform 'w': 0 sample(s); at least two times are needed."),
        ("0,1\n1,1\n", "the table has no header; name its columns, for example t,v_re,v_im."),
        ("t,v\n0,x\n1,1\n2,1\n", "line 2, column 'v': 'x' is not a number."),
        ("t,v\n0,1\n2,1\n1,1\n", "waveform 'w': times do not increase: t[2] = 1 s comes after t[1] = 2 s."),
    ],
)
def test_unusable_tables(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "w.csv"
    path.write_text(text, encoding="utf-8")
    assert error_of(lambda: Waveform.from_csv(path)) == f"{path}: {message}"


def test_a_record_with_a_gap_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.csv"

    def record(*times: float) -> Path:
        path.write_text("t,v\n" + "".join(f"{t:.6g},1\n" for t in times), encoding="utf-8")
        return path

    before, after = (np.arange(30) * 0.01 + start for start in (0.0, 5.0))
    assert error_of(lambda: Waveform.from_csv(record(*before, *after))) == (
        f"{path}: no sample between 0.29 s and 5 s of a record with one every 0.01 s. "
        "Fill the gap, or give the part before or after it."
    )
    assert len(Waveform.from_csv(record(*before, *(before + 0.39))).t) == 60  # ten steps without a sample
    assert len(Waveform.from_csv(record(0.0, 0.1, 0.1, 0.25, 0.25, 5.0)).t) == 6  # points set by hand
    assert len(Waveform.from_csv(record(*before, 0.3, 0.3, *(before + 0.31))).t) == 62  # a jump in a record


def test_missing_file(tmp_path: Path) -> None:
    path = tmp_path / "none.csv"
    assert error_of(lambda: Waveform.from_csv(path)) == f"{path}: there is no such file."


def test_comtrade_channels_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    record = SimpleNamespace(
        time=[0.0, 0.1], analog_channel_ids=["VMAG", "VANG"], analog=[[230.0, 115.0], [0.0, 90.0]]
    )
    monkeypatch.setitem(sys.modules, "comtrade", SimpleNamespace(load=lambda path: record))
    w = Waveform.from_comtrade("rec.cfg", "VMAG", "VANG", base=230.0)
    assert w.v == pytest.approx([1, 0.5j])
    message = error_of(lambda: Waveform.from_comtrade("rec.cfg", "VMG"))
    assert message == "rec.cfg: no analogue channel 'VMG'. Did you mean 'VMAG'? Known: VMAG, VANG."


def test_comtrade_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "comtrade", None)
    assert error_of(lambda: Waveform.from_comtrade("rec.cfg", "V")) == (
        "Reading COMTRADE needs the package 'comtrade': pip install 'dcvrt[comtrade]'. "
        "Or export the record to CSV and use Waveform.from_csv."
    )


# -- refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("t", "v", "message"),
    [
        ([0, 1, 2], [1, np.nan, np.nan], "waveform: v[1] is nan and 1 more."),
        ([0, np.inf], [1, 1], "waveform: t[1] is inf."),
        ([0, 2, 1], [1, 1, 1], "waveform: times do not increase: t[2] = 1 s comes after t[1] = 2 s."),
        (
            [0, 1, 1, 1, 2],
            [1] * 5,
            "waveform: t[1] = t[2] = t[3] = 1 s: a time may stand twice (a jump), not three times.",
        ),
        ([], [], "waveform: 0 sample(s); at least two times are needed."),
        ([1, 1], [1, 0.5], "waveform: it lasts no time: first and last time are 1 s."),
        ([0, 1], [1], "waveform: t has shape (2,) and v (1,); both must be one column of the same length."),
    ],
)
def test_unusable_samples(t: list, v: list, message: str) -> None:
    assert error_of(lambda: Waveform(np.array(t), np.array(v))) == message


def test_unusable_tangents_and_lookups() -> None:
    message = error_of(lambda: Waveform(np.arange(2), np.ones(2), {"H": np.array([1, np.nan])}))
    assert message == "waveform: tangents['H'][1] is nan."
    w = Waveform(np.arange(2), np.ones(2), {"H_75": np.ones(2)}, "w")
    message = error_of(lambda: w.pieces("H_57"))
    assert message == "waveform 'w' has no tangent 'H_57'. Did you mean 'H_75'? Known: H_75."


def test_unusable_arguments() -> None:
    assert error_of(lambda: Waveform.segments([])) == (
        "waveform: no segments given; write for example [(0.0, 1.0), (0.1, 0.5), (0.2, 1.0)]."
    )
    assert error_of(lambda: Waveform.segments([(0.0, 1.0), (0.0, 0.5)], until=1.0)) == (
        "waveform: segment 0 begins at 0 s and ends at 0 s; times must increase."
    )
    assert error_of(lambda: Waveform.segments([(0.0,)])) == (  # type: ignore[list-item]
        "waveform: segment 0 is (0.0,); write (t, v) or (t, v_from, v_to)."
    )
    assert error_of(lambda: Waveform.sag(0.5, 0.1, 0.0, 1.0)) == (
        "sag: retained = 0.5 pu must not be negative, length = 0 s not zero."
    )
    assert error_of(lambda: Waveform.from_samples([0, 1], [1, 1], jumps=[3])) == (
        "waveform: jump at 3 s is outside (0, 1) s."
    )
    assert (
        error_of(lambda: Waveform.sag(0.5, 0.1, 0.1, 1.0).resampled(0.0))
        == "waveform: dt = 0 s must be positive."
    )


def test_volts_are_not_taken_for_per_unit() -> None:
    with pytest.raises(InputError) as error:
        Waveform.from_samples([0.0, 1.0], [230.0, 231.0], name="site")
    assert str(error.value) == (
        "waveform 'site': |v[1]| = 231 pu at 1 s is above 3 pu. "
        "Divide by the nominal voltage: a waveform is in per unit."
    )


def test_a_magnitude_is_not_negative_but_a_phasor_may_point_anywhere(tmp_path: Path) -> None:
    sentence = "pu is negative. Write a complex value to turn the phasor."
    with pytest.raises(InputError) as error:
        Waveform.from_samples([0.0, 1.0], [1.0, -1.0], name="site")
    assert str(error.value) == f"waveform 'site': v[1] = -1 {sentence}"
    with pytest.raises(InputError) as error:
        Waveform.segments([(0.0, 1.0), (0.5, -0.4)])
    assert str(error.value) == f"waveform: segment 1[0] = -0.4 {sentence}"
    table = tmp_path / "w.csv"
    table.write_text("t,v_pu\n0,1\n1,-0.5\n")
    with pytest.raises(InputError) as error:
        Waveform.from_csv(table)
    assert str(error.value) == f"{table}: waveform table: v_pu[1] = -0.5 {sentence}"
    assert Waveform.from_samples([0.0, 1.0], [1.0 + 0j, -1.0 + 0j]).at(1.0) == pytest.approx(-1.0)


@pytest.mark.parametrize("bad", [dict(retained=-0.1), dict(length=0.0), dict(length=float("nan"))])
def test_a_sag_has_a_depth_and_a_length(bad: dict[str, float]) -> None:
    with pytest.raises(
        InputError, match=r"^sag: retained = .* pu must not be negative, length = .* s not zero\.$"
    ):
        Waveform.sag(**(dict(retained=0.5, start=0.1, length=0.1, until=1.0) | bad))
