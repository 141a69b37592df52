"""Measure the forward step of an earlier version: python -m benchmarks.earlier [COMMIT].

Two processes step the same model in turns: one with the sources of the commit, in a temporary git
worktree, and one with the current sources. The table shows both forward steps relative to the lean
reference (`benchmarks.rods.lean_forward`), and the ratio of current to commit. Values are medians
over the turns, of processor times. The column of the commit defines `benchmarks.rods.EARLIER`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from benchmarks import ROOT, layered
from livepde.stepping import Advance, ImplicitEuler, simulate

COMMIT = "51ef98c"
STEPS, TURNS = 100, 15
SIZES = ((31, 2), (200, 2), (1_000, 2), (10_000, 4))


def main() -> None:
    """Parse the command line, measure, and print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("commit", nargs="?", default=COMMIT)
    options.add_argument("--turns", type=int, default=TURNS)
    options.add_argument("--serve", help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.serve:
        serve(given.serve == "lean")
        return
    with TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        command = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*command, "add", "--detach", str(tree), given.commit], check=True)
        try:
            compare(tree / "src", given.commit, given.turns)
        finally:
            subprocess.run([*command, "remove", "--force", str(tree)], check=True)


def compare(earlier: Path, commit: str, turns: int) -> None:
    """Step both versions in turns, and print a row for each model."""
    then, now = _worker(earlier, "forward"), _worker(ROOT / "src", "lean")
    write = sys.stdout.write
    write(f"| nodes | ends | {commit} / lean | today / lean | today / {commit} |\n")
    write("|---|---|---|---|---|\n")
    for nodes, unknowns in SIZES:
        for ends in layered.ENDS if nodes < SIZES[-1][0] else layered.ENDS[:1]:
            task = f"{nodes} {unknowns} {ends}"
            times = np.array([[*_ask(then, task), *_ask(now, task)] for _ in range(turns)])
            old, new, lean = times.T
            shares = [np.median(old / lean), np.median(new / lean), np.median(new / old)]
            cells = " | ".join(f"{share:.3g}" for share in shares)
            write(f"| {nodes} | {ends} | {cells} |\n")
            sys.stdout.flush()
    for worker in (then, now):
        worker.communicate("")


def _worker(source: Path, what: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "benchmarks.earlier", "--serve", what]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdin=pipe, stdout=pipe, text=True)


def _ask(worker: subprocess.Popen[str], task: str) -> list[float]:
    if worker.stdin is None or worker.stdout is None:
        raise RuntimeError("the worker has no pipes")
    worker.stdin.write(f"{task}\n")
    worker.stdin.flush()
    return [float(word) for word in worker.stdout.readline().split()]


def serve(lean: bool) -> None:
    """Answer each line "NODES UNKNOWNS ENDS" with median times of a forward step, in s."""
    models: dict[str, Any] = {}
    for line in sys.stdin:
        nodes, unknowns, ends = line.split()
        if line not in models:
            size, count = int(nodes), int(unknowns)
            square = size >= SIZES[-1][0]
            models[line] = layered.plate(size) if square else layered.rod(size, count, ends)
        answer = [_forward(models[line], ends)]
        if lean:
            from benchmarks.rods import Rod, lean_forward

            rod = models.setdefault(f"lean {line}", Rod(int(nodes), int(unknowns), ends))
            answer.append(float(np.median(lean_forward(rod, STEPS))))
        sys.stdout.write(" ".join(map(repr, answer)) + "\n")
        sys.stdout.flush()


def _forward(model: Any, ends: str) -> float:
    times = (layered.STEP * np.arange(STEPS + 1)).tolist()
    inputs = {t: layered.ends_at(ends, t) for t in times}.__getitem__
    states = simulate(model, model.latent.prior, 0.0, times, Advance(ImplicitEuler()), inputs)
    next(states)
    spent = []
    for _ in range(STEPS):
        begun = process_time()
        next(states)
        spent.append(process_time() - begun)
    return float(np.median(spent))


if __name__ == "__main__":
    main()
