"""The refit agrees with a SciPy fit of the stored samples on an independent forward model."""

import copy
import math
import threading
from functools import cache
from typing import Any

import broken_rod
import numpy as np
import pandas as pd
import pytest
from scipy.linalg import solve_banded
from scipy.optimize import least_squares
from scipy.special import erfc, erfcx

import livepde as lp
from livepde import cases
from livepde.laws import refit as refit_module
from livepde.laws.gate import near_neighbours
from livepde.laws.refit import refitted
from livepde.laws.stored_samples import StoredSamples
from livepde.models import heat

V, D, AT, NOISE = 0.258, 0.0357, 11.0, 0.01
TIMES = np.arange(1.5, 66.1, 1.5)


def breakthrough(v: float, d: float, times: Any = TIMES) -> np.ndarray:
    """Return the concentration of a column washed out from 1 to 0 (Ogata and Banks)."""
    t, spread = np.asarray(times), 2.0 * np.sqrt(d * np.asarray(times))
    ahead, behind = (AT - v * t) / spread, (AT + v * t) / spread
    # exp(v x/D) erfc(behind) without overflow: the squares differ by v x/D.
    return 1.0 - 0.5 * (erfc(ahead) + np.exp(-(ahead**2)) * erfcx(behind))


@cache
def measured(seed: int = 0) -> tuple[float, ...]:
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(TIMES))
    return tuple((breakthrough(V, D) + noise).tolist())


def column(prior: tuple[float, float, float, float], **options: Any) -> lp.Identifier:
    """Return an identifier of the column with prior means and standard deviations of v and D."""
    v, v_std, d, d_std = prior
    mesh = lp.interval(0.0, 16.0, 40)
    model = lp.Model(
        lp.Field(mesh, lp.fem.quadratic(mesh), dirichlet={"left": 0.0}),
        {"v": lp.LogNormal(v, std=v_std), "D": lp.LogNormal(d, std=d_std)},
        A=lambda q, u, v, x: q.D * lp.dot(lp.grad(u), lp.grad(v)) + q.v * lp.grad(u)[0] * v,
    )
    law = lp.SensitivityLaw(**{"refit": lp.laws.Refit(), "shadows": None, **options})
    return lp.Identifier(model, lp.Points({"c": AT}, noise=NOISE), law, u0=1.0, dt_max=0.5)


def stream(z: Any = None) -> list[tuple[float, dict[str, float]]]:
    values = measured() if z is None else z
    return [(t, {"c": value}) for t, value in zip(TIMES.tolist(), values, strict=True)]


