"""Shards of rods: memory and time of many live members, kills of workers, two workers over one."""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter, process_time, sleep
from typing import Any, NamedTuple, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.fleet import NODES, NOISE, SENSORS, STEP
from livepde.atomic_write import write_bytes
from livepde.diagnostics.check_report import Check, Table
from livepde.fem import Channel, LogNormal, interval
from livepde.fleet import Shard
from livepde.laws import SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.models import heat
from livepde.observation import Points
from livepde.runs import Outcome
from livepde.stepping import Advance, simulate

SIZE = 250  # members of a shard: a step of more takes more memory at a time
TRUTHS = 20  # rods of other coefficients; each member has noise of its own
GROWN = "shard: memory of 10 000 members"
WARM = 100  # samples of each member before time and memory are taken: logs are as long as they get
TIMED = 10  # samples of each member that are timed
FEW = 100  # members of the shards whose workers are killed
BATCHES, MORE, EVERY = 60, 20, 7  # of such a shard, for each kill, and from one dump to the next
ASSETS = 10_000  # of the promises
GIGABYTES, CORE, FASTER = 0.5, 1.0, 1.5  # the promises: at most, at most, at least
PATIENCE = 600.0  # seconds for a worker
STARTED = 10  # members whose first samples are timed
LAWS = {
    "without shadows": SensitivityLaw(refit=None, shadows=None),
    "usual": SensitivityLaw(refit=None),
}

Found = TypeVar("Found")


def shard(members: int = ASSETS, kills: int = 20) -> Outcome:
    """Measure shards of rods of 100 nodes whose diffusivity is unknown, heated at one end.

    Parameters
    ----------
    members
        Rods whose memory and time of a step are measured, in shards of 250.
    kills
        How often one of two workers is killed at a random moment.
    """
    lean, usual = (_in_process(_cost, members, name) for name in LAWS)
    start = _in_process(_started, STARTED, "start with refits")
    alone = _in_process(_alone, STARTED, "usual")
    one, two = (_throughput(workers) for workers in (1, 2))
    different, missing, taken, done = _killed(kills)
    memory, ratio = usual.base + usual.each * ASSETS, two / one
    rows: list[tuple[Any, ...]] = [
        (what, *(getattr(cost, name) * scale for cost in (lean, usual)))
        for what, name, scale in (
            ("memory of a member, kB", "each", 1e-3),
            ("memory of the process without members, MB", "base", 1e-6),
            ("state of a member in a dump, kB", "dumped", 1e-3),
            ("time of a sample, µs", "step", 1e6),
            ("dump, µs a member", "dump", 1e6),
            ("load, µs a member", "load", 1e6),
        )
    ]
    more = [
        ("samples a second of one worker", one),
        ("samples a second of two workers", two),
        ("start of a member with refits, seconds in all", start),
        ("sample at a time of its own, µs", 1e6 * alone),
    ]
    return Outcome(
        tables=[
            Table(f"{members} rods of {NODES} nodes in shards of {SIZE}", ("", *LAWS), rows),
            Table("Workers with a shard each, and the start", ("", "value"), more),
            Table(
                "Workers that were killed and went on from their last dump",
                ("kills", "samples", "written twice", "different", "lost"),
                [(done, 2 * FEW * (BATCHES + MORE * kills), taken, different, missing)],
            ),
        ],
        checks=[
            # Of few members the largest memory is that of the start and of dumps.
            *([Check(f"{GROWN}, GB", memory / 1e9, GIGABYTES, "<=")] if members >= ASSETS else []),
            Check("shard: cores for 10 000 samples a second", usual.step * ASSETS, CORE, "<="),
            Check("shard: estimates that differ after kills", float(different), 0.0, "<="),
            Check("shard: estimates lost after kills", float(missing), 0.0, "<="),
            Check("shard: kills", float(done), float(kills), ">="),
            Check(
                "shard: throughput of two workers over one, by processor time", ratio, FASTER, ">="
            ),
        ],
        notes=[
            "Memory: the largest that a process has had, dumps of one shard after the other "
            "included; that of fewer members is taken for 10 000 in proportion. Time: of the "
            "processor, one thread, all members with samples at the same times, after the first "
            f"{WARM} samples of each, by a law whose start is not iterated (refit=None). "
            "Without shadows (shadows=None) errors of the discretisation do not widen what is "
            "reported. Throughput: samples over processor time of each worker, while all run."
        ],
    )


