"""Five jobs: a simulated table of measurements, and the case that a user would write.

Tables come from finite volumes on fine meshes. In one dimension, time integration is exact for
inputs that are linear or constant between rows; in two dimensions, it is Crank-Nicolson with
substeps. Neither shares mesh, scheme or code with livepde or with the fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import splu

SEED = 3
LAYERS = np.array([5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]) / 100.0
SOIL = np.array([3.2e-7, 4.1e-7, 5.0e-7, 6.2e-7, 5.5e-7, 4.6e-7])
PLATE = np.array([1.4e-5, 0.8e-5, 1.0e-5, 1.9e-5])
SIDE = 1.0  # m, of plate and field
PLATE_SENSORS = [(0.2, 0.3), (0.3, 0.7), (0.6, 0.2), (0.7, 0.8), (0.8, 0.4)]
FIELD_SENSORS = [(x, y) for x in np.arange(1, 6) / 6 for y in np.arange(1, 6) / 6]
MEAN = 1.0e-5  # m^2/s, median of the field


@dataclass(frozen=True)
class Job:
    """Job of a user.

    Attributes
    ----------
    name, title
        Key of the job, and description.
    table
        Random generator -> table.
    case
        Case in TOML, which reads `data.csv`.
    truth
        Label of an unknown -> true value; empty for a field.
    part, whole
        Bounds on the time relative to the fit: without imports and figure, and of whole processes.
    """

    name: str
    title: str
    table: Callable[[np.random.Generator], pd.DataFrame]
    case: str
    truth: dict[str, float]
    part: float
    whole: float

    def write(self, folder: Path, rows: int | None = None) -> None:
        """Write the case and its table, or only the table's first rows, into a folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self.table(np.random.default_rng(SEED))[:rows].to_csv(folder / "data.csv", index=False)
        (folder / "case.toml").write_text(self.case)


# --- volumes on an interval --------------------------------------------------------------------


def followed(A: Any, B: Any, C: Any, inputs: Any, h: float, u: Any, *, hold: bool = False) -> Any:
    """Return C u at all rows of inputs b, with row spacing h, for the exact u' = A u + B b."""
    n, m = B.shape
    whole = np.zeros((n + 2 * m, n + 2 * m))
    whole[:n, :n], whole[:n, n : n + m] = A * h, B * h
    whole[n : n + m, n + m :] = np.eye(m)
    step = scipy.linalg.expm(whole)[:n]
    rows = [C @ u]
    for b, after in pairwise(inputs):
        change = np.zeros(m) if hold else after - b
        u = step @ np.concatenate([u, b, change])
        rows.append(C @ u)
    return np.array(rows)


def conduction(faces: Any, alpha: Any) -> tuple[Any, Any]:
    """Return A and B of conduction between given end values, for `alpha` of each volume."""
    width = np.diff(faces)
    resist = 0.5 * width / alpha
    between = 1.0 / np.concatenate([resist[:1], resist[:-1] + resist[1:], resist[-1:]])
    A = np.diag(-(between[:-1] + between[1:]) / width)
    A += np.diag(between[1:-1] / width[:-1], 1) + np.diag(between[1:-1] / width[1:], -1)
    B = np.zeros((len(width), 2))
    B[0, 0], B[-1, 1] = between[0] / width[0], between[-1] / width[-1]
    return A, B


def at(faces: Any, places: Any) -> Any:
    """Return the matrix that interpolates values of volumes to given positions."""
    centres = 0.5 * (faces[1:] + faces[:-1])
    return np.array([np.interp(places, centres, row) for row in np.eye(len(centres))]).T


def rod(rng: np.random.Generator) -> pd.DataFrame:
    """Simulate a rod with a heat loss to surroundings at 20 degC."""
    t = 10.0 * np.arange(4000)
    faces, places = np.linspace(0.0, 0.4, 201), [0.08, 0.16, 0.24, 0.32]
    A, B = conduction(faces, np.full(200, 2.0e-5))
    ends = np.column_stack([
        30.0 + 8.0 * np.sin(t / 700.0) + 4.0 * np.sin(t / 2300.0), 22.0 + 3.0 * np.sin(t / 1500.0)
    ])  # fmt: skip
    loss = 2.0e-4
    inputs = np.column_stack([ends, np.full(len(t), 20.0)])
    B = np.column_stack([B, np.full(200, loss)])
    start = np.interp(0.5 * (faces[1:] + faces[:-1]), [0.0, 0.4], ends[0])
    exact = followed(A - loss * np.eye(200), B, at(faces, places), inputs, 10.0, start)
    noisy = exact + 0.05 * rng.standard_normal(exact.shape)
    columns = {f"T{k + 1}": noisy[:, k] for k in range(4)}
    return pd.DataFrame({"t": t, "left": ends[:, 0], "right": ends[:, 1], **columns}).round(5)


