"""The command line: answers at once, one clear message for each mistake, exit codes that scripts can use."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from dcvrt import __version__
from dcvrt.cli import main
from dcvrt.errors import InfeasibleError, InputError, SimulationError

HEAVY = (
    "numpy",
    "scipy",
    "casadi",
    "andes",
    "highspy",
    "pandas",
    "matplotlib",
    "dask",
    "distributed",
    "pydantic",
)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return int(ended.value.code or 0)


def study(folder: Path, *replacements: tuple[str, str]) -> Path:
    from dcvrt.studies.config import template

    text = template()
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "my.toml").write_text(text)
    return folder / "my.toml"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from dcvrt.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit as end: assert not end.code\n"
        f"print('loaded:', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.stdout.splitlines()[-1] == "loaded: []"
    for command in ("study", "ride", "facility", "doctor"):
        assert command in done.stdout


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out == f"dcvrt {__version__}\n"


def test_a_new_study_file_is_in_order_and_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    assert run("study", "new", str(file)) == 0
    assert tomllib.loads(file.read_text())["grid"]["sites"] == [21, 75, 106, 108]
    assert run("study", "check", str(file)) == 0
    assert "in order: 4 sites, 7 faults, 3 periods, 2 modes" in capsys.readouterr().out
    file.write_text("mine")
    assert run("study", "new", str(file)) == 2
    assert capsys.readouterr().err == f"{file} exists already. Way out: another name; nothing was written.\n"
    assert file.read_text() == "mine"


def test_a_bad_study_file_is_one_message_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = study(tmp_path, ("bus = 25 ", "bus = 75 "), ("pf = 0.98", "pf = -1.0"))
    out = tmp_path / "out"
    for command in (("study", "check", str(file)), ("study", "run", str(file), "--out", str(out))):
        assert run(*command) == 2
        said = capsys.readouterr()
        assert said.err.splitlines() == [
            f"{file}: 2 problems",
            "  hosting.pf = -1.0: must be above 0.",
            "  fault[1].bus = 75: is a candidate bus; a site cannot ride through a fault at its own "
            "terminals. "
            "Way out: take a neighbouring bus, or drop it from grid.sites.",
        ]
    assert not out.exists(), "nothing is written for a study that cannot run"


def test_an_infeasible_base_case_is_code_3_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = study(tmp_path, ("rating_scale = 0.6", "rating_scale = 0.38"))
    assert run("study", "run", str(file), "--out", str(tmp_path / "out"), "--workers", "1") == 3
    assert capsys.readouterr().err.splitlines()[1:] == [
        "ieee118: the base case has no dispatch in 53 of 8760 hours (hours 7768-7770, 8104-8106, 8265-8266, "
        "8272-8275, 8296-8298, 8321-8322, 8417-8418, 8432-8443, 8456-8461, 8464-8467 and 12 more) with "
        "nothing hosted.",
        "  Worst hour 8441: branches are overloaded by 4.667 MW whatever the dispatch: 77-78 (rated 57.38 "
        "MVA), "
        "77-80 (rated 53.58 MVA).",
        "Ways out: a larger rating_scale (now 0.38), or more generation behind these branches, or leave "
        "these hours out.",
    ]
    assert not (tmp_path / "out").exists()


def test_no_workers_is_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("study", "run", "--workers", "0", "--out", str(tmp_path / "out")) == 2
    assert "workers = 0: needs at least 1." in capsys.readouterr().err


def test_a_report_needs_a_study_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("study", "report", str(tmp_path)) == 2
    assert capsys.readouterr().err == (
        f"{tmp_path / 'study.sqlite'}: no study store. Way out: name a folder that "
        "'dcvrt study run' has made.\n"
    )


def test_a_study_with_a_task_set_aside_is_incomplete(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from dcvrt.cli import _show
    from dcvrt.studies.store import Store
    from dcvrt.studies.study import Result
    from tests.studies.synthetic import make

    folder = make(tmp_path / "folder")
    with Store(folder / "study.sqlite", write=True) as store:
        store.add_tasks([("ab12" * 16, "samples", "{}")])
        store.set_task("ab12" * 16, "quarantined", "its worker died 3 times while doing it")
    with pytest.raises(typer.Exit) as ended:
        _show(Result.of(folder))
    assert ended.value.exit_code == 4
    said = capsys.readouterr()
    assert said.err == (
        "samples task ab12ab12ab12: quarantined: its worker died 3 times while doing it\n"
        "The study is incomplete: plans with missing runs count as failed. Way out: look at the messages "
        "above, then run again with --retry.\n"
    )
    assert "no ride-through" in said.out


def test_a_missing_study_file_says_how_to_get_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "none.toml"
    assert run("study", "check", str(file)) == 2
    assert (
        capsys.readouterr().err
        == f"{file}: no such study file. Way out: 'dcvrt study new {file}' writes one to edit.\n"
    )


def test_schema_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("study", "schema") == 0
    assert '"title": "dcvrt study"' in capsys.readouterr().out


def test_facility_list_and_sheet(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("facility", "list") == 0
    head, _, first, second = capsys.readouterr().out.splitlines()[:4]
    assert head.split() == ["name", "what", "it", "is", "states", "modes"]
    assert [line.split()[0] for line in (first, second)] == ["gfl", "gfm"]
    assert first.rstrip().endswith("sup: NORMAL MIXED BATTERY RETURN")
    assert run("facility", "sheet", "gfl") == 0
    piped = capsys.readouterr().out
    assert piped.startswith("# gfl\n")
    assert "V_dip" in piped
    assert run("facility", "sheet", "gfl", "--markdown") == 0
    assert capsys.readouterr().out == piped
    assert run("facility", "sheet", "gfl", "--latex") == 0
    assert capsys.readouterr().out.startswith("\\documentclass")
    assert run("facility", "sheet", "gfl", "--latex", "--markdown") == 2
    assert capsys.readouterr().err == (
        "--markdown and --latex exclude each other. Way out: one of the two.\n"
    )
    assert run("facility", "sheet", "gfx") == 2
    assert capsys.readouterr().err.startswith("there is no facility variant 'gfx'. Did you mean 'gf")


def test_a_sheet_in_a_terminal_has_formulas_that_can_be_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")
    assert run("facility", "sheet", "gfm") == 0
    said = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert "2 H_v ω̇ = (P^g - P^eff)/H - D (ω - 1)" in said
    assert "\\frac" not in said
    assert "$" not in said
    assert max(len(line) for line in said.splitlines()) <= 100


def test_ride_shows_margins_and_events_and_writes_signals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("ride", "gfl", "--waveform", "sag-70", "--beta", "1.3", "--out", str(tmp_path / "ride")) == 0
    said = capsys.readouterr().out
    assert "status: completed" in said
    assert "voltage margin: +" in said
    assert "NORMAL -> MIXED" in said
    base, header, first = (tmp_path / "ride" / "signals.csv").read_text().splitlines()[:3]
    assert base.startswith("# per unit")
    assert header.startswith("t_s,v_it,p_g")
    assert first.startswith("0.000000,")
    assert (tmp_path / "ride" / "signals.svg").read_text().startswith("<?xml")


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (
            "t,u\n0,1\n1,1\n",
            "waveform table has no voltage column: v_re and v_im, or one of v, vm, v_mag, v_pu, v_poi, "
            "v_poi_pu, "
            "magnitude, voltage (with angle_deg), or v_a, v_b and v_c. Found: t, u.",
        ),
        ("t,v\n0,1\n1,nan\n2,1\n", "waveform 'w': v[1] is (nan+nanj)."),
        (
            "t,v\n0,1\n2,1\n1,1\n",
            "waveform 'w': times do not increase: t[2] = 1 s comes after t[1] = 2 s.",
        ),
    ],
)
def test_ride_refuses_a_bad_waveform(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, told: str
) -> None:
    file = tmp_path / "w.csv"
    file.write_text(table)
    assert run("ride", "gfl", "--waveform", str(file), "--out", str(tmp_path / "ride")) == 2
    said = capsys.readouterr()
    assert said.err == f"{file}: {told}\n"
    assert said.out == ""
    assert not (tmp_path / "ride").exists()


def test_ride_refuses_an_unknown_waveform_and_a_rating_out_of_bounds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("ride", "gfl", "--waveform", "sag-71") == 2
    assert capsys.readouterr().err == (
        "waveform 'sag-71': no such file and no such scenario. Did you mean 'sag-70'? "
        "Known: ercot-style, sag-30, sag-50, sag-70, sag-85, six-sags, reclosing, interruption, swell, "
        "phase-jump, frequency-ramp, frequency-step, ... (14 in all).\n"
    )
    assert run("ride", "gfl", "--waveform", "sag-70", "--beta", "9") == 2
    assert capsys.readouterr().err == "beta = 9 is outside [0.8, 2].\n"


def test_ride_takes_scenarios_and_other_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ride", "gfl", "--waveform", "six-sags", "--set", "sup.T_deep=0.1") == 0
    said = capsys.readouterr().out
    assert said.startswith("gfl on 6 sags within 82 s, seed 0, beta 1.15, sup.T_deep 0.1, on the base")
    assert said.count("NORMAL -> MIXED  [") == 6
    assert "BATTERY" not in said


def test_ride_against_an_envelope_that_is_met_is_code_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ride", "gfl", "--against", "spp-hill") == 0
    said = capsys.readouterr()
    lines = said.out.splitlines()
    assert lines[0] == "gfl against SPP HILL, Southwest Power Pool: beta 1.15"
    assert "  note: constant current in the sag, not constant power [P, P2]" in lines
    assert "3 pass" in lines
    assert "evidence: P: primary text read; P2: digest that quotes the primary text" in lines
    assert lines[-1] == (
        "Screening only: compare the numbers with the code in force before anyone relies on them."
    )
    assert max(map(len, lines)) <= 160
    assert said.err == ""


def test_ride_against_an_envelope_that_is_not_met_is_code_3_and_writes_all_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import csv

    out = tmp_path / "ride"
    assert run("ride", "gfl", "--against", "nerc-prc-024", "--beta", "1.3", "--out", str(out)) == 3
    said = capsys.readouterr().out
    assert "3 pass, 8 FAIL" in said.splitlines()
    assert "for protection of generators: for comparison, no requirement on loads" in said
    head, *table = (out / "verdicts.csv").read_text().splitlines()
    assert head.startswith("# NERC PRC-024; marks of evidence: P = primary text read, ")
    rows = list(csv.DictReader(table))
    first = next(row for row in rows if row["segment"] == "0.75-0.9 pu, 3 s")
    assert (first["verdict"], first["evidence"], first["requirement"]) == ("FAIL", "P", "connected")
    assert first["what_it_did"].endswith("v_f < V_dip or v_f > V_swell held T_dip")
    assert len({row["segment"] for row in rows}) == 11
    signals = sorted(path.name for path in (out / "signals").iterdir())
    assert (len(signals), signals[2]) == (11, "03-0.75-0.9-pu-3-s.csv")
    assert (out / "envelope.svg").read_text().startswith("<?xml")
    assert (out / "envelope.png").stat().st_size > 10_000


def test_an_unverified_number_is_shown_as_such(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ride", "gfl", "--against", "semi-f47") == 0
    said = capsys.readouterr().out
    assert "status: industry standard [K]" in said
    assert "K: background knowledge, NOT verified" in said
    assert len([line for line in said.splitlines() if " pass " in line and " K " in line]) == 4


def test_ride_says_what_is_missing_or_too_much(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    way_out = "Way out: --waveform for one course of the voltage, --against for every item of a code.\n"
    assert run("ride", "gfl") == 2
    assert capsys.readouterr().err == (
        f"ride needs either --waveform or --against; neither is there. {way_out}"
    )
    assert run("ride", "gfl", "--waveform", "sag-50", "--against", "spp-hill") == 2
    assert capsys.readouterr().err == f"ride needs either --waveform or --against; both are there. {way_out}"
    assert run("ride", "gfl", "--against", "spp-hil") == 2
    assert capsys.readouterr().err.startswith(
        "there is no envelope 'spp-hil'. Did you mean 'spp-hill'? Known: ercot-nogrr282, caiso-straw-2026, "
    )
    assert run("ride", "gfl", "--against", "spp-hill", "--set", "sup.Tdip=1") == 2
    assert capsys.readouterr().err.startswith(
        "gfl has no parameter 'sup.Tdip'. Did you mean 'sup.T_dip'? Known: "
    )
    out = tmp_path / "file"
    out.write_text("")
    assert run("ride", "gfl", "--against", "spp-hill", "--out", str(out)) == 2
    assert capsys.readouterr().err == (
        f"{out} is a file, not a folder. Way out: take another folder with --out.\n"
    )


def test_ride_refuses_settings_it_cannot_read_all_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    settings = ("sup.T_dip", "sup.T_deep=x", "beta=1.2", "pf=0.9", "pf=0.95")
    assert run("ride", "gfl", "--waveform", "sag-50", *(a for s in settings for a in ("--set", s))) == 2
    form = "write NAME=VALUE with a number, for example --set sup.T_dip=2.5."
    assert capsys.readouterr().err.splitlines() == [
        "ride: 4 problems",
        f"  --set sup.T_dip: {form}",
        f"  --set sup.T_deep=x: {form}",
        "  --set beta=1.2: beta has a value already. Way out: use --beta.",
        "  --set pf=0.95: pf has a value already. Way out: give it once.",
    ]


def test_a_rating_without_a_start_is_one_message_and_code_4(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("ride", "gfl", "--against", "spp-hill", "--beta", "0.9") == 4
    said = capsys.readouterr()
    assert said.err.startswith("gfl: no equilibrium at the first value of the waveform.")
    assert said.out == ""


def test_ride_help_lists_scenarios_and_envelopes_and_loads_nothing_heavy() -> None:
    from dcvrt import envelopes, scenarios

    heavy = tuple(name for name in HEAVY if name != "pydantic")  # typer reads options with it
    code = (
        "import sys; from dcvrt.cli import main\n"
        "try: main(['ride', '--help'])\n"
        "except SystemExit as end: assert not end.code\n"
        f"print('loaded:', [name for name in {heavy!r} if name in sys.modules])"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.splitlines()[-1] == "loaded: []"
    for name in (*scenarios.names(), *envelopes.names()):
        assert name in done.stdout
    assert "3 the facility fails an item of the envelope" in done.stdout


def test_doctor_names_versions_compiler_and_caches(capsys: pytest.CaptureFixture[str]) -> None:
    code = run("doctor")
    said = capsys.readouterr().out
    assert code == 0
    assert f"dcvrt        {__version__}" in said
    for word in ("andes", "casadi", "highspy", "compiler", "cache"):
        assert word in said


@pytest.mark.parametrize(
    ("error", "code"), [(InputError("a"), 2), (InfeasibleError("b"), 3), (SimulationError("c"), 4)]
)
def test_each_kind_of_error_has_its_exit_code(
    error: Exception, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from dcvrt import facility

    def fail() -> None:
        raise error

    monkeypatch.setattr(facility, "names", fail)
    assert run("facility", "list") == code
    assert capsys.readouterr().err == f"{error}\n"


def test_many_sites_share_a_column() -> None:
    from dcvrt.cli import _open_sites

    row = {"bus_2_mw": 0.0, "bus_17_mw": 12.34, "bus_75_mw": 104.96}
    assert _open_sites(row, list(row)) == "17: 12.3, 75: 105.0"
