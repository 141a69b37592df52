"""Problems of the benchmark suite.

A problem returns a `Process` for each seed: the model for all estimators, and a truth of which they
receive only samples. `seed` and `seed-excited` are examples of the paper with data from the same
scheme. Otherwise, the truth comes from a finer mesh with shorter steps, and is drawn from the prior
for each seed, so that coverage of intervals is meaningful.
"""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.problems.data import WARM_UP, Data, Problem, Process
from benchmarks.problems.flow import FLOW
from benchmarks.problems.paper import SEED, SEED_EXCITED
from benchmarks.problems.plate import PLATE
from benchmarks.problems.soil import SOIL
from benchmarks.problems.wall import WALL

__all__ = ["PROBLEMS", "WARM_UP", "Data", "Problem", "Process"]

PROBLEMS: Mapping[str, Problem] = {
    problem.name: problem for problem in (SEED, SEED_EXCITED, PLATE, FLOW, WALL, SOIL)
}
"""Name -> problem."""
