"""The problems of the benchmark suite: what is unknown, what is seen, where the data come from.

A problem makes a `Process` for each seed: the model that every estimator is given, and a truth of
which it is given the samples only. Except for `seed` and `seed-excited`, whose example is the
paper's with data of the same scheme, the truth comes from a finer mesh with shorter steps and is
drawn anew for each seed from the prior, so that an honest interval has something to be honest
about.
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
