"""Intervals that allow for model errors, and verdict levels that follow from fit and effect."""

import json
import math
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
import scipy

import livepde as lp
from livepde.laws.error_columns import SMALL, ErrorColumns
from livepde.laws.model_errors import linear_model, model_errors
from livepde.laws.stored_samples import StoredSamples
from livepde.streams import AbsoluteNoise, Twin
from livepde.verdict import Allowed, Cause, Finding, ModelErrors, Shifts, Verdict, discretised
from livepde.verdict.evidence import NU, TEMPER, Causes, Family, LinearModel, Mixture, averaged


def test_harmonics_of_an_unknown_do_not_shift_other_unknowns():
    """An unknown with harmonics has more coefficients than numbers, at any position."""
    mesh, times = lp.interval(0.0, 1.0, 20), np.arange(0.0, 12.01, 0.1)
    unknowns = {
        "s": lp.Scalar(lp.Normal(0.0, 1.0), evolution=lp.fem.Periodic(5.0)),
        "k": lp.LogNormal(0.1, 0.05),
    }
    found = []
    for names in (("s", "k"), ("k", "s")):
        model = lp.Model(
            lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T"), "right": 0.0}),
            {name: unknowns[name] for name in names},
            A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) - q.s * v,
        )
        sensors = lp.Points({"a": 0.3, "b": 0.6}, noise=0.01)
        truth = {"q_true": {"s": 0.5, "k": 0.08}, "u0": 0.0, "inputs": lambda t: {"T": np.sin(t)}}
        twin = Twin(
            model=model, observation=sensors, times=times, noise=AbsoluteNoise(0.01), **truth
        )
        errors = lp.Identifier(model, sensors, u0=0.0).run(twin).verdict.errors
        found.append({one.label: (one.value, one.low, one.high) for one in errors.unknowns})
    for name, numbers in found[0].items():
        assert numbers == pytest.approx(found[1][name], rel=1e-6)
    assert found[0]["k"][1] < 0.08 < found[0]["k"][2]


# --- the average --------------------------------------------------------------------------------


def dense(model: LinearModel, tried: list[tuple[Any, Any]]) -> tuple[Any, Any, Any]:
    """Return log evidence, mean and standard deviation of each hypothesis with dense matrices.

    A hypothesis is: columns, and a square root of the covariance of their amplitudes.
    """
    n, logs, means, deviations = len(model.z), [], [], []
    for columns, root in tried:
        B = np.hstack([model.J, model.Z[:, columns] @ root])
        H = np.eye(B.shape[1]) + B.T @ B
        squares = model.z @ np.linalg.solve(np.eye(n) + B @ B.T, model.z)
        logs.append(-0.5 * (NU + n) * math.log(NU + squares) - 0.5 * np.linalg.slogdet(H)[1])
        P = np.linalg.inv(H)
        T = np.hstack([model.T, np.zeros((len(model.T), B.shape[1] - model.T.shape[1]))])
        means.append(T @ P @ B.T @ model.z)
        level = max(1.0, (NU + squares) / (NU + n))
        deviations.append(np.sqrt(level * np.diag(T @ P @ T.T)))
    return np.array(logs), np.array(means), np.array(deviations)


