"""Connection of a case to a running process."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from livepde.cases.case import Case, Prepared
from livepde.cases.data import (
    START,
    Data,
    check_hours,
    limits_of,
    passwords_of,
    policy_of,
    publishers_of,
    refuse_late,
    source_of,
    suspect_start,
    wild_start,
)
from livepde.dates import since_1970
from livepde.errors import ConfigurationError, DataError
from livepde.runs.backlog import Sink
from livepde.runs.feeds import Feed, Gathered, Paced, SampleFeed
from livepde.runs.journal import Journal
from livepde.runs.live_loop import LOOK, Live
from livepde.samples import Sample
from livepde.streams.gaps import RECENT
from livepde.streams.intake import Intake, Ready, Remark, gather
from livepde.streams.oddities import FEWEST_FOLLOWING

LOG = logging.getLogger("livepde.run")


class LiveCase:
    """Connection of a case to its process; a context manager, or to be closed explicitly.

    ::

        with LiveCase(load("case.toml"), Rows(my_rows()), path=Path("journal.sqlite")) as wiring:
            live = wiring.live()
            live.run()
            print(live.result.table())

    Parameters
    ----------
    case
        The case.
    data
        Replacement of the case's source: a file, an iterable of JSON lines, or a `RowSource`.
    path
        Journal of the run. An existing journal is continued; None: in memory.
    pace
        Speed of a replay relative to real time; infinity: as fast as possible.
    allow_env
        Environment variables that the case may use as passwords, in addition to those whose names
        begin with LIVEPDE_.

    Attributes
    ----------
    prepared
        The case with its first sample; None before the first sample.
    running
        The run, including the time in which samples of the journal are processed again; None
        before.
    silent
        Whether the source has been silent for too long while waiting for the first sample.
    why
        Reason why the run cannot begin yet: the source is silent, or its samples are refused. Empty
        if there is no reason.

    Raises
    ------
    CaseError, DataError
        The source is missing or cannot be reached, or the policy is invalid.
    ConfigurationError
        The pace is not positive.
    RunError
        The journal cannot be continued.
    """

    def __init__(
        self,
        case: Case,
        data: Data = None,
        *,
        path: Path | None = None,
        pace: float = math.inf,
        allow_env: Iterable[str] = (),
    ) -> None:
        if not pace > 0.0:
            raise ConfigurationError(f"a replay needs a speed > 0; got {pace}.")
        self.case = case
        self.prepared: Prepared | None = None
        self.running: Live | None = None
        self.silent = False
        self.why = ""
        self._reason = "no sample arrived"  # reason why the run has not begun
        self._heard = 0.0  # monotonic time at which data last arrived from the source
        # Raises errors about an invalid case before connections are opened.
        self._policy, self._limits = policy_of(case), limits_of(case)
        self._passwords = passwords_of(case, data is None, allow_env)
        self._path = path
        self._journal: Journal | None = None
        self._intake: Intake | None = None
        self._origin: datetime | None = None
        with ExitStack() as stack:
            if path is not None and path.exists():
                self._journal = stack.enter_context(Journal.open(path, write=True))
            self._feed = self._fed(data)
            stack.callback(self._feed.close)
            if math.isfinite(pace):
                self._feed = Paced(self._feed, pace * case.clock.second)
            self._stack = stack.pop_all()

    def __enter__(self) -> LiveCase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close source, sinks and journal."""
        self._stack.close()

    def live(
        self, sinks: Iterable[Sink] = (), stopping: threading.Event | None = None
    ) -> Live | None:
        """Wait for the first sample with all initial values, and return the run, ready to continue.

        Parameters
        ----------
        sinks
            Destinations of estimates in addition to the journal and the sinks of the case. They are
            closed with this object.
        stopping
            Event that stops the waiting and the run.

        Returns
        -------
        Live or None
            The run; None if `stopping` was set before the first sample.

        Raises
        ------
        DataError
            The source ended before the first sample.
        """
        stopping = stopping or threading.Event()
        sinks = [*sinks, *publishers_of(self.case, self._passwords)]
        for sink in sinks:
            self._stack.callback(sink.close)
        waiting: Sequence[Ready] = ()
        irregular: dict[tuple[str, str], Remark] = {}
        if self._journal is not None and self._journal.first is not None:
            first = self._journal.first
            self.prepared = self._prepared(Sample(t=first.t, z=first.values))
        else:
            found = self._begun(stopping, irregular)
            if found is None:
                return None
            self.prepared, waiting = found
        if self._journal is None:
            self._journal = self._stack.enter_context(self.prepared.journal(self._path))
        if self._intake is not None:
            self._intake.past = self._journal
        backlog, retention, silence = self._limits
        live = Live(
            self.prepared.identifier,
            self._feed,
            self._journal,
            sinks=sinks,
            fields_every=self.case.spec.output.fields_every,
            backlog=backlog,
            retention=retention,
            silence=silence,
            begun=waiting,
            irregular=irregular.values(),
            patient=True,
            stopping=stopping,
        )
        self.running = live
        again = live.resume()
        if len(live.result):
            LOG.info(
                "resumed after %d samples, %d of them processed again", len(live.result), again
            )
        return live

    def _prepared(self, first: Sample) -> Prepared:
        """Return the case with its first sample; live if rows arrive through an intake."""
        origin = self._origin if self._intake is None else self._intake.start
        return self.case.begin(first, origin, live=self._intake is not None)

    def _begun(
        self, stopping: threading.Event, irregular: dict[tuple[str, str], Remark]
    ) -> tuple[Prepared, Sequence[Ready]] | None:
        """Return the case with its first sample, and the samples so far; None if stopped."""
        LOG.info("waiting for the first sample")
        self._heard = time.monotonic()
        found: list[Ready] = []
        held: dict[str, float] = {}  # last values of held channels in samples that were dropped
        while not stopping.is_set() and (found or not self._feed.done):
            news = self._polled(found, irregular)
            while found and self._is_sure(found):
                prepared = self._started(found, held)
                if prepared is not None:
                    return prepared, found
            # If the run begins in this poll, the run itself reports the remarks.
            for remark in news:
                LOG.warning("%s: %s", remark.kind, remark.message)
        if stopping.is_set():
            return None
        first = next(iter(irregular.values()), None)
        wrong = f" ({first.kind}: {first.message})" if first is not None else ""
        raise DataError(f"{self.case.path}: {self._reason}{wrong}.")

    def _polled(self, found: list[Ready], irregular: dict[tuple[str, str], Remark]) -> list[Remark]:
        """Poll the source for samples and remarks, and return the remarks of new kinds."""
        new = list(self._feed.poll(LOOK))
        self._listen()
        remarks, known = self._feed.remarks(new), set(irregular)
        found += new
        for remark in [*remarks, *self._without_wild(found)]:
            gather(irregular, remark)
        return [remark for remark in remarks if (remark.kind, remark.channel) not in known]

    def _is_sure(self, found: list[Ready]) -> bool:
        """Return whether the first row can be accepted without waiting for further rows."""
        many = self._feed.done or len(found) > FEWEST_FOLLOWING
        return many or not suspect_start(self.case, found[0].values)

    def _started(self, found: list[Ready], held: dict[str, float]) -> Prepared | None:
        """Return the case with the first sample; drop a sample with which it cannot begin.

        `held`: the last values of channels that are constant until the next reading.
        """
        values = dict.fromkeys(self.case.columns, math.nan) | found[0].values
        for name, channel in self.case.spec.channels.items():
            if channel.between == "hold" and not math.isnan(values[name]):
                held[name] = values[name]
        found[0] = replace(found[0], values=found[0].values | held)
        try:
            return self._prepared(Sample(t=found[0].t, z=values | held))
        except DataError as error:
            before, self._reason = self._reason, str(error).removesuffix(".")
        self.why = f"the run cannot start yet: {self._reason}"
        if self._reason != before:
            LOG.warning("cannot start yet: %s", self._reason)
        self._feed.acknowledge(found.pop(0))
        return None

    def _without_wild(self, found: list[Ready]) -> list[Remark]:
        """Replace outliers in the first rows by NaN, and return remarks on them."""
        if len(found) <= FEWEST_FOLLOWING:
            return []
        remarks = []
        for k, name in wild_start(self.case, [(one.t, one.values) for one in found]):
            values = found[k].values
            text = f"{name} = {values[name]:g} is an outlier: it is far from all later values"
            remarks.append(Remark(START, name, text))
            found[k] = replace(found[k], values=values | {name: math.nan})
        return remarks

    def _listen(self) -> None:
        """Update whether the source is silent, and when data last arrived from it."""
        silence = math.inf if self._limits[-1] is None else self._limits[-1]
        now = time.monotonic()
        if self._feed.heard():
            self.silent, self.why, self._heard = False, "", now
        elif not self.silent and now - self._heard > silence:
            self.silent = True
            self.why = f"no data from the source for more than {silence:g} s"
            LOG.warning("silent: %s", self.why)

    def _fed(self, data: Data) -> Feed:
        case, named = self.case, data if isinstance(data, str) else None
        if self._reads_all(data, named):
            whole = case.read(named)  # gaps are filled without waiting for the next value
            self._origin = whole.origin
            if self._journal is not None:
                return SampleFeed(whole.stream, after=self._journal.last)
            counts = getattr(whole.stream, "remarks", {}).items()
            remarks = [Remark(kind, of, f"{n} times in these data", n) for (kind, of), n in counts]
            return SampleFeed(whole.stream, irregular=remarks)
        refuse_late(case)
        self._intake, position = self._new_intake()
        return Gathered(source_of(case, data, position, self._passwords), self._intake)

    def _reads_all(self, data: Data, named: str | None) -> bool:
        """Return whether all rows are read at once instead of followed one by one."""
        case, spec = self.case, self.case.spec.data
        file, reader = (spec.file, case.reader) if data is None else (named, None)
        if isinstance(file, tuple):
            return True
        check_hours(case, self.case.clock, file)
        if spec.every > 1 and not (file or reader):
            text = f"got {spec.every}; a live source uses all rows: leave it out."
            raise case.error("data.every", text)
        if reader is not None or str(file).endswith(".parquet"):
            return True
        return bool(file) and (spec.every > 1 or spec.is_of_file)

    def _new_intake(self) -> tuple[Intake, str]:
        """Return an intake for rows after the journal, and the position in the source."""
        case, journal = self.case, self._journal
        options: dict[str, Any] = {"missing": case.spec.data.missing}
        position = ""
        if journal is not None:
            begun = journal.layout.attrs.get("origin")
            position = journal.position
            options["origin"] = 0.0 if begun is None else since_1970(datetime.fromisoformat(begun))
            options |= {"dates": begun is not None, "last": journal.last}
            options["recent"] = [(one.t, one.values) for one in journal.recent(RECENT)]
        intake = Intake(case.columns, case.clock, self._policy, **options)
        intake.past = journal
        return intake, position
