"""The battery particle agrees with a sphere under constant flux, with balances and with twins."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import livepde as lp
from livepde.errors import ModelError
from livepde.models import battery_particle
from livepde.models.battery import FARADAY
from livepde.stepping import Advance, Alexander2, simulate

R, AREA, FULL = 5e-6, 1.0, 30555.0
D = 5e-14
START = 0.8 * FULL
CURRENT = 1.0


def particle(
    cells: int = 30, slope: lp.fem.Unknown | None = None, evolution: Any = None, std: float = D
) -> lp.Model:
    moving = {"evolution": evolution} if evolution else {}
    return battery_particle(
        lp.interval(0.0, R, cells),
        lp.Scalar(lp.LogNormal(D, std), **moving),
        slope,
        area=AREA,
        c_max=FULL,
    )


def discharged(model: lp.Model, times: Any, q: Any = None) -> Any:
    """Return radii and concentrations after a discharge with a constant current."""
    constant = lambda t: {"I": CURRENT}  # noqa: E731
    start = model.initial_parameter(q)
    *_, (_, c) = simulate(model, start, START, times, Advance(Alexander2()), constant)
    order = np.argsort(model.state.mesh.p[0])
    return model.state.mesh.p[0][order], (model.state_block.at_vertices @ c)[order]


def crank(r: Any, t: float) -> Any:
    """Concentration in a sphere that loses a constant flux (Crank, section 6.3)."""
    f = lambda x: np.sin(x) - x * np.cos(x)  # noqa: E731
    roots = np.array([brentq(f, n * np.pi + 0.1, (n + 0.5) * np.pi) for n in range(1, 60)])[:, None]
    tau, x = D * t / R**2, np.maximum(r / R, 1e-6)
    modes = np.sin(roots * x) / (roots**2 * np.sin(roots)) * np.exp(-(roots**2) * tau)
    shape = 3 * tau + x**2 / 2 - 0.3 - 2 / x * modes.sum(axis=0)
    return START - CURRENT / (FARADAY * AREA) * R / D * shape


TIMES = np.concatenate([[0.0], np.geomspace(0.05, 600.0, 200)])


@pytest.mark.slow
def test_constant_flux_is_that_of_the_textbook():
    errors = []
    for cells in (20, 40):
        r, c = discharged(particle(cells), TIMES)
        exact = crank(r, TIMES[-1])
        errors.append(np.abs(c - exact).max() / np.ptp(exact))
    assert errors[0] < 5e-3
    assert errors[1] < 0.4 * errors[0]


@pytest.mark.slow
def test_what_leaves_is_the_charge():
    model = particle(slope=lp.Normal(-1.0, 1.0))
    _, c = discharged(model, TIMES)
    mesh = model.state.mesh
    assert np.all(np.diff(mesh.p[0]) > 0)  # c is in the order of the coefficients
    volume = (model.mass @ np.ones(len(c))).sum()
    lost = START - (model.mass @ c).sum() / volume
    assert lost == pytest.approx(3 * CURRENT * TIMES[-1] / (FARADAY * AREA * R), rel=1e-6)


@pytest.mark.slow
def test_diffusivity_follows_the_filling():
    """Near the surface -D(c) c_r is the flux."""
    r, c = discharged(particle(400, slope=lp.Normal(2.0, 1.0)), TIMES)
    middle = (c[-1] + c[-2]) / 2
    mobility = D * np.exp(2.0 * (middle / FULL - 0.5))
    flux = -mobility * (c[-1] - c[-2]) / (r[-1] - r[-2])
    assert flux == pytest.approx(CURRENT / (FARADAY * AREA), rel=0.01)
    _, without = discharged(particle(30, slope=lp.Normal(0.0, 1.0)), TIMES)
    _, constant = discharged(particle(30), TIMES)
    assert np.allclose(without, constant)


@pytest.mark.parametrize(
    ("start", "area", "c_max", "message"),
    [
        (0.0, 0.0, FULL, "area must be a positive number"),
        (0.0, AREA, -1.0, "c_max must be a positive number"),
        (0.1 * R, AREA, FULL, "centre"),
    ],
)
def test_what_is_no_particle_is_refused(start, area, c_max, message):
    with pytest.raises(ModelError, match=message):
        battery_particle(lp.interval(start, R, 10), lp.Normal(D, D), area=area, c_max=c_max)
