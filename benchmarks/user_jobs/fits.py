"""Fit of each job as a user would write it: own matrices and sensitivities, and SciPy.

Usage: python -m benchmarks.user_jobs.fits JOB FOLDER

Reads `data.csv` in the folder, and prints estimates and processor time in s as JSON. Unknowns are
fitted as logarithms with the prior of the case; time steps are Crank-Nicolson from row to row.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd
import scipy.sparse as sp
from scipy.optimize import least_squares, minimize
from scipy.sparse.linalg import splu


def log_prior(mean: Any, std: Any) -> tuple[Any, Any]:
    """Return mean and standard deviation of the logarithm of a log-normal unknown."""
    spread = np.sqrt(np.log1p((np.asarray(std) / np.asarray(mean)) ** 2))
    return np.log(mean) - 0.5 * spread**2, spread


def fitted(simulate: Any, readings: Any, noise: float, mean: Any, spread: Any) -> Any:
    """Return the maximum a posteriori unknowns; `simulate` returns readings and derivatives."""
    known = np.isfinite(readings)

    def both(xi: Any) -> tuple[Any, Any]:
        if not (last and np.array_equal(last[0], xi)):
            predicted, derivatives = simulate(mean + spread * xi)
            r = np.concatenate([((predicted - readings)[known]) / noise, xi])
            J = np.vstack([derivatives[known] * spread / noise, np.eye(len(xi))])
            last[:] = xi.copy(), r, J
        return last[1], last[2]

    last: list[Any] = []

    def residuals(xi: Any) -> Any:
        return both(xi)[0]

    def slopes(xi: Any) -> Any:
        return both(xi)[1]

    minimum = least_squares(residuals, np.zeros(len(mean)), slopes, method="lm", xtol=1e-6)
    return mean + spread * minimum.x


# --- intervals: dense matrices, the fastest option below a few hundred nodes ---------------------


def along(K: Any, B: Any, Ks: Any, Bs: Any, C: Any, means: Any, h: float, u: Any) -> Any:
    """Return C u and its derivatives at all rows, for u' = -K u + B b.

    `means` are means of b between two rows; `Ks` and `Bs` are the derivatives of K and B.
    """
    n, p = len(K), len(Ks)
    P = np.linalg.inv(np.eye(n) + 0.5 * h * K)
    N = P @ (np.eye(n) - 0.5 * h * K)
    changes = -0.5 * h * np.concatenate([P @ Kj for Kj in Ks])  # (p n, n)
    given = means @ (h * P @ B).T
    moved = np.stack([means @ (h * P @ Bj).T for Bj in Bs], axis=-1)
    X = np.zeros((n, 1 + p))  # the state and its derivatives
    X[:, 0] = u
    out = np.empty((len(means) + 1, len(C), 1 + p))
    out[0] = C @ X
    for k in range(len(means)):
        both = X[:, 0].copy()
        X = N @ X
        X[:, 0] += given[k]
        both += X[:, 0]
        X[:, 1:] += (changes @ both).reshape(p, n).T + moved[k]
        out[k + 1] = C @ X
    return out[..., 0], out[..., 1:]


def middle(inputs: Any) -> Any:
    """Return the means of inputs between two rows."""
    return 0.5 * (inputs[1:] + inputs[:-1])


def conduction(x: Any, alpha: Any) -> tuple[Any, Any]:
    """Return K and B of conduction on inner nodes with given ends, for `alpha` of each cell."""
    flow = alpha / np.diff(x)
    width = 0.5 * (x[2:] - x[:-2])
    K = np.diag((flow[1:] + flow[:-1]) / width)
    K -= np.diag(flow[1:-1] / width[:-1], 1) + np.diag(flow[1:-1] / width[1:], -1)
    B = np.zeros((len(width), 2))
    B[0, 0], B[-1, 1] = flow[0] / width[0], flow[-1] / width[-1]
    return K, B


def nodes_at(x: Any, places: Any) -> Any:
    """Return the matrix that selects the inner nodes at given positions."""
    return (np.abs(x[None, 1:-1] - np.asarray(places)[:, None]) < 1e-9).astype(float)


def rod(table: pd.DataFrame) -> dict[str, float]:
    """Fit diffusivity and loss."""
    x = np.linspace(0.0, 0.4, 41)
    ends = table[["left", "right"]].to_numpy()
    means = np.column_stack([middle(ends), np.full(len(ends) - 1, 20.0)])
    C = nodes_at(x, [0.08, 0.16, 0.24, 0.32])
    K1, B1 = conduction(x, np.ones(40))
    BD = np.column_stack([B1, np.zeros(39)])
    BL = np.column_stack([0.0 * B1, np.ones(39)])
    start = np.interp(x, [0.0, 0.08, 0.16, 0.24, 0.32, 0.4], _first(table))[1:-1]

    def simulate(theta: Any) -> Any:
        alpha, loss = np.exp(theta)
        Ks, Bs = [alpha * K1, loss * np.eye(39)], [alpha * BD, loss * BL]
        return along(sum(Ks), sum(Bs), Ks, Bs, C, means, 10.0, start)

    mean, spread = log_prior([4e-5, 4e-4], [3e-5, 4e-4])
    readings = table[["T1", "T2", "T3", "T4"]].to_numpy()
    alpha, loss = np.exp(fitted(simulate, readings, 0.05, mean, spread))
    return {"alpha": alpha, "loss": loss}


def _first(table: pd.DataFrame) -> list[float]:
    first = table.iloc[0]
    return [first["left"], *first[["T1", "T2", "T3", "T4"]], first["right"]]


def soil(table: pd.DataFrame) -> dict[str, float]:
    """Fit diffusivities and offsets, and return the diffusivities."""
    x = np.linspace(0.05, 0.60, 56)
    layer = np.searchsorted([0.10, 0.20, 0.30, 0.40, 0.50], 0.5 * (x[1:] + x[:-1]))
    parts = [conduction(x, (layer == j).astype(float)) for j in range(6)]
    ends, C = table[["T05", "T60"]].to_numpy(), nodes_at(x, [0.1, 0.2, 0.4, 0.5])
    readings = table[["T10", "T20", "T40", "T50"]].to_numpy()
    start = np.interp(x, [0.05, 0.1, 0.2, 0.4, 0.5, 0.6], [ends[0, 0], *readings[0], ends[0, 1]])
    means = middle(ends)

    def simulate(theta: Any) -> Any:
        alpha = np.exp(theta[:6])
        Ks = [a * K for a, (K, _) in zip(alpha, parts, strict=True)]
        Bs = [a * B for a, (_, B) in zip(alpha, parts, strict=True)]
        readings, slopes = along(sum(Ks), sum(Bs), Ks, Bs, C, means, 3600.0, start[1:-1])
        offsets = np.broadcast_to(np.eye(4), (len(readings), 4, 4))
        return readings + theta[6:], np.concatenate([slopes, offsets], axis=-1)

    mean, spread = log_prior(np.full(6, 5e-7), np.full(6, 2e-7))
    mean, spread = np.append(mean, np.zeros(4)), np.append(spread, np.full(4, 0.2))
    alpha = np.exp(fitted(simulate, readings, 0.1, mean, spread)[:6])
    return {f"alpha[{name}]": value for name, value in zip("abcdef", alpha, strict=True)}


def column(table: pd.DataFrame) -> dict[str, float]:
    """Fit dispersion and velocity."""
    x = np.linspace(0.0, 20.0, 101)
    KD, BD = conduction(x, np.ones(100))
    KD[-1, -1] -= BD[-1, 1]  # no dispersion through the end
    KV = (np.diag(np.ones(98), 1) - np.diag(np.ones(98), -1)) / (2.0 * x[1])
    KV[-1, -1] += 1.0 / (2.0 * x[1])
    BD, BV = BD[:, :1], np.zeros((99, 1))
    BV[0] = 1.0 / (2.0 * x[1])
    means = table[["c_in"]].to_numpy()[:-1]  # piecewise constant
    C = nodes_at(x, [8.0, 16.0])

    def simulate(theta: Any) -> Any:
        D, v = np.exp(theta)
        Ks, Bs = [D * KD, v * KV], [D * BD, v * BV]
        return along(sum(Ks), sum(Bs), Ks, Bs, C, means, 1.0 / 180.0, np.zeros(99))

    mean, spread = log_prior([12.0, 30.0], [12.0, 15.0])
    D, v = np.exp(fitted(simulate, table[["c8", "c16"]].to_numpy(), 0.01, mean, spread))
    return {"D": D, "v": v}


# --- squares: sparse matrices with one factor for all steps --------------------------------------


class Square:
    """Bilinear elements on n x n nodes with two given sides, as conductances; x index first."""

    def __init__(self, n: int, sensors: Any, table: pd.DataFrame) -> None:
        number = np.arange(n * n).reshape(n, n)
        self.n, self.h = n, float(table["t"].iloc[1])
        cells = np.arange((n - 1) ** 2).reshape(n - 1, n - 1)
        edges = [(number[:-1].ravel(), number[1:].ravel())]
        edges.append((number[:, :-1].ravel(), number[:, 1:].ravel()))
        begin, end = map(np.concatenate, zip(*edges, strict=True))
        count = len(begin)
        rows = np.tile(np.arange(count), 2)
        signs = np.repeat([-1.0, 1.0], count)
        D = sp.csr_array((signs, (rows, np.concatenate([begin, end]))), (count, n * n))
        # Each edge receives half of the conductance of each adjacent cell.
        along_x = np.arange((n - 1) * n).reshape(n - 1, n)
        along_y = (n - 1) * n + np.arange(n * (n - 1)).reshape(n, n - 1)
        of = [along_x[:, :-1], along_x[:, 1:], along_y[:-1], along_y[1:]]
        at = np.concatenate([part.ravel() for part in of])
        self.W = sp.csr_array(
            (np.full(len(at), 0.5), (at, np.tile(cells.ravel(), 4))), (count, cells.size)
        )
        mass = np.zeros((n, n))
        for i in (0, 1):
            for j in (0, 1):
                mass[i : n - 1 + i, j : n - 1 + j] += 0.25 / (n - 1) ** 2
        inner = number[1:-1].ravel()
        self.mass, self.D = mass.ravel()[inner], D[:, inner]
        sides = np.zeros((n * n, 2))
        sides[number[0], 0] = sides[number[-1], 1] = 1.0
        means = middle(table[["left", "right"]].to_numpy())
        self.given = (D @ sides) @ means.T  # differences along edges due to the given sides
        self.C = sp.csr_array(_bilinear(np.linspace(0.0, 1.0, n), sensors)[:, inner])
        names = [f"T{k + 1}" for k in range(len(sensors))]
        self.readings, self.start = table[names].to_numpy(), np.full(len(inner), 20.0)

    def factor(self, flow: Any) -> tuple[Any, Any]:
        """Return the solver of a step, and K, for the conductances of edges."""
        K = self.D.T @ (sp.diags_array(flow) @ self.D)
        left = sp.diags_array(self.mass / self.h) + 0.5 * K
        options = {"SymmetricMode": True}
        return splu(left.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options).solve, K.tocsr()


def _bilinear(x: Any, points: Any) -> Any:
    hats = np.eye(len(x))
    each = [[np.array([np.interp(p, x, e) for e in hats]) for p in point] for point in points]
    return np.array([np.outer(first, second).ravel() for first, second in each])


def plate(table: pd.DataFrame) -> dict[str, float]:
    """Fit the diffusivities of the quarters."""
    square = Square(101, [(0.2, 0.3), (0.3, 0.7), (0.6, 0.2), (0.7, 0.8), (0.8, 0.4)], table)
    half = np.arange(100) >= 50
    quarter = (2 * half[:, None] + half[None]).ravel()
    weights = square.W @ np.eye(4)[quarter]

    def simulate(theta: Any) -> Any:
        alpha = np.exp(theta)
        solve, K = square.factor(weights @ alpha)
        X = np.zeros((len(square.mass), 5))
        X[:, 0] = square.start
        out = [square.C @ X]
        for given in square.given.T:
            known = square.mass[:, None] / square.h * X - 0.5 * (K @ X)
            known[:, 0] -= square.D.T @ (weights @ alpha * given)
            u = solve(known[:, 0])
            slope = square.D @ (0.5 * (u + X[:, 0])) + given
            known[:, 1:] -= square.D.T @ (weights * alpha * slope[:, None])
            X[:, 0], X[:, 1:] = u, solve(known[:, 1:])
            out.append(square.C @ X)
        found = np.array(out)
        return found[..., 0], found[..., 1:]

    mean, spread = log_prior(np.full(4, 1e-5), np.full(4, 0.5e-5))
    values = np.exp(fitted(simulate, square.readings, 0.05, mean, spread))
    return {f"alpha[{name}]": value for name, value in zip("abcd", values, strict=True)}


def field(table: pd.DataFrame) -> dict[str, float]:
    """Fit 14 x 14 values with a prior covariance by L-BFGS and an adjoint, without deviations."""
    places = [(x, y) for x in np.arange(1, 6) / 6 for y in np.arange(1, 6) / 6]
    square, x = Square(57, places, table), np.linspace(0.0, 1.0, 14)
    centres = (np.arange(56) + 0.5) / 56
    grid = sp.csr_array(_bilinear(x, [(a, b) for a in centres for b in centres]))
    nodes = np.array([(a, b) for a in x for b in x])
    distance = np.linalg.norm(nodes[:, None] - nodes[None], axis=-1) / 0.3
    mean, spread = log_prior(1e-5, 0.6e-5)
    covariance = spread**2 * (1.0 + math.sqrt(3.0) * distance) * np.exp(-math.sqrt(3.0) * distance)
    L = np.linalg.cholesky(covariance + 1e-8 * np.eye(len(nodes)))
    samples = len(table)

    def cost(xi: Any) -> tuple[float, Any]:
        alpha = np.exp(grid @ (mean + L @ xi))
        flow = square.W @ alpha
        solve, K = square.factor(flow)
        u = [square.start]
        for given in square.given.T:
            known = square.mass / square.h * u[-1] - 0.5 * (K @ u[-1])
            u.append(solve(known - square.D.T @ (flow * given)))
        states = np.array(u)
        r = ((square.C @ states.T).T - square.readings) / 0.05
        slope, back = np.zeros(len(flow)), np.zeros(len(square.mass))
        for k in range(samples - 1, 0, -1):
            back = back + square.C.T @ r[k] / 0.05
            adjoint = solve(back)
            change = square.D @ (0.5 * (states[k] + states[k - 1])) + square.given[:, k - 1]
            slope -= change * (square.D @ adjoint)
            back = square.mass / square.h * adjoint - 0.5 * (K @ adjoint)
        gradient = L.T @ (grid.T @ (alpha * (square.W.T @ slope))) + xi
        return 0.5 * float((r**2).sum() + (xi**2).sum()), gradient

    minimum = minimize(
        cost, np.zeros(len(nodes)), jac=True, method="L-BFGS-B", options={"ftol": 1e-7}
    )
    values = np.exp(mean + L @ minimum.x)
    return {f"{a:.6f} {b:.6f}": float(v) for (a, b), v in zip(nodes, values, strict=True)}


JOBS = {"rod": rod, "soil": soil, "plate": plate, "column": column, "field": field}

if __name__ == "__main__":
    name, folder = sys.argv[1:]
    table, begun = pd.read_csv(Path(folder) / "data.csv"), process_time()
    estimates = JOBS[name](table)
    sys.stdout.write(json.dumps({"estimates": estimates, "seconds": process_time() - begun}))
