"""Readers of published pumping tests: drawdown of wells that are read at times of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

Array = npt.NDArray[np.float64]
Columns = dict[str, Array]
RATES = {"p05": 0.3, "p40": 0.1, "p42": 0.1, "p44": 0.1}  # m^3/s, by the name of the pumped well


def wells(folder: Path, rate: float, files: dict[str, str]) -> tuple[Array, Columns]:
    """Return drawdown by well, and Q = rate from time 0 on; files hold times and head changes."""
    texts = {name: (folder / "pumping_ttim" / file).read_text() for name, file in files.items()}
    heads = {name: np.loadtxt(text.splitlines()).T for name, text in texts.items()}
    times = np.unique(np.concatenate([[0.0], *(time for time, _ in heads.values())]))
    columns = {"Q": np.full(len(times), rate)}
    for name, (time, head) in heads.items():
        columns[name] = np.full(len(times), np.nan)
        columns[name][np.searchsorted(times, time)] = -head
    return times, columns


def horkheim(folder: Path, samples: int = 10) -> tuple[Array, Columns]:
    """Return drawdown per 0.1 m^3/s, test_well, as the published fit takes it.

    That is at quadratically spaced times that all wells have, interpolated. Rows between them hold
    no measurements: they make small time steps.
    """
    found = {}
    for test, rate in RATES.items():
        table = pd.read_csv(folder / "pumping_horkheim" / f"horkheim_{test}.csv")
        for well, rows in table.groupby("obs_well"):
            found[f"{test}_{well}"] = rows["t_s"].to_numpy(), rows["drawdown_m"] * 0.1 / rate
    first = max(time[0] for time, _ in found.values())
    last = min(time[-1] for time, _ in found.values())
    chosen = np.linspace(np.sqrt(first), np.sqrt(last), samples) ** 2
    times = np.unique(np.concatenate([[0.0], np.geomspace(first / 16, last, 40)[:-1], chosen]))
    used = np.isin(times, chosen)
    columns = {
        name: np.where(used, np.interp(times, time, drawdown), np.nan)
        for name, (time, drawdown) in found.items()
    }
    return times, {"Q": np.full(len(times), 0.1), **columns}
