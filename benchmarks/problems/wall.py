"""Wall of three layers with sensors at its surfaces."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from benchmarks.problems.data import Problem, Process
from livepde.fem import Field, LogNormal, Normal, On, Scalars, grad, interval, linear
from livepde.model import Model
from livepde.observation import Points
from livepde.stepping import Advance, Alexander2, simulate

TIMES = np.linspace(0.0, 240.0, 481)  # h
LAYERS = {"inner": (0.0, 0.1), "middle": (0.1, 0.2), "outer": (0.2, 0.3)}  # m
FILM = {"left": 8.0, "right": 20.0}  # W/(m^2 K)
BLEND = 0.004  # m, width of the smooth transition between layers


def _share(x: Any, name: str) -> tuple[Any, Any]:
    """Return the smooth indicator of a layer at x, and its derivative."""
    start, stop = LAYERS[name]
    up = 1.0 if start == 0.0 else 0.5 * (1 + np.tanh((x[0] - start) / BLEND))
    down = 1.0 if stop == 0.3 else 0.5 * (1 - np.tanh((x[0] - stop) / BLEND))
    slope_up = 0.0 if start == 0.0 else 0.5 / BLEND / np.cosh((x[0] - start) / BLEND) ** 2
    slope_down = 0.0 if stop == 0.3 else -0.5 / BLEND / np.cosh((x[0] - stop) / BLEND) ** 2
    return up * down + 0.0 * x[0], slope_up * down + up * slope_down + 0.0 * x[0]


def _mixed(values: Any, x: Any) -> tuple[Any, Any]:
    """Return a layered coefficient and its derivative in x."""
    parts = [(values[name], *_share(x, name)) for name in LAYERS]
    return sum(value * share for value, share, _ in parts), sum(
        value * slope for value, _, slope in parts
    )


def _air(t: float) -> dict[str, float]:
    """Return the air temperatures: daytime heating inside, a cold spell outside."""
    day = 2 * np.pi * t / 24.0
    heating = 2.0 * np.tanh(4.0 * np.sin(day))
    outside = 5.0 + 5.0 * np.sin(day - 2.0) + 4.0 * np.sin(day / 4.3)
    return {"inside": 20.0 + heating, "outside": outside}


def _u0(x: Any) -> Any:
    return 20.0 - 50.0 * x[0]


def _model() -> Model:
    """Return the wall with unknown k and C, divided by C because the mass must be known.

    C u_t = (k u_x)_x is tested with v/C, whose derivative is v_x/C - v C_x/C^2.
    """
    mesh = interval(0.0, 0.3, 60)

    def conduct(q: Any, u: Any, v: Any, x: Any) -> Any:
        (k, _), (C, slope) = _mixed(q.k, x), _mixed(q.C, x)
        return k * grad(u)[0] * (grad(v)[0] / C - v * slope / C**2)

    return Model(
        Field(mesh, linear(mesh), unit="degC"),
        {
            "k": Scalars(list(LAYERS), LogNormal(0.6, 0.3), unit="W/(m K)"),
            "C": Scalars(list(LAYERS), LogNormal(350.0, 140.0), unit="W h/(m^3 K)"),
        },
        A=[
            conduct,
            On(
                "left",
                lambda q, u, v, x: FILM["left"] * (u - x.inputs["inside"]) * v / q.C["inner"],
            ),
            On(
                "right",
                lambda q, u, v, x: FILM["right"] * (u - x.inputs["outside"]) * v / q.C["outer"],
            ),
        ],
        inputs=["inside", "outside"],
        time_unit="h",
    )


def _truth(k: dict[str, float], C: dict[str, float]) -> Model:
    """Return the wall with known coefficients on a finer mesh, without division by C."""
    mesh = interval(0.0, 0.3, 240)
    return Model(
        Field(mesh, linear(mesh)),
        {"a": Normal(1.0, 1.0)},
        A=[
            lambda q, u, v, x: q.a * _mixed(k, x)[0] * grad(u)[0] * grad(v)[0],
            On("left", lambda q, u, v, x: q.a * FILM["left"] * (u - x.inputs["inside"]) * v),
            On("right", lambda q, u, v, x: q.a * FILM["right"] * (u - x.inputs["outside"]) * v),
        ],
        M=lambda u, v, x: _mixed(C, x)[0] * u * v,
        inputs=["inside", "outside"],
    )


@cache
def _process(seed: int) -> Process:
    model = _model()
    rng = np.random.default_rng([seed, 0])
    latent = model.latent
    q = latent.value(latent.prior + latent.deviations * rng.standard_normal(latent.dim))
    k, C = (dict(zip(LAYERS, values, strict=True)) for values in (q[:3].tolist(), q[3:].tolist()))
    points = Points({"inner_surface": 0.0, "outer_surface": 0.3}, unit="degC")
    fine = _truth(k, C)
    G = points.matrix(fine.state_space)
    control = Advance(Alexander2(), dt_max=0.125)
    inputs = [_air(float(t)) for t in TIMES]

    def air(t: float) -> dict[str, float]:  # also between samples, where it is not measured
        return {
            name: float(np.interp(t, TIMES, [row[name] for row in inputs]))
            for name in ("inside", "outside")
        }

    run = simulate(fine, np.ones(1), _u0, TIMES.tolist(), control, air)
    return Process(
        model=model,
        observation=points,
        times=TIMES,
        exact=np.array([G @ u for _, u in run]),
        q_true=np.tile(q, (len(TIMES), 1)),
        u0=_u0,
        scheme=Alexander2(),
        inputs=inputs,
    )


WALL = Problem(
    name="wall",
    summary="Wall of three layers: k and C of each from the temperature of its surfaces",
    make=_process,
)