class Cost(NamedTuple):
    """Memory in bytes (base: of the process without members) and time in seconds."""

    base: float
    each: float
    dumped: float
    step: float
    dump: float
    load: float


def _cost(members: int, law: str) -> Cost:
    """Return what members of this process cost."""
    model = _rod()
    counts = [min(SIZE, members - first) for first in range(0, members, SIZE)]
    first = _shard(model, counts[0], law)
    for offset, batch in _batches(model, WARM, counts[0]):
        first.step(offset, batch)
    first.load(first.dump())
    peak, times = _peak(), []
    shards = [first, *(_shard(model, count, law) for count in counts[1:])]
    for one in shards[1:]:
        for offset, batch in _batches(model, WARM, len(one)):
            one.step(offset, batch)
    for k, (_, batch) in enumerate(_batches(model, WARM + TIMED, SIZE)):
        if k < WARM:
            continue
        begun = process_time()
        for one in shards:
            one.step(one.offset, batch[: len(one)])
        times.append((process_time() - begun) / members)
    begun = process_time()
    contents = [len(one.dump()) for one in shards]
    dump = (process_time() - begun) / members
    last = first.dump()
    begun = process_time()
    first.load(last)
    load = (process_time() - begun) / len(first)
    each = (_peak() - peak) / max(members - counts[0], 1)
    base = peak - each * counts[0]
    step = float(np.median(times))
    return Cost(base, each, sum(contents) / members, step, dump, load)


def _peak() -> float:
    """Return the largest memory that this process has had, in bytes."""
    return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _started(members: int, law: str) -> float:
    """Return what the samples of the start take, in seconds of the processor a member."""
    model = _rod()
    one, begun = _shard(model, members, law), process_time()
    for offset, batch in _batches(model, WARM, members):
        one.step(offset, batch)
    return (process_time() - begun) / members


def _alone(members: int, law: str) -> float:
    """Return processor time of a sample where no two members have one at the same time."""
    model = _rod()
    one, times = _shard(model, members, law), []
    for offset, batch in _batches(model, WARM, members):
        own = [(name, t + 1e-3 * STEP * int(name), *rest) for name, t, *rest in batch]
        begun = process_time()
        one.step(offset, own)
        times.append((process_time() - begun) / members)
    return float(np.median(times))


def _throughput(workers: int) -> float:
    """Return samples a second of the processor of workers that have a shard each, all at once."""
    context = multiprocessing.get_context("spawn")
    barrier, spent = context.Barrier(workers), context.SimpleQueue()
    started = [
        context.Process(target=_paced, args=(barrier, spent, 10 * BATCHES), daemon=True)
        for _ in range(workers)
    ]
    for worker in started:
        worker.start()
    for worker in started:
        worker.join(PATIENCE)
    return sum(FEW * 10 * BATCHES / float(spent.get()) for _ in started)


def _paced(barrier: Any, spent: Any, count: int) -> None:
    """Take batches from a meeting with the others on, and tell the processor time."""
    model = _rod()
    one, pieces = _shard(model, FEW), list(_batches(model, count, FEW))
    barrier.wait(PATIENCE)
    with threadpool_limits(1):  # threads of BLAS that wait for each other are no work
        begun = process_time()
        for offset, batch in pieces:
            one.step(offset, batch)
        spent.put(process_time() - begun)


