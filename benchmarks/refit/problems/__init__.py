"""Problems of the benchmark by name."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.refit.problem import Problem
from benchmarks.refit.problems.column import Column, Few, OffsetColumn
from benchmarks.refit.problems.immobile import Immobile
from benchmarks.refit.problems.layers import Layers
from benchmarks.refit.problems.profile import Profile
from benchmarks.refit.problems.rods import Collinear, Plate
from benchmarks.refit.problems.waves import Burgers, Source

__all__ = ["PROBLEMS"]

PROBLEMS: Mapping[str, Problem] = {
    "column": Column(),
    "column-offset": OffsetColumn(),
    "layers": Layers(),
    "source": Source(),
    "burgers": Burgers(),
    "immobile": Immobile(),
    "collinear": Collinear(),
    "few": Few(),
    "plate": Plate(),
    "profile": Profile(),
}
