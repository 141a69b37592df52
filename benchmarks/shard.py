"""Memory, times and throughput of shards of rods, and recovery of their killed workers."""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter, process_time, sleep
from typing import Any, NamedTuple, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.fleet import NODES, NOISE, SENSORS, STEP
from benchmarks.processes import peak_memory
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

SIZE = 250  # members of a shard; the memory of a step grows with it
TRUTHS = 20  # rods with different coefficients; each member has its own noise
GROWN = "shard: memory of 10 000 members"
WARM = 100  # untimed samples of each member, after which logs have reached their full length
TIMED = 10  # timed samples of each member
FEW = 100  # members of the shards whose workers are killed
BATCHES, MORE, EVERY = 60, 20, 7  # batches of such a shard, per kill, and between two dumps
ASSETS = 10_000  # members for which the bounds are defined
GIGABYTES, CORE, FASTER = 0.5, 1.0, 1.5  # largest memory, largest load, smallest speed-up
PATIENCE = 600.0  # s, time limit of a worker
STARTED = 10  # members whose first samples are timed
LAWS = {
    "without shadows": SensitivityLaw(refit=None, shadows=None),
    "usual": SensitivityLaw(refit=None),
}

Found = TypeVar("Found")


def shard(members: int = ASSETS, kills: int = 20) -> Outcome:
    """Measure shards of heated rods of 100 nodes with unknown diffusivity.

    Parameters
    ----------
    members
        Number of rods whose memory and step time are measured, in shards of 250.
    kills
        Number of kills of one of two workers at random times.
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
            ("dump, µs per member", "dump", 1e6),
            ("load, µs per member", "load", 1e6),
        )
    ]
    more = [
        ("samples per second of one worker", one),
        ("samples per second of two workers", two),
        ("start of a member with refits, s in total", start),
        ("sample at a time that no other member shares, µs", 1e6 * alone),
    ]
    return Outcome(
        tables=[
            Table(f"{members} rods of {NODES} nodes in shards of {SIZE}", ("", *LAWS), rows),
            Table("Throughput of workers with a shard each, and the start", ("", "value"), more),
            Table(
                "Killed workers that resumed from their last dump",
                ("kills", "samples", "written twice", "different", "lost"),
                [(done, 2 * FEW * (BATCHES + MORE * kills), taken, different, missing)],
            ),
        ],
        checks=[
            # With few members, start and dumps dominate the peak memory.
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
            "Memory: peak memory of the process, including dumps of its shards in turn, and "
            "extrapolated to 10 000 members. Times: processor times with one thread after the "
            f"first {WARM} samples of each member, all members at the same times, without refits "
            "(refit=None). Without shadows (shadows=None), discretisation errors do not widen "
            "the intervals. Throughput: samples over processor time of each concurrent worker."
        ],
    )


class Cost(NamedTuple):
    """Memory in bytes (`base`: process without members; others per member), and times in s."""

    base: float
    each: float
    dumped: float
    step: float
    dump: float
    load: float


def _cost(members: int, law: str) -> Cost:
    """Return memory and times of members in this process."""
    model = _rod()
    counts = [min(SIZE, members - first) for first in range(0, members, SIZE)]
    first = _shard(model, counts[0], law)
    for offset, batch in _batches(model, WARM, counts[0]):
        first.step(offset, batch)
    first.load(first.dump())
    peak, times = peak_memory(), []
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
    each = (peak_memory() - peak) / max(members - counts[0], 1)
    base = peak - each * counts[0]
    step = float(np.median(times))
    return Cost(base, each, sum(contents) / members, step, dump, load)


def _started(members: int, law: str) -> float:
    """Return the processor time per member of the first `WARM` samples, in s."""
    model = _rod()
    one, begun = _shard(model, members, law), process_time()
    for offset, batch in _batches(model, WARM, members):
        one.step(offset, batch)
    return (process_time() - begun) / members


def _alone(members: int, law: str) -> float:
    """Return the processor time of a sample if all members have samples at different times."""
    model = _rod()
    one, times = _shard(model, members, law), []
    for offset, batch in _batches(model, WARM, members):
        own = [(name, t + 1e-3 * STEP * int(name), *rest) for name, t, *rest in batch]
        begun = process_time()
        one.step(offset, own)
        times.append((process_time() - begun) / members)
    return float(np.median(times))


def _throughput(workers: int) -> float:
    """Return the total samples per second of processor time of concurrent workers."""
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
    """Wait for the other workers, process batches, and send the processor time."""
    model = _rod()
    one, pieces = _shard(model, FEW), list(_batches(model, count, FEW))
    barrier.wait(PATIENCE)
    with threadpool_limits(1):  # waiting BLAS threads would count as processor time
        begun = process_time()
        for offset, batch in pieces:
            one.step(offset, batch)
        spent.put(process_time() - begun)


def _killed(kills: int) -> tuple[int, int, int, int]:
    """Return numbers of different, lost and repeated estimates, and of kills."""
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
        wanted, different, missing, repeated = _written(homes[0]), 0, 0, 0
        for home in homes[1:]:
            written = _written(home)
            missing += len(wanted.keys() - written.keys())
            shared = wanted.keys() & written.keys()
            different += sum(not np.array_equal(written[k], wanted[k]) for k in shared)
            batches = sum(len(path.read_bytes()) for path in home.glob("*.log"))
            repeated += batches - len(written) // FEW
        return different, missing, FEW * repeated, done


def _worker(home: Path, count: int, pause: float) -> None:
    """Process batches from the last dump on, write each estimate, and dump periodically."""
    model = _rod()
    one, dump = _shard(model, FEW), home / "shard.bin"
    if dump.exists():
        one.load(dump.read_bytes())
    for offset, batch in _batches(model, count, FEW):
        if offset < one.offset:
            continue
        estimate = one.step(offset, batch)
        with (home / "batches.log").open("ab") as log:
            log.write(b".")
        write_bytes(home / f"{offset}.npy", estimate.q.tobytes())
        if offset // FEW % EVERY == EVERY - 1:
            write_bytes(dump, one.dump())
        sleep(pause)


def _written(home: Path) -> dict[int, Array]:
    """Return the estimates that a worker wrote, by offset."""
    return {
        int(path.stem) + k: row
        for path in home.glob("*.npy")
        for k, row in enumerate(np.frombuffer(path.read_bytes()).reshape(-1, 1))
    }


def _in_process(what: Callable[[int, str], Found], count: int, law: str) -> Found:
    """Call a function in a new process, and return its result."""
    context = multiprocessing.get_context("spawn")
    mine, other = context.Pipe()
    worker = context.Process(target=_send, args=(other, what, count, law), daemon=True)
    worker.start()
    other.close()
    result: Found = mine.recv()
    worker.join(PATIENCE)
    return result


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
    """Yield offsets and batches, each with a sample of every member."""
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
