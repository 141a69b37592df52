"""Predicted shifts of estimates by step, mesh and input lines agree with actual shifts."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from factories import driven_rod, readings

import livepde as lp
from livepde.linalg.member_arrays import changed
from livepde.models import heat
from livepde.stepping import ImplicitEuler
from livepde.streams import AbsoluteNoise, Twin

NOISE, WIDTH, COUNT = 0.003, 0.1, 150
TRUE = {"k": 1.3, "h": 0.8}


def rod(cells: int, **k: Any) -> lp.Model:
    """Return a rod with unknown conductivity and loss, heated by a channel at its left end."""
    mesh = lp.interval(0.0, 1.0, cells)
    field = lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T"), "right": 0.0})
    unknowns = {"k": lp.Scalar(lp.Normal(1.0, std=0.3), **k), "h": lp.Normal(1.0, std=0.3)}
    return lp.Model(
        field,
        unknowns,
        A=lambda q, u, v, x: 0.1 * q.k * lp.dot(lp.grad(u), lp.grad(v)) + 0.3 * q.h * u * v,
    )


SENSORS = lp.Points({"a": 0.3, "b": 0.6}, noise=NOISE)


@cache
def exact(width: float = WIDTH) -> np.ndarray[Any, Any]:
    """Return what the sensors show of the exact state at the samples, (samples, 2)."""
    model, times = rod(160), width * np.arange(round(COUNT * WIDTH / width) + 1)
    twin = Twin(
        model=model,
        observation=SENSORS,
        q_true=TRUE,
        u0=0.0,
        times=times,
        truth="fine",
        fine=model,
        fine_dt=0.005,
        inputs=lambda t: {"T": float(np.sin(t))},
    )
    return np.array(twin.exact_data)


def samples(seed: int = 0, width: float = WIDTH) -> list[tuple[float, Any, dict[str, float]]]:
    z = exact(width)
    noise = NOISE * np.random.default_rng(seed).standard_normal(z.shape)
    rows = enumerate(z + noise)
    return [(width * k, row, {"T": float(np.sin(width * k))}) for k, row in rows]


def identifier(cells: int = 160, law: Any = None, **k: Any) -> lp.Identifier:
    return lp.Identifier(rod(cells), SENSORS, law or lp.SensitivityLaw(), u0=0.0, **k)


def ran(given: lp.Identifier, rows: Any) -> Any:
    for t, z, inputs in rows:
        estimate = given.step(t, z, inputs)
    return estimate


def shifts(estimate: Any, kind: str) -> np.ndarray[Any, Any]:
    return np.array([estimate.diagnostics.shifts.by(kind)[name] for name in ("k", "h")])


def assert_predicts(predicted: Any, actual: Any, std: Any, band: float) -> None:
    """Assert that shifts agree to a share of the largest of them, counted in deviations."""
    predicted, actual = predicted / std, actual / std
    assert np.abs(predicted - actual).max() < band * np.abs(actual).max(), (predicted, actual)


PLAIN = lp.SensitivityLaw(shadows=None)
# The error that a stated step makes: steps are not divided.
STATED = lp.SensitivityLaw(shadows=lp.laws.Shadows(parts=1))


@cache
def reference(width: float = WIDTH) -> Any:
    """Return the estimate on a fine mesh with short steps."""
    return ran(identifier(law=PLAIN, dt_max=WIDTH / 8), samples(width=width))


@pytest.mark.slow
def test_predicts_the_shift_by_the_step() -> None:
    estimate = ran(identifier(law=STATED, scheme=ImplicitEuler()), samples())
    actual = estimate.q - reference().q
    assert np.abs(actual / reference().q_std).max() > 8.0
    assert_predicts(shifts(estimate, "step"), actual, reference().q_std, 0.2)


@pytest.mark.long
def test_predicts_the_shift_by_steps_across_jumps() -> None:
    """A heater that goes on and off: the jumps are shadowed, and each counts once."""
    mesh = lp.interval(0.0, 0.4, 20)
    model = heat(
        mesh,
        alpha=lp.LogNormal(5e-5, 3e-5),
        dirichlet={"left": lambda x, t: 20.0 + 30.0 * (t % 3600.0 < 600.0)},
    )
    sensors = lp.Points([0.1, 0.2], noise=0.05)
    times = np.arange(0.0, 7200.0, 60.0)
    truth = Twin(
        model=model,
        observation=sensors,
        q_true={"alpha": 9.7e-5},
        u0=20.0,
        times=times,
        dt_max=2.0,
        noise=AbsoluteNoise(0.05),
    )
    rows, ends = list(truth), []
    for width in (30.0, 2.0):
        given = lp.Identifier(model, sensors, STATED, u0=20.0, dt_max=width)
        ends.append([given.step(sample.t, sample.z) for sample in rows][-1])
    coarse, fine = ends
    (label,) = coarse.parameters
    predicted, actual = coarse.diagnostics.shifts.by("step")[label], (coarse.q - fine.q)[0]
    assert abs(actual) > 2.0 * fine.q_std[0]
    assert predicted == pytest.approx(actual, rel=0.4)


@pytest.mark.slow
def test_the_shift_of_an_unknown_that_hardly_moves_is_that_of_a_constant_one() -> None:
    """Richardson's two steps halve that of an unknown that moves as well, and do not quarter it."""
    found = []
    for k in ({}, {"evolution": lp.RandomWalk(1e-9)}):
        given = lp.Identifier(rod(10, **k), SENSORS, STATED, u0=0.0)
        found.append(shifts(ran(given, samples()[:60]), "step"))
    np.testing.assert_allclose(found[1], found[0], rtol=0.05)


