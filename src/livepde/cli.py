"""The command line. Exit codes: 0 all well, 1 a check failed, 2 bad input, 130 interrupted."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable
from threadpoolctl import threadpool_limits

from livepde import __version__
from livepde.errors import ConfigurationError, LivepdeError

if TYPE_CHECKING:
    from livepde.cases import Case, Prepared
    from livepde.runs import Check, Outcome, Table
    from livepde.streams import Table as Samples

__all__ = ["app", "main"]

MOST_CHANNELS = 40  # rows of the table of channels
CHECK_FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
FIGURES_MISSING = "No figures: they need Matplotlib, pip install 'livepde[plots]'."

app = typer.Typer(
    name="livepde",
    help="""Identify the unknown parameters of a process that a PDE describes, while it runs.

    Start with:  livepde demo,  then  livepde init mycase,  livepde run mycase/case.toml""",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object, with 'checks'; exit 1 if one fails.")
]
OutOption = Annotated[
    Path | None,
    typer.Option(help="Run directory to make. Default: a new one in runs/.", show_default=False),
]
CodeOption = Annotated[
    bool,
    typer.Option(
        "--allow-code", help="Load the equation or reader of your own that the case names."
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Another value than the case has, as law.noise='2 K'. Repeat it for more.",
        show_default=False,
    ),
]
CaseArgument = Annotated[Path, typer.Argument(help="The case file (TOML).", show_default=False)]


def main() -> int:
    """Run the command line and return its exit code."""
    try:
        # The dense matrices of a step are small: threads for them cost more than they save.
        with threadpool_limits(1):
            app(standalone_mode=True)
    except LivepdeError as error:
        _console(err=True).print(f"[bold red]Error:[/] {escape(str(error))}", soft_wrap=True)
        return BAD_INPUT
    except BrokenPipeError:  # the reader of a pipe has seen enough
        sys.stderr.close()
    return 0


def _console(*, err: bool = False) -> Console:
    return Console(stderr=err, highlight=False)


def _version(asked: bool) -> None:
    if asked:
        _console().print(f"livepde {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


# --- experiments ---------------------------------------------------------------------------------


@app.command()
def demo(out: OutOption = None) -> None:
    """Watch the paper's method find q(x) and u(t, x) online.

    Runs the first experiment of Boiger and Kaltenbacher (2016), prints how close it came, and
    leaves a run directory with the figures of the paper.

    Example:  livepde demo
    """
    from livepde.reproduce import EXPERIMENTS
    from livepde.runs import RunWriter, free_path

    console = _console()
    console.print(
        "\n[bold]Which reaction q(x) explains what is seen?[/]\n\n"
        "  u_t - (D u_x)_x + q u = f  on (0, 1), u is seen on (0.3, 0.87), one sample at a time.\n"
        "  The state u and the parameter q are estimated together while the samples come.\n",
        soft_wrap=True,
    )
    folder = out or free_path(Path("runs") / "demo")
    experiment = EXPERIMENTS["seed"]
    command = ["livepde", "demo"]
    writer = RunWriter.create(
        folder, version=__version__, command=command, title="Demo: " + experiment.summary
    )
    outcome = experiment.run(None, progress=True)
    _show(console, outcome.tables, outcome.checks, outcome.notes)
    figures = outcome.figures if _can_draw(console) else {}
    writer.finish(
        status="finished",
        dataset=outcome.dataset,
        shown=outcome.tables,
        checks=outcome.checks,
        notes=outcome.notes,
        figures=figures,
    )
    for name in figures:
        console.print(f"Figure: {folder / name}.png", soft_wrap=True)
    console.print(f"[bold]Run directory: {escape(str(folder))}[/]", soft_wrap=True)


@app.command()
def reproduce(
    name: Annotated[str, typer.Argument(help="Name of the experiment; 'list' shows them.")],
    truth: Annotated[
        str | None,
        typer.Option(
            help="Where the data come from: discrete (the same scheme), fine (a finer grid), "
            "analytic (a formula).",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Keep dataset and figures in a new run directory.", show_default=False),
    ] = None,
) -> None:
    """Run a published or stated experiment and compare it with its expected numbers.

    Example:  livepde reproduce seed --json
    """
    from livepde.reproduce import EXPERIMENTS
    from livepde.runs import RunWriter

    if name == "list":
        for item in EXPERIMENTS.values():
            _console().print(f"[bold]{item.name}[/]  {escape(item.summary)}")
        return
    experiment = _named(name, EXPERIMENTS, "experiment")
    command = ["livepde", "reproduce", name, *(["--truth", truth] if truth else [])]
    writer = None
    if out is not None:
        writer = RunWriter.create(
            out, version=__version__, command=command, title=experiment.summary
        )
    outcome = experiment.run(truth, progress=not as_json)
    if writer is not None:
        writer.finish(
            status="finished",
            dataset=outcome.dataset,
            shown=outcome.tables,
            checks=outcome.checks,
            notes=outcome.notes,
            figures=outcome.figures if _can_draw(_console(err=True)) else {},
        )
    _report_outcome(outcome, command, as_json)


SUITES = ("cases", "coverage", "accuracy", "peers")  # benchmarks with options of their own


@app.command()
def bench(
    name: Annotated[str, typer.Argument(help="Name of the benchmark; 'list' shows them.")] = "list",
    as_json: JsonOption = False,
    only: Annotated[
        list[str] | None,
        typer.Option(help="With 'cases', 'accuracy', 'peers': only this one. Repeat it for more."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1, help="With 'accuracy', 'peers': data sets for each noise level. Default: 3, 1."
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="With 'cases': where they are. Default: the next folder 'cases'."),
    ] = None,
    gallery: Annotated[
        Path | None,
        typer.Option(help="With 'cases': folder for a page with tables and figures."),
    ] = None,
    twins: Annotated[
        int, typer.Option(min=1, help="With 'coverage': how many twins of each problem.")
    ] = 200,
) -> None:
    """Measure what things cost, as ratios that hold on any machine, and what cases find.

    'cases' runs every case of the project with its variants, and the code that they name.
    'coverage' counts how often the truth lies in the 68 % and 95 % intervals.
    'accuracy' holds our laws against what all data together can tell, at several noise levels;
    'peers' against other packages, where they are installed.

    Example:  livepde bench step
    Accuracy: livepde bench accuracy --only wall --seeds 5
    Cases:    livepde bench cases --only soil_layers --json
    """
    from livepde.bench import BENCHMARKS

    if name == "list":
        for key in (*BENCHMARKS, *SUITES):
            _console().print(key)
        return
    if name == "cases":
        _bench_cases(folder, only or [], gallery, as_json)
        return
    if name in SUITES:
        outcome = _bench_suite(name, only or [], seeds, twins)
    else:
        outcome = _named(name, {**BENCHMARKS, **dict.fromkeys(SUITES)}, "benchmark")()
    _report_outcome(outcome, ["livepde", "bench", name], as_json)


def _bench_suite(name: str, only: Sequence[str], seeds: int | None, twins: int) -> Outcome:
    from livepde.bench.accuracy import accuracy
    from livepde.bench.coverage import coverage
    from livepde.bench.peers import peers
    from livepde.bench.problems import PROBLEMS

    if name == "coverage":
        return coverage(twins, progress=True)
    for problem in only:
        _named(problem, PROBLEMS, "problem")
    if name == "peers":
        return peers(only, seeds or 1, progress=True)
    return accuracy(only, seeds or 3, progress=True)


def _bench_cases(
    folder: Path | None, only: Sequence[str], gallery: Path | None, as_json: bool
) -> None:
    from livepde.bench import cases

    known = {path.stem: path for path in cases.find_cases(folder)}
    paths = [_named(name, known, "case") for name in only] or list(known.values())
    pictures = None
    if gallery is not None:
        gallery.mkdir(parents=True, exist_ok=True)
        pictures = gallery if _can_draw(_console(err=True)) else None
    outcome, runs = cases.bench_cases(paths, progress=True, pictures=pictures)
    if gallery is not None:
        page = cases.gallery(runs, gallery)
        _console(err=True).print(f"Gallery: {page}", soft_wrap=True)
    _report_outcome(outcome, ["livepde", "bench", "cases"], as_json)


# --- cases ---------------------------------------------------------------------------------------


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write to.")],
) -> None:
    """Write a commented case to start from, with made-up data that it runs on.

    Example:  livepde init mycase
    """
    from livepde.cases.template import write_template

    case, data = write_template(folder)
    console = _console()
    console.print(f"Wrote {case} and {data}. Next:", soft_wrap=True)
    console.print(f"  livepde check {case}\n  livepde run {case}", soft_wrap=True)


@app.command()
def equations(
    name: Annotated[str, typer.Argument(help="Name of an equation; 'list' shows them.")] = "list",
) -> None:
    """Show the ready-made equations, and what a case says about one of them.

    Example:  livepde equations heat
    """
    from livepde.models import EQUATIONS
    from livepde.runs import Table

    console = _console()
    if name == "list":
        for item in EQUATIONS.values():
            console.print(f"[bold]{item.name}[/]  {escape(item.summary)}", soft_wrap=True)
        return
    found = _named(name, EQUATIONS, "equation")
    console.print(f"[bold]{found.name}[/]  {escape(found.summary)}", soft_wrap=True)
    console.print(escape(found.formula), soft_wrap=True)
    rows = [("state", "u", found.state.text, found.state.unit, "")]
    for table, known in (("[unknowns]", found.unknowns), ("[channels], input", found.inputs)):
        rows += [(table, key, item.text, item.unit, "") for key, item in known.items()]
    for key, option in found.options.items():
        default = "needed" if option.default is None else str(option.default)
        choices = f" ({', '.join(option.choices)})" if option.choices else ""
        rows.append(("[options]", key, option.text + choices, option.unit, default))
    unit = found.state.unit
    rows += [
        ("[channels], quantity", key, item.text, unit, "") for key, item in found.quantities.items()
    ]
    columns = ("where", "name", "what", "unit", "default")
    _print_table(console, Table("What a case says about it", columns, rows))
    console.print(f"Length in {found.length_unit or '1'}, time in {found.time_unit or '1'}.")


@app.command()
def check(
    case: CaseArgument,
    data: Annotated[
        str | None,
        typer.Option(help="Other data than the case names (.csv, .jsonl).", show_default=False),
    ] = None,
    allow_code: CodeOption = False,
    settings: SetOption = None,
    advise: Annotated[
        bool,
        typer.Option("--advise", help="Tell also where one more point sensor would help most."),
    ] = False,
) -> None:
    """Check a case and its data, and tell what its sensors can identify.

    Nothing is written. Example:  livepde check mycase/case.toml
    """
    console = _console()
    loaded = _load(case, allow_code, settings)
    prepared = loaded.prepare(data)
    _show_model(console, prepared)
    samples: Samples = prepared.stream  # type: ignore[assignment]
    if data is None or not data.endswith((".jsonl", ".ndjson")):
        _show_data(console, loaded, prepared, samples)
    failed = _show_checks(console, prepared)
    notes = [*loaded.notes, *_show_preview(console, prepared)]
    if advise:
        _show_advice(console, prepared)
    for note in notes:
        console.print(f"[yellow]Note:[/] {escape(note)}", soft_wrap=True)
    if failed:
        raise typer.Exit(CHECK_FAILED)
    console.print(f"[bold green]ok[/]  livepde run {escape(str(case))}", soft_wrap=True)


def _load(case: Path, allow_code: bool, settings: Sequence[str] | None) -> Case:
    from livepde import cases
    from livepde.cases.settings import parse

    return cases.load(case, allow_code=allow_code, settings=parse(settings or ()))


def _show_preview(console: Console, prepared: Prepared) -> Sequence[str]:
    """Print what the sensors can tell; return sentences on it."""
    from livepde.cases.preview import preview
    from livepde.runs import Table

    found = preview(prepared, prepared.stream)
    rows = [
        (
            item.name,
            f"{item.prior:.3g}",
            f"{item.posterior:.3g}",
            f"{100 * item.left:.2g} %",
            item.unit,
            "hardly identified" if item.hardly else "",
        )
        for item in found.unknowns
    ]
    if rows:
        columns = ("unknown", "prior deviation", "after", "left", "unit", "")
        title = f"What {found.samples} samples can tell, at best"
        _print_table(console, Table(title, columns, rows))
    return found.sentences


def _show_advice(console: Console, prepared: Prepared) -> None:
    """Print where one more sensor would help most."""
    from livepde.cases.placement import advise
    from livepde.runs import Table

    found = advise(prepared, prepared.stream)
    unit = prepared.case.frame.equation.length_unit
    at = ", ".join(f"{x:.3g}" for x in found.position)
    rows = [
        (name, f"{100 * left:.2g} %", f"{100 * found.then[name]:.2g} %")
        for name, left in found.now.items()
    ]
    title = f"One more sensor helps most at {at} {unit}".rstrip()
    columns = ("unknown", "deviation left", "with the sensor")
    _print_table(console, Table(title, columns, rows))
    console.print(
        f"Best of {found.candidates} vertices by the mean share of variance left, with the noise "
        "of the other sensors.",
        soft_wrap=True,
    )


def _show_model(console: Console, prepared: Prepared) -> None:
    case, model = prepared.case, prepared.case.model
    console.print(f"[bold]{escape(case.title)}[/]\n{escape(case.frame.equation.formula)}")
    from livepde.linalg import analyse

    engine = type(analyse(model.form_M.pattern("v", "u"))).__name__.removesuffix("Solver")
    console.print(
        f"State: {model.X.dim} coefficients; parameter: {model.Q.dim}; "
        f"law: {type(case.law).__name__}; scheme: {type(case.scheme).__name__}; "
        f"engine: {engine}."
    )


def _show_data(console: Console, case: Case, prepared: Prepared, samples: Samples) -> None:
    import numpy as np

    from livepde.runs import Table

    steps = np.diff(samples.t)
    unit = case.frame.equation.time_unit
    begin = f" from {prepared.origin}" if prepared.origin else ""
    text = f"Data: {len(samples)} samples{begin}, t = {samples.t[0]:g} to {samples.t[-1]:g} {unit}"
    if len(steps):
        text += f"; step {np.median(steps):g} {unit}, longest {steps.max():g} {unit}"
    console.print(text + ".", soft_wrap=True)
    rows: list[tuple[Any, ...]] = []
    many = len(samples.names) > MOST_CHANNELS
    for name, values in zip(samples.names, samples.values.T, strict=True):
        if many and len(rows) == MOST_CHANNELS:
            more = len(samples.names) - MOST_CHANNELS
            rows.append((f"and {more} more", "", "", "", "", "", ""))
            break
        present = values[np.isfinite(values)]
        least, largest = (
            (f"{present.min():.4g}", f"{present.max():.4g}") if len(present) else ("–", "–")
        )
        rows.append(
            (
                name,
                case.frame.spec.channels[name].role,
                least,
                largest,
                case.frame.unit(name),
                len(values) - len(present),
                _longest_gap(np.isfinite(values)),
            )
        )
    columns = ("channel", "role", "least", "largest", "unit", "missing", "longest gap")
    _print_table(console, Table("Channels", columns, rows))


def _longest_gap(present: Any) -> int:
    longest = here = 0
    for value in present.tolist():
        here = 0 if value else here + 1
        longest = max(longest, here)
    return longest


def _show_checks(console: Console, prepared: Prepared) -> bool:
    """Run the library's own checks on the case's model; True if one failed."""
    from livepde.diagnostics import check_model, check_observation

    case, first = prepared.case, prepared.first
    values = first.z if isinstance(first.z, Mapping) else {}
    inputs = {name: values[name] for name in case.model.channels if values[name] == values[name]}
    report = check_model(case.model, u=prepared.u0, t=first.t, inputs=inputs)
    observed, size = prepared.identifier.observed, prepared.typical(inputs)
    read = {name: values[name] for name in observed.observation.inputs}
    reports = [report, check_observation(observed, at=size, inputs={**inputs, **read})]
    for item in reports:
        if item.ok:
            console.print(f"{item.name}: [green]ok[/] ({len(item.lines)} properties)")
        else:
            console.print(escape(str(item)), soft_wrap=True)
    return not all(item.ok for item in reports)


@app.command()
def run(
    case: CaseArgument,
    data: Annotated[
        str | None,
        typer.Option(
            help="Other data than the case names: a .csv or .jsonl file, or - for JSON lines "
            "from standard input.",
            show_default=False,
        ),
    ] = None,
    out: OutOption = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Identify: take every sample of a case, and write a run directory.

    Ctrl-C ends a run early; what it has is written.

    Example:  livepde run mycase/case.toml
    Live:     logger | livepde run mycase/case.toml --data -
    """
    from livepde.runs import RunWriter, checks_of, doubts, drive, free_path, tables
    from livepde.streams import Table as Samples

    loaded = _load(case, allow_code, settings)
    source = sys.stdin if data == "-" else data
    if out is not None and out.exists():
        _must_be_empty(out)
    prepared = loaded.prepare(source)
    folder = out or free_path(Path("runs") / loaded.name)
    writer = RunWriter.create(
        folder,
        version=__version__,
        command=["livepde", *sys.argv[1:]],
        title=loaded.title,
        case=loaded.text,
        settings=settings or (),
        original=loaded.original,
    )
    total = len(prepared.stream) if isinstance(prepared.stream, Samples) else None
    driven = drive(
        prepared.identifier,
        prepared.stream,
        progress=not as_json,
        total=total,
        fields_every=loaded.fields_every,
    )
    dataset = driven.result.to_xarray()
    prepared.describe(dataset)
    checks = checks_of(loaded.expected, dataset)
    notes = [*loaded.notes, *doubts(dataset)]
    if len(driven.result):
        notes += _traded(prepared)
    if driven.status == "interrupted":
        notes.append(f"Interrupted after {len(driven.result)} samples.")
    if driven.error is not None:
        notes.append(f"Stopped after {len(driven.result)} samples: {driven.error}")
    shown = tables(dataset)
    err = _console(err=True)
    writer.finish(
        status=driven.status,
        dataset=dataset,
        identifier=prepared.identifier,
        shown=shown,
        checks=checks,
        notes=notes,
        figures=_figures(dataset, loaded.title) if _can_draw(err) else {},
    )
    if driven.error is not None:
        raise driven.error
    if as_json:
        _print_json(shown, checks, notes, run=str(folder), status=driven.status, dataset=dataset)
    else:
        console = _console()
        console.print(f"[bold]{escape(loaded.title)}[/]  {len(driven.result)} samples")
        _show(console, shown, checks, notes)
        console.print(f"[bold]Run directory: {escape(str(folder))}[/]", soft_wrap=True)
    if driven.status == "interrupted":
        raise typer.Exit(INTERRUPTED)
    if as_json and not all(item.ok for item in checks):
        raise typer.Exit(CHECK_FAILED)


