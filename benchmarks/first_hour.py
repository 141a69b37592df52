"""Coverage of the walks of docs/first-hour.md for other truths.

Truths come from independent codes, which share only the priors with livepde. Walls, ground and
aquifer use finite volumes with matrix exponentials in time, the plate finite differences with small
steps. The column uses the solution of Ogata and Banks (1961), and the pipe cells that move with the
water. `write` writes the tables of examples/first_hour.
"""

from __future__ import annotations

import contextlib
import math
import runpy
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import solve_banded, toeplitz
from scipy.signal import lfilter
from scipy.sparse.linalg import splu
from scipy.special import erfc, erfcx

from benchmarks import ROOT
from benchmarks.honest.linear import Linear, diffusion, fine_times
from benchmarks.honest.problems.borehole import Borehole
from benchmarks.jobs import each
from livepde.cases import load
from livepde.cases.case import Case, Prepared
from livepde.diagnostics.check_report import Check, Table
from livepde.estimate import Estimate
from livepde.laws import Problem
from livepde.readout import Marginal
from livepde.runs import Outcome

Array = NDArray[Any]
FOLDER = ROOT / "examples" / "first_hour"
WALKS = ("furnace", "borehole", "plate", "pumping", "column", "heater", "wall", "pipe")
WRITTEN = 0  # seed of the tables in the examples
SHARE = 0.9  # smallest share of vertices at which the interval of a field contains the truth
TRUSTED = "trusted"  # name of a score of a run
HELD = 0.9  # smallest share of seeds whose interval contains the truth: 18 of 20
WIDTH, EXACT = "width of ", "exact width of "
WIDEST = 1.3  # largest width over the width of a batch fit with noisy inputs
NUDGE = 1e-3  # relative change of an unknown, for derivatives of the readings
Factors: TypeAlias = Mapping[str, float]  # unknown -> factor on its drawn value
AS_DRAWN: Factors = {}

# The furnace wall.
THICK, CAPACITY = 0.1, 3.7e6
DEPTHS = (0.005, 0.02, 0.04, 0.07)
KELVIN = 0.3  # noise of its thermocouples

# The outer wall of a house.
WALL = 0.24
WALL_STEP = 600.0  # s
WALL_KELVIN, WALL_FLUX = 0.1, 0.3  # noise of its surface thermometers and its heat-flux plate
BEFORE = 3 * 86400.0  # s, simulated time before the table begins

# The L-shaped plate, with sides of 1 m.
SIDE = 60  # cells of the truth along 1 m
SENSORS = 30
PLATE_NOISE = 0.2
ALPHA, ALPHA_STD, LENGTH = 1e-4, 4e-5, 0.3  # prior of its diffusivity

# The aquifer, with a pumped well and two observation wells.
WELLS = (18.0, 63.0)  # m, distances from the pumped well
WELL, FAR = 0.1, 5000.0  # m, inner and outer radius
DRAWDOWN = 0.01  # m, noise of its loggers

# The column.
OUTLET = 10.0  # cm, position of its probe
CONCENTRATION = 0.01  # noise of the probe

# The buried pipe, read once a minute.
PIPE, PIPE_SENSORS = 400.0, (130.0, 270.0, 400.0)  # m
PIPE_CELL = 0.5  # m, of the truth
PIPE_AREA, WATER, SOIL = 7.854e-3, 4.1e6, 9.0  # m^2, J/(m^3 K), degC
VALVE = 120.0  # s, time constant with which its supply follows the set point
PIPE_KELVIN, SUPPLY_KELVIN = 0.15, 0.03

# The wall with a heater that a controller switches.
BRICK, BRICK_CAPACITY, BRICK_DEPTHS = 0.1, 1.4e6, (0.01, 0.03, 0.06)
POWER = 800.0  # W/m^2
BRICK_KELVIN = 0.2


