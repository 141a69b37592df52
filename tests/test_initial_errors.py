"""Errors of the initial state as random fields, and how the laws estimate them."""

import functools

import numpy as np
import pytest
from factories import INTERPOLATED_ROD_CASE, filter_alone
from skfem import ElementLineP2

import livepde as lp
from benchmarks.first_hour import wall
from livepde import cases

H = 0.02
SENSORS = {"T_3": 0.3, "T_7": 0.7}
LAWS = {
    "filter": filter_alone(guards=None),
    "refit": lp.SensitivityLaw(shadows=None, verdict=False),
}


# --- random fields -----------------------------------------------------------------------------


def std_of(field, x) -> np.ndarray:
    return np.sqrt(sum(function(np.atleast_2d(x)) ** 2 for function in field))


def matern(a, b, length: float) -> np.ndarray:
    d = np.sqrt(3.0) * np.abs(np.subtract.outer(a, b)) / length
    return (1.0 + d) * np.exp(-d)


def test_a_field_is_zero_where_values_are_known_and_as_large_as_stated():
    mesh = lp.interval(0.0, 2.0, 80)
    field = lp.random_field(mesh, 3.0, known={0.2: 20.0, 1.5: 10.0})
    assert std_of(field, [0.2, 1.5]) == pytest.approx(0.0, abs=1e-3)
    assert std_of(field, mesh.p[0]).max() == pytest.approx(3.0, rel=1e-9)


def test_a_stated_size_that_few_functions_do_not_have_is_refused():
    """Eight functions were returned, with a tenth of the variance that was stated."""
    mesh = lp.interval(0.0, 1.0, 100)
    with pytest.raises(lp.errors.SpaceError, match="represent 13% of the variance"):
        lp.random_field(mesh, 1.0, length=0.01)
    size = std_of(lp.random_field(mesh, 1.0, length=0.01, most=100), mesh.p)
    assert size == pytest.approx(1.0, rel=0.05)


def test_a_field_whose_values_are_all_known_is_none():
    mesh = lp.interval(0.0, 1.0, 4)
    for std in (None, 1.0):
        assert (
            lp.random_field(mesh, std, known=dict(zip(mesh.p[0], [2, 1, 4, 1, 3], strict=True)))
            == ()
        )


def test_the_variance_is_that_of_kriging():
    """Conditional covariance by the textbook formula, of readings whose spread tells the size."""
    mesh, length = lp.interval(0.0, 1.0, 40), 0.5
    at, values = np.array([0.0, 0.35, 1.0]), np.array([3.0, 2.0, 4.0])
    field = lp.random_field(mesh, known=dict(zip(at, values, strict=True)), most=30)
    K = matern(at, at, length)
    ones = np.ones(3)
    mean = ones @ np.linalg.solve(K, values) / (ones @ np.linalg.solve(K, ones))
    size = (values - mean) @ np.linalg.solve(K, values - mean) / 2
    x = mesh.p[0]
    cross = matern(x, at, length)
    kriged = size * (1.0 - np.einsum("is,si->i", cross, np.linalg.solve(K, cross.T)))
    assert std_of(field, x) ** 2 == pytest.approx(kriged, abs=0.03 * kriged.max())


def test_a_field_on_a_plane_has_its_standard_deviation_everywhere():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 2.0), (8, 16))
    field = lp.random_field(mesh, 2.0, length=2.0, most=20)
    assert std_of(field, mesh.p) == pytest.approx(2.0, rel=0.05)


def test_one_reading_has_no_spread():
    assert lp.random_field(lp.interval(0.0, 1.0, 8), known={0.5: 3.0}) == ()
    assert len(lp.random_field(lp.interval(0.0, 1.0, 8), 1.0, known={0.5: 3.0})) > 1


@pytest.mark.parametrize("wrong", [{"std": 0.0}, {"std": -1.0}, {"std": 1.0, "length": np.inf}])
def test_sizes_of_a_field_are_positive(wrong):
    with pytest.raises(lp.errors.SpaceError, match="must be a positive number"):
        lp.random_field(lp.interval(0.0, 1.0, 8), **wrong)


# --- in the laws -------------------------------------------------------------------------------


