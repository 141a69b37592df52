"""Command `fleet`: runs of one case for each row of a table."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.markup import escape
from threadpoolctl import threadpool_limits

from livepde import runs
from livepde.cases import Case, Prepared
from livepde.cases.member_blocks import MemberBlock, blocks
from livepde.cli.options import CaseArgument, CodeOption, JsonOption, SetOption, load_case, option
from livepde.cli.printing import CHECK_FAILED, INTERRUPTED, present
from livepde.cli.run import concluded, run_batch, writer_of
from livepde.errors import ConfigurationError, DataError, LivepdeError, RunError
from livepde.frames import estimates
from livepde.records import STATUS_CODES
from livepde.runs import JOURNAL, Check, Driven, Run, RunWriter, Table
from livepde.streams import DataTable

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

SUMMARY = "fleet.csv"
NAME, DATA = "name", "data"  # columns of the table; all other columns are keys of the case
ASKED, GOES_ON = "--separately", "resumed runs"  # reasons for separate runs
UNFIT = frozenset('/\\:*?"<>|')  # characters that are invalid in names of folders
Row = TypeVar("Row")
Found = TypeVar("Found")
LARGEST = 256  # largest number of members in a part, whose runs are interrupted if a worker dies
ATTEMPTS = 5  # losses of a worker, without a completed part in between, until the fleet fails
DEAD_WORKER = {"KilledWorker", "ActorDiedError"}  # exceptions of Dask and Ray for a lost worker


@dataclass(frozen=True)
class Member:
    """One row of the table."""

    name: str  # name of the run directory
    data: str = ""  # data file; empty: the data of the case
    settings: tuple[str, ...] = ()  # KEY=VALUE


@dataclass(frozen=True)
class MemberOutcome:
    """Outcome of the run of a member."""

    name: str
    status: str  # "finished", "interrupted" or "failed"
    samples: int = 0
    level: str = ""  # level of the verdict; empty without samples
    # Last estimates: D, D_std, D_low and D_high, an interval with model errors if it is known.
    unknowns: dict[str, float] = field(default_factory=dict)
    failed: tuple[str, ...] = ()  # names of failed checks
    lost: dict[str, int] = field(default_factory=dict)  # reason -> number of failed steps
    error: str = ""
    apart: str = ""  # reason for a separate run; empty if it was stepped in a block


def fleet(
    case: CaseArgument,
    members: Annotated[
        Path,
        option(
            "A .csv file with a row for each run. Columns: `name`, `data` (a file, relative to the "
            "table), and case keys such as `unknowns.alpha.prior`."
        ),
    ],
    out: Annotated[
        Path | None, option("Folder for the run directories. Default: a new one in runs/.")
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=-1, help="Number of processes. -1: one for each processor.")
    ] = 1,
    backend: Annotated[
        Backend | None,
        option(
            "joblib backend of the processes: loky on this machine (default with --jobs), or Dask "
            "or Ray with the cluster at DASK_SCHEDULER_ADDRESS or RAY_ADDRESS."
        ),
    ] = None,
    resume: Annotated[
        bool, option("Resume the runs in --out, and start the missing ones.", "--resume")
    ] = False,
    separately: Annotated[
        bool,
        option(
            "Run each member separately, with results identical to 'livepde run'.", "--separately"
        ),
    ] = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Run a case for each row of a table, with its own data, settings and run directory.

    If members differ only in data and initial state, they are stepped together, which is much
    faster. A note gives the reason for separate runs. The summary is fleet.csv. If a run fails, the
    others continue, and its message is printed.

    Example:  livepde fleet rod/case.toml --members rods.csv --out rods --jobs 4
    """
    _refuse(resume, out, jobs)
    rows = _read(members)
    name = load_case(case, allow_code, settings).name
    folder = out or runs.free_path(Path("runs") / name)
    for row in () if resume else rows:
        runs.refuse_taken(folder / row.name)
    run = FleetRunner(case, folder, allow_code, tuple(settings or ()), resume, separately)
    ended, losses, summary = _each(run, rows, jobs, backend)
    wrong = [item for item in ended if item.status == "failed" or item.failed]
    notes = [*_how(ended), *losses, *_complaints(ended)]
    lines = [f"[bold]Run directories: {escape(str(folder))}[/]"]
    # The intervals make standard deviations redundant.
    short = summary[[name for name in summary.columns if not str(name).endswith("_std")]]
    cells = list(short.itertuples(index=False, name=None))
    tables = [Table(f"{len(cells)} runs", list(map(str, short.columns)), cells)]
    present(tables, [], notes, as_json=as_json, lines=lines, run=str(folder), failed=len(wrong))
    if _interrupted(ended):
        raise typer.Exit(INTERRUPTED)
    if wrong:
        raise typer.Exit(CHECK_FAILED)


