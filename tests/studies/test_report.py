"""The report: one offline file that says first what was asked and hides nothing that failed."""

from __future__ import annotations

import html
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from dcvrt.errors import SimulationError
from dcvrt.studies import outputs
from dcvrt.studies.findings import Findings
from dcvrt.studies.report import checks, hypotheses, write_report
from dcvrt.studies.rows import verdict
from dcvrt.studies.store import Store
from tests.studies.synthetic import make

VOID = {"meta", "br", "path", "use", "rect", "image", "line", "circle", "img", "hr", "link"}
HOSTILE = 'Sites <script>alert("x")</script> & "more"'


class Page(HTMLParser):
    """Collects elements, visible text and nesting errors."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == [], f"not closed: {self.open[-5:]}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {k: v or "" for k, v in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {k: v or "" for k, v in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if tag in VOID:
            return
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data: str) -> None:
        if "style" not in self.open[-1:]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make(tmp_path_factory.mktemp("study"), lost=True, name=HOSTILE)
    write_report(Findings(folder))
    return folder


def page_of(study: Path, pictures: Path) -> Page:
    """The report of a study, with the pictures of another one, which saves the time to draw them."""
    shutil.copytree(pictures / "figures", study / "figures")
    write_report(Findings(study))
    return Page((study / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def source(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(source: str) -> Page:
    return Page(source)


def test_report_is_one_file_that_needs_no_network(source: str, page: Page) -> None:
    assert page.all("link") == []
    assert page.all("script") == []
    assert page.all("img") == []
    for _, attributes in page.elements:
        for key in ("src", "href", "xlink:href"):
            assert attributes.get(key, "#").startswith(("#", "data:image/png;base64,"))
    assert "@import" not in source
    assert re.findall(r"url\((?!#)", source) == []


def test_links_lead_to_places_on_the_page_and_ids_are_unique(page: Page) -> None:
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    for attributes in page.all("a"):
        assert attributes["href"].removeprefix("#") in ids


def test_text_of_the_study_is_escaped(source: str, page: Page) -> None:
    assert "<script>" not in source
    assert html.escape(HOSTILE, quote=True) in source
    assert HOSTILE in page.text


def test_tables_have_captions_and_headers_and_pictures_have_texts(page: Page) -> None:
    assert len(page.all("table")) == len(page.all("caption")) >= 8
    assert all(attributes.get("scope") in ("col", "row") for attributes in page.all("th"))
    pictures = page.all("svg")
    assert len(pictures) == 12
    assert all(attributes["role"] == "img" and len(attributes["aria-label"]) > 20 for attributes in pictures)
    assert page.all("html")[0]["lang"] == "en"
    assert [attributes["content"] for attributes in page.all("meta") if attributes.get("name") == "viewport"]


def test_answer_comes_first_and_is_the_best_plan(folder: Path, page: Page) -> None:
    best = Findings(folder).best()
    assert best is not None
    assert f"{best['total_mw']:.1f} MW of data-centre load can be hosted with ride-through" in page.text
    assert page.text.index("The answer") < page.text.index("Plans by method, mode and rating")


def test_every_row_of_the_summary_stands_in_the_table(folder: Path, source: str) -> None:
    table = source[source.index("<caption>Plans by method") :]
    table = table[: table.index("</table>")]
    rows = re.findall(r"<tr(?: class=\"marked\")?>(<th scope=\"row\".*?)</tr>", table)
    findings = Findings(folder)
    assert len(rows) == len(findings.rows()) + 1
    cells = [re.sub("<[^>]+>", "|", row) for row in rows]
    for row in findings.rows():
        assert any(
            f"{row['beta']:g}" in c and row["method"] in c and f"{row['total_mw']:.2f}" in c for c in cells
        )


def test_failed_replays_and_lost_simulations_are_in_plain_sight(
    folder: Path, source: str, page: Page
) -> None:
    failed = [row for row in Findings(folder).rows() if verdict(row) == "failed"]
    assert failed
    assert f"{len(failed)} plan(s) failed the replay and must not be used" in page.text
    assert source.count('<span class="badge bad">FAILED</span>') >= 2 * len(failed)
    assert "1 task(s) were set aside" in page.text
    assert "took longer than 600 s" in page.text
    assert "Every plan that hosts anything passed the replay." not in page.text


def test_shortfall_is_told_with_its_reason(page: Page) -> None:
    assert "The highest β does not reach the capacity without ride-through" in page.text
    assert "What prevents more: Bus" in page.text


def test_findings_of_the_paper_are_tested_on_the_rows(folder: Path, page: Page) -> None:
    findings = Findings(folder)
    assert "The paper's findings, tested" in page.text
    assert hypotheses.full_rating(findings, "gfl", "paper") is None
    full = [r["beta"] for r in findings.rows("gfl", "share") if r["total_mw"] > findings.no_vrt_mw - 0.3]
    assert hypotheses.full_rating(findings, "gfl", "share") == min(full)
    assert hypotheses._forming_needs_less(findings)[0] == hypotheses.HOLDS
    forming = findings.rows("gfm", "share")
    forming[-1]["total_mw"] = 100.0
    outcome, evidence = hypotheses._forming_needs_less(findings)
    assert outcome == hypotheses.FAILS
    assert "GFM hosts 100.0 MW, GFL" in evidence
    assert hypotheses._never_falls(findings)[0] == hypotheses.FAILS


def test_clean_study_says_so(tmp_path: Path, folder: Path) -> None:
    text = page_of(make(tmp_path, failing=False), folder).text
    assert "Every plan that hosts anything passed the replay." in text
    assert "must not be used" not in text
    assert "Some simulations have no result" not in text


def test_facility_without_a_response_is_told(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SimulationError("gfl: no equilibrium at the first value of the waveform.")

    make(tmp_path)
    shutil.copytree(folder / "figures", tmp_path / "figures")
    for picture in (tmp_path / "figures").glob("internal_response_*"):
        picture.unlink()
    monkeypatch.setattr("dcvrt.integrators.Simulator.attempt", fails)
    write_report(Findings(tmp_path))
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    assert "GFL: no response to the test waveform: gfl: no equilibrium at the first value" in text


def test_nothing_hosted_is_an_answer(tmp_path: Path, folder: Path) -> None:
    make(tmp_path)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        plans = store.plans().to_dict("records")
        store.put("plans", [plan | {"passed": 0} for plan in plans if plan["method"] != "none"])
        outputs.write_results(tmp_path, store)
    text = page_of(tmp_path, folder).text
    assert "No data-centre load can be hosted at the sites studied" in text


def test_false_passes_are_told(tmp_path: Path, folder: Path) -> None:
    make(tmp_path)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        points = store.predictions()
        wrong = points[(points.method == "share") & (points["mode"] == "gfm") & (points.margin < 0)].iloc[:2]
        store.put("predictions", [row | {"predicted": 1e-3} for row in wrong.to_dict("records")])
    text = page_of(tmp_path, folder).text
    assert "False passes: margins that a fit passes and the simulation does not" in text
    assert "method share, GFM, load loss: 2 validation point(s)" in text


def test_a_failed_validation_run_that_a_fit_passes_is_a_false_pass_everywhere(
    tmp_path: Path, folder: Path
) -> None:
    from dcvrt.studies.figures import validation

    make(tmp_path)
    before = {key(row): row for row in Findings(tmp_path).summary["surrogate"]}
    with Store(tmp_path / "study.sqlite", write=True) as store:
        points = store.predictions()
        chosen = points[(points.method == "share") & (points["mode"] == "gfm") & (points.target == "loss")]
        lost = chosen.sort_values("predicted").iloc[[0, -1]].to_dict("records")
        assert lost[0]["predicted"] < 0 < lost[1]["predicted"], "one is not passed, the other is"
        store.put("predictions", [row | {"margin": None} for row in lost])
        outputs.write_results(tmp_path, store)
    findings = Findings(tmp_path)
    for row in findings.summary["surrogate"]:
        was, here = before[key(row)], key(row) == ("share", "gfm", "loss")
        assert (row["n_validation"], row["n_validation_failed"]) == (
            was["n_validation"] - 2 * here,
            2 * here,
        )
        total = was["n_validation"]
        assert row["violation_rate"] == pytest.approx(was["violation_rate"] + here / total)
    assert "method share, GFM, load loss: 1 validation point(s)" in page_of(tmp_path, folder).text
    shown = [text.get_text() for axes in validation.draw(findings).axes for text in axes.texts]
    assert any("(2 have no margin to show, 1 of them false passes)" in text for text in shown)


def key(row: dict) -> tuple[str, str, str]:
    return row["method"], row["mode"], row["target"]


def test_assumptions_name_what_is_illustrative_and_the_modes_differences(page: Page) -> None:
    assert "parameters are illustrative" in page.text
    assert "Parameters that differ between the modes" in page.text
    assert "dc_loop.K_p" in page.text
    assert "not ERCOT's official one" in page.text
    assert "Positive sequence only." in page.text


def test_every_assumption_stands_with_gradient_and_search(page: Page) -> None:
    assert "How the answer moves with the assumptions" in page.text
    assert (
        "criteria.loss_share: largest loss of import 0.1 0.08 / 0.12 1.2e+03 -24.0 / +24.0 -24.5 / +11.0 –"
    ) in page.text
    assert (
        "sup.V_deep: deep dip below 0.5 0.4 / 0.6 0 0 / – – / – high: bus 106 fails: fault bus 94, 100 ms, "
        "peak: the <link> collapsed"
    ) in page.text
    assert "dc_loop.K_p: proportional gain over H 1 0.8 / 1.2 -3 +0.6 / – – / – high: no <gap>" in page.text
    assert "GFM: 1 assumption(s) that move nothing at first order" in page.text
    assert "Gradients and search agree to a tenth at 1 of 2 ends searched again." in page.text
    assert (
        "loss at bus 108, fault bus 111, 100 ms, peak (1200 MW per share, +7.0 MW per 0.01 of β)" in page.text
    )
    assert "(12 fault simulations and 345 facility runs in all)" in page.text


def test_a_plan_that_the_network_holds_has_no_zeros_for_findings(page: Page) -> None:
    assert (
        "is held by no margin, so there is no MW per unit: it is left out, not zero. What holds it: "
        "line 80-99. No margin is near."
    ) in page.text
    assert "GFL: 4 assumption(s)" in page.text


def test_parameters_that_differ_by_mode_lead_to_their_effect(page: Page) -> None:
    assert (
        "How the answer moves with dc_loop.K_p: see How the answer moves with the assumptions ." in page.text
    )
    assert "The effect of dc_loop.K_i was not studied; a range in [sensitivity.ranges] adds it." in page.text
    assert "#sensitivity" in [attributes["href"] for attributes in page.all("a")]


def test_without_a_plan_of_the_frontier_the_report_says_so(tmp_path: Path, folder: Path) -> None:
    make(tmp_path)
    with Store(tmp_path / "study.sqlite", write=True) as store:
        store.clear("sensitivities")
        store.note(sensitivity_plans={})
    text = page_of(tmp_path, folder).text
    for mode in ("GFL", "GFM"):
        assert f"{mode}: the frontier was not searched, so no prices of margins are known." in text


def test_parameters_that_the_study_sets_are_shown_with_its_values(source: str) -> None:
    rows = {
        re.sub("<[^>]+>", "|", row).strip("|").split("|")[0]: re.sub("<[^>]+>", "|", row)
        for row in re.findall(r"<tr>(.*?)</tr>", source[source.index("Parameters of the GFL facility") :])
    }
    for path, value in {"beta": "1 to 1.5", "pf": "0.98", "d": "0.9 to 1", "H": "1, on the base of"}.items():
        assert f"|{value}" in rows[path]
        assert "|set by the study|" in rows[path]
    assert "set by the study" not in rows["PUE"]


def test_every_deviation_of_the_models_is_listed(folder: Path, page: Page) -> None:
    findings = Findings(folder)
    for mode in findings.modes:
        for note in findings.facility(mode).notes:
            assert re.sub(r"\s+", " ", note.partition(": ")[2]) in page.text


def test_forms_of_the_margins_stand_side_by_side(tmp_path: Path) -> None:
    """Counts of the store, and of what a form keeps: never more than is feasible."""
    folder = make(tmp_path / "forms")
    with Store(folder / "study.sqlite") as store:
        forms = {form["method"]: form for form in store.provenance()["forms"]}
    assert list(forms) == ["paper", "share", "bound"]
    assert len({form["feasible"] for form in forms.values()}) == 1
    assert all(0 <= form["kept"] <= form["feasible"] for form in forms.values())
    assert forms["bound"]["kept"] > 0
    write_report(Findings(folder))
    page = (folder / "report.html").read_text(encoding="utf-8")
    table = page[page.index("What each form keeps of what is feasible") :]
    for form in forms.values():
        assert f">{form['kept']}</td>" in table[table.index(f">{form['method']}<") :]
    assert "judged too with sampling.gradients = true" in page


def test_margins_seen_from_one_side_are_counted_by_site() -> None:
    said = [
        "loss at bus 21, fault bus 25, 100 ms, gfl, beta 1: every sample misses it",
        "loss at bus 21, fault bus 30, 100 ms, gfl, beta 1: every sample misses it",
        "voltage at bus 21, fault bus 25, 100 ms, gfl, beta 1: every sample meets it",
        "bus 75, fault bus 25, 100 ms, gfm, beta 1: no run of the fitting set has a margin",
    ]
    assert checks.counted(said) == [
        "bus 75: 1 times no run of the fitting set has a margin",
        "loss at bus 21: 2 times every sample misses it",
        "voltage at bus 21: 1 times every sample meets it",
    ]