def rod(initial: bool = False) -> lp.Model:
    """Return a rod; with `initial` its start has two unknowns, else they are errors of u0."""
    mesh = lp.interval(0.0, 1.0, 20)
    unknowns = {"k": lp.LogNormal(0.3, std=0.15)}
    if initial:
        unknowns |= {"a": lp.Normal(0.0, std=1.0), "b": lp.Normal(0.0, std=1.0)}
    return lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("left")}),
        unknowns,
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
        initial=(lambda q, v, x: (line(x) + q.a * bow(x) + q.b * wave(x)) * v) if initial else None,
    )


def line(x):
    return 1.0 - 0.5 * x[0]


def bow(x):
    return 0.4 * np.sin(np.pi * x[0])


def wave(x):
    return 0.2 * np.sin(2.0 * np.pi * x[0])


def with_errors(law, **options) -> lp.Identifier:
    sensors = lp.Points(SENSORS, noise=0.02)
    return lp.Identifier(rod(), sensors, law, u0=line, u0_errors=[bow, wave], **options)


@functools.cache
def readings(count: int = 30) -> list[lp.Sample]:
    """Return readings of a rod that starts in a bow, with noise."""
    mesh = lp.interval(0.0, 1.0, 60)
    fine = lp.Model(
        lp.Field(mesh, ElementLineP2(), dirichlet={"left": lp.Channel("left")}),
        {"k": lp.Normal(0.4, std=0.1)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    true = lp.Identifier(
        fine, lp.Points(SENSORS, noise=0.02), filter_alone(), u0=lambda x: line(x) + 1.2 * bow(x)
    )
    times = H * np.arange(1, count + 1)
    left = 1.0 + 0.5 * np.sin(2.0 * times)
    shown = true.forecast(times, {"left": left})
    rng = np.random.default_rng(3)
    noise = {name: 0.02 * rng.standard_normal(count) for name in SENSORS}
    return [
        lp.Sample(t=t, z={"left": left[k], **{n: shown[n][k] + noise[n][k] for n in SENSORS}})
        for k, t in enumerate(times)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_errors_of_u0_are_as_unknowns_of_the_start(law):
    """The same rod with its errors as unknowns of `Model.initial`: estimates agree."""
    one = with_errors(LAWS[law])
    sensors = lp.Points(SENSORS, noise=0.02)
    other = lp.Identifier(rod(initial=True), sensors, LAWS[law])
    for sample in readings():
        here, there = (each.step(sample.t, sample.z) for each in (one, other))
    tolerance = 1e-3 if law == "filter" else 0.1  # a refit ends near the optimum
    spread = there["k"].deviation
    assert here["k"].median == pytest.approx(there["k"].median, abs=tolerance * spread)
    assert here["k"].deviation == pytest.approx(spread, rel=tolerance)
    assert abs(here["k"].median - 0.4) < 3.0 * spread


@pytest.mark.slow
def test_a_fit_begins_where_the_last_one_ended():
    """Errors of the start were zero at each refit: the second fit of 200 samples took 5 passes."""
    one = with_errors(LAWS["refit"])
    for sample in readings(200):
        one.step(sample.t, sample.z)
    before = one.refit().fit
    after = one.refit().fit
    assert after.passes - before.passes < 1.5
    assert after.cost == pytest.approx(before.cost, rel=1e-6)


@pytest.mark.slow
def test_without_them_a_start_that_is_off_ends_in_the_unknowns():
    sensors = lp.Points(SENSORS, noise=0.02)
    plain = lp.Identifier(rod(), sensors, LAWS["refit"], u0=line)
    uncertain = with_errors(LAWS["refit"])
    for sample in readings():
        ends = [one.step(sample.t, sample.z)["k"].median for one in (plain, uncertain)]
    assert abs(ends[0] - 0.4) > 10.0 * abs(ends[1] - 0.4)


@pytest.mark.slow
def test_smoothed_ends_as_filtered_and_begins_nearer_to_the_truth():
    one = with_errors(LAWS["refit"])
    smoothed = one.smoothed(readings())
    for sample in readings():
        estimate = one.step(sample.t, sample.z)
    assert float(smoothed["k"][-1]) == pytest.approx(
        estimate["k"].median, abs=0.1 * estimate["k"].deviation
    )
    x = one.model.state.mesh.p[0]
    first = np.asarray(smoothed["u"][0])
    true = line(x[None]) + 1.2 * bow(x[None])
    assert np.abs(first - true)[5:].max() < 0.5 * np.abs(first - line(x[None]))[5:].max()


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_a_checkpoint_resumes_and_knows_other_errors(law):
    one, stream = with_errors(LAWS[law]), readings()
    for sample in stream[:10]:
        one.step(sample.t, sample.z)
    again = with_errors(LAWS[law])
    again.restore(one.dump())
    for sample in stream[10:]:
        a, b = one.step(sample.t, sample.z), again.step(sample.t, sample.z)
    assert np.array_equal(a.belief.q_factor, b.belief.q_factor)
    assert np.array_equal(a.belief.u, b.belief.u)
    later = H * np.arange(31, 40)
    assert np.array_equal(one.forecast(later)["T_3"], again.forecast(later)["T_3"])
    sensors = lp.Points(SENSORS, noise=0.02)
    other = lp.Identifier(rod(), sensors, LAWS[law], u0=line, u0_errors=[bow])
    with pytest.raises(lp.errors.RunError, match="another u0 or q0"):
        other.restore(one.dump())


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_members_of_a_fleet_have_errors_of_their_own(law):
    each = [(bow, wave), (), (bow,)]
    sensors = lp.Points(SENSORS, noise=0.02)
    fleet = lp.Fleet(rod(), sensors, LAWS[law], 3, u0=line, u0_errors=each)
    ones = [lp.Identifier(rod(), sensors, LAWS[law], u0=line, u0_errors=own) for own in each]
    for sample in readings(12):
        found = fleet.step(sample.t, sample.z)
        alone = [one.step(sample.t, sample.z) for one in ones]
    for k, one in enumerate(alone):
        assert found.q[k] == pytest.approx(one.q, rel=1e-8)
        assert found.q_std[k] == pytest.approx(one.belief.q_std, rel=1e-6)
    # A member goes on by itself, and its checkpoint is that of the same identifier.
    ones[2].restore(fleet.identifier(2).dump())


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"u0_errors": [bow]}, "u0_errors describes u0: give u0, too"),
        ({"u0": line, "u0_errors": [lambda x: np.nan * x[0]]}, "u0_errors: .* is not finite"),
    ],
)
def test_errors_of_no_start_are_refused(options, text):
    with pytest.raises(lp.errors.LivepdeError, match=text):
        lp.Identifier(rod(), lp.Points(SENSORS, noise=0.1), lp.SensitivityLaw(), **options)


