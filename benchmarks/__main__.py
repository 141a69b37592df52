"""Command line of the benchmarks."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from benchmarks.commands import Count, Program, Workers, chosen, several
from livepde.cli import main
from livepde.cli.finished import Standard
from livepde.cli.options import CodeOption, SetOption, load_case
from livepde.cli.printing import can_draw, named, terminal
from livepde.runs import Outcome

__all__ = ["app"]

program = Program(
    "python -m benchmarks",
    """Measure the cost of livepde, as ratios that hold on any machine, and the quality of results.

    With --quick, each benchmark runs its checks with fewer seeds and smaller sizes, in less than
    two minutes on two cores. Explicit options override the values of --quick.

    Example:  python -m benchmarks step""",
)
app = program.app

Problems = Annotated[list[str] | None, several("Only this problem.", "--only")]
Levels = Annotated[
    list[float] | None,
    several("Noise relative to the data's root mean square.", "--level", min=0.0, max=1.0),
]


@program.command(
    quick="Two sizes, and only rods with 31 nodes: the bounds of longer rods and of the square "
    "with constant unknowns are not checked."
)
def step(
    size: Annotated[
        list[int] | None,
        several(
            "Number of nodes, default 31, 1000, 10000 and 100000, with --quick 31 and 10000.", min=5
        ),
    ] = None,
    modes: Annotated[
        list[int] | None,
        several(
            "Modes of the sensitivity law, default 1, 10 and 50, with --quick 1 and 10.", min=1
        ),
    ] = None,
    quick: bool = False,
) -> Outcome:
    """Time a step of each law relative to one forward step of the same model.

    Example:  python -m benchmarks step --size 1000 --json
    """
    from benchmarks.rods import RODS, rods
    from benchmarks.step import MODES, QUICK_MODES, QUICK_SIZES, SIZES
    from benchmarks.step import step as benchmark
    from benchmarks.usual_step import MEMBERS, RUNS, usual_step

    timed = size or (QUICK_SIZES[:1] if quick else ())
    filters = rods([rod for rod in RODS if not timed or rod.nodes in timed])
    sizes = size or (QUICK_SIZES if quick else SIZES)
    usual = usual_step(timed, runs=2 if quick else RUNS, members=0 if quick else MEMBERS)
    laws = benchmark(sizes, modes or (QUICK_MODES if quick else MODES))
    return _both(_both(laws, filters), usual)


@program.command(quick="One round, with the rod and the column only.")
def jobs(
    only: Annotated[list[str] | None, several("Only this job.", "--only")] = None,
    rounds: Annotated[int, Count(3, 1, "Runs of each job and of its fit.")] = 3,
    quick: bool = False,
) -> Outcome:
    """Time whole runs relative to fits that a user would write, at equal error.

    Example:  python -m benchmarks jobs --only rod --json
    """
    from benchmarks.user_jobs.report import QUICK, user_jobs

    return user_jobs(only or (QUICK if quick else ()), rounds)


@program.command(name="import", quick="Fewer processes.")
def startup(rounds: Annotated[int, Count(15, 3, "New processes for each import.")]) -> Outcome:
    """Time the import of livepde relative to the import of SciPy and scikit-fem.

    Example:  python -m benchmarks import --json
    """
    from benchmarks.startup import startup as benchmark

    return benchmark(rounds)


@program.command(quick="One process and one pair of runs: other load on the machine counts.")
def overhead(
    rounds: Annotated[int, Count(5, 1, "New processes, and pairs of runs.")],
) -> Outcome:
    """Time the overhead of the command line: until the first estimate, and per sample of a rod.

    Example:  python -m benchmarks overhead --json
    """
    from benchmarks.overhead import overhead as benchmark

    return benchmark(rounds)


@program.command(
    quick="Fewer rods: a small fleet saves less, and the start of the command has a larger share. "
    "Bounds on times that hold for 1000 rods may fail."
)
def fleet(
    members: Annotated[int, Count(1000, 200, "Rods in the fleet whose steps are timed.")],
    runs: Annotated[
        int, Count(25, 8, "Rods for which run directories are written; 0 for none.", least=0)
    ],
) -> Outcome:
    """Time steps and command of a fleet of rods relative to separate identifiers.

    Example:  python -m benchmarks fleet --json
    """
    from benchmarks.fleet import fleet as benchmark
    from benchmarks.rods import fleet as rods

    return _both(benchmark(members, runs), rods())


@program.command(
    quick="Fewer rods, from which the memory of 10 000 is extrapolated, and few kills.",
)
def shard(
    members: Annotated[int, Count(10_000, 2000, "Number of live rods.")],
    kills: Annotated[int, Count(20, 4, "Number of times a worker is killed.")],
) -> Outcome:
    """Measure live shards of rods: memory, time per sample, and recovery of killed workers.

    Example:  python -m benchmarks shard --json
    """
    from benchmarks.shard import shard as benchmark

    return benchmark(members, kills)


@program.command(
    quick="Only the rod, one seed, 0.6 of the time, and the first setting of the moving horizon on "
    "the reduced model: the horizon is not tuned, and the worst case is of a single seed."
)
def control(
    *,
    only: Problems = None,
    seeds: Annotated[int, Count(5, 1, "Runs of each kind.")],
    draw: Annotated[Path | None, typer.Option(help="Folder for a figure of each problem.")] = None,
    quick: bool = False,
) -> Outcome:
    """Compare control by livepde with control by true and wrong models and a moving horizon.

    Example:  python -m benchmarks control --only rod --seeds 2
    """
    from benchmarks.control import PROBLEMS
    from benchmarks.control import control as benchmark

    names = chosen(only, PROBLEMS, "problem", ["rod"] if quick else [])
    outcome = benchmark(names, seeds, short=quick, progress=True)
    if draw is not None and can_draw(terminal(err=True)):
        draw.mkdir(parents=True, exist_ok=True)
        for name, figure in outcome.figures.items():
            figure().savefig(draw / f"{name}.png", dpi=110)
    return outcome


@program.command(
    quick="Small squares, where a step of the law costs more forward steps than on large ones. "
    "The exponent is for the small squares."
)
def scale(
    size: Annotated[
        list[int] | None,
        several(
            "Nodes of the square, default 10000 and 100000, with --quick 2500 and 10000.", min=2500
        ),
    ] = None,
    cube: Annotated[list[int] | None, several("Nodes of a cube.", min=8000)] = None,
    gain: Annotated[
        list[float] | None, several("Gain of the law, default 1, 100 and 10000.")
    ] = None,
    million: Annotated[
        bool, typer.Option(help="Only run a million nodes: 100 steps, several minutes, 3 GB.")
    ] = False,
    quick: bool = False,
) -> Outcome:
    """Time a step of the gradient law for large fields relative to one forward step.

    Example:  python -m benchmarks scale --size 100000 --gain 100
    """
    from benchmarks import scale as benchmark

    if million:
        return benchmark.million()
    sizes = size or (benchmark.COUNTED if quick else benchmark.SIZES)
    return benchmark.scale(sizes, gain or benchmark.GAINS, cube or ())


@program.command(quick="One data set, the smallest meshes, and one reaction on partial data.")
def auto(
    *,
    size: Annotated[
        list[int] | None,
        several("Nodes of the square, default 64 to 10000, with --quick 64.", min=25),
    ] = None,
    seeds: Annotated[int, Count(5, 1, "Data sets for each noise level.")],
    quick: bool = False,
) -> Outcome:
    """Check errors and cost of the gradient law with automatic gain.

    Example:  python -m benchmarks auto --quick
    """
    from benchmarks.auto import COSTS, SIZES
    from benchmarks.auto import auto as benchmark
    from benchmarks.partial import LEVELS, PROCESSES

    sizes = size or (SIZES[:1] if quick else SIZES)
    costs = (min(COSTS),) if quick else tuple(COSTS)
    reactions = tuple(PROCESSES)[: 1 if quick else None]
    return benchmark(sizes, seeds, costs, reactions, LEVELS[-1:] if quick else LEVELS)


@program.command(quick="Few nodes: q is compared, but the bounds on costs do not apply.")
def petsc(
    *,
    size: Annotated[int, Count(100_000, 3000, "Number of nodes.", least=2500)],
    ranks: Annotated[list[int] | None, several("Number of ranks, default 1 and 2.", min=1)] = None,
    samples: Annotated[int, Count(6, 2, "Timed samples.")],
) -> Outcome:
    """Time both laws on PETSc vectors relative to a forward step, on one and several ranks.

    Example:  python -m benchmarks petsc --size 100000
    """
    from benchmarks.petsc import petsc as benchmark

    return benchmark(size, ranks or (1, 2), samples)


@program.command(
    quick="One case for each kind of process, without variants. With --folder: all cases in it."
)
def cases(
    only: Annotated[list[str] | None, several("Only this case.")] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Folder of the cases. Default: the nearest folder 'cases'.")
    ] = None,
    gallery: Annotated[
        Path | None, typer.Option(help="Write a page with tables and figures into this folder.")
    ] = None,
    compared: Annotated[
        int,
        typer.Option(help="Variants that livepde compare tries on cases with measurements.", min=0),
    ] = 0,
    quick: bool = False,
) -> Outcome:
    """Run every case of the project with its variants. Code that the cases name is executed.

    Example:  python -m benchmarks cases --only soil_layers --json
    """
    from benchmarks import cases as benchmark

    known = {path.stem: path for path in benchmark.find_cases(folder)}
    names = only or (benchmark.QUICK if quick and folder is None else known)
    paths = [named(name, known, "case") for name in names]
    pictures = None
    if gallery is not None:
        gallery.mkdir(parents=True, exist_ok=True)
        pictures = gallery if can_draw(terminal(err=True)) else None
    outcome, runs = benchmark.bench_cases(
        paths, progress=True, pictures=pictures, variants=not quick, compared=compared
    )
    if gallery is not None:
        page = benchmark.gallery(runs, gallery)
        terminal(err=True).print(f"Gallery: {page}")
    return outcome


@program.command(
    quick="Fewer twins: the bounds are for shares of 200 twins, and shares of 20 miss some of "
    "them by chance."
)
def coverage(twins: Annotated[int, Count(200, 20, "Twins of each problem.")]) -> Outcome:
    """Count how often the truth lies in the reported intervals.

    Example:  python -m benchmarks coverage --twins 20
    """
    from benchmarks.coverage import coverage as benchmark

    return benchmark(twins, progress=True)


@program.command(
    quick="Few twins of the cheapest problems. The bounds on coverage allow for chance, so that "
    "only gross errors break them."
)
def honest(
    *,
    only: Problems = None,
    kind: Annotated[list[str] | None, several("Only this kind of data.")] = None,
    seeds: Annotated[int, Count(40, 4, "Twins of each problem.")],
    workers: Workers = None,
    quick: bool = False,
) -> Outcome:
    """Count how often intervals contain truths from another code on another mesh.

    Example:  python -m benchmarks honest --only rod --kind white --seeds 10
    """
    from benchmarks.honest import KINDS, PROBLEMS, QUICK
    from benchmarks.honest import honest as benchmark

    names = chosen(only, PROBLEMS, "problem", QUICK if quick else ())
    kinds = chosen(kind, KINDS, "kind of data")
    return benchmark(names, kinds, seeds=seeds, workers=workers, progress=True)


@program.command(quick="Few priors: a single one that misses the best cost breaks the bound.")
def refit(
    *,
    only: Annotated[list[str] | None, several("Only this problem, or jumps.")] = None,
    seeds: Annotated[int, Count(24, 4, "Priors of each problem; half as many truths with jumps.")],
    workers: Workers = None,
) -> Outcome:
    """Fit stored samples from distant priors, and compare with the best known fit.

    Example:  python -m benchmarks refit --only column --seeds 8
    """
    from benchmarks.refit import PARTS
    from benchmarks.refit import refit as benchmark

    return benchmark(chosen(only, PARTS, "problem"), seeds=seeds, workers=workers, progress=True)


@program.command(quick="No difference: all parts together take less than five minutes.")
def silent(
    *,
    only: Annotated[list[str] | None, several("Only this part.")] = None,
    workers: Workers = None,
) -> Outcome:
    """Check results that were once silently wrong against independent computations.

    Example:  python -m benchmarks silent --only smoother
    """
    from benchmarks.silent import PARTS
    from benchmarks.silent import silent as benchmark

    return benchmark(chosen(only, PARTS, "part", PARTS), workers, progress=True)


@program.command(name="first-hour", quick="Two truths of each walk.")
def first_hour(
    *,
    seeds: Annotated[int, Count(20, 2, "Truths of each walk.")],
    only: Annotated[list[str] | None, several("Only this walk.")] = None,
    wrong: Annotated[
        bool, typer.Option("--wrong", help="Corrupt one channel of each table.")
    ] = False,
) -> Outcome:
    """Count how often the walks of docs/first-hour.md recover truths from another code.

    With --wrong, one channel is late, scaled, exchanged or in degrees Fahrenheit. The runs must
    not be trusted, and should name this channel first.

    Example:  python -m benchmarks first-hour --only pumping --seeds 4
    """
    from benchmarks.first_hour import WALKS
    from benchmarks.first_hour import first_hour as benchmark
    from benchmarks.wrong_channels import FAULTS, wrong_channels

    if wrong:
        known = tuple(dict.fromkeys(fault.walk for fault in FAULTS))
        walks = chosen(only, known, "walk", known)
        faults = [fault for fault in FAULTS if fault.walk in walks]
        return wrong_channels(faults, seeds=seeds, progress=True)
    return benchmark(tuple(chosen(only, WALKS, "walk", WALKS)), seeds=seeds, progress=True)


@program.command(quick="Two wrong cases.")
def compared(
    *,
    seeds: Annotated[int, Count(2, 1, "Truths of each wrong case.")],
    quick: bool = False,
    workers: Workers = None,
) -> Outcome:
    """Count how often `livepde compare` corrects a wrong case without a hint.

    Example:  python -m benchmarks compared --seeds 1
    """
    from benchmarks.compared import QUICK, WRONGS
    from benchmarks.compared import compared as benchmark

    wrongs = QUICK if quick else WRONGS
    return benchmark(wrongs, seeds=seeds, workers=workers, progress=True)


@program.command(
    quick="One jump up, one down and one calm run of each process, and one data set for each "
    "wrong model. Two false alarms break the bound; with all runs, five do."
)
def alarms(
    seeds: Annotated[int, Count(5, 1, "Jumps up and jumps down, each.")], quick: bool = False
) -> Outcome:
    """Measure detection delays of jumps, false alarms, and detection of wrong models.

    Example:  python -m benchmarks alarms --seeds 3
    """
    from benchmarks.alarms import alarms as benchmark

    return benchmark(seeds, few=quick, progress=True)


@program.command(
    quick="One data set with 1 % noise of the problems seed, seed-excited and heat2d: the error of "
    "a single draw, not a median."
)
def accuracy(
    *,
    only: Problems = None,
    level: Levels = None,
    seeds: Annotated[int, Count(3, 1, "Data sets for each noise level.")],
    quick: bool = False,
) -> Outcome:
    """Compare errors of our laws with an offline fit of all data, at several noise levels.

    Example:  python -m benchmarks accuracy --only wall --seeds 5
    """
    from benchmarks.accuracy import accuracy as benchmark
    from benchmarks.problems import PROBLEMS

    default = ["seed", "seed-excited", "heat2d"] if quick else []
    levels = level or ([0.01] if quick else None)
    names = chosen(only, PROBLEMS, "problem", default)
    return benchmark(names, seeds, levels=levels, progress=True)


@program.command(quick="One data set of the rod: the error of a single draw, not a mean.")
def peers(
    *,
    only: Problems = None,
    level: Levels = None,
    seeds: Annotated[int, Count(4, 1, "Data sets for each noise level.")],
    row: Annotated[list[str] | None, several("Only this estimator.")] = None,
    quick: bool = False,
) -> Outcome:
    """Compare our laws with ensemble and other filters, and with other packages if installed.

    Example:  python -m benchmarks peers --only rod --seeds 16
    """
    from benchmarks.peers import PROBLEMS, ROWS
    from benchmarks.peers import peers as benchmark

    names = chosen(only, PROBLEMS, "problem", ["rod"] if quick else [])
    rows = chosen(row, ROWS, "row")
    return benchmark(names, seeds, levels=level or [0.01], rows=rows, progress=True)


@program.command(quick="Few kills of short runs, which do not cover every phase of a run.")
def faults(
    kills: Annotated[int, Count(600, 6, "Kills in total, with file, standard input and broker.")],
    samples: Annotated[int, Count(2000, 400, "Samples of each killed run.", least=50)],
    malformed: Annotated[int, Count(100_000, 2000, "Broken rows and messages.")],
    flips: Annotated[int, Count(200, 20, "Damaged journals.")],
    seed: Annotated[int, typer.Option(help="Seed of the random numbers.")] = 0,
    only: Annotated[
        list[str] | None,
        several(
            "One of file, stdin, mqtt, progress, sigterm, restart, disk, malformed, messages, "
            "journals, files, clocks, visitors, cases."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Runs killed in parallel.")] = 1,
) -> Outcome:
    """Kill runs, stop their sources, feed them broken rows, damage their journals and clocks.

    Example:  python -m benchmarks faults --kills 20 --only file
    """
    from benchmarks.faults import PARTS
    from benchmarks.faults import faults as benchmark

    parts = chosen(only, PARTS, "part")
    return benchmark(kills, samples, malformed, flips, seed, parts, workers, progress=True)


@program.command(quick="One run instead of five, so that there is no median.")
def journal(quick: bool = False) -> Outcome:
    """Measure the cost of the journal relative to a step of the soil case.

    Example:  python -m benchmarks journal --json
    """
    from benchmarks.journal import journal as benchmark

    return benchmark(repetitions=1 if quick else None)


@program.command(quick="Five problems and few runs: a single false alarm breaks the bound.")
def census(
    *,
    only: Problems = None,
    fault: Annotated[list[str] | None, several("Only this fault.")] = None,
    seeds: Annotated[int, Count(4, 1, "Runs of each fault and problem.")],
    sound: Annotated[int, Count(40, 6, "Runs of each problem without a fault.")],
    workers: Workers = None,
    quick: bool = False,
) -> Outcome:
    """Count how often faulty runs report a fault and its cause, and correct runs report none.

    Example:  python -m benchmarks census --only rod --seeds 2 --sound 3
    """
    from benchmarks.census import FAULTS, PROBLEMS, QUICK
    from benchmarks.census import census as benchmark

    names = chosen(only, PROBLEMS, "problem", QUICK if quick else PROBLEMS)
    wrong = chosen(fault, FAULTS, "fault")
    return benchmark(names, wrong, seeds, sound, workers=workers, progress=True)


@program.command(
    quick="One month, with a tenth as many samples retained: slow leaks and slowdowns are not "
    "detected."
)
def soak(
    months: Annotated[int, Count(24, 1, "Number of months, with a row each minute.")],
    quick: bool = False,
) -> Outcome:
    """Run for months with weekly faults of each kind: memory and step time must not grow.

    The run is a number of whole weeks, so that its last fault ends before it does.

    Example:  python -m benchmarks soak --months 2 --json
    """
    from benchmarks.soak import MONTH, WEEK
    from benchmarks.soak import soak as benchmark

    weeks = round(months * MONTH / WEEK)
    return benchmark(weeks * WEEK, share=0.1 if quick else 1.0, progress=True)


@program.command(quick="Only the first samples.")
def fmu(
    case: Annotated[
        Path | None,
        typer.Argument(help="The case file (TOML). Default: the case that livepde init writes."),
    ] = None,
    unit: Annotated[
        Path | None,
        typer.Option(help="The unit of the case. Default: a new unit is written."),
    ] = None,
    fmi: Annotated[Standard, typer.Option(help="Version of the standard: FMI 2.0 or 3.0.")] = (
        Standard.two
    ),
    samples: Annotated[
        int | None,
        typer.Option(min=1, help="Number of samples. Default all, with --quick 60."),
    ] = None,
    quick: bool = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> Outcome:
    """Run a case as a co-simulation unit (FMU, with FMPy) and in Python, and compare the outputs.

    Example:  python -m benchmarks fmu mycase/case.toml --unit rod.fmu
    """
    from benchmarks.fmu import fmu as benchmark

    loaded = None if case is None else load_case(case, allow_code, settings)
    count = samples or (60 if quick else None)
    version: Literal[2, 3] = 2 if fmi is Standard.two else 3
    return benchmark(loaded, unit, fmi=version, samples=count, progress=True)


def _both(one: Outcome, other: Outcome) -> Outcome:
    """Return the combined tables, checks and notes of two outcomes."""
    return replace(
        one,
        tables=[*one.tables, *other.tables],
        checks=[*one.checks, *other.checks],
        notes=[*one.notes, *other.notes],
    )


if __name__ == "__main__":
    sys.exit(main(app))
