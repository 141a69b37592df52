"""Checks that the smoother, like the filter, weights each reading by its own noise.

Estimating a source in a rod is a regression on one number, which gives the exact values. A furnace
wall is run as a case with a noise column and `output.smoothed`; its data are from finite volumes.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

import livepde as lp
from benchmarks.first_hour import FOLDER, KELVIN, furnace
from livepde.diagnostics.check_report import Check

Array = NDArray[Any]

CELLS, STEP, COUNT = 10, 0.1, 60
SENSOR, FINE, ROUGH = 5, 0.001, 0.5  # node of the sensor, and its two alternating noise levels
STD = 2.0  # prior standard deviation of the source
ROUGH_KELVIN = 3.0  # noise of every second row of the furnace
EVERY = 40  # every 40th row of the furnace is used


def checks() -> list[Check]:
    """Return the checks of the smoother."""
    return [*_source(), *_furnace()]


# --- a source in a rod: linear -------------------------------------------------------------------


def _transition() -> Array:
    """Return F of (u, s) by implicit Euler for u_t = 0.3 u_xx + s, with u = 0 at both ends."""
    h, n = 1.0 / CELLS, CELLS + 1
    M = h / 6.0 * (4.0 * np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1))
    K = 0.3 / h * (2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    inner = slice(1, -1)
    S = (M / STEP + K)[inner, inner]
    F = np.zeros((n + 1, n + 1))
    F[-1, -1] = 1.0
    F[1:-2, :n] = np.linalg.solve(S, M[inner] / STEP)
    F[1:-2, -1] = np.linalg.solve(S, np.full(n - 2, h))
    return F


def _readings() -> tuple[Array, Array]:
    """Return noisy readings for s = 1, and the noise standard deviation of each reading."""
    rng, F, x = np.random.default_rng(0), _transition(), np.zeros(CELLS + 2)
    x[-1] = 1.0
    std = np.where(np.arange(COUNT) % 2, FINE, ROUGH)
    z = []
    for noise in std:
        x = F @ x
        z.append(x[SENSOR] + noise * rng.standard_normal())
    return np.array(z), std


def _exact(z: Array, std: Array) -> tuple[float, float, Array]:
    """Return mean and standard deviation of s given all readings, and the states for s = 1.

    The initial state is zero, so that the state is s times its response: a regression on s.
    """
    F, x, states = _transition(), np.append(np.zeros(CELLS + 1), 1.0), []
    for _ in z:
        x = F @ x
        states.append(x[:-1])
    response = np.array(states)
    weight = response[:, SENSOR] / std**2
    precision = 1.0 / STD**2 + weight @ response[:, SENSOR]
    return float(weight @ z / precision), float(precision**-0.5), response


def _run() -> lp.Identifier:
    mesh = lp.interval(0.0, 1.0, CELLS)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": 0.0, "right": 0.0}),
        {"s": lp.Normal(0.0, std=STD)},
        A=lambda q, _, v, x: -q.s * v,
        B=lambda u, v, x: 0.3 * lp.dot(lp.grad(u), lp.grad(v)),
    )
    law = lp.SensitivityLaw(gate=np.inf, guards=None, shadows=None, verdict=False)
    sensors = lp.Points({"a": SENSOR / CELLS}, noise=0.1)
    return lp.Identifier(model, sensors, law, u0=0.0, scheme=lp.ImplicitEuler(), halvings=0)


def _source() -> list[Check]:
    z, std = _readings()
    exact, deviation, response = _exact(z, std)
    samples = [(STEP * (k + 1), {"a": pair}) for k, pair in enumerate(zip(z, std, strict=True))]
    result = _run().run(samples)
    last, data = result.last, result.smoothed()
    if last is None:
        raise RuntimeError("the run has no estimate")
    # If innovations are correlated, all intervals are widened by one common factor.
    widened = float(data["s_std"][-1]) / deviation
    states, spread = data["u"].values - exact * response, data["u_std"].values / widened
    spread = spread - deviation * np.abs(response)
    return [
        Check(
            "source: filter at the last sample, in deviations from a regression",
            abs(last["s"].mean - exact) / deviation,
            1e-6,
            "<=",
        ),
        Check(
            "source: smoother at the last sample, in deviations from the filter",
            abs(float(data["s"][-1]) - last["s"].mean) / last["s"].std,
            1e-6,
            "<=",
        ),
        Check(
            "source: deviation of the smoother over that of the filter, last sample",
            float(data["s_std"][-1]) / last["s"].std,
            (1.0 - 1e-6, 1.0 + 1e-6),
            "in",
        ),
        Check(
            "source: smoothed states, largest difference from the regression, in deviations",
            float(np.abs(states).max() / (deviation * response.max())),
            1e-6,
            "<=",
        ),
        Check(
            "source: deviations of smoothed states, largest difference, in the largest one",
            float(np.abs(spread).max() / (deviation * response.max())),
            1e-6,
            "<=",
        ),
    ]


# --- a furnace wall, run as a case ---------------------------------------------------------------


def _furnace() -> list[Check]:
    header, table, truths = furnace(0)
    table = table[::EVERY].copy()
    rng, rough = np.random.default_rng(1), np.arange(len(table)) % 2 == 1
    sensors = slice(1, 5)
    table[rough, sensors] += ROUGH_KELVIN * rng.standard_normal((int(rough.sum()), 4))
    noise = np.where(rough, np.hypot(KELVIN, ROUGH_KELVIN), KELVIN)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        rows = np.column_stack([table, noise])
        lines = [",".join(f"{value:.8g}" for value in row) for row in rows.tolist()]
        text = "\n".join([",".join([*header, "noise"]), *lines]) + "\n"
        (folder / "furnace.csv").write_text(text)
        case = (FOLDER / "furnace.toml").read_text()
        case = case.replace('noise = "0.3 K"', 'noise = "1 K", noise_column = "noise"')
        (folder / "furnace.toml").write_text(case + "[output]\nsmoothed = true\n")
        command = [sys.executable, "-m", "livepde", "run", "furnace.toml", "--out", "run"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        with xr.open_dataset(folder / "run" / "estimates.nc", engine="scipy") as data:
            return [check for name, truth in truths.items() for check in _alike(data, name, truth)]


def _alike(data: xr.Dataset, name: str, truth: float) -> list[Check]:
    """Check the smoothed estimate of an unknown at the last sample."""
    mean, std, smooth, smooth_std = (
        float(data[f"{name}{end}"][-1]) for end in ("", "_std", "_smoothed", "_smoothed_std")
    )
    return [
        # The smoother linearises about a different trajectory, which changes little.
        Check(
            f"furnace, {name}: last smoothed less last filtered, in deviations",
            abs(smooth - mean) / std,
            0.3,
            "<=",
        ),
        Check(
            f"furnace, {name}: deviation over that of the filter",
            smooth_std / std,
            (0.8, 1.25),
            "in",
        ),
        Check(
            f"furnace, {name}: smoothed less truth, in deviations",
            abs(smooth - truth) / smooth_std,
            3.0,
            "<=",
        ),
    ]