def _refuse(resume: bool, out: Path | None, jobs: int) -> None:
    """Refuse conflicting options."""
    if resume and out is None:
        raise ConfigurationError("--resume requires --out: the folder of the runs to resume.")
    if jobs == 0:
        raise ConfigurationError("--jobs 0: give at least 1, or -1 for one on each processor.")


def _read(path: Path) -> list[Member]:
    """Return the members in the table; raises `DataError`."""
    import pandas as pd

    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False, skipinitialspace=True)
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise DataError(f"Cannot read the members in {path}: {error}.") from error
    if not isinstance(table.index, pd.RangeIndex):  # pandas uses surplus first cells as labels
        raise DataError(
            f"{path}: its rows have more cells than its header: name each column, and end no row "
            "with a separator."
        )
    if NAME not in table.columns:
        raise DataError(
            f"{path} has the columns {list(table.columns)}: one called '{NAME}' is needed, which "
            "names the run directories."
        )
    members: dict[str, Member] = {}
    for content in table.to_dict("records"):
        member = _member(content, path)
        if member.name in members or member.name == SUMMARY:
            raise DataError(f"{path}: the name '{member.name}' is taken; each run needs its own.")
        members[member.name] = member
    if not members:
        raise DataError(f"{path} has no rows.")
    return list(members.values())


def _member(content: Mapping[Hashable, str], path: Path) -> Member:
    """Return the member in a row of the table at `path`; raises `DataError`."""
    texts = {str(key).strip(): str(value).strip() for key, value in content.items()}
    name, data = texts.pop(NAME), texts.pop(DATA, "")
    if not name or name.startswith(".") or UNFIT & set(name):
        raise DataError(f"{path}: the name {name!r} is not valid as a folder name.")
    given = tuple(f"{key}={value}" for key, value in texts.items() if value)
    return Member(name, str(path.parent / data) if data else "", given)


def _each(
    run: FleetRunner, rows: Sequence[Member], jobs: int, backend: Backend | None
) -> tuple[list[MemberOutcome], list[str], pd.DataFrame]:
    """Run all members; return their outcomes, notes on lost workers, and the written summary."""
    ended: dict[str, MemberOutcome] = {}
    losses: list[str] = []

    def summed_up() -> pd.DataFrame:
        summary = _summary(_in_order(rows, ended))
        run.folder.mkdir(parents=True, exist_ok=True)
        summary.to_csv(run.folder / SUMMARY, index=False)
        return summary

    try:
        here = jobs == 1 and backend is None
        # A backend may run a part again by itself, so each part resumes existing runs.
        parallel = replace(run, resume=True, home=Path.cwd())
        for found in [run(rows)] if here else in_parts(parallel, rows, jobs, backend, losses):
            ended |= {item.name: item for item in found}
    except ConfigurationError:
        raise
    except RunError as error:  # workers died repeatedly
        given_up = f"{error} Resume with --resume."
        lost = {row.name: MemberOutcome(row.name, "failed", error=given_up) for row in rows}
        ended = lost | run.left(rows, ended, "failed", given_up) | ended
    except (Exception, KeyboardInterrupt) as error:
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        ended |= run.left(rows, ended, status, "The command was ended. Resume with --resume.")
        summed_up()
        raise
    return _in_order(rows, ended), losses, summed_up()