@cache
def best(prior: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Return v, D and the cost of SciPy's fit from the truth, by the analytic solution."""
    v, v_std, d, d_std = prior
    middle, widths = np.log([v, d]), np.array([v_std / v, d_std / d])

    def residuals(a: np.ndarray) -> np.ndarray:
        q = np.exp(middle + widths * a)
        return np.concatenate([(np.array(measured()) - breakthrough(*q)) / NOISE, a])

    found = least_squares(residuals, (np.log([V, D]) - middle) / widths, method="lm")
    q = np.exp(middle + widths * found.x)
    return float(q[0]), float(q[1]), float(found.cost)


PRIORS = {
    "near": (0.3, 0.1, 0.05, 0.05),
    "far above": (0.7, 0.5, 0.1, 0.1),
    "far below": (0.1, 0.1, 0.01, 0.01),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PRIORS)
def test_the_column_is_found_from_each_prior(name: str):
    result = column(PRIORS[name]).run(stream())
    v, d, cost = best(PRIORS[name])
    fit = result.last.fit
    assert fit.converged
    assert fit.samples == len(TIMES)
    assert result.last.parameters["v"][0] == pytest.approx(v, rel=2e-3)
    assert result.last.parameters["D"][0] == pytest.approx(d, rel=3e-2)  # error of the mesh
    assert fit.cost == pytest.approx(cost, abs=1.5)
    assert fit.passes < 20


@pytest.mark.slow
def test_beyond_a_bound_the_other_unknowns_are_those_of_the_best_fit_within():
    """At v = 0.28 the best D differs from the D of the unbounded best v, 0.258."""
    low, middle, width = 0.28, math.log(0.05), 1.0
    v = lp.Scalar(lp.Normal(0.35, std=0.1, bounds=(low, 1.0)))
    z = measured()

    def residuals(a: np.ndarray) -> np.ndarray:
        v, d = a[0], math.exp(middle + width * a[1])
        prior = [(v - 0.35) / 0.1, a[1]]
        return np.concatenate([(np.array(z) - breakthrough(v, d)) / NOISE, prior])

    best = least_squares(residuals, [0.3, 0.0], bounds=([low, -10.0], [1.0, 10.0])).x
    free = least_squares(residuals, [0.3, 0.0]).x
    mesh = lp.interval(0.0, 16.0, 40)
    model = lp.Model(
        lp.Field(mesh, lp.fem.quadratic(mesh), dirichlet={"left": 0.0}),
        {"v": v, "D": lp.LogNormal(0.05, std=0.05)},
        A=lambda q, u, v, x: q.D * lp.dot(lp.grad(u), lp.grad(v)) + q.v * lp.grad(u)[0] * v,
    )
    law = lp.SensitivityLaw(shadows=None)
    who = lp.Identifier(model, lp.Points({"c": AT}, noise=NOISE), law, u0=1.0, dt_max=0.5)
    last = who.run(stream()).last
    found = float(np.log(last["D"].median) - middle) / width
    assert last["v"].mean == pytest.approx(low, abs=1e-9)
    assert found == pytest.approx(best[1], abs=0.15 * abs(best[1] - free[1]))
    assert abs(best[1] - free[1]) > 0.1


def fitted(identifier: lp.Identifier) -> tuple[StoredSamples, Any]:
    samples = StoredSamples.of(identifier._work, identifier._state)
    return samples, refitted(samples, lp.laws.Refit(), last=True)


def test_the_filter_goes_on_from_the_fit():
    """About one trajectory, one update by all samples equals the filter sample by sample."""
    who = column(PRIORS["near"])
    for t, z in stream():
        who.step(t, z)
    samples, found = fitted(who)
    one, other = (samples.updated(found.best, found.used), samples.judged(found.best, found.used))
    std = np.linalg.norm(other.C[0], axis=0)
    assert np.abs(one.q - other.q).max() < 1e-12
    assert (np.abs(one.da - other.da)[0] / std).max() < 1e-8
    assert np.abs(one.C[0].T @ one.C[0] - other.C[0].T @ other.C[0]).max() < 1e-9 * std.max() ** 2
    assert np.abs(one.u + one.du - other.u - other.du).max() < 1e-9


@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_few_samples_are_fitted(count: int):
    late = stream()[22 : 22 + count]  # while the front passes
    result = column(PRIORS["far above"]).run(late)
    assert result.last.fit.converged
    predicted = breakthrough(*(result.last.parameters[name][0] for name in ("v", "D")))
    missed = (np.array(measured()) - predicted)[22 : 22 + count] / NOISE
    assert np.sqrt(np.mean(missed**2)) < 3.0


@pytest.mark.slow
def test_outliers_are_left_out():
    rng = np.random.default_rng(4)
    z = np.array(measured())
    wild = rng.choice(len(z), len(z) // 5, replace=False)
    z[wild] += rng.choice([-1.0, 1.0], len(wild)) * NOISE * rng.uniform(10.0, 100.0, len(wild))
    clean, spoiled = (column(PRIORS["near"]).run(stream(data)).last for data in (None, z.tolist()))
    for name in ("v", "D"):
        value, std = clean.parameters[name]
        assert abs(spoiled.parameters[name][0] - value) < std
    assert len(wild) // 2 <= spoiled.fit.refused <= len(wild) + 4


def test_wild_readings_in_a_row_are_told_from_those_beside_them():
    """At both ends of the sequence, the median of the neighbours is itself an outlier."""
    rng = np.random.default_rng(3)
    values = rng.standard_normal((40, 1))
    values[6:10, 0] += [-17.0, -98.0, -73.0, -22.0]
    wild = np.zeros((40, 1), dtype=bool)
    wild[6:10] = True
    assert (near_neighbours(values, 4.0) == ~wild).all()
    # A lasting step is not a sequence of outliers.
    values = rng.standard_normal((40, 1))
    values[20:] += 50.0
    assert near_neighbours(values, 4.0)[[*range(17), *range(23, 40)]].all()


def test_a_refit_on_demand_is_that_of_the_end():
    rows = stream()
    end = column(PRIORS["near"]).run(rows).last
    who = column(PRIORS["near"])
    for t, z in rows:
        who.step(t, z)
    found = who.refit()
    assert found.parameters == end.parameters
    assert found.fit == end.fit


def rod(**options: Any) -> lp.Identifier:
    mesh = lp.interval(0.0, broken_rod.LENGTH, 16)
    ends = {"left": lp.Channel("T_left"), "right": 20.0}
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet=ends),
        {"alpha": lp.LogNormal(5e-5, std=3e-5)},
        A=lambda q, u, v, x: q.alpha * lp.dot(lp.grad(u), lp.grad(v)),
    )
    names = {f"T_{k + 1}": x for k, x in enumerate(broken_rod.AT)}
    law = lp.SensitivityLaw(refit=lp.laws.Refit(), **options)
    return lp.Identifier(model, lp.Points(names, noise=broken_rod.NOISE), law, u0=20.0)