@pytest.mark.slow
def test_the_second_order_scheme_is_shifted_little() -> None:
    given = identifier(law=STATED)
    estimate = given._settled(
        ran(given, samples())
    )  # else the last refit leaves as much to a later one
    actual = estimate.q - reference().q
    assert_predicts(shifts(estimate, "step"), actual, reference().q_std, 0.4)
    assert np.abs(actual / reference().q_std).max() < 1.0


@pytest.mark.long
@pytest.mark.parametrize("cells", [5, 10])
def test_predicts_the_shift_by_the_mesh(cells: int) -> None:
    estimate = ran(identifier(cells, dt_max=WIDTH / 8), samples())
    actual = estimate.q - reference().q
    assert np.abs(actual / reference().q_std).max() > 2.0
    assert_predicts(shifts(estimate, "mesh"), actual, reference().q_std, 0.75)


@pytest.mark.slow
@pytest.mark.long
def test_follows_a_drive_that_turns_between_two_shadows_of_the_mesh() -> None:
    """A mesh shift of nearly nothing is not found large where eight samples see half a turn."""

    def left(t: float) -> float:
        return float(np.sin(3.0 * t))

    points, times = lp.Points([0.25, 0.5, 0.75], noise=0.01), 0.05 * np.arange(401)
    unknown, ends = {"a": lp.Normal(0.2, std=0.2)}, {}
    models = {n: driven_rod(unknown, left, lp.interval(0.0, 1.0, n)) for n in (16, 64)}
    rows = readings(models[16], points, lambda t: 0.3, times, 0.01, 0)
    for cells, model in models.items():
        given = lp.Identifier(model, points, lp.SensitivityLaw(), u0=0.0)
        ends[cells] = [given.step(t, z) for t, z in rows][-1]
    coarse, fine = ends[16], ends[64]
    assert abs(coarse.q - fine.q)[0] < 0.01 * fine.q_std[0]
    assert abs(coarse.diagnostics.shifts.by("mesh")["a"]) < 0.1 * fine.q_std[0]


@pytest.mark.long
def test_predicts_the_shift_by_input_lines() -> None:
    """Against a run that is told the inputs ten times for each reading of the sensors."""
    rows = samples()
    estimate = ran(identifier(dt_max=WIDTH / 8), rows)
    told = identifier(law=PLAIN)
    for (t, z, inputs), k in zip(rows, range(len(rows)), strict=True):
        for part in range(1, 10) if k else ():
            s = t - WIDTH + WIDTH * part / 10
            told.step(s, [np.nan, np.nan], {"T": float(np.sin(s))})
        better = told.step(t, z, inputs)
    actual = estimate.q - better.q
    assert np.abs(actual / better.q_std).max() > 0.5
    assert_predicts(shifts(estimate, "input"), actual, better.q_std, 0.5)


