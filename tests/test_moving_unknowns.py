"""Time-varying and transformed unknowns: Kalman filter, refits, checkpoints and theory."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from factories import advanced, observe
from scipy.optimize import least_squares
from skfem import ElementLineP1

import livepde as lp
from livepde import cases
from livepde.cases.new_case import write_template
from livepde.cases.preview import preview
from livepde.diagnostics import Excitation, Spaces, theory_report
from livepde.linalg import Array
from livepde.stepping import ForwardStage
from livepde.streams import AbsoluteNoise, Twin

NOISE = 0.02
SENSORS = {"a": 0.3, "b": 0.55, "c": 0.8}
REVERTING = lp.MeanReverting(1.5)
mesh = lp.interval(0.0, 1.0, 6)


def linear_model(evolution: Any, offsets: Any = REVERTING) -> lp.Model:
    """Return a rod with an unknown source, offsets of two sensors, and an unknown initial state.

    Source and offsets move by `evolution` and `offsets`.
    """
    unknowns = {
        "s": lp.Scalar(lp.Normal(0.5, 0.7), evolution=evolution),
        "off": lp.Scalars(("a", "b"), lp.Normal(0.1, 0.2), evolution=offsets),
        "u0": lp.Field(mesh, ElementLineP1(), inner="H1", prior=lp.Normal(0.3, std=0.6)),
    }
    return lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lambda x, t: np.sin(t) + 0 * x[0]}),
        unknowns,
        A=lambda q, u, v, x: -q.s * (1 + x[0]) * v,
        B=lambda u, v, x: 0.3 * lp.dot(lp.grad(u), lp.grad(v)) + 0.4 * u * v,
        initial=lambda q, v, x: q.u0 * v,
    )


def sensors() -> lp.Points:
    direct = {"a": lambda q, x: q.off["a"], "b": lambda q, x: q.off["b"]}
    return lp.Points(SENSORS, noise=NOISE, direct=direct)


def samples(count: int = 30, missing: bool = True) -> list[tuple[float, Array]]:
    """Return irregular samples, from time zero on; some values are missing, two samples whole."""
    rng = np.random.default_rng(0)
    times = np.cumsum(np.append(0.0, rng.uniform(0.05, 0.2, count)))
    z = np.outer(np.sin(times), [0.7, 0.5, 0.2]) + 0.4 + 0.3 * np.cos(2 * times)[:, None]
    z += 0.05 * rng.standard_normal(z.shape)
    if missing:
        z[rng.random(z.shape) < 0.2] = np.nan
        z[10:12] = np.nan
    return list(zip(times.tolist(), z, strict=True))


MOVING = {
    "walk": (lp.Scalar(lp.Normal(1.0, 0.5), evolution=lp.RandomWalk(0.4)), 0.0),
    "reverting": (lp.Scalar(lp.Normal(1.0, 0.5), evolution=lp.MeanReverting(0.4)), 0.0),
    "periodic": (lp.Scalar(lp.Normal(1.0, 0.5), evolution=lp.fem.Periodic(2.0)), 0.0),
    "drift": (lp.Normal(1.0, 0.5), 0.1),
}


@pytest.mark.parametrize("name", MOVING)
def test_unknowns_that_move_are_not_fitted(name: str):
    unknown, drift = MOVING[name]
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()), {"k": unknown}, A=lambda q, u, v, x: q.k * u * v
    )
    points = lp.Points([0.5], noise=NOISE)
    identifier = lp.Identifier(model, points, lp.SensitivityLaw(drift=drift), u0=1.0)
    stream = [(t, [np.exp(-t)]) for t in 0.1 * np.arange(1, 6)]
    result = identifier.run(stream)
    assert result.last.fit is None
    assert abs(result.last.parameters["k"][0] - 1.0) < 2.0 * result.last.parameters["k"][1]


@pytest.mark.slow
def test_a_checkpoint_of_other_modes_is_refused_whatever_its_width(tmp_path: Path):
    model = linear_model(lp.RandomWalk(0.4))
    first, other = (
        lp.Identifier(model, sensors(), lp.SensitivityLaw(modes=modes)) for modes in (3, 4)
    )
    for t, z in samples(4):
        first.step(t, z)
    first.save(tmp_path / "state.bin")
    with pytest.raises(lp.errors.RunError, match="another option of the law"):
        other.load(tmp_path / "state.bin")


def test_an_initial_state_may_read_channels():
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        {"gain": lp.Normal(0.0, 1.0)},
        A=lambda q, u, v, x: 0.1 * u * v + 0.0 * q.gain * v,
        initial=lambda q, v, x: q.gain * x.inputs["T"] * v,
        inputs=["T"],
    )
    identifier = lp.Identifier(model, lp.Points([0.3], noise=1e-3), lp.SensitivityLaw())
    estimate = identifier.step(0.0, [3.0], {"T": 2.0})
    assert estimate.parameters["gain"][0] == pytest.approx(1.5, rel=1e-5)
    np.testing.assert_allclose(estimate.u, 3.0, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("refit", "first"), [(None, True), (lp.Refit(), True), (lp.Refit(), False)]
)
def test_a_nonlinear_initial_state_is_linearised_anew(refit: Any, first: bool):
    unknown = lp.LogNormal(1.0, 1.0)
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        {"u0": unknown},
        A=lambda q, u, v, x: 0.1 * u * v,
        initial=lambda q, v, x: q.u0 * v,
    )
    truth = model.initial_parameter({"u0": 5.0})
    forward, u = ForwardStage(model), model.initial_state(truth)
    law = lp.SensitivityLaw(refit=refit)
    identifier = lp.Identifier(model, lp.Points([0.3, 0.6], noise=0.01), law)
    if first:
        identifier.step(0.0, identifier.observed.G @ u)
    for k in range(1, 20):
        u = advanced(forward, u, truth, 0.1 * (k - 1), 0.1 * k)
        estimate = identifier.step(0.1 * k, identifier.observed.G @ u)
    value, std = estimate.parameters["u0"]
    assert abs(value - 5.0) < std < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("law", [lp.SensitivityLaw(modes=3), lp.GradientLaw()])
def test_a_moving_field_keeps_its_boundary_value(law: Any):
    field = lp.Field(
        mesh,
        ElementLineP1(),
        inner="H1",
        prior=lp.Normal(1.0),
        dirichlet={"left": 0.0},
        evolution=lp.MeanReverting(1.0),
    )
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()),
        {"s": field},
        A=lambda q, u, v, x: -q.s * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
    )
    identifier = lp.Identifier(model, lp.Points([0.3], noise=0.1), law)
    for k in range(4):
        estimate = identifier.step(0.5 * k, [1.0 + 0.5 * k])
    fixed = model.parameter_space.fixed
    assert len(fixed) == 1
    np.testing.assert_array_equal(estimate.q[fixed], 0.0)


def reacting(first: lp.fem.Unknown) -> lp.Model:
    return lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"right": 0.0}),
        {"a": first, "b": lp.Normal(0.3, 0.2)},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)) + q.b * u * v,
    )


def theory(model: lp.Model) -> Any:
    full, start = lp.Full(noise=0.01), lambda x: 1 - x[0] ** 2
    times, q = np.arange(0.0, 2.0, 0.1), {"a": 0.6, "b": 0.5}
    twin = Twin(model=model, observation=full, q_true=q, u0=start, times=times)
    identifier = lp.Identifier(model, full, lp.GradientLaw(gain=10.0), u0=start)
    return twin, theory_report(identifier, twin, twin=twin)


@pytest.mark.slow
def test_the_theory_of_a_periodic_unknown_is_that_of_its_visible_part():
    _, plain = theory(reacting(lp.Normal(0.4, 0.2)))
    twin, report = theory(
        reacting(lp.Scalar(lp.Normal(0.4, 0.2), evolution=lp.fem.Periodic(1.0, 2)))
    )
    assert report.constants.C_A > 0.99 * plain.constants.C_A
    (sheet,) = (table for table in report.tables if "Excitation" in table.title)
    assert {row[3] for row in sheet.rows} == {"a", "b"}
    assert any("constant parameter" in note for note in report.notes)
    q = twin.model.parameter_space.interpolate(twin.q_true)
    assert twin.error(q) == 0.0


@pytest.mark.slow
def test_the_theory_does_not_speak_of_models_nonlinear_in_what_is_estimated():
    _, report = theory(reacting(lp.LogNormal(0.4, 0.2)))
    assert report.constants is None
    assert any("not linear in what is estimated" in note for note in report.notes)


def starting(unknown: lp.fem.Unknown) -> lp.Model:
    return lp.Model(
        lp.Field(mesh, ElementLineP1()),
        {"u0": unknown},
        A=lambda q, u, v, x: 0.1 * u * v,
        initial=lambda q, v, x: q.u0 * v,
    )


def test_a_twin_starts_where_its_model_says():
    model, times = starting(lp.Normal(1.0, 1.0)), [0.0, 0.1, 0.2]
    twin = Twin(model=model, observation=lp.Points([0.3]), q_true={"u0": 5.0}, times=times)
    assert next(iter(twin)).z == pytest.approx([5.0])
    with pytest.raises(lp.errors.ConfigurationError, match="leave out u0"):
        Twin(model=model, observation=lp.Points([0.3]), q_true=5.0, times=times, u0=1.0)


def test_an_unknown_initial_state_is_not_for_the_gradient_law():
    with pytest.raises(lp.errors.LawError, match="which this law cannot learn: use SensitivityLaw"):
        lp.Identifier(starting(lp.Normal(1.0, 1.0)), lp.Full(), lp.GradientLaw())


@pytest.mark.slow
def test_the_preview_does_not_depend_on_what_is_measured(tmp_path: Path):
    path, _ = write_template(tmp_path)
    text = path.read_text()
    path.write_text(text.replace('bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]', 'transform = "log"'))
    prepared = cases.load(path).prepare()
    stream = list(prepared.stream)[:60]
    warmer = [
        replace(item, z={**item.z, "T_10": item.z["T_10"] + 0.3 * k})
        for k, item in enumerate(stream)
        if isinstance(item.z, dict)
    ]
    assert len(warmer) == len(stream)
    (row,) = preview(prepared, stream).unknowns
    (other,) = preview(prepared, warmer).unknowns
    assert other.posterior == pytest.approx(row.posterior, rel=1e-6)


@pytest.mark.slow
def test_the_preview_tells_of_the_end_and_of_errors_that_are_not_seen(
    tmp_path: Path, monkeypatch: Any
):
    monkeypatch.setattr("livepde.cases.preview.MOST_SAMPLES", 60)
    path, _ = write_template(tmp_path)
    settings = {
        "steps": {"scheme": "implicit-euler", "dt_max": "300 s"},
        "channels.T_10.noise": "0.001 K",
        "channels.T_30.noise": "0.001 K",
    }
    prepared = cases.load(path, settings=settings).prepare()
    stream = list(prepared.stream)
    assert len(stream) > 60
    found = preview(prepared, stream)
    assert found.samples == 60
    (first,), (last,) = found.unknowns, found.last
    assert last.name == first.name
    assert 0 < last.left < 1
    assert last.left != pytest.approx(first.left, rel=1e-3)
    assert any("Discretisation errors have shifted" in text for text in found.sentences)
    assert not preview(prepared, stream[:60]).last


@pytest.mark.slow
def test_a_run_finds_the_most_probable_parameter():
    left = lambda x, t: np.sin(3 * t) + 0 * x[0]  # noqa: E731
    state = lp.Field(mesh, ElementLineP1(), dirichlet={"left": left})
    model = lp.Model(
        state,
        {
            "a": lp.LogNormal(0.2, 0.15),
            "w": lp.LogNormal(0.5, 0.5),
            "off": lp.Scalars(("a", "b"), lp.Normal(0.0, 0.1)),
        },
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
        initial=lambda q, v, x: q.w * np.sin(np.pi * x[0]) * v,
    )
    law = lp.SensitivityLaw(shadows=None)
    identifier = lp.Identifier(model, sensors(), law, halvings=0)
    latent, forward, times = model.latent, ForwardStage(model), 0.02 * np.arange(64)

    def seen(a: Array) -> Array:
        u, rows = model.initial_state(a), []
        for k, t in enumerate(times):
            u = advanced(forward, u, a, t - 0.02, t) if k else u
            rows.append(identifier.observed.predict(u, latent.value(a), lp.fem.Moment(t)))
        return np.array(rows)

    truth = {"a": 0.1, "w": 1.6, "off": [0.05, -0.08]}
    rng, exact = np.random.default_rng(1), seen(model.initial_parameter(truth))
    data = exact + NOISE * rng.standard_normal(exact.shape)
    estimate = identifier.run(zip(times, data, strict=True)).last

    def residual(x: Array) -> Array:
        misfit = (data - seen(latent.prior + latent.deviations * x)) / NOISE
        return np.append(misfit.ravel(), x)

    found = least_squares(residual, np.zeros(latent.dim))
    best = latent.prior + latent.deviations * found.x
    root = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    std = root * latent.deviations * latent.slopes(best)
    factor = estimate.belief.q_factor
    assert factor is not None
    np.testing.assert_allclose(np.linalg.norm(factor, axis=1), std, rtol=0.05)
    assert np.abs(estimate.q - latent.value(best)).max() < 0.1 * std.min()


def test_the_excitation_of_a_transformed_unknown_is_that_at_the_estimate():
    model = lp.Model(
        lp.Field(mesh, ElementLineP1()), lp.LogNormal(2.0, 1.0), A=lambda q, u, v, x: q * u * v
    )
    full = observe(model, lp.Full())
    excitation = Excitation(Spaces(model, full), window=0.5)
    for q, slope in ((None, 2.0), (np.array([5.0]), 5.0)):
        state = excitation.init()
        for t in (0.0, 0.25, 0.5):
            state = excitation.add(state, t, np.full(7, 3.0), q=q)
        # 0.5 * 3 * dq/dtheta * deviation of theta, on an interval of length 1
        strength = excitation.spectrum(state).strength
        assert strength == pytest.approx([0.5 * 3.0 * slope * 0.5])


@pytest.mark.long
def test_what_sensors_see_is_linear_about_the_reference_as_the_state_is():
    """A logarithm that sensors see directly: the first samples overshot, and widened all."""
    model = lp.Model(
        lp.Field(mesh, ElementLineP1(), dirichlet={"left": lambda x, t: np.sin(t) + 0 * x[0]}),
        {"a": lp.Normal(0.3, 0.1), "c": lp.LogNormal(0.1, 0.05)},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
    )
    points = lp.Points({"z": 0.5}, noise=NOISE, direct={"z": lambda q, x: 20.0 * q.c})
    truth = {"a": 0.35, "c": 0.17}
    noise = AbsoluteNoise(NOISE)
    for seed in range(3):
        twin = Twin(
            model=model,
            observation=points,
            q_true=truth,
            u0=0.0,
            times=0.1 * np.arange(100),
            noise=noise,
            seed=seed,
            scheme=lp.SensitivityLaw.scheme,
        )
        law = lp.SensitivityLaw(shadows=None)
        identifier = lp.Identifier(model, points, law, u0=0.0)
        estimate = identifier.run(twin).last
        assert identifier._state.now.innovations.inflation < 1.3
        for name, (value, std) in estimate.parameters.items():
            assert abs(value - truth[name]) < 3.5 * std
