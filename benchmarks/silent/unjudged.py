"""Checks that untested runs are not trusted, and that the gradient law detects wrong models.

The data come from independent finite differences, Crank-Nicolson on 200 cells, of

    u_t = D u_xx - q u + f,    D = 1,  q = 5,

with or without noise. A model with D = 1 is correct. No value of q corrects a model with D = 2,
D = 1.3 or half of the source. For a field a(x) observed on a part of the rod, the gradient law once
returned an estimate with a larger error than the prior.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
from scipy.linalg import solve_banded

import livepde as lp
from livepde.diagnostics.check_report import Check
from livepde.errors import LawError
from livepde.runs import verdict, verdict_table

CELLS, DT, EVERY, SAMPLES = 200, 0.005, 10, 200  # of the data; EVERY steps between two samples
D, Q = 1.0, 5.0
LAWS = {
    "auto": lp.GradientLaw(gain="auto"),
    "gain 100": lp.GradientLaw(gain=100.0),
    "gain 10": lp.GradientLaw(gain=10.0),
}
NOISES = (0.0, 0.002, 0.01)  # standard deviations, for readings of size 1
WRONG = {"D = 2": (2.0, 1.0), "D = 1.3": (1.3, 1.0), "half of the source": (1.0, 0.5)}


def source(x: Any, t: float) -> Any:
    """Return the source f."""
    first = 20 * np.sin(np.pi * x) * (1 + np.sin(2 * t))
    return first + 60 * np.cos(3 * t) * np.sin(2 * np.pi * x)


@cache
def data() -> list[tuple[float, Any]]:
    """Return the time and the state at all 201 points for each sample."""
    a = np.full(CELLS, D)
    return list(_differences(a, lambda x, t: source(x, t), Q, DT, np.zeros(CELLS + 1)))


def _differences(
    a: Any, f: Callable[[Any, float], Any], q: float, dt: float, u: Any
) -> Iterator[tuple[float, Any]]:
    """Yield samples of u_t = (a u_x)_x - q u + f by Crank-Nicolson; a has one value per cell."""
    x, h = np.linspace(0.0, 1.0, CELLS + 1), 1.0 / CELLS
    left, right, inner = a[:-1] / h**2, a[1:] / h**2, u[1:-1].copy()
    bands = np.zeros((3, CELLS - 1))
    bands[0, 1:], bands[2, :-1] = -0.5 * dt * right[:-1], -0.5 * dt * left[1:]
    bands[1] = 1.0 + 0.5 * dt * (left + right + q)
    for k in range(EVERY * SAMPLES):
        U = np.pad(inner, 1)
        change = right * (U[2:] - U[1:-1]) - left * (U[1:-1] - U[:-2]) - q * inner
        rhs = inner + 0.5 * dt * change + dt * f(x[1:-1], (k + 0.5) * dt)
        inner = solve_banded((1, 1), bands, rhs)
        if k % EVERY == EVERY - 1:
            yield (k + 1) * dt, np.pad(inner, 1)


def model(diffusivity: float = D, share: float = 1.0) -> lp.Model:
    """Return a model with a given diffusivity and a given share of the source."""
    mesh = lp.interval(0.0, 1.0, 40)
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
        {"q": lp.Normal(4.0, std=2.0)},
        A=lambda q, u, v, x: q.q * u * v,
        B=lambda u, v, x: diffusivity * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: share * source(x[0], t),
    )


def judged(
    law: Any, noise: float, seed: int, of: lp.Model | None = None, *, part: bool = False
) -> Any:
    """Return the result of a run that observes the whole rod, or a part of it."""
    of = model() if of is None else of
    stated = noise or None
    sensors: Any = lp.Full(noise=stated)
    if part:
        sensors = lp.Subdomain(lambda x: (x[0] > 0.2) & (x[0] < 0.7), noise=stated)
    G = sensors.bind(of.state_space, of.X, of.parameter_space).G
    rng = np.random.default_rng(seed)
    rows = ((t, u[:: CELLS // 40] + noise * np.pad(rng.standard_normal(39), 1)) for t, u in data())
    return lp.Identifier(of, sensors, law, u0=0.0).run((t, G @ z) for t, z in rows)


class Own(lp.laws.Law):  # type: ignore[type-arg]
    """Custom law without tests, which keeps its initial estimates."""

    def prepare(self, problem: Any) -> Any:
        return problem

    def init(self, work: Any, q0: Any, u0: Any) -> Any:
        return (q0, u0)

    def step(self, work: Any, state: Any, interval: Any) -> Any:
        predicted = work.predict(state[1], state[0], interval.end)
        return state, lp.laws.Report(lp.laws.Status(), predicted)

    def belief(self, work: Any, state: Any) -> Any:
        return lp.laws.Belief(*state)


def _field() -> bool:
    """Return whether a field estimate that is worse than its prior is trusted, not refused."""
    mesh, x = lp.interval(0.0, 1.0, 40), (np.arange(CELLS) + 0.5) / CELLS
    a = (
        0.06
        + 0.05 * np.exp(-(((x - 0.6) / 0.13) ** 2))
        - 0.03 * np.exp(-(((x - 0.33) / 0.09) ** 2))
    )

    def f(x: Any, t: float) -> Any:
        low = 3 * np.sin(np.pi * x) * (1 + 0.6 * np.sin(2 * t))
        return low + 4 * np.sin(2 * np.pi * x) * np.cos(3.1 * t)

    start = np.sin(np.pi * np.linspace(0.0, 1.0, CELLS + 1))
    of = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"boundary": 0.0}),
        lp.Field(mesh, lp.linear(mesh), inner="H1", prior=lp.Normal(0.06, 0.04)),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: f(x[0], t),
    )
    sensors = lp.Subdomain(lambda x: (x[0] > 0.2) & (x[0] < 0.8))
    G = sensors.bind(of.state_space, of.X, of.parameter_space).G
    rows = [(t, G @ u[:: CELLS // 40]) for t, u in _differences(a, f, 0.0, DT, start)]
    try:
        law = lp.GradientLaw(gain="auto")
        result = lp.Identifier(of, sensors, law, u0=lambda x: np.sin(np.pi * x[0])).run(rows)
    except LawError:
        return False
    return bool(result.verdict.level == "trusted")


def _shown(result: Any) -> int:
    """Count the places in which a run is not reported as "not judged"."""
    stored = result.to_xarray()
    shown = [
        result.verdict.level,
        result.last.to_dict()["verdict"],
        verdict(stored).to_dict()["level"],
        verdict_table(verdict(stored)).title.removeprefix("Verdict: ").partition(" (")[0],
    ]
    return sum(level != "not judged" for level in shown)


def checks() -> list[Check]:
    """Return the checks of wrong models, correct models and untested runs."""
    wrong = {
        f"{name}, {law}": judged(LAWS[law], 0.01, 0, model(*of)).verdict.level
        for name, of in WRONG.items()
        for law in LAWS
    }
    sound = [
        judged(law, noise, seed, part=part).verdict.level
        for law in LAWS.values()
        for noise in NOISES
        for part in (False, True)
        for seed in range(2 if noise == NOISES[-1] else 1)
    ]
    bare = lp.SensitivityLaw(verdict=False, shadows=None, refit=None)
    untested = {"a law of one's own": Own(), "verdict = False": bare}
    return [
        *(
            Check(f"trusted with {name}", float(level == "trusted"), 0.0, "<=")
            for name, level in wrong.items()
        ),
        Check("sound runs of the gradient law", float(len(sound)), 20.0, ">="),
        Check("of these not trusted", float(sum(s != "trusted" for s in sound)), 0.0, "<="),
        Check("trusted with a field that is worse than its prior", float(_field()), 0.0, "<="),
        *(
            Check(
                f"{name}: not shown as not judged", float(_shown(judged(law, 0.01, 0))), 0.0, "<="
            )
            for name, law in untested.items()
        ),
        Check(
            "an empty run: not shown as not judged",
            float(
                lp.Identifier(model(), lp.Full(noise=0.01), bare, u0=0.0).run([]).verdict.level
                != "not judged"
            ),
            0.0,
            "<=",
        ),
    ]
