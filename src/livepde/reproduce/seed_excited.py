"""The excited twin: the paper's equation with a persistently exciting state.

In the paper's example the state decays like 1/(1 + t), and with it all information on q. Here

    q* = 2 + 3 sin^2(pi x),    u* = (1 + sin(t)/2) sin(pi x) + cos(0.7 t)/2 sin(2 pi x)

with D = 1, full observation, exact data of the same scheme, h = 0.05 to t = 60, Q = H^1 and
q^(0) = 0; both update laws, through the same model and observation. The gradient law is the paper's
(`livepde.paper`); q* = 2 at the ends, so the values and slopes there are kept.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from livepde import paper, plots
from livepde.diagnostics.check_report import Check, Table
from livepde.fem import Field, Normal, dot, grad, hermite, interval
from livepde.identifier import Identifier
from livepde.laws import ResidualDamping, SensitivityLaw, Shadows
from livepde.model import Model
from livepde.observation import Full
from livepde.reproduce.experiment import Experiment, Track, draw_errors, failures, track
from livepde.runs import Outcome
from livepde.stepping import ImplicitEuler
from livepde.streams import Twin

D = 1.0
N = 31
TIMES = 0.05 * np.arange(1201)
SHOWN = (0.0, 0.5, 2.0, 10.0, 60.0)
# Noise level passed to the sensitivity law, although the data are exact.
NOISE_LEVEL = 1e-3


def q_true(x: Any) -> Any:
    """The exact parameter q*."""
    return 2 + 3 * np.sin(np.pi * x[0]) ** 2


def u_true(x: Any, t: float) -> Any:
    """The exact state u*."""
    first, second = np.sin(np.pi * x[0]), np.sin(2 * np.pi * x[0])
    return (1 + np.sin(t) / 2) * first + np.cos(0.7 * t) / 2 * second


def f(x: Any, t: float) -> Any:
    """The source for which u* is the solution with q*."""
    first, second = np.sin(np.pi * x[0]), np.sin(2 * np.pi * x[0])
    rate = np.cos(t) / 2 * first - 0.35 * np.sin(0.7 * t) * second
    curvature = (1 + np.sin(t) / 2) * first + 4 * np.cos(0.7 * t) / 2 * second
    return rate + D * np.pi**2 * curvature + q_true(x) * u_true(x, t)


def build(std: float = 1.0) -> tuple[Model, Full]:
    """Return model, with a prior standard deviation of q, and observation."""
    mesh = interval(0, 1, N - 1)
    element = hermite(mesh)
    model = Model(
        state=Field(mesh, element, dirichlet={"boundary": 0.0}),
        parameter=Field(mesh, element, inner="H1", prior=Normal(std=std)),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: D * dot(grad(u), grad(v)),
        f=f,
    )
    return model, Full()


def twin_of(std: float = 1.0, **options: Any) -> Twin:
    """Return the twin of `build`; `options` of `Twin` replace its own."""
    model, full = build(std)
    truth = {"q_true": q_true, "u_true": u_true, "times": TIMES}
    given = {"model": model, "observation": full, "scheme": ImplicitEuler(), **truth, **options}
    return Twin(**given)


def start(x: Any) -> Any:
    """The exact state at t = 0, the initial state of all runs."""
    return u_true(x, 0.0)


def run(truth: str = "discrete", progress: bool = False) -> Outcome:
    """Run both laws and return their errors with checks and figures."""
    twin = twin_of(truth=truth, fine_dt=0.005)
    model, full = twin.model, twin.observation
    identifiers = {
        "gradient": paper.identifier(
            model, full, gain=1000.0, damping=ResidualDamping(1.0), D=D, u0=start
        ),
        "sensitivity": Identifier(
            model,
            full,
            # The data have the discretisation error of the same steps, so none is divided.
            SensitivityLaw(modes=12, noise=NOISE_LEVEL, shadows=Shadows(parts=1)),
            q0=0.0,
            u0=start,
            scheme=twin.scheme,
        ),
    }
    tracks = {
        name: track(identifier, twin, f"{name} law", progress)
        for name, identifier in identifiers.items()
    }
    table = Table(
        f"relative L2 error of q, truth = {truth}",
        [
            *("law", "q = 0", "t = 1", "t = 10", "t = 60", "bound", "error of u"),
            *("divided steps", "failed steps"),
        ],
        [
            [
                *(name, twin.baseline(0.0), *map(found.error, (1.0, 10.0, 60.0))),
                EXPECTED[name] if truth == "discrete" else None,
                *(found.u_error, found.divided, found.failed),
            ]
            for name, found in tracks.items()
        ],
    )
    checks, notes = [], [_words(truth)]
    if truth == "discrete":
        checks = [
            Check(f"error of q at t = 60, {name} law", tracks[name].error(60.0), bound, "<=")
            for name, bound in EXPECTED.items()
        ]
    return Outcome(
        tables=[table],
        checks=[*checks, failures(tracks.values())],
        notes=notes,
        dataset=tracks["gradient"].result.to_xarray(),
        figures={
            "parameter": partial(_figure, tracks),
            "error": partial(draw_errors, {f"{name} law": run for name, run in tracks.items()}),
        },
    )


def _words(truth: str) -> str:
    if truth == "discrete":
        return (
            f"The data are exact; the sensitivity law is told a noise level of {NOISE_LEVEL:g} "
            "(the state is of size 1), since a filter needs one; the smaller it is, the smaller "
            "the error. The first sample moves q by several prior standard deviations and is "
            "iterated by the law's guards."
        )
    return (
        "Data and estimator do not share the scheme here, so the truncation error of h = 0.05 "
        "bounds what can be found; the bounds hold for discrete truth only and are not checked."
    )


def _figure(tracks: dict[str, Track]) -> Any:
    """Draw q of both laws at several times."""
    drawn, axes = plots.figure(1, 2, "Parameter estimate $\\hat q(t, x)$, full observation")
    for ax, (name, found) in zip(axes, tracks.items(), strict=True):
        data = found.result.to_xarray()
        exact = q_true([data["x"].values])
        plots.profiles(data, "q", times=SHOWN, exact=exact, ax=ax, legend=ax is axes[-1])
        ax.set_title(f"{name} law")
    return drawn


SEED_EXCITED = Experiment(
    name="seed-excited",
    summary="The paper's equation with a state that keeps moving, fully observed: both update laws",
    truths=("discrete", "analytic", "fine"),
    conduct=run,
)

# Expected results: for each law a bound on the relative L2 error of q at t = 60, exact discrete
# data.
EXPECTED = {"gradient": 0.005, "sensitivity": 0.001}
