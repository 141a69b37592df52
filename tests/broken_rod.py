"""Readings of a rod by independent finite differences, and case and table files made of them."""

from functools import cache

import numpy as np
import scipy.linalg

ALPHA, LENGTH, AT, STEP, NOISE = 1e-4, 0.4, (0.1, 0.2, 0.3), 20.0, 0.05


def left(t):
    return 20.0 + 15.0 * np.sin(2 * np.pi * t / 1200.0)


@cache
def exact(rows: int, change: float = 1.0, after: int = 10**9) -> np.ndarray:
    """Return sensor temperatures by Crank-Nicolson, 160 cells, 8 steps per row, shape (rows, 3).

    After row `after`, the diffusivity is multiplied by `change`.
    """
    cells, parts = 160, 8
    x = np.linspace(0.0, LENGTH, cells + 1)
    u, h = np.full(cells + 1, 20.0), STEP / parts
    temperatures = [u[[40, 80, 120]]]
    for k in range(1, rows):
        r = 0.5 * ALPHA * (change if k > after else 1.0) * h / (x[1] - x[0]) ** 2
        bands = np.zeros((3, cells + 1))
        bands[0, 2:], bands[1], bands[2, :-2] = -r, 1.0, -r
        bands[1, 1:-1] += 2 * r
        for j in range(parts):
            rhs = u.copy()
            rhs[1:-1] += r * (u[2:] - 2 * u[1:-1] + u[:-2])
            rhs[0], rhs[-1] = left((k - 1) * STEP + (j + 1) * h), 20.0
            u = scipy.linalg.solve_banded((1, 1), bands, rhs)
        temperatures.append(u[[40, 80, 120]])
    return np.array(temperatures)


def readings(rows: int, seed: int = 0, **process) -> np.ndarray:
    noise = NOISE * np.random.default_rng(seed).standard_normal((rows, 3))
    return exact(rows, **process) + noise


def case_text() -> str:
    """Return a case file for `table`, with the initial state interpolated from the first row."""
    sensors = "\n".join(
        f'T_{k + 1} = {{ role = "sensor", column = "T_{k + 1}", at = {x}, noise = {NOISE} }}'
        for k, x in enumerate(AT)
    )
    return f"""
equation = "heat"
initial = "interpolate"
mesh = {{ from = 0, to = {LENGTH}, cells = 16 }}
data = {{ file = "rod.csv", time = "t", time_unit = "s" }}
unknowns.alpha = {{ prior = 5e-5, std = 3e-5 }}
law.kind = "sensitivity"

[channels]
T_left = {{ role = "boundary", column = "T_left", at = "left" }}
T_right = {{ role = "boundary", column = "T_right", at = "right" }}
{sensors}
"""


def table(z: np.ndarray, left_cells: dict[int, float] | None = None) -> str:
    """Return a CSV file of readings and end values; `left_cells` replaces values at the left."""
    lines = ["t,T_left,T_1,T_2,T_3,T_right"]
    for k, row in enumerate(z.tolist()):
        end = (left_cells or {}).get(k, left(k * STEP))
        lines.append(",".join(map(repr, [k * STEP, float(end), *row, 20.0])))
    return "\n".join(lines) + "\n"