def furnace(seed: int) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and final truths of a wall with random conductivity and heat flux."""
    rng = np.random.default_rng([seed, 1])
    k = 20.0 * np.exp(0.5 * rng.standard_normal())
    times = np.arange(0.0, 3601.0, 2.0)
    fine = fine_times(times)
    size, periods = 1e4 * rng.standard_normal(3), rng.uniform(1500.0, 4000.0, 3)
    flux = 2e4 + sum(a * np.sin(2 * np.pi * fine / p) for a, p in zip(size, periods, strict=True))
    cold = 25.0 + 5.0 * fine / 3600.0
    cells = 200
    width = THICK / cells
    between = np.full(cells, k / width)
    loss, B = np.zeros(cells), np.zeros((cells, 2))
    loss[-1], B[0, 0], B[-1, 1] = 2.0 * between[-1], 1.0, 2.0 * between[-1]
    middles = width * (np.arange(cells) + 0.5)
    C = np.array([np.interp(depth, middles, row) for depth in DEPTHS for row in np.eye(cells)])
    C = C.reshape(len(DEPTHS), cells)
    capacity = np.full(cells, CAPACITY * width)
    system = diffusion(between[:-1], capacity, loss, B, C, np.zeros((len(DEPTHS), 2)))
    # Temperatures are relative to the initial 25 degC.
    shown = 25.0 + system.respond(np.column_stack([flux, cold - 25.0]), 2.0)
    shown += KELVIN * rng.standard_normal(shown.shape)
    header = ["time_s", *(f"T_{n}" for n in range(1, len(DEPTHS) + 1)), "T_cold"]
    table = np.column_stack([times, shown, np.interp(times, fine, cold)])
    return header, table, {"k": float(k), "J": float(flux[-1])}


def wall(
    seed: int, days: float = 3.0, *, by: Factors = AS_DRAWN
) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and truths of a wall with a curved initial profile."""
    rng = np.random.default_rng([seed, 5])
    k, capacity = (
        0.8 * np.exp(0.5 * rng.standard_normal()),
        1.5e6 * np.exp(rng.standard_normal() / 3.0),
    )
    times = np.arange(-BEFORE, 86400.0 * days + 1.0, WALL_STEP)
    fine = fine_times(times)
    phases = 2.0 * np.pi * rng.uniform(size=5)
    outside = 4.0 + 4.0 * np.sin(2 * np.pi * fine / 86400.0 + phases[0])
    outside += np.sin(2 * np.pi * fine / 40000.0 + phases[1])
    # A cold front two hours before the table begins makes the initial profile curved.
    outside -= 3.0 * (1.0 + np.tanh((fine + 7200.0) / 1800.0))
    # Flux for 16 K across the wall, with a heating that switches by day and night.
    flux = 16.0 * k / WALL * (1.0 + 0.25 * np.tanh(3.0 * np.sin(2 * np.pi * fine / 86400.0)))
    for phase, period in zip(phases[2:], (20000.0, 33000.0, 60000.0), strict=True):
        flux += 2.0 * np.sin(2 * np.pi * fine / period + phase)
    k, capacity = k * by.get("k", 1.0), capacity * by.get("C", 1.0)
    faces = _faces(k, capacity)
    inside = faces.respond(np.column_stack([flux, outside]), WALL_STEP)[:, 0]
    begins = times >= 0.0
    t = times[begins]
    shown = [inside[begins], np.interp(t, fine, outside), np.interp(t, fine, flux)]
    noise = WALL_KELVIN, WALL_KELVIN, WALL_FLUX
    columns = [
        values + std * rng.standard_normal(len(t)) for values, std in zip(shown, noise, strict=True)
    ]
    header = ["time_s", "T_inside", "T_outside", "q_inside"]
    return header, np.column_stack([t, *columns]), {"k": float(k), "C": float(capacity)}


