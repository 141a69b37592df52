"""Meshes, models and measurements shared by several test files."""

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skfem import (
    ElementHex1,
    ElementLineHermite,
    ElementLineP1,
    ElementLineP2,
    ElementQuad1,
    ElementQuad2,
    ElementTetP1,
    ElementTriP1,
    ElementTriP2,
    MeshHex,
    MeshQuad,
    MeshTet,
    MeshTri,
)

import livepde as lp
from livepde.cases.new_case import write_template
from livepde.stepping import ForwardStage, advance


def few(count: int, *axes: Iterable[Any]) -> list[tuple[Any, ...]]:
    """Return a reproducible selection of combinations with balanced frequencies of the values."""
    rng, listed = random.Random(0), [list(axis) for axis in axes]
    picks = [rng.sample([k % len(axis) for k in range(count)], count) for axis in listed]
    unique = dict.fromkeys(zip(*picks, strict=True))
    return [tuple(axis[k] for axis, k in zip(listed, pick, strict=True)) for pick in unique]


def usual(values: Iterable[Any], *, often: int = 1) -> list[Any]:
    """Return values of a test parameter, with all but the first `often` marked as long tests."""
    return [
        value if k < often else pytest.param(value, marks=pytest.mark.long)
        for k, value in enumerate(values)
    ]


def turns(first: Iterable[Any], second: Iterable[Any], third: Sequence[Any]) -> list[Any]:
    """Return all pairs of two axes, each with one value of a third axis in turn."""
    second = list(second)
    return [
        (a, b, third[(j + k) % len(third)])
        for j, a in enumerate(first)
        for k, b in enumerate(second)
    ]


def line(cells: int = 12) -> Any:
    return lp.interval(0.0, 1.0, cells)


def square(cells: int) -> MeshTri:
    """Return the unit square with 2 `cells`^2 triangles and named sides."""
    return lp.rectangle((0.0, 1.0), (0.0, 1.0), (cells, cells)).to_meshtri()


@dataclass(frozen=True)
class Case:
    """A mesh, with one element for the state and one for the parameter."""

    mesh: Callable[[], Any]
    state: Any
    parameter: Any

    def model(self, **options: Any) -> lp.Model:
        """Return u_t - div(grad u) + q u = f with these elements."""
        mesh = self.mesh()
        return reaction(mesh, self.state, self.parameter, **options)


CASES: dict[str, Case] = {
    "line P1": Case(line, ElementLineP1(), ElementLineP1()),
    "line P2 / P1": Case(line, ElementLineP2(), ElementLineP1()),
    "line Hermite": Case(line, ElementLineHermite(), ElementLineHermite()),
    "triangles P1": Case(lambda: MeshTri().refined(3), ElementTriP1(), ElementTriP1()),
    "triangles P2 / P1": Case(lambda: MeshTri().refined(2), ElementTriP2(), ElementTriP1()),
    "quads Q1": Case(lambda: MeshQuad().refined(3), ElementQuad1(), ElementQuad1()),
    "quads Q2 / Q1": Case(lambda: MeshQuad().refined(2), ElementQuad2(), ElementQuad1()),
    "tets P1": Case(lambda: MeshTet().refined(2), ElementTetP1(), ElementTetP1()),
    "hexes Q1": Case(lambda: MeshHex().refined(2), ElementHex1(), ElementHex1()),
}


def product(q: Any, u: Any, v: Any, x: Any) -> Any:
    return q * u * v


def diffusion(q: Any, u: Any, v: Any, x: Any) -> Any:
    return q * lp.dot(lp.grad(u), lp.grad(v))


def laplace(u: Any, v: Any, x: Any) -> Any:
    return lp.dot(lp.grad(u), lp.grad(v))


def conduction(q: Any, u: Any, v: Any, x: Any) -> Any:
    return q.a * lp.dot(lp.grad(u), lp.grad(v))


def driven_rod(
    unknowns: Any, left: Callable[[float], float], mesh: Any, A: Any = conduction, **options: Any
) -> lp.Model:
    """Return a rod of P1 elements with a time-dependent left end and zero at the right end.

    By default, the conductivity is the unknown `a`: u_t - (a u_x)_x = 0.
    """
    ends = {"left": lambda x, t: left(t) + 0.0 * x[0], "right": 0.0}
    state = lp.Field(mesh, ElementLineP1(), dirichlet=ends)
    return lp.Model(state, unknowns, A, **options)


def reaction(
    mesh: Any,
    state: Any,
    parameter: Any = None,
    *,
    dirichlet: Any = None,
    inner: Any = "H1",
    q_dirichlet: Any = None,
    **options: Any,
) -> lp.Model:
    """Return u_t - div(grad u) + q(x) u = f; by default u = 0 on the boundary."""
    zero = {"boundary": 0.0}
    return lp.Model(
        state=lp.Field(mesh, state, dirichlet=zero if dirichlet is None else dirichlet),
        parameter=lp.Field(
            mesh, parameter or state, inner=inner, dirichlet=q_dirichlet or {}, unit="1/s"
        ),
        **{"A": product, "B": laplace, **options},
    )