def soil(rng: np.random.Generator) -> pd.DataFrame:
    """Simulate six layers of soil below varying weather, with offsets of the sensors."""
    hours = np.arange(2928)
    t, days = 3600.0 * hours, hours / 24.0
    weather = np.cumsum(rng.standard_normal(len(t))) * 0.15
    weather -= np.linspace(weather[0], weather[-1], len(t))
    ends = np.column_stack([
        8.0 + 0.1 * days + 5.0 * np.sin(2 * np.pi * days) + weather, 7.5 + 0.09 * days
    ])  # fmt: skip
    faces = np.linspace(0.05, 0.60, 221)
    centres = 0.5 * (faces[1:] + faces[:-1])
    alpha = SOIL[np.searchsorted(LAYERS, centres) - 1]
    A, B = conduction(faces, alpha)
    start = np.interp(centres, [0.05, 0.60], ends[0])
    exact = followed(A, B, at(faces, [0.1, 0.2, 0.4, 0.5]), ends, 3600.0, start)
    noisy = exact + 0.1 * rng.standard_normal(exact.shape) + np.array([0.15, -0.2, 0.1, -0.1])
    columns = {f"T{k}": noisy[:, i] for i, k in enumerate((10, 20, 40, 50))}
    return pd.DataFrame({"t": t, "T05": ends[:, 0], "T60": ends[:, 1], **columns}).round(5)


def column(rng: np.random.Generator) -> pd.DataFrame:
    """Simulate three pulses of a tracer through a column."""
    minutes = np.arange(600) / 3.0
    faces = np.linspace(0.0, 20.0, 801)
    width, D, v = faces[1], 16.2, 27.0
    A, B = conduction(faces, np.full(800, D))
    A[-1, -1] += B[-1, 1]  # no dispersion through the end
    A += np.diag(np.full(799, 0.5 * v / width), -1) - np.diag(np.full(799, 0.5 * v / width), 1)
    A[0, 0] -= 0.5 * v / width
    A[-1, -1] -= 0.5 * v / width
    inlet = B[:, :1].copy()
    inlet[0] += v / width
    c_in = (minutes % 80.0 < 30.0).astype(float)
    C = at(faces, [8.0, 16.0])
    exact = followed(A, inlet, C, c_in[:, None], 1.0 / 180.0, np.zeros(800), hold=True)
    noisy = exact + 0.01 * rng.standard_normal(exact.shape)
    return pd.DataFrame(
        {"minute": minutes.round(6), "c_in": c_in, "c8": noisy[:, 0], "c16": noisy[:, 1]}
    ).round(6)


# --- volumes on a square -----------------------------------------------------------------------


def square(alpha: Any, ends: Any, h: float, sensors: Any, substeps: int = 3) -> Any:
    """Return readings of a square with two given sides, for `alpha` of volumes, shape (n, n)."""
    n = len(alpha)
    width = SIDE / n
    number = np.arange(n * n).reshape(n, n)  # first index along x
    pairs = [(number[:-1], number[1:], alpha[:-1], alpha[1:])]
    pairs.append((number[:, :-1], number[:, 1:], alpha[:, :-1], alpha[:, 1:]))
    A: Any = sp.csr_array((n * n, n * n))
    for one, other, first, second in pairs:
        i, j = one.ravel(), other.ravel()
        flow = (2.0 / (1.0 / first + 1.0 / second)).ravel() / width**2
        rows, columns = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
        A += sp.csr_array((np.concatenate([flow, flow, -flow, -flow]), (rows, columns)), A.shape)
    B = np.zeros((n * n, 2))
    for side, edge in enumerate((0, -1)):
        B[number[edge], side] = 2.0 * alpha[edge] / width**2
    A -= sp.diags_array(B.sum(axis=1))
    dt = h / substeps
    solve = splu((sp.eye_array(n * n) - 0.5 * dt * A).tocsc()).solve
    explicit = (sp.eye_array(n * n) + 0.5 * dt * A).tocsr()
    centres = (np.arange(n) + 0.5) * width
    each = [[np.array([np.interp(p, centres, e) for e in np.eye(n)]) for p in at] for at in sensors]
    C = sp.csr_array([np.outer(along, across).ravel() for along, across in each])
    u = np.repeat(np.interp(centres, [0.0, SIDE], ends[0]), n)
    readings = [C @ u]
    for before, after in pairwise(ends):
        for k in range(substeps):
            mean = before + (k + 0.5) / substeps * (after - before)
            u = solve(explicit @ u + dt * (B @ mean))
        readings.append(C @ u)
    return np.array(readings)