@pytest.mark.long
@pytest.mark.parametrize("evolution", [None, lp.RandomWalk(0.01)])
def test_no_number_of_the_filter_moves(evolution: Any) -> None:
    found = []
    for law in (STATED, PLAIN):
        more = {} if evolution is None else {"evolution": evolution}
        given = lp.Identifier(rod(10, **more), SENSORS, law, u0=0.0)
        found.append((ran(given, samples()[:60]), given._state.now))
    (one, x), (other, y) = found
    np.testing.assert_array_equal(one.q, other.q)
    np.testing.assert_array_equal(one.u, other.u)
    for part in ("U", "C", "du", "da", "evidence"):
        np.testing.assert_array_equal(getattr(x, part), getattr(y, part))
    assert (one.q_std >= other.q_std).all()


@pytest.mark.study
def test_intervals_hold_on_a_coarse_mesh() -> None:
    """The plain 95 % intervals miss a constant in most runs on five cells; these hold it."""
    held, plain = [], []
    for seed in range(12):
        rows = samples(seed)[:100]
        for law, into in ((lp.SensitivityLaw(), held), (PLAIN, plain)):
            low, high = ran(identifier(5, law), rows)["k"].interval()
            into.append(low <= TRUE["k"] <= high)
    assert np.mean(plain) < 0.5
    assert np.mean(held) >= 0.9


@pytest.mark.long
def test_where_nothing_is_wrong_intervals_grow_little() -> None:
    rows = samples(width=WIDTH / 2)
    widened = ran(identifier(), rows)
    plain = ran(identifier(law=PLAIN), rows)
    assert (widened.q_std / plain.q_std < 1.1).all()
    assert widened.diagnostics.shifts.largest < 2.0


@pytest.mark.long
def test_no_interval_is_much_wider_than_that_of_the_prior() -> None:
    """Two samples far apart on a mesh of two cells: whatever the shifts, the prior bounds them."""
    given = identifier(2, scheme=ImplicitEuler())
    estimate = ran(given, [(t, [0.1, 0.05], {"T": 50.0 * t}) for t in (0.0, 3.0, 6.0)])
    assert (estimate.q_std <= 1.5 * 0.3).all()


@pytest.mark.long
def test_a_refit_keeps_shadows_or_takes_them_again() -> None:
    """About a reference that stays, shifts are those of the plain filter."""
    law = lp.SensitivityLaw(refit=None)
    plain = ran(identifier(8, law, scheme=ImplicitEuler()), samples())
    fitted = identifier(8, scheme=ImplicitEuler())
    ran(fitted, samples())
    refitted = fitted.refit()
    for kind in ("step", "mesh"):
        one, other = shifts(plain, kind), shifts(refitted, kind)
        assert np.abs(one - other).max() < 0.3 * np.abs(one).max()


@pytest.mark.long
def test_a_field_is_prolonged() -> None:
    mesh = lp.interval(0.0, 1.0, 8)
    line = lp.linear(mesh)
    model = lp.Model(
        lp.Field(mesh, line, dirichlet={"left": lp.Channel("T"), "right": 0.0}),
        lp.Field(mesh, line, inner="H1", prior=lp.Normal(1.0, std=0.1)),
        A=lambda q, u, v, x: 0.1 * q * lp.dot(lp.grad(u), lp.grad(v)),
    )
    law = lp.SensitivityLaw(modes=4)
    given = lp.Identifier(model, SENSORS, law, u0=0.0)
    estimate = ran(given, samples()[:60])
    assert np.isnan(estimate.diagnostics.mesh_unfollowed)
    assert abs(estimate.diagnostics.shifts.sizes["mesh"]) > 0.0