def test_the_gradient_law_refuses_them():
    with pytest.raises(lp.errors.LawError, match="u0_errors"):
        lp.Identifier(rod(), lp.Points(SENSORS), lp.GradientLaw(), u0=line, u0_errors=[bow])


# --- a wall that starts in a curve -------------------------------------------------------------


def wall_identifier(first: dict[str, float], *, uncertain: bool) -> lp.Identifier:
    """Return C u_t = k u_xx that starts in the line between the first readings."""
    mesh = lp.interval(0.0, 0.24, 16)
    model = lp.Model(
        lp.Field(mesh, ElementLineP2(), dirichlet={"right": lp.Channel("T_outside")}),
        {"k": lp.LogNormal(0.8, std=0.4), "C": lp.LogNormal(1.5e6, std=0.5e6)},
        A=[
            lambda q, u, v, x: q.k / q.C * lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("left", lambda q, _, v, x: -x.inputs["q_inside"] / q.C * v),
        ],
        inputs=["q_inside"],
    )
    at = {"T_inside": 0.0, "T_outside": 0.24}
    known = {place: first[name] for name, place in at.items()}
    return lp.Identifier(
        model,
        lp.Points({"T_inside": 0.0}, noise=0.1),
        lp.SensitivityLaw(),
        u0=lambda x: np.interp(x[0], list(known), list(known.values())),
        u0_from={
            name: lambda x, row=row: np.interp(x[0], list(known), row)
            for name, row in zip(at, np.eye(2), strict=True)
        },
        u0_errors=lp.random_field(mesh, known=known) if uncertain else (),
        input_noise={"T_outside": 0.1, "q_inside": 0.3},
    )


