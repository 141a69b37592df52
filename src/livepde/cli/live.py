"""A live run: it waits for the first sample, and continues until it is stopped."""

from __future__ import annotations

import logging
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from livepde.cli.printing import INTERRUPTED
from livepde.errors import DataError

if TYPE_CHECKING:
    from livepde.cases import Case, Prepared
    from livepde.cases.live_case import LiveCase
    from livepde.result import Estimate
    from livepde.runs import Driven, RunWriter
    from livepde.runs.live_loop import Sink

LOG = logging.getLogger("livepde.run")
BEAT = 60.0  # seconds between two lines of the log that say how far a run is
METRICS_PORT = 9100


@dataclass(frozen=True)
class LiveOptions:
    """Options of a live run.

    Attributes
    ----------
    data
        A file, or lines of JSON, instead of the case's own source.
    goes_on
        Whether the source goes on by itself, at its own pace.
    speed
        Speed of the replay of a finished file, relative to real time; None: that of the option's
        default.
    listen, page
        Addresses of /health and /metrics, and of the page; None: not served.
    token
        Secret that visitors need.
    estimates
        Print each estimate as a line of JSON.
    allow_env
        Environment variables that the case may use as passwords.
    """

    data: str | Iterable[str] | None = None
    goes_on: bool = False
    speed: float | None = None
    listen: str | None = None
    page: str | None = None
    token: str = ""
    estimates: bool = False
    allow_env: tuple[str, ...] = ()

    @property
    def pace(self) -> float:
        """Speed of the samples relative to real time; inf: each is taken as soon as it is there."""
        if self.goes_on:
            return math.inf
        return 1.0 if self.speed is None else self.speed


def run_live(
    case: Case, how: LiveOptions, folder: Path, write: Callable[[], RunWriter], stack: ExitStack
) -> tuple[RunWriter, tuple[Prepared, Driven]]:
    """Run a case in its run directory until its source ends or a signal comes.

    Parameters
    ----------
    write
        Makes the run directory; called when the source is connected.
    stack
        Closes all opened resources, among them the journal, from which the result reads.

    Returns
    -------
    writer, taken
        Writer of the run directory; the case with its result.

    Raises
    ------
    Exit
        The run was interrupted before the first sample.
    """
    from livepde.cases.live_case import LiveCase
    from livepde.runs import JOURNAL, conduct, stopped_by_signals

    wiring = stack.enter_context(
        LiveCase(case, how.data, path=folder / JOURNAL, pace=how.pace, allow_env=how.allow_env)
    )
    health, stopping = partial(_health, wiring), threading.Event()
    sinks = _observers(case, how, stack, health)
    writer = write()
    # The report at the end needs them, when a signal leaves few seconds.
    for library in ("xarray", "pint"):
        import_module(library)
    if how.page is not None:
        _show(how.page, how.token, folder, stack)
    with stopped_by_signals(stopping, lambda: True):
        try:
            live = wiring.live(sinks, stopping)
        except DataError as error:
            writer.finish(status="failed", notes=[str(error)])
            raise
        if live is not None and wiring.prepared is not None:
            return writer, (wiring.prepared, conduct(live, patient=True))
    writer.finish(status="interrupted", notes=["Ended before the first sample."])
    raise typer.Exit(INTERRUPTED)


def _health(wiring: LiveCase) -> Mapping[str, Any]:
    """Return the content of /health, also before the first sample."""
    if wiring.running is not None:
        return wiring.running.health
    status = "waiting for the first sample"
    silent, why = wiring.silent, wiring.why
    ailment = "silent" if silent else "start" if why else ""
    return {
        "ok": not why,
        "why": why,
        "ailment": ailment,
        "samples": 0,
        "silent": silent,
        "status": status,
    }


class _Heartbeat:
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

    def close(self) -> None:
        """Do nothing: there are no resources to release."""


def _observers(
    case: Case, how: LiveOptions, stack: ExitStack, health: Callable[[], Mapping[str, Any]]
) -> list[Sink]:
    """Start servers and outputs of a live run, and return their sinks."""
    from livepde.runs.web import Address

    if how.page is not None:
        from livepde.dashboard import check_installed

        Address.read(how.page, 0, how.token)  # an invalid address is reported before all else
        check_installed()
    sinks: list[Sink] = [_Heartbeat()]
    if how.estimates:
        from livepde.runs.monitor import JsonLinesSink

        sinks.append(JsonLinesSink(sys.stdout))
    if how.listen is not None:
        from livepde.runs.monitor import Metrics, Monitor

        metrics = Metrics(case.sensors, case.clock.second)
        monitor = Monitor(Address.read(how.listen, METRICS_PORT, how.token), health, metrics)
        stack.callback(monitor.close)
        LOG.info("health and metrics at %s", monitor.shown)
        sinks.append(metrics)
    return sinks


def _show(page: str, token: str, folder: Path, stack: ExitStack) -> None:
    """Serve the page from a separate process: drawing must not delay steps."""
    watch = [sys.executable, "-m", "livepde", "watch", str(folder), "--address", page]
    secret = {"LIVEPDE_TOKEN": token} if token else {}
    process = subprocess.Popen(
        [*watch, "--attached"],
        stdin=subprocess.PIPE,
        stdout=sys.stderr,
        env={**os.environ, **secret},
    )
    stack.callback(process.communicate)  # closes its standard input, and waits
