"""Battery particle that is charged as fast as its surface allows, with a drifting diffusivity.

Charging fills a particle of graphite from its surface. If the surface is too full, lithium metal is
deposited, which ruins the cell. Therefore the filling at the surface has a limit. Its difference
from the mean filling depends on the diffusivity, which is unknown and drifts with temperature and
age. The measured voltage is a known function of the filling at the surface. It is flat near the
limit, where only a model determines the filling. If the assumed diffusivity is too large, the
surface exceeds the limit; if it is too small, charging is slow. In both cases the filter corrects
its state for the error of the diffusivity, so that the mean filling, and with it the state of
charge, is wrong, too.

The cell is charged and discharged in turn, as on a test bench, with a lower limit of the current
for discharging. The diffusivity is a random walk, drawn for each seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.control.problem import Problem, Simulated
from livepde.control import Goal, Trust, reduce
from livepde.fem import LogNormal, On, RandomWalk, Scalar, line
from livepde.identifier import Identifier
from livepde.laws import SensitivityLaw
from livepde.model import Model
from livepde.models import battery_particle
from livepde.models.battery import FARADAY
from livepde.observation import Functionals, Points, Transformed
from livepde.stepping import Alexander2

RADIUS, AREA, FULL = 5e-6, 1.0, 30555.0  # m, m^2, mol/m^3
CAPACITY = FARADAY * FULL * AREA * RADIUS / 3  # C, charge of the full particle
ONE = CAPACITY / 3600.0  # A, fills the particle in an hour
D, SPREAD = 3e-15, 0.5  # m^2/s, prior and standard deviation of its logarithm
DRIFT = 0.3 / np.sqrt(3600.0)  # s**-0.5, rate of the random walk of the logarithm
NOISE = 2e-3  # V
FASTEST = (-3.0 * ONE, 1.0 * ONE)  # A, charge and discharge
LIMITS = (0.05, 0.85)  # limits of the filling at the surface
LOW, HIGH = 0.3, 0.8  # mean filling
CYCLE, CHARGING = 5400.0, 2700.0  # s
CYCLES = 2
PERIOD, HORIZON = 30.0, 12
CELLS, FINE = 24, (72, 3.0)  # cells of the model; cells, and time step in s, of the truth


def process(cells: int) -> Model:
    """Return the model of the particle on a mesh that is finer towards the surface."""
    inward = np.linspace(1.0, 0.0, cells + 1)
    mesh = line((RADIUS * (1.0 - inward**2)).tolist())
    walk = RandomWalk(DRIFT)
    unknown = Scalar(LogNormal(D, SPREAD * D), evolution=walk)
    return battery_particle(mesh, unknown, area=AREA, c_max=FULL)


def graphite(x: Any) -> Any:
    """Return the open-circuit voltage for a filling (Safari and Delacourt, 2011)."""
    return (
        0.6379
        + 0.5416 * np.exp(-305.5309 * x)
        + 0.044 * np.tanh((0.1958 - x) / 0.1088)
        - 0.1978 * np.tanh((x - 1.0571) / 0.0854)
        - 0.6875 * np.tanh((x + 0.0117) / 0.0529)
        - 0.0175 * np.tanh((x - 0.5692) / 0.0875)
    )


def fillings() -> Functionals:
    """Return observations of mean filling and filling at the surface, exact in the model."""
    return Functionals(
        {
            "mean": lambda q, c, x: 3.0 / RADIUS * c / FULL,
            "surface": On("right", lambda q, c, x: c / FULL),
        }
    )


def drawn(seed: int) -> tuple[list[float], list[float]]:
    """Draw a truth, and return its times and diffusivities."""
    rng = np.random.default_rng([seed, 0])
    times = PERIOD * np.arange(round(CYCLES * CYCLE / PERIOD) + 1)
    gained = DRIFT * np.sqrt(PERIOD) * rng.standard_normal(len(times))
    path = D * np.exp(SPREAD * rng.standard_normal() + np.cumsum(gained))
    return times.tolist(), path.tolist()


def battery(seed: int = 0) -> Problem:
    """Return the problem of a seed."""
    voltage = Transformed(Points({"V": RADIUS}), lambda c: graphite(c / FULL), noise=NOISE)
    model, fine = process(CELLS), process(FINE[0])
    times, path = drawn(seed)
    start = LOW * FULL

    def truth(t: float) -> Mapping[str, float]:
        return {"D": float(np.interp(t, times, path))}

    def plant(noise: int) -> Simulated:
        at = {"I": 0.0}
        return Simulated(
            fine, voltage, fillings(), truth, u0=start, step=FINE[1], seed=noise, start=at
        )

    return Problem(
        name="battery",
        title="A battery particle whose diffusivity drifts",
        reduced=reduce(
            model, fillings(), ["I"], sensors=voltage, modes=2, rates=(1.0 / PERIOD,), u=start
        ),
        identifier=lambda: Identifier(
            model, voltage, SensitivityLaw(), u0=start, scheme=Alexander2(), between={"I": "next"}
        ),
        goal=Goal(
            track={"mean": 1.0},
            move={"I": 1e-5 / ONE**2},
            inputs={"I": FASTEST},
            limits={"surface": LIMITS},
        ),
        period=PERIOD,
        horizon=HORIZON,
        samples=round(CYCLES * CYCLE / PERIOD),
        plant=plant,
        truth=truth,
        drive={"I": 0.02 * ONE},
        reference=lambda t: {"mean": HIGH if t % CYCLE < CHARGING else LOW},
        disturbances=lambda t: {},
        before={"I": 0.0},
        tolerance=0.01,
        trust=Trust(spread=1.0),
    )