def _in_order(rows: Sequence[Member], ended: Mapping[str, MemberOutcome]) -> list[MemberOutcome]:
    """Return the existing outcomes in the order of the table."""
    return [ended[row.name] for row in rows if row.name in ended]


@dataclass(frozen=True)
class FleetRunner:
    """Runner of members in one process; its fields are options of the command."""

    case: Path
    folder: Path
    allow_code: bool
    settings: tuple[str, ...]
    resume: bool
    separately: bool = False
    home: Path = Path()  # start of relative paths, for processes with another working directory

    def __call__(self, rows: Sequence[Member]) -> list[MemberOutcome]:
        """Run members and return their outcomes; members are stepped in blocks if possible."""
        members = {row.name: row for row in rows}
        ready, ended = self._prepared(rows)
        new, begun = dict[str, Prepared](), dict[str, str]()
        for name, one in ready.items():
            if (self._target(name) / JOURNAL).exists():
                begun[name] = GOES_ON
            else:
                new[name] = one
        together, apart = ([], dict.fromkeys(new, ASKED)) if self.separately else blocks(new)
        for block in together:
            ended |= self._together(block, members) if not _interrupted(ended.values()) else {}
        for name, why in (apart | begun).items():
            if not _interrupted(ended.values()):
                ended[name] = replace(self._alone(members[name], ready[name]), apart=why)
        return _in_order(rows, ended)

    def _prepared(
        self, rows: Sequence[Member]
    ) -> tuple[dict[str, Prepared], dict[str, MemberOutcome]]:
        """Return the members whose case and data can be read, and the outcomes of the others."""
        ended: dict[str, MemberOutcome] = {}
        ready: dict[str, Prepared] = {}
        # Members with the same settings share a case, which is read and checked only once.
        loaded: dict[tuple[str, ...], Case] = {}
        for row in rows:
            try:
                if row.settings not in loaded:
                    path = self.home / self.case
                    loaded[row.settings] = load_case(path, self.allow_code, self._own(row))
                case = loaded[row.settings]
                target = self._target(row.name)
                if self.resume and (target / runs.RECORD).exists():
                    # The run to resume has to be a run of this member.
                    command = self._command(row)
                    runs.open(target).refuse_other(command, case.text, self._own(row))
                ready[row.name] = case.read(str(self.home / row.data) if row.data else None)
            except LivepdeError as error:
                ended[row.name] = MemberOutcome(row.name, "failed", error=str(error))
        return ready, ended

    def left(
        self, rows: Sequence[Member], ended: Mapping[str, MemberOutcome], status: str, why: str
    ) -> dict[str, MemberOutcome]:
        """Return the outcomes of runs not in `ended`; runs marked as running get `status`."""
        found = {}
        for name in (row.name for row in rows if row.name not in ended):
            target = self._target(name)
            if not (target / runs.RECORD).exists():
                continue
            try:
                run = runs.open(target)
                begun = run.status != "running" or (target / runs.JOURNAL).exists()
                dataset = run.dataset if begun else None
                if run.status == "running":
                    writer = runs.RunWriter(target, run.record)
                    writer.finish(status=status, dataset=dataset, notes=[why])
                    run = runs.open(target)
                found[name] = MemberOutcome(name, run.status, error=why)
                if dataset is not None:
                    found[name] = replace(_outcome_of(name, run, dataset, run.checks), error=why)
            except LivepdeError as error:
                found[name] = MemberOutcome(name, status, error=str(error))
        return found

    def _target(self, name: str) -> Path:
        return self.home / self.folder / name

    def _own(self, member: Member) -> list[str]:
        return [*self.settings, *member.settings]

    def _command(self, member: Member) -> list[str]:
        target = self.folder / member.name  # without `home`: records are the same in all processes
        command = ["livepde", "run", str(self.case), "--out", str(target)]
        command += ["--data", member.data] if member.data else []
        return command + [word for text in self._own(member) for word in ("--set", text)]

    def _writer(self, member: Member, case: Case) -> RunWriter:
        target, command = self._target(member.name), self._command(member)
        return writer_of(case, target, self._own(member), self.resume, command)

    def _together(
        self, block: MemberBlock, members: Mapping[str, Member]
    ) -> dict[str, MemberOutcome]:
        """Run a block of members and return their outcomes."""
        ended = {}
        try:
            writers = {
                name: self._writer(members[name], one.case) for name, one in block.members.items()
            }
            block.run([self._target(name) / JOURNAL for name in writers])
            for k, (name, writer) in enumerate(writers.items()):
                with block.ended(k) as (identifier, driven):
                    one = (block.members[name], identifier, driven, writer)
                    dataset, _, checks, _ = concluded(*one, draw=False)
                ended[name] = _outcome_of(name, driven, dataset, checks)
        except LivepdeError as error:  # such as a full disk: all unfinished members fail
            for name in block.members.keys() - ended.keys():
                ended[name] = MemberOutcome(name, "failed", error=str(error))
        return ended

    def _alone(self, member: Member, prepared: Prepared) -> MemberOutcome:
        """Run a member separately, unless its run has finished, and return the outcome."""
        name, table = member.name, prepared.stream
        target = self._target(name)
        try:
            if self.resume and (target / runs.RECORD).exists() and isinstance(table, DataTable):
                run = runs.open(target)
                if run.status == "finished" and run.record.get("samples") == len(table):
                    return _outcome_of(name, run, run.dataset, run.checks)
            with ExitStack() as stack:
                write = partial(self._writer, member, prepared.case)
                writer, (_, driven) = run_batch(prepared, target, write, stack, quiet=True)
                one = (prepared, prepared.identifier, driven, writer)
                dataset, _, checks, _ = concluded(*one, draw=False)
        except LivepdeError as error:
            return MemberOutcome(name, "failed", error=str(error))
        return _outcome_of(name, driven, dataset, checks)