@pytest.mark.long
@pytest.mark.parametrize("uncertain", [True, False])
def test_a_wall_that_starts_in_a_curve(uncertain):
    """Truth by finite volumes; the line between two readings is not where the wall begins."""
    (_, *names), table, truths = wall(0, days=1.0)
    one = wall_identifier(dict(zip(names, table[0, 1:], strict=True)), uncertain=uncertain)
    for t, *values in table.tolist():
        estimate = one.step(t, dict(zip(names, values, strict=True)))
    if not uncertain:
        assert estimate.verdict.level == "do not trust"
        return
    assert estimate.verdict.level == "trusted"
    for name, truth in truths.items():
        low, high = estimate[name].interval()
        assert low <= truth <= high
        assert high / low < 1.2


# --- in cases ----------------------------------------------------------------------------------

CHANNELS = """
[channels]
left = { role = "boundary", column = "left", at = "left", unit = "degC" }
T = { role = "sensor", column = "T", at = "0.3 m", unit = "degC", noise = "0.1 K" }
"""


def prepared(tmp_path, initial: str, law: str = "sensitivity") -> cases.Prepared:
    rows = ["t,left,T", *(f"{300 * k},20,{22 + 0.1 * k}" for k in range(5)), ""]
    (tmp_path / "rows.csv").write_text("\n".join(rows))
    text = INTERPOLATED_ROD_CASE.replace('"interpolate"', initial, 1)
    text = text.replace('kind = "sensitivity"', f'kind = "{law}"')
    (tmp_path / "case.toml").write_text(text + CHANNELS)
    return cases.load(tmp_path / "case.toml").prepare()


@pytest.mark.parametrize("initial", ['"interpolate"', '{ from = "readings" }'])
def test_an_interpolated_start_is_uncertain_by_the_spread_of_its_readings(tmp_path, initial):
    problem = prepared(tmp_path, initial).identifier.problem
    mesh = problem.model.state.mesh
    field = lp.random_field(mesh, known={0.0: 20.0, 0.3: 22.0})
    assert problem.initial_errors == pytest.approx(np.array([f(mesh.p) for f in field]))
    assert list(problem.initial_readings) == ["left", "T"]


def test_its_size_may_be_stated(tmp_path):
    ready = prepared(tmp_path, '{ from = "readings", std = "4 K", length = "20 cm" }')
    errors = ready.identifier.problem.initial_errors
    assert np.sqrt((errors**2).sum(axis=0)).max() == pytest.approx(4.0, rel=0.05)


def test_a_stated_profile_may_be_uncertain(tmp_path):
    problem = prepared(tmp_path, '{ from = "20 degC", std = "2 K" }').identifier.problem
    size = np.sqrt((problem.initial_errors**2).sum(axis=0))
    assert size == pytest.approx(2.0, rel=0.05)
    assert not problem.initial_readings
    assert not len(prepared(tmp_path, '"20 degC"').identifier.problem.initial_errors)


@pytest.mark.parametrize(
    ("initial", "text"),
    [
        ('from = "readings", sdt = "1 K"', "no key 'initial.sdt'; did you mean 'std'"),
        ('from = "raedings"', "initial: got 'raedings'; did you mean 'readings'"),
        ('from = "readings", std = 0', "initial.std: got 0.0; expected more than 0"),
        ('from = "interpolate-exact", std = 1', "'interpolate-exact' has no errors"),
        ('from = 20, length = "1 m"', "add initial.std"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, initial, text):
    with pytest.raises(lp.errors.CaseError, match=text):
        prepared(tmp_path, f"{{ {initial} }}")


def test_a_length_that_is_too_short_is_refused_with_its_key(tmp_path):
    text = INTERPOLATED_ROD_CASE.replace("cells = 10", "cells = 100").replace(
        '"interpolate"', '{ from = "20 degC", std = "1 K", length = "1 mm" }', 1
    )
    (tmp_path / "rows.csv").write_text("t,left,T\n0,20,22\n300,20,22\n")
    (tmp_path / "case.toml").write_text(text + CHANNELS)
    with pytest.raises(lp.errors.CaseError, match="initial: random_field: 8 functions"):
        cases.load(tmp_path / "case.toml").prepare()


def test_a_case_with_the_gradient_law_refuses_its_size(tmp_path):
    with pytest.raises(lp.errors.CaseError, match=r"'gradient' has no covariance"):
        prepared(tmp_path, '{ from = "readings", std = "1 K" }', "gradient")
    assert prepared(tmp_path, '"interpolate"', "gradient").identifier