@pytest.mark.parametrize("strength", [0.3, 30.0])
def test_the_average_equals_dense_gaussian_models(strength):
    rng = np.random.default_rng(1)
    n, p = 40, 3
    J, Z = strength * rng.standard_normal((n, p)), rng.standard_normal((n, 9))
    z = J @ rng.standard_normal(p) + strength * Z[:, 3] + rng.standard_normal(n)
    model = LinearModel(J=J, Z=Z, z=z, T=rng.standard_normal((2, p)))
    most = np.array([math.inf, 0.5, math.inf])
    causes = Causes(np.array([0, 1, 2]), most, (1.0, 16.0))
    first, second = np.arange(3, 6), np.arange(6, 9)
    roots = rng.standard_normal((3, 2)), np.diag([1.0, 0.5, 0.2])
    families = [
        Family(((first, roots[0]),), (1.0, 10.0), (4.0,)),
        Family(((first, roots[0]), (second, roots[1])), (3.0,)),
    ]

    def scaled(columns: Any, root: Any) -> Any:
        return root / np.sqrt(((Z[:, columns] @ root) ** 2).sum() / n)

    def cause(k: int, size: float) -> Any:
        usual = np.sqrt((Z[:, k] ** 2).mean())
        return np.array([[min(size / usual, most[k])]])

    nothing = np.zeros(0, dtype=int)
    single = [(np.array([k]), cause(k, size)) for size in (1.0, 16.0) for k in range(3)]
    one = scaled(first, roots[0])
    both = scipy.linalg.block_diag(one, scaled(second, roots[1])) / math.sqrt(2.0)
    several = [(first, one), (first, 10.0 * one)]
    several += [
        (np.array([*first, k]), scipy.linalg.block_diag(4.0 * one, cause(k, 4.0))) for k in range(3)
    ]
    several.append((np.arange(3, 9), 3.0 * both))
    tried = [(nothing, np.zeros((0, 0))), *single, *several]
    # Hypotheses of one kind differ only in size.
    kinds = np.array([0, 1, 2, 3, 1, 2, 3, 4, 4, 5, 6, 7, 8])

    logs, means, deviations = dense(model, tried)
    e = np.exp(logs - logs[0])
    of_kind = np.array([e[kinds == kind].mean() for kind in range(9)])
    mass = np.array([0.5, *[0.25 / 3] * 3, *[0.25 / 5] * 5])
    excess = math.log((of_kind * mass).max() / mass[0])
    eta = 1.0 if excess <= TEMPER else TEMPER / excess
    sums = np.array([e[kinds == kind].sum() for kind in range(9)])
    weights = (mass * of_kind**eta / sums)[kinds] * e
    found = averaged(model, causes, families)
    assert found.weights == pytest.approx(weights / weights.sum(), rel=1e-6)
    assert found.means == pytest.approx(means, rel=1e-8)
    assert found.deviations == pytest.approx(deviations, rel=1e-8)
    # Quantiles are quantiles of the mixture.
    for share in (0.025, 0.5, 0.975):
        at = scipy.special.ndtr((found.quantile(share) - means) / deviations)
        assert found.weights @ at == pytest.approx(share, abs=1e-9)


def test_quantiles_take_few_evaluations(monkeypatch):
    """The standard deviations of the components differ by a factor of ten."""
    rng = np.random.default_rng(2)
    means, deviations = (
        3.0 * rng.standard_normal((200, 30)),
        10.0 ** rng.uniform(0.0, 1.0, (200, 30)),
    )
    mixture = Mixture(np.full(200, 1.0 / 200), means, deviations)
    calls, ndtr = [], scipy.special.ndtr
    monkeypatch.setattr(scipy.special, "ndtr", lambda x: (calls.append(x), ndtr(x))[1])
    low, high = mixture.interval
    assert len(calls) < 20  # pure bisection takes 100
    for end, share in ((low, 0.025), (high, 0.975)):
        below = mixture.weights @ ndtr((end - means) / deviations)
        assert below == pytest.approx(np.full(30, share), abs=1e-9)


def test_hypotheses_without_weight_are_left_out():
    rng = np.random.default_rng(3)
    J, Z = rng.standard_normal((200, 2)), rng.standard_normal((200, 5))
    z = 40.0 * Z[:, 0] + rng.standard_normal(200)
    model = LinearModel(J=J, Z=Z, z=z, T=np.eye(2))
    causes = Causes(np.arange(5), np.full(5, math.inf), (1.0, 40.0))
    found = averaged(model, causes, [])
    # Only the larger size of the first cause explains the readings.
    assert len(found.weights) == len(found.means) == len(found.deviations) == 10
    assert found.weights.sum() == pytest.approx(1.0, abs=1e-12)


# --- responses of the process --------------------------------------------------------------------


LENGTH, STEP, COUNT = 1.0, 0.02, 120


PRIOR = lp.LogNormal(0.1, std=0.05)


