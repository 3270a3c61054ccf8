"""The study file: what is right is read, what is wrong is told all at once, before anything runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dcvrt import facility
from dcvrt.errors import InputError
from dcvrt.grid.network import Network
from dcvrt.planning import replay
from dcvrt.planning.security import N1
from dcvrt.studies import checks, config
from dcvrt.studies.setting import setting_of
from dcvrt.studies.tables import read_profiles

HERE = Path()


def changed(*replacements: tuple[str, str]) -> str:
    """The shipped study file with some of its text replaced; each must be there."""
    text = config.template()
    for old, new in replacements:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def complaint(text: str, folder: Path = HERE) -> str:
    with pytest.raises(InputError) as caught:
        checks.check(text, "my.toml", folder)
    return str(caught.value)


def test_the_shipped_study_is_in_order_and_is_what_the_defaults_describe() -> None:
    file = checks.check(config.template(), "ieee118.toml", HERE)
    assert file.grid.sites == [21, 75, 106, 108]
    assert len(file.fault) >= 6
    assert len(file.period) >= 3
    assert file.facility.beta[0] == 1.0
    assert file.facility.beta[-1] == 1.5
    assert not {f.bus for f in file.fault} & set(file.grid.sites)


def test_quick_keeps_faults_sites_and_modes() -> None:
    file = config.load(config.template(), "ieee118.toml")
    quick = file.quick()
    assert (quick.fault, quick.grid, quick.facility.modes) == (file.fault, file.grid, file.facility.modes)
    assert quick.sampling.n < file.sampling.n
    assert len(quick.period) < len(file.period)
    assert set(quick.facility.beta) < set(file.facility.beta)
    assert quick.facility.beta[-1] == file.facility.beta[-1]
    assert (quick.sensitivity.reruns, file.sensitivity.reruns) == (1, 3)
    assert quick.sensitivity.ranges == file.sensitivity.ranges
    assert file.system_limit.beta is not None
    assert quick.system_limit.beta is not None
    assert len(quick.system_limit.beta) == 1 < len(file.system_limit.beta)
    checks.check(config.template(), "quick", HERE)
    assert not checks.contradictions({name: getattr(quick, name) for name in config.StudyFile.model_fields})


def test_the_canonical_form_leaves_out_what_decides_nothing() -> None:
    file = config.load(config.template(), "a")
    renamed = config.load(
        changed(("IEEE-118 with", "Another name for"), ("task_timeout_s = 600.0", "task_timeout_s = 9.0")),
        "a",
    )
    reseeded = config.load(changed(("seed = 1", "seed = 2")), "a")
    asked = config.load(
        changed(("reruns = 3", "reruns = 2"), ("loss_mw = [0.0, ", "loss_mw = [0.0, 7.5, ")),
        "a",
    )
    assert file.canonical() == renamed.canonical() == asked.canonical() != reseeded.canonical()
    assert file.sensitivity != asked.sensitivity


def test_schema_is_json_and_knows_every_table() -> None:
    schema = json.loads(config.schema())
    assert set(schema["properties"]) == set(config.StudyFile.model_fields)


def test_every_mistake_of_fields_is_told_at_once() -> None:
    text = changed(
        ("sites = [21,", 'sitez = 3\nsites = ["a",'),
        ("pf = 0.98", "pf = 1.2"),
        ("t_clear_ms = 100.0", "t_clear_ms = -5.0"),
        ('hour = "peak"', 'hour = "peek"'),
        ("[run]", "[runn]"),
        ("n = 32", "n = 3.5"),
    )
    assert complaint(text) == (
        "my.toml: 7 problems\n"
        "  runn: unknown table. Did you mean 'run'? Known: study, grid, hosting, facility, criteria, "
        "sampling, surrogate, frontier, system_limit, replay, sensitivity, "
        "run, ... (14 in all).\n"
        "  grid.sites[1] = 'a': must be a whole number.\n"
        "  grid.sitez: unknown field. Did you mean 'sites'? Known: case, dynamics, sites, engine, coupling, "
        "t_end_s, step_s, redispatch.\n"
        "  hosting.pf = 1.2: must be at most 1.\n"
        "  sampling.n = 3.5: must be a whole number.\n"
        "  fault[1].t_clear_ms = -5.0: must be above 0.\n"
        "  period[1].hour = 'peek': must be a whole number, or 'peak', 'median' or 'light'."
    )


def test_a_mistake_of_one_field_hides_none_across_fields() -> None:
    """What is wrong by itself stands out of the checks across fields, a mistyped name too."""
    text = changed(
        ("sites = [21, 75, 106, 108]", "sites = [21, 75, 75, 999]"),
        ("t_end_s = 2.0", "t_end_s = -2.0"),
        ("pf = 0.98", "pf = 1.2"),
        ("h_max_mw = 500.0", "h_max_mww = 900.0"),
        ("min_size_mw = 0.0", "min_size_mw = [600.0, 1.0]"),
        ("v_min_pu = 0.94", "v_min_pu = 1.07"),
        ("t_clear_ms = 100.0", "t_clear_ms = 1e4\nx_pu = 0.0"),
        ("bus = 111 ", "bus = 21 "),
        ('modes = ["gfl", "gfm"]', 'modes = ["gfk", "gfm"]'),
        ("beta = [1.0, 1.05,", "beta = [-1.0, 1.05,"),
    )
    known = ", ".join(map(str, Network.ieee118().bus[:12]))
    assert complaint(text).splitlines() == [
        "my.toml: 11 problems",
        "  grid.t_end_s = -2.0: must be above 0.",
        "  hosting.pf = 1.2: must be at most 1.",
        "  hosting.h_max_mww: unknown field. Did you mean 'h_max_mw'? Known: profiles, hours, pf, "
        "rating_scale, v_min_pu, v_max_pu, reactive_limits, h_max_mw, min_size_mw, n1_rating_factor, "
        "base_violations.",
        "  facility.beta[1] = -1.0: must be above 0.",
        "  fault[1].x_pu = 0.0: must be above 0.",
        "  grid.sites: bus 75 is listed more than once.",
        "  fault[6].bus = 21: is a candidate bus; a site cannot ride through a fault at its own terminals. "
        "Way out: take a neighbouring bus, or drop it from grid.sites.",
        "  hosting.min_size_mw: 2 values for 4 sites.",
        "  hosting.v_min_pu = 1.07: must be below v_max_pu = 1.06.",
        f"  grid.sites[4] = 999: ieee118 has no such bus. Did you mean '99'? Known: {known}, "
        "... (118 in all).",
        "  facility.modes: no variant 'gfk'. Did you mean 'gfm'? Known: gfl, gfm, gfm-droop, "
        "line-interactive, eco-mode, no-ups, gfl-vfd-cooling, gfl-sag-counter, gfl-support.",
    ]


def test_a_wrong_field_is_not_judged_by_its_default() -> None:
    """600 MW exceed the default of h_max_mw, and 3 s that of t_end_s, which both were to be others."""
    text = changed(
        ("t_end_s = 2.0", 't_end_s = "5 s"'),
        ("h_max_mw = 500.0", "h_max_mww = 900.0"),
        ("min_size_mw = 0.0", "min_size_mw = 600.0"),
        ("t_clear_ms = 100.0", "t_clear_ms = 3e3"),
        ("window_ms = 20.0", "window_ms = 3e3"),
        ('profiles = "ieee118"', "profiles = 3"),
        ('hour = "light"', "hour = 9000"),
    )
    assert [line.split(":")[0].strip() for line in complaint(text).splitlines()[1:]] == [
        "grid.t_end_s = '5 s'",
        "hosting.profiles = 3",
        "hosting.h_max_mww",
    ]


def test_system_limits_have_to_rise_and_to_be_at_ratings_of_the_study() -> None:
    text = changed(
        ("loss_mw = [0.0, 20.0, 80.0]", "loss_mw = [20.0, 20.0]\nloss_share = [0.2, 0.1]"),
        ("beta = [1.05, 1.15, 1.2, 1.3] ", "beta = [1.05, 1.16] "),
        ("search = true", "search = false"),
    )
    assert complaint(text) == (
        "my.toml: 4 problems\n"
        "  system_limit.loss_mw = [20.0, 20.0]: must rise from one value to the next.\n"
        "  system_limit.loss_share = [0.2, 0.1]: must rise from one value to the next.\n"
        "  system_limit: its plans are searched after the frontier, and frontier.search = false. Way out: "
        "search = true, or no limits.\n"
        "  system_limit.beta[2] = 1.16: is not in facility.beta, which has 1, 1.05, 1.1, 1.125, 1.15, 1.175, "
        "1.2, 1.25, 1.3, 1.35, 1.4, 1.5."
    )


def test_values_that_no_system_limit_has_are_told() -> None:
    text = changed(("loss_mw = [0.0, 20.0, 80.0]", "loss_mw = [-1.0]\nloss_share = [1.5]\nloss_pu = 3"))
    assert complaint(text) == (
        "my.toml: 3 problems\n"
        "  system_limit.loss_mw[1] = -1.0: must be at least 0.\n"
        "  system_limit.loss_share[1] = 1.5: must be at most 1.\n"
        "  system_limit.loss_pu: unknown field. Did you mean 'loss_mw'? Known: loss_mw, loss_share, beta."
    )


def test_a_quick_study_tries_its_limits_at_ratings_that_it_has() -> None:
    quick = config.load(config.template(), "ieee118").quick()
    assert set(quick.system_limit.beta) <= set(quick.facility.beta)
    assert quick.system_limit.loss_mw


def test_missing_tables_are_named() -> None:
    assert complaint('[study]\nname = "x"') == (
        "my.toml: 3 problems\n"
        "  grid: this table is required.\n"
        "  fault: at least one [[fault]] is required.\n"
        "  period: at least one [[period]] is required."
    )


def test_what_is_not_toml_says_where() -> None:
    assert (
        complaint("[study\n")
        == "my.toml: not a TOML file: Expected ']' at the end of a table declaration (at line 1, column 7)."
    )


def test_unknown_bus() -> None:
    assert complaint(changed(("sites = [21, 75,", "sites = [21, 755,"), ("bus = 25 ", "bus = 999 "))) == (
        "my.toml: 2 problems\n"
        "  grid.sites[2] = 755: ieee118 has no such bus. Did you mean '75'? Known: 1, 2, 3, 4, 5, 6, 7, 8, "
        "9, 10, 11, 12, ... "
        "(118 in all).\n"
        "  fault[1].bus = 999: ieee118 has no such bus. Did you mean '99'? Known: 1, 2, 3, 4, 5, 6, 7, 8, "
        "9, 10, 11, 12, ... (118 in all)."
    )


def test_fault_at_a_candidate_bus() -> None:
    assert complaint(changed(("bus = 25 ", "bus = 75 "))) == (
        "my.toml: fault[1].bus = 75: is a candidate bus; a site cannot ride through a fault at its own "
        "terminals. "
        "Way out: take a neighbouring bus, or drop it from grid.sites."
    )


def test_a_branch_that_clears_a_fault() -> None:
    given = "# opens = [25, 27]          # the branch"
    file = checks.check(changed((given, "opens = [25, 27] # the branch")), "my.toml", HERE)
    assert replay.fault_label(file.fault[0].model_dump()) == "bus 25, 100 ms, opens 25-27"
    assert complaint(changed((given, "opens = [25, 28] # the branch"))) == (
        "my.toml: fault[1].opens = [25, 28]: no branch joins buses 25 and 28. Those at either end: 23-25, "
        "26-25, 25-27, 27-28, 28-29."
    )
    assert complaint(changed((given, "opens = [9, 10] # the branch"))) == (
        "my.toml: fault[1].opens = [9, 10]: with 9-10 open, 1 bus(es) are islanded: 10. Islands are not "
        "simulated."
    )


def test_negative_capacity() -> None:
    assert complaint(changed(("# h_max_mw = [30.0, 150.0,", "h_max_mw = [30.0, -150.0,"))) == (
        "my.toml: sampling.h_max_mw[2] = -150.0: must be at least 0."
    )


def test_sizes_by_site() -> None:
    text = changed(
        ("h_max_mw = 500.0 ", "h_max_mw = [30.0, 150.0, 100.0] "),
        ("min_size_mw = 0.0 ", "min_size_mw = [1.0] "),
    )
    assert complaint(text).splitlines() == [
        "my.toml: 2 problems",
        "  hosting.h_max_mw: 3 values for 4 sites.",
        "  hosting.min_size_mw: 1 values for 4 sites.",
    ]
    right = changed(
        ("h_max_mw = 500.0 ", "h_max_mw = [30, 150.0, 100.0, 40.0] "),
        ("min_size_mw = 0.0 ", "min_size_mw = 5 "),
        ("# n1_rating_factor = 1.2", "n1_rating_factor = 1.3"),
        ('base_violations = "error"', 'base_violations = "hold"'),
    )
    problem = setting_of(config.load(right, "my.toml"), Path()).problem
    assert problem.upper.tolist() == [30.0, 150.0, 100.0, 40.0]
    assert problem.lower.tolist() == [5.0] * 4
    assert problem.security == N1(1.3)
    crossed = changed(
        ("h_max_mw = 500.0 ", "h_max_mw = [30.0, 150.0, 100.0, 40.0] "),
        ("min_size_mw = 0.0 ", "min_size_mw = 40.0 "),
    )
    assert complaint(crossed) == (
        "my.toml: hosting.min_size_mw: 40 MW at site 21 exceeds its h_max_mw 30 MW."
    )


def test_parameter_out_of_bounds_and_unknown() -> None:
    text = changed(('# "sup.T_dip" = 0.25', '"sup.V_dip" = 2.0\n"sup.V_dipp" = 0.9\nbeta = 1.2'))
    found = complaint(text).splitlines()
    assert found[0] == "my.toml: 4 problems"
    assert found[1] == '  facility.parameters."sup.V_dip" = 2 pu(V): is outside [0.3, 1].'
    assert found[2].startswith(
        "  facility.parameters.\"sup.V_dipp\": variant 'gfl' has no such parameter. Did you mean "
        "'sup.V_dip'? Known:"
    )
    assert (
        found[3] == '  facility.parameters."beta": is set by the study in every run and cannot be fixed here.'
    )


def test_sensitivities_that_cannot_be_are_told_all_at_once() -> None:
    text = changed(
        ("# beta = 1.15 ", "beta = 1.16 #"),
        (
            '"vsm.D" = [24.0, 36.0]',
            """"vsm.D" = [24.0, 600.0]
