"""Problems of tests/test_petsc.py, and their solutions by the serial laws of livepde."""

from functools import cache
from typing import ClassVar

import numpy as np

import livepde as lp
from livepde.laws.damping import ConstantDamping
from livepde.stepping import Newton, simulate

CELLS = (20, 16)
POINTS = [(0.22, 0.31), (0.61, 0.42), (0.5, 0.73)]
PRIOR, STD, NOISE, MODES = [0.3, 1.0], [0.1, 0.5], 0.01, 4
STEP = 0.05
EULER = lp.Advance(lp.ImplicitEuler())


class Filter(lp.SensitivityLaw):
    """Sensitivity law without a graded start."""

    graded_start: ClassVar[bool] = False


def plain(**options):
    """Return the filter without refits, guards, shadows, verdict and gate."""
    disabled = {"refit": None, "guards": None, "shadows": None, "verdict": False}
    return Filter(noise=NOISE, gate=np.inf, **disabled, **options)


@cache
def mesh():
    return lp.rectangle((0.0, 1.0), (0.0, 0.8), CELLS).to_meshtri()


def source(x, sine):
    return 3.0 * (1.0 + x) * (1.0 + sine)


def omega(x):
    return x[0] < 0.6


def numbers():
    return lp.Model(
        state=lp.Field(mesh(), lp.linear(mesh()), dirichlet={"left": 2.0}),
        parameter={
            name: lp.Normal(mean, std)
            for name, mean, std in zip(("k", "s"), PRIOR, STD, strict=True)
        },
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) + q.s * u * v,
        B=[lp.On(side, lambda u, v, x: 0.5 * (u - 1.0) * v) for side in ("right", "bottom", "top")],
        f=lambda x, t: source(x[0], np.sin(t)),
    )


def reaction():
    return lp.Model(
        state=lp.Field(mesh(), lp.linear(mesh()), dirichlet={"left": 2.0}),
        parameter=lp.Field(mesh(), lp.linear(mesh()), inner="H1", prior=lp.Normal(1.0)),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: 0.1 * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: 10.0 * (1.0 + x[0]),
    )


def readings(count=6):
    rng = np.random.default_rng(1)
    waves = np.outer(STEP * np.arange(1, count + 1), [0.8, 1.4, 1.1])
    z = 2.0 + waves + NOISE * rng.standard_normal(waves.shape)
    z[2, 1] = np.nan
    return list(zip(STEP * np.arange(1, count + 1), z, strict=True))


def field_readings():
    return [(t, z + 0.2 * t) for t, z in readings()]


@cache
def data(count=6):
    """Return times and states of the process with the true q."""
    model = reaction()
    q = model.initial_parameter(lambda x: 1.0 + x[0] * x[1])
    times = STEP * np.arange(count + 1)
    return list(simulate(model, q, 2.0, times, EULER))[1:]


def rest(count=9):
    """Return rows of a transient, followed by noise about zero."""
    rng, (_, first) = np.random.default_rng(2), data()[0]
    rows = [(STEP * (k + 1), u) for k, (_, u) in enumerate(data()[:3])]
    for k in range(4, count + 1):
        rows.append((STEP * k, 0.02 * rng.standard_normal(len(first))))
    return rows


def filtered(model, law, rows):
    points = lp.Points(POINTS, noise=NOISE)
    identifier = lp.Identifier(model, points, law, u0=2.0, scheme=lp.ImplicitEuler())
    for t, z in rows:
        estimate = identifier.step(t, z)
        assert estimate.status.ok
    # The filter's own factor, because reported intervals are wider if innovations are correlated.
    (root,) = identifier._state.now.C
    return estimate, np.sqrt((root**2).sum(axis=0))


def observed(observation, law):
    model = reaction()
    identifier = lp.Identifier(model, observation, law, u0=2.0, q0=0.5, scheme=lp.ImplicitEuler())
    for t, u in data():
        estimate = identifier.step(t, identifier.observed.G @ u)
        assert estimate.status.ok
    return estimate


def solved():
    """Return all estimates by the serial laws of livepde."""
    first, shares = filtered(numbers(), plain(), readings())
    field, _ = filtered(reaction(), plain(modes=MODES), field_readings())
    strict = {"gain": 100.0, "gate": None, "newton": Newton(tolerance=1e-11, share=0.0)}
    part = lp.Subdomain(omega)
    estimates = {
        "full": observed(lp.Full(), lp.GradientLaw(**strict)),
        "part": observed(part, lp.GradientLaw(nu=0.01, sigma=0.1, **strict)),
        "constant": observed(part, lp.GradientLaw(damping=ConstantDamping(mu=0.5), **strict)),
    }
    return {
        "numbers.q": np.array([first.parameters[name][0] for name in ("k", "s")]),
        "numbers.std": np.array(STD) * shares,
        "numbers.u": first.u,
        "modes.q": field.q,
        "modes.u": field.u,
        **{f"{name}.q": estimate.q for name, estimate in estimates.items()},
        **{f"{name}.u": estimate.u for name, estimate in estimates.items()},
    }