def _faces(k: float, capacity: float) -> Linear:
    """Return the system from flux and outer temperature to the temperature of the inner face."""
    cells = 200
    width = WALL / cells
    between = np.full(cells, k / width)
    loss, B = np.zeros(cells), np.zeros((cells, 2))
    loss[-1], B[0, 0], B[-1, 1] = 2.0 * between[-1], 1.0, 2.0 * between[-1]
    # The inner face is half a volume away from the first cell centre.
    C, D = np.eye(1, cells), np.array([[0.5 * width / k, 0.0]])
    return diffusion(between[:-1], np.full(cells, capacity * width), loss, B, C, D)


def wall_noise(truths: Factors, readings: int) -> Array:
    """Return the covariance of the inner face due to noise of the flux and the outer temperature.

    Inputs are interpolated linearly, so that each reading acts as a triangle over two intervals.
    """
    times = WALL_STEP * np.arange(readings + 1.0)
    fine = fine_times(times) / WALL_STEP
    triangle = np.maximum(1.0 - np.abs(fine - 1.0), 0.0)[:, None]
    faces, covariance = _faces(truths["k"], truths["C"]), np.zeros((readings, readings))
    for std, column in zip((WALL_FLUX, WALL_KELVIN), np.eye(2), strict=True):
        answer = std * faces.respond(triangle * column, WALL_STEP)[1:, 0]
        H = toeplitz(answer, np.zeros(readings))
        covariance += H @ H.T
    return covariance


def borehole(seed: int) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and truths of a thermal response test."""
    problem, rng = Borehole(), np.random.default_rng([seed, 2])
    theta, shown = problem.draw(rng)
    shown = shown + problem.noise * rng.standard_normal(shown.shape)
    table = np.column_stack([problem.times, shown, problem.inputs(problem.times)])
    truths = {
        name: float(np.exp(item.value(theta, 0)[0])) for name, item in problem.latents.items()
    }
    return ["time_s", "T_fluid", "Q_W"], table, truths


def held(system: Linear, times: Array, g: Array) -> Array:
    """Return the outputs of a system with diagonal A and piecewise constant inputs.

    Parameters
    ----------
    times, g
        Shapes (times,) and (times, inputs); the state is zero at the first time.
    """
    y, shown = np.zeros(len(system.A)), []
    for k, t in enumerate(times):
        if k:
            z = system.A * (t - times[k - 1])
            share = np.where(np.abs(z) < 1e-12, 1.0, np.expm1(z) / np.where(z == 0.0, 1.0, z))
            y = np.exp(z) * y + (t - times[k - 1]) * share * (system.B @ g[k - 1])
        shown.append(system.C @ y)
    return np.array(shown)


def aquifer(T: float, S: float, times: Array, rate: Array) -> Array:
    """Return the drawdown in the observation wells, (times, wells), for stepwise rates in m^3/s."""
    cells = 400
    faces = np.linspace(np.log(WELL), np.log(FAR), cells + 1)
    middles, width = 0.5 * (faces[1:] + faces[:-1]), faces[1] - faces[0]
    between = np.full(cells, 2.0 * np.pi * T / width)
    loss, B = np.zeros(cells), np.zeros((cells, 1))
    loss[-1], B[0, 0] = 2.0 * between[-1], 1.0
    C = np.array([[np.interp(np.log(r), middles, row) for row in np.eye(cells)] for r in WELLS])
    capacity = S * np.pi * np.diff(np.exp(2.0 * faces))
    system = diffusion(between[:-1], capacity, loss, B, C, np.zeros((len(WELLS), 1)))
    return held(system, times, rate[:, None])


def pumping(seed: int, *, by: Factors = AS_DRAWN) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and truths of a pumping test with three rates and a recovery."""
    rng = np.random.default_rng([seed, 5])
    T, S = 4e-3 * np.exp(0.4 * rng.standard_normal()), 3e-4 * np.exp(0.4 * rng.standard_normal())
    T, S = T * by.get("k", 1.0), S * by.get("Ss", 1.0)
    minutes = np.arange(0.0, 901.0)
    rates = np.array([0.0, *np.round(np.sort(rng.uniform(5.0, 18.0, 3)), 1), 0.0])  # L/s
    rate = rates[np.searchsorted([10.0, 160.0, 340.0, 540.0], minutes, side="right")]
    shown = aquifer(T, S, 60.0 * minutes, 1e-3 * rate)
    shown += DRAWDOWN * rng.standard_normal(shown.shape)
    header = ["time_min", "Q_L_s", *(f"s_{r:g}m" for r in WELLS)]
    return header, np.column_stack([minutes, rate, shown]), {"k": float(T), "Ss": float(S)}