def rod(
    prior: Any = PRIOR, source: float = 0.0, loss: float = 0.0, flow: float = 0.0, bent: float = 0.0
) -> lp.Model:
    mesh = lp.interval(0.0, LENGTH, 40)
    ends = {"left": lp.Channel("left"), "right": lp.Channel("right")}
    more: dict[str, Any] = {}
    if source or loss or flow or bent:
        more["B"] = lambda u, v, x: (
            (loss * u - source) * v
            + flow * lp.grad(u)[0] * v
            + bent * np.cos(np.pi * x[0]) * lp.dot(lp.grad(u), lp.grad(v))
        )
    return lp.Model(
        lp.Field(mesh, lp.fem.linear(mesh), dirichlet=ends),
        prior,
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
        **more,
    )


def ends(t: Any) -> dict[str, Any]:
    return {"left": np.sin(5.0 * t), "right": 0.3 * np.sin(2.0 * t) ** 2}


SENSORS = {"T_2": 0.2, "T_5": 0.5, "T_7": 0.7}
TIMES = (STEP * np.arange(COUNT)).tolist()
EULER = lp.ImplicitEuler()


def readings(model: lp.Model, q: float = 0.12) -> Any:
    """Return noise-free readings, shape (samples, sensors)."""
    spaces = model.state_space, model.X, model.parameter_space
    observed = lp.Points(SENSORS, noise=0.01).bind(*spaces)
    control = lp.stepping.Advance(EULER)
    parameter = np.array([q])
    latent = np.log(parameter)
    return np.array(
        [
            observed.predict(u, parameter, lp.fem.Moment(t, lp.fem.Inputs(ends(t))))
            for t, u in lp.stepping.simulate(model, latent, 0.0, TIMES, control, ends)
        ]
    )


def identified(z: Any) -> lp.Identifier:
    """Return the identifier of an error-free model after processing the readings."""
    sensors = lp.Points(SENSORS, noise=0.01)
    law = lp.SensitivityLaw(shadows=None)  # steps are not divided
    found = lp.Identifier(rod(), sensors, law, u0=0.0, scheme=EULER)
    for t, row in zip(TIMES, z, strict=True):
        found.step(t, row, ends(t))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mode", "size"),
    [
        ("source", 0, {"source": 1.0}),
        ("flow", 0, {"flow": 1e-6}),
        ("conductivity", 1, {"bent": 1e-6}),
    ],
)
def test_a_response_is_the_change_of_the_readings_by_an_error(kind, mode, size):
    identifier = identified(readings(rod()))
    samples = StoredSamples.of(identifier._work, identifier._state)
    one = samples.about(samples.reached)
    errors = ErrorColumns(samples, SMALL)
    responses, _, predicted = errors.followed(one)
    (x, *_) = samples.along(one)
    q = float(identifier.model.latent.value(x.q[0])[0])
    # The first steps of the law are shorter than the steps of `readings`.
    assert predicted == pytest.approx(readings(rod(), q)[1:], abs=0.01)
    # The hat functions of a family sum to one.
    found = 0.0
    for first, (shape, course) in zip(errors.first, errors.shapes, strict=True):
        if (shape.kind, shape.mode) == (kind, mode):
            columns = range(first, first + course.size)
            found = found + sum(responses[:, :, k] for k in columns)
    ((_, amplitude),) = size.items()
    change = (readings(rod(**size), q) - readings(rod(), q)) / amplitude
    scale = np.abs(change).max()
    assert found == pytest.approx(change[1:], abs=0.02 * scale)


def best_fit(model: lp.Model, sensors: Any, z: Any) -> tuple[StoredSamples, Any]:
    """Return the samples of a run, and its final fit."""
    identifier = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=0.0)
    for t, row in zip(TIMES[: len(z)], z, strict=True):
        identifier.step(t, row, ends(t))
    samples = StoredSamples.of(identifier._work, identifier._state)
    return samples, samples.about(samples.reached)