def _interrupted(ended: Iterable[MemberOutcome]) -> bool:
    """Return whether Ctrl-C has interrupted a run, which ends the fleet."""
    return any(item.status == "interrupted" for item in ended)


def _outcome_of(
    name: str, run: Driven | Run, dataset: xr.Dataset, checks: Sequence[Check]
) -> MemberOutcome:
    unknowns: dict[str, float] = {}
    for label, row in estimates(dataset).iterrows():
        kind = "" if math.isnan(row["model_low"]) else "model_"
        columns = {"": "value", "_std": "std", "_low": f"{kind}low", "_high": f"{kind}high"}
        unknowns |= {f"{label}{end}": float(row[column]) for end, column in columns.items()}
    failed = tuple(check.name for check in checks if not check.ok)
    error = getattr(run, "error", None)
    samples = dataset.sizes["time"]
    lost = dict(Counter(STATUS_CODES[code] for code in dataset["status"].values.tolist() if code))
    return MemberOutcome(
        name,
        run.status,
        samples,
        level=runs.verdict(dataset).level if samples else "",
        unknowns=unknowns,
        failed=failed,
        lost=lost,
        error=str(error) if error else "",
    )


def _complaints(ended: Sequence[MemberOutcome]) -> list[str]:
    """Return sentences on errors, then on failed steps, then on failed checks."""
    steps = [(item, why, count) for item in ended for why, count in item.lost.items()]
    return [
        *(f"{item.name}: {item.error}" for item in ended if item.error),
        *(f"{one.name}: {n} of {one.samples} steps failed: {why}" for one, why, n in steps),
        *(f"{item.name}: check failed: {check}" for item in ended for check in item.failed),
    ]