def _square_table(
    rng: np.random.Generator, alpha: Any, samples: int, h: float, sensors: Any
) -> pd.DataFrame:
    t = h * np.arange(samples)
    ends = np.column_stack(
        [20.0 + 10.0 * np.sin(t / (80.0 * h)), 20.0 + 6.0 * np.sin(t / (50.0 * h))]
    )
    exact = square(alpha, ends, h, sensors)
    noisy = exact + 0.05 * rng.standard_normal(exact.shape)
    columns = {f"T{k + 1}": noisy[:, k] for k in range(len(sensors))}
    return pd.DataFrame({"t": t, "left": ends[:, 0], "right": ends[:, 1], **columns}).round(5)


def plate(rng: np.random.Generator) -> pd.DataFrame:
    """Simulate a plate with four different quarters."""
    alpha = np.repeat(np.repeat(PLATE.reshape(2, 2), 60, axis=0), 60, axis=1)
    return _square_table(rng, alpha, 300, 200.0, PLATE_SENSORS)


def true_field(x: Any, y: Any) -> Any:
    """Return the diffusivity of the field, m^2/s."""
    log = 0.5 * np.cos(np.pi * x) * np.cos(np.pi * y) + 0.35 * np.sin(2.0 * np.pi * x * y)
    return MEAN * np.exp(log)


def field(rng: np.random.Generator) -> pd.DataFrame:
    """Simulate a square with a smooth field as diffusivity."""
    centres = (np.arange(90) + 0.5) / 90
    alpha = true_field(centres[:, None], centres[None])
    return _square_table(rng, alpha, 100, 600.0, FIELD_SENSORS)


# --- cases -------------------------------------------------------------------------------------

ROD_CASE = """
equation = "heat"
initial = "interpolate"
mesh = { from = 0, to = "40 cm", cells = 40 }
data = { file = "data.csv", time = "t", time_unit = "s" }
inputs.ambient = "20 degC"
[unknowns]
alpha = { prior = "4e-5 m^2/s", std = "3e-5 m^2/s", transform = "log" }
loss = { prior = "4e-4 1/s", std = "4e-4 1/s", transform = "log" }
[channels]
left = { role = "boundary", column = "left", at = "left" }
right = { role = "boundary", column = "right", at = "right" }
T1 = { role = "sensor", column = "T1", at = "8 cm", noise = "0.05 K" }
T2 = { role = "sensor", column = "T2", at = "16 cm", noise = "0.05 K" }
T3 = { role = "sensor", column = "T3", at = "24 cm", noise = "0.05 K" }
T4 = { role = "sensor", column = "T4", at = "32 cm", noise = "0.05 K" }
"""
SOIL_CASE = """
equation = "heat"
initial = "interpolate"
mesh = { from = "5 cm", to = "60 cm", cells = 55 }
data = { file = "data.csv", time = "t", time_unit = "s" }
[unknowns.alpha]
prior = "5e-7 m^2/s"
std = "2e-7 m^2/s"
transform = "log"
[unknowns.alpha.regions]
a = ["5 cm", "10 cm"]
b = ["10 cm", "20 cm"]
c = ["20 cm", "30 cm"]
d = ["30 cm", "40 cm"]
e = ["40 cm", "50 cm"]
f = ["50 cm", "60 cm"]
[channels]
T05 = { role = "boundary", column = "T05", at = "left" }
T60 = { role = "boundary", column = "T60", at = "right" }
T10 = { role = "sensor", column = "T10", at = "10 cm", noise = "0.1 K", offset = "0.2 K" }
T20 = { role = "sensor", column = "T20", at = "20 cm", noise = "0.1 K", offset = "0.2 K" }
T40 = { role = "sensor", column = "T40", at = "40 cm", noise = "0.1 K", offset = "0.2 K" }
T50 = { role = "sensor", column = "T50", at = "50 cm", noise = "0.1 K", offset = "0.2 K" }
"""
COLUMN_CASE = """
equation = "advection_dispersion"
initial = 0
options.inlet = "fixed"
mesh = { from = 0, to = "20 cm", cells = 100 }
data = { file = "data.csv", time = "minute", time_unit = "min" }
[unknowns]
D = { prior = "12 cm^2/h", std = "12 cm^2/h", transform = "log" }
v = { prior = "30 cm/h", std = "15 cm/h", transform = "log" }
[channels]
c_in = { role = "input", column = "c_in", between = "hold" }
c8 = { role = "sensor", column = "c8", at = "8 cm", noise = 0.01 }
c16 = { role = "sensor", column = "c16", at = "16 cm", noise = 0.01 }
"""


