"""Benchmarks: each a command with its own options."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from livepde.cli import main
from livepde.cli.options import JsonOption
from livepde.cli.printing import can_draw, named, report_outcome, terminal

if TYPE_CHECKING:
    from livepde.runs.outcome import Outcome

__all__ = ["app"]

ProblemsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--only",
        help="Only this problem. Repeat it for more.",
    ),
]

LevelsOption = Annotated[
    list[float] | None,
    typer.Option(
        "--level", min=0.0, max=1.0, help="Noise over the data's root mean square. Repeat for more."
    ),
]

app = typer.Typer(
    name="benchmarks",
    help="""Measure what things cost, as ratios that hold on any machine, and what they find.

    Example:  python -m benchmarks step""",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.command()
def step(
    size: Annotated[
        list[int] | None,
        typer.Option(min=5, help="Number of nodes, default 31, 1000 and 10000. Repeat for more."),
    ] = None,
    modes: Annotated[
        list[int] | None,
        typer.Option(
            min=1, help="Unknowns of the sensitivity law, default 1, 10 and 50. Repeat for more."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Time a step of each law against one forward step of the same model.

    Example:  python -m benchmarks step --size 1000 --json
    """
    from benchmarks.rods import RODS, rods
    from benchmarks.step import MODES, SIZES
    from benchmarks.step import step as benchmark

    command = ["step"]
    command += [word for nodes in size or () for word in ("--size", str(nodes))]
    command += [word for count in modes or () for word in ("--modes", str(count))]
    outcome = benchmark(size or SIZES, modes or MODES)
    filters = rods([rod for rod in RODS if not size or rod.nodes in size])
    _report(_both(outcome, filters), command, as_json)


@app.command("import")
def startup(
    rounds: Annotated[int, typer.Option(min=1, help="Fresh processes of each.")] = 15,
    as_json: JsonOption = False,
) -> None:
    """Time the import of livepde, in fresh processes, against that of SciPy and scikit-fem.

    Example:  python -m benchmarks import --json
    """
    from benchmarks.startup import startup as benchmark

    command = ["import", "--rounds", str(rounds)]
    _report(benchmark(rounds), command, as_json)


