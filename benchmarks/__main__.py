"""Benchmarks: each a command with its own options."""

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
    """Measure what things cost, as ratios that hold on any machine, and what they find.

    With --quick each runs its checks on fewer seeds and smaller sizes, in less than two minutes on
    two cores. An option that is given wins over the value of --quick.

    Example:  python -m benchmarks step""",
)
app = program.app

Problems = Annotated[list[str] | None, several("Only this problem.", "--only")]
Levels = Annotated[
    list[float] | None,
    several("Noise over the data's root mean square.", "--level", min=0.0, max=1.0),
]


@program.command(
    quick="Two sizes; of the rods those with 31 nodes, so that bounds of longer rods and of the "
    "square with numbers are not checked."
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
            "Unknowns of the sensitivity law, default 1, 10 and 50, with --quick 1 and 10.", min=1
        ),
    ] = None,
    quick: bool = False,
) -> Outcome:
    """Time a step of each law against one forward step of the same model.

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


@program.command(quick="One round of the rod and of the column.")
def jobs(
    only: Annotated[list[str] | None, several("Only this job.", "--only")] = None,
    rounds: Annotated[int, Count(3, 1, "Runs of each job and of its fit.")] = 3,
    quick: bool = False,
) -> Outcome:
    """Time whole runs against fits that a user would write, at equal error.

    Example:  python -m benchmarks jobs --only rod --json
    """
    from benchmarks.user_jobs.report import QUICK, user_jobs

    return user_jobs(only or (QUICK if quick else ()), rounds)


@program.command(name="import", quick="Fewer processes.")
def startup(rounds: Annotated[int, Count(15, 3, "Fresh processes of each.")]) -> Outcome:
    """Time the import of livepde, in fresh processes, against that of SciPy and scikit-fem.

    Example:  python -m benchmarks import --json
    """
    from benchmarks.startup import startup as benchmark

    return benchmark(rounds)


@program.command(quick="One process and one pair of runs, whose slow moments count.")
def overhead(
    rounds: Annotated[int, Count(5, 1, "Fresh processes, and pairs of runs.")],
) -> Outcome:
    """Time what the command line adds: to the first estimate, and to each sample of a rod.

    Example:  python -m benchmarks overhead --json
    """
    from benchmarks.overhead import overhead as benchmark

    return benchmark(rounds)


@program.command(
    quick="Fewer rods: the less of them, the less a fleet saves, and the more the start of a "
    "command weighs, so that bounds on times may be missed that 1000 rods keep."
)
def fleet(
    members: Annotated[int, Count(1000, 200, "How many rods step.")],
    runs: Annotated[
        int, Count(25, 8, "Rods of which run directories are made; 0 for none.", least=0)
    ],
) -> Outcome:
    """Time a fleet of rods against as many separate identifiers: a step, and the command.

    Example:  python -m benchmarks fleet --json
    """
    from benchmarks.fleet import fleet as benchmark
    from benchmarks.rods import fleet as rods

    return _both(benchmark(members, runs), rods())


@program.command(
    quick="Fewer rods, of which the memory of 10 000 is extrapolated; few kills.",
)
def shard(
    members: Annotated[int, Count(10_000, 2000, "How many rods are live.")],
    kills: Annotated[int, Count(20, 4, "How often a worker is killed.")],
) -> Outcome:
    """Measure live shards of rods: memory, time of a sample, and kills of their workers.

    Example:  python -m benchmarks shard --json
    """
    from benchmarks.shard import shard as benchmark

    return benchmark(members, kills)


@program.command(
    quick="One seed, the rod alone, and of the moving horizon the first setting on the reduced "
    "model, in 0.6 of the time: a horizon that is not tuned, and the worst of one seed, say less."
)
def control(
    *,
    only: Problems = None,
    seeds: Annotated[int, Count(5, 1, "Runs of each kind.")],
    draw: Annotated[Path | None, typer.Option(help="Folder for a figure of each problem.")] = None,
    quick: bool = False,
) -> Outcome:
    """Hold control with livepde against true and wrong models and a moving horizon.

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
    quick="Small squares, where a step of the law costs more forward steps than on large ones: "
    "the exponent is theirs."
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
        bool, typer.Option(help="Only the run with a million nodes: 100 steps, minutes, 3 GB.")
    ] = False,
    quick: bool = False,
) -> Outcome:
    """Time a step of the gradient law for large fields against one forward step.

    Example:  python -m benchmarks scale --size 100000 --gain 100
    """
    from benchmarks import scale as benchmark

    if million:
        return benchmark.million()
    sizes = size or (benchmark.COUNTED if quick else benchmark.SIZES)
    return benchmark.scale(sizes, gain or benchmark.GAINS, cube or ())