def _traded(prepared: Prepared) -> list[str]:
    """Return what a run's data tell only together."""
    from livepde.diagnostics import identifiability
    from livepde.laws import SensitivityLaw

    if not isinstance(prepared.case.law, SensitivityLaw):
        return []
    belief = prepared.identifier.latent_belief()
    return identifiability(prepared.case.model, belief).sentences


def _must_be_empty(folder: Path) -> None:
    """Refuse a taken folder before data are read."""
    from livepde.runs import refuse_taken

    refuse_taken(folder)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run directory.")],
    theory: Annotated[
        bool,
        typer.Option(
            "--theory",
            help="What the paper's theory says about the run: constants, excitation, conditions, "
            "T*. Takes the samples again; writes theory.md.",
        ),
    ] = False,
    data: Annotated[
        str | None,
        typer.Option(help="With --theory: the run's data, if its case was moved."),
    ] = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
) -> None:
    """Show what a run found: tables, and figures into the run directory.

    Example:  livepde report runs/mycase
    Theory:   livepde report runs/mycase --theory
    """
    from livepde import runs

    if theory:
        _report_theory(runs.open(folder), data, as_json, allow_code)
        return
    from livepde.runs.directory import markdown

    opened = runs.open(folder)
    shown = opened.summary()
    checks = opened.checks
    console = _console(err=as_json)
    drawn = []
    if _can_draw(console):
        for name, draw in _figures(opened.dataset, opened.title).items():
            draw().savefig(folder / f"{name}.png", dpi=120)
            drawn.append(f"{name}.png")
    notes = opened.notes
    text = markdown(opened.title, shown, checks, notes, drawn)
    (folder / "report.md").write_text(text, encoding="utf-8")
    if as_json:
        _print_json(
            shown, checks, notes, run=str(folder), status=opened.status, dataset=opened.dataset
        )
        if not all(item.ok for item in checks):
            raise typer.Exit(CHECK_FAILED)
        return
    console.print(f"[bold]{escape(opened.title)}[/]  {opened.status}")
    _show(console, shown, checks, notes)
    for name in drawn:
        console.print(f"Figure: {folder / name}", soft_wrap=True)


