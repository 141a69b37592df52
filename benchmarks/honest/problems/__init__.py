"""Problems of the benchmark by name."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.honest.problem import Problem
from benchmarks.honest.problems.borehole import Borehole
from benchmarks.honest.problems.column import Column
from benchmarks.honest.problems.fisher import Fisher
from benchmarks.honest.problems.flux import NonlinearFlux, RodFlux
from benchmarks.honest.problems.layers import Profile, Wall
from benchmarks.honest.problems.plate import Plate, Reaction
from benchmarks.honest.problems.rod import LossyRod, Rod
from benchmarks.honest.problems.warm import WarmRod

__all__ = ["PROBLEMS"]

PROBLEMS: Mapping[str, Problem] = {
    "rod": Rod(),
    "lossy-rod": LossyRod(),
    "flux": RodFlux(),
    "warm-flux": NonlinearFlux(),
    "warm-rod": WarmRod(),
    "fisher": Fisher(),
    "column": Column(),
    "wall": Wall(),
    "profile": Profile(),
    "plate": Plate(),
    "reaction": Reaction(),
    "borehole": Borehole(),
}