@program.command(
    quick="The smallest square, one data set, the smallest cost, one reaction on partial data."
)
def auto(
    *,
    size: Annotated[
        list[int] | None,
        several("Nodes of the square, default 64 to 10000, with --quick 64.", min=25),
    ] = None,
    seeds: Annotated[int, Count(5, 1, "Data sets for each noise.")],
    quick: bool = False,
) -> Outcome:
    """Check what the gradient law that tunes itself promises: its errors and its cost.

    Example:  python -m benchmarks auto --quick
    """
    from benchmarks.auto import COSTS, SIZES
    from benchmarks.auto import auto as benchmark
    from benchmarks.partial import LEVELS, PROCESSES

    sizes = size or (SIZES[:1] if quick else SIZES)
    costs = (min(COSTS),) if quick else tuple(COSTS)
    reactions = tuple(PROCESSES)[: 1 if quick else None]
    return benchmark(sizes, seeds, costs, reactions, LEVELS[-1:] if quick else LEVELS)


@program.command(quick="Few nodes: q is compared, and costs are too small for their bounds.")
def petsc(
    *,
    size: Annotated[int, Count(100_000, 3000, "Number of nodes.", least=2500)],
    ranks: Annotated[list[int] | None, several("Number of ranks, default 1 and 2.", min=1)] = None,
    samples: Annotated[int, Count(6, 2, "Samples that are timed.")],
) -> Outcome:
    """Time both laws on PETSc vectors against a forward step, and their scaling on several ranks.

    Example:  python -m benchmarks petsc --size 100000
    """
    from benchmarks.petsc import petsc as benchmark

    return benchmark(size, ranks or (1, 2), samples)