"vsm.H_w" = [0.1, 0.2]
"bess.P_dis" = [0.5, 0.4]
"criteria.loss_share" = [0.2, 1.2]
"pf" = [0.95, 1.0]""",
        ),
    )
    found = complaint(text).splitlines()
    known = found.pop(3)
    assert known.startswith(
        "  sensitivity.ranges.\"vsm.H_w\": no variant has such a parameter. Did you mean 'vsm.H_v'? Known: "
        "criteria.v_it_min_pu, criteria.window_ms, criteria.loss_share, criteria.loss_window_ms, "
    )
    assert found == [
        "my.toml: 6 problems",
        "  sensitivity.beta = 1.16: is not among facility.beta = [1.0, 1.05, 1.1, 1.125, 1.15, 1.175, 1.2, "
        "1.25, 1.3, 1.35, 1.4, 1.5]. Way out: add it there, or leave it out here.",
        '  sensitivity.ranges."vsm.D": vsm.D = 600 is outside [0, 500].',
        '  sensitivity.ranges."bess.P_dis" = [0.5, 0.4]: the first value must be below the second.',
        '  sensitivity.ranges."criteria.loss_share": criteria.loss_share = 1.2 is outside [0, 1].',
        '  sensitivity.ranges."pf": is set by the study in every run and is no assumption of a facility.',
    ]


def test_a_range_of_a_variant_that_is_not_studied_waits() -> None:
    text = changed(('modes = ["gfl", "gfm"]', 'modes = ["gfl"]'))
    assert "vsm.X_v" in checks.check(text, "my.toml", HERE).sensitivity.ranges


def test_fields_of_the_sensitivities_are_told_with_their_place() -> None:
    text = changed(("reruns = 3", "rerun = 3"), ("change = 0.2 ", "change = 1.2 "))
    assert complaint(text) == (
        "my.toml: 2 problems\n"
        "  sensitivity.change = 1.2: must be below 1.\n"
        "  sensitivity.rerun: unknown field. Did you mean 'reruns'? Known: beta, change, ranges, reruns."
    )


def test_fields_that_contradict_each_other() -> None:
    text = changed(
        ("t_end_s = 2.0", "t_end_s = 0.25"),
        ("v_min_pu = 0.94", "v_min_pu = 1.2"),
        ("beta = [1.0, 1.05", "beta = [1.3, 1.05"),
        ('name = "median"', 'name = "peak"'),
        ("bus = 30 ", "bus = 25 "),
        ("n = 32", "n = 7"),
        ('modes = ["gfl", "gfm"]', 'modes = ["gfl", "gfn"]'),
        ('hour = "light"', "hour = 9000"),
        ("# h_max_mw = [30.0, 150.0, 100.0,", "h_max_mw = [30.0, 150.0,"),
    )
    assert complaint(text).splitlines()[1:] == [
        *(
            f"  fault[{k}]: is cleared at 0.3 s, after the end of the simulation at 0.25 s. Way out: raise "
            f"grid.t_end_s."
            for k in range(1, 8)
        ),
        "  sampling.h_max_mw: 3 values for 4 sites.",
        "  sampling.n = 7: leaves 5 hosting vectors to fit a margin of 4 sites, 6 are needed. Way out: "
        "raise sampling.n or lower "
        "sampling.validation_share.",
        "  fault: more than one is called 'bus 25, 100 ms'; results could not tell them apart.",
        "  period: the name 'peak' is used more than once.",
        "  hosting.v_min_pu = 1.2: must be below v_max_pu = 1.06.",
        "  facility.beta = [1.3, 1.05, 1.1, 1.125, 1.15, 1.175, 1.2, 1.25, 1.3, 1.35, 1.4, 1.5]: must rise "
        "from one value to the next.",
        "  period[3].hour = 9000: is not among the 8760 operating hours (0 to 8759).",
        f"  facility.modes: no variant 'gfn'. Did you mean 'gfm'? Known: {', '.join(facility.names())}.",
    ]


def test_closed_loop_with_an_engine_that_has_no_facilities() -> None:
    text = changed(
        ('engine = "native"  ', 'engine = "andes"  '), ('coupling = "open"  ', 'coupling = "closed"  ')
    )
    assert complaint(text).splitlines()[1] == (
        "  grid.coupling = 'closed': grid.engine = 'andes' has no model of a facility. Way out: "
        "grid.engine = 'native', or coupling = 'open'."
    )


def test_derivatives_of_an_engine_that_has_none() -> None:
    text = changed(('engine = "native"  ', 'engine = "andes"  '))
    assert complaint(text).splitlines()[1:] == [
        "  sampling.gradients = true: grid.engine = 'andes' gives none. Way out: grid.engine = 'native'.",
        "  frontier.search = true: needs gradients, which grid.engine = 'andes' does not give. Way out: "
        "grid.engine = 'native', or search = false.",
    ]


def test_case_without_dynamic_data(tmp_path: Path) -> None:
    (tmp_path / "north.raw").write_text("0, 100.0\n")
    assert complaint(changed(('case = "ieee118"', 'case = "north.raw"')), tmp_path) == (
        "my.toml: grid.case = 'north.raw': a .raw file has no dynamic data (machines, exciters, governors), "
        "without which no "
        'fault can be simulated. Way out: give grid.dynamics = "FILE.dyr", or a case that has both (.xlsx '
        "or .json of ANDES)."
    )


@pytest.mark.slow
def test_case_file_without_machines(tmp_path: Path) -> None:
    from dcvrt.grid import andes

    (tmp_path / "bare.m").write_text(andes.case118().read_text())
    found = complaint(changed(('case = "ieee118"', 'case = "bare.m"')), tmp_path)
    assert found.startswith(
        "my.toml: grid.case = 'bare.m': bare, base: the case has no dynamic data, not one machine. Way out:"
    )


def test_unknown_case_and_missing_dynamics() -> None:
    assert complaint(changed(('case = "ieee118"', 'case = "ieee181"'))) == (
        "my.toml: grid.case = 'ieee181': no such file and no such built-in case. Did you mean 'ieee118'? "
        "Known: ieee118. "
        "Way out: 'ieee118', or the path of a case with dynamic data, from the folder of the study file."
    )


@pytest.mark.parametrize(
    ("table", "told"),
    [
        ("hour,load\n0,1.0\n", "no column 'dc'. It has: hour, load."),
        ("hour,load,dc\n0,1.0,x\n", "line 2, column 'dc': 'x' is not a number."),
        ("hour,load,dc,wind\n0,1.0,1.0,3\n", "column 'wind' is none of hour, load, dc, wind_<bus>_mw."),
        ("hour,load,dc\n0,1.0\n", "line 2 has 2 cells, the table 3."),
        ("hour,load,dc\n0.5,1.0,1.0\n", "column 'hour' must hold whole numbers."),
        ("", "no line has two columns or more."),
    ],
)
def test_bad_profiles_are_told(tmp_path: Path, table: str, told: str) -> None:
    (tmp_path / "hours.csv").write_text(table)
    with pytest.raises(InputError) as caught:
        read_profiles(tmp_path / "hours.csv")
    assert str(caught.value) == f"{tmp_path / 'hours.csv'}: {told}"


def test_profiles_are_read_with_their_wind(tmp_path: Path) -> None:
    (tmp_path / "hours.csv").write_text("hour,load,dc,wind_80_mw\n10,0.9,1.0,55.5\n11,0.8,0.9,0\n")
    year = read_profiles(tmp_path / "hours.csv")
    assert year.hours.tolist() == [10, 11]
    assert year.at(10).wind == {80: 55.5}
    assert year.at(11).dc == 0.9


def test_profiles_of_a_study_may_be_missing(tmp_path: Path) -> None:
    assert complaint(changed(('profiles = "ieee118"', 'profiles = "hours.csv"')), tmp_path) == (
        f"my.toml: hosting.profiles = 'hours.csv': {tmp_path / 'hours.csv'}: there is no such file."
    )


def test_values_that_a_facility_run_would_refuse(tmp_path: Path) -> None:
    hours = "".join(f"{hour},{1 - 0.01 * hour},{dc}\n" for hour, dc in enumerate([0.05, 1.0, 0.09]))
    (tmp_path / "hours.csv").write_text(f"hour,load,dc\n{hours}")
    text = changed(
        ("beta = [1.0, 1.05", "beta = [0.5, 1.05"),
        (" 1.5]", " 1.5, 9.0]"),
        ("pf = 0.98", "pf = 0.5"),
        ('profiles = "ieee118"', 'profiles = "hours.csv"'),
    )
    both, d = "of gfl and gfm may have.", "[0.1, 1.2], which parameter d"
    assert complaint(text, tmp_path).splitlines() == [
        "my.toml: 5 problems",
        f"  facility.beta[1] = 0.5: is outside [0.8, 2], which parameter beta {both}",
        f"  facility.beta[13] = 9: is outside [0.8, 2], which parameter beta {both}",
        f"  hosting.pf = 0.5: is outside [0.8, 1], which parameter pf {both}",
        f"  period[1]: the data-centre factor of hour 0 = 0.05: is outside {d} {both}",
        f"  period[3]: the data-centre factor of hour 2 = 0.09: is outside {d} {both}",
    ]


def test_a_fault_needs_a_time_before_it() -> None:
    text = changed(("bus = 25 ", "t_start_s = 0.0\nbus = 25 "))
    assert complaint(text) == "my.toml: fault[1].t_start_s = 0.0: must be above 0."


def test_parameters_that_do_not_go_together() -> None:
    told = (
        "sup: 'NORMAL -> MIXED: v_f < V_dip or v_f > V_swell or w < w_sag' and 'MIXED -> NORMAL: v_f > "
        "V_back and v_f < V_calm and w > w_back held T_mixed' leave no gap between them (V_dip = 0.9, V_back "
        "= 0.88): the modes would chatter. Set the limit of the way back beyond that of the way out."
    )
    assert complaint(changed(('# "sup.T_dip" = 0.25', '"sup.V_back" = 0.88'))) == (
        f"my.toml: 2 problems\n  facility.parameters: gfl: {told}\n  facility.parameters: gfm: {told}"
    )


def test_faults_that_tables_would_call_the_same() -> None:
    text = changed(("bus = 30 ", "bus = 25 "))
    first = text.index("t_clear_ms = 100.0", text.index("bus = 25 ", text.index("bus = 25 ") + 1))
    text = text[:first] + "t_clear_ms = 100.0000001" + text[first + len("t_clear_ms = 100.0") :]
    assert complaint(text) == (
        "my.toml: fault: more than one is called 'bus 25, 100 ms'; results could not tell them apart."
    )


@pytest.mark.parametrize(
    ("hours", "told"),
    [
        ("[168, 10]", "hosting.hours = [168, 10]: must be the first hour and the one after the last."),
        (
            "[0, 9999]",
            "hosting.hours = [0, 9999]: hour 8760 is not among the 8760 operating hours (0 to 8759).",
        ),
    ],
)
def test_hours_that_are_none(hours: str, told: str) -> None:
    assert complaint(changed(('profiles = "ieee118"', f'profiles = "ieee118"\nhours = {hours}'))) == (
        f"my.toml: {told}"
    )