@pytest.mark.parametrize("what", ["flow", "source", "loss"])
def test_an_effect_of_an_unknown_is_not_a_model_error(what):
    """If the velocity is unknown, a steady flow is not an error, but a varying flow is."""
    more = {
        "flow": lambda q, u, v, x: q.s * lp.grad(u)[0] * v,
        "source": lambda q, u, v, x: -q.s * v,
        "loss": lambda q, u, v, x: q.s * u * v,
    }[what]
    model = lp.Model(
        rod().state,
        {"k": PRIOR, "s": lp.Normal(0.0, std=1.0)},
        A=[lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)), more],
    )
    samples, one = best_fit(model, lp.Points(SENSORS, noise=0.01), truth(1)[:40])
    errors = ErrorColumns(samples, SMALL)
    responses, *_ = errors.followed(one)
    constant = {"flow": {"steady flow"}, "source": {"switched"}, "loss": {"loss"}}[what]
    varies = {"flow": {"flow"}, "source": {"source", "switched"}, "loss": {"loss"}}[what]
    for first, (shape, course) in zip(errors.first, errors.shapes, strict=True):
        own = responses[:, :, first : first + course.size]
        if shape.kind in constant:
            assert not own[:, :, 0].any()
        elif shape.kind in ("steady flow", "switched", "loss"):
            assert own[:, :, 0].any()
        if shape.kind in varies and shape.mode == 0:
            assert own.any()
        if shape.kind in ("flow", "source"):  # hat functions that sum to one
            same = shape.kind == what and shape.mode == 0
            size = np.abs(own).max()
            assert (np.abs(own.sum(axis=2)).max() < 1e-9 * size) == same


