"""Benchmarks: each a command with its own options."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from livepde.cli import main
from livepde.cli.export import Standard
from livepde.cli.options import CodeOption, JsonOption, SetOption, load_case
from livepde.cli.printing import can_draw, named, report_outcome, terminal

if TYPE_CHECKING:
    from livepde.runs.outcome import Outcome

__all__ = ["app"]

app = typer.Typer(
    name="benchmarks",
    help="""Measure what things cost, as ratios that hold on any machine, and what they find.

    With --quick each runs its checks on fewer seeds and smaller sizes, in less than two minutes on
    two cores. An option that is given wins over the value of --quick.

    Example:  python -m benchmarks step""",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


class Count(NamedTuple):
    """Values of an option that is not given: the usual one, and that of --quick."""

    usual: int
    quick: int

    def option(self, what: str, least: int = 1) -> Any:
        """Return the option."""
        return typer.Option(min=least, help=f"{what} With --quick {self.quick}.")

    def of(self, context: typer.Context, name: str) -> int:
        """Return the value that is taken."""
        value: int = context.params[name]
        return value if not context.params["quick"] or _is_given(context, name) else self.quick


@app.command()
def step(
    context: typer.Context,
    size: Annotated[
        list[int] | None,
        typer.Option(
            min=5,
            help="Number of nodes, default 31, 1000, 10000 and 100000, with --quick 31 and 10000. "
            "Repeat for more.",
        ),
    ] = None,
    modes: Annotated[
        list[int] | None,
        typer.Option(
            min=1,
            help="Unknowns of the sensitivity law, default 1, 10 and 50, with --quick 1 and 10. "
            "Repeat for more.",
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Two sizes; of the rods those with 31 nodes, so that bounds of longer rods and of "
            "the square with numbers are not checked.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Time a step of each law against one forward step of the same model.

    Example:  python -m benchmarks step --size 1000 --json
    """
    from benchmarks.rods import RODS, rods
    from benchmarks.step import MODES, QUICK_MODES, QUICK_SIZES, SIZES
    from benchmarks.step import step as benchmark

    sizes = size or (QUICK_SIZES if quick else SIZES)
    timed = size or (QUICK_SIZES[:1] if quick else ())
    filters = rods([rod for rod in RODS if not timed or rod.nodes in timed])
    laws = benchmark(sizes, modes or (QUICK_MODES if quick else MODES))
    _report(context, _both(laws, filters), as_json)


ROUNDS = Count(15, 3)


