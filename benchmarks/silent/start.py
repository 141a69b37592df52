"""Checks of initial boundary values, refits, vector sensors and log-normal moments.

The correct values come from finite differences for a boundary value at the start, from the exact
posterior for a refit with a time-varying unknown, from an exact solution for sensors of a vector,
and from closed forms for the moments of a log-normal unknown.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import solve_banded
from skfem import ElementVector

import livepde as lp
from livepde.diagnostics.check_report import Check

D = 0.3  # diffusivity of the rod
K = 0.05  # diffusivity of the plate
CLOSE = 0.003  # bound on the error of u(0.9) on 20 cells


def checks() -> list[Check]:
    """Return the checks of all sections below."""
    return [*_first_value(), *_moving(), *_vector(), *_moments()]


# --- an initial boundary value from u0 -----------------------------------------------------------


def _rod() -> lp.Identifier:
    mesh = lp.interval(0.0, 1.0, 20)
    ends: dict[str, Any] = {"left": 0.0, "right": lp.Channel("T")}
    model = lp.Model(
        lp.Field(mesh, lp.fem.linear(mesh), dirichlet=ends),
        {"s": lp.Normal(0.0, std=1.0)},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: D * lp.dot(lp.grad(u), lp.grad(v)) - x.inputs["Q"] * v,
        inputs=["Q"],
    )
    law = lp.SensitivityLaw(shadows=None)
    return lp.Identifier(model, lp.Points({"a": 0.9}, noise=0.01), law, u0=0.0, q0={"s": 0.0})


def _differences() -> float:
    """Return u(0.9) at t = 0.1 by implicit Euler, if u(1) rises linearly from 0 to 1."""
    cells, steps = 400, 1000
    r = D * (0.1 / steps) * cells**2
    bands = np.zeros((3, cells + 1))
    bands[1], bands[0, 2:], bands[2, :-2] = 1.0 + 2.0 * r, -r, -r
    bands[1, [0, cells]] = 1.0
    u = np.zeros(cells + 1)
    for k in range(steps):
        u[0], u[cells] = 0.0, (k + 1) / steps
        u = solve_banded((1, 1), bands, u)
    return float(u[round(0.9 * cells)])


def _first_value() -> list[Check]:
    expected = _differences()
    rod = _rod()
    forecast = float(rod.forecast([0.1], {"T": 1.0, "Q": 0.0})["a"][0])
    estimate = rod.step(0.1, {"a": np.nan, "T": 1.0, "Q": 0.0})
    found = float(rod.forecast([0.1])["a"][0])
    named = [item.subject for item in estimate.verdict.findings if item.what == "input"]
    return [
        Check(
            "error of u(0.9), boundary value at the start by u0", abs(found - expected), CLOSE, "<="
        ),
        Check(
            "the same of a forecast before the first sample", abs(forecast - expected), CLOSE, "<="
        ),
        Check(
            "inputs without a value at the start that are not named",
            float(named != ["Q"]),
            0.0,
            "<=",
        ),
    ]


# --- a refit with a time-varying unknown ---------------------------------------------------------

RATE, NOISE, EVERY = 0.2, 0.02, 0.1


def _uniform(rng: np.random.Generator, k: float, count: int) -> Any:
    """Return readings of u' = s - k u, u(0) = 2, for a random walk s, by exponential steps."""
    u, s, parts = 2.0, 0.0, 50
    h, readings = EVERY / parts, []
    for _ in range(count):
        for _ in range(parts):
            u = s / k + (u - s / k) * np.exp(-k * h)
            s += RATE * np.sqrt(h) * rng.standard_normal()
        readings.append(u + NOISE * rng.standard_normal())
    return np.array(readings)


def _evidence(k: float, z: Any) -> float:
    """Return the log likelihood of k, up to a constant, by the Kalman filter of (u, s)."""
    decay = np.exp(-k * EVERY)
    F = np.array([[decay, (1.0 - decay) / k], [0.0, 1.0]])
    h, q = EVERY, RATE**2
    W = q * np.array([[h**3 / 3.0, h**2 / 2.0], [h**2 / 2.0, h]])
    x, P, log = np.array([2.0, 0.0]), np.diag([0.0, 1.0]), 0.0
    for value in z:
        x, P = F @ x, F @ P @ F.T + W
        S, d = P[0, 0] + NOISE**2, value - x[0]
        log -= 0.5 * (d * d / S + np.log(S))
        x, P = x + P[:, 0] * d / S, P - np.outer(P[:, 0], P[0]) / S
    return log


