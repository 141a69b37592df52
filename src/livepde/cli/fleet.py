"""Many runs of one case: a table says which."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from livepde.cli.options import CaseArgument, CodeOption, JsonOption, SetOption, load_case
from livepde.cli.printing import CHECK_FAILED, INTERRUPTED, print_json, show, terminal
from livepde.cli.run import batch, concluded, writer_of
from livepde.errors import ConfigurationError, DataError, LivepdeError

if TYPE_CHECKING:
    import pandas as pd

    from livepde.runs import Table

__all__ = ["fleet"]

SUMMARY = "fleet.csv"
NAME, DATA = "name", "data"  # columns of the table; every other one is a key of the case
UNFIT = frozenset('/\\:*?"<>|')  # what names of folders do without


@dataclass(frozen=True)
class Member:
    """One row of the table.

    Attributes
    ----------
    name
        Its run directory is called so.
    data
        Its file; empty: that of the case.
    settings
        Texts KEY=VALUE.
    """

    name: str
    data: str = ""
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ended:
    """How the run of a member ended.

    Attributes
    ----------
    status
        "finished", "interrupted" or "failed".
    samples
        How many it has taken.
    unknowns
        Label of each number -> last value and standard deviation.
    failed
        Names of checks that failed.
    error
        Why it failed.
    """

    name: str
    status: str
    samples: int = 0
    unknowns: dict[str, tuple[float, float]] = field(default_factory=dict)
    failed: tuple[str, ...] = ()
    error: str = ""


def fleet(
    case: CaseArgument,
    members: Annotated[
        Path,
        typer.Option(
            help="A .csv file with a row for each run. Columns: name; data, a file beside the "
            "table; and keys of the case, as unknowns.alpha.prior, with a value for each run.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the run directories. Default: a new one in runs/.", show_default=False
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=-1, help="Processes at once; -1 for one on each processor.")
    ] = 1,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Go on with the runs in --out; begin those that are not there."
        ),
    ] = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Run a case for each row of a table: other data, other settings, a run directory each.

    A run that fails does not end the others; its sentence stands in the summary, fleet.csv.

    Example:  livepde fleet rod/case.toml --members rods.csv --out rods --jobs 4
    """
    from livepde.runs import free_path, refuse_taken

    if resume and out is None:
        raise ConfigurationError("--resume needs --out: the folder of the runs to go on with.")
    if jobs == 0:
        raise ConfigurationError("--jobs 0: give at least 1, or -1 for one on each processor.")
    rows = _read(members)
    name = load_case(case, allow_code, settings).name
    folder = out or free_path(Path("runs") / name)
    for row in rows:
        if not resume and (folder / row.name).exists():
            refuse_taken(folder / row.name)
    run = partial(_run, case, folder, allow_code, tuple(settings or ()), resume)
    ended = _each(run, rows, jobs)
    summary = _summary(ended)
    folder.mkdir(parents=True, exist_ok=True)
    summary.to_csv(folder / SUMMARY, index=False)
    wrong = [item for item in ended if item.status == "failed" or item.failed]
    notes = [f"{item.name}: {item.error}" for item in ended if item.error]
    notes += [f"{item.name}: check failed: {check}" for item in ended for check in item.failed]
    if as_json:
        print_json([_table(summary)], [], notes, run=str(folder), failed=len(wrong))
    else:
        console = terminal()
        show(console, [_table(summary)], [], notes)
        console.print(f"[bold]Run directories: {escape(str(folder))}[/]", soft_wrap=True)
    if any(item.status == "interrupted" for item in ended):
        raise typer.Exit(INTERRUPTED)
    if wrong:
        raise typer.Exit(CHECK_FAILED)


def _read(path: Path) -> list[Member]:
    """Return the rows of the table."""
    import pandas as pd

    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False, skipinitialspace=True)
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise DataError(f"Cannot read the members in {path}: {error}.") from error
    if NAME not in table.columns:
        raise DataError(
            f"{path} has the columns {list(table.columns)}: one called '{NAME}' is needed, which "
            "names the run directories."
        )
    rows: list[Member] = []
    for content in table.to_dict("records"):
        texts = {str(key).strip(): str(value).strip() for key, value in content.items()}
        name, data = texts.pop(NAME), texts.pop(DATA, "")
        if not name or name.startswith(".") or UNFIT & set(name):
            raise DataError(f"{path}: the name {name!r} does not do for a folder.")
        if name in {row.name for row in rows} or name == SUMMARY:
            raise DataError(f"{path}: the name '{name}' is taken; each run needs its own.")
        given = tuple(f"{key}={value}" for key, value in texts.items() if value)
        rows.append(Member(name, str(path.parent / data) if data else "", given))
    if not rows:
        raise DataError(f"{path} has no rows.")
    return rows


def _each(run: Any, rows: Sequence[Member], jobs: int) -> list[Ended]:
    """Run all members, in so many processes."""
    if jobs == 1:
        ended: list[Ended] = []
        for row in rows:
            ended.append(run(row))
            if ended[-1].status == "interrupted":  # Ctrl-C ends all
                break
        return ended
    try:
        from joblib import Parallel, delayed, parallel_config
    except ImportError as error:
        raise ConfigurationError(
            "--jobs needs joblib: pip install 'livepde[fleet]'; without it the runs follow each "
            "other."
        ) from error
    with parallel_config(backend="loky", inner_max_num_threads=1):
        ended = Parallel(n_jobs=jobs)(delayed(run)(row) for row in rows)
    return ended


def _run(
    case: Path,
    folder: Path,
    allow_code: bool,
    settings: tuple[str, ...],
    resume: bool,
    member: Member,
) -> Ended:
    """Run one member as `livepde run` would."""
    own = [*settings, *member.settings]
    target = folder / member.name
    command = ["livepde", "run", str(case), "--out", str(target)]
    command += ["--data", member.data] if member.data else []
    command += [word for text in own for word in ("--set", text)]
    try:
        loaded = load_case(case, allow_code, own)
        write = partial(writer_of, loaded, target, own, resume, command)
        with ExitStack() as stack:
            source = member.data or None
            writer, (prepared, driven) = batch(loaded, source, target, write, stack, quiet=True)
            dataset, _, checks, _ = concluded(loaded, prepared, driven, writer)
    except LivepdeError as error:
        return Ended(member.name, "failed", error=str(error))
    unknowns = {
        label: (float(dataset[label][-1]), float(dataset[f"{label}_std"][-1]))
        for label in filter(None, dataset.attrs["scalars"].split("\n"))
        if dataset.sizes["time"]
    }
    return Ended(
        member.name,
        driven.status,
        len(driven.result),
        unknowns,
        tuple(check.name for check in checks if not check.ok),
        "" if driven.error is None else str(driven.error),
    )


def _summary(ended: Sequence[Ended]) -> pd.DataFrame:
    """Return a row for each run: how it ended, and what it found."""
    import pandas as pd

    rows = []
    for item in ended:
        found = {
            key: number
            for label, (value, std) in item.unknowns.items()
            for key, number in ((label, value), (f"{label}_std", std))
        }
        rows.append({NAME: item.name, "status": item.status, "samples": item.samples, **found})
    return pd.DataFrame(rows)


def _table(summary: pd.DataFrame) -> Table:
    from livepde.runs import Table

    rows = [tuple(row) for row in summary.itertuples(index=False)]
    return Table(f"{len(rows)} runs", [str(name) for name in summary.columns], rows)
