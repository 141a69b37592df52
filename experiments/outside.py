"""What the laws find of a field outside the part of the domain that is observed.

Two processes on [0, 1], whose true field is drawn from the prior for each seed on a mesh of its own,
with 1 % noise on 18 sensors in omega = (0.3, 0.87): a reaction q(x) in the paper's equation, excited
by its source, and the logarithm of a diffusivity a(x), heated at both ends. The relative error of
the field inside and outside omega, the share of true values in 95 % intervals, and how wide they
are, as a share of the prior's, against the distance from omega.

    python experiments/outside.py 0 1 2 3 4

runs it for these seeds of truth and noise.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.fem import Field, Sobolev, dot, grad, hermite, interval, linear
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, GradientLaw, Replay, SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Discrepancy, Points, Tikhonov
from livepde.reproduce import seed_excited
from livepde.stepping import Advance, Alexander2, simulate

OMEGA = (0.3, 0.87)
SENSORS = np.linspace(*OMEGA, 18)
TIMES = 0.05 * np.arange(401)
LEVEL = 0.01
CELLS, FINE = 30, 90
BINS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)  # distances from omega


def reaction(cells: int) -> Model:
    """Return u_t - u_xx + q u = f with the source of `seed-excited`."""
    mesh = interval(0.0, 1.0, cells)
    smooth = Sobolev(1.0, 0.3).pointwise(1)
    return Model(
        Field(mesh, hermite(mesh), dirichlet={"boundary": 0.0}),
        {"q": Field(mesh, linear(mesh), inner=smooth, prior=3.0, std=1.5)},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: dot(grad(u), grad(v)),
        f=seed_excited.f,
    )


def rod(cells: int) -> Model:
    """Return u_t = (a u_x)_x, heated at both ends."""
    mesh = interval(0.0, 1.0, cells)
    ends: dict[str, Any] = {
        "left": lambda x, t: np.sin(1.1 * t) + 0.0 * x[0],
        "right": lambda x, t: np.sin(0.7 * t) + 0.0 * x[0],
    }
    smooth = Sobolev(2.0, 0.3).pointwise(1)
    a = Field(mesh, linear(mesh), inner=smooth, prior=0.1, std=0.04, transform="log")
    return Model(
        Field(mesh, hermite(mesh), dirichlet=ends),
        {"a": a},
        A=lambda q, u, v, x: q.a * dot(grad(u), grad(v)),
    )


PROCESSES: Mapping[str, Callable[[int], Model]] = {"reaction": reaction, "rod": rod}


@dataclass(frozen=True, eq=False)
class Data:
    """One truth and its samples: values at the vertices x, and readings at `TIMES`."""

    model: Model
    x: Array
    true: Array
    z: Array
    noise: float


def draw(build: Callable[[int], Model], seed: int) -> Data:
    """Return data of a field drawn from the prior, from a finer mesh and shorter steps."""
    rng = np.random.default_rng(seed)
    model, fine = build(CELLS), build(FINE)
    root = np.linalg.inv(np.linalg.cholesky(fine.Q.gram.toarray())).T
    a = fine.latent.prior + root @ rng.standard_normal(fine.latent.dim)
    G = Points(SENSORS.tolist()).matrix(fine.state_space)
    control = Advance(Alexander2(), dt_max=0.025)
    exact = np.array([G @ u for _, u in simulate(fine, a, 0.0, TIMES.tolist(), control)])
    noise = LEVEL * float(np.sqrt((exact**2).mean()))
    z = exact + noise * rng.standard_normal(exact.shape)
    order = np.argsort(fine.mesh.p[0])
    values = (fine.parameter_space.fields[_name(fine)].at_vertices @ fine.latent.value(a))[order]
    x = np.sort(model.mesh.p[0])
    return Data(model, x, np.interp(x, fine.mesh.p[0][order], values), z, noise)


def _name(model: Model) -> str:
    (name,) = model.parameter_space.fields
    return name


def run(data: Data, law: AnyLaw) -> tuple[Array, Array, Array]:
    """Return the field, and the ends of its 95 % interval, at the vertices in order."""
    name = _name(data.model)
    smooth = Tikhonov("V", Discrepancy(1.0, delta=data.noise * np.sqrt(len(SENSORS))))
    gradient = isinstance(law, GradientLaw)
    points = Points(
        SENSORS.tolist(), noise=data.noise, **({"reconstruction": smooth} if gradient else {})
    )
    identifier = Identifier(data.model, points, law, u0=0.0, scheme=Alexander2())
    for t, z in zip(TIMES, data.z, strict=True):
        estimate = identifier.step(t, z)
    block = data.model.parameter_space.fields[name]
    order = np.argsort(data.model.mesh.p[0])
    low, high = estimate.interval(name)
    return tuple((block.at_vertices @ each)[order] for each in (estimate.q, low, high))