def test_an_estimated_sensor_error_is_not_a_model_error():
    """The prior of an estimated offset already limits its size."""
    process = lp.Model(
        rod().state,
        {"k": PRIOR, "offset": lp.Normal(0.0, std=0.05)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    own, points = np.array([0.0, 1.0, 0.0]), lp.Points(SENSORS)
    sensors = lp.observation.Calibrated(points, lambda y, q, x: y + own * q.offset, noise=0.01)
    samples, one = best_fit(process, sensors, truth(1)[:40])
    used = np.isfinite(one.residuals)
    T = samples.filter.reduction.Phi @ samples.start.C[0].T
    model, causes, *_ = linear_model(samples, one, used, T)
    effects = [effect[effect != 0.0] for effect in model.Z[:, causes.columns].T]
    assert sum(bool(effect.size) and np.ptp(effect) < 1e-9 for effect in effects) == 2
    found, _ = model_errors(samples, lp.laws.Refit(), np.full(2, 0.1), np.zeros(2))
    assert isinstance(found, ModelErrors)
    assert {one.label: one.of_sensor for one in found.unknowns} == {"k": False, "offset": True}


# --- runs ----------------------------------------------------------------------------------------


@cache
def truth(seed: int, *wrong: tuple[str, float]) -> Any:
    """Return noisy readings of a finer model with a different time scheme."""
    errors = dict(wrong)
    cells = 200
    x = (np.arange(cells) + 0.5) / cells
    q, h = 0.12, STEP / 8
    main = np.full(cells, -2.0)
    main[[0, -1]] = -3.0
    ones = np.ones(cells - 1)
    L = q * cells**2 * scipy.sparse.diags_array([ones, main, ones], offsets=[-1, 0, 1])
    L = L - errors.get("loss", 0.0) * scipy.sparse.eye_array(cells)
    flow = errors.get("flow", 0.0) * cells / 2.0
    L = L - flow * scipy.sparse.diags_array([-ones, ones], offsets=[-1, 1])
    one = scipy.sparse.eye_array(cells)
    solver = scipy.sparse.linalg.splu(scipy.sparse.csc_array(one - 0.5 * h * L))
    right, u, shown = one + 0.5 * h * L, np.zeros(cells), [np.zeros(3)]
    for k in range(8 * (COUNT - 1)):
        t = h * (k + 0.5)
        # Inputs are linear between readings, as in the model.
        at = {name: np.interp(t, TIMES, [ends(s)[name] for s in TIMES]) for name in ends(0.0)}
        b = np.full(cells, errors.get("source", 0.0))
        b[0] += 2.0 * q * cells**2 * at["left"] + flow * 2.0 * at["left"]
        b[-1] += 2.0 * q * cells**2 * at["right"] - flow * 2.0 * at["right"]
        u = solver.solve(right @ u + h * b)
        if (k + 1) % 8 == 0:
            shown.append(np.interp(list(SENSORS.values()), x, u))
    return np.array(shown) + 0.01 * np.random.default_rng(seed).standard_normal((COUNT, 3))


def ended(z: Any) -> lp.Estimate:
    sensors = lp.Points(SENSORS, noise=0.01)
    identifier = lp.Identifier(rod(), sensors, lp.SensitivityLaw(), u0=0.0)
    samples = [(t, row, ends(t)) for t, row in zip(TIMES, z, strict=True)]
    return identifier.run(samples).last


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_correct_run_is_trusted_with_a_barely_wider_interval(seed):
    verdict = ended(truth(seed)).verdict
    assert verdict.level == "trusted"
    assert verdict.errors.misfit == pytest.approx(1.0, abs=0.15)
    (one,) = verdict.errors.unknowns
    assert one.low < 0.12 < one.high
    assert one.wider < 1.3


WRONG = [pytest.param(one, marks=pytest.mark.long) for one in (("loss", 0.5), ("flow", 0.15))]


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [("source", 0.06), *WRONG])
def test_a_model_without_a_term_ends_in_an_interval_with_the_truth(wrong):
    verdict = ended(truth(3, wrong)).verdict
    (one,) = verdict.errors.unknowns
    assert one.low < 0.12 < one.high
    assert verdict.level == "caution"
    first = verdict.sentences[0]
    assert "times the noise" in first
    assert "interval" in first


@pytest.mark.long
def test_readings_that_no_model_explains_are_not_trusted():
    z = truth(1) + 0.3 * np.sin(9.0 * np.array(TIMES)[:, None] + np.array([0.0, 2.0, 4.0]))
    verdict = ended(z).verdict
    assert verdict.errors.failed
    assert verdict.level == "do not trust"
    assert verdict.sentences[0].startswith("The fit failed.")


WALK = lp.Scalar(PRIOR, evolution=lp.RandomWalk(0.05))


def innovations_of(z: Any, prior: Any = PRIOR, **options: Any) -> Verdict:
    """Return the verdict of a run without a refit, which uses innovations."""
    law = lp.SensitivityLaw(**options)
    identifier = lp.Identifier(rod(prior), lp.Points(SENSORS, noise=0.01), law, u0=0.0)
    samples = [(t, row, ends(t)) for t, row in zip(TIMES, z, strict=True)]
    return identifier.run(samples).last.verdict


UNFITTED = {
    "moves": {"prior": WALK},
    "not stored": {"refit": None},
    "window": {"refit": lp.Refit(window=60)},
    "fades": {"memory": 50.0},
    "not guarded": {"refit": None, "guards": None},
}


@pytest.mark.slow
@pytest.mark.parametrize("why", UNFITTED)
def test_a_correct_run_without_a_fit_has_a_barely_wider_interval(why):
    verdict = innovations_of(truth(1), **UNFITTED[why])
    assert verdict.level == "trusted"
    assert verdict.errors.misfit == pytest.approx(1.0, abs=0.15)
    assert 0.0 < verdict.errors.of_signal < 0.2
    (one,) = verdict.errors.unknowns
    assert one.low < 0.12 < one.high
    assert one.wider < 1.3


FAULTS = ("source", "gain", "lag")
# Usual tests have one kind of run per fault, and two for one fault; others are long tests.
OFTEN = {("moves", "gain"), ("fades", "gain"), *product(["not stored"], FAULTS)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("why", "wrong"),
    [
        pytest.param(*pair, marks=[] if pair in OFTEN else pytest.mark.long)
        for pair in product(UNFITTED, FAULTS)
    ],
)
def test_an_interval_of_innovations_allows_for_errors_of_process_and_sensors(why, wrong):
    z = truth(3, ("source", 0.06)) if wrong == "source" else truth(3).copy()
    if wrong == "gain":
        z[:, 0] *= 1.15
    elif wrong == "lag":
        z[3:, 0] = truth(3)[:-3, 0]
    verdict = innovations_of(z, **UNFITTED[why])
    assert verdict.level != "trusted"
    (one,) = verdict.errors.unknowns
    assert one.low < 0.12 < one.high
    if wrong == "source":
        return
    # A time-varying unknown absorbs a part, and its plain interval is wide. The other interval is
    # wider on the side of the truth.
    assert (one.plain_low < 0.12 < one.plain_high) == (why == "moves")
    below, above = one.plain_low - one.low, one.high - one.plain_high
    assert max(below, above) > 0.0
    assert (below > above) == (one.value > 0.12)


def numbers(estimate: lp.Estimate) -> Any:
    """Return the misfit, and relative ends and width of the only unknown's interval."""
    errors = estimate.verdict.errors
    one = errors["q"] if "q" in estimate.space.labels else errors.unknowns[0]
    relative = [end / one.value for end in (one.low, one.high, one.plain_low, one.plain_high)]
    return [errors.misfit, errors.of_signal, *relative, one.wider]


def ended_with(z: Any, order: Any = None, scale: float = 1.0, **options: Any) -> lp.Estimate:
    """Return the end of a run with reordered sensors and a state in another unit."""
    names = order or list(SENSORS)
    sensors = lp.Points({name: SENSORS[name] for name in names}, noise=0.01 * scale)
    identifier = lp.Identifier(rod(), sensors, lp.SensitivityLaw(), u0=0.0, **options)
    columns = {name: scale * z[:, k] for k, name in enumerate(SENSORS)}
    samples = [
        (
            t,
            {name: float(columns[name][k]) for name in names},
            {name: scale * value for name, value in ends(t).items()},
        )
        for k, t in enumerate(TIMES)
    ]
    last = identifier.run(samples).last
    return last


@pytest.mark.long
@pytest.mark.parametrize("wrong", [(), (("source", 0.06),)])
@pytest.mark.parametrize("gaps", [False, True])
def test_order_and_units_of_the_readings_change_no_interval(wrong, gaps):
    z = truth(4, *wrong).copy()
    if gaps:  # gaps of single readings, and of one sensor for a while
        z[7::11, 0] = z[30:60, 2] = np.nan
    expected = numbers(ended_with(z))
    assert numbers(ended_with(z, order=["T_7", "T_2", "T_5"])) == pytest.approx(expected, rel=1e-4)
    assert numbers(ended_with(z, scale=40.0)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.long
def test_an_uncertain_initial_state_is_not_a_misfit():
    """Residuals are from the best fit, in which the initial state has its most probable value."""
    clean = truth(5)
    bump = 0.3 * np.sin(np.pi * np.array(list(SENSORS.values())))
    decay = np.exp(-0.12 * np.pi**2 * np.array(TIMES))
    z = clean + decay[:, None] * bump  # the first mode of another initial state
    uncertain = ended_with(z, u0_errors=[lambda x: 0.3 * np.sin(np.pi * x[0])])
    errors = uncertain.verdict.errors
    assert errors.misfit == pytest.approx(1.0, abs=0.15)
    assert uncertain.verdict.level == "trusted"
    stated = ended_with(z).verdict.errors
    assert stated.misfit > 1.5


# --- levels --------------------------------------------------------------------------------------


def errors(effect: float, wider: float, misfit: float = 1.0, of_signal: float = 0.01) -> Any:
    one = Allowed("k", "W/m/K", 1.0, 1.0 - effect, 1.0 + effect, 0.999, 1.001, wider)
    offset = Allowed("T.offset", "K", 0.0, -9.0, 9.0, -0.1, 0.1, 90.0, of_sensor=True)
    return ModelErrors(misfit, of_signal, {"T": misfit}, (one, offset))


@pytest.mark.parametrize(
    ("of", "doubted", "level"),
    [
        (errors(0.3, 1.1), False, "trusted"),
        (errors(0.05, 5.0), False, "trusted"),
        (errors(0.2, 3.0), False, "caution"),
        (errors(0.01, 9.0), True, "trusted"),
        (errors(0.2, 9.0), True, "caution"),
        (errors(0.8, 1.5), True, "caution"),
        (errors(0.8, 9.0), True, "do not trust"),
        (errors(0.01, 1.0, misfit=9.0), True, "trusted"),
        (errors(0.01, 1.0, misfit=9.0, of_signal=0.4), True, "do not trust"),
    ],
)
def test_the_level_follows_from_fit_and_effect(of, doubted, level):
    cause = Cause("source", "", "a source may be missing in the model", 0.8)
    misfit = Finding("misfit", "do not trust", "Model misfit.", causes=(cause,))
    verdict = Verdict.of([misfit] if doubted else []).with_errors(of)
    assert verdict.level == level
    # The level is unchanged if repeated, read from a file, or with more findings.
    again = Verdict.from_dict(json.loads(json.dumps(verdict.to_dict())))
    assert again == verdict
    assert verdict.with_errors(of) == verdict
    more = again.with_findings([Finding("input", "note", "Channel a has gaps.")])
    assert more.level == level
    assert sum(finding.what == "effect" for finding in more.findings) == (level != "trusted")


def test_the_remedy_mentions_plain_intervals_that_include_the_errors():
    """The table once had one column of intervals, while the remedy mentioned others."""
    same = ModelErrors(1.6, 0.05, {"T": 1.6}, (Allowed("c", "", 1.0, 0.9, 1.1, 0.9, 1.1, 1.0),))
    assert same.remedy == "The plain intervals include these errors."


def test_one_uncertain_unknown_leaves_the_others_usable():
    wide, narrow = errors(0.8, 9.0), Allowed("c", "", 1.0, 0.8, 1.3, 0.99, 1.01, 12.0)
    misfit = Finding("misfit", "do not trust", "Model misfit.")
    both = ModelErrors(2.0, 0.01, {"T": 2.0}, (*wide.unknowns, narrow))
    verdict = Verdict.of([misfit]).with_errors(both)
    assert verdict.level == "caution"
    assert both.remedy == "Use these intervals, but not that of k: too wide to use."
    assert both.remedy in verdict.sentences[0]
    alone = Verdict.of([misfit]).with_errors(wide)
    assert alone.level == "do not trust"
    assert "These intervals are too wide to use." in alone.sentences[0]


def test_an_unknown_near_zero_is_well_determined_relative_to_its_prior():
    """For a velocity of either sign near zero, any error is large relative to its value."""
    misfit = Finding("misfit", "do not trust", "Model misfit.")
    for size, level in ((0.001, "trusted"), (0.05, "caution"), (0.3, "do not trust")):
        v = Allowed("v", "m/s", 0.0, -size, size, -0.01 * size, 0.01 * size, 9.0, usual=0.2)
        found = ModelErrors(2.0, 0.01, {"T": 2.0}, (v,))
        assert Verdict.of([misfit]).with_errors(found).level == level
        assert v.text.endswith(f"(error up to {100 * size:.2g} % of its prior standard deviation)")
    far = Allowed("v", "m/s", 3.0, 2.7, 3.3, 2.9, 3.1, 3.0, usual=0.2)
    assert far.effect == pytest.approx(0.3 / 3.1)


def test_a_doubted_run_without_unknowns_of_the_model_is_not_trusted():
    offset = Allowed("T.offset", "K", 0.0, -0.1, 0.1, -0.1, 0.1, 1.0, of_sensor=True)
    misfit = Finding("misfit", "do not trust", "Model misfit.")
    only = ModelErrors(2.0, 0.01, {"T": 2.0}, (offset,))
    assert Verdict.of([misfit]).with_errors(only).level == "caution"


def test_unbounded_numbers_are_valid_json():
    one = Allowed("k", "", 0.0, -1.0, math.inf, 0.0, 0.0, math.inf)
    verdict = Verdict.of([]).with_errors(ModelErrors(1.0, math.inf, {"T": 1.0}, (one,)))
    text = json.dumps(verdict.to_dict(), allow_nan=False)
    assert Verdict.from_dict(json.loads(text)) == verdict


def test_a_later_estimate_keeps_the_widening_of_its_interval():
    before = errors(0.3, 4.0)
    after = before.about({"k": (2.0, 1.99, 2.02)})["k"]
    assert after.low == pytest.approx(2.0 - 0.01 * 0.3 / 0.001)
    assert after.high == pytest.approx(2.0 + 0.02 * 0.3 / 0.001)
    assert before.about({"k": (1.0, 0.999, 1.001)})["k"] == before["k"]


def test_other_findings_keep_their_severity():
    held = Finding("held", "do not trust", "The unknowns were held.")
    assert Verdict.of([held]).with_errors(errors(0.01, 1.0)).level == "do not trust"
    unit = Cause("unit", "T", "T may be in degF instead of degC", 0.99)
    gross = Finding("misfit", "do not trust", "Model misfit.", causes=(unit,))
    assert Verdict.of([gross]).with_errors(errors(0.01, 1.0)).level == "do not trust"


def test_a_guessed_curvature_of_inputs_is_a_caution_unless_an_interval_holds_it():
    shifts = Shifts(2.6, {"step": 0.1, "input": -2.5}, {("k", "input"): 0.1})
    (found,) = discretised(shifts)
    assert found.severity == "caution"
    assert Verdict.of([found]).level == "caution"
    assert Verdict.of([found]).with_errors(errors(0.05, 1.5)).level == "trusted"
    (held,) = discretised(Shifts(2.6, {"step": 2.5, "input": 0.1}))
    assert held.severity == "note"


@pytest.mark.slow
def test_an_initial_time_long_before_the_samples_changes_no_course_in_time():
    """With a forgotten t0, sources that begin within the run cannot begin before its samples."""
    rng = np.random.default_rng(4)
    ends = {"left": lp.Channel("T"), "right": 0.0}
    rod = lp.models.heat(lp.interval(0.0, 1.0, 20), lp.LogNormal(0.1, std=0.05), dirichlet=ends)
    t = 0.05 * np.arange(80)
    drive = np.sin(2.1 * t) + 0.3 * np.sin(7.0 * t)
    late = 0.6 * np.interp(t - 0.4, t, drive)[:, None] + 0.02 * rng.standard_normal((80, 1))

    def upper(t0: float) -> float:
        sensors = lp.Points({"a": 0.3}, noise=0.02)
        start = lp.Identifier(rod, sensors, lp.SensitivityLaw(), u0=0.0, t0=t0)
        rows = ((1e6 + t[k], late[k], {"T": drive[k]}) for k in range(len(t)))
        errors = start.run(rows).verdict.errors
        return errors["alpha"].high

    assert upper(1e6 - 1000.0) == pytest.approx(upper(1e6), rel=0.05)


@pytest.mark.parametrize("options", [{}, pytest.param({"refit": None}, marks=pytest.mark.slow)])
@pytest.mark.parametrize("what", ["noisy", "silent"])
def test_sensor_noise_is_not_a_model_error(what, options):
    """One sensor is eight times as noisy as stated, or all five times and two have one reading."""
    clean = truth(6)
    rng = np.random.default_rng(7)
    if what == "noisy":
        z = clean + 0.08 * rng.standard_normal(clean.shape) * [0.0, 1.0, 0.0]
    else:
        z = clean + 0.05 * rng.standard_normal(clean.shape)
        z[:40, 1:] = z[41:, 1:] = np.nan
    verdict = innovations_of(z, **options)
    assert verdict.errors.misfit == pytest.approx(1.0, abs=0.2)
    assert verdict.errors.misfit <= 1.001 * max(verdict.errors.sensors.values())
    assert verdict.level != "do not trust"
    noise = [finding.subject for finding in verdict.findings if finding.what == "noise"]
    assert noise == (["T_5"] if what == "noisy" else [""])
