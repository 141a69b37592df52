"""Reader of the breakthrough curves of figure 7-3a in USDA Research Report 137."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def breakthrough(folder: Path, curve: int) -> tuple[Array, dict[str, Array]]:
    """Return times and relative concentration c, with the step of the inflow, c_in, at time 0."""
    times, c = np.loadtxt(folder / "soil_column" / f"FIG7-3A_{curve}.csv", delimiter=",").T
    return np.insert(times, 0, 0.0), {"c": np.insert(c, 0, np.nan), "c_in": np.ones(len(c) + 1)}