def _killed(kills: int) -> tuple[int, int, int, int]:
    """Return estimates that differ, that are lost and that came twice, and how often was killed."""
    context = multiprocessing.get_context("spawn")
    rng, done = np.random.default_rng(0), 0
    with tempfile.TemporaryDirectory() as folder:
        homes = [Path(folder) / name for name in ("whole", "first", "second")]
        for home in homes:
            home.mkdir()
        count = BATCHES + MORE * kills
        _worker(homes[0], count, 0.0)

        def started(home: Path) -> Any:
            worker = context.Process(target=_worker, args=(home, count, 0.01), daemon=True)
            worker.start()
            return worker

        workers = {home: started(home) for home in homes[1:]}
        end = perf_counter() + PATIENCE
        while any(worker.is_alive() for worker in workers.values()):
            if perf_counter() > end:
                break
            home = homes[1 + done % 2]
            before = len(list(home.glob("*.npy")))
            while workers[home].is_alive() and len(list(home.glob("*.npy"))) <= before + 1:
                sleep(0.002)
            if done < kills and workers[home].is_alive():
                sleep(rng.uniform(0.0, 0.1))
                workers[home].kill()
                workers[home].join()
                done += workers[home].exitcode != 0
                workers[home] = started(home)
            elif done >= kills:
                for worker in workers.values():
                    worker.join(PATIENCE)
        wanted, different, missing, again = _written(homes[0]), 0, 0, 0
        for home in homes[1:]:
            found = _written(home)
            missing += len(wanted.keys() - found.keys())
            shared = wanted.keys() & found.keys()
            different += sum(not np.array_equal(found[k], wanted[k]) for k in shared)
            again += sum(len(path.read_bytes()) for path in home.glob("*.log")) - len(found) // FEW
        return different, missing, FEW * again, done


def _worker(home: Path, count: int, pause: float) -> None:
    """Take the log from the last dump on: estimates by their offset, and a dump now and then."""
    model = _rod()
    one, dump = _shard(model, FEW), home / "shard.bin"
    if dump.exists():
        one.load(dump.read_bytes())
    for offset, batch in _batches(model, count, FEW):
        if offset < one.offset:
            continue
        found = one.step(offset, batch)
        with (home / "batches.log").open("ab") as log:
            log.write(b".")
        write_bytes(home / f"{offset}.npy", found.q.tobytes())
        if offset // FEW % EVERY == EVERY - 1:
            write_bytes(dump, one.dump())
        sleep(pause)


def _written(home: Path) -> dict[int, Array]:
    """Return the estimates of a worker by offset."""
    return {
        int(path.stem) + k: row
        for path in home.glob("*.npy")
        for k, row in enumerate(np.frombuffer(path.read_bytes()).reshape(-1, 1))
    }


def _in_process(what: Callable[[int, str], Found], count: int, law: str) -> Found:
    """Return what a function gives in a fresh process."""
    context = multiprocessing.get_context("spawn")
    mine, other = context.Pipe()
    worker = context.Process(target=_send, args=(other, what, count, law), daemon=True)
    worker.start()
    other.close()
    found: Found = mine.recv()
    worker.join(PATIENCE)
    return found


def _send(pipe: Connection, what: Callable[[int, str], Any], count: int, law: str) -> None:
    with threadpool_limits(1):
        pipe.send(what(count, law))


def _rod() -> Model:
    alpha = LogNormal(0.5, std=0.25)
    return heat(interval(0.0, 1.0, NODES - 1), alpha, {"left": Channel("heated"), "right": 0.0})


def _shard(model: Model, members: int, law: str = "usual") -> Shard:
    chosen = {**LAWS, "start with refits": SensitivityLaw()}[law]
    return Shard(model, Points(SENSORS, noise=NOISE), chosen, members, u0=0.0)


def _heated(t: float) -> dict[str, float]:
    return {"heated": float(np.sin(t) + np.sin(3.1 * t))}


def _batches(model: Model, count: int, members: int) -> Iterator[tuple[int, list[Any]]]:
    """Yield offsets and batches of a sample of every member."""
    rng, names = np.random.default_rng(0), [str(k) for k in range(members)]
    times = [STEP * k for k in range(count + 1)]
    sensors, control = Points(SENSORS).matrix(model.state_space), Advance(SensitivityLaw.scheme)
    shown = []
    for _ in range(TRUTHS):
        q = model.initial_parameter([rng.uniform(0.3, 0.8)])
        shown.append([sensors @ u for _, u in simulate(model, q, 0.0, times, control, _heated)])
    truths = np.array(shown)[np.arange(members) % TRUTHS]
    for k, t in enumerate(times[1:], 1):
        z = truths[:, k] + NOISE * rng.standard_normal(truths[:, k].shape)
        rows = zip(names, z.tolist(), strict=True)
        yield (k - 1) * members, [(name, t, row, _heated(t)) for name, row in rows]
