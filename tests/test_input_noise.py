"""Intervals include the noise of inputs and of readings that define the initial state."""

import numpy as np
import pytest
from factories import INTERPOLATED_ROD_CASE, filter_alone
from skfem import ElementLineP1

import livepde as lp
from livepde import cases
from livepde.laws.noise_rows import PAUSE_ROWS, ROWS
from livepde.stepping import Alexander2, ImplicitEuler

H, STEPS = 0.01, 40
SENSORS = {"T_1": 0.1, "T_5": 0.5}


def rod(std: float = 0.3, flux: bool = False, cube: float = 0.0) -> lp.Model:
    """Return a rod whose left end or source arrives with the stream."""
    sources = [0.0, lp.On("right", lambda x, _: x.inputs["Q"])] if flux else 0.0
    return lp.Model(
        state=lp.Field(
            lp.interval(0.0, 1.0, 20),
            ElementLineP1(),
            dirichlet={"left": lp.Channel("left")} if not flux else {},
        ),
        parameter={"k": lp.Normal(1.0, std=std)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) + cube * u**3 * v,
        f=sources,
        inputs=["Q"] if flux else [],
    )


def channel(k: int) -> float:
    return 1.0 + np.sin(0.3 * k)


def states(model, inputs, scheme) -> np.ndarray:
    """Return what the sensors see of a run with these inputs and the unknowns of the prior."""
    name = model.channels[0]
    points = lp.Points(SENSORS, noise=1.0)
    one = lp.Identifier(model, points, filter_alone(), u0=0.0, scheme=scheme, halvings=0)
    for k, value in enumerate(inputs):
        one.step(H * k, {name: value})
    belief = one._latent_belief()
    return one.observed.predict(belief.u, belief.q, None)


@pytest.mark.parametrize("flux", [False, True])
@pytest.mark.parametrize(("scheme", "tolerance"), [(ImplicitEuler(), 0.01), (Alexander2(), 0.05)])
@pytest.mark.long
def test_the_uncertainty_of_the_state_is_that_of_all_readings(flux, scheme, tolerance):
    """Each reading one standard deviation off moves the state; squares add up."""
    model, noise = rod(std=1e-9, flux=flux), 0.2
    name = model.channels[0]
    inputs = np.array([channel(k) for k in range(STEPS + 1)])
    known = states(model, inputs, scheme)
    square = np.zeros(len(SENSORS))
    for k in range(1, STEPS + 1):
        off = inputs.copy()
        off[k] += noise
        square += (states(model, off, scheme) - known) ** 2
    one = lp.Identifier(
        model,
        lp.Points(SENSORS, noise=1.0),
        filter_alone(),
        u0=0.0,
        scheme=scheme,
        halvings=0,
        input_noise={name: noise},
    )
    for k, value in enumerate(inputs):
        one.step(H * k, {name: value})
    factor = one.observed.G @ one._latent_belief().u_factor
    assert factor.shape[1] <= 2 + ROWS + PAUSE_ROWS
    ratio = np.sqrt((factor**2).sum(axis=1) / square)
    assert ratio[1] == pytest.approx(1.0, rel=tolerance)
    near = 1.0 if flux or isinstance(scheme, ImplicitEuler) else 1.25
    assert 1.0 - tolerance <= ratio[0] <= near + tolerance


# --- initial states ----------------------------------------------------------------------------


def made_of_readings(law, errors, u_true, **unknowns):
    at = np.array([0.0, 0.3, 0.7, 1.0])
    names = [f"T_{k}" for k in range(4)]
    model = lp.Model(
        state=lp.Field(lp.interval(0.0, 1.0, 20), ElementLineP1()),
        parameter={"k": lp.Normal(1.0, std=0.3), **unknowns},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    z = u_true(at) + errors
    unit = np.eye(4)
    weights = {
        name: lambda x, row=unit[k]: np.interp(x[0], at, row) for k, name in enumerate(names)
    }
    direct = {"T_1": lambda q, x: q.offset} if unknowns else {}
    sensors = lp.Points(dict(zip(names, at.tolist(), strict=True)), direct, noise=0.1)
    one = lp.Identifier(model, sensors, law, u0=lambda x: np.interp(x[0], at, z), u0_from=weights)
    one.step(0.0, z)
    return one, z


def test_the_readings_of_the_start_count_once():
    one, z = made_of_readings(lp.SensitivityLaw(), np.zeros(4), lambda x: 1.0 + x)
    belief = one._latent_belief()
    seen = one.observed.G @ belief.u_factor
    assert np.sqrt((seen**2).sum(axis=1)) == pytest.approx(np.full(4, 0.1), rel=1e-9)
    assert one.observed.G @ belief.u == pytest.approx(z)
    assert np.sqrt((belief.q_factor**2).sum()) == pytest.approx(0.3)  # nothing is learned of k


def test_an_offset_is_not_learned_from_the_state_that_was_made_with_it():
    extra = {"offset": lp.Normal(0.0, std=0.5)}
    one, _ = made_of_readings(lp.SensitivityLaw(), np.zeros(4), lambda x: 1.0 + x, **extra)
    belief = one._latent_belief()
    assert np.sqrt((belief.q_factor[1] ** 2).sum()) == pytest.approx(0.5)
    seen = one.observed.G @ belief.u_factor
    assert np.sqrt((seen**2).sum(axis=1)) == pytest.approx([0.1, np.hypot(0.1, 0.5), 0.1, 0.1])


@pytest.mark.parametrize("law", [lp.SensitivityLaw(), lp.SensitivityLaw(refit=None)])
@pytest.mark.long
def test_a_wrong_start_does_not_end_in_the_unknowns(law):
    """Means of squared errors over expected variances: of order one with the noise of the start."""
    scores = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        one, _ = made_of_readings(law, 0.1 * rng.standard_normal(4), lambda x: 1.0 + x)
        true = lp.Identifier(
            one.model, one.observed.observation, filter_alone(), u0=lambda x: 1.0 + x[0]
        )
        times = 0.01 * np.arange(1, 21)
        expected = true.forecast(times)
        for k, t in enumerate(times):
            z = np.array([expected[name][k] for name in one.observed.names])
            estimate = one.step(t, z + 0.1 * rng.standard_normal(4))
        belief = estimate.belief
        scores.append((belief.q[0] - 1.0) ** 2 / (belief.q_factor[0] ** 2).sum())
    assert np.mean(scores) < 2.0


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"input_noise": {"rigth": 0.1}}, "the model has no channel 'rigth'"),
        ({"input_noise": {"left": 0.0}}, "must be a positive number"),
        ({"u0_from": {"T_9": 1.0}, "u0": 0.0}, "'T_9' is neither an assimilated sensor"),
        ({"u0_from": {"T_1": 1.0}}, "give u0, too"),
    ],
)
def test_what_makes_no_sense_is_refused(options, text):
    points = lp.Points(SENSORS, noise=1.0)
    with pytest.raises(lp.errors.ConfigurationError, match=text):
        lp.Identifier(rod(), points, lp.SensitivityLaw(), **options)