def breakthrough(v: float, D: float, hours: Array) -> Array:
    """Return the concentration at the probe after a step at the inlet (Ogata and Banks)."""
    t = np.where(hours > 0.0, hours, np.nan)
    a, b = ((OUTLET + sign * v * t) / (2.0 * np.sqrt(D * t)) for sign in (-1.0, 1.0))
    # exp(v x/D) erfc(b) without the overflow of the first factor: v x/D - b^2 = -a^2.
    step = 0.5 * (erfc(a) + np.exp(-(a**2)) * erfcx(b))
    return np.where(hours > 0.0, step, 0.0)


def column(seed: int, *, by: Factors = AS_DRAWN) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and truths of a tracer pulse through a column."""
    rng = np.random.default_rng([seed, 6])
    v, D = 27.0 * np.exp(0.2 * rng.standard_normal()), 16.0 * np.exp(0.4 * rng.standard_normal())
    v, D = v * by.get("v", 1.0), D * by.get("D", 1.0)
    minutes = np.arange(0.0, 181.0, 4.0)
    stop = 4.0 * rng.integers(15, 26)  # end of the pulse
    c = breakthrough(v, D, minutes / 60.0) - breakthrough(v, D, (minutes - stop) / 60.0)
    c += CONCENTRATION * rng.standard_normal(len(c))
    table = np.column_stack([minutes, np.where(minutes < stop, 1.0, 0.0), c])
    return ["time_min", "c_in", "c"], table, {"v": float(v), "D": float(D)}


def heater(seed: int, *, by: Factors = AS_DRAWN) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and truths of a wall with a heater that a controller switches.

    The table lists the heater only at its changes, between readings of the thermometers.
    """
    rng = np.random.default_rng([seed, 7])
    k, h = 0.8 * np.exp(0.3 * rng.standard_normal()), 10.0 * np.exp(0.3 * rng.standard_normal())
    k, h = k * by.get("k", 1.0), h * by.get("h", 1.0)
    read = np.arange(0.0, 8 * 3600.0 + 1.0, 60.0)
    stretches = rng.uniform(300.0, 2400.0, 200)
    changes = np.round(np.append(0.0, np.cumsum(stretches)), 1)
    changes = np.append(0.0, changes[1:][changes[1:] < read[-1]])
    states = np.arange(len(changes)) % 2 * POWER
    times = np.union1d(read, changes)
    power = states[np.searchsorted(changes, times, side="right") - 1]
    cells = 200
    width = BRICK / cells
    middles = width * (np.arange(cells) + 0.5)
    between = np.full(cells, k / width)
    loss, B = np.zeros(cells), np.zeros((cells, 1))
    loss[-1], B[0, 0] = 1.0 / (1.0 / h + 0.5 / between[-1]), 1.0
    seen = [[np.interp(x, middles, row) for row in np.eye(cells)] for x in BRICK_DEPTHS]
    nothing = np.zeros((len(BRICK_DEPTHS), 1))
    system = diffusion(
        between[:-1], np.full(cells, BRICK_CAPACITY * width), loss, B, np.array(seen), nothing
    )
    shown = 20.0 + held(system, times, power[:, None])
    shown += BRICK_KELVIN * rng.standard_normal(shown.shape)
    shown[~np.isin(times, read)] = np.nan
    logged = np.where(np.isin(times, changes), power, np.nan)
    header = ["time_s", "heater_W_m2", *(f"T_{1e3 * x:g}mm" for x in BRICK_DEPTHS)]
    truths = {"k": float(k), "h": float(h)}
    return header, np.column_stack([times, logged, shown]), truths


