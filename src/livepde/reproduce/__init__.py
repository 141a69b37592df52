"""Published and stated experiments, each with the numbers it must show.

One file for each experiment, its expected numbers at the end; `livepde reproduce NAME` runs them,
and so do the tests.
"""

from __future__ import annotations

from livepde.reproduce.boiger2016 import BOIGER2016
from livepde.reproduce.degenerate import DEGENERATE
from livepde.reproduce.dimensions import DIMENSIONS
from livepde.reproduce.exact import EXACT
from livepde.reproduce.experiment import Experiment
from livepde.reproduce.noisy import SEED_EXCITED_NOISE
from livepde.reproduce.relatives import RELATIVES
from livepde.reproduce.seed import SEED
from livepde.reproduce.seed_excited import SEED_EXCITED

__all__ = ["EXPERIMENTS", "Experiment"]

EXPERIMENTS: dict[str, Experiment] = {
    item.name: item
    for item in (
        SEED,
        SEED_EXCITED,
        SEED_EXCITED_NOISE,
        DEGENERATE,
        DIMENSIONS,
        BOIGER2016,
        RELATIVES,
        EXACT,
    )
}
"""Name -> experiment."""
