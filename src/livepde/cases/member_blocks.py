"""Blocks of fleet members that differ only in data and initial state, stepped together.

Each member has its own journal, whose records are equal to the records of a separate run.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from livepde.cases.case import Case, Prepared
from livepde.cases.case_channels import between_of
from livepde.errors import DataError, LivepdeError, RunError
from livepde.fleet import Fleet, FleetRecords
from livepde.frames import layout_of
from livepde.identifier import Identifier
from livepde.result import Result
from livepde.runs import Driven, Journal, stopped_by_signals
from livepde.runs.journal import Event
from livepde.samples import by_name
from livepde.streams import DataTable

WAITING = 2**23  # pending numbers above which the journals are written
ALONE = "no other member has their settings and sample times"
# Keys of channels (how they are read) and tables of the case in which members may differ.
READ = {"column", "columns", "noise_column", "unit", "factor", "late", "valid"}
READ |= {"missing", "spikes", "wait", "repeated"}
TOLD = {"title", "initial", "data", "intake", "reference", "expect", "variants"}


def blocks(members: Mapping[str, Prepared]) -> tuple[list[MemberBlock], dict[str, str]]:
    """Return blocks of members that can be stepped together, and other member -> reason.

    Cases in a block differ only in data, initial state and descriptions; samples have the same
    times and channels.
    """
    groups: dict[tuple[Any, ...], dict[str, Prepared]] = {}
    settings: dict[Case, str] = {}
    apart: dict[str, str] = {}
    for name, one in members.items():
        if not isinstance(one.stream, DataTable):
            apart[name] = "their samples come one at a time"
            continue
        if why := _refuses(one):
            apart[name] = why
            continue
        # Members often share one case: its settings are only serialised once.
        if one.case not in settings:
            unread = {"channels": {"__all__": READ}}
            settings[one.case] = one.case.spec.model_dump_json(
                exclude={**dict.fromkeys(TOLD, True), **unread}
            )
        # Late channels and noise columns change the order of channels in a table.
        table = one.stream
        key = settings[one.case], one.assimilate_from, one.t0, table.t.tobytes(), table.names
        groups.setdefault(key, {})[name] = one
    found = []
    for group in groups.values():
        block = MemberBlock(group) if len(group) > 1 else None
        if block is not None and block.fleet.together:
            found.append(block)
        else:
            apart |= dict.fromkeys(group, ALONE if block is None else block.fleet.note)
    return found, apart


def _refuses(one: Prepared) -> str:
    """Return the reason why a member cannot join a block, or ''; its own run reports errors."""
    try:
        _ = one.u0
    except LivepdeError:
        return "they cannot begin with their first sample"
    values = by_name(one.first.z, ())
    known = (np.isfinite(values.get(name, np.nan)) for name in one.case.model.channels)
    return "" if all(known) else "an input has no value in their first sample"


class MemberBlock:
    """Members with one model and the same sample times, which are stepped together."""

    def __init__(self, members: Mapping[str, Prepared]) -> None:
        self.members = dict(members)
        self._each = list(self.members.values())
        self._tables = [one.stream for one in self._each if isinstance(one.stream, DataTable)]
        one, case = self._each[0], self._each[0].case
        uncertain = [member.uncertain(case.law) for member in self._each]
        self.fleet = Fleet(
            case.model,
            case.observation,
            case.law,
            list(self.members),
            u0=[member.u0 for member in self._each],
            t0=one.t0,
            validation=case.validation,
            scheme=case.scheme,
            dt_max=case.dt_max,
            assimilate_from=one.assimilate_from,
            between=between_of(case),
            input_noise=uncertain[0].get("input_noise"),
            u0_from=[own.get("u0_from", {}) for own in uncertain],
            u0_errors=[own.get("u0_errors", ()) for own in uncertain],
        )
        self.status = "finished"
        self.error: DataError | None = None
        self._paths: list[Path] = []
        self._kept = FleetRecords(case.model, case.spec.output.fields_every)
        self._events: list[list[Event]] = [[] for _ in self._each]
        self._taken = self._written = 0  # numbers of samples

    def run(self, paths: Sequence[Path]) -> None:
        """Step through all samples, writing journals at intervals; `ended` completes them."""
        self._paths = list(paths)
        table, stopping = self._tables[0], threading.Event()
        with stopped_by_signals(stopping, lambda: True):
            for t in table.t.tolist():
                if stopping.is_set():
                    self.status = "interrupted"
                    break
                try:
                    self._step(t)
                except DataError as error:
                    self.status, self.error = "failed", error
                    break
                if self._kept.size > WAITING:
                    for k in range(len(self._each)):
                        identifier = self.fleet.identifier(k)
                        with self._journal(k, identifier) as journal:
                            self._write(k, journal, identifier)
                    self._kept.clear()
                    self._written = self._taken

    def _step(self, t: float) -> None:
        rows = np.array([table.values[self._taken] for table in self._tables])
        estimate = self.fleet.step(t, dict(zip(self._tables[0].names, rows.T, strict=True)))
        self._kept.add(estimate)
        self._taken += 1
        for k in np.flatnonzero(~estimate.ok).tolist():
            status = estimate.statuses[k]
            self._events[k].append(Event(float(self.fleet.t[k]), status.code, "", str(status)))

    def _journal(self, k: int, identifier: Identifier) -> Journal:
        """Open the journal of a member; keeping all journals open would exceed the file limit."""
        path, one = self._paths[k], self._each[k]
        if self._written:
            return Journal.open(path, write=True)
        who = identifier
        layout = layout_of(who.model, who.observed, who.validation, one.case.ignored)
        journal = Journal.create(path, who.channels, one.described(layout))
        for (kind, channel), number in self._tables[k].remarks.items():
            journal.count(kind, channel, number)
        return journal

    def _write(self, k: int, journal: Journal, identifier: Identifier) -> None:
        """Add pending samples, estimates and events to the journal of a member."""
        # Another process may have extended the journal between two writes.
        if journal.accepted != self._written:
            raise RunError(f"{journal.path.parent} is being written by another process: stop it.")
        table = self._tables[k]
        names, rows = journal.channels, table.values[self._written : self._taken]
        if not set(journal.noise).isdisjoint(table.names):
            names += journal.noise
        absent = np.full((len(rows), 1), np.nan)
        # Column -1 is an appended column of NaN, for channels that are not in this table.
        places = [table.names.index(name) if name in table.names else -1 for name in names]
        rows = np.hstack([rows, absent])[:, places]
        for event in self._events[k]:
            journal.note(event)
        self._events[k].clear()
        journal.extend(zip(rows, self._kept.records(k), strict=True), identifier.dump())

    @contextmanager
    def ended(self, k: int) -> Iterator[tuple[Identifier, Driven]]:
        """Complete the journal of a member, and yield its identifier and run while it is open."""
        fleet, identifier = self.fleet, self.fleet.identifier(k)
        with self._journal(k, identifier) as journal:
            self._write(k, journal, identifier)
            result = Result(
                fleet.model,
                fleet.observed,
                fleet.validation,
                self._kept.fields_every,
                journal,
                layout=journal.layout,
                count=journal.estimated,
            )
            if self._taken:
                result.last = identifier.estimate()
                result._settle(identifier._settled(result.last))
                journal.keep(result._snapshot(result.last))
            yield identifier, Driven(result, journal, self.status, self.error)