def excited(
    cells: int = 20, element: Any = None, f: Any = None, mesh: Any = None, **options: Any
) -> lp.Model:
    """Return the excited twin of DESIGN.md, fact 5, with u* = `excited_u` and q* = `excited_q`."""
    element = element or ElementLineHermite()

    def source(x: Any, t: float) -> Any:
        s1, s2, pi = np.sin(np.pi * x[0]), np.sin(2 * np.pi * x[0]), np.pi
        a, b = 1 + np.sin(t) / 2, np.cos(0.7 * t) / 2
        rate = np.cos(t) / 2 * s1 - 0.35 * np.sin(0.7 * t) * s2
        return rate + pi**2 * a * s1 + 4 * pi**2 * b * s2 + excited_q(x) * (a * s1 + b * s2)

    return reaction(mesh or line(cells), element, f=f or source, **options)


def excited_q(x: Any) -> Any:
    return 2 + 3 * np.sin(np.pi * x[0]) ** 2


def excited_u(x: Any, t: float) -> Any:
    a, b = 1 + np.sin(t) / 2, np.cos(0.7 * t) / 2
    return a * np.sin(np.pi * x[0]) + b * np.sin(2 * np.pi * x[0])


def truth(
    model: lp.Model,
    q: np.ndarray,
    u0: Any,
    times: Any,
    scheme: lp.stepping.Scheme | None = None,
    inputs: Any = None,
) -> list[np.ndarray]:
    """Simulate the forward model, and return its states at all times."""
    control = lp.Advance(scheme or lp.ImplicitEuler())
    return [u for _, u in lp.simulate(model, q, u0, list(times), control, inputs)]


def broad(value: float) -> lp.Normal:
    """Return a weakly informative prior around a value."""
    return lp.Normal(value, max(abs(value), 1.0))


def last_state(model: lp.Model, u0: Any, times: Any, inputs: Any = None) -> np.ndarray:
    """Simulate with the prior means, and return the last state at the vertices."""
    control = lp.Advance(lp.Alexander2())
    *_, (_, u) = lp.simulate(model, model.initial_parameter(), u0, times, control, inputs)
    return model.state_block.at_vertices @ u


def advanced(
    forward: ForwardStage,
    u: np.ndarray,
    q: Any,
    t0: float,
    t1: float,
    scheme: lp.stepping.Scheme = lp.SensitivityLaw.scheme,
) -> np.ndarray:
    """Advance a state from t0 to t1; q contains coefficients, or is a function of time."""

    def stage(c: np.ndarray, t: float, h: float) -> np.ndarray:
        return forward.solve(c, q(t) if callable(q) else q, h, lp.fem.Moment(t))

    u, _, failure = advance(lp.Advance(scheme), stage, u, t0, t1)
    assert failure is None
    return u


def filter_alone(**options: Any) -> lp.SensitivityLaw:
    """Return a sensitivity law without refits, shadows and verdict, which is faster."""
    return lp.SensitivityLaw(**{"refit": None, "shadows": None, "verdict": False, **options})


def observe(model: lp.Model, observation: lp.observation.Observation) -> Any:
    return observation.bind(model.state_space, model.X, model.parameter_space)


def rates(errors: Any) -> np.ndarray:
    """Return the orders of convergence of successive errors, each with half the step before."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


def readings(
    model: lp.Model,
    sensors: lp.observation.Observation,
    q: Callable[[float], float],
    times: Iterable[float],
    noise: float,
    seed: int = 0,
    scheme: lp.stepping.Scheme = lp.SensitivityLaw.scheme,
) -> list[tuple[float, np.ndarray]]:
    """Simulate a process from zero with one unknown q(t), and return its noisy samples."""
    rng, observed = np.random.default_rng(seed), observe(model, sensors)
    forward, u, samples = ForwardStage(model), model.initial(0.0), []
    for t0, t1 in pairwise(float(t) for t in times):
        u = advanced(forward, u, lambda t: np.array([q(t)]), t0, t1, scheme)
        samples.append((t1, observed.G @ u + noise * rng.standard_normal(observed.size)))
    return samples


def short_rod(folder: Path, samples: int = 61) -> Path:
    """Write the case of `livepde init` with its first samples."""
    case, data = write_template(folder)
    rows = data.read_text().splitlines()[: samples + 1]
    data.write_text("\n".join(rows) + "\n")
    return case


# Case file of a rod, to which a test appends [channels].
ROD_CASE = """
equation = "heat"
initial = "20 degC"
[mesh]
from = 0
to = "1 m"
cells = 10
[data]
file = "rows.csv"
time = "t"
time_unit = "s"
[boundary]
right = "20 degC"
[unknowns.alpha]
prior = "2e-5 m^2/s"
std = "1e-5 m^2/s"
[law]
kind = "sensitivity"
"""
INTERPOLATED_ROD_CASE = ROD_CASE.replace('"20 degC"', '"interpolate"', 1)


def sided(mesh):
    return mesh.with_boundaries({"left": lambda p: np.isclose(p[0], 0.0)})


BODIES = {
    "line": lambda: lp.interval(0.0, 1.0, 10),
    "triangle": lambda: sided(MeshTri().refined(2)),
    "quad": lambda: lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 3)),
    "tetra": lambda: lp.fem.box((0.0, 1.0), (0.0, 1.0), (0.0, 1.0), (3, 2, 2)),
    "hexahedron": lambda: sided(MeshHex().refined(1)),
}
"""Kind of cell -> mesh of a unit body with a boundary "left"."""