def _how(ended: Sequence[MemberOutcome]) -> list[str]:
    """Return a sentence, if any, on members stepped together and reasons for separate runs."""
    apart = Counter(item.apart for item in ended if item.apart)
    count = sum(apart.values())
    together = sum(not item.apart and item.samples > 0 for item in ended)
    parts = [f"{together} were stepped together"] if together else []
    reasons = "; ".join(f"{why} ({number})" for why, number in apart.items())
    parts += [f"{count} were stepped separately: {reasons}"] if apart else []
    return [f"Of {len(ended)} members, {', and '.join(parts)}."] if parts else []


def _summary(ended: Sequence[MemberOutcome]) -> pd.DataFrame:
    """Return a row for each run: status, number of samples, level and final estimates."""
    import pandas as pd

    rows = []
    for item in ended:
        own = {NAME: item.name, "status": item.status, "samples": item.samples}
        rows.append({**own, "verdict": item.level, **item.unknowns})
    return pd.DataFrame(rows)


class Backend(StrEnum):
    """Backends of joblib that livepde can configure."""

    loky = "loky"
    dask = "dask"
    ray = "ray"


def in_parts(
    run: Callable[[Sequence[Row]], Found],
    rows: Sequence[Row],
    jobs: int,
    backend: Backend | None,
    messages: list[str],
) -> Iterator[Found]:
    """Run rows in parts of bounded size, and iterate over their results in any order.

    If a worker dies, its part is run again; `run` has to resume from its run directories. A
    sentence for each lost worker is appended to `told`.
    """
    with ExitStack() as stack:
        _configure(backend, stack)
        from joblib import Parallel, delayed, effective_n_jobs
        from joblib.parallel import get_active_backend

        jobs = min(effective_n_jobs(jobs), len(rows))
        count = max(jobs, -(-len(rows) // LARGEST))
        parts = {k: rows[k::count] for k in range(count)}
        lost = 0
        while parts:
            tasks = [delayed(_attempt)(run, k, part) for k, part in parts.items()]
            soon = get_active_backend()[0].supports_return_generator  # Ray returns all at the end
            how = "generator_unordered" if soon else "list"
            parallel = Parallel(n_jobs=jobs, batch_size=1, return_as=how)
            try:
                for k, found in parallel(tasks):
                    del parts[k]
                    lost = 0
                    yield found
            except Exception as error:
                name = type(error).__name__
                if not isinstance(error, BrokenExecutor) and name not in DEAD_WORKER:
                    raise
                lost += 1
                members = sum(map(len, parts.values()))
                what = "A worker process died (killed or out of memory)"
                what += f", {members} members unfinished"
                if lost == ATTEMPTS:
                    raise RunError(f"{what}, {lost} times in a row without progress.") from error
                messages.append(f"{what}. They were resumed from their run directories.")


def _attempt(
    run: Callable[[Sequence[Row]], Found], k: int, part: Sequence[Row]
) -> tuple[int, Found]:
    with threadpool_limits(1):
        return k, run(part)


def _configure(backend: Backend | None, stack: ExitStack) -> None:
    """Configure a backend of joblib, unless it is None, until the stack is closed."""
    try:
        from joblib import parallel_config
    except ImportError as error:
        raise ConfigurationError(
            "--jobs requires joblib: pip install 'livepde[fleet]'. Without --jobs, members run one "
            "after the other."
        ) from error
    if backend is None:
        return
    if backend is Backend.ray:
        try:
            from ray.util.joblib import register_ray
        except ImportError as error:
            raise ConfigurationError(
                "--backend ray needs Ray: pip install ray, here and on its nodes."
            ) from error
        register_ray()  # type: ignore[no-untyped-call,unused-ignore]
    if backend is Backend.dask:
        try:
            import distributed
        except ImportError as error:
            raise ConfigurationError(
                "--backend dask needs Dask: pip install 'dask[distributed]', here and on its "
                "workers."
            ) from error
        dask: Any = distributed  # without types
        # Connects to DASK_SCHEDULER_ADDRESS, or starts a local cluster.
        client: AbstractContextManager[Any] = dask.Client()
        stack.enter_context(client)
    stack.enter_context(parallel_config(backend=backend.value))
