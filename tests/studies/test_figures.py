"""The figures of a study: all drawn, readable, reproducible, and saying what the store says."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from dcvrt import facility
from dcvrt.errors import InputError
from dcvrt.grid.network import Network
from dcvrt.studies.figures import (
    capacity,
    draw_all,
    faults,
    layout,
    sensitivity,
    supervisor,
    validation,
    worst,
)
from dcvrt.studies.findings import Findings
from dcvrt.studies.rows import by_site, closed, verdict
from dcvrt.studies.store import Store
from dcvrt.studies.style import HATCHES, MARKERS, PALETTE, styled
from tests.studies.synthetic import LEAST, PERIODS, SITES, make, retained

NAMES = {
    "framework",
    "capacity",
    "allocation",
    "validation",
    "retained_voltage",
    "network_map",
    "worst_case_gfl",
    "worst_case_gfm",
    "internal_response_gfl",
    "internal_response_gfm",
    "supervisor",
    "sensitivity",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def drawn(folder: Path) -> list[Path]:
    (folder / "figures").mkdir()
    (folder / "figures" / "old.svg").write_text("<svg/>", encoding="utf-8")
    return draw_all(Findings(folder))


def texts_of(figure: object) -> list[str]:
    """Every text that a figure shows."""
    from matplotlib.text import Text

    return [t.get_text() for t in figure.findobj(Text) if t.get_visible() and t.get_text()]  # type: ignore[attr-defined]


# -- all of them --------------------------------------------------------------------------------------------


def test_every_figure_is_written_as_svg_and_png(folder: Path, drawn: list[Path]) -> None:
    assert {p.stem for p in drawn} == NAMES
    assert {p.suffix for p in drawn} == {".svg", ".png"}
    assert sorted(drawn) == sorted((folder / "figures").iterdir()), (
        "a figure of an earlier run is left behind"
    )


def test_svg_is_well_formed_and_refers_to_nothing_outside(drawn: list[Path]) -> None:
    for path in drawn:
        if path.suffix == ".svg":
            root = ET.fromstring(path.read_text(encoding="utf-8"))
            for element in root.iter():
                for key, value in element.attrib.items():
                    if key.endswith("href"):
                        assert value.startswith(("#", "data:image/png;base64,")), f"{path.name}: {value[:60]}"


def test_the_same_study_gives_the_same_bytes(folder: Path, drawn: list[Path]) -> None:
    before = {p: p.read_bytes() for p in drawn}
    assert {p: p.read_bytes() for p in draw_all(Findings(folder))} == before


def test_no_text_is_smaller_than_can_be_read_in_print(folder: Path) -> None:
    from matplotlib.text import Text

    findings = Findings(folder)
    with styled():
        for figure in (
            capacity.draw_totals(findings),
            capacity.draw_allocation(findings),
            validation.draw(findings),
            faults.draw(findings),
            sensitivity.draw(findings),
        ):
            assert min(t.get_fontsize() for t in figure.findobj(Text) if t.get_text()) >= 6.0


def test_nothing_sticks_out_of_its_figure(folder: Path) -> None:
    from dcvrt.studies.figures import _figures

    with styled():
        for name, figure in _figures(Findings(folder)):
            figure.canvas.draw()  # type: ignore[attr-defined]
            drawn = figure.get_tightbbox()
            width, height = figure.get_size_inches()
            out = (-drawn.x0, -drawn.y0, drawn.x1 - width, drawn.y1 - height)
            assert max(out) < 0.02, f"{name}: {max(out):.2f} inches beyond the edge"


def test_unfinished_study_is_refused_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        draw_all(Findings(tmp_path))
    assert str(error.value) == (
        f"{tmp_path}: summary.json and study.sqlite not found, so this is not the folder of a study that has "
        "ended. Way out: run 'dcvrt study run' with this folder as --out; it resumes."
    )


def test_colours_can_be_told_apart_by_lightness_or_marker() -> None:
    assert len(set(PALETTE)) == len(PALETTE) == len(set(MARKERS)) == len(set(HATCHES))


# -- capacity -----------------------------------------------------------------------------------------------


def test_totals_are_those_of_the_summary_and_failed_plans_are_crossed(folder: Path) -> None:
    findings = Findings(folder)
    with styled():
        figure = capacity.draw_totals(findings)
    assert any(verdict(row) == "failed" for row in findings.rows())
    for axes, mode in zip(figure.axes, findings.modes, strict=True):
        lines = {line.get_label(): line for line in axes.get_lines()}
        for method in findings.methods:
            line = lines[capacity.METHOD_TEXT[method]]
            assert [*line.get_ydata()] == [row["total_mw"] for row in findings.rows(mode, method)]
        assert lines["without ride-through"].get_ydata()[0] == findings.no_vrt_mw
        crosses = sorted(
            (float(x), float(y))
            for line in axes.get_lines()
            if line.get_marker() == "x"
            for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)
        )
        failed = sorted((r["beta"], r["total_mw"]) for r in findings.rows(mode) if verdict(r) == "failed")
        assert crosses == failed


def test_stacks_add_up_to_the_total(folder: Path) -> None:
    findings = Findings(folder)
    with styled():
        figure = capacity.draw_allocation(findings)
    places = [(method, mode) for method in findings.methods for mode in findings.modes]
    for axes, (method, mode) in zip(figure.axes, places, strict=True):
        rows = findings.rows(mode, method)
        tops = np.array([bar.get_y() + bar.get_height() for bar in axes.patches]).reshape(
            len(SITES), len(rows)
        )
        assert tops[-1] == pytest.approx([row["total_mw"] for row in rows])
        heights = np.array([bar.get_height() for bar in axes.patches]).reshape(len(SITES), len(rows))
        assert pytest.approx(np.array([by_site(row, findings.sites) for row in rows])) == heights.T


# -- validation ---------------------------------------------------------------------------------------------


def test_fitting_points_lie_on_or_below_the_simulated_margins(folder: Path) -> None:
    """Tightening lowers every fit by its largest overprediction: no fitting point is overpredicted."""
    findings = Findings(folder)
    for method in findings.methods:
        for target in ("voltage", "loss"):
            margin, predicted = validation.fitted_points(findings, method, target)
            fits = findings.surrogates
            chosen = fits[(fits.method == method) & (fits.target == target)]
            assert len(margin) == chosen.n_fit.sum()
            assert (predicted - margin).max() <= 1e-9
            assert (predicted - margin).max() >= -1e-9, "the tightest fitting point should be met"


def test_false_passes_are_ringed_and_counted(tmp_path: Path) -> None:
    make(tmp_path)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        points = store.predictions()
        wrong = points[(points.method == "share") & (points.target == "loss") & (points.margin < 0)].iloc[:3]
        store.put("predictions", [row | {"predicted": 0.01} for row in wrong.to_dict("records")])
    with styled():
        figure = validation.draw(Findings(tmp_path))
    counts = [re.search(r"validation: (\d+) false", text) for text in texts_of(figure)]
    assert [int(found[1]) for found in counts if found] == [0, 0, 0, 3]
    rings = [line for line in figure.axes[3].get_lines() if line.get_markerfacecolor() == "none"]
    assert sum(len(line.get_xdata()) for line in rings) == 3


# -- voltages and waveforms ---------------------------------------------------------------------------------


def test_retained_voltage_is_the_one_of_the_store(folder: Path) -> None:
    with Store(folder / "study.sqlite") as store:
        samples = store.hostings().query("role == 'sample'").by_site
        table = faults.retained(store.margins("sample")).set_index(["fault", "site"])
    vectors = [np.array([H[str(site)] for site in SITES]) for H in samples]
    for bus in LEAST:
        for site in SITES:
            volts = [retained(bus, site, H, d) for H in vectors for _, _, d, _ in PERIODS.values()]
            row = table.loc[(f"bus {bus}, 100 ms", site)]
            assert (row["min"], row["max"]) == pytest.approx((min(volts), max(volts)), abs=1e-12)


def test_bars_are_what_gradients_say_and_diamonds_what_a_search_found(folder: Path) -> None:
    findings = Findings(folder)
    with styled():
        figure = sensitivity.draw(findings)
    assert figure is not None
    (axes,) = figure.axes  # with grid-following control the network holds the plan, and nothing is at stake
    rows = sensitivity.drawn(findings, "gfm")
    assert [row["path"] for row in rows] == ["criteria.loss_share", "sup.V_deep", "dc_loop.K_p"]
    bars = {(round(bar.get_y() + bar.get_height() / 2, 2), bar.get_width()) for bar in axes.patches}
    assert bars == {(-0.19, -24.0), (0.19, 24.0), (0.81, 0.0), (1.81, 0.6)}
    marks = {
        (line.get_marker(), round(float(line.get_ydata()[0]), 2)): float(line.get_xdata()[0])
        for line in axes.lines
        if line.get_marker() in ("D", "x")
    }
    assert marks == pytest.approx({("D", -0.19): -24.5, ("D", 0.19): 11.0, ("x", 1.19): 0.0})
    assert axes.get_yticklabels()[0].get_text() == "criteria.loss_share = 0.08 … 0.12"


def test_what_gradients_cannot_see_is_no_bar_of_no_length() -> None:
    blind = {"gradient_mw": 0.0, "refused": "", "unseen": {"21": "events"}}
    assert sensitivity.by_gradient(blind) is None
    assert sensitivity.by_gradient(blind | {"unseen": {}}) == 0.0
    assert sensitivity.by_gradient(blind | {"gradient_mw": -9.0}) == -9.0
    assert sensitivity.by_gradient(blind | {"gradient_mw": 3.0, "refused": "cannot be"}) is None
    assert sensitivity.by_gradient(blind | {"gradient_mw": None, "unseen": {}}) is None


def test_without_sensitivities_there_is_no_such_figure(tmp_path: Path) -> None:
    make(tmp_path)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.clear("sensitivities")
    assert sensitivity.draw(Findings(tmp_path)) is None


def test_rating_line_is_the_static_loss_law() -> None:
    for beta in (1.0, 1.2, 1.5):
        v = faults.rating_line(beta, 0.1)
        assert 1.0 - min(1.0, beta * v) == pytest.approx(0.1)


def test_worst_case_is_the_least_margin_of_a_plan_and_is_run_again_on_its_voltage(folder: Path) -> None:
    findings = Findings(folder)
    case = findings.worst_case("gfl")
    assert case is not None
    plans = set(findings.plans[["hosting", "mode", "beta"]].itertuples(index=False, name=None))
    least = min(
        min(r.v_margin_pu, r.loss_margin_share)
        for r in findings.margins.rename(columns={"mode": "variant"}).itertuples()
        if r.variant == "gfl" and (r.hosting, "gfl", r.beta) in plans and r.h_mw > 0 and r.ok
    )
    assert min(case.v_margin_pu, case.loss_margin_share) == least
    run = findings.run(case)
    assert run is not None
    assert run.completed
    assert (run.t[0], run.t[-1]) == (0.0, findings.study.grid.t_end_s)
    d = findings.provenance["periods"][case.period]["dc_factor"]
    assert run["p_out"][0] == pytest.approx(d, rel=0.05)  # the load of the period, on the base of the site
    with styled():
        figure = worst.draw(findings, case)
    assert f"bus {case.site} (worst)" in texts_of(figure)
    assert len([line for line in figure.axes[0].get_lines() if str(line.get_label()).startswith("bus ")]) == 4


# -- supervisor ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", ["gfl", "gfm"])
def test_supervisor_diagram_shows_every_row_of_the_table(variant: str) -> None:
    dae = facility.get(variant).compile()
    table = dae.automata[0]
    with styled():
        shown = "\n".join(texts_of(supervisor.draw(dae)))
    for mode in table.modes:
        assert mode in shown
    for number, row in enumerate(table.rows, 1):
        assert f"{number}  {supervisor.guard_text(row.text)}" in shown
    for row in dae.parameter_rows:
        if row.path.startswith(f"{table.path}.") and row.path.split(".")[1] in " ".join(
            r.text for r in table.rows
        ):
            assert f"= {row.value:g}" in shown


# -- map ----------------------------------------------------------------------------------------------------


def test_shipped_coordinates_are_the_computed_ones() -> None:
    network = Network.ieee118()
    assert layout.positions(network) == pytest.approx(layout.computed(network), abs=0.05)


def test_the_table_of_coordinates_is_what_was_computed(tmp_path: Path) -> None:
    network = Network.ieee118()
    layout.write_table(network, str(tmp_path / "118.csv"))
    written = np.loadtxt(tmp_path / "118.csv", delimiter=",", skiprows=2)
    assert written[:, 0].tolist() == network.bus.tolist()
    assert written[:, 1:] == pytest.approx(layout.computed(network), abs=5e-4 + 1e-9)


def test_majorisation_never_raises_the_stress() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(12, 2))
    target = rng.normal(size=(12, 2))
    distance = np.linalg.norm(target[:, None] - target[None], axis=2)
    values = [layout.stress(distance, x)]
    for _ in range(30):
        x = layout.majorised(distance, x, 1)
        values.append(layout.stress(distance, x))
    assert (np.diff(values) <= 1e-12).all()
    assert values[-1] < 0.5 * values[0]


def test_classical_scaling_recovers_a_plane() -> None:
    target = np.random.default_rng(5).normal(size=(9, 2))
    distance = np.linalg.norm(target[:, None] - target[None], axis=2)
    assert layout.stress(distance, layout.classical(distance)) == pytest.approx(0.0, abs=1e-18)


def test_buses_do_not_cover_each_other_on_the_map() -> None:
    x = layout.positions(Network.ieee118())
    apart = np.linalg.norm(x[:, None] - x[None], axis=2) + 9.0 * np.eye(len(x))
    assert apart.min() > 0.2


# -- statements ---------------------------------------------------------------------------------------------


def test_shortfall_names_what_closes_sites(folder: Path) -> None:
    findings = Findings(folder)
    said = findings.shortfalls()
    short = [
        r
        for r in findings.rows()
        if r["beta"] == 1.5 and r["total_mw"] < findings.no_vrt_mw - findings.tolerance_mw
    ]
    assert len(said) == len(short) > 0
    for text, row in zip(said, short, strict=True):
        assert f"{row['total_mw']:.1f} MW" in text
        for bus, why in closed(row).items():
            assert f"us {bus} is closed: {why}" in text


def test_falls_are_found_and_only_where_they_are(folder: Path) -> None:
    findings = Findings(folder)
    assert findings.falls() == []
    rows = findings.rows("gfm", "share")
    rows[-1]["total_mw"] = rows[-2]["total_mw"] - 5.0
    said = findings.falls()
    assert len(said) == 1
    assert "GFM, method share: capacity falls from" in said[0]
    assert "at β = 1.5" in said[0]


def test_best_plan_has_passed_everything(folder: Path) -> None:
    findings = Findings(folder)
    best = findings.best()
    assert best is not None
    assert best["replay"]["passed"]
    assert best["ac"]["passed"]
    larger = [r for r in findings.rows() if r["total_mw"] > best["total_mw"] + findings.tolerance_mw]
    assert all(verdict(r) == "failed" for r in larger)


def test_thirty_sites_are_told_apart() -> None:
    """Colours come round again; colour with hatch and colour with marker do not."""
    from dcvrt.studies.style import site_colour, site_hatch, site_marker

    sites = list(range(100, 130))
    assert len({(site_colour(s, sites), site_hatch(s, sites)) for s in sites}) == len(sites)
    assert len({(site_colour(s, sites), site_marker(s, sites)) for s in sites}) == len(sites)
