"""Followed files that are rotated, truncated, copied, rewritten, or end in NUL bytes."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from pathlib import Path

import pytest
from live_rod import OPENED, live, rows

from livepde.errors import DataError
from livepde.streams import growing_file
from livepde.streams.clock import Clock
from livepde.streams.csvfile import read_csv
from livepde.streams.sources import Follow, Row
from livepde.streams.table import Column

HEADER = "t,a\n"


def lines(first: int, stop: int) -> str:
    """Return rows whose value is known from their time."""
    return "".join(f"{t},{7 * t}.5\n" for t in range(first, stop))


def taken(source: Follow, wait: float = 0.3) -> list[Row]:
    """Return all rows that come until none has come for a while."""
    found: list[Row] = []
    while new := source.poll(wait):
        found += new
    return found


def times(found: Iterable[Row]) -> list[int]:
    """Return the times of rows, whose values must be theirs."""
    right = [row for row in found if not row.broken]
    for row in right:
        assert float(row.values["a"]) == 7 * int(row.values["t"]) + 0.5
    return [int(row.values["t"]) for row in right]


def kinds(found: Iterable[Row]) -> list[str]:
    return [row.kind for row in found if row.broken]


def distinct(found: Sequence[int]) -> list[int]:
    """Return times without those that come again, which the intake knows."""
    return list(dict.fromkeys(found))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.csv"


@pytest.mark.slow
def test_a_file_that_is_emptied_and_refilled_beyond_its_length(path: Path) -> None:
    path.write_text(HEADER + lines(0, 100))
    with closing(Follow(path, follow=True)) as source:
        assert times(taken(source)) == [*range(100)]
        path.write_text(HEADER + lines(100, 300))
        found = taken(source)
    assert times(found) == [*range(100, 300)]
    assert kinds(found) == ["rewritten"]
    assert "are lost" in found[0].broken


@pytest.mark.slow
def test_a_window_that_is_written_in_place_moves_on(path: Path) -> None:
    """Without an end of the file between: rows of before follow those of now."""
    path.write_text(HEADER + lines(100, 200))
    found: list[Row] = []
    with closing(Follow(path, follow=True)) as source:
        found += taken(source)
        for first in range(110, 400, 10):
            with path.open("r+") as file:
                file.write(HEADER + lines(first, first + 50))
                file.flush()
                found += source.poll(0.0)  # half of it is old
                file.write(lines(first + 50, first + 100))
            found += taken(source, 0.1)
    assert distinct(times(found)) == [*range(100, 490)]
    assert not kinds(found)


def test_a_window_that_moves_on_twice_before_it_is_read_is_reported(path: Path) -> None:
    path.write_text(HEADER + lines(100, 200))
    with closing(Follow(path, follow=True)) as source:
        found = taken(source, 0.1)
        path.write_text(HEADER + lines(150, 250))  # its first rows are those that were read
        assert not source.poll(0.0)
        path.write_text(HEADER + lines(300, 400))
        found += taken(source, 0.3)
    assert distinct(times(found)) == [*range(100, 200), *range(300, 400)]
    assert kinds(found) == ["rewritten"]


@pytest.mark.slow
def test_a_window_that_is_written_all_the_time(path: Path) -> None:
    path.write_text(HEADER + lines(100, 200))
    over = threading.Event()

    def write() -> None:
        first = 100
        while not over.is_set() and first < 800:
            first += 1
            path.write_text(HEADER + lines(first, first + 100))
            time.sleep(0.004)

    writer = threading.Thread(target=write)
    writer.start()
    found: list[Row] = []
    try:
        with closing(Follow(path, follow=True)) as source:
            while writer.is_alive():
                found += source.poll(0.05)
            found += taken(source)
    finally:
        over.set()
        writer.join()
    assert distinct(times(found))[-1] == 899
    # A window that went by while it changed all the time is reported.
    assert len(set(times(found))) == 800 or "rewritten" in kinds(found)


def rotated(path: Path, content: str) -> None:
    """Rotate a file as logrotate does, and write a new one."""
    for number in (2, 1):
        older = path.with_name(f"{path.name}.{number}")
        if older.exists():
            older.rename(path.with_name(f"{path.name}.{number + 1}"))
    path.rename(path.with_name(f"{path.name}.1"))
    path.write_text(HEADER + content)


def copied(path: Path, content: str) -> None:
    """Copy a file and empty it, as logrotate does with copytruncate."""
    for number in (2, 1):
        older = path.with_name(f"{path.name}.{number}")
        if older.exists():
            older.rename(path.with_name(f"{path.name}.{number + 1}"))
    shutil.copyfile(path, path.with_name(f"{path.name}.1"))
    path.write_text(HEADER + content)


@pytest.mark.slow
@pytest.mark.parametrize("away", [False, True])
@pytest.mark.parametrize("often", [1, 2, 3])
@pytest.mark.parametrize("rotate", [rotated, copied])
def test_rotations_between_two_looks_lose_nothing(
    path: Path, rotate: Callable[[Path, str], None], often: int, away: bool
) -> None:
    (path.parent / "log2.csv").write_text(HEADER + lines(5000, 5010))
    path.write_text(HEADER + lines(0, 1000))
    source = Follow(path, follow=True)
    found = [*source.poll(0.0), *source.poll(0.0)]
    assert len(found) == 200
    if not away:
        found += taken(source)
    with path.open("a") as file:
        file.write(lines(1000, 1010))
    for k in range(often):
        rotate(path, lines(1010 + 10 * k, 1020 + 10 * k))
    if away:
        position = source.position([found[150].token])
        source.close()
        source = Follow(path, follow=True, position=position)
    found += taken(source)
    source.close()
    assert distinct(times(found)) == [*range(1010 + 10 * often)]
    assert not kinds(found)
    assert times(found).count(150) == (2 if away else 1)


@pytest.mark.slow
def test_what_is_gone_while_the_reader_was_away_is_reported(path: Path) -> None:
    path.write_text(HEADER + lines(0, 10))
    source = Follow(path, follow=True)
    assert times(taken(source)) == [*range(10)]
    position = source.position([])
    source.close()
    path.unlink()
    path.write_text(HEADER + lines(20, 30))
    with closing(Follow(path, follow=True, position=position)) as source:
        found = taken(source)
    assert kinds(found) == ["rewritten"]
    assert "replaced by another file" in found[0].broken
    assert times(found) == [*range(20, 30)]


@pytest.mark.slow
def test_a_writer_that_keeps_a_renamed_file_open(path: Path) -> None:
    path.write_text(HEADER + lines(0, 10))
    with closing(Follow(path, follow=True)) as source, path.open("a") as writer:
        found = taken(source)
        path.rename(path.with_name("log.csv.1"))
        path.write_text(HEADER)
        found += taken(source)
        writer.write(lines(10, 20))
        writer.flush()
        found += taken(source)
        with path.open("a") as new:
            new.write(lines(20, 30))
        found += taken(source)
    assert times(found) == [*range(30)]


@pytest.mark.slow
def test_nul_bytes_wait_for_what_replaces_them(path: Path, monkeypatch) -> None:
    text = (HEADER + lines(0, 100)).encode()
    cut = len(HEADER + lines(0, 40)) + 3
    path.write_bytes(text[:cut] + b"\0" * (len(text) - cut - 20) + text[-20:])
    with closing(Follow(path, follow=True)) as source:
        found = taken(source)
        assert times(found) == [*range(40)]
        with path.open("r+b") as file:
            file.write(text[: cut + 100])
        found += taken(source)
        path_length = path.stat().st_size
        with path.open("r+b") as file:
            file.write(text)
        assert path.stat().st_size == path_length
        found += taken(source)
        assert times(found) == [*range(100)]
        assert not kinds(found)
        # A hole that nothing will fill is one row, and those after it are read.
        with path.open("ab") as file:
            file.write(b"10\0\0\0\0\n" + lines(100, 110).encode())
        assert not taken(source)
        monkeypatch.setattr(growing_file, "HOLES", 0.0)
        found = taken(source)
    assert [row.broken for row in found if row.broken] == ["NUL bytes instead of a row"]
    assert times(found) == [*range(100, 110)]


@pytest.mark.slow
def test_a_header_that_appears_again_holds_from_there_on(path: Path) -> None:
    path.write_text("t,a,b\n0,1,2\nt,a,b\n1,1,2\nt,b,a\n2,2,1\n")
    expected = [{"t": str(k), "a": "1", "b": "2"} for k in range(4)]
    source = Follow(path, follow=True)
    found = taken(source)
    tokens = [row.token for row in found]
    assert kinds(found) == ["header"]
    assert "t, b, a" in found[2].broken
    places = [source.position([]), source.position(tokens[1:]), source.position(tokens[3:])]
    source.close()
    with path.open("a") as file:
        file.write("3,2,1\n")
    assert [row.values for row in found if not row.broken] == expected[:3]
    for place, first in zip(places, (3, 1, 2), strict=True):
        with closing(Follow(path, follow=True, position=place)) as source:
            again = [row for row in taken(source) if not row.broken]
        assert [row.values for row in again] == expected[first:]


def test_titles_units_comments_and_days_beside_hours_while_a_file_grows(path: Path) -> None:
    text = (
        "Logger 7\nof the cellar\nday,hour,a\nd.m.y,h:m,degC\n# begun\n"
        "1.2.2025,10:00,1\n# a stop\n1.2.2025,10:10,2\n"
    )
    source = Follow(path, follow=True, skip=2, times=("day", "hour"))
    found: list[Row] = []
    for k in range(0, len(text), 5):
        with path.open("a") as file:
            file.write(text[k : k + 5])
        found += source.poll(0.0)
        position = source.position([])
        source.close()
        source = Follow(path, follow=True, skip=2, times=("day", "hour"), position=position)
    found += source.poll(0.0)
    source.close()
    assert [(row.values["day"], row.values["a"]) for row in found] == [
        ("1.2.2025 10:00", "1"),
        ("1.2.2025 10:10", "2"),
    ]


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("name", ["/dev/zero", "pipe", "."])
def test_what_is_no_file_is_refused_in_a_sentence(tmp_path: Path, name: str, follow: bool) -> None:
    place = tmp_path / name
    if name == "pipe":
        os.mkfifo(place)
    said = pytest.raises(DataError, match=r"is a device, a pipe or a folder, not a file: name")
    with closing(Follow(place, follow=follow)) as source, said:
        source.poll(0.0)


def test_a_device_is_no_table() -> None:
    with pytest.raises(DataError, match="/dev/zero is a device, not a file"):
        read_csv("/dev/zero", {"a": Column(("a",))}, Clock("t"))


@pytest.mark.slow
def test_a_run_counts_what_it_cannot_know(tmp_path: Path) -> None:
    data = tmp_path / "data.csv"
    given = [",".join(map(repr, row.values())) for row in rows(40)]
    data.write_text("\n".join(["t,a,b,left", *given[:20]]) + "\n")
    source = Follow(data, follow=True)
    run = live(tmp_path, source)
    empty, poll = [0], source.poll

    def polled(wait: float) -> Sequence[Row]:
        found = poll(min(wait, 0.2))
        if not found and wait > 0.0:
            empty[0] += 1
            if empty[0] == 1:
                data.write_text("\n".join(["t,a,b,left", *given[25:]]) + "\n")
            elif len(run.journal) == 35:
                run.stopping.set()
        return found

    source.poll = polled  # type: ignore[method-assign]
    run.run()
    assert len(run.journal) == 35
    assert run.journal.counts == {("rewritten", ""): 1}
    (event,) = [one for one in run.journal.events if one.kind == "rewritten"]
    assert "are lost" in event.message
    assert run.health["ok"]
    while OPENED:
        OPENED.pop().close()