def _square_case(cells: int, unknown: str, sensors: Any) -> str:
    lines = [
        'equation = "heat"',
        'initial = "20 degC"',
        f'mesh = {{ x = ["0 m", "1 m"], y = ["0 m", "1 m"], cells = [{cells}, {cells}] }}',
        'data = { file = "data.csv", time = "t", time_unit = "s" }',
        unknown,
        "[channels]",
        *(f'{s} = {{ role = "boundary", column = "{s}", at = "{s}" }}' for s in ("left", "right")),
    ]
    for k, (x, y) in enumerate(sensors):
        keys = f'role = "sensor", column = "T{k + 1}", at = [{x:.8g}, {y:.8g}], noise = "0.05 K"'
        lines.append(f"T{k + 1} = {{ {keys} }}")
    return "\n".join(lines) + "\n"


QUARTERS = """[unknowns.alpha]
prior = "1e-5 m^2/s"
std = "0.5e-5 m^2/s"
transform = "log"
[unknowns.alpha.regions]
a = ["0 m", "0.5 m", "0 m", "0.5 m"]
b = ["0 m", "0.5 m", "0.5 m", "1 m"]
c = ["0.5 m", "1 m", "0 m", "0.5 m"]
d = ["0.5 m", "1 m", "0.5 m", "1 m"]"""
FIELD = """[unknowns.alpha]
prior = "1e-5 m^2/s"
std = "0.6e-5 m^2/s"
transform = "log"
field = true
length = "0.3 m\""""

JOBS = (
    Job(
        name="rod",
        title="rod, 41 nodes, 2 unknowns, 4 sensors, 4000 samples",
        table=rod,
        case=ROD_CASE,
        truth={"alpha": 2.0e-5, "loss": 2.0e-4},
        part=3.0,
        whole=5.0,
    ),
    Job(
        name="soil",
        title="soil, 6 layers and 4 offsets, 2928 samples",
        table=soil,
        case=SOIL_CASE,
        truth={f"alpha[{name}]": value for name, value in zip("abcdef", SOIL, strict=True)},
        part=3.0,
        whole=5.0,
    ),
    Job(
        name="plate",
        title="plate, 1e4 nodes, 4 unknowns, 5 sensors, 300 samples",
        table=plate,
        case=_square_case(100, QUARTERS, PLATE_SENSORS),
        truth={f"alpha[{name}]": value for name, value in zip("abcd", PLATE, strict=True)},
        part=1.5,
        whole=2.0,
    ),
    Job(
        name="column",
        title="advection-dispersion, 2 unknowns, 2 sensors, 600 samples",
        table=column,
        case=COLUMN_CASE,
        truth={"D": 16.2, "v": 27.0},
        part=3.0,
        whole=5.0,
    ),
    Job(
        name="field",
        title="field on 3249 nodes, 25 sensors, 100 samples",
        table=field,
        case=_square_case(56, FIELD, FIELD_SENSORS),
        truth={},
        part=2.0,
        whole=2.5,
    ),
)
