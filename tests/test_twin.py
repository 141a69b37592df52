"""Twin experiments: truth separate from the estimator, stated noise, errors against the truth."""

from typing import Any

import numpy as np
import pytest
from skfem import ElementLineHermite, ElementLineP1

import livepde as lp
from livepde.streams import AbsoluteNoise, RelativeNoise, Twin

TIMES = 0.1 * np.arange(6)


def q_true(x: Any) -> Any:
    return 1 + x[0]


def u_true(x: Any, t: float) -> Any:
    return np.exp(-t) * np.sin(np.pi * x[0])


def f(x: Any, t: float) -> Any:
    return (np.pi**2 - 1 + q_true(x)) * u_true(x, t)


def build(cells: int = 12, element: Any = ElementLineHermite) -> lp.Model:
    mesh = lp.interval(0, 1, cells)
    return lp.Model(
        lp.Field(mesh, element(), dirichlet={"boundary": 0.0}),
        lp.Field(mesh, element(), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        f=f,
    )


MODEL = build()
MIDDLE = lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.8))
SENSORS = lp.Points({"a": 0.25, "b": 0.6})


def twin(**options: Any) -> Twin:
    given = {
        "model": MODEL,
        "observation": MIDDLE,
        "q_true": q_true,
        "u_true": u_true,
        "times": TIMES,
        "scheme": lp.ImplicitEuler(),
    }
    return Twin(**{**given, **options})


def data(stream: Twin) -> np.ndarray:
    return np.array([sample.z for sample in stream])


def test_samples_carry_time_and_data_only() -> None:
    samples = list(twin(noise=RelativeNoise(0.01)))
    assert len(samples) == len(twin()) == len(TIMES)
    assert [sample.t for sample in samples] == TIMES.tolist()
    for sample in samples:
        assert type(sample) is lp.Sample
        assert set(vars(sample)) == {"t", "z", "inputs"}
        assert sample.inputs is None


@pytest.mark.slow
def test_estimator_never_receives_the_truth() -> None:
    # Two twins that differ in the names of their truth only through the data: an identifier that
    # is fed the same numbers by hand gives the same estimate to the last bit.
    stream = twin()
    law = lp.GradientLaw(gain=10.0)
    fed = lp.Identifier(MODEL, MIDDLE, law, u0=lambda x: u_true(x, 0.0)).run(stream)
    by_hand = lp.Identifier(MODEL, MIDDLE, law, u0=lambda x: u_true(x, 0.0))
    for t, z in zip(TIMES, stream.exact_data, strict=True):
        estimate = by_hand.step(t, z)
    assert np.array_equal(fed.last.q, estimate.q)
    assert np.array_equal(fed.last.u, estimate.u)


def test_discrete_truth_is_the_model_itself() -> None:
    stream = twin()
    control = lp.Advance(lp.ImplicitEuler())
    states = [u for _, u in lp.simulate(MODEL, stream.q, lambda x: u_true(x, 0.0), TIMES, control)]
    assert np.array_equal(states, stream.states)
    assert np.array_equal(stream.exact_data, np.array(states) @ stream.observed.G.T)


@pytest.mark.parametrize("observation", [SENSORS, MIDDLE])
def test_fine_truth_lies_between_discrete_and_analytic(
    observation: lp.observation.Observation,
) -> None:
    fine = twin(truth="fine", observation=observation, fine=build(48), fine_dt=0.005)
    discrete = twin(observation=observation)
    exact = twin(truth="analytic", observation=observation)
    assert fine.exact_data.shape == discrete.exact_data.shape
    error = np.abs(fine.exact_data - exact.exact_data).max()
    assert 0 < error < 0.1 * np.abs(discrete.exact_data - exact.exact_data).max()


def test_fine_points_see_the_fine_state_itself() -> None:
    # A kink of the coarse P1 state at 0.25 + h/2 would show in data that had been projected.
    coarse, fine = build(4, ElementLineP1), build(64, ElementLineP1)
    stream = twin(model=coarse, observation=SENSORS, truth="fine", fine=fine, fine_dt=0.005)
    expected = [u_true([0.25], t) for t in TIMES]
    assert np.allclose(stream.exact_data[:, 0], np.squeeze(expected), atol=2e-3)


@pytest.mark.study
@pytest.mark.parametrize("observation", [SENSORS, MIDDLE, lp.Full()])
def test_relative_noise_has_its_level_in_the_norm_of_Z(
    observation: lp.observation.Observation,
) -> None:
    level, squares = 0.05, []
    for seed in range(300):
        noisy = twin(observation=observation, noise=RelativeNoise(level), seed=seed)
        noise = data(noisy) - noisy.exact_data
        W = noisy.weights
        ratio = [(n @ W @ n) / (z @ W @ z) for n, z in zip(noise, noisy.exact_data, strict=True)]
        squares.append(ratio)
    mean = np.mean(squares, axis=0)  # for every sample apart
    tolerance = 5 * np.std(squares, axis=0) / np.sqrt(len(squares))
    assert np.all(np.abs(mean - level**2) < tolerance)