def _report_theory(opened: Any, data: str | None, as_json: bool, allow_code: bool) -> None:
    """Take a run's samples again, and print and write what the theory says."""
    from livepde.diagnostics import theory_report
    from livepde.errors import CaseError, RunError
    from livepde.runs import Table

    case = opened.case_file()
    try:
        prepared = _load(case, allow_code, opened.settings).prepare(data or opened.data_file)
    except CaseError as error:
        if case.parent != opened.path:
            raise
        moved = "The case is not where it was run, or has changed: add --data FILE with its data."
        raise RunError(f"{error} {moved}") from error
    found = theory_report(prepared.identifier, prepared.stream)
    target = opened.path / "theory.md"
    target.write_text(found.markdown(f"Theory: {opened.title}"), encoding="utf-8")
    shown = [Table(table.title, table.columns, table.rows) for table in found.tables]
    if as_json:
        _print_json(shown, [], found.notes, run=str(opened.path), theory=str(target))
        return
    console = _console()
    console.print(f"[bold]{escape(opened.title)}[/]  theory")
    _show(console, shown, [], found.notes)
    console.print(f"Page: {escape(str(target))}", soft_wrap=True)


# --- printing ------------------------------------------------------------------------------------


def _named(name: str, known: Mapping[str, Any], what: str) -> Any:
    if name not in known:
        import difflib

        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"expected one of {', '.join(known)}."
        raise ConfigurationError(f"there is no {what} '{name}'; {hint}")
    return known[name]


