"""The command line. What is heavy is imported inside the commands, so that `dcvrt --help` answers at once.

Exit codes: 0 done; 1 internal error; 2 bad input; 3 the answer is no: nothing meets the limits (infeasible),
or a facility fails its envelope; 4 incomplete: something was set aside or did not reach its end.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dcvrt import __version__, envelopes, scenarios
from dcvrt.errors import DcvrtError, InfeasibleError, InputError, SimulationError, raise_all
from dcvrt.threads import one_thread

if TYPE_CHECKING:
    from rich.console import Console

OK, INTERNAL, BAD_INPUT, INFEASIBLE, INCOMPLETE = range(5)
MOST_COLUMNS = 6
"""Sites that have a column each in the table of plans; more share one."""

app = typer.Typer(
    name="dcvrt",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="How much data-centre load a grid can host when every site must ride through the grid's faults.",
)
study = typer.Typer(
    no_args_is_help=True, help="A study: one TOML file in, one folder of tables, figures and report out."
)
facility = typer.Typer(no_args_is_help=True, help="The facility variants: what they are made of.")
app.add_typer(study, name="study")
app.add_typer(facility, name="facility")


@app.callback(invoke_without_command=True)
def _root(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if show_version:
        print(f"dcvrt {__version__}")
        raise typer.Exit(OK)


# -- study ---------------------------------------------------------------------------------------------------


@study.command("run")
def study_run(
    file: Annotated[Path | None, typer.Argument(help="Study file; without one, the IEEE-118 study.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the results; the same folder again resumes.")
    ] = None,
    workers: Annotated[int, typer.Option(help="Worker processes on this machine.")] = 2,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a running dask scheduler, instead of own workers.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer samples, periods and ratings: minutes instead of more.")
    ] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Do once more what was set aside.")] = False,
) -> None:
    """Run a study, or go on with an interrupted one."""
    from dcvrt.studies.progress import Reporter
    from dcvrt.studies.study import Study

    try:
        result = Study.load(file).run(out, workers, scheduler, quick, retry, Reporter())
    except KeyboardInterrupt:
        _complain("Interrupted. The same command goes on where it stopped.")
        raise typer.Exit(INCOMPLETE) from None
    _show(result)


@study.command("new")
def study_new(file: Annotated[Path, typer.Argument(help="File to write; must not exist.")]) -> None:
    """Write a commented study file to edit."""
    from dcvrt.studies.config import template

    if file.exists():
        raise InputError(f"{file} exists already. Way out: another name; nothing was written.")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder. Way out: make it first.")
    file.write_text(template(), encoding="utf-8")
    print(f"{file}: edit it, then 'dcvrt study check {file}' and 'dcvrt study run {file}'")


@study.command("check")
def study_check(file: Annotated[Path, typer.Argument(help="Study file.")]) -> None:
    """Report every mistake in a study file at once; runs nothing."""
    from dcvrt.studies.study import Study

    s = Study.load(file).file
    print(
        f"{file}: in order: {len(s.grid.sites)} sites, {len(s.fault)} faults, {len(s.period)} periods, "
        f"{len(s.facility.modes)} modes, {len(s.facility.beta)} ratings, {s.sampling.n} samples"
    )


@study.command("report")
def study_report(
    folder: Annotated[Path, typer.Argument(help="Folder that 'dcvrt study run' has made.")],
) -> None:
    """Write tables, figures and report again from the store of a finished study."""
    from dcvrt.studies.study import Result

    result = Result.of(folder)
    for path in result.report():
        print(path)
    if not result.complete:
        raise typer.Exit(INCOMPLETE)


@study.command("schema")
def study_schema() -> None:
    """Print the JSON Schema of the study file, for editors."""
    from dcvrt.studies.config import schema

    print(schema())


def _open_sites(row: dict[str, Any], sites: list[str]) -> str:
    """Sites that host anything, with their capacity, in one cell."""
    return ", ".join(f"{c[4:-3]}: {row[c]:.1f}" for c in sites if row[c] > 0)


def _show(result: object) -> None:
    """Print the table of plans and where the rest is; say what is missing and end with code 4 if anything
    is."""
    from rich.table import Table

    from dcvrt.studies.store import records
    from dcvrt.studies.study import Result

    assert isinstance(result, Result)
    frame = result.table()
    sites = [str(column) for column in frame if str(column).startswith("bus_")]
    by_column = len(sites) <= MOST_COLUMNS
    names = [f"bus {c[4:-3]}" for c in sites] if by_column else ["sites, MW"]
    shown = Table()
    for heading in (
        "method",
        "mode",
        "beta",
        "MW",
        *names,
        "replay",
        "V margin, pu",
        "loss margin, MW",
        "AC",
    ):
        shown.add_column(heading, no_wrap=by_column or heading != "sites, MW")
    for row in records(frame):
        verdict = {"failed": "[red]failed[/]", "passed": "[green]passed[/]"}.get(row["replay"], row["replay"])
        shown.add_row(
            row["method"],
            row["mode"],
            _number(row["beta"], "g"),
            _number(row["total_mw"], ".2f"),
            *([_number(row[c], ".2f") for c in sites] if by_column else [_open_sites(row, sites)]),
            verdict,
            _number(row["worst_voltage_margin_pu"], ".4f"),
            _number(row["worst_loss_margin_mw"], ".2f"),
            row["ac"],
        )
    console = _console()
    console.print(shown)
    counts = result.summary["simulations"]
    console.print(
        f"{counts['grid']} fault simulations, {counts['facility']} facility runs, {counts['failed']} failed, "
        f"{counts['quarantined']} task(s) set aside; report: {result.folder / 'report.html'}",
        highlight=False,
    )
    if not result.complete:
        for line in result.lost:
            print(line, file=sys.stderr)
        print(
            "The study is incomplete: plans with missing runs count as failed. Way out: look at the messages "
            "above, then run again with --retry.",
            file=sys.stderr,
        )
        raise typer.Exit(INCOMPLETE)
    if not any(row["total_mw"] > 0 for row in result.summary["rows"]):
        print(
            "No plan meets the criteria: every site is closed at every rating, in every mode.",
            file=sys.stderr,
        )
        for line in result.closed():
            print(f"  {line}", file=sys.stderr)
        raise typer.Exit(INFEASIBLE)


def _console(width: int = 140) -> Console:
    """Where tables go; as wide as they need when nobody watches."""
    from rich.console import Console

    console = Console(highlight=False)
    if not sys.stdout.isatty():
        console.width = width
    return console


def _number(value: object, form: str) -> str:
    return "" if value is None or value != value else format(value, form)


# -- design --------------------------------------------------------------------------------------------------


@app.command()
def design(
    file: Annotated[Path | None, typer.Argument(help="Study file; without one, the IEEE-118 study.")] = None,
    hosting: Annotated[
        list[str] | None,
        typer.Option(metavar="SITE=MW,...", help="Hosted capacities, as 21=30,75=150; others host nothing."),
    ] = None,
    mode: Annotated[
        list[str] | None, typer.Option(help="Facility variant; repeatable. Default: those of the study.")
    ] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATH",
            help="What is sought; repeatable. Default: beta, and with the rating found, rounded up to a step "
            "of 0.05, battery power bess.P_dis and DC hold-up dc.T_hold.",
        ),
    ] = None,
    beta: Annotated[
        float | None, typer.Option(help="Rating with which other parameters than beta are sought.")
    ] = None,
    low: Annotated[float | None, typer.Option(help="Low end of the range; default: the bound.")] = None,
    high: Annotated[float | None, typer.Option(help="High end of the range; default: the bound.")] = None,
    engine: Annotated[
        str | None, typer.Option(help="Simulator of the faults: native, andes. Default: the study's replay.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Plain data instead of a table.")] = False,
) -> None:
    """The least rating, battery and DC hold-up with which given capacities ride through all faults.

    Each answer is replayed: it passes, and the value just below it fails. The network's own limits are not
    looked at; a study does that.

    Exit codes: 0 every answer found; 2 bad input; 3 some value does not exist in its range, or the grid

    has no operating point at these capacities; 4 a fault has no simulation.
    """
    from dcvrt.studies import design as designing
    from dcvrt.studies.study import Study

    capacities, problems = designing.hosting_of(hosting or [])
    if not hosting:
        problems.append("--hosting is needed, for example --hosting 21=30,75=150.")
    loaded = Study.load(file)
    setting = loaded.setting()
    ask = designing.Ask(
        capacities,
        tuple(mode or loaded.file.facility.modes),
        tuple(parameter or ()),
        beta,
        low,
        high,
        engine or loaded.file.replay.engine,
    )
    raise_all(problems + designing.problems_of(ask, setting), "design")
    answers = designing.design(setting, ask)
    if as_json:
        print(json.dumps([answer.as_data() for answer in answers], indent=2))
    else:
        print(designing.header(setting, ask))
        _console(80).print(designing.table_of(answers))
        print(designing.FOOTER)
    if any(answer.value is None for answer in answers):
        raise typer.Exit(INFEASIBLE)


# -- one facility --------------------------------------------------------------------------------------------


@app.command()
def ride(
    variant: Annotated[str, typer.Argument(help="Facility variant; 'dcvrt facility list' shows them.")],
    waveform: Annotated[
        str | None,
        typer.Option(help=f"CSV file with columns t and v, or one of {', '.join(scenarios.names())}."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help=f"Instead of a waveform, every item of an envelope: {', '.join(envelopes.names())}."
        ),
    ] = None,
    beta: Annotated[float, typer.Option(help="Converter rating over hosted capacity.")] = 1.15,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Another parameter, as sup.T_dip=2.5; repeatable."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for signals (CSV), pictures and, of an envelope, verdicts (CSV)."),
    ] = None,
) -> None:
    """Run one facility on one waveform, or against the ride-through envelope of a code.

    Exit codes: 0 done, and every item of an envelope passed; 2 bad input;

    3 the facility fails an item of the envelope; 4 a run did not reach its end.
    """
    from dcvrt.studies.single import parameters_of

    if (waveform is None) == (against is None):
        how = "neither is there" if waveform is None else "both are there"
        raise InputError(
            f"ride needs either --waveform or --against; {how}. Way out: --waveform for one course of the "
            "voltage, --against for every item of a code."
        )
    parameters = parameters_of(beta, settings or [])
    if waveform is not None:
        from dcvrt.studies.single import ride as run_one

        text, complete = run_one(variant, waveform, parameters, out)
        print(text)
        if not complete:
            raise typer.Exit(INCOMPLETE)
    elif against is not None:
        _against(variant, envelopes.get(against), parameters, out)


def _against(
    variant: str, envelope: envelopes.Envelope, parameters: dict[str, float], out: Path | None
) -> None:
    from dcvrt.studies import against as judge

    outcomes, written = judge.against(variant, envelope, parameters, out)
    print(judge.header(variant, envelope, parameters))
    _console(160).print(judge.table_of(outcomes))
    print(judge.footer(envelope, outcomes))
    for path in written[:3]:
        print(path)
    if len(written) > 3:
        print(f"{written[3].parent}: {len(written) - 3} tables of signals")
    passed = judge.overall(outcomes)
    if passed is not True:
        raise typer.Exit(INFEASIBLE if passed is False else INCOMPLETE)


@facility.command("list")
def facility_list() -> None:
    """List the shipped variants: name, what it is, number of states, modes of its automata."""
    from rich import box
    from rich.table import Table

    from dcvrt import facility as variants

    shown = Table(
        "name", "what it is", "states", "modes", box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0)
    )
    for name in variants.names():
        diagram = variants.get(name)
        dae = diagram.compile()
        modes = "\n".join(f"{a.path}: {' '.join(a.modes)}" for a in dae.automata)
        shown.add_row(name, diagram.doc, str(len(dae.states)), modes)
    shown.columns[0].no_wrap = True
    _console().print(shown)


@facility.command("sheet")
def facility_sheet(
    variant: Annotated[str, typer.Argument(help="Facility variant; 'dcvrt facility list' shows them.")],
    markdown: Annotated[bool, typer.Option("--markdown", help="Markdown, as into a file.")] = False,
    latex: Annotated[bool, typer.Option("--latex", help="A LaTeX document.")] = False,
) -> None:
    """Show what a variant is made of: equations, parameters, ports, modes. Markdown when piped."""
    from dcvrt import facility as variants

    if markdown and latex:
        raise InputError("--markdown and --latex exclude each other. Way out: one of the two.")
    diagram = variants.get(variant)
    if latex or markdown or not sys.stdout.isatty():
        print(diagram.sheet("latex" if latex else "markdown"), end="")
        return
    from dcvrt.models.sheet import contents
    from dcvrt.models.sheet_forms import terminal

    console = _console()
    for part in terminal(contents(diagram), console.width):
        console.print(part)


@facility.command("export")
def facility_export(
    variant: Annotated[str, typer.Argument(help="Facility variant; 'dcvrt facility list' shows them.")],
    fmu: Annotated[Path, typer.Option(help="File to write, *.fmu.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file of this name.")] = False,
) -> None:
    """Write a variant as an FMU (FMI 3.0, model exchange) for other simulation tools."""
    from dcvrt import facility as variants
    from dcvrt.fmi import export

    diagram = variants.get(variant)
    path = export(diagram.compile(), fmu, overwrite=overwrite, doc=diagram.doc, sheet=diagram.sheet())
    print(f"{path}: {variant} as FMI 3.0 model exchange; documentation/index.html inside tells how to use it")


# -- the machine ---------------------------------------------------------------------------------------------


@app.command()
def doctor() -> None:
    """Say what is installed, where caches are, what is missing and how to get it."""
    from dcvrt.studies.doctor import examine

    text, healthy = examine()
    print(text)
    if not healthy:
        raise typer.Exit(INCOMPLETE)


# -- entry ---------------------------------------------------------------------------------------------------


def code_of(error: DcvrtError) -> int:
    """Exit code of an error."""
    if isinstance(error, InfeasibleError):
        return INFEASIBLE
    return INCOMPLETE if isinstance(error, SimulationError) else BAD_INPUT


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; errors of dcvrt are one message without a traceback."""
    one_thread()  # before anything heavy is imported
    try:
        app(sys.argv[1:] if arguments is None else arguments)
    except DcvrtError as error:
        _complain(str(error))
        raise SystemExit(code_of(error)) from None


def _complain(text: str) -> None:
    red, plain = ("\033[31m", "\033[0m") if sys.stderr.isatty() else ("", "")
    print(f"{red}{text}{plain}", file=sys.stderr)


if __name__ == "__main__":
    main()
