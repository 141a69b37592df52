"""The run directory: outcome of a run, and writer and reader of its files.

::

    RUN/run.json          version, command, status, checks, hash of the case
    RUN/case.toml         a copy of the case
    RUN/journal.sqlite    samples and estimates, written during the run; survives a kill
    RUN/estimates.nc      the dataset (netCDF 3: any netCDF reader opens it)
    RUN/checkpoint.bin    the identifier's state
    RUN/report.md         tables
    RUN/*.png             figures
"""

from __future__ import annotations

import difflib
import hashlib
import io
import json
import math
import os
import re
import tomllib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from livepde.atomic_write import PARTIAL, replacing, write_bytes
from livepde.dates import with_epoch, without_epoch
from livepde.diagnostics.check_report import Check, Table
from livepde.errors import RunError
from livepde.identifier import Identifier
from livepde.plots.style import png
from livepde.runs.database import DAMAGE
from livepde.runs.journal import Journal
from livepde.runs.run_verdict import verdict, verdict_table
from livepde.runs.summary import arrivals, tables

if TYPE_CHECKING:
    import xarray as xr

T = TypeVar("T")

FigureFactory: TypeAlias = Callable[[], Any]
"""Function that returns a matplotlib Figure; called only when the figure is needed."""
FORMAT = 2
RUNS = "runs"  # folder in which the command line creates run directories
RECORD, CASE, ESTIMATES = "run.json", "case.toml", "estimates.nc"
CHECKPOINT, REPORT = "checkpoint.bin", "report.md"
JOURNAL = "journal.sqlite"
LONGEST = 10_000_000  # largest size of a record in bytes
# Keys of the digests of the record itself, of the copy of the case and of the estimates. While the
# estimates are replaced, the record has the digests of both files: after a kill, one of them fits.
OWN, COPY, CONTENT = "sha256", "case_copy_sha256", "estimates_sha256"
MARKUP = re.compile("<(?=[A-Za-z/!?])")  # start of HTML markup, escaped in reports
WRITTEN_LATER = (".md", ".png")  # files that a reader of another user's run may write