@app.command("import")
def startup(
    context: typer.Context,
    rounds: Annotated[int, ROUNDS.option("Fresh processes of each.")] = ROUNDS.usual,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer processes.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Time the import of livepde, in fresh processes, against that of SciPy and scikit-fem.

    Example:  python -m benchmarks import --json
    """
    from benchmarks.startup import startup as benchmark

    _report(context, benchmark(ROUNDS.of(context, "rounds")), as_json)


PAIRS = Count(5, 1)


@app.command()
def overhead(
    context: typer.Context,
    rounds: Annotated[int, PAIRS.option("Fresh processes, and pairs of runs.")] = PAIRS.usual,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="One process and one pair of runs, whose slow moments count."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Time what the command line adds: to the first estimate, and to each sample of a rod.

    Example:  python -m benchmarks overhead --json
    """
    from benchmarks.overhead import overhead as benchmark

    _report(context, benchmark(PAIRS.of(context, "rounds")), as_json)


MEMBERS, DIRECTORIES = Count(1000, 200), Count(25, 8)


@app.command()
def fleet(
    context: typer.Context,
    members: Annotated[int, MEMBERS.option("How many rods step.")] = MEMBERS.usual,
    runs: Annotated[
        int,
        DIRECTORIES.option("Rods of which run directories are made; 0 for none.", least=0),
    ] = DIRECTORIES.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Fewer rods: the less of them, the less a fleet saves, and the more the start of "
            "a command weighs, so that bounds on times may be missed that 1000 rods keep.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Time a fleet of rods against as many separate identifiers: a step, and the command.

    Example:  python -m benchmarks fleet --json
    """
    from benchmarks.fleet import fleet as benchmark
    from benchmarks.rods import fleet as rods

    separate = benchmark(MEMBERS.of(context, "members"), DIRECTORIES.of(context, "runs"))
    _report(context, _both(separate, rods()), as_json)


LIVE, DEATHS = Count(10_000, 2000), Count(20, 4)


@app.command()
def shard(
    context: typer.Context,
    members: Annotated[int, LIVE.option("How many rods are live.")] = LIVE.usual,
    kills: Annotated[int, DEATHS.option("How often a worker is killed.")] = DEATHS.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Fewer rods, of which the memory of 10 000 is extrapolated; few kills."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure live shards of rods: memory, time of a sample, and kills of their workers.

    Example:  python -m benchmarks shard --json
    """
    from benchmarks.shard import shard as benchmark

    outcome = benchmark(LIVE.of(context, "members"), DEATHS.of(context, "kills"))
    _report(context, outcome, as_json)


STORED = Count(8000, 2000)


@app.command()
def replay(
    context: typer.Context,
    samples: Annotated[int, STORED.option("Samples of the run.", least=100)] = STORED.usual,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer samples.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Time the longest call while stored samples are assimilated again.

    Example:  python -m benchmarks replay --samples 2000
    """
    from benchmarks.replay import replay as benchmark

    _report(context, benchmark(STORED.of(context, "samples")), as_json)


LOOPS = Count(5, 1)


@app.command()
def control(
    context: typer.Context,
    only: Annotated[
        list[str] | None, typer.Option(help="Only this problem. Repeat it for more.")
    ] = None,
    seeds: Annotated[int, LOOPS.option("Runs of each kind.")] = LOOPS.usual,
    draw: Annotated[Path | None, typer.Option(help="Folder for a figure of each problem.")] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="One seed, the rod alone, and of the moving horizon the first setting on the "
            "reduced model, in 0.6 of the time: a horizon that is not tuned, and the worst of one "
            "seed, say less.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Hold control with livepde against true and wrong models and a moving horizon.

    Example:  python -m benchmarks control --only rod --seeds 2
    """
    from benchmarks.control import PROBLEMS
    from benchmarks.control import control as benchmark

    for name in only or ():
        named(name, PROBLEMS, "problem")
    chosen = only or (["rod"] if quick else None)
    outcome = benchmark(chosen, LOOPS.of(context, "seeds"), short=quick, progress=True)
    if draw is not None and can_draw(terminal(err=True)):
        draw.mkdir(parents=True, exist_ok=True)
        for name, figure in outcome.figures.items():
            figure().savefig(draw / f"{name}.png", dpi=110)
    _report(context, outcome, as_json)


@app.command()
def scale(
    context: typer.Context,
    size: Annotated[
        list[int] | None,
        typer.Option(
            min=2500,
            help="Nodes of the square, default 10000 and 100000, with --quick 2500 and 10000. "
            "Repeat for more.",
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
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Small squares, where a step of the law costs more forward steps than on large "
            "ones: the exponent is theirs.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Time a step of the gradient law for large fields against one forward step.

    Example:  python -m benchmarks scale --size 100000 --gain 100
    """
    from benchmarks import scale as benchmark

    if million:
        _report(context, benchmark.million(), as_json)
        return
    sizes = size or (benchmark.COUNTED if quick else benchmark.SIZES)
    outcome = benchmark.scale(sizes, gain or benchmark.GAINS, cube or ())
    _report(context, outcome, as_json)


DATA_SETS = Count(5, 1)


@app.command()
def auto(
    context: typer.Context,
    size: Annotated[
        list[int] | None,
        typer.Option(
            min=25,
            help="Nodes of the square, default 64 to 10000, with --quick 64. Repeat for more.",
        ),
    ] = None,
    seeds: Annotated[int, DATA_SETS.option("Data sets for each noise.")] = DATA_SETS.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Only the smallest square, one data set, and the smallest cost."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check what the gradient law that tunes itself promises: its errors and its cost.

    Example:  python -m benchmarks auto --quick
    """
    from benchmarks.auto import COSTS, SIZES
    from benchmarks.auto import auto as benchmark

    sizes = size or (SIZES[:1] if quick else SIZES)
    costs = (min(COSTS),) if quick else tuple(COSTS)
    _report(context, benchmark(sizes, DATA_SETS.of(context, "seeds"), costs), as_json)


NODES, TIMED = Count(100_000, 3000), Count(6, 2)


@app.command()
def petsc(
    context: typer.Context,
    size: Annotated[int, NODES.option("Number of nodes.", least=2500)] = NODES.usual,
    ranks: Annotated[
        list[int] | None,
        typer.Option(min=1, help="Number of ranks, default 1 and 2. Repeat for more."),
    ] = None,
    samples: Annotated[int, TIMED.option("Samples that are timed.")] = TIMED.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Few nodes: q is compared, and costs are too small for their bounds."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Time both laws on PETSc vectors against a forward step, and their scaling on several ranks.

    Example:  python -m benchmarks petsc --size 100000
    """
    from benchmarks.petsc import petsc as benchmark

    nodes, steps = NODES.of(context, "size"), TIMED.of(context, "samples")
    _report(context, benchmark(nodes, ranks or (1, 2), steps), as_json)


@app.command()
def cases(
    context: typer.Context,
    only: Annotated[
        list[str] | None, typer.Option(help="Only this case. Repeat it for more.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where the cases are. Default: the next folder 'cases'.")
    ] = None,
    gallery: Annotated[
        Path | None, typer.Option(help="Folder for a page with tables and figures.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="A case of each kind of process, without its variants; with --folder all of its "
            "cases.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run every case of the project with its variants, and the code that they name.

    Example:  python -m benchmarks cases --only soil_layers --json
    """
    from benchmarks import cases as benchmark

    known = {path.stem: path for path in benchmark.find_cases(folder)}
    chosen = only or (benchmark.QUICK if quick and folder is None else known)
    paths = [named(name, known, "case") for name in chosen]
    pictures = None
    if gallery is not None:
        gallery.mkdir(parents=True, exist_ok=True)
        pictures = gallery if can_draw(terminal(err=True)) else None
    outcome, runs = benchmark.bench_cases(
        paths, progress=True, pictures=pictures, variants=not quick
    )
    if gallery is not None:
        page = benchmark.gallery(runs, gallery)
        terminal(err=True).print(f"Gallery: {page}", soft_wrap=True)
    _report(context, outcome, as_json)


TWINS = Count(200, 20)


@app.command()
def coverage(
    context: typer.Context,
    twins: Annotated[int, TWINS.option("How many twins of each problem.")] = TWINS.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Fewer twins: bounds are those of the share of 200, and that of 20 misses some "
            "of them by chance.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Count how often the truth lies in the intervals that are reported.

    Example:  python -m benchmarks coverage --twins 20
    """
    from benchmarks.coverage import coverage as benchmark

    _report(context, benchmark(TWINS.of(context, "twins"), progress=True), as_json)


HONEST = Count(40, 4)
WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="Processes, default one for each processor.")
]


@app.command()
def honest(
    context: typer.Context,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Only this problem. Repeat it for more.")
    ] = None,
    kind: Annotated[
        list[str] | None, typer.Option("--kind", help="Only this kind of data. Repeat for more.")
    ] = None,
    seeds: Annotated[int, HONEST.option("Twins of each problem.")] = HONEST.usual,
    workers: WorkersOption = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Few twins of the problems that cost least: bounds of coverage are those that "
            "chance keeps, so that they see gross errors alone.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Count how often intervals hold when the truth comes from another code on another mesh.

    Example:  python -m benchmarks honest --only rod --kind white --seeds 10
    """
    from benchmarks.honest import KINDS, PROBLEMS, QUICK
    from benchmarks.honest import honest as benchmark

    for given, known, what in ((only, PROBLEMS, "problem"), (kind, KINDS, "kind of data")):
        for name in given or ():
            named(name, known, what)
    chosen = only or (QUICK if quick else ())
    count = HONEST.of(context, "seeds")
    found = benchmark(chosen, kind or (), seeds=count, workers=workers, progress=True)
    _report(context, found, as_json)


WALKS = Count(20, 2)


@app.command("first-hour")
def first_hour(
    context: typer.Context,
    seeds: Annotated[int, WALKS.option("Truths of each walk.")] = WALKS.usual,
    quick: Annotated[bool, typer.Option("--quick", help="Two truths of each walk.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Count how often the walks of docs/first-hour.md find truths of another code.

    Example:  python -m benchmarks first-hour --seeds 4
    """
    from benchmarks.first_hour import first_hour as benchmark

    _report(context, benchmark(seeds=WALKS.of(context, "seeds"), progress=True), as_json)


JUMPS = Count(5, 1)


@app.command()
def alarms(
    context: typer.Context,
    seeds: Annotated[int, JUMPS.option("Jumps up, and as many down, of each.")] = JUMPS.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Of each process one jump up, one down and one calm run, and one data set for "
            "each wrong model: two false alarms are more than the bound, with all runs five are.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure how soon jumps are flagged, how seldom without cause, and which models are doubted.

    Example:  python -m benchmarks alarms --seeds 3
    """
    from benchmarks.alarms import alarms as benchmark

    _report(context, benchmark(JUMPS.of(context, "seeds"), few=quick, progress=True), as_json)


ProblemsOption = Annotated[
    list[str] | None, typer.Option("--only", help="Only this problem. Repeat it for more.")
]
LevelsOption = Annotated[
    list[float] | None,
    typer.Option(
        "--level", min=0.0, max=1.0, help="Noise over the data's root mean square. Repeat for more."
    ),
]
REPEATS, AGAIN = Count(3, 1), Count(4, 1)


@app.command()
def accuracy(
    context: typer.Context,
    only: ProblemsOption = None,
    level: LevelsOption = None,
    seeds: Annotated[int, REPEATS.option("Data sets for each noise level.")] = REPEATS.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="One data set, 1 % noise, the problems seed, seed-excited and heat2d: an error of "
            "one draw, not a median.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Hold our laws against what all data together can tell, at several noise levels.

    Example:  python -m benchmarks accuracy --only wall --seeds 5
    """
    from benchmarks.accuracy import accuracy as benchmark
    from benchmarks.problems import PROBLEMS

    for name in only or ():
        named(name, PROBLEMS, "problem")
    chosen = only or (["seed", "seed-excited", "heat2d"] if quick else [])
    levels = level or ([0.01] if quick else None)
    outcome = benchmark(chosen, REPEATS.of(context, "seeds"), levels=levels, progress=True)
    _report(context, outcome, as_json)


@app.command()
def peers(
    context: typer.Context,
    only: ProblemsOption = None,
    level: LevelsOption = None,
    seeds: Annotated[int, AGAIN.option("Data sets for each noise level.")] = AGAIN.usual,
    row: Annotated[
        list[str] | None, typer.Option(help="Only this estimator. Repeat it for more.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="One data set of the rod: an error of one draw, not a mean."),
    ] = False,
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
    chosen = only or (["rod"] if quick else [])
    count = AGAIN.of(context, "seeds")
    outcome = benchmark(chosen, count, levels=level or [0.01], rows=row or (), progress=True)
    _report(context, outcome, as_json)


KILLS, LENGTH, BROKEN = Count(600, 6), Count(2000, 400), Count(100_000, 2000)
FLIPS = Count(200, 20)


@app.command()
def faults(
    context: typer.Context,
    kills: Annotated[
        int, KILLS.option("Kills in all, over a file, standard input and a broker.")
    ] = KILLS.usual,
    samples: Annotated[
        int, LENGTH.option("Samples of a run that is killed.", least=50)
    ] = LENGTH.usual,
    malformed: Annotated[int, BROKEN.option("Broken rows and messages.")] = BROKEN.usual,
    flips: Annotated[int, FLIPS.option("Damaged journals.")] = FLIPS.usual,
    seed: Annotated[int, typer.Option(help="Of what is drawn at random.")] = 0,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="One of file, stdin, mqtt, restart, disk, malformed, messages, journals, clocks, "
            "visitors, cases. Repeat it."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Runs that are killed at a time.")] = 1,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Few kills of short runs: not every moment of a run is among them."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Kill runs, take their sources away, feed them broken rows, damage their journals and clocks.

    Example:  python -m benchmarks faults --kills 20 --only file
    """
    from benchmarks.faults import PARTS
    from benchmarks.faults import faults as benchmark

    for name in only or ():
        named(name, PARTS, "part")
    outcome = benchmark(
        KILLS.of(context, "kills"),
        LENGTH.of(context, "samples"),
        BROKEN.of(context, "malformed"),
        FLIPS.of(context, "flips"),
        seed,
        only or (),
        workers,
        progress=True,
    )
    _report(context, outcome, as_json)


@app.command()
def journal(
    context: typer.Context,
    quick: Annotated[
        bool, typer.Option("--quick", help="One run in the place of five: no median.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure what the journal costs: its share of a step of the soil case.

    Example:  python -m benchmarks journal --json
    """
    from benchmarks.journal import journal as benchmark

    _report(context, benchmark(repetitions=1 if quick else None), as_json)


FAULTY, SOUND = Count(4, 1), Count(40, 6)


@app.command()
def census(
    context: typer.Context,
    only: ProblemsOption = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="Only this fault. Repeat it for more.")
    ] = None,
    seeds: Annotated[int, FAULTY.option("Runs of each fault and problem.")] = FAULTY.usual,
    sound: Annotated[int, SOUND.option("Runs of each problem with nothing wrong.")] = SOUND.usual,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes, default one for each processor.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Five problems, few runs: one false alarm is too many.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Count how often runs that are wrong say so, name the cause, and sound ones keep quiet.

    Example:  python -m benchmarks census --only rod --seeds 2 --sound 3
    """
    from benchmarks.census import FAULTS, PROBLEMS, QUICK
    from benchmarks.census import census as benchmark

    for name in only or ():
        named(name, dict.fromkeys(PROBLEMS), "problem")
    for name in fault or ():
        named(name, FAULTS, "fault")
    outcome = benchmark(
        only or (QUICK if quick else PROBLEMS),
        fault or (),
        FAULTY.of(context, "seeds"),
        SOUND.of(context, "sound"),
        workers=workers,
        progress=True,
    )
    _report(context, outcome, as_json)


STEPS = Count(1_000_000, 20_000)


@app.command()
def soak(
    context: typer.Context,
    steps: Annotated[int, STEPS.option("How many steps.")] = STEPS.usual,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Fewer steps, of which a tenth as many are retained: a leak or a slowdown that "
            "shows in a million steps only is not seen.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run for very long: memory, time of a step and the journal's size must not grow.

    Example:  python -m benchmarks soak --steps 100000 --json
    """
    from benchmarks.soak import soak as benchmark

    share = 0.1 if quick else 1.0
    _report(context, benchmark(STEPS.of(context, "steps"), share=share, progress=True), as_json)


@app.command()
def fmu(
    context: typer.Context,
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
    quick: Annotated[bool, typer.Option("--quick", help="The first samples only.")] = False,
    as_json: JsonOption = False,
    allow_code: CodeOption = False,
    settings: SetOption = None,
) -> None:
    """Run a case as a co-simulation unit (FMU, by FMPy) and in Python, and compare all outputs.

    Example:  python -m benchmarks fmu mycase/case.toml --unit rod.fmu
    """
    from benchmarks.fmu import fmu as benchmark

    loaded = None if case is None else load_case(case, allow_code, settings)
    count = samples or (60 if quick else None)
    version: Literal[2, 3] = 2 if fmi is Standard.two else 3
    outcome = benchmark(loaded, unit, fmi=version, samples=count, progress=True)
    _report(context, outcome, as_json)


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _report(context: typer.Context, outcome: Outcome, as_json: bool) -> None:
    """Print an outcome with its command: with all numbers, those of --quick aside; no paths."""
    words = ["python", "-m", "benchmarks", context.command.name or ""]
    for option in context.command.params:
        name, flag = option.name or "", max(option.opts, key=len)
        value = context.params.get(name)
        told = _is_given(context, name) or not context.params["quick"]
        if name == "as_json" or value is None or isinstance(value, Path) or not told:
            continue
        if isinstance(value, bool):
            words += [flag] if value else []
            continue
        for item in value if isinstance(value, list | tuple) else [value]:
            words += [flag, f"{item:g}" if isinstance(item, float) else str(item)]
    report_outcome(outcome, words, as_json)


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