def moved(K: float, D: float, flow: Any, supply: Any, until: float) -> tuple[Array, Array]:
    """Return times, and temperatures at the sensors, of water that moves by one cell per step.

    Advection is thereby exact. Dispersion uses the Crank-Nicolson scheme between two half steps of
    the heat loss, which is exact.

    Parameters
    ----------
    flow, supply
        Functions of time: m^3/h and degC.
    """
    cells = round((PIPE + 50.0) / PIPE_CELL)  # the outlet is beyond the last sensor
    x = PIPE_CELL * (np.arange(cells) + 0.5)
    u, t = SOIL + (supply(0.0) - SOIL) * np.exp(-K * x / (WATER * flow(0.0) / 3600.0)), 0.0
    times, shown = [t], [np.interp(PIPE_SENSORS, x, u)]
    bands = np.zeros((3, cells))
    while t < until:
        step = PIPE_CELL * PIPE_AREA / (flow(t) / 3600.0)
        fed = supply(t + 0.5 * step)
        u = np.append(fed, u[:-1])
        kept = np.exp(-0.5 * step * K / (WATER * PIPE_AREA))
        u = SOIL + (u - SOIL) * kept
        r = 0.5 * D * step / PIPE_CELL**2
        bands[0, 1:] = bands[2, :-1] = -r
        bands[1] = 1.0 + 2.0 * r
        bands[1, -1] = 1.0 + r
        bands[1, 0] = 1.0 + 3.0 * r  # the inlet is half a cell away
        change = np.diff(u, prepend=2.0 * fed - u[0], append=u[-1])
        right = u + r * np.diff(change)
        right[0] += 2.0 * r * fed
        u = solve_banded((1, 1), bands, right)
        u = SOIL + (u - SOIL) * kept
        t += step
        times.append(t)
        shown.append(np.interp(PIPE_SENSORS, x, u))
    return np.array(times), np.array(shown)


def pipe(
    seed: int, minutes: int = 300, *, by: Factors = AS_DRAWN
) -> tuple[list[str], Array, dict[str, float]]:
    """Return header, table and truths of a pipe whose supply changes between set points."""
    rng = np.random.default_rng([seed, 8])
    K, D = 1.0 * np.exp(0.3 * rng.standard_normal()), 0.1 * np.exp(0.4 * rng.standard_normal())
    K, D = K * by.get("K", 1.0), D * by.get("D", 1.0)
    fine = np.arange(0.0, 60.0 * minutes + 121.0)
    changes = np.cumsum(rng.uniform(1200.0, 3600.0, minutes))
    points = rng.uniform(65.0, 85.0, minutes + 1)
    wanted = points[np.searchsorted(changes, fine, side="right")]
    supply = lfilter([1.0 / VALVE], [1.0, 1.0 / VALVE - 1.0], wanted - wanted[0]) + wanted[0]
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    flow = 10.0 + 1.5 * np.sin(2 * np.pi * fine / 5400.0 + phase[0])
    flow += 0.5 * np.sin(2 * np.pi * fine / 1500.0 + phase[1])
    read = 60.0 * np.arange(minutes + 1.0)
    times, shown = moved(
        K,
        D,
        lambda t: float(np.interp(t, fine, flow)),
        lambda t: float(np.interp(t, fine, supply)),
        float(read[-1]),
    )
    seen = np.column_stack([np.interp(read, times, column) for column in shown.T])
    seen += PIPE_KELVIN * rng.standard_normal(seen.shape)
    fed = np.interp(read, fine, supply) + SUPPLY_KELVIN * rng.standard_normal(len(read))
    header = ["time_s", "flow_m3_h", "T_supply", *(f"T_{x:g}" for x in PIPE_SENSORS)]
    table = np.column_stack([read, np.interp(read, fine, flow), fed, seen])
    return header, table, {"K": float(K), "D": float(D)}


