"""Command `run`: estimate the unknowns of a case from complete or live data."""

from __future__ import annotations

import json
import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.markup import escape

from livepde import __version__, runs
from livepde.cases import Case, LiveCase, Prepared
from livepde.cases.remedies import after_gaps, start_missed, with_settings
from livepde.cases.set_aside import with_errors_of_set_aside
from livepde.cli import options, printing
from livepde.errors import ConfigurationError, DataError, LivepdeError
from livepde.estimate import Estimate
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.runs import JOURNAL, RECORD, Check, Driven, Journal, RunWriter, Sink, Table
from livepde.runs.directory import attempted
from livepde.runs.monitor import JsonLinesSink, Metrics, Monitor
from livepde.runs.monitor import configure as configure_logging
from livepde.runs.web import Address
from livepde.streams import DataTable
from livepde.verdict import Verdict

if TYPE_CHECKING:
    import xarray as xr
LOG = logging.getLogger("livepde.run")
BEAT = 60.0  # seconds between progress lines in the log
METRICS_PORT = 9100


class LogKind(StrEnum):
    """Formats of the log."""

    text = "text"
    json = "json"


def run(
    case: options.CaseArgument,
    data: Annotated[
        str | None,
        options.option(
            "Use this data instead of the case's: a .csv, .jsonl or .parquet file, or - for JSON "
            "lines from standard input. If `data.follow` is set, the file is followed."
        ),
    ] = None,
    out: options.OutOption = None,
    resume: Annotated[
        bool,
        options.option(
            "Resume the run in --out, with the same results as without the interruption. If "
            "there is no run, start one. Standard input is then read as with --realtime, and rows "
            "that were sent before are only counted.",
            "--resume",
        ),
    ] = False,
    realtime: Annotated[
        bool,
        options.option(
            "Run online: late, malformed and missing rows are counted and do not end the run. "
            "A complete file is replayed. This is the default if the source is live.",
            "--realtime",
        ),
    ] = False,
    speed: Annotated[
        float | None,
        options.option(
            "Speed of the replay with --realtime, relative to the recorded times. inf: as fast as "
            "possible. Default: 1."
        ),
    ] = None,
    listen: Annotated[
        str | None,
        options.option(
            "Serve /livez, /readyz, /health and /metrics (Prometheus) at this address.",
            metavar="[HOST:]PORT",
        ),
    ] = None,
    watch: Annotated[
        str | None,
        options.option(
            "Serve the live page at this address during the run.", metavar="[HOST:]PORT"
        ),
    ] = None,
    token: Annotated[
        str,
        options.option(
            "Token that clients of --listen and --watch must send.", envvar="LIVEPDE_TOKEN"
        ),
    ] = "",
    estimates: Annotated[
        bool,
        options.option("Print each estimate to standard output as a line of JSON.", "--estimates"),
    ] = False,
    log: Annotated[LogKind, typer.Option(help="Format of the log of a live run.")] = LogKind.text,
    as_json: options.JsonOption = False,
    allow_code: options.CodeOption = False,
    allow_env: options.EnvOption = None,
    settings: options.SetOption = None,
) -> None:
    """Estimate the unknowns of a case from its data, and write a run directory.

    Ctrl-C or SIGTERM ends a run early. The results so far are written.

    Example:  livepde run mycase/case.toml
    Replay:   livepde run mycase/case.toml --realtime --speed 3600 --watch 8050
    Service:  livepde run mycase/case.toml --realtime --out runs/mycase --resume --listen 9100
    """
    loaded = options.load_case(case, allow_code, settings)
    own = loaded.is_live(data)
    how = LiveOptions(
        data, own, realtime, resume, speed, listen, watch, token, estimates, allow_env
    )
    folder = _run_directory(loaded, out, resume)
    _refuse(how, as_json)
    write = partial(writer_of, loaded, folder, settings or (), resume, ["livepde", *sys.argv[1:]])
    with ExitStack() as stack:
        if how.live:
            configure_logging(log.value)
            writer, taken = run_live(loaded, how, folder, write, stack)
        else:
            prepared = loaded.prepare(how.source)
            writer, taken = run_batch(prepared, folder, write, stack, quiet=as_json)
        prepared, driven = taken
        # A service must stop within seconds: `livepde report` can draw the figures later.
        draw = not (how.live and driven.status == "interrupted")
        found = concluded(prepared, prepared.identifier, driven, writer, draw=draw)
    if driven.error is not None:
        raise driven.error
    if not estimates:  # with --estimates, standard output is for estimates only
        _show(loaded.title, folder, driven, found, as_json)
    if driven.status == "interrupted" and not how.live:  # a signal is the usual end of a live run
        raise typer.Exit(printing.INTERRUPTED)
    printing.exit_if_failed(found.checks if as_json else ())