def rows(z: np.ndarray) -> list[tuple[float, dict[str, float]]]:
    times = broken_rod.STEP * np.arange(len(z))
    table = np.column_stack([broken_rod.left(times), z])
    names = ("T_left", "T_1", "T_2", "T_3")
    return [
        (t, dict(zip(names, row, strict=True)))
        for t, row in zip(times.tolist(), table.tolist(), strict=True)
    ]


@pytest.mark.slow
def test_a_sensor_that_was_set_aside_is_not_fitted():
    z = broken_rod.readings(130)
    whole = rod().run(rows(z)).last["alpha"]
    z[80:115, 1] = -127.0  # unplugged
    last = rod().run(rows(z)).last
    assert last.fit.converged
    value, std = last.parameters["alpha"]
    assert abs(value - whole.median) < 2.0 * whole.deviation
    assert std < 1.3 * whole.deviation
    assert abs(value - broken_rod.ALPHA) < 4.0 * std


@pytest.mark.long
def test_a_reading_whose_place_is_missing_is_not_fitted():
    model = heat(lp.interval(0.0, 1.0, 12), lp.Normal(0.2, 0.1), {"left": 1.0, "right": 0.0})
    probe = lp.observation.Moving({"probe": "x_p"}, noise=0.01)
    missing, never = (lp.Identifier(model, probe, lp.SensitivityLaw(), u0=0.0) for _ in range(2))
    for k in range(1, 12):
        z, place = 0.5 + 0.01 * (k % 3), {"x_p": 0.3 + 0.02 * k}
        lost = {"x_p": math.nan} if k == 5 else place
        one = missing.step(0.1 * k, {"probe": z}, lost)
        other = never.step(0.1 * k, {"probe": math.nan if k == 5 else z}, place)
    one, other = missing._settled(one), never._settled(other)
    assert one.fit.cost == pytest.approx(other.fit.cost)
    (_, std) = one.parameters["alpha"]
    assert one.q == pytest.approx(other.q, abs=1e-3 * std)  # a search ends within 0.03


@pytest.mark.slow
def test_a_fit_that_leaves_out_many_readings_says_so():
    """It also reports them if its filter refused none of them."""
    z, wild = np.array(measured()), np.arange(len(TIMES)) % 6 == 3
    who = column((0.3, 0.1, 0.05, 0.03))
    last = who.run(stream((z + np.where(wild, 0.3, 0.0)).tolist())).last
    assert (last.fit.readings, last.fit.refused) == (len(TIMES), wild.sum())
    (said,) = [one for one in last.verdict.findings if one.what == "fit"]
    assert said.severity == "caution"
    assert "excluded" in said.text
    clean = column((0.3, 0.1, 0.05, 0.03)).run(stream()).last
    assert not [one for one in clean.verdict.findings if one.what == "fit"]


# --- refits in a separate thread ----------------------------------------------------------------