def _can_draw(console: Console) -> bool:
    import importlib.util

    found = importlib.util.find_spec("matplotlib") is not None
    if not found:
        console.print(escape(FIGURES_MISSING))
    return found


def _figures(dataset: Any, title: str) -> dict[str, Any]:
    from livepde import plots

    if not dataset.sizes["time"]:
        return {}
    return {"overview": lambda: plots.overview(dataset, title=title)}


def _report_outcome(outcome: Outcome, command: Sequence[str], as_json: bool) -> None:
    if as_json:
        _print_json(outcome.tables, outcome.checks, outcome.notes, command=" ".join(command))
    else:
        _show(_console(), outcome.tables, outcome.checks, outcome.notes)
    if as_json and not outcome.ok:
        raise typer.Exit(CHECK_FAILED)


def _print_json(
    shown: Iterable[Table],
    checks: Iterable[Check],
    notes: Iterable[str],
    *,
    dataset: Any = None,
    **more: Any,
) -> None:
    from livepde.runs import measures
    from livepde.runs.directory import plain

    content: dict[str, Any] = {"livepde": __version__, **more}
    content["checks"] = [item.to_dict() for item in checks]
    if dataset is not None:
        content["measures"] = measures(dataset)
    content["tables"] = [item.to_dict() for item in shown]
    content["notes"] = list(notes)
    sys.stdout.write(json.dumps(plain(content), ensure_ascii=False) + "\n")