@program.command(
    quick="A case of each kind of process, without its variants; with --folder all of its cases."
)
def cases(
    only: Annotated[list[str] | None, several("Only this case.")] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where the cases are. Default: the next folder 'cases'.")
    ] = None,
    gallery: Annotated[
        Path | None, typer.Option(help="Folder for a page with tables and figures.")
    ] = None,
    compared: Annotated[
        int,
        typer.Option(help="Variants of livepde compare for each case on measurements.", min=0),
    ] = 0,
    quick: bool = False,
) -> Outcome:
    """Run every case of the project with its variants, and the code that they name.

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
    quick="Fewer twins: bounds are those of the share of 200, and that of 20 misses some of them "
    "by chance."
)
def coverage(twins: Annotated[int, Count(200, 20, "How many twins of each problem.")]) -> Outcome:
    """Count how often the truth lies in the intervals that are reported.

    Example:  python -m benchmarks coverage --twins 20
    """
    from benchmarks.coverage import coverage as benchmark

    return benchmark(twins, progress=True)


@program.command(
    quick="Few twins of the problems that cost least: bounds of coverage are those that chance "
    "keeps, so that they see gross errors alone."
)
def honest(
    *,
    only: Problems = None,
    kind: Annotated[list[str] | None, several("Only this kind of data.")] = None,
    seeds: Annotated[int, Count(40, 4, "Twins of each problem.")],
    workers: Workers = None,
    quick: bool = False,
) -> Outcome:
    """Count how often intervals hold when the truth comes from another code on another mesh.

    Example:  python -m benchmarks honest --only rod --kind white --seeds 10
    """
    from benchmarks.honest import KINDS, PROBLEMS, QUICK
    from benchmarks.honest import honest as benchmark

    names = chosen(only, PROBLEMS, "problem", QUICK if quick else ())
    kinds = chosen(kind, KINDS, "kind of data")
    return benchmark(names, kinds, seeds=seeds, workers=workers, progress=True)


@program.command(quick="Few priors: one that misses the best cost breaks the bound on their share.")
def refit(
    *,
    only: Annotated[list[str] | None, several("Only this problem, or jumps.")] = None,
    seeds: Annotated[int, Count(24, 4, "Priors of each problem, and twice the truths with jumps.")],
    workers: Workers = None,
) -> Outcome:
    """Fit stored samples from far priors, and compare with the best known fit.

    Example:  python -m benchmarks refit --only column --seeds 8
    """
    from benchmarks.refit import PARTS
    from benchmarks.refit import refit as benchmark

    return benchmark(chosen(only, PARTS, "problem"), seeds=seeds, workers=workers, progress=True)


@program.command(quick="The same: all parts together take less than five minutes.")
def silent(
    *,
    only: Annotated[list[str] | None, several("Only this part.")] = None,
    workers: Workers = None,
) -> Outcome:
    """Check results that were once wrong without a word against separate computations.

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
        bool, typer.Option("--wrong", help="One channel of each table is wrong.")
    ] = False,
) -> Outcome:
    """Count how often the walks of docs/first-hour.md find truths of another code.

    With --wrong one channel is late, scaled, exchanged or in degrees Fahrenheit: whether the runs
    are not trusted, and name it first.

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
    """Count how often `livepde compare` turns a wrong case into a right one without a hint.

    Example:  python -m benchmarks compared --seeds 1
    """
    from benchmarks.compared import QUICK, WRONGS
    from benchmarks.compared import compared as benchmark

    wrongs = QUICK if quick else WRONGS
    return benchmark(wrongs, seeds=seeds, workers=workers, progress=True)


@program.command(
    quick="Of each process one jump up, one down and one calm run, and one data set for each "
    "wrong model: two false alarms are more than the bound, with all runs five are."
)
def alarms(
    seeds: Annotated[int, Count(5, 1, "Jumps up, and as many down, of each.")], quick: bool = False
) -> Outcome:
    """Measure how soon jumps are flagged, how seldom without cause, and which models are doubted.

    Example:  python -m benchmarks alarms --seeds 3
    """
    from benchmarks.alarms import alarms as benchmark

    return benchmark(seeds, few=quick, progress=True)


@program.command(
    quick="One data set, 1 % noise, the problems seed, seed-excited and heat2d: an error of one "
    "draw, not a median."
)
def accuracy(
    *,
    only: Problems = None,
    level: Levels = None,
    seeds: Annotated[int, Count(3, 1, "Data sets for each noise level.")],
    quick: bool = False,
) -> Outcome:
    """Hold our laws against what all data together can tell, at several noise levels.

    Example:  python -m benchmarks accuracy --only wall --seeds 5
    """
    from benchmarks.accuracy import accuracy as benchmark
    from benchmarks.problems import PROBLEMS

    some = ["seed", "seed-excited", "heat2d"] if quick else []
    levels = level or ([0.01] if quick else None)
    names = chosen(only, PROBLEMS, "problem", some)
    return benchmark(names, seeds, levels=levels, progress=True)


@program.command(quick="One data set of the rod: an error of one draw, not a mean.")
def peers(
    *,
    only: Problems = None,
    level: Levels = None,
    seeds: Annotated[int, Count(4, 1, "Data sets for each noise level.")],
    row: Annotated[list[str] | None, several("Only this estimator.")] = None,
    quick: bool = False,
) -> Outcome:
    """Hold our laws against filters as arrays, and other packages where they are installed.

    Example:  python -m benchmarks peers --only rod --seeds 16
    """
    from benchmarks.peers import PROBLEMS, ROWS
    from benchmarks.peers import peers as benchmark

    names = chosen(only, PROBLEMS, "problem", ["rod"] if quick else [])
    rows = chosen(row, ROWS, "row")
    return benchmark(names, seeds, levels=level or [0.01], rows=rows, progress=True)


@program.command(quick="Few kills of short runs: not every moment of a run is among them.")
def faults(
    kills: Annotated[int, Count(600, 6, "Kills in all, over a file, standard input and a broker.")],
    samples: Annotated[int, Count(2000, 400, "Samples of a run that is killed.", least=50)],
    malformed: Annotated[int, Count(100_000, 2000, "Broken rows and messages.")],
    flips: Annotated[int, Count(200, 20, "Damaged journals.")],
    seed: Annotated[int, typer.Option(help="Of what is drawn at random.")] = 0,
    only: Annotated[
        list[str] | None,
        several(
            "One of file, stdin, mqtt, progress, sigterm, restart, disk, malformed, messages, "
            "journals, files, clocks, visitors, cases."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Runs that are killed at a time.")] = 1,
) -> Outcome:
    """Kill runs, take their sources away, feed them broken rows, damage their journals and clocks.

    Example:  python -m benchmarks faults --kills 20 --only file
    """
    from benchmarks.faults import PARTS
    from benchmarks.faults import faults as benchmark

    parts = chosen(only, PARTS, "part")
    return benchmark(kills, samples, malformed, flips, seed, parts, workers, progress=True)


@program.command(quick="One run in the place of five: no median.")
def journal(quick: bool = False) -> Outcome:
    """Measure what the journal costs: its share of a step of the soil case.

    Example:  python -m benchmarks journal --json
    """
    from benchmarks.journal import journal as benchmark

    return benchmark(repetitions=1 if quick else None)


@program.command(quick="Five problems, few runs: one false alarm is too many.")
def census(
    *,
    only: Problems = None,
    fault: Annotated[list[str] | None, several("Only this fault.")] = None,
    seeds: Annotated[int, Count(4, 1, "Runs of each fault and problem.")],
    sound: Annotated[int, Count(40, 6, "Runs of each problem with nothing wrong.")],
    workers: Workers = None,
    quick: bool = False,
) -> Outcome:
    """Count how often runs that are wrong say so, name the cause, and sound ones keep quiet.

    Example:  python -m benchmarks census --only rod --seeds 2 --sound 3
    """
    from benchmarks.census import FAULTS, PROBLEMS, QUICK
    from benchmarks.census import census as benchmark

    names = chosen(only, PROBLEMS, "problem", QUICK if quick else PROBLEMS)
    wrong = chosen(fault, FAULTS, "fault")
    return benchmark(names, wrong, seeds, sound, workers=workers, progress=True)


@program.command(
    quick="One month, of which a tenth as many samples are retained: a leak or a slowdown that "
    "shows in many months only is not seen."
)
def soak(
    months: Annotated[int, Count(24, 1, "How many months, with a row each minute.")],
    quick: bool = False,
) -> Outcome:
    """Run for months with a fault of each kind a week: memory and time of a step must not grow.

    The run ends with a whole week, after the last of its faults.

    Example:  python -m benchmarks soak --months 2 --json
    """
    from benchmarks.soak import MONTH, WEEK
    from benchmarks.soak import soak as benchmark

    weeks = round(months * MONTH / WEEK)
    return benchmark(weeks * WEEK, share=0.1 if quick else 1.0, progress=True)


@program.command(quick="The first samples only.")
def fmu(
    case: Annotated[
        Path | None,
        typer.Argument(help="The case file (TOML). Default: what livepde init writes."),
    ] = None,
    unit: Annotated[
        Path | None,
        typer.Option(help="The unit of the case. Default: one that is written for the purpose."),
    ] = None,
    fmi: Annotated[Standard, typer.Option(help="Version of the standard: FMI 2.0 or 3.0.")] = (
        Standard.two
    ),
    samples: Annotated[
        int | None,
        typer.Option(min=1, help="How many of the case. Default all, with --quick 60."),
    ] = None,
    quick: bool = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> Outcome:
    """Run a case as a co-simulation unit (FMU, by FMPy) and in Python, and compare all outputs.

    Example:  python -m benchmarks fmu mycase/case.toml --unit rod.fmu
    """
    from benchmarks.fmu import fmu as benchmark

    loaded = None if case is None else load_case(case, allow_code, settings)
    count = samples or (60 if quick else None)
    version: Literal[2, 3] = 2 if fmi is Standard.two else 3
    return benchmark(loaded, unit, fmi=version, samples=count, progress=True)


def _both(one: Outcome, other: Outcome) -> Outcome:
    """Return tables, checks and notes of two benchmarks as one."""
    return replace(
        one,
        tables=[*one.tables, *other.tables],
        checks=[*one.checks, *other.checks],
        notes=[*one.notes, *other.notes],
    )


if __name__ == "__main__":
    sys.exit(main(app))
