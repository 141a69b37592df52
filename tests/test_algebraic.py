"""Components without a mass term: their equations hold at every moment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from factories import observe
from scipy.integrate import trapezoid
from skfem import ElementLineP1

import livepde as lp
from livepde.stepping import ForwardStage

MESH = lp.interval(0.0, 1.0, 16)
D, SIGMA = 0.2, 0.7


def electrolyte(held: bool = True, mass: Any = None) -> lp.Model:
    """A concentration that diffuses, and the quasi-static potential that its charge makes."""
    inflow = {"left": lambda x, t: np.sin(t) + 0.0 * x[0]}
    state = {
        "c": lp.Field(MESH, ElementLineP1(), dirichlet=inflow),
        "phi": lp.Field(MESH, ElementLineP1(), dirichlet={"right": 0.0} if held else {}),
    }
    unknowns = {
        "D": lp.LogNormal(0.3, 0.2),
        "sigma": lp.LogNormal(1.0, 0.5),
    }

    def fluxes(q: Any, u: Any, v: Any, x: Any) -> Any:
        diffusion = q.D * lp.dot(lp.grad(u.c), lp.grad(v.c))
        return diffusion + q.sigma * lp.dot(lp.grad(u.phi), lp.grad(v.phi))

    def charge(u: Any, v: Any, x: Any) -> Any:
        return -u.c * v.phi

    return lp.Model(state, unknowns, fluxes, charge, M=mass or (lambda u, v, x: u.c * v.c))


def test_only_components_without_a_mass_are_algebraic():
    model = electrolyte()
    part = model.state_space.part("phi")
    free = np.flatnonzero(model.X.free)
    assert model.algebraic.tolist() == [k for k in free if part.start <= k < part.stop]
    assert not len(electrolyte(mass=lambda u, v, x: u.c * v.c + u.phi * v.phi).algebraic)


def test_a_model_with_an_algebraic_component_passes_its_check():
    report = lp.diagnostics.check_model(electrolyte(), u=0.5)
    report.raise_if_failed()
    names = [line.name for line in report.lines]
    assert "M positive definite (failures)" in names
    assert "algebraic components: size of their inverse" in names


@pytest.mark.filterwarnings("ignore:the diffusion of 'c' is negative")  # relative to M
@pytest.mark.parametrize(
    ("options", "failed"),
    [
        ({"held": False}, ["algebraic components: size of their inverse"]),
        ({"mass": lambda u, v, x: -u.c * v.c}, ["M positive definite (failures)"]),
    ],
)
def test_what_does_not_determine_the_state_fails(options: Any, failed: list[str]):
    report = lp.diagnostics.check_model(electrolyte(**options), u=0.5)
    assert [line.name for line in report.failed] == failed


def test_the_potential_is_that_of_the_concentration_at_every_moment():
    """Of -sigma phi'' = c with phi(1) = 0 and no flux at 0: phi(0) is that of (1 - x) c / sigma."""
    model = electrolyte()
    forward, u = ForwardStage(model), model.initial(0.0)
    space = model.state_space
    nodes = MESH.p[0]
    for k in range(5):
        u = forward.solve(u, np.log([D, SIGMA]), 0.3, lp.fem.Moment(0.3 * (k + 1)))
        c, phi = u[space.part("c")], u[space.part("phi")]
        fine = np.linspace(0.0, 1.0, 4001)
        inner = (1.0 - fine) * np.interp(fine, nodes, c)
        expected = trapezoid(inner, fine) / SIGMA
        assert phi[np.argmin(nodes)] == pytest.approx(expected, rel=1e-5)


def samples(sensors: lp.observation.Observation, noise: float) -> list[tuple[float, Any]]:
    model, rng = electrolyte(), np.random.default_rng(0)
    observed = observe(model, sensors)
    forward, u, found = ForwardStage(model), model.initial(0.0), []
    for k in range(60):
        for j in range(10):  # the truth takes ten steps for each of the filter's
            moment = lp.fem.Moment(0.1 * k + 0.01 * (j + 1))
            u = forward.solve(u, np.log([D, SIGMA]), 0.01, moment)
        z = observed.G @ u
        found.append((0.1 * (k + 1), z + noise * rng.standard_normal(len(z))))
    return found


@pytest.mark.parametrize("refit", [None, lp.laws.Refit()])
@pytest.mark.parametrize("of", ["phi", "c and phi"])
@pytest.mark.slow
def test_both_unknowns_are_identified_from_the_potential(refit: Any, of: str):
    law = lp.SensitivityLaw(refit=refit, shadows=None)
    noise = 0.01
    potential = lp.Points({"phi_2": 0.2, "phi_6": 0.6}, of="phi", noise=noise)
    concentration = lp.Points({"c_5": 0.5}, of="c", noise=noise)
    sensors = potential if of == "phi" else lp.Combined([concentration, potential])
    options: Any = {"u0": 0.0, "scheme": lp.Alexander2()}
    identifier = lp.Identifier(electrolyte(), sensors, law, **options)
    estimate = None
    for t, z in samples(sensors, noise):
        estimate = identifier.step(t, z)
        assert estimate.status.ok
    assert estimate is not None
    for name, true in (("D", D), ("sigma", SIGMA)):
        value, std = estimate.parameters[name]
        assert abs(value - true) < 4.0 * std < 0.4 * true


def test_the_gradient_law_needs_a_mass_everywhere():
    potential = lp.Points([0.2, 0.6], of="phi")
    with pytest.raises(lp.errors.LawError, match="no mass term, so M is not an inner product"):
        lp.Identifier(electrolyte(), potential, lp.GradientLaw())