def rod_samples(seed: int = 0, count: int = 160) -> list[tuple[float, dict[str, float]]]:
    """Return readings of a rod with insulated ends, from the series of its exact solution."""
    rng, times = np.random.default_rng(seed), np.linspace(0.02, 4.0, count)
    exact = {name: np.cos(np.pi * x) * np.exp(-0.23 * np.pi**2 * times) for name, x in PLACES}
    noisy = {name: 20.0 * u + 0.05 * rng.standard_normal(count) for name, u in exact.items()}
    return [(t, {name: float(z[k]) for name, z in noisy.items()}) for k, t in enumerate(times)]


PLACES = (("a", 0.3), ("b", 0.6))


def insulated(**options: Any) -> lp.Identifier:
    model = heat(lp.interval(0.0, 1.0, 20), lp.LogNormal(0.1, std=0.07))
    sensors = lp.Points(dict(PLACES), noise=0.05)
    law = lp.SensitivityLaw(refit=lp.Refit(**options))
    return lp.Identifier(model, sensors, law, u0=lambda x: 20.0 * np.cos(np.pi * x[0]))


def numbers_of(identifier: lp.Identifier, items: Any) -> np.ndarray:
    found = []
    for t, z in items:
        estimate = identifier.step(t, z)
        found.append([estimate.belief.q[0], estimate.belief.q_std[0]])
    return np.array(found)


@cache
def undisturbed() -> tuple[lp.Identifier, np.ndarray]:
    """Return an identifier after all samples with background refits, and its numbers."""
    apart = insulated(apart=True)
    return apart, numbers_of(apart, rod_samples())


@pytest.mark.slow
def test_a_refit_apart_goes_on_from_where_one_at_once_would():
    at_once, (apart, beside) = insulated(), undisturbed()
    direct = numbers_of(at_once, rod_samples())
    assert np.array_equal(beside[:127], direct[:127])
    # The fit of 128 samples is used from sample 144 on, and the 16 since are taken by sample 151.
    assert not np.array_equal(beside[128:150], direct[128:150])
    # From the same fit on, both have taken the same samples: the noise of rounding,
    # and that of fits that end within a tenth of a standard deviation.
    assert np.abs(beside[152:, 0] - direct[152:, 0]).max() < 0.1 * direct[100, 1]
    assert apart.refit().belief.q[0] == pytest.approx(
        at_once.refit().belief.q[0], abs=0.05 * direct[-1, 1]
    )


@pytest.mark.slow
def test_a_refit_apart_survives_restarts_and_copies():
    samples, (_, whole), first = rod_samples(), undisturbed(), insulated(apart=True)
    for at, sample in enumerate(samples):
        if at in (130, 143, 147, 150):
            restored, twin = insulated(apart=True), copy.deepcopy(first)
            restored.restore(first.dump())
            for one in (restored, twin):
                assert np.array_equal(numbers_of(one, samples[at:]), whole[at:])
        assert np.array_equal(numbers_of(first, [sample])[0], whole[at])


def apart_only(monkeypatch: pytest.MonkeyPatch, before: Any) -> None:
    """Call a function before each refit in another thread."""
    fit, here = refit_module.refitted_now, threading.get_ident()

    def fitted(*given: Any) -> Any:
        if threading.get_ident() != here:
            before()
        return fit(*given)

    monkeypatch.setattr(refit_module, "refitted_now", fitted)


def test_samples_go_on_while_a_refit_is_under_way(monkeypatch: pytest.MonkeyPatch):
    """A fit that has not ended holds no sample up before it is due."""
    ends = threading.Event()

    def slowly() -> None:
        assert ends.wait(60.0)

    apart_only(monkeypatch, slowly)
    identifier, samples = insulated(apart=True), rod_samples()
    numbers_of(identifier, samples[:143])  # that of 128 samples is due with sample 144
    ends.set()
    numbers_of(identifier, samples[143:])


@pytest.mark.slow
def test_an_error_in_a_refit_apart_reaches_who_steps(monkeypatch: pytest.MonkeyPatch):
    def broken() -> None:
        raise ValueError("of a form")

    apart_only(monkeypatch, broken)
    with pytest.raises(ValueError, match="of a form"):
        numbers_of(insulated(apart=True), rod_samples())


