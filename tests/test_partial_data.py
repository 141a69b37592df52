"""`gain="auto"` on partial data: refused with derivatives of u in A, unsmoothed without."""

from typing import Any

import numpy as np
import pytest
from factories import turns

import livepde as lp
from benchmarks.partial import PROCESSES, Readings, omega
from livepde.errors import LawError

AUTO = lp.GradientLaw(gain="auto")
MESH = lp.interval(0.0, 1.0, 10)
SQUARE = lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4))
FLUX = "SensitivityLaw on this Subdomain"


def laplace(u: Any, v: Any) -> Any:
    return lp.dot(lp.grad(u), lp.grad(v))


# Whether each contains derivatives of u, by definition: after an integration by parts where the
# test function has a derivative.
OPERATORS = {
    "reaction": (False, lambda q, u, v, x: q * u * v),
    "reaction of higher order": (False, lambda q, u, v, x: q * (u - u**3) * v),
    "reaction with a root": (False, lambda q, u, v, x: q * np.sqrt(u) * v),
    "saturation": (False, lambda q, u, v, x: q * u / (1.0 + lp.fem.absolute(u)) * v),
    "source": (False, lambda q, u, v, x: -q * v),
    "source by its flux": (False, lambda q, u, v, x: q * lp.grad(v)[0]),
    "slope of q": (False, lambda q, u, v, x: lp.grad(q)[0] * u * v),
    "exchange at an end": (False, lp.On("left", lambda q, u, v, x: q * (u - 1.0) * v)),
    "diffusivity": (True, lambda q, u, v, x: q * laplace(u, v)),
    "diffusivity of u": (True, lambda q, u, v, x: (1.0 + q * u) * laplace(u, v)),
    "velocity": (True, lambda q, u, v, x: q * lp.grad(u)[0] * v),
    "velocity, conservative": (True, lambda q, u, v, x: -q * u * lp.grad(v)[0]),
    "Burgers": (True, lambda q, u, v, x: -q * u**2 / 2 * lp.grad(v)[0]),
    "mixed": (True, lambda q, u, v, x: q * u * v + q * laplace(u, v)),
    "late": (True, lambda q, u, v, x: q * u * v + (x.t > 500.0) * q * laplace(u, v)),
    "threshold": (True, lambda q, u, v, x: q * (u > 1e5) * laplace(u, v)),
    "two terms": (True, [lambda q, u, v, x: q * u * v, lambda q, u, v, x: q * laplace(u, v)]),
}
UNKNOWNS = {
    "field": lambda mesh: lp.Field(mesh, lp.linear(mesh), inner="H1", prior=lp.Normal(1.0, 0.5)),
    "positive field": lambda mesh: lp.Field(
        mesh, lp.linear(mesh), inner="H1", prior=lp.LogNormal(1.0, std=0.5)
    ),
    "number": lambda mesh: lp.Normal(1.0, 0.5),
}


def model(A: Any, unknown: str = "field", mesh: Any = MESH, **options: Any) -> lp.Model:
    state = lp.Field(mesh, lp.linear(mesh), dirichlet={"right": 0.0})
    return lp.Model(state, UNKNOWNS[unknown](mesh), A=A, B=lambda u, v, x: laplace(u, v), **options)


@pytest.mark.parametrize(("name", "unknown", "mesh"), turns(OPERATORS, UNKNOWNS, [MESH, SQUARE]))
def test_derivatives_of_u_are_found(name, unknown, mesh):
    expected, A = OPERATORS[name]
    if name == "slope of q" and unknown == "number":
        pytest.skip("a number has no slope")
    assert model(A, unknown, mesh).form_A.differentiates("u") is expected


def test_second_derivatives_are_found():
    smooth = lp.fem.hermite(MESH)
    for A in (
        lambda q, u, v, x: q * lp.fem.hess(u)[0, 0] * v,
        lambda q, u, v, x: q * u * lp.fem.hess(v)[0, 0],
    ):
        state = lp.Field(MESH, smooth, dirichlet={"boundary": 0.0})
        assert lp.Model(state, lp.Normal(1.0, 0.5), A=A).form_A.differentiates("u")


