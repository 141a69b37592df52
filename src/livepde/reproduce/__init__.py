"""Published experiments, each with its expected numbers.

Each experiment is a file with its expected numbers at the end. The command `livepde reproduce NAME`
and the tests run the experiments.
"""

from __future__ import annotations

from livepde.reproduce.boiger2016 import BOIGER2016
from livepde.reproduce.experiment import Experiment
from livepde.reproduce.seed import SEED
from livepde.reproduce.seed_excited import SEED_EXCITED

__all__ = ["EXPERIMENTS", "Experiment"]

EXPERIMENTS: dict[str, Experiment] = {item.name: item for item in (SEED, SEED_EXCITED, BOIGER2016)}
"""Name -> experiment."""
