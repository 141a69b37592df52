"""Command of the benchmark: python -m benchmarks.honest."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from benchmarks.honest import KINDS, PROBLEMS, honest
from benchmarks.honest.run import QUICK, QUICK_SEEDS, SEEDS
from livepde.cli.options import JsonOption
from livepde.cli.printing import report_outcome

__all__ = ["main"]


def main(
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Only this problem. Repeat it for more.")
    ] = None,
    kind: Annotated[
        list[str] | None, typer.Option("--kind", help="Only this kind of data. Repeat for more.")
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(min=1, help=f"Twins of each problem: {SEEDS}, with --quick {QUICK_SEEDS}."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes, default one for each processor.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer problems and twins.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Find out whether intervals hold when the truth comes from another code.

    Example:  python -m benchmarks.honest --only rod --kind white --seeds 10
    """
    for given, known in ((only, PROBLEMS), (kind, KINDS)):
        for name in given or ():
            if name not in known:
                raise typer.BadParameter(f"'{name}' is not one of {', '.join(known)}.")
    problems = only or (QUICK if quick else tuple(PROBLEMS))
    count = seeds or (QUICK_SEEDS if quick else SEEDS)
    found = honest(problems, kind or (), count, workers=workers, progress=True)
    report_outcome(found, ["python", "-m", "benchmarks.honest", *sys.argv[1:]], as_json)


if __name__ == "__main__":
    typer.run(main)