def test_the_gradient_law_has_no_covariance():
    with pytest.raises(lp.errors.LawError, match="has no covariance"):
        lp.Identifier(rod(), lp.Points(SENSORS), lp.GradientLaw(), input_noise={"left": 0.1})


# --- cases and fleets --------------------------------------------------------------------------

CASE = f"""{INTERPOLATED_ROD_CASE}
[channels]
left = {{ role = "boundary", column = "left", at = "left", unit = "degC", noise = "0.2 K" }}
T = {{ role = "sensor", column = "T", at = "0.3 m", unit = "degC", noise = "0.1 K" }}
"""


def test_a_case_states_the_noise_of_its_channels(tmp_path):
    rows = [f"{300 * k},{20 + k % 3},{20 + 0.1 * k}" for k in range(5)]
    (tmp_path / "rows.csv").write_text("\n".join(["t,left,T", *rows, ""]))
    (tmp_path / "case.toml").write_text(CASE)
    prepared = cases.load(tmp_path / "case.toml").prepare()
    problem = prepared.identifier.problem
    assert problem.input_noise == {"left": 0.2}
    assert list(problem.initial_readings) == ["left", "T"]
    result = prepared.identifier.run(prepared.stream)
    assert result.last.belief.u_factor[3].any()


def of_two_sensors_at_one_place(tmp_path, initial: str) -> lp.Identifier:
    rows = ["t,left,T,S", *(f"{300 * k},20,{20.5 + 0.1 * k},21.5" for k in range(5)), ""]
    (tmp_path / "rows.csv").write_text("\n".join(rows))
    other = 'S = { role = "sensor", column = "S", at = "0.3 m", unit = "degC", noise = "0.1 K" }\n'
    text = (CASE + other).replace('"interpolate"', f'"{initial}"')
    (tmp_path / "case.toml").write_text(text)
    return cases.load(tmp_path / "case.toml").prepare().identifier


@pytest.mark.parametrize("initial", ["interpolate", "interpolate-exact"])
def test_the_start_is_interpolated_from_the_mean_of_readings_at_one_place(tmp_path, initial):
    identifier = of_two_sensors_at_one_place(tmp_path, initial)
    x = identifier.model.state.mesh.p[0]
    assert identifier.u0 == pytest.approx(np.interp(x, [0.0, 0.3], [20.0, 21.0]))


def test_readings_at_one_place_share_the_noise_of_the_start(tmp_path):
    identifier = of_two_sensors_at_one_place(tmp_path, "interpolate")
    readings = identifier.problem.initial_readings
    x = identifier.model.state.mesh.p[0]
    assert readings["S"].weight == pytest.approx(np.interp(x, [0.0, 0.3], [0.0, 0.5]))
    identifier.step(0.0, {"left": 20.0, "T": 20.5, "S": 21.5})
    there = identifier.observed.G[0] @ identifier._latent_belief().u_factor
    assert np.linalg.norm(there) == pytest.approx(0.1 / np.sqrt(2.0))


def test_an_exact_start_has_no_noise(tmp_path):
    identifier = of_two_sensors_at_one_place(tmp_path, "interpolate-exact")
    assert not identifier.problem.initial_readings
    identifier.step(0.0, {"left": 20.0})
    there = identifier.observed.G[0] @ identifier._latent_belief().u_factor
    assert np.linalg.norm(there) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_members_of_a_fleet_start_from_readings_of_their_own():
    model, points = rod(), lp.Points(SENSORS, noise=0.05)
    hats = [{"T_1": lambda x: 1.0 - x[0]}, {"T_1": lambda x: 1.0 - x[0], "T_5": lambda x: x[0]}, {}]
    fleet = lp.Fleet(model, points, lp.SensitivityLaw(), 3, u0=1.0, u0_from=hats)
    ones = [lp.Identifier(model, points, lp.SensitivityLaw(), u0=1.0, u0_from=hat) for hat in hats]
    z = {"T_1": 0.9, "T_5": 1.1, "left": 1.0}
    for k in range(6):
        found = fleet.step(H * k, z)
        each = [one.step(H * k, z) for one in ones]
    for j, one in enumerate(each):
        assert found.q[j] == pytest.approx(one.belief.q, rel=1e-9)
        assert found.q_std[j] == pytest.approx(one.belief.q_std, rel=1e-9)