def diffusivity(seed: int) -> Any:
    """Return the diffusivity alpha(x, y) of the plate, the exponential of random cosines."""
    rng = np.random.default_rng([seed, 3])
    j, k = np.meshgrid(np.arange(5), np.arange(5), indexing="ij")
    decay = 1.0 / (1.0 + (np.pi * LENGTH) ** 2 * (j**2 + k**2))
    size = np.where(j > 0, np.sqrt(2.0), 1.0) * np.where(k > 0, np.sqrt(2.0), 1.0) * decay
    weights = size * rng.standard_normal(decay.shape)
    scale = (ALPHA_STD / ALPHA) / np.sqrt(np.sum(decay**2))

    def alpha(x: Any, y: Any) -> Any:
        waves = sum(
            weights[a, b] * np.cos(np.pi * a * x) * np.cos(np.pi * b * y)
            for a in range(5)
            for b in range(5)
        )
        return ALPHA * np.exp(scale * waves)

    return alpha


def plate(seed: int) -> tuple[list[str], Array, Array]:
    """Return header and table of the plate, and the positions of its sensors."""
    rng, alpha = np.random.default_rng([seed, 4]), diffusivity(seed)
    width = 1.0 / SIDE
    line = width * (np.arange(SIDE) + 0.5)
    x, y = np.meshgrid(line, line, indexing="ij")
    inside = (x < 0.5) | (y < 0.5)
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    values = alpha(x, y)
    A = sp.lil_array((inside.sum(), inside.sum()))
    for shift in ((1, 0), (0, 1)):
        first = tuple(slice(None, -1 if s else None) for s in shift)
        second = tuple(slice(1 if s else None, None) for s in shift)
        both = inside[first] & inside[second]
        mean = 2.0 / (1.0 / values[first][both] + 1.0 / values[second][both]) / width**2
        for a, b, c in zip(number[first][both], number[second][both], mean, strict=True):
            A[a, b] += c
            A[b, a] += c
            A[a, a] -= c
            A[b, b] -= c
    edge = np.zeros(inside.sum())
    edge[number[0]] = 2.0 * values[0] / width**2
    A = sp.csc_array(A) - sp.diags_array(edge, format="csc")
    times, parts = np.arange(0.0, 6001.0, 60.0), 6
    step = 60.0 / parts
    one = sp.eye_array(len(edge), format="csc")
    solver, explicit = splu(sp.csc_array(one - 0.5 * step * A)), one + 0.5 * step * A

    def hot(t: Any) -> Any:
        return 20.0 + 30.0 * np.sin(2 * np.pi * t / 3000.0)

    places = _places()
    near = [int(number[tuple(np.minimum((at / width).astype(int), SIDE - 1))]) for at in places]
    u, rows = np.full(len(edge), 20.0), []
    for n, t in enumerate(times):
        if n:
            for part in range(parts):
                start = times[n - 1] + part * step
                u = solver.solve(
                    explicit @ u + 0.5 * step * edge * (hot(start) + hot(start + step))
                )
        rows.append([t, hot(t), *(u[near] + PLATE_NOISE * rng.standard_normal(len(near)))])
    return ["time_s", "T_hot", *(f"T_{k}" for k in range(SENSORS))], np.array(rows), places