@app.command()
def overhead(
    rounds: Annotated[int, typer.Option(min=1, help="Fresh processes, and pairs of runs.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """Time what the command line adds: to the first estimate, and to each sample of a rod.

    Example:  python -m benchmarks overhead --json
    """
    from benchmarks.overhead import overhead as benchmark

    command = ["overhead", "--rounds", str(rounds)]
    _report(benchmark(rounds), command, as_json)


@app.command()
def fleet(
    members: Annotated[int, typer.Option(min=1, help="How many rods step.")] = 1000,
    runs: Annotated[
        int, typer.Option(min=0, help="Rods of which run directories are made; 0 for none.")
    ] = 25,
    as_json: JsonOption = False,
) -> None:
    """Time a fleet of rods against as many separate identifiers: a step, and the command.

    Example:  python -m benchmarks fleet --json
    """
    from benchmarks.fleet import fleet as benchmark
    from benchmarks.rods import fleet as rods

    command = [
        "python",
        "-m",
        "benchmarks",
        "fleet",
        "--members",
        str(members),
        "--runs",
        str(runs),
    ]
    _report(_both(benchmark(members, runs), rods()), command, as_json)


@app.command()
def control(
    only: Annotated[
        list[str] | None, typer.Option(help="Only this problem. Repeat it for more.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each kind.")] = 5,
    draw: Annotated[Path | None, typer.Option(help="Folder for a figure of each problem.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Hold control with livepde against true and wrong models and a moving horizon.

    Example:  python -m benchmarks control --only rod --seeds 2
    """
    from benchmarks.control import PROBLEMS
    from benchmarks.control import control as benchmark

    for name in only or ():
        named(name, PROBLEMS, "problem")
    outcome = benchmark(only, seeds, progress=True)
    if draw is not None and can_draw(terminal(err=True)):
        draw.mkdir(parents=True, exist_ok=True)
        for name, figure in outcome.figures.items():
            figure().savefig(draw / f"{name}.png", dpi=110)
    command = ["control"]
    command += [word for name in only or () for word in ("--only", name)]
    _report(outcome, [*command, "--seeds", str(seeds)], as_json)


@app.command()
def scale(
    size: Annotated[
        list[int] | None,
        typer.Option(
            min=2500, help="Nodes of the square, default 10000 and 100000. Repeat for more."
        ),
    ] = None,
    cube: Annotated[
        list[int] | None, typer.Option(min=8000, help="Nodes of a cube. Repeat for more.")
    ] = None,
    gain: Annotated[
        list[float] | None,
        typer.Option(help="Gain of the law, default 1, 100 and 10000. Repeat for more."),
    ] = None,
    million: Annotated[
        bool, typer.Option(help="Only the run with a million nodes: 100 steps, minutes, 3 GB.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Time a step of the gradient law for large fields against one forward step.

    Example:  python -m benchmarks scale --size 100000 --gain 100
    """
    from benchmarks import scale as benchmark

    command = ["scale"]
    command += [word for nodes in size or () for word in ("--size", str(nodes))]
    command += [word for nodes in cube or () for word in ("--cube", str(nodes))]
    command += [word for value in gain or () for word in ("--gain", str(value))]
    if million:
        _report(benchmark.million(), [*command, "--million"], as_json)
        return
    outcome = benchmark.scale(size or benchmark.SIZES, gain or benchmark.GAINS, cube or ())
    _report(outcome, command, as_json)


@app.command()
def auto(
    size: Annotated[
        list[int] | None,
        typer.Option(min=25, help="Nodes of the square, default 64 to 10000. Repeat for more."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Data sets for each noise.")] = 5,
    quick: Annotated[
        bool, typer.Option(help="Only the smallest square, one data set, and the smallest cost.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check what the gradient law that tunes itself promises: its errors and its cost.

    Example:  python -m benchmarks auto --quick
    """
    from benchmarks.auto import COSTS, SIZES
    from benchmarks.auto import auto as benchmark

    command = ["auto"]
    command += [word for nodes in size or () for word in ("--size", str(nodes))]
    if quick:
        _report(benchmark(SIZES[:1], 1, (min(COSTS),)), [*command, "--quick"], as_json)
        return
    command += ["--seeds", str(seeds)]
    _report(benchmark(size or SIZES, seeds, tuple(COSTS)), command, as_json)


@app.command()
def mpi(
    size: Annotated[int, typer.Option(min=2500, help="Number of nodes.")] = 1_000_000,
    ranks: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Number of ranks, default 1 and 2. Repeat for more."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Steps that are timed.")] = 5,
    rounds: Annotated[int, typer.Option(min=1, help="Runs with each number of ranks.")] = 2,
    as_json: JsonOption = False,
) -> None:
    """Time the gradient law on several ranks of MPI, and count what crosses between them.

    Example:  python -m benchmarks mpi --size 100000
    """
    from benchmarks.mpi import mpi as benchmark

    command = ["mpi", "--size", str(size)]
    command += [word for count in ranks or () for word in ("--ranks", str(count))]
    command += ["--samples", str(samples), "--rounds", str(rounds)]
    _report(benchmark(size, ranks or (1, 2), samples, rounds), command, as_json)


@app.command()
def cases(
    only: Annotated[
        list[str] | None, typer.Option(help="Only this case. Repeat it for more.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where the cases are. Default: the next folder 'cases'.")
    ] = None,
    gallery: Annotated[
        Path | None, typer.Option(help="Folder for a page with tables and figures.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run every case of the project with its variants, and the code that they name.

    Example:  python -m benchmarks cases --only soil_layers --json
    """
    from benchmarks import cases as benchmark

    known = {path.stem: path for path in benchmark.find_cases(folder)}
    paths = [named(name, known, "case") for name in only or ()] or list(known.values())
    pictures = None
    if gallery is not None:
        gallery.mkdir(parents=True, exist_ok=True)
        pictures = gallery if can_draw(terminal(err=True)) else None
    outcome, runs = benchmark.bench_cases(paths, progress=True, pictures=pictures)
    if gallery is not None:
        page = benchmark.gallery(runs, gallery)
        terminal(err=True).print(f"Gallery: {page}", soft_wrap=True)
    _report(outcome, ["cases"], as_json)


@app.command()
def coverage(
    twins: Annotated[int, typer.Option(min=1, help="How many twins of each problem.")] = 200,
    as_json: JsonOption = False,
) -> None:
    """Count how often the truth lies in the intervals that are reported.

    Example:  python -m benchmarks coverage --twins 20
    """
    from benchmarks.coverage import coverage as benchmark

    command = ["coverage", "--twins", str(twins)]
    _report(benchmark(twins, progress=True), command, as_json)


@app.command()
def alarms(
    seeds: Annotated[int, typer.Option(min=1, help="Jumps up, and as many down, of each.")] = 5,
    as_json: JsonOption = False,
) -> None:
    """Measure how soon jumps are flagged, how seldom without cause, and which models are doubted.

    Example:  python -m benchmarks alarms --seeds 3
    """
    from benchmarks.alarms import alarms as benchmark

    command = ["alarms", "--seeds", str(seeds)]
    _report(benchmark(seeds, progress=True), command, as_json)


@app.command()
def accuracy(
    only: ProblemsOption = None,
    level: LevelsOption = None,
    seeds: Annotated[int, typer.Option(min=1, help="Data sets for each noise level.")] = 3,
    as_json: JsonOption = False,
) -> None:
    """Hold our laws against what all data together can tell, at several noise levels.

    Example:  python -m benchmarks accuracy --only wall --seeds 5
    """
    from benchmarks.accuracy import accuracy as benchmark

    outcome = benchmark(_problems(only), seeds, levels=level, progress=True)
    _report(outcome, _command("accuracy", only, level, seeds), as_json)


@app.command()
def peers(
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this problem. Repeat it for more.",
        ),
    ] = None,
    level: LevelsOption = None,
    seeds: Annotated[int, typer.Option(min=1, help="Data sets for each noise level.")] = 4,
    row: Annotated[
        list[str] | None,
        typer.Option(
            help="Only this estimator. Repeat it for more.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Hold our laws against filters as arrays, and other packages where they are installed.

    Example:  python -m benchmarks peers --only rod --seeds 16
    """
    from benchmarks.peers import PROBLEMS, ROWS
    from benchmarks.peers import peers as benchmark

    for name in only or ():
        named(name, PROBLEMS, "problem")
    for name in row or ():
        named(name, dict.fromkeys(ROWS), "row")
    outcome = benchmark(only or (), seeds, levels=level or [0.01], rows=row or (), progress=True)
    command = _command("peers", only, level, seeds)
    command += [word for name in row or () for word in ("--row", name)]
    _report(outcome, command, as_json)


@app.command()
def faults(
    kills: Annotated[int, typer.Option(min=1, help="Kills, with a file and with a broker.")] = 200,
    samples: Annotated[int, typer.Option(min=50, help="Samples of a run that is killed.")] = 2000,
    malformed: Annotated[int, typer.Option(min=1, help="Broken rows and messages.")] = 100_000,
    seed: Annotated[int, typer.Option(help="Of what is drawn at random.")] = 0,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="One of file, mqtt, restart, malformed, messages. Repeat it.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Kill runs, take their sources away, feed them broken rows, and count what is lost.

    Example:  python -m benchmarks faults --kills 20 --only file
    """
    from benchmarks.faults import PARTS
    from benchmarks.faults import faults as benchmark

    for name in only or ():
        named(name, PARTS, "part")
    outcome = benchmark(kills, samples, malformed, seed, only or (), progress=True)
    options = ["--kills", kills, "--samples", samples, "--malformed", malformed, "--seed", seed]
    chosen = [word for name in only or () for word in ("--only", name)]
    _report(outcome, ["faults", *map(str, options), *chosen], as_json)


@app.command()
def journal(as_json: JsonOption = False) -> None:
    """Measure what the journal costs: its share of a step of the soil case.

    Example:  python -m benchmarks journal --json
    """
    from benchmarks.journal import journal as benchmark

    _report(benchmark(), ["journal"], as_json)


@app.command()
def soak(
    steps: Annotated[int, typer.Option(min=1, help="How many steps.")] = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Run for very long: memory, time of a step and the journal's size must not grow.

    Example:  python -m benchmarks soak --steps 100000 --json
    """
    from benchmarks.soak import soak as benchmark

    command = ["soak", "--steps", str(steps)]
    _report(benchmark(steps, progress=True), command, as_json)


def _report(outcome: Outcome, words: Sequence[str], as_json: bool) -> None:
    report_outcome(outcome, ["python", "-m", "benchmarks", *words], as_json)


def _both(one: Outcome, other: Outcome) -> Outcome:
    """Return tables, checks and notes of two benchmarks as one."""
    return replace(
        one,
        tables=[*one.tables, *other.tables],
        checks=[*one.checks, *other.checks],
        notes=[*one.notes, *other.notes],
    )


def _problems(only: Sequence[str] | None) -> list[str]:
    from benchmarks.problems import PROBLEMS

    for name in only or ():
        named(name, PROBLEMS, "problem")
    return list(only or ())


def _command(
    name: str, only: Sequence[str] | None, levels: Sequence[float] | None, seeds: int
) -> list[str]:
    chosen = [word for problem in only or () for word in ("--only", problem)]
    chosen += [word for level in levels or () for word in ("--level", f"{level:g}")]
    return [name, *chosen, "--seeds", str(seeds)]


if __name__ == "__main__":
    sys.exit(main(app))
