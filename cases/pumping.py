"""Published pumping tests: readers of the data, and one aquifer that explains four tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

import livepde as lp
from livepde.fem import linear
from livepde.models.groundwater import well

Array = npt.NDArray[np.float64]
Columns = dict[str, Array]
RATES = {"p05": 0.3, "p40": 0.1, "p42": 0.1, "p44": 0.1}  # m^3/s, by the name of the pumped well
PLACES = {"p05": (0.0, 0.0), "p40": (5.608, 4.232), "p42": (-6.25, -1.937), "p44": (-5.953, -8.576)}


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


def horkheim(
    folder: Path, samples: int = 10, power: float = 2.0, between: int = 40
) -> tuple[Array, Columns]:
    """Return drawdown per 0.1 m^3/s, test_well, interpolated at times that all wells have.

    As for the published fit the times are quadratically spaced, or with another power. Rows
    between them hold no measurements: they make small time steps.
    """
    found = {}
    for test, rate in RATES.items():
        table = pd.read_csv(folder / "pumping_horkheim" / f"horkheim_{test}.csv")
        for read, rows in table.groupby("obs_well"):
            found[f"{test}_{read}"] = rows["t_s"].to_numpy(), rows["drawdown_m"] * 0.1 / rate
    first = max(time[0] for time, _ in found.values())
    last = min(time[-1] for time, _ in found.values())
    chosen = np.linspace(first ** (1 / power), last ** (1 / power), samples) ** power
    times = np.unique(np.concatenate([[0.0], np.geomspace(first / 16, last, between)[:-1], chosen]))
    used = np.isin(times, chosen)
    columns = {
        name: np.where(used, np.interp(times, time, drawdown), np.nan)
        for name, (time, drawdown) in found.items()
    }
    return times, {"Q": np.full(len(times), 0.1), **columns}


def four_tests(mesh: Any, unknowns: Mapping[str, Any], dirichlet: Any, length: float) -> lp.Model:
    """Return the drawdown of each test in an aquifer of transmissivity T Y(x) and storage S Z(x).

    S Z s_t = div(T Y grad s) + Q delta, Q = 0.1 m^3/s. Y and Z vary where the wells are, and are 1
    far away: their prior has this length, and a deviation that fades beyond 30 m.
    """

    def inner(u: Any, v: Any, x: Any) -> Any:
        far = ((x[0] - 2) ** 2 + (x[1] + 3) ** 2) / 30**2
        return (1 + far**2) * (u * v / length**2 + lp.dot(lp.grad(u), lp.grad(v))) / (2 * np.pi)

    def balance(q: Any, u: Any, v: Any, x: Any) -> Any:
        D, terms = q.T * q.Y / (q.S * q.Z), []
        for test, at in PLACES.items():
            s, w = getattr(u, test), getattr(v, test)
            slope = lp.dot(lp.grad(s), lp.grad(w)) - lp.dot(lp.grad(s), lp.grad(q.Z)) / q.Z * w
            terms.append(D * slope - 0.1 * well(x, at, 4.5) / (q.S * q.Z) * w)
        return sum(terms)

    fields = {name: replace(unknowns[name], inner=inner) for name in ("Y", "Z")}
    state = {
        test: lp.Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}, unit="m", quadrature=4)
        for test in PLACES
    }
    return lp.Model(state, {**unknowns, **fields}, A=balance, time_unit="s")