def _places() -> Array:
    """Return the positions of the plate's sensors, cell centres that do not depend on the seed."""
    rng = np.random.default_rng(7)
    places: list[Array] = []
    while len(places) < SENSORS:
        at = (np.floor(SIDE * rng.uniform(0.05, 0.95, 2)) + 0.5) / SIDE
        if min(at) < 0.45 and all(np.linalg.norm(at - other) > 0.08 for other in places):
            places.append(at)
    return np.array(places)


# Walks with constant unknowns, for which `batch_fit` is available.
BATCH = {"pumping": pumping, "column": column, "heater": heater, "wall": wall, "pipe": pipe}
# Walks with significant noise of inputs -> covariance that it adds to the readings.
NOISY = {"wall": wall_noise}
TABLES = {
    "furnace": furnace,
    "borehole": borehole,
    "pumping": pumping,
    "column": column,
    "heater": heater,
    "wall": wall,
    "pipe": pipe,
}


def _cell(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def write(folder: Path, walk: str, seed: int = WRITTEN) -> dict[str, float]:
    """Write the tables of a walk into a folder, and return its true constants."""
    truths: dict[str, float] = {}
    if walk == "plate":
        header, table, places = plate(seed)
        lines = [f"T_{k},{x:.5f},{y:.5f}" for k, (x, y) in enumerate(places.tolist())]
        (folder / "places.csv").write_text("\n".join(["name,x,y", *lines]) + "\n")
    else:
        header, table, truths = TABLES[walk](seed)
    save(folder / f"{walk}.csv", header, table)
    return truths


def save(path: Path, header: Sequence[str], table: Array) -> None:
    """Write a table as CSV; NaN becomes an empty cell."""
    rows = [",".join(map(_cell, row)) for row in table.tolist()]
    path.write_text("\n".join([",".join(header), *rows]) + "\n")


def first_hour(walks: tuple[str, ...] = WALKS, *, seeds: int, progress: bool = False) -> Outcome:
    """Run each walk with several truths.

    Parameters
    ----------
    seeds
        Number of truths of each walk.
    """
    todo = [(walk, seed) for walk in walks for seed in range(seeds)]
    scores: dict[tuple[str, str], list[float]] = {}
    for (walk, _), scored in each(_scores, todo, "truths", progress=progress):
        for name, score in scored.items():
            scores.setdefault((walk, name), []).append(score)
    rows, widths, checks = [], [], []
    for (walk, name), values in scores.items():
        if name.startswith(EXACT):
            continue
        if name == TRUSTED:
            least = min(HELD, (len(values) - 1) / len(values))
            title = f"{walk}: share of runs that are trusted"
            checks.append(Check(title, float(np.mean(values)), least, ">="))
            continue
        if name.startswith(WIDTH):
            name = name.removeprefix(WIDTH)
            width, by_exact = (float(np.median(v)) for v in (values, scores[walk, EXACT + name]))
            widths.append((walk, name, len(values), by_exact, width))
            title = f"{walk}, {name}: width over that of a batch fit"
            checks.append(Check(title, width, WIDEST, "<="))
            continue
        holds = [value >= (SHARE if name == "alpha" else 1.0) for value in values]
        rows.append((walk, name, len(values), sum(holds), float(np.mean(values))))
        # One truth of several may lie outside, since 95 % intervals miss one of two truths with
        # probability 0.1. A single truth must lie inside.
        least = min(HELD, (len(holds) - 1) / len(holds)) if len(holds) > 1 else 1.0
        title = f"{walk}, {name}: share of intervals"
        checks.append(Check(title, float(np.mean(holds)), least, ">="))
    columns = ("walk", "unknown", "truths", "in the interval", "mean share")
    note = (
        "95 % intervals at the end of the run. The field alpha counts as inside if its intervals "
        f"contain the truth at {SHARE:.0%} of the vertices or more."
    )
    tables = [Table("Truths in their 95 % interval", columns, rows)]
    if widths:
        head = ("walk", "unknown", "truths", "exact inputs", "inputs as read")
        tables.append(Table("Median width of the interval over that of a batch fit", head, widths))
    return Outcome(tables=tables, checks=checks, notes=[note])


def _scores(walk: str, seed: int) -> dict[str, float]:
    """Run a walk, and return its scores: coverage, widths of intervals, and trust."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / FOLDER.relative_to(ROOT)
        shutil.copytree(FOLDER, folder)
        truths = write(folder, walk, seed)
        if walk == "plate":
            return _plate_scores(Path(place), folder / "plate.py", seed)
        case = load(folder / f"{walk}.toml", allow_code=True)
        prepared = case.prepare()
        result = prepared.identifier.run(prepared.stream)
        last = result.last
        if last is None:
            raise RuntimeError(f"{walk}: the run has no samples")
        held = {name: float(_holds(last[name], truth)) for name, truth in truths.items()}
        widths = _widths(walk, seed, case, prepared, last) if walk in BATCH else {}
        return {**held, **widths, TRUSTED: float(result.verdict.level == "trusted")}


def batch_fit(
    walk: str, seed: int, problem: Problem, columns: Factors, *, noisy: bool = False
) -> dict[str, float]:
    """Return the relative standard deviation of each unknown in a linearised batch fit.

    Readings are linearised in the logarithms of the unknowns by central differences. Both sides
    have the same noise, which cancels.

    Parameters
    ----------
    columns
        Column of each sensor -> its noise.
    noisy
        True: account for the noise of the inputs. False: the inputs are exact.
    """
    table, latent = BATCH[walk], problem.model.latent
    header, _, truths = table(seed)
    places = [header.index(name) for name in columns]
    rows = []
    for name in truths:
        ends = [table(seed, by={name: 1.0 + sign * NUDGE})[1][:, places] for sign in (1.0, -1.0)]
        change = (ends[0] - ends[1]) / (2.0 * NUDGE) / np.array([*columns.values()])
        rows.append(change[np.isfinite(change)])
    J = np.array(rows)
    if noisy and walk in NOISY:  # walks with a single sensor
        (std,) = columns.values()
        covariance = np.eye(len(J.T)) + NOISY[walk](truths, len(J.T)) / std**2
        J = np.linalg.solve(np.linalg.cholesky(covariance), J.T).T
    # The logarithms of all unknowns have normal priors.
    prior = [latent.deviations[latent.parts[name].part.start] for name in truths]
    variance = np.diag(np.linalg.inv(J @ J.T + np.diag(1.0 / np.square(prior))))
    return dict(zip(truths, np.sqrt(variance).tolist(), strict=True))


def _widths(
    walk: str, seed: int, case: Case, prepared: Prepared, last: Estimate
) -> dict[str, float]:
    """Return the width of each interval relative to batch fits with noisy and exact inputs."""
    problem, channels = prepared.identifier.problem, case.spec.channels
    names, noise = problem.observed.names, problem.observed.noise
    if noise is None:
        raise RuntimeError(f"{walk}: the case does not specify the noise")
    each = zip(names, noise.tolist(), strict=True)
    columns = {str(channels[sensor].column): std for sensor, std in each}
    widths = {}
    for kind, noisy in ((WIDTH, True), (EXACT, False)):
        for name, std in batch_fit(walk, seed, problem, columns, noisy=noisy).items():
            low, high = last[name].interval()
            widths[kind + name] = math.log(high / low) / (2.0 * 1.96 * std)
    return widths


def _plate_scores(clone: Path, program: Path, seed: int) -> dict[str, float]:
    with contextlib.chdir(clone):
        names = runpy.run_path(str(program))
    data, truth = names["data"].isel(snapshot=-1), diffusivity(seed)(*names["mesh"].p)
    held = (data["alpha_low"] <= truth) & (truth <= data["alpha_high"])
    return {"alpha": float(held.mean())}


def _holds(marginal: Marginal, truth: float) -> bool:
    low, high = marginal.interval()
    return bool(low <= truth <= high)