def _show(title: str, folder: Path, driven: Driven, found: Conclusion, as_json: bool) -> None:
    where = escape(str(folder))
    printing.present(
        found.tables,
        found.checks,
        found.notes,
        as_json=as_json,
        title=f"[bold]{escape(title)}[/]  {len(driven.result)} samples",
        lines=[f"[bold]Run directory: {where}[/]", f"To view it: livepde watch {where}"],
        dataset=found.dataset,
        run=str(folder),
        status=driven.status,
    )


def _run_directory(loaded: Case, out: Path | None, resume: bool) -> Path:
    """Return the run directory: `out`, which must be free for a new run, or a new default."""
    if out is None:
        if resume:
            raise ConfigurationError("--resume requires --out: the run directory to resume.")
        return runs.free_path(Path("runs") / loaded.name)
    if not resume:
        runs.refuse_taken(out)
    return out


def _refuse(how: LiveOptions, as_json: bool) -> None:
    """Refuse conflicting options before data are read."""
    live_only = {
        "--speed": how.speed is not None,
        "--listen": how.listen,
        "--watch": how.page,
        "--estimates": how.estimates,
    }
    for name, given in live_only.items():
        if given and not how.live:
            raise ConfigurationError(f"{name} requires --realtime.")
    if as_json and how.estimates:
        raise ConfigurationError("--json and --estimates both print to standard output. Keep one.")
    if how.continuous and how.speed is not None:
        raise ConfigurationError(
            "--speed is only valid for the replay of a complete file. This source is live."
        )


def writer_of(
    loaded: Case, folder: Path, settings: Sequence[str], resume: bool, command: Sequence[str]
) -> RunWriter:
    """Return the writer of a new or resumed run directory."""
    about: dict[str, Any] = {"version": __version__, "command": command, "settings": settings}
    about |= {"case": loaded.text, "original": loaded.original}
    if resume and (folder / RECORD).exists():
        return RunWriter.reopen(folder, **about)
    return RunWriter.create(folder, title=loaded.title, **about)


def run_batch(
    prepared: Prepared,
    folder: Path,
    write: Callable[[], RunWriter],
    stack: ExitStack,
    *,
    quiet: bool,
) -> tuple[RunWriter, tuple[Prepared, Driven]]:
    """Run a case on complete data; an unusable sample ends the run."""
    identifier = prepared.identifier  # raises on inconsistent data before files are written
    writer, path = write(), folder / JOURNAL
    table = prepared.stream if isinstance(prepared.stream, DataTable) else None
    if path.exists():
        journal = stack.enter_context(Journal.open(path, write=True))
    else:
        journal = stack.enter_context(prepared.journal(path))
        for (kind, channel), number in (table.remarks if table else {}).items():
            journal.count(kind, channel, number)
    driven = runs.drive(
        identifier,
        prepared.stream,
        progress=not quiet,
        total=len(table) if table else None,
        fields_every=prepared.case.spec.output.fields_every,
        journal=journal,
    )
    return writer, (prepared, driven)


class Conclusion(NamedTuple):
    """Dataset of a run, and the tables, checks and notes that are printed."""

    dataset: xr.Dataset
    tables: list[Table]
    checks: list[Check]
    notes: list[str]