@pytest.mark.slow
def test_numbers_that_end_a_refit_apart_end_no_run(monkeypatch: pytest.MonkeyPatch):
    def singular() -> None:
        raise np.linalg.LinAlgError("singular")

    apart_only(monkeypatch, singular)
    identifier = insulated(apart=True)
    for t, z in rod_samples():
        estimate = identifier.step(t, z)
        assert estimate.status.ok
    assert estimate.fit.samples == 128
    assert not estimate.fit.converged
    assert estimate.verdict.level == "do not trust"


@pytest.mark.slow
def test_readings_withdrawn_while_a_refit_is_under_way_are_not_in_it():
    """A sensor that is set aside meanwhile brings no reading, from its first misfit on."""
    samples = rod_samples()
    broken = [
        (t, {**z, "b": z["b"] + (3.0 if k >= 60 else 0.0)}) for k, (t, z) in enumerate(samples)
    ]
    identifier = insulated(apart=True)
    numbers = numbers_of(identifier, broken)
    assert abs(numbers[-1, 0] - 0.23) < 5.0 * numbers[-1, 1]


WALL = """
equation = "conduction"
initial = "interpolate"
mesh = { from = 0, to = "36 cm", cells = 20 }
data = { file = "wall.csv", time = "t", time_unit = "s" }
law = { shadows = false, verdict = false }
unknowns.k = { prior = "0.8 W/m/K", std = "0.4 W/(m K)", transform = "log" }
unknowns.C = { prior = "1.6e6 J/(m3 K)", std = "5e5 J/(m3 K)", transform = "log" }
channels.a = { role = "boundary", column = "a", at = "left" }
channels.b = { role = "boundary", column = "b", at = "right" }
channels.q = { role = "sensor", column = "q", at = "left", quantity = "flux", noise = "2 W/m2" }
"""


def wall(count: int) -> dict[str, Any]:
    """Return temperatures at both faces of a wall and the flux into it: finite volumes."""
    k, C, length, cells, h = 0.62, 1.45e6, 0.36, 72, 600.0
    width, day = length / cells, 2 * np.pi / 86400.0
    share = k * (h / 2) / (C * width**2)
    bands = np.zeros((3, cells))
    bands[0, 1:] = bands[2, :-1] = -share
    bands[1] = 1.0 + 2.0 * share
    bands[1, [0, -1]] += share

    def faces(t: Any) -> Any:
        return np.array(
            [
                20.0 + 0.8 * np.sin(day * t) + 0.6 * np.sin(day * t / 3.3),
                6.0 + 5.0 * np.sin(day * t - 2.0) + 3.0 * np.sin(day * t / 4.1),
            ]
        )

    u, t = 20.0 - 14.0 * (np.arange(cells) + 0.5) / cells, h * np.arange(count)
    flux = np.zeros(count)
    for step in range(2 * count - 1):
        if step:
            u[[0, -1]] += 2.0 * share * faces(step * h / 2)
            u = solve_banded((1, 1), bands, u)
        if step % 2 == 0:
            flux[step // 2] = 2.0 * k * (faces(step * h / 2)[0] - u[0]) / width
    rng = np.random.default_rng(1)
    a, b = faces(t) + 0.03 * rng.standard_normal((2, count))
    return {"t": t, "a": a, "b": b, "q": flux + 0.3 * rng.standard_normal(count)}


@pytest.mark.long
def test_a_fit_far_from_its_prior_is_not_the_end_of_the_search(tmp_path):
    """A wall with an uncertain start: the fit ended at k = 0.1 and six times the heat capacity.

    The residuals there are half as large again as the noise, which alone did not begin a search.
    """
    (tmp_path / "case.toml").write_text(WALL)
    pd.DataFrame(wall(360)).round(2).to_csv(tmp_path / "wall.csv", index=False)
    prepared = cases.load(tmp_path / "case.toml").prepare()
    last = prepared.identifier.run(prepared.stream).last
    assert last.parameters["k"][0] == pytest.approx(0.62, rel=0.03)
    assert last.parameters["C"][0] == pytest.approx(1.45e6, rel=0.05)
    assert last.fit.converged
    assert last.fit.cost < 90.0  # 118 at the wrong end