@dataclass(frozen=True, eq=False)
class Outcome:
    """Tables, checks, notes, dataset and figures of an experiment.

    Attributes
    ----------
    tables, checks, notes
        Printed parts, in this order.
    dataset
        Dataset of the run, see `Result.to_xarray`.
    figures
        File name without suffix -> function that draws a matplotlib figure.
    """

    tables: Sequence[Table] = ()
    checks: Sequence[Check] = ()
    notes: Sequence[str] = ()
    dataset: xr.Dataset | None = None
    figures: Mapping[str, FigureFactory] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """True if all checks pass."""
        return all(check.ok for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object: checks, tables, notes."""
        return {
            "checks": [check.to_dict() for check in self.checks],
            "tables": [table.to_dict() for table in self.tables],
            "notes": list(self.notes),
        }


def attempted(what: str, compute: Callable[[], T], otherwise: T, notes: list[str]) -> T:
    """Return the value of a computation; if it fails, return `otherwise` and add a note.

    A run keeps its data even if one of its diagnostics fails. `OSError` is raised, and so is its
    subclass `RunError`, for a directory that cannot be written.
    """
    try:
        return compute()
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001  the note reports it
        reason = str(error).split("\n", 1)[0].rstrip(".") or "no reason given"
        notes.append(
            f"{what} failed ({type(error).__name__}: {reason[:200]}); everything else is complete."
        )
        return otherwise


def free_path(wanted: Path) -> Path:
    """Return the wanted path, with a number appended if that path exists."""
    path, number = wanted, 2
    while path.exists():
        path = wanted.with_name(f"{wanted.name}-{number}")
        number += 1
    return path


def refuse_taken(path: Path) -> None:
    """Raise `RunError` unless the path is free or an empty folder."""
    if not path.exists():
        return
    if not path.is_dir():
        raise RunError(f"{path} is a file. Specify a folder for the run. Nothing was written.")
    if any(path.iterdir()):
        what = "already contains a run" if (path / RECORD).exists() else "is not empty"
        raise RunError(f"{path} {what}. Choose another folder. Nothing was written.")


def _only_begun(path: Path, case: str) -> bool:
    """Return whether a kill or a full disk interrupted the creation of this run directory."""
    names = {item.name for item in path.iterdir()} if path.is_dir() else set()
    names = {name for name in names if not name.endswith(PARTIAL)}
    if names != {CASE}:
        return False
    return case.encode().startswith((path / CASE).read_bytes())


def _nearest(folder: Path) -> str:
    """Return a hint at the nearest run directory: below the folder, next to it, or in runs/."""
    if folder.is_file():  # a case, or a file in a run directory
        folder = folder.parent
    near = difflib.get_close_matches(folder.name, run_names(folder.parent), n=1)
    likely = [folder.parent / name for name in near]
    for place in (folder, folder / RUNS, folder.parent / RUNS):
        known = run_names(place)
        named = [name for name in known if name == folder.name] or known[-1:]
        likely += [place / name for name in named]
    return f"did you mean '{likely[0]}'?" if likely else "'livepde run CASE' creates one in runs/."


def run_names(folder: Path) -> list[str]:
    """Return the names of the run directories in a folder."""
    return sorted(item.parent.name for item in folder.glob(f"*/{RECORD}"))


@contextmanager
def _room_to_write(folder: Path) -> Iterator[None]:
    """Convert an `OSError` from writing into a folder to a `RunError` with the remedy."""
    try:
        yield
    except RunError:
        raise
    except OSError as error:
        why = f"{error.strerror or error}; free disk space or check the folder."
        raise RunError(f"{folder} cannot be written: {why}") from error


@dataclass(eq=False, repr=False)
class RunWriter:
    """Writer of a run directory: a new or empty folder, or the folder of a run to resume."""

    path: Path
    record: dict[str, Any]

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        version: str,
        command: Sequence[str],
        title: str,
        case: str | None = None,
        settings: Sequence[str] = (),
        original: str | None = None,
    ) -> RunWriter:
        """Create the directory with its record and a copy of the case.

        Parameters
        ----------
        path, version, command, title
            The directory, and the entries of its record.
        case
            Text of the case, which is copied.
        settings
            Overrides of keys of the case, 'key=value'.
        original
            Content of the case file, if it differs from `case`.

        Raises
        ------
        RunError
            The directory exists and is not empty, or cannot be created.
        """
        try:
            if not _only_begun(path, case or ""):
                refuse_taken(path)
            path.mkdir(parents=True, exist_ok=True)
            record = {
                "format": FORMAT,
                "livepde": version,
                "title": title,
                "command": _without_token(command),
                "started": _now(),
                "status": "running",
            }
            if case is not None:
                record |= _written_case(path, case, original or case)
            if settings:
                record["settings"] = list(settings)
            # The record is written last: a folder without a record is incomplete.
            writer = cls(path, record)
            writer._save_record()
        except RunError:
            raise
        except OSError as error:
            raise RunError(f"{path}: cannot be created: {error.strerror or error}.") from error
        return writer

    @classmethod
    def reopen(
        cls,
        path: Path,
        *,
        version: str,
        command: Sequence[str],
        case: str,
        settings: Sequence[str],
        original: str | None = None,
    ) -> RunWriter:
        """Return the writer of a run that ended early, to resume it.

        The case may have a different `intake.shift`, which then replaces the stored value.

        Raises `RunError`: there is no such run, or its case, settings or data differ.
        """
        run = open_run(path)
        for item in path.iterdir():
            if item.is_symlink():
                raise RunError(f"{item} is a link: a run is resumed in regular files only.")
        run.refuse_other(command, case, settings)
        for left in filter(Path.is_file, path.glob(f"*{PARTIAL}")):  # of a killed process
            left.unlink(missing_ok=True)
        begun = {"at": _now(), "livepde": version}
        changed: dict[str, Any] = {}
        kept = (path / CASE).read_text(encoding="utf-8", errors="replace")
        if kept != case or run.settings != list(settings):
            begun["intake.shift"] = str(_parts(case)[1])
            changed = {**_written_case(path, case, original or case), "settings": list(settings)}
        resumed = [*run.record.get("resumed", []), begun]
        record = run.record | changed | {"status": "running", "resumed": resumed}
        writer = cls(path, {"command": _without_token(command)} | record)
        writer._save_record()
        return writer

    def finish(
        self,
        *,
        status: str,
        dataset: xr.Dataset | None = None,
        identifier: Identifier | None = None,
        shown: Iterable[Table] = (),
        checks: Iterable[Check] = (),
        notes: Iterable[str] = (),
        figures: Mapping[str, FigureFactory] | None = None,
    ) -> None:
        """Write the results of a run: dataset, checkpoint, report and record, then figures."""
        shown, checks, notes = list(shown), list(checks), list(notes)
        title = str(self.record["title"])
        with _room_to_write(self.path):
            if dataset is not None:
                self._write_estimates(dataset)
                self.record["samples"] = int(dataset.sizes.get("time", 0))
            if identifier is not None:
                identifier.save(self.path / CHECKPOINT)
            self.record |= {"status": status, "ended": _now()}
            self._report(markdown(title, shown, checks, notes), checks, notes)
            drawn = drawn_into(self.path, figures or {}, notes)
            if figures:
                self._report(markdown(title, shown, checks, notes, drawn), checks, notes)

    def _write_estimates(self, dataset: xr.Dataset) -> None:
        """Write the dataset, with its digest in the record before the old file is replaced."""
        with replacing(self.path / ESTIMATES) as partial:
            _to_netcdf(with_epoch(dataset), partial)
            new = hashlib.sha256(partial.read_bytes()).hexdigest()
            self.record[CONTENT] = [*self.record.get(CONTENT, []), new]
            self._save_record()
        self.record[CONTENT] = [new]

    def _report(self, text: str, checks: Sequence[Check], notes: Sequence[str]) -> None:
        write_text(self.path / REPORT, text)
        self.record |= {"checks": [check.to_dict() for check in checks], "notes": list(notes)}
        self._save_record()

    def _save_record(self) -> None:
        record = plain(self.record)
        text = json.dumps(record | {OWN: _digest(record)}, indent=2, ensure_ascii=False)
        with _room_to_write(self.path):
            write_text(self.path / RECORD, text + "\n")


@dataclass(eq=False, repr=False)
class Run:
    """Reader of a run directory; `livepde.runs.open(path)` returns one."""

    path: Path
    record: dict[str, Any]

    @property
    def status(self) -> str:
        """Status of the run: running, finished, interrupted or failed."""
        return str(self.record.get("status", ""))

    @property
    def title(self) -> str:
        """Title of the case."""
        return str(self.record.get("title", self.path.name))

    @property
    def notes(self) -> list[str]:
        """Notes of the run: warnings and remarks in addition to its numbers."""
        return [str(note) for note in self.record.get("notes", [])]

    @property
    def checks(self) -> list[Check]:
        """Checks of the run, evaluated when it ended."""
        found = []
        try:
            for item in self.record.get("checks", []):
                value = math.nan if item["value"] is None else float(item["value"])
                bound = tuple(item["bound"]) if isinstance(item["bound"], list) else item["bound"]
                found.append(Check(item["name"], value, bound, item["sense"]))
        except (LookupError, TypeError, ValueError):
            raise RunError(f"{self.path / RECORD} is damaged: its checks are not valid.") from None
        return found

    @cached_property
    def dataset(self) -> xr.Dataset:
        """Estimates over time, see `Result.to_xarray`."""
        path = self.path / ESTIMATES
        journal = self.path / JOURNAL
        if journal.is_file() and (self.status == "running" or not path.is_file()):
            with Journal.open(journal) as kept:
                return kept.dataset()
        if not path.is_file():
            notes = "".join(f" {note}" for note in self.notes)
            raise RunError(
                f"{self.path} contains no estimates; its status is '{self.status}'.{notes}"
            )
        import xarray as xr

        try:
            content = path.read_bytes()
            if hashlib.sha256(content).hexdigest() not in self.record.get(CONTENT, []):
                raise ValueError("its content has changed since it was written")
            # Files of `write_dataset` decode without warnings: a warning indicates changed bytes.
            with warnings.catch_warnings(action="error", category=xr.SerializationWarning):
                raw = io.BytesIO(content)
                return without_epoch(xr.load_dataset(raw, engine="scipy", decode_times=False))
        except (OSError, *DAMAGE, xr.SerializationWarning) as error:
            remedy = "run the case again, into another folder"
            if journal.is_file():
                remedy = "delete it, so that they are read from the journal"
            raise RunError(f"{path} is damaged: {error}; {remedy}.") from error

    @contextmanager
    def reading(self) -> Iterator[Journal | None]:
        """Open the journal of the run for reading; None if it has none."""
        if not (self.path / JOURNAL).is_file():
            yield None
            return
        with Journal.open(self.path / JOURNAL) as journal:
            yield journal

    def case_file(self) -> Path:
        """Return the case file to run again: the original if it is unchanged, else the copy.

        Data files are named relative to the case. If the original is missing or has changed, the
        copy in the run directory is used, and the user has to specify the data.

        Raises `RunError`: the run has no case (a reproduction), or the copy of the case is changed.
        """
        copy = self.path / CASE
        if not copy.is_file():
            raise RunError(
                f"{self.path} was not made from a case file. Only runs of 'livepde run' can be "
                "processed again."
            )
        for word in self.record.get("command", [])[2:]:
            original = Path(str(word))
            if original.suffix == ".toml" and original.is_file():
                text = original.read_text(encoding="utf-8", errors="replace")
                if hashlib.sha256(text.encode()).hexdigest() == self.record.get("case_sha256"):
                    return original
        if hashlib.sha256(copy.read_bytes()).hexdigest() != self.record.get(COPY):
            raise RunError(
                f"{copy} is not the case that was run. Give the case file to 'livepde run' again."
            )
        return copy

    @property
    def settings(self) -> list[str]:
        """Overrides of keys of the case, each 'key=value'."""
        return [str(item) for item in self.record.get("settings", [])]

    @property
    def data_file(self) -> str | None:
        """Data file of the option --data; None for the data of the case or standard input."""
        return _data_of(self.record.get("command", []))

    def refuse_other(self, command: Sequence[str], case: str, settings: Sequence[str]) -> None:
        """Raise `RunError` unless the run can be resumed with a case, settings and data."""
        begun = (self.path / JOURNAL).is_file() or not (self.path / ESTIMATES).exists()
        if not (self.path / CASE).is_file() or not begun:
            raise RunError(f"{self.path} has no case and journal: it cannot be resumed.")
        kept = (self.path / CASE).read_text(encoding="utf-8", errors="replace")
        # The correction of a clock may change.
        begun_with, now = (
            [one for one in given if one.partition("=")[0].strip() != "intake.shift"]
            for given in (self.settings, settings)
        )
        same = kept == case or _parts(kept)[0] == _parts(case)[0]
        if not same or begun_with != now:
            raise RunError(
                f"{self.path} was run with another case or other settings. Resume it with these, "
                "or choose another folder."
            )
        self._refuse_other_data(command)

    def _refuse_other_data(self, command: Sequence[str]) -> None:
        files = self.data_file, _data_of(command)
        if files[0] != files[1]:
            before, other = (f"--data {d}" if d else "the data of its case" for d in files)
            raise RunError(
                f"{self.path} was run with {before}, not with {other}: resume it so, or choose "
                "another folder."
            )

    def arrivals(self) -> list[Table]:
        """Return the table of irregular rows of a run with a journal, if there are any."""
        with self.reading() as journal:
            return [] if journal is None else arrivals(journal)

    def summary(self) -> list[Table]:
        """Return tables of the verdict, the estimates, the errors of each channel, and others."""
        data = self.dataset
        judged = [verdict_table(verdict(data))] if data.sizes["time"] else []
        return [*judged, *tables(data)]


def open_run(path: str | os.PathLike[str]) -> Run:
    """Open a run directory.

    Raises `RunError`: there is no run, its record is damaged, or a report or figure is a link.
    """
    folder = Path(path)
    for page in folder.glob("*"):
        if page.suffix in WRITTEN_LATER and page.is_symlink():
            raise RunError(f"{page} is a link: data written to it would go elsewhere.")
    record = _stored_record(folder)
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise RunError(f"{folder / RECORD} is not a record of this version of livepde.")
    if record.pop(OWN, "") != _digest(record):
        raise RunError(
            f"{folder / RECORD} is damaged: its content has changed since it was written; "
            "restore it from a copy, or run the case again into another folder."
        )
    return Run(folder, record)


def _stored_record(folder: Path) -> Any:
    """Return the content of the record of a run."""
    try:
        with (folder / RECORD).open("rb") as file:
            text = file.read(LONGEST + 1)
        if len(text) > LONGEST:
            raise RunError(f"{folder / RECORD} is longer than {LONGEST} bytes.")
        return json.loads(text)
    except (FileNotFoundError, NotADirectoryError):
        why = f"no {RECORD}" if folder.is_dir() or not folder.exists() else "it is a file"
        raise RunError(f"{folder} contains no run ({why}); {_nearest(folder)}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise RunError(f"{folder / RECORD} is damaged: {error}.") from error


def drawn_into(folder: Path, figures: Mapping[str, FigureFactory], notes: list[str]) -> list[str]:
    """Draw figures into a folder and return their file names; add a note for each failure."""
    drawn = []
    for name, draw in figures.items():
        file = f"{name}.png"

        def saved(draw: FigureFactory = draw, file: str = file) -> bool:
            write_bytes(folder / file, png(draw()))
            return True

        if attempted(f"The figure '{name}'", saved, False, notes):
            drawn.append(file)
    return drawn


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; a link at the path is replaced."""
    write_bytes(path, text.encode())


def write_dataset(data: xr.Dataset, path: Path) -> None:
    """Write a dataset as netCDF 3, atomically."""
    with replacing(path) as partial:
        _to_netcdf(data, partial)


def _to_netcdf(data: xr.Dataset, path: Path) -> None:
    # netCDF 3 has no fixed dimension of size zero.
    empty = [name for name, size in data.sizes.items() if size == 0 and name != "time"]
    kept = data.drop_dims(empty)
    kept.attrs = {key: plain(value) for key, value in data.attrs.items()}
    whole = {name: {"_FillValue": None} for name in kept.dims if name in kept.coords}  # CF: no gaps
    kept.to_netcdf(path, engine="scipy", encoding=whole)


def _digest(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _written_case(path: Path, case: str, original: str) -> dict[str, str]:
    """Write the copy of the case; return its digest and the digest of the original."""
    write_text(path / CASE, case)
    texts = {"case_sha256": original, COPY: case}
    return {key: hashlib.sha256(text.encode()).hexdigest() for key, text in texts.items()}


def _parts(case: str) -> tuple[dict[str, Any], Any]:
    """Return the content of a case without the correction of its clock, and the correction."""
    try:
        document = tomllib.loads(case)
    except tomllib.TOMLDecodeError:
        return {"text": case}, 0.0
    intake = document.pop("intake", {})
    shift = intake.pop("shift", 0.0)
    return document | ({"intake": intake} if intake else {}), shift


def markdown(
    title: str,
    shown: Iterable[Table],
    checks: Iterable[Check] = (),
    notes: Iterable[str] = (),
    figures: Iterable[str] = (),
) -> str:
    """Return a report in Markdown."""
    parts = [f"# {title}", *(table.markdown() for table in shown)]
    rows = [
        (one.name, f"{one.value:.5g}", one.sense, one.bound_text, "ok" if one.ok else "FAILED")
        for one in checks
    ]
    if rows:
        parts.append(Table("Checks", ("number", "value", "", "bound", ""), rows).markdown())
    parts += [f"> {note}" for note in notes]
    parts += [f"![{name.removesuffix('.png')}]({name})" for name in figures]
    return MARKUP.sub("&lt;", "\n\n".join(parts)) + "\n"


def plain(value: Any) -> Any:
    """Return a value for JSON: NaN and infinity become None, NumPy scalars become numbers."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if hasattr(value, "item") and getattr(value, "ndim", 0) == 0:
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _without_token(command: Sequence[str]) -> list[str]:
    """Return a command with its token masked."""
    kept = [re.sub("^--token=.*", "--token=...", word) for word in command]
    for k, word in enumerate(kept[:-1]):
        if word == "--token":
            kept[k + 1] = "..."
    return kept


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _data_of(command: Sequence[Any]) -> str | None:
    """Return the file of the option --data in a command; None without one or for '-'."""
    words = [str(word) for word in command]
    for k, word in enumerate(words):
        if word.startswith("--data="):
            return word.removeprefix("--data=")
        if word == "--data" and k + 1 < len(words) and words[k + 1] != "-":
            return words[k + 1]
    return None
