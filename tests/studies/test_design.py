"""`dcvrt design`: what facilities need at given capacities, in words, as data, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dcvrt import facility
from dcvrt.cli import main
from dcvrt.studies import design as designing
from dcvrt.studies.study import Study

SMALL = """
[study]
name = "two sites"
[grid]
case = "ieee118"
sites = [21, 75]
[[fault]]
bus = 25
[[fault]]
bus = 80
[[period]]
name = "peak"
hour = "peak"
[facility]
modes = ["gfl"]
beta = [1.1, 1.2]
[replay]
engine = "native"
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("design") / "small.toml"
    path.write_text(SMALL)
    return path


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["design", *arguments])
    return int(ended.value.code or 0)


def test_every_answer_passes_and_the_value_below_it_fails(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(str(file), "--hosting", "21=30,75=150", "--json") == 0
    answers = {(a["site"], a["parameter"]): a for a in json.loads(capsys.readouterr().out)}
    assert set(answers) == {(s, p) for s in (21, 75) for p in ("beta", "bess.P_dis", "dc.T_hold")}
    for answer in answers.values():
        assert answer["confirmed"]
        passes, *below = answer["replay"]
        assert passes["passed"]
        assert passes["value"] == answer["value"]
        assert (answer["ends_at"] == "range") == (not below)
        for trial in below:
            assert not trial["passed"]
            assert 0.99 * answer["value"] <= trial["value"] < answer["value"]
    rating = answers[21, "beta"]
    assert (rating["ends_at"], rating["rating"]) == ("margin", None)
    # A loss of at most a quarter of the import, which the rating has to bring at the retained voltage.
    assert 1.0 < rating["value"] < 1.3
    step = answers[21, "bess.P_dis"]["rating"]
    assert step == pytest.approx(round(step / 0.05) * 0.05)
    assert rating["value"] <= step < rating["value"] + 0.05
    assert answers[75, "bess.P_dis"]["ends_at"] == "sequence"
    assert "events change; below: DC link voltage left" in answers[75, "bess.P_dis"]["why"]


def test_the_rating_follows_the_voltage_that_the_grid_retains(file: Path) -> None:
    """More hosted at a site lowers its voltage in the fault; the static law then asks (1 - lambda) d/V."""
    setting = Study.load(file).setting()
    found = []
    for mw in (10.0, 50.0):
        ask = designing.Ask({21: mw}, ("gfl",), ("beta",), None, None, None, "native")
        exposures = designing.exposures_of(setting, ask)[21]
        retained = min(float(exposure.waveform.magnitude.min()) for exposure in exposures)
        (answer,) = designing.design(setting, ask)
        found.append((retained, answer.value))
        assert answer.value == pytest.approx(0.75 * setting.d["peak"] / retained, rel=0.02)
    assert found[1][0] < found[0][0]
    assert found[1][1] > found[0][1]


def test_the_study_may_set_parameters_and_criteria(file: Path, tmp_path: Path) -> None:
    strict = tmp_path / "strict.toml"
    strict.write_text(SMALL.replace("beta = [1.1, 1.2]", "beta = [1.1, 1.2]\n[criteria]\nloss_share = 0.2"))
    values = []
    for path in (file, strict):
        ask = designing.Ask({21: 30.0}, ("gfl",), ("beta",), None, None, None, "native")
        (answer,) = designing.design(Study.load(path).setting(), ask)
        values.append(answer.value)
    assert values[1] / values[0] == pytest.approx(0.80 / 0.75, rel=5e-3)


def test_a_table_of_eighty_columns_says_what_decides(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(file), "--hosting", "21=30", "--parameter", "beta") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["two sites", "bus 21: 30 MW; 2 fault(s) in 1 period(s), simulated by native"]
    assert max(map(len, lines)) <= 80
    assert lines[2].split() == [
        "mode",
        "bus",
        "MW",
        "parameter",
        "beta",
        "least",
        "just",
        "below",
        "what",
        "decides",
    ]
    assert lines[4].split()[:4] == ["gfl", "21", "30", "beta"]
    assert "loss, fault bus 25, 100" in lines[4]
    above, below = (float(text) for text in lines[5].split()[:2])
    assert above > 0 > below


def test_no_answer_in_the_range_is_code_three_and_tells_what_stops_it(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = (str(file), "--hosting", "21=30", "--parameter", "beta", "--high", "1.05", "--json")
    assert run(*asked) == 3
    (answer,) = json.loads(capsys.readouterr().out)
    assert answer["value"] is None
    assert answer["why"].startswith(
        "no value tried from 0.8 to 1.05 passes; nearest at 1.05: loss margin -0.0"
    )
    assert answer["why"].endswith("fault bus 25, 100 ms, peak, NORMAL>MIXED>NORMAL")
    assert answer["best"]["value"] == 1.05


@pytest.mark.parametrize("engine", ["native", "andes"])
def test_capacities_that_the_grid_cannot_carry_have_no_answer(
    file: Path, engine: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Code 3, the reason once for all faults; a fault that ends badly is another matter."""
    assert run(str(file), "--hosting", "21=500", "--engine", engine) == 3
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert said[0].startswith("design: ieee118, peak: power flow has no solution")


def test_a_fault_without_a_simulation_is_named(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    status = "ieee118, peak, fault at bus 25, 100 ms: lost synchronism at t = 0.9 s"
    monkeypatch.setattr(designing.replay, "fault_runs", lambda request: [("bus 25, 100 ms", None, status)])
    assert run(str(file), "--hosting", "21=30") == 4
    assert status in capsys.readouterr().err


def test_without_a_rating_nothing_else_is_sought(file: Path, tmp_path: Path) -> None:
    hasty = tmp_path / "hasty.toml"
    hasty.write_text(
        SMALL.replace("beta = [1.1, 1.2]", 'beta = [1.1, 1.2]\n[facility.parameters]\n"sup.T_dip" = 0.03')
    )
    ask = designing.Ask({21: 30.0}, ("gfl",), (), None, None, None, "native")
    rating, power, hold = designing.design(Study.load(hasty).setting(), ask)
    assert rating.value is None
    assert "BATTERY" in rating.why
    assert (power.why, hold.why) == ("not sought: no rating passes",) * 2
    assert power.as_data()["value"] is None


def test_everything_wrong_is_told_at_once(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("--hosting", "21=-5,x=3,76=10,21=4", "--mode", "gfk", "--parameter", "bess.P_diss")
    code = run(str(file), *asked, "--mode", "gfl", "--low", "9", "--beta", "0.1", "--engine", "native2")
    assert code == 2
    told = capsys.readouterr().err.splitlines()
    unknown = next(line for line in told if "bess.P_diss" in line)
    told.remove(unknown)
    assert unknown.startswith(
        "  --parameter bess.P_diss: variant 'gfl' has no such parameter. Did you mean 'bess.P_dis'? Known: "
    )
    assert told == [
        "design: 8 problems",
        "  --hosting x=3: write SITE=MW, for example --hosting 21=30,75=150.",
        "  --hosting 21=4: site 21 has a capacity already. Way out: give it once.",
        "  --hosting 21=-5: must be a number of MW, at least 0.",
        "  --hosting 76=10: no candidate site. Known: 21, 75.",
        f"  --mode gfk: no such variant. Did you mean 'gfm'? Known: {', '.join(facility.names())}.",
        "  --beta: beta = 0.1 is outside [0.8, 2].",
        "  --engine native2: no such simulator. Did you mean 'native'? Known: andes, native.",
    ]


def test_an_unknown_mode_hides_no_unknown_parameter(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(file), "--hosting", "21=30", "--mode", "gfk", "--parameter", "bess.P_diss") == 2
    told = capsys.readouterr().err.splitlines()
    assert told[0] == "design: 2 problems"
    assert told[1].startswith("  --mode gfk: no such variant. Did you mean 'gfm'?")
    assert told[2].startswith("  --parameter bess.P_diss: variant 'gfl' has no such parameter. Did you mean")


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ((), "--hosting is needed, for example --hosting 21=30,75=150."),
        (("--hosting", "21=0"), "--hosting: nothing is hosted, so there is no facility to design."),
        (
            ("--hosting", "21=30", "--low", "1"),
            "--low, --high: of which parameter? Way out: name one with --parameter.",
        ),
        (
            ("--hosting", "21=30", "--parameter", "beta", "--beta", "1.2"),
            "--beta: is what is sought. Way out: leave it out, or seek another --parameter.",
        ),
        (
            ("--hosting", "21=30", "--parameter", "dc.T_hold", "--high", "2"),
            "--parameter dc.T_hold = 2 s is outside [0.001, 1].",
        ),
        (
            ("--hosting", "21=30", "--parameter", "pf"),
            "--parameter pf: is set by the site, the period and the grid, and cannot be sought.",
        ),
    ],
)
def test_what_cannot_be_asked(
    file: Path, capsys: pytest.CaptureFixture[str], asked: tuple[str, ...], told: str
) -> None:
    assert run(str(file), *asked) == 2
    assert capsys.readouterr().err == f"design: {told}\n"