@pytest.mark.long
def test_says_where_the_mesh_is_not_followed() -> None:
    mesh = lp.interval(0.0, 1.0, 8)
    model = lp.Model(
        lp.Field(mesh, lp.fem.quadratic(mesh), dirichlet={"left": lp.Channel("T"), "right": 0.0}),
        lp.Normal(1.0, std=0.3),
        A=lambda q, u, v, x: 0.1 * q * lp.dot(lp.grad(u), lp.grad(v)),
    )
    given = lp.Identifier(model, SENSORS, lp.SensitivityLaw(), u0=0.0)
    assert ran(given, samples()[:10]).diagnostics.mesh_unfollowed == 1.0
    few = lp.SensitivityLaw(shadows=lp.laws.Shadows(largest=10))
    assert ran(identifier(8, few), samples()[:10]).diagnostics.mesh_unfollowed == 1.0
    for law, why in (
        (few, "more than `largest` = 10 of the shadows"),
        (lp.SensitivityLaw(shadows=lp.laws.Shadows(mesh=False)), "(mesh = false)"),
        (PLAIN, "shadows = None"),
    ):
        verdict = ran(identifier(8, law), samples()[:30]).verdict
        (told,) = verdict.untested
        assert why in told
        assert any(told in finding.text for finding in verdict.findings)
    for sensors in (lp.Subdomain(lambda x: x[0] > 0.3, noise=NOISE), lp.Full(noise=NOISE)):
        whole = lp.Identifier(rod(8), sensors, lp.SensitivityLaw(), u0=0.0)
        for t, _, inputs in samples()[:25]:
            estimate = whole.step(t, np.zeros(whole.observed.size), inputs)
        assert "coefficients of the given mesh" in estimate.verdict.untested[0]
        assert "more cells" in estimate.verdict.untested[0]
    assert not ran(identifier(8), samples()[:30]).verdict.untested


def test_a_shadow_that_is_not_finite_begins_anew() -> None:
    """Neither gate nor verdict take its part, and no number of the filter moves."""
    law = lp.SensitivityLaw(refit=None)
    spoiled, whole = identifier(8, law), identifier(8, law)
    ran(spoiled, samples()[:15]), ran(whole, samples()[:15])
    now = spoiled._state.now
    wrong = changed(now.shadows, u=np.full_like(now.shadows.u, np.nan))
    spoiled._state = changed(spoiled._state, now=changed(now, shadows=wrong))
    found, expected = ran(spoiled, samples()[15:60]), ran(whole, samples()[15:60])
    assert found.q.tolist() == expected.q.tolist()
    assert found.diagnostics.shadow_failed == 3.0
    assert found.diagnostics.refused == expected.diagnostics.refused == 0.0
    assert set(found.diagnostics.shifts.sizes) == {"step", "mesh", "input"}
    told = [[item.what for item in one.verdict.findings] for one in (found, expected)]
    assert told[0] == told[1]
    assert np.isfinite(spoiled._state.now.ledger.sums).all()


@pytest.mark.slow
def test_a_mesh_whose_initial_state_is_not_finite_is_followed_later() -> None:
    """A function that fails at a single point of the halved mesh; its stages keep factors."""
    mesh, spoiled = lp.rectangle((0.0, 1.0), (0.0, 1.0), (24, 24)), []

    def initial(x: Any) -> Any:
        u = np.sin(np.pi * x[0]) * np.sin(np.pi * x[1])
        if x.shape[1] == 4 * mesh.nelements:
            spoiled.append(x)
            u.flat[99] = np.nan
        return u

    model = heat(mesh, lp.Normal(0.05, 0.03), {"boundary": 0.0})
    sensors, law = lp.Points([[0.3, 0.4], [0.7, 0.6]], noise=0.05), lp.SensitivityLaw(verdict=False)
    given = lp.Identifier(model, sensors, law, u0=initial)
    estimates = [given.step(0.05 * k, [0.8 * np.exp(-0.06 * k)] * 2) for k in range(1, 20)]
    assert len(spoiled) == 1
    assert estimates[2].diagnostics.shifts.sizes["mesh"] != 0.0
    assert estimates[1].diagnostics.shadow_failed == estimates[-1].diagnostics.shadow_failed > 0.0


def test_refuses_shadows_of_nothing() -> None:
    with pytest.raises(lp.errors.LawError, match="Shadows: none is left"):
        lp.laws.Shadows(step=False, mesh=False, inputs=False)
    with pytest.raises(lp.errors.LawError, match="shadows must be a Shadows"):
        lp.SensitivityLaw(shadows=True)  # type: ignore[arg-type]
    with pytest.raises(lp.errors.LawError, match="largest must be at least 1"):
        lp.laws.Shadows(largest=0)
