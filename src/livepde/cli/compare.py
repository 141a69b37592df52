"""Command `compare`: run variants of a case and recommend one."""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Annotated

import tomlkit
import typer
from rich.markup import escape
from threadpoolctl import threadpool_limits

from livepde import runs
from livepde.atomic_write import write_bytes
from livepde.cases.case import with_members
from livepde.cases.proposals import MOST, proposed
from livepde.cases.read import filled, parse, read_text
from livepde.cases.recommendation import conclusions, recommended
from livepde.cases.variants import AS_STATED, Variant, VariantRun, run_variant, variant_of
from livepde.cli.options import (
    CodeOption,
    DataOption,
    JsonOption,
    SetOption,
    argument,
    load_case,
    of_a_run,
    option,
)
from livepde.cli.printing import present
from livepde.errors import ConfigurationError, RunError
from livepde.plots.style import figure_class
from livepde.progress import timed
from livepde.runs import Table
from livepde.runs.summary import digits, interval, shown

WIDE = 3  # largest number of panels in a row


def compare(
    case: Annotated[
        Path, argument("The case file (TOML), or the directory of a run.", metavar="CASE")
    ],
    variants: Annotated[
        list[str] | None,
        option(
            "A variant: its name, and settings as for --set, separated by ';'. Repeatable. "
            "Default: the likely causes of the first run, and common errors.",
            "--variant",
            metavar="'NAME: KEY=VALUE; KEY=VALUE'",
        ),
    ] = None,
    settings: SetOption = None,
    data: DataOption = None,
    most: Annotated[
        int, typer.Option(min=1, help="Largest number of variants, if the program chooses them.")
    ] = MOST,
    jobs: Annotated[
        int, option("Number of processes. Default: one for each processor.", min=1)
    ] = os.cpu_count() or 1,
    write: Annotated[
        Path | None,
        option(
            "Write the recommended variant as a case file, with the comments of the case.",
            metavar="FILE.toml",
        ),
    ] = None,
    force: Annotated[bool, option("With --write: replace an existing file.", "--force")] = False,
    figure: Annotated[
        Path | None, option("Draw the intervals of all variants to a figure.", metavar="FILE.png")
    ] = None,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
) -> None:
    """Run variants of a case side by side, and recommend one.

    The recommended variant has the best evidence of those that do not predict the validation
    sensors worse. No run directory is written.

    Example:  livepde compare mycase/case.toml
    By hand:  livepde compare mycase/case.toml --variant "offset: channels.T_10.offset='0.2 K'"
    Of a run: livepde compare runs/mycase --write mycase/better.toml
    """
    given = list(map(variant_of, variants or ()))
    named = case
    case, settings, data = _case_of(named, settings or [], data)
    loaded = load_case(case, allow_code, settings)
    if loaded.is_live(data) or data == "-":
        raise ConfigurationError(
            "compare requires complete data. Add --data FILE with recorded rows."
        )
    _check_targets(write, figure, case, force)
    with of_a_run(named != case):
        prepared = loaded.prepare(data)
    run = partial(_run, case, settings, data=data, allow_code=allow_code)
    stated = Variant(AS_STATED)
    (base, *found) = _all(run, [stated, *given], jobs, as_json)
    if base.error:
        raise RunError(f"{case}: the run of the case failed: {base.error}")
    chosen = [] if given else proposed(prepared, base, most)
    found += _all(run, chosen, jobs, as_json)
    best = recommended(base, found)
    notes = conclusions(base, found)
    base, *found = (best if one.variant == best.variant else one for one in (base, *found))
    if write is not None:
        notes.append(_written(write, case, settings, best.variant, data, allow_code))
    if figure is not None:
        notes.append(_drawn([base, *found], best, figure))
    present(
        _tables(base, found, best),
        [],
        notes,
        as_json=as_json,
        title=f"[bold]{escape(loaded.title)}[/]  {1 + len(found)} variants",
        case=str(case),
        recommended=best.variant.name,
        variants=[one.to_dict() for one in (base, *found)],
    )


def _case_of(
    case: Path, settings: list[str], data: str | None
) -> tuple[Path, list[str], str | None]:
    """Return case file, settings and data; if `case` is a run directory, those of the run."""
    if not case.is_dir():
        return case, settings, data
    run = runs.open(case)
    return run.case_file(), [*run.settings, *settings], data or run.data_file


def _written(
    target: Path,
    case: Path,
    settings: Sequence[str],
    best: Variant,
    data: str | None,
    allow_code: bool,
) -> str:
    """Write the recommended variant unless it is the case itself; return a sentence on it."""
    if not best.settings:
        return f"{target} is not written: the case itself is recommended."
    text = read_text(case)
    for each in (settings, best.settings):
        document = tomlkit.parse(text)
        with_members(document, parse(each), case, allow_code)
        text = filled(tomlkit.dumps(document), parse(each), str(case))
    write_bytes(target, text.encode())
    of = "" if data is None else f" --data {data}"  # the case may specify other data
    return f"Wrote {target}: livepde run {target}{of}"


