"""Checks that temporary sensor failures and outliers in the first row do not spoil the estimates.

Readings of a rod come from independent finite differences, and readings of a slab from the series
of the exact solution, so that the truth is known.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy.linalg

import livepde as lp
from livepde import cases, runs
from livepde.diagnostics.check_report import Check
from livepde.linalg import Array
from livepde.models import heat

ALPHA, LENGTH, STEP, NOISE = 1e-4, 0.4, 20.0, 0.05
AT = (0.1, 0.2, 0.3)
SLAB, FREQUENCY = 0.04, 2.0  # diffusivity of the slab, and angular frequency at its driven end
WITHIN = 4.0  # largest error of an estimate, in standard deviations
WIDER = 1.2  # largest ratio to the standard deviation without bad readings


def _left(t: float) -> float:
    return 20.0 + 15.0 * float(np.sin(2.0 * np.pi * t / 1200.0))


def _rod(rows: int) -> Array:
    """Return noisy readings by Crank-Nicolson, 160 cells, 8 steps per row, shape (rows, 3)."""
    cells, parts = 160, 8
    u, h = np.full(cells + 1, 20.0), STEP / parts
    r = 0.5 * ALPHA * h / (LENGTH / cells) ** 2
    bands = np.array([np.full(cells + 1, -r), np.full(cells + 1, 1.0 + 2.0 * r)] * 2)[:3]
    bands[2] = -r
    bands[0, :2] = bands[2, -2:] = 0.0
    bands[1, [0, -1]] = 1.0
    places, found = (np.array(AT) / LENGTH * cells).round().astype(int), []
    for k in range(rows):
        found.append(u[places])
        for j in range(parts):
            rhs = u.copy()
            rhs[1:-1] += r * (u[2:] - 2.0 * u[1:-1] + u[:-2])
            rhs[0], rhs[-1] = _left(k * STEP + (j + 1) * h), 20.0
            u = scipy.linalg.solve_banded((1, 1), bands, rhs)
    return np.array(found) + NOISE * np.random.default_rng(0).standard_normal((rows, 3))


def _slab(t: Array) -> Array:
    """Return exact readings at x = 0.3 and 0.6 of a slab on (0, 1), u = 0 at the start.

    With u = sin(w t) at the left and u = 0 at the right, u = (1 - x) sin(w t) + sum c_n(t) sin(n pi
    x), where c_n' + l c_n = -2 w cos(w t)/(n pi) and l = alpha (n pi)^2.
    """
    x, n = np.array([0.3, 0.6]), np.arange(1, 400)[:, None]
    w, rate = FREQUENCY, SLAB * (n * np.pi) ** 2
    answer = rate * np.cos(w * t) + w * np.sin(w * t) - rate * np.exp(-rate * t)
    c = -2.0 * w / (n * np.pi) * answer / (rate**2 + w**2)
    found: Array = np.outer(np.sin(w * t), 1.0 - x) + c.T @ np.sin(np.pi * n * x)
    return found


def _checked(name: str, estimate: Any, reference: Any, truth: float) -> list[Check]:
    (value, std), (_, usual) = estimate.parameters["alpha"], reference.parameters["alpha"]
    return [
        Check(f"{name}: standard deviations off the truth", abs(value - truth) / std, WITHIN, "<="),
        Check(f"{name}: interval over that without bad readings", std / usual, WIDER, "<="),
    ]


def _unplugged(count: int) -> list[Check]:
    """Check a run in which one of three sensors reads -127 for `count` rows, 50 before the end."""
    first, z = 200, _rod(250 + count)
    ends = {"left": lp.Channel("T_left"), "right": 20.0}

    def run(value: float) -> Any:
        model = heat(lp.interval(0.0, LENGTH, 40), lp.Normal(5e-5, std=3e-5), ends)
        points = lp.Points(dict(zip(("T_1", "T_2", "T_3"), AT, strict=True)), noise=NOISE)
        who = lp.Identifier(model, points, lp.SensitivityLaw(), u0=20.0)
        shown = z.copy()
        shown[first : first + count, 1] = value
        for k, row in enumerate(shown):
            estimate = who.step(k * STEP, row, {"T_left": _left(k * STEP)})
        return estimate

    return _checked(f"-127 for {count} rows", run(-127.0), run(np.nan), ALPHA)


def _nines() -> list[Check]:
    """Check a run in which one of two slab sensors reads -9999 for 20 rows, 130 before the end."""
    t = 0.05 * np.arange(300.0)
    z = _slab(t) + 0.01 * np.random.default_rng(1).standard_normal((len(t), 2))

    def run(value: float) -> Any:
        ends = {"left": lambda x, t: np.sin(FREQUENCY * t), "right": 0.0}
        model = heat(lp.interval(0.0, 1.0, 60), lp.LogNormal(0.08, std=0.06), ends)
        points = lp.Points([0.3, 0.6], noise=0.01)
        who = lp.Identifier(model, points, lp.SensitivityLaw(), u0=0.0)
        shown = z.copy()
        shown[150:170, 0] = value
        for moment, row in zip(t.tolist(), shown, strict=True):
            estimate = who.step(moment, row)
        return estimate

    return _checked("-9999 for 20 rows", run(-9999.0), run(np.nan), SLAB)


def _case(rows: Array, left: dict[int, float]) -> Any:
    """Run a case with the initial state from the first row, and return the last estimate."""
    sensors = "\n".join(
        f'T_{k + 1} = {{ role = "sensor", column = "T_{k + 1}", at = {x}, noise = {NOISE} }}'
        for k, x in enumerate(AT)
    )
    text = f"""
equation = "heat"
initial = "interpolate"
mesh = {{ from = 0, to = {LENGTH}, cells = 40 }}
data = {{ file = "rod.csv", time = "t", time_unit = "s" }}
unknowns.alpha = {{ prior = 5e-5, std = 3e-5 }}
law.kind = "sensitivity"
[channels]
T_left = {{ role = "boundary", column = "T_left", at = "left" }}
T_right = {{ role = "boundary", column = "T_right", at = "right" }}
{sensors}
"""
    lines = ["t,T_left,T_1,T_2,T_3,T_right"]
    for k, row in enumerate(rows.tolist()):
        cells = [k * STEP, left.get(k, _left(k * STEP)), *row, 20.0]
        lines.append(",".join(map(repr, cells)))
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "rod.csv").write_text("\n".join(lines) + "\n")
        (folder / "case.toml").write_text(text)
        prepared = cases.load(folder / "case.toml").prepare()
        return runs.drive(prepared.identifier, prepared.stream).result.last


def _first_rows() -> list[Check]:
    """Check runs in which, in the first row, a sensor reads 85 or a boundary value is 9999."""
    z = _rod(150)
    reference, hot = _case(z, {}), z.copy()
    hot[0, 1] = 85.0
    return [
        *_checked("85 in the first row", _case(hot, {}), reference, ALPHA),
        *_checked("boundary 9999 in the first row", _case(z, {0: 9999.0}), reference, ALPHA),
    ]


def checks() -> list[Check]:
    """Return the checks of failing sensors."""
    return [*_unplugged(12), *_unplugged(50), *_nines(), *_first_rows()]