def _show(
    console: Console, shown: Iterable[Table], checks: Iterable[Check], notes: Iterable[str]
) -> None:
    for table in shown:
        _print_table(console, table)
    _print_checks(console, list(checks))
    for note in notes:
        console.print(f"[yellow]Note:[/] {escape(note)}", soft_wrap=True)


def _print_table(console: Console, table: Table) -> None:
    from rich.box import SIMPLE_HEAD

    grid = RichTable(
        title=escape(table.title), title_justify="left", box=SIMPLE_HEAD, title_style="bold"
    )
    for k, column in enumerate(table.columns):
        numbers = k > 0 and all(_numeric(row[k]) for row in table.rows)
        grid.add_column(escape(column), justify="right" if numbers else "left")
    for row in table.rows:
        grid.add_row(*(escape(_cell(value)) for value in row))
    console.print(grid)


def _numeric(value: Any) -> bool:
    if isinstance(value, int | float):
        return True
    text = str(value).removesuffix(" %")
    return text == "–" or text.lstrip("+-").replace(".", "").replace("e", "").isdigit()


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _print_checks(console: Console, checks: Sequence[Check]) -> None:
    from livepde.runs.directory import bound_text

    if not checks:
        return
    grid = RichTable.grid(padding=(0, 2))
    for item in checks:
        mark = "[green]ok[/]" if item.ok else "[bold red]failed[/]"
        grid.add_row(mark, escape(item.name), _cell(item.value), item.sense, bound_text(item))
    console.print(grid)