def concluded(
    prepared: Prepared,
    identifier: Identifier,
    driven: Driven,
    writer: RunWriter,
    *,
    draw: bool = True,
) -> Conclusion:
    """Write the results of a run, with figures if `draw`, and return them."""
    from livepde.diagnostics import identifiability

    loaded, journal = prepared.case, driven.journal
    notes: list[str] = []
    nothing: list[Any] = []
    ended = attempted("The final estimate", driven.result.dataset, None, notes)
    dataset = journal.dataset() if ended is None else ended
    # The estimates are written first, so that they are safe if a later step fails or takes long.
    writer.finish(status=driven.status, dataset=dataset, identifier=identifier, notes=loaded.notes)
    judged = partial(_judged, prepared, driven, dataset)
    found = attempted("The verdict", judged, Verdict.unjudged(), notes)
    dataset.attrs["verdict"] = json.dumps(found.to_dict())
    shown = [
        *([runs.verdict_table(found)] if len(driven.result) else []),
        *attempted("The tables", lambda: runs.tables(dataset), nothing, notes),
        *attempted("The table of irregular rows", lambda: runs.arrivals(journal), nothing, notes),
    ]
    expected = loaded.expected
    checks = attempted("The checks", lambda: runs.checks_of(expected, dataset), nothing, notes)
    notes[:0] = [*loaded.notes, *found.sentences]
    if len(driven.result):
        if isinstance(loaded.law, SensitivityLaw):
            notes += attempted(
                "Identifiability", lambda: identifiability(identifier).sentences, nothing, notes
            )
        if loaded.spec.output.smoothed:
            smooth = partial(_with_smoothed, prepared, driven, dataset)
            dataset, more = attempted("The smoother", smooth, (dataset, nothing), notes)
            notes += more
    if driven.status == "interrupted":
        notes.append(f"Interrupted after {len(driven.result)} samples.")
    if driven.error is not None:
        notes.append(f"Stopped after {len(driven.result)} samples: {driven.error}")
    figures: dict[str, Any] = {}
    if draw and printing.can_draw(printing.terminal(err=True)):
        figures = printing.figures_of(dataset, loaded.title, journal)
    writer.finish(
        status=driven.status,
        dataset=dataset,
        identifier=identifier,
        shown=shown,
        checks=checks,
        notes=notes,
        figures=figures,
    )
    return Conclusion(dataset, shown, checks, notes)


def _judged(prepared: Prepared, driven: Driven, dataset: xr.Dataset) -> Verdict:
    """Return the verdict on a run, with settings of the case as remedies for its findings."""
    raw, journal = prepared.raw, driven.journal

    def readings() -> tuple[Array, Array]:
        return journal.readings(journal.channels) if raw is None else (raw.t, raw.values)

    inputs = runs.input_findings(journal, prepared.case.roles("boundary", "input"))
    found = [*runs.sampling_findings(dataset, readings), *runs.clock_findings(journal), *inputs]
    verdict = after_gaps(runs.verdict(dataset).with_findings(found), inputs)
    verdict = with_errors_of_set_aside(prepared, dataset, verdict)
    return with_settings(prepared, verdict.with_findings(start_missed(prepared, verdict)))


def _with_smoothed(
    prepared: Prepared, driven: Driven, dataset: xr.Dataset
) -> tuple[xr.Dataset, list[str]]:
    """Return the dataset of a run with smoothed estimates, and notes if they are unavailable."""
    from livepde.hindsight import with_smoothed

    if driven.status != "finished" or not len(driven.result):
        return dataset, ["No smoothed estimates: the run did not finish."]
    samples = ((taken.t, taken.values) for taken in driven.journal.taken())
    begun = prepared.identifier_with(prepared.case.law)
    try:
        smoothed = begun.smoothed(samples, fields_every=prepared.case.spec.output.fields_every)
    except LivepdeError as error:  # the estimates of the run are kept
        return dataset, [f"No smoothed estimates: {error}"]
    return with_smoothed(dataset, smoothed), []


@dataclass(frozen=True)
class LiveOptions:
    """Options of the command that concern live runs."""

    data: str | None  # replaces the source of the case
    own: bool  # whether the source of the case, or the file that replaces it, is live
    realtime: bool
    resume: bool
    speed: float | None
    listen: str | None
    page: str | None
    token: str
    estimates: bool
    allow_env: Sequence[str] | None

    @property
    def source(self) -> str | Iterable[str] | None:
        """The data, with `-` replaced by standard input."""
        return sys.stdin if self.data == "-" else self.data

    @property
    def continuous(self) -> bool:
        """Whether the source continues at its own pace."""
        return self.own or self.data == "-"

    @property
    def live(self) -> bool:
        """Whether to run online."""
        # Rows sent to a resumed run may begin at any time: times count from the first start.
        return self.own or self.realtime or (self.resume and self.data == "-")

    @property
    def pace(self) -> float:
        """Speed of the samples relative to real time; inf: samples are processed immediately."""
        if self.continuous:
            return math.inf
        return 1.0 if self.speed is None else self.speed