def test_weights_are_the_norm_of_the_observed_part() -> None:
    stream = twin()
    z = stream.exact_data[1]
    u = stream.observed.split().reconstruct(z, np.zeros(MODEL.X.dim))
    assert np.isclose(z @ stream.weights @ z, MODEL.X.inner(u, u))
    assert np.array_equal(twin(observation=SENSORS).weights, np.eye(2))


@pytest.mark.long
def test_absolute_noise() -> None:
    draws = [
        data(twin(observation=SENSORS, noise=AbsoluteNoise([0.1, 2.0]), seed=seed))
        for seed in range(200)
    ]
    std = np.std(draws, axis=0).mean(axis=0)
    assert np.allclose(std, [0.1, 2.0], rtol=0.1)
    with pytest.raises(lp.errors.ConfigurationError, match="2 standard deviations for"):
        list(twin(noise=AbsoluteNoise([0.1, 2.0])))


def test_errors_and_baseline() -> None:
    stream = twin()
    assert stream.baseline() == pytest.approx(1.0)  # q = 0
    assert stream.baseline(q_true) == 0.0
    assert stream.error(1.1 * stream.q) == pytest.approx(0.1)
    assert stream.baseline(1.0) == pytest.approx(np.sqrt((1 / 3) / (7 / 3)))


def test_errors_of_one_of_several_unknowns() -> None:
    mesh = lp.interval(0, 1, 4)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"boundary": 0.0}),
        {"D": lp.Normal(1.0), "c": lp.Normal(2.0)},
        A=lambda q, u, v, x: q.D * lp.dot(lp.grad(u), lp.grad(v)) + q.c * u * v,
    )
    stream = twin(model=model, q_true={"D": 2.0, "c": 4.0}, observation=SENSORS)
    assert stream.error(np.array([1.0, 4.0]), "D") == 0.5
    assert stream.error(np.array([1.0, 4.0]), "c") == 0.0
    assert stream.baseline() == pytest.approx(0.5)


def test_energy_is_that_of_the_paper_and_never_grows() -> None:
    stream, gain = twin(observation=lp.Full()), 50.0
    law = lp.GradientLaw(gain=gain)
    identifier = lp.Identifier(MODEL, lp.Full(), law, u0=lambda x: u_true(x, 0.0))
    estimates = [identifier.step(sample.t, sample.z) for sample in stream]
    energies = [stream.energy(estimate, gain) for estimate in estimates]
    assert energies[0] == pytest.approx(MODEL.Q.inner(stream.q, stream.q) / gain)
    assert np.all(np.diff(energies) <= 1e-14)
    e, r = estimates[-1].q - stream.q, estimates[-1].u - stream.u(0.5)
    assert energies[-1] == pytest.approx(MODEL.Q.norm(e) ** 2 / gain + MODEL.X.norm(r) ** 2)


def test_inputs_travel_with_the_samples() -> None:
    mesh = lp.interval(0, 1, 8)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lp.Channel("T0")}),
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
    )
    stream = Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=lp.Points([0.0, 0.5]),
        q_true=1.0,
        u0=0.0,
        times=TIMES,
        inputs=lambda t: {"T0": 1.0 + t},
    )
    for sample in stream:
        assert sample.inputs == {"T0": 1.0 + sample.t}
        assert np.asarray(sample.z)[0] == pytest.approx(1.0 + sample.t)
    assert lp.Identifier(model, lp.Points([0.0, 0.5]), lp.SensitivityLaw(noise=0.1)).run(stream)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"truth": "exact"}, "expected one of analytic, discrete, fine"),
        ({"times": [0.0]}, "two or more"),
        ({"times": [0.0, 0.2, 0.1]}, "increasing"),
        ({"truth": "analytic", "u_true": None, "u0": 0.0}, "needs the formula"),
        ({"u_true": None}, "initial state u0"),
        ({"truth": "fine"}, "needs a model `fine`"),
    ],
)
def test_refusals(options: dict[str, Any], message: str) -> None:
    with pytest.raises(lp.errors.ConfigurationError, match=message):
        twin(**options)


def test_refuses_what_has_no_answer() -> None:
    with pytest.raises(lp.errors.ConfigurationError, match="level must be"):
        RelativeNoise(-0.1)
    with pytest.raises(lp.errors.ConfigurationError, match="one number >= 0"):
        AbsoluteNoise(-1.0)
    with pytest.raises(lp.errors.ConfigurationError, match="not a sample time"):
        twin().u(0.05)
    with pytest.raises(lp.errors.ConfigurationError, match="q_true is zero"):
        twin(q_true=0.0).baseline()


def test_a_truth_that_cannot_be_computed_says_so() -> None:
    mesh = lp.interval(0, 1, 4)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        lp.Normal(),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: -(1e6 + u**2) * v,  # blows up: no implicit step has a real root
    )
    stream = Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=SENSORS,
        q_true=0.0,
        u0=0.0,
        times=[0.0, 1.0],
    )
    with pytest.raises(lp.errors.ConfigurationError, match=r"truth .* cannot be computed"):
        list(stream)