@pytest.mark.parametrize(
    "seen",
    [
        lp.Subdomain(omega),
        lp.Points([0.25, 0.5, 0.75]),
        lp.Averages({"left": lambda x: x[0] < 0.5, "right": lambda x: x[0] > 0.5}),
    ],
    ids=["subdomain", "points", "averages"],
)
def test_partial_data_of_a_diffusivity_are_refused_in_one_sentence(seen):
    for name, (derivatives, A) in OPERATORS.items():
        if not derivatives:
            lp.Identifier(model(A), seen, AUTO, u0=0.0)
            continue
        with pytest.raises(LawError, match=FLUX) as refused:
            lp.Identifier(model(A), seen, AUTO, u0=0.0)
        assert str(refused.value).count(". ") == 0, name


def test_full_data_and_constant_gains_are_not_refused():
    _, A = OPERATORS["diffusivity"]
    lp.Identifier(model(A), lp.Full(), AUTO, u0=0.0)
    lp.Identifier(model(A), lp.Points(np.linspace(0.0, 0.9, 10).tolist()), AUTO, u0=0.0)
    lp.Identifier(model(A), lp.Subdomain(omega), lp.GradientLaw(gain=10.0), u0=0.0)


def test_a_component_that_is_not_observed_makes_the_data_partial():
    state = {
        name: lp.Field(MESH, lp.linear(MESH), dirichlet={"boundary": 0.0}) for name in ("u", "w")
    }

    def diffusion(q, s, v, x):
        return q * laplace(s.u, v.u)

    def reaction(q, s, v, x):
        return q * s.w * v.u

    def rest(s, v, x):
        return laplace(s.w, v.w)

    seen = lp.Full(of="u")
    with pytest.raises(LawError, match=FLUX):
        lp.Identifier(lp.Model(state, lp.Normal(1.0, 0.5), diffusion, rest), seen, AUTO, u0=0.0)
    lp.Identifier(lp.Model(state, lp.Normal(1.0, 0.5), reaction, rest), seen, AUTO, u0=0.0)


@pytest.mark.slow
def test_noisy_partial_data_are_not_smoothed_and_the_error_does_not_grow():
    data = Readings.drawn(PROCESSES["line, field"], 0)
    states = data.noisy(0.01, 0)
    for noise in (None, 0.01 * float(np.sqrt((data.states**2).mean()))):
        seen = lp.Subdomain(omega, noise=noise)
        identifier = lp.Identifier(data.model, seen, AUTO, u0=data.process.start)
        errors, alphas = [], []
        for t, u in zip(data.times, states, strict=True):
            estimate = identifier.step(float(t), identifier.observed.G @ u)
            errors.append(data.error(estimate.q))
            alphas.append(np.nan_to_num(estimate.diagnostics.alpha))
        assert max(alphas) == 0.0
        assert errors[-1] <= 1.1 * errors[len(errors) // 2]
        assert errors[-1] <= 0.4  # smoothed it was 0.48


@pytest.mark.slow
def test_the_independent_truth_converges():
    """Twice the cells move the states of the benchmark by less than a thousandth."""
    process = PROCESSES["line, number"]
    finer = type(process)(1, 2 * process.cells, field=False)
    times = 0.05 * np.arange(21)
    coarse = process.states(np.full(process.cells + 1, 3.0), times)
    fine = finer.states(np.full(finer.cells + 1, 3.0), times)[:, ::2]
    assert np.abs(coarse - fine).max() <= 1e-3 * np.abs(fine).max()


@pytest.mark.parametrize(
    "sensors",
    [lp.Full(noise=0.01), lp.Subdomain(lambda x: x[0] < 0.75, noise=0.01), lp.Points([0.3, 0.6])],
)
def test_data_may_begin_after_the_first_sample(sensors):
    """The law was stuck in failed steps: it went by the noise of no data."""
    reaction = model(OPERATORS["reaction"][1], f=lambda x, t: 5.0 + 3.0 * np.sin(t) + 0.0 * x[0])
    times = 0.1 * np.arange(1, 40)
    truth = lp.Identifier(reaction, sensors, lp.GradientLaw(), q0=2.0, dt_max=0.1)
    z = truth.forecast(times).z
    z += 0.01 * np.random.default_rng(0).standard_normal(z.shape)
    who = lp.Identifier(reaction, sensors, AUTO, dt_max=0.1, assimilate_from=0.35)
    found = [who.step(t, values) for t, values in zip(times, z, strict=True)]
    assert all(estimate.status.ok for estimate in found)
    np.testing.assert_allclose(found[-1].q[:7], 2.0, atol=0.5)  # the prior is 1