def _moving() -> list[Check]:
    """Compare a refit of k, with a random walk s, to the exact posterior of k on a grid."""
    z = _uniform(np.random.default_rng(1), 0.5, 60)
    mean, std = np.log(0.4), 0.5  # prior of log k
    grid = np.linspace(mean - 4.0 * std, mean + 4.0 * std, 801)
    log = np.array([_evidence(np.exp(a), z) for a in grid]) - 0.5 * ((grid - mean) / std) ** 2
    weights = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    right = float(weights @ grid)
    spread = float(np.sqrt(weights @ (grid - right) ** 2))
    mesh = lp.interval(0.0, 1.0, 4)
    model = lp.Model(
        lp.Field(mesh, lp.fem.linear(mesh)),
        {
            "k": lp.LogNormal(0.4, std=0.2),
            "s": lp.Scalar(lp.Normal(0.0, std=1.0), evolution=lp.RandomWalk(RATE)),
        },
        A=lambda q, u, v, x: q.k * u * v - q.s * v,
    )
    run = lp.Identifier(model, lp.Points([0.5], noise=NOISE), lp.SensitivityLaw(), u0=2.0)
    for at, value in enumerate(z, 1):
        run.step(EVERY * at, [value])
    k = run.refit()["k"]
    low, high = k.interval(0.95)
    found = np.log(high / low) / (2.0 * 1.959963984540054)
    return [
        Check(
            "refit of k beside a source that walks, deviations from the exact posterior",
            float(abs(np.log(k.median) - right) / spread),
            0.3,
            "<=",
        ),
        Check("its deviation over the exact one", float(abs(np.log(found / spread))), 0.2, "<="),
    ]


# --- sensors of a vector -------------------------------------------------------------------------


def _exact(x: Any, t: float = 0.0) -> Any:
    """Return a vector state whose components are decaying eigenfunctions on the unit square."""
    first = np.exp(-2.0 * np.pi**2 * K * t) * np.sin(np.pi * x[0]) * np.sin(np.pi * x[1])
    other = np.exp(-5.0 * np.pi**2 * K * t) * np.sin(np.pi * x[0]) * np.sin(2.0 * np.pi * x[1])
    return np.stack([first, other])


def _vector() -> list[Check]:
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (5, 5))
    model = lp.Model(
        lp.Field(mesh, ElementVector(lp.fem.quadratic(mesh)), dirichlet={"boundary": 0.0}),
        {"k": lp.LogNormal(0.03, std=0.015)},
        A=lambda q, u, v, x: q.k * lp.fem.ddot(lp.grad(u), lp.grad(v)),
    )
    at, component = {"x": (0.3, 0.4), "y": (0.3, 0.3)}, [0, 1]
    sensors = lp.Points(at, component=component, noise=1e-3)
    run = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=_exact)
    for t in np.linspace(0.05, 1.0, 20):
        places = zip(at.items(), component, strict=True)
        estimate = run.step(t, {name: float(_exact(x, t)[c]) for (name, x), c in places})
    error = abs(estimate.parameters["k"][0] / K - 1.0)
    try:
        lp.Identifier(model, lp.Points(at, noise=1e-3), lp.SensitivityLaw(), u0=0.0)
        unrefused = 1.0
    except lp.errors.ObservationError:
        unrefused = 0.0
    return [
        Check("relative error of k from two components", error, 0.005, "<="),
        Check("vector states without component that are not refused", unrefused, 0.0, "<="),
    ]


# --- moments of a log-normal unknown -------------------------------------------------------------


def _moments() -> list[Check]:
    """Check the moments of a log-normal decay rate after one weakly informative reading."""
    mesh = lp.interval(0.0, 1.0, 4)
    model = lp.Model(
        lp.Field(mesh, lp.fem.linear(mesh)),
        {"k": lp.LogNormal(1.0, std=0.8)},
        A=lambda q, u, v, x: q.k * u * v,
    )
    run = lp.Identifier(model, lp.Points([0.5], noise=0.3), lp.SensitivityLaw(), u0=1.0)
    k = run.step(0.5, [0.7])["k"]
    spread = (np.log(k.interval(0.95)[1]) - np.log(k.median)) / 1.959963984540054
    mean = k.median * np.exp(spread**2 / 2.0)
    return [
        Check("relative error of the mean", abs(k.mean / mean - 1.0), 1e-9, "<="),
        Check(
            "relative error of the standard deviation",
            abs(k.std / (mean * np.sqrt(np.expm1(spread**2))) - 1.0),
            1e-9,
            "<=",
        ),
        Check("spread of the logarithm, so that it counts", spread, 0.3, ">="),
    ]
