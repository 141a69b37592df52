"""Costs of steps, memory, and speed-up of a fleet; `python -m benchmarks` also checks bounds.

`python -m benchmarks.suite.costs NODES LAW` prints the memory of one identification.
"""

from __future__ import annotations

import subprocess
import sys
from typing import Any

from benchmarks import ROOT
from benchmarks.fleet import fleet
from benchmarks.processes import peak_memory
from benchmarks.step import problem, step
from livepde import GradientLaw, Identifier, SensitivityLaw
from livepde.laws import ResidualDamping

LAWS = ("gradient", "sensitivity")
MODES = 10


class Step:
    """Cost of a step of each law in forward steps of the same model, largest over settings."""

    params: Any = ((31, 1_000, 10_000), LAWS)
    param_names = ("nodes", "law")
    unit = "forward steps"

    def setup_cache(self) -> dict[tuple[int, str], float]:
        sizes, laws = self.params
        largest: dict[tuple[int, str], float] = {}
        for size in sizes:
            (table,) = step([size], [MODES]).tables
            rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
            for law in laws:
                ratios = [row["median"] for row in rows if row["law"].startswith(law)]
                largest[size, law] = max(ratios)
        return largest

    def track_ratio(self, largest: dict[tuple[int, str], float], nodes: int, law: str) -> float:
        return largest[nodes, law]


class Memory:
    """Memory per state unknown that an identification adds to a process with livepde imported."""

    params: Any = ((10_000,), LAWS)
    param_names = ("nodes", "law")

    def track_memory(self, nodes: int, law: str) -> float:
        command = [sys.executable, "-m", "benchmarks.suite.costs", str(nodes), law]
        done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
        return float(done.stdout)

    track_memory.unit = "kB per unknown"  # type: ignore[attr-defined]


class Fleet:
    """Speed-up of a fleet of rods with 100 nodes relative to separate identifiers."""

    members, runs = 1000, 25
    unit = "times"

    def setup_cache(self) -> list[float]:
        return [check.value for check in fleet(self.members, self.runs).checks]

    def track_step(self, values: list[float]) -> float:
        return values[0]

    def track_command(self, values: list[float]) -> float:
        return values[2]


def _spent(nodes: int, law: str) -> float:
    """Return the memory of the model and five steps of a law, in kB per state unknown."""
    before, given = peak_memory(), problem(nodes)
    gradient = law == "gradient"
    rule = GradientLaw(1e4, ResidualDamping(1.0)) if gradient else SensitivityLaw(MODES, 1e-3)
    sensors = given.omega if gradient else given.points
    matrix = sensors.matrix(given.model.state_space)
    identifier = Identifier(given.model, sensors, rule, q0=0.0, u0=given.u0)
    for k, (t, u) in enumerate(given.forward(given.q_true)):
        if k:
            identifier.step(t, matrix @ u)
        if k == 5:
            break
    return (peak_memory() - before) / given.model.X.dim / 1000.0


if __name__ == "__main__":
    sys.stdout.write(f"{_spent(int(sys.argv[1]), sys.argv[2])}\n")
