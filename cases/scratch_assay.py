"""Reader of the scratch assays of Jin et al. (2016): cell density by position and time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

Array = npt.NDArray[np.float64]


def profiles(folder: Path, density: int) -> tuple[Array, dict[str, Array]]:
    """Return times in h and u_0, u_1, ... in cells/um^2: the mean of three replicates."""
    table = pd.read_csv(
        folder / "scratch_assay" / f"CellDensity_{density}.csv", encoding="utf-8-sig"
    )
    wide = table.pivot(index="Time", columns="Position", values="AvgDens")
    columns = {f"u_{k}": wide[x].to_numpy(float) for k, x in enumerate(sorted(wide.columns))}
    return wide.index.to_numpy(float), columns