def run_live(
    case: Case, how: LiveOptions, folder: Path, write: Callable[[], RunWriter], stack: ExitStack
) -> tuple[RunWriter, tuple[Prepared, Driven]]:
    """Run a case in its run directory until its source ends or a signal arrives.

    `write` creates the run directory after the source is connected. `stack` closes all resources,
    including the journal from which the result reads.
    """
    wiring = stack.enter_context(
        LiveCase(
            case, how.source, path=folder / JOURNAL, pace=how.pace, allow_env=how.allow_env or ()
        )
    )
    health, stopping = partial(_health, wiring), threading.Event()
    sinks = _observers(case, how, stack, health)
    writer = write()
    # The final report needs them, and after a signal there is no time to import them.
    for library in ("xarray", "pint"):
        import_module(library)
    if how.page is not None:
        _serve_page(how.page, how.token, folder, stack)
    with runs.stopped_by_signals(stopping, lambda: True):
        try:
            live = wiring.live(sinks, stopping)
        except DataError as error:
            writer.finish(status="failed", notes=[str(error)])
            raise
        if live is not None and wiring.prepared is not None:
            return writer, (wiring.prepared, runs.conduct(live, patient=True))
    writer.finish(status="interrupted", notes=["Ended before the first sample."])
    raise typer.Exit(printing.INTERRUPTED)


def _health(wiring: LiveCase) -> Mapping[str, Any]:
    """Return the content of /health, including the time before the first sample."""
    if wiring.running is not None:
        return wiring.running.health
    silent, why = wiring.silent, wiring.why  # read once: another thread sets them
    return {
        "ok": not why,
        "why": why,
        "ailment": "silent" if silent else "start" if why else "",
        "samples": 0,
        "silent": silent,
        "status": "waiting for the first sample",
    }


class _Heartbeat(Sink):
    """A sink that logs the progress of a run at intervals."""

    def __init__(self) -> None:
        self._logged = -math.inf

    def put(self, estimate: Estimate) -> None:
        now = time.monotonic()
        if now - self._logged < BEAT:
            return
        self._logged = now
        numbers = estimate.parameters.items()
        shown = ", ".join(f"{label} = {value:.6g} +- {std:.2g}" for label, (value, std) in numbers)
        LOG.info("t = %g: %s", estimate.t, shown or estimate.status.code)


def _observers(
    case: Case, how: LiveOptions, stack: ExitStack, health: Callable[[], Mapping[str, Any]]
) -> list[Sink]:
    """Start servers and outputs of a live run, and return their sinks."""
    if how.page is not None:
        from livepde.dashboard import check_installed

        Address.read(how.page, 0, how.token)  # reports an invalid address first
        check_installed()
    sinks: list[Sink] = [_Heartbeat()]
    if how.estimates:
        sinks.append(JsonLinesSink(sys.stdout))
    if how.listen is not None:
        metrics = Metrics(case.sensors, case.clock.second)
        monitor = Monitor(Address.read(how.listen, METRICS_PORT, how.token), health, metrics)
        stack.callback(monitor.close)
        LOG.info("health and metrics at %s", monitor.shown)
        sinks.append(metrics)
    return sinks


def _serve_page(page: str, token: str, folder: Path, stack: ExitStack) -> None:
    """Serve the page from a separate process, so that drawing does not delay steps."""
    watch = [sys.executable, "-m", "livepde", "watch", str(folder), "--address", page]
    secret = {"LIVEPDE_TOKEN": token} if token else {}
    process = subprocess.Popen(
        [*watch, "--attached"],
        stdin=subprocess.PIPE,
        stdout=sys.stderr,
        env={**os.environ, **secret},
    )
    stack.callback(process.communicate)  # closes its standard input and waits for its end