def _all(
    run: Callable[[Variant], VariantRun], variants: Sequence[Variant], jobs: int, quiet: bool
) -> list[VariantRun]:
    """Return the runs of variants in their order; with several jobs, each in its own process."""

    def apart(variant: Variant) -> VariantRun:
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=spawn) as process:
            try:
                return process.submit(run, variant).result()
            except BrokenProcessPool:
                return VariantRun(variant, error="its process was killed or ran out of memory")

    jobs = min(jobs, len(variants))
    one = run if jobs < 2 else apart
    with timed([variant.name for variant in variants], quiet) as running:

        def watched(index: int, variant: Variant) -> VariantRun:
            with running(index):
                return one(variant)

        if jobs < 2:
            return list(map(watched, range(len(variants)), variants))
        with ThreadPoolExecutor(jobs) as threads:
            return list(threads.map(watched, range(len(variants)), variants))


def _run(
    case: Path, settings: Sequence[str], variant: Variant, *, data: str | None, allow_code: bool
) -> VariantRun:
    """Run a variant with one thread."""
    with threadpool_limits(1):
        return run_variant(case, settings, variant, data, allow_code)


def _tables(base: VariantRun, found: Sequence[VariantRun], best: VariantRun) -> list[Table]:
    """Return tables of variants by evidence, of estimates, of failures, and of settings."""

    def rank(one: VariantRun) -> tuple[bool, float]:
        gained = one.gained(base)
        return math.isnan(gained), -gained if math.isfinite(gained) else 0.0

    ended = sorted((one for one in (base, *found) if not one.error), key=rank)
    rows = [
        (
            _marked(one, best),
            one.level,
            shown(one.gained(base), "+.1f"),
            shown(one.misfit, ".2g"),
            shown(one.validation_error, ".3g"),
            one.unknowns,
        )
        for one in ended
    ]
    columns = ("variant", "verdict", "evidence", "/ noise", "validation", "unknowns")
    tables = [Table("Variants (* recommended)", columns, rows)]
    if each := _estimates(base, ended, best):
        tables.append(Table("Estimates", ("unknown", "variant", "value", "95 %", ""), each))
    failed = [(one.variant.name, one.error) for one in found if one.error]
    if failed:
        tables.append(Table("Variants that failed", ("variant", "reason"), failed))
    changed = [(one.variant.name, "; ".join(one.variant.settings)) for one in found]
    return [*tables, Table("Settings of the variants", ("variant", "settings"), changed)]


def _marked(one: VariantRun, best: VariantRun) -> str:
    """Return the name of a variant, marked with `*` if it is recommended."""
    return one.variant.name + (" *" if one is best else "")


def _estimates(
    base: VariantRun, ended: Sequence[VariantRun], best: VariantRun
) -> list[tuple[str, ...]]:
    """Return a row of the table of estimates for each unknown and variant."""
    rows: list[tuple[str, ...]] = []
    for label in dict.fromkeys(label for one in (base, *ended) for label in one.estimates):
        for one in ended:
            if (known := one.estimates.get(label)) is not None:
                unknown = f"{label} in {known.unit}" if known.unit else label
                value, ends = digits(known.value, known.std)[0], (known.low, known.high)
                mark = "apart" if label in one.apart(base) else ""
                row = unknown, _marked(one, best), value, interval(*ends, known.std), mark
                rows.append(row)
    return rows


def _drawn(runs: Sequence[VariantRun], best: VariantRun, target: Path) -> str:
    """Draw the intervals of the case's unknowns in all variants; return a sentence on it."""
    from livepde.plots import figure, intervals

    if not runs[0].estimates:
        return f"{target} is not written: no unknown of the case is a number."
    labels = list(runs[0].estimates)
    wide = min(len(labels), WIDE)
    drawn, axes = figure(-(-len(labels) // wide), wide, "Variants (* recommended)")
    for label, ax in zip(labels, axes, strict=False):
        of = {
            f"{_marked(one, best)} ({one.level})": one.estimates[label]
            for one in runs
            if label in one.estimates
        }
        each = {name: (known.value, known.low, known.high) for name, known in of.items()}
        intervals(each, runs[0].estimates[label].unit, ax=ax)
        ax.set_title(label)
    for ax in axes[len(labels) :]:
        ax.set_visible(False)
    drawn.savefig(target)
    return f"Wrote {target}."


def _check_targets(case_target: Path | None, figure: Path | None, case: Path, force: bool) -> None:
    """Refuse invalid output files before variants are run."""
    if case_target is not None:
        _check_target(case_target, case, force)
    if figure is not None:
        _check_figure(figure)


def _check_target(target: Path, case: Path, force: bool) -> None:
    if target.exists() and not force:
        raise ConfigurationError(f"{target} exists: add --force to replace it.")
    if target.resolve() == case.resolve():
        raise ConfigurationError(f"--write {target} is the case itself: name another file.")
    if target.parent.resolve() != case.parent.resolve():
        raise ConfigurationError(
            f"--write {target}: paths in a case are relative to it; name a file in {case.parent}."
        )


def _check_figure(target: Path) -> None:
    known = figure_class()().canvas.get_supported_filetypes()
    if target.suffix.removeprefix(".").lower() not in known:
        raise ConfigurationError(f"--figure {target}: name a file that ends in .png, .pdf or .svg.")
    if not target.parent.is_dir():
        raise ConfigurationError(f"--figure {target}: there is no directory {target.parent}.")
