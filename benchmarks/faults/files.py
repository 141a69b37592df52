"""Followed files that are rotated, copied, truncated, rewritten, or end in NUL bytes."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

from benchmarks.faults.plan import Plan
from benchmarks.faults.rod import STEP, Row, case_text, rod_rows
from livepde.cases import load
from livepde.cases.live_case import LiveCase
from livepde.runs import Check, Outcome, Table
from livepde.streams.sources import Follow

COUNT, PART, WINDOW = 300, 60, 100  # rows of a file, of one write, and of a window
PATIENCE = 60.0  # time limit for a run to read its file, in seconds

Change: TypeAlias = Callable[[Path, str, Sequence[str]], Iterator[None]]
"""Writes header and rows to a file in several parts, and yields after each part."""


def _grows(path: Path, header: str, rows: Sequence[str]) -> Iterator[None]:
    path.write_text(header)
    for part in _parts(rows):
        with path.open("a") as file:
            file.write(part)
        yield


def _parts(rows: Sequence[str]) -> Iterator[str]:
    for k in range(0, len(rows), PART):
        yield "".join(rows[k : k + PART])


def _kept_back(path: Path, move: Callable[[Path, Path], object]) -> None:
    """Rotate a file: rows.csv.1 becomes rows.csv.2, and rows.csv becomes rows.csv.1."""
    older = sorted(path.parent.glob(f"{path.name}.*"), reverse=True)
    for backup in older:
        number = int(backup.suffix[1:]) + 1
        backup.rename(path.with_name(f"{path.name}.{number}"))
    move(path, path.with_name(f"{path.name}.1"))


def _rotated(times: int, move: Callable[[Path, Path], object]) -> Change:
    """Return a change that rotates the file several times between two polls."""

    def change(path: Path, header: str, rows: Sequence[str]) -> Iterator[None]:
        first, *parts = _parts(rows)
        path.write_text(header + first)
        yield  # a run starts with the file that exists at its start
        for part in parts:
            lines = part.splitlines(keepends=True)
            size = -(-len(lines) // (times + 1))
            for k in range(0, len(lines), size):
                with path.open("a") as file:
                    file.write("".join(lines[k : k + size]))
                if k + size < len(lines):
                    _kept_back(path, move)
                    path.write_text(header)
            yield

    return change


def _emptied(path: Path, header: str, rows: Sequence[str]) -> Iterator[None]:
    """Overwrite the file with parts that are each longer than the part before."""
    at, size = 0, PART // 2
    while at < len(rows):
        path.write_text(header + "".join(rows[at : at + size]))
        at, size = at + size, size + 10
        yield


def _window(path: Path, header: str, rows: Sequence[str]) -> Iterator[None]:
    """Rewrite a moving window of rows in place, in two halves."""
    for stop in range(WINDOW, len(rows) + 1, 20):
        part = rows[stop - WINDOW : stop]
        with path.open("r+" if path.exists() else "w") as file:
            file.write(header + "".join(part[: WINDOW // 2]))
            file.flush()
            file.write("".join(part[WINDOW // 2 :]))
            file.truncate()
        yield


def _nulls(path: Path, header: str, rows: Sequence[str]) -> Iterator[None]:
    """Reserve the space of each part with NUL bytes before writing its rows."""
    written = header.encode()
    path.write_bytes(written)
    for part in _parts(rows):
        with path.open("ab") as file:
            file.write(bytes(len(part)))
        yield
        with path.open("r+b") as file:
            file.seek(len(written))
            file.write(part.encode())
        written += part.encode()
        yield


def _exchanged(path: Path, header: str, rows: Sequence[str]) -> Iterator[None]:
    """Repeat the header before each part; every second time, swap two columns and their values."""
    path.write_text(header)
    for number, part in enumerate(_parts(rows)):
        lines = [header, *part.splitlines(keepends=True)]
        if number % 2:
            cells = [line.rstrip("\n").split(",") for line in lines]
            lines = [",".join([*row[:-2], row[-1], row[-2]]) + "\n" for row in cells]
        with path.open("a") as file:
            file.write("".join(lines))
        yield


CHANGES: Mapping[str, Change] = {
    "none": _grows,
    "rotated": _rotated(1, shutil.move),
    "rotated twice between two looks": _rotated(2, shutil.move),
    "copied and emptied": _rotated(1, shutil.copyfile),
    "copied and emptied twice between two looks": _rotated(2, shutil.copyfile),
    "emptied and refilled beyond its length": _emptied,
    "a window written again in place": _window,
    "NUL bytes before the rows": _nulls,
    "the header again, two columns exchanged": _exchanged,
}
CHANNELS = ("left", "T_3", "T_6")
KNOWN_LOSS = {"emptied and refilled beyond its length": "rewritten"}  # lost rows, but counted


def file_faults(plan: Plan) -> Outcome:
    """Change files while runs follow them, and compare samples and values with the written rows."""
    rows, table, lost, wrong, silent = rod_rows(COUNT), [], 0, 0, 0
    faults = [*CHANGES.items()]
    for number in plan.watched(len(faults), "files"):
        fault, change = faults[number]
        missing, other, counts = _followed(change, rows)
        lost, wrong = lost + missing, wrong + other
        silent += fault in KNOWN_LOSS and KNOWN_LOSS[fault] not in counts
        counted = ", ".join(f"{kind} {number}" for kind, number in sorted(counts.items()))
        table.append((fault, missing, other, counted or "–"))
    head = ("fault", "right rows lost", "wrong values", "told")
    return Outcome(
        tables=[Table(f"Followed files of {COUNT} rows", head, table)],
        checks=[
            Check("files: right rows lost", lost, 0, "<="),
            Check("files: wrong values or times", wrong, 0, "<="),
            Check("files: what cannot be known, and is not counted", silent, 0, "<="),
        ],
    )


class _Watched(Follow):
    """Followed file that sets `idle` when a run waits for new rows."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, follow=True)
        self.idle = threading.Event()

    def poll(self, wait: float) -> Sequence[Any]:
        """Return the available rows."""
        rows = super().poll(wait)
        # A run waits once it has processed all rows.
        if not rows and wait > 0.0:
            self.idle.set()
        return rows


def _followed(change: Change, rows: Sequence[Row]) -> tuple[int, int, Mapping[str, int]]:
    """Return the number of missing rows, the number of wrong samples, and the counts of a run."""
    header = ",".join(rows[0]) + "\n"
    lines = [",".join(map(str, row.values())) + "\n" for row in rows]
    with TemporaryDirectory() as name:
        path, case = Path(name) / "rows.csv", Path(name) / "case.toml"
        case.write_text(case_text('file = "rows.csv"\nfollow = true'))
        source, stopping = _Watched(path), threading.Event()

        def write() -> None:
            for _ in change(path, header, lines):
                source.idle.clear()
                if not source.idle.wait(PATIENCE):
                    break
            stopping.set()

        writer = threading.Thread(target=write)
        writer.start()
        with LiveCase(load(case), source) as wiring:
            live = wiring.live(stopping=stopping)
            if live is None:
                raise RuntimeError("the run did not begin")
            live.run()
            taken = {round(each.t / STEP): dict(each.values) for each in live.journal.taken()}
            counts = {kind: number for (kind, _), number in live.journal.counts.items()}
        writer.join()
    right = {k: {name: row[name] for name in CHANNELS} for k, row in enumerate(rows)}
    wrong = sum(values != right.get(k) for k, values in taken.items())
    return len(right.keys() - taken.keys()), wrong, counts
