"""A fleet gives the numbers of separate identifiers, also if some members fail."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from factories import laplace, line, truth
from skfem import ElementLineP1, ElementLineP2

import livepde as lp
from livepde.fleet import Fleet, FleetRecords
from livepde.linalg import BandedBlocks, BandedSolver, Pattern
from livepde.models import Flux, heat, with_conditions
from livepde.result import Result

SENSORS = lp.Points({"T_1": 0.3, "T_2": 0.5, "T_3": 0.8}, noise=0.02)
ALPHA = lp.Normal(0.5, std=0.25)
BOUNDED = lp.Normal(0.5, std=0.25, bounds=(0.45, 0.55))


def rod(prior=ALPHA, **alpha):
    """Return a rod with two unknowns, and inputs in boundary values and as factor of an unknown."""
    ends = {"left": lp.Channel("T_0"), "right": 0.0}
    return heat(
        line(16), lp.Scalar(prior, unit="m^2/s", **alpha), ends, loss=lp.Normal(0.3, std=0.2)
    )


def sources():
    """Return a model with time-dependent sources, no inputs, and quadratic elements."""
    return lp.Model(
        lp.Field(line(12), ElementLineP2(), dirichlet={"boundary": 0.0}),
        {"a": lp.Normal(0.5, std=2.0), "b": lp.Normal(-1.0, std=0.5)},
        A=lambda q, _, v, x: -q.a * v - q.b * x[0] * np.sin(x.t) * v,
        B=laplace,
    )


def layers():
    """Return a model with one unknown per layer, and an input as source."""
    halves = {"top": lambda x: x[0] < 0.4, "bottom": lambda x: x[0] >= 0.4}
    return lp.Model(
        lp.Field(line(16), ElementLineP1(), dirichlet={"left": lp.Channel("T_0")}),
        {"k": lp.Piecewise(halves, lp.Normal(0.6, 0.2)), "c": lp.Normal(0.0, std=0.1)},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) - q.c * u * v,
        f=lambda x, t: 0.1 * x.inputs["sun"] * np.cos(t) * x[0],
        inputs=["sun"],
    )


def walks():
    """Return a model with a random walk, a mean-reverting, a harmonic and a constant unknown."""
    evolutions = {
        "a": lp.RandomWalk(0.1),
        "b": lp.MeanReverting(2.0),
        "c": lp.fem.Periodic(3.0),
        "d": None,
    }
    unknowns = {
        name: lp.Scalar(lp.Normal(0.5, std=0.2), **({"evolution": kind} if kind else {}))
        for name, kind in evolutions.items()
    }
    return lp.Model(
        lp.Field(line(16), ElementLineP1(), dirichlet={"left": lp.Channel("T_0"), "right": 0.0}),
        unknowns,
        A=[
            lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)) + q.b * u * v,
            lambda q, _, v, x: -q.c * x[0] * v - q.d * np.sin(x.t) * v,
        ],
    )


MODELS = {
    "walks": walks,
    "rod": rod,
    "logarithm": lambda: rod(lp.LogNormal(0.5, 0.25)),
    "sources": sources,
    "layers": layers,
}


def law(**options) -> lp.SensitivityLaw:
    """Return a law without a verdict, because a fleet has none.

    Its start is short and without shadows: "usual" is the law that has both as they are by default.
    """
    return lp.SensitivityLaw(
        **{"refit": lp.laws.Refit(start=4), "shadows": None, "verdict": False, **options}
    )


LAWS = {
    "usual": lp.SensitivityLaw(verdict=False),
    "drift": law(drift=0.1),
    "rank": law(rank=8),
    "plain": law(),
    "gate, noise": law(gate=3.0, noise="auto"),
    "jumps": law(jumps=lp.Jumps(settle=5)),
    "no guards, memory": law(guards=None, memory=2.0),
}


def samples(fleet, steps=16, seed=0):
    """Return what members with values near the prior show, with gaps and a few outliers."""
    rng = np.random.default_rng(seed)
    members, model = len(fleet), fleet.model
    times = [0.1 * k for k in range(steps + 1)]
    size = rng.uniform(0.7, 1.3, members)
    shown = []
    for k in range(members):

        def inputs(t, k=k):
            return dict.fromkeys(fleet.inputs, size[k] * np.sin(2.0 * t))

        q = model.latent.prior + 0.3 * model.latent.deviations * rng.standard_normal(model.Q.dim)
        states = truth(model, q, 0.0, times, inputs=inputs)
        shown.append([fleet.observed.G @ u for u in states])
    z = np.array(shown)
    z += 0.02 * rng.standard_normal(z.shape)
    z[rng.random(z.shape) < 0.1] = np.nan
    z[rng.random(z.shape) < 0.01] += 0.3
    z[1, 5] = np.nan
    found = []
    for k, t in enumerate(times[1:], 1):
        given = {name: size * np.sin(2.0 * t) for name in fleet.inputs}
        if given and k > 3:
            given["T_0"] = np.where(rng.random(members) < 0.1, np.nan, given["T_0"])
        found.append((t, z[:, k], given))
    return found


def assert_equal(estimate, others, tolerance=1e-8):
    """Assert that every number of the estimate equals that of separate identifiers."""
    for k, other in enumerate(others):
        one = estimate.member(k)
        pairs = [(estimate.q[k], other.q), (one.q, other.q), (one.u, other.u)]
        pairs += [(estimate.u[k], other.u), (estimate.innovation[k], other.innovation)]
        if other.q_std is not None:
            pairs += [(estimate.q_std[k], other.q_std), (one.u_std, other.u_std)]
        for mine, separate in pairs:
            np.testing.assert_allclose(mine, separate, rtol=tolerance, atol=tolerance)
        assert one.status.code == other.status.code
        assert (one.steps, one.held) == (other.steps, other.held)
        mine, theirs = one.diagnostics.named(), other.diagnostics.named()
        assert mine == pytest.approx(theirs, rel=1e-6, abs=1e-8)


def compare(model, law, stream=samples, members=4, sensors=SENSORS, **options):
    """Step a fleet and separate identifiers with the same samples, and compare them."""
    fleet = lp.Fleet(model, sensors, law, members, **options)

    def each(name, k):
        value = options.get(name)
        return value[k] if isinstance(value, list) else value

    separate = [
        lp.Identifier(model, sensors, law, **{**options, "q0": each("q0", k), "u0": each("u0", k)})
        for k in range(members)
    ]
    for t, z, inputs in stream(fleet):
        estimate = fleet.step(t, z, inputs)
        others = [
            one.step(t, z[k], {name: values[k] for name, values in inputs.items()})
            for k, one in enumerate(separate)
        ]
        assert_equal(estimate, others)
    for k, one in enumerate(separate):  # each verdict counts failed steps and gaps
        mine, own = fleet.identifier(k)._so_far, one._so_far
        assert mine.steps.counts.tolist() == own.steps.counts.tolist()
        for name in ("counts", "held", "unstated"):
            assert getattr(mine.gaps, name).tolist() == getattr(own.gaps, name).tolist()
    return fleet, estimate


# Each model and each law, in the pairs that go the farthest ways; more in test_identities.py.
PAIRS = [
    ("walks", "gate, noise"),
    ("layers", "usual"),
    ("logarithm", "jumps"),
    ("sources", "drift"),
    ("rod", "no guards, memory"),
    ("rod", "rank"),
    ("rod", "plain"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "law"), PAIRS)
def test_equals_separate_identifiers(model, law):
    fleet, _ = compare(MODELS[model](), LAWS[law], partial(samples, steps=11), members=3)
    assert fleet.together, fleet.note


@pytest.mark.long
def test_members_start_at_their_initial_values():
    starts = [{"alpha": 0.3 + 0.1 * k, "loss": 0.2} for k in range(4)]
    states = [0.0, 0.2, lambda x: x[0], 1.0]
    _, estimate = compare(rod(), LAWS["plain"], q0=starts, u0=states, assimilate_from=0.75)
    assert len(np.unique(estimate.q[:, 0])) == 4


@pytest.mark.long
def test_an_unknown_initial_state_learns_from_a_first_sample():
    model = lp.Model(
        lp.Field(line(16), ElementLineP1(), dirichlet={"right": 0.0}),
        {"a": lp.Normal(0.5, std=0.2), "u0": lp.Normal(0.0, std=1.0)},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
        initial=lambda q, v, x: q.u0 * v,
    )

    def stream(fleet):
        z = np.array([[0.9, 0.8, 0.7], [0.3, 0.35, np.nan], [np.nan] * 3, [0.1, 0.1, 0.1]])
        return [(0.1 * k, z * np.exp(-0.3 * k), {}) for k in range(8)]

    fleet, estimate = compare(model, LAWS["plain"], stream)
    assert fleet.together
    assert np.ptp(estimate.q[:, 1]) > 0.5


@pytest.mark.long
def test_a_bound_is_active_and_later_inactive():
    model = rod(BOUNDED)
    fleet, estimate = compare(model, law(), members=6)
    assert fleet.together
    alpha, _ = estimate.parameters["alpha"]
    assert np.isin(alpha, (0.45, 0.55)).any()
    assert ((alpha >= 0.45) & (alpha <= 0.55)).all()


@pytest.mark.long
def test_a_member_that_fails_does_not_disturb_the_others():
    """If its input overflows for some samples, its state is kept, and later it continues."""

    def stream(fleet):
        for k, (t, z, inputs) in enumerate(samples(fleet)):
            if k in (8, 9, 14):
                inputs = {**inputs, "T_0": inputs["T_0"].copy()}
                inputs["T_0"][2] = 1e308
            yield t, z, inputs

    for model, guards in ((rod(), None), (rod(), lp.laws.Guards()), (rod(BOUNDED), None)):
        fleet, estimate = compare(model, law(guards=guards), stream)
        assert fleet.together
        assert estimate.ok.all()
    fleet = lp.Fleet(rod(), SENSORS, LAWS["plain"], ["a", "b", "c", "d"])
    estimates = [fleet.step(*sample) for sample in stream(fleet)]
    assert estimates[8].ok.tolist() == [True, True, False, True]
    assert estimates[8].member("c").status.code == "not_finite"
    assert estimates[8].steps[2] == 0


class Singular(lp.GradientLaw):
    """Law that cannot solve samples with the value 9."""

    def step(self, work, state, interval):
        if interval.z1[0] == 9.0:
            raise np.linalg.LinAlgError("Singular matrix")
        return super().step(work, state, interval)


def test_a_law_that_fails_for_a_member_gives_it_a_status():
    fleet = lp.Fleet(rod(), SENSORS, Singular(), 2)
    inputs, good = {"T_0": 1.0, "ambient": 0.0}, [0.3, 0.2, 0.1]
    for k, (first, code) in enumerate([(0.3, "ok"), (9.0, "singular"), (1e200, "not_finite")]):
        found = fleet.step(0.1 * (k + 1), [good, [first, 0.2, 0.1]], inputs)
        assert [status.code for status in found.statuses] == ["ok", code]
    assert fleet.step(0.4, [good, good], inputs).ok.all()
    assert fleet.t.tolist() == [0.4, 0.4]


@pytest.mark.parametrize("law", [lp.SensitivityLaw(), Singular()], ids=["together", "apart"])
def test_inputs_that_give_no_finite_start_are_refused(law):
    fleet, z = lp.Fleet(rod(), SENSORS, law, ["a", "b"]), [[0.3, 0.2, 0.1]] * 2
    with pytest.raises(lp.errors.SampleError, match="member 'b' gets no finite initial state"):
        fleet.step(0.1, z, {"T_0": [0.0, 1.7e308], "ambient": 0.0})
    assert fleet.step(0.1, z, {"T_0": 0.0, "ambient": 0.0}).ok.all()


@pytest.mark.long
def test_other_laws_step_one_by_one_and_say_so():
    fleet, _ = compare(rod(), lp.GradientLaw())
    assert not fleet.together
    assert "GradientLaw" in fleet.note


def nonlinear():
    return lp.Model(
        lp.Field(line(16), ElementLineP1(), dirichlet={"left": lp.Channel("T_0"), "right": 0.0}),
        {"a": lp.Normal(0.5, std=0.2)},
        A=lambda q, u, v, x: q.a * (1 + u**2) * lp.dot(lp.grad(u), lp.grad(v)),
    )


def curved_in_inputs():
    return lp.Model(
        lp.Field(line(16), ElementLineP1(), dirichlet={"boundary": 0.0}),
        {"a": lp.Normal(0.5, std=0.2)},
        A=lambda q, u, v, x: q.a * lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, _: x.inputs["T_0"] ** 2,
        inputs=["T_0"],
    )


def moving_matrix():
    return lp.Model(
        lp.Field(line(16), ElementLineP1(), dirichlet={"boundary": 0.0}),
        {"a": lp.Normal(0.5, std=0.2)},
        A=lambda q, u, v, x: (1.0 + x.inputs["T_0"] ** 2) * q.a * lp.dot(lp.grad(u), lp.grad(v)),
        f=1.0,
        inputs=["T_0"],
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("build", "why"),
    [
        (nonlinear, "affine in its state"),
        (curved_in_inputs, "affine in its input"),
        (moving_matrix, "inputs other than linearly"),
    ],
)
def test_other_models_step_one_by_one_and_say_so(build, why):
    fleet, _ = compare(build(), LAWS["plain"], partial(samples, steps=8))
    assert why in fleet.note


@pytest.mark.long
def test_sensors_that_see_an_unknown_step_one_by_one():
    model = rod().with_unknowns({"offset": lp.Normal(0.0, std=0.1)})
    sensors = lp.Points(
        {"T_1": 0.3, "T_2": 0.5, "T_3": 0.8}, noise=0.02, direct={"T_1": lambda q, x: q.offset}
    )
    fleet, _ = compare(model, LAWS["plain"], sensors=sensors)
    assert "sensors" in fleet.note


@pytest.mark.slow
@pytest.mark.parametrize("cut", [0, 10])
def test_a_fleet_resumes_from_a_checkpoint_with_equal_numbers(cut, tmp_path):
    """Also before the first sample; test_shard.py tests any sample and other laws."""
    model, law = rod(), LAWS["usual"]
    fleet, other, strange = (lp.Fleet(model, SENSORS, law, ["a", end]) for end in "bbc")
    stream = samples(fleet, steps=20)
    for sample in stream[:cut]:
        fleet.step(*sample)
    fleet.save(tmp_path / "fleet.bin")
    other.load(tmp_path / "fleet.bin")
    for sample in stream[cut:]:
        fleet.step(*sample)
        other.step(*sample)
    assert fleet.dump() == other.dump()
    with pytest.raises(lp.errors.RunError, match="another members"):
        strange.load(tmp_path / "fleet.bin")


@pytest.mark.slow
def test_channels_by_name_and_validation_sensors():
    model, hidden = rod(), lp.Points({"T_4": 0.6})
    fleet = lp.Fleet(model, SENSORS, LAWS["plain"], 2, validation=hidden)
    one = lp.Identifier(model, SENSORS, LAWS["plain"], validation=hidden)
    row = {"T_1": 0.2, "T_2": 0.1, "T_4": 0.05, "T_0": 0.3, "ambient": 0.0}
    estimate = fleet.step(0.1, {**row, "T_1": [0.9, 0.2]})
    other = one.step(0.1, row)
    np.testing.assert_allclose(estimate.validation_error[1], other.validation_error, rtol=1e-9)
    np.testing.assert_allclose(estimate.innovation[1], other.innovation, rtol=1e-9)
    assert estimate.innovation[0, 0] == pytest.approx(estimate.innovation[1, 0] + 0.7)


def test_values_are_assigned_to_members_by_name():
    """They were once used in their order, so that members got the readings of others."""
    z = np.array([[0.1, 0.2, np.nan], [0.4, 0.5, 0.6]])
    rows = pd.DataFrame(z, ["north", "south"], ["T_1", "T_2", "T_3"]).loc[["south", "north"]]
    heated = pd.Series({"south": 1.0, "north": 0.5})
    plain = fleet_of_two().step(0.1, z, {"T_0": [0.5, 1.0], "ambient": 0.0})
    for readings, T_0 in (
        (rows, heated),
        ({name: rows[name] for name in rows}, dict(heated)),
        (
            {name: rows[name].rename_axis("member").to_xarray() for name in rows},
            heated.rename_axis("member").to_xarray(),
        ),
        (np.ma.masked_array(np.nan_to_num(z), np.isnan(z)), heated),
    ):
        named = fleet_of_two().step(0.1, readings, {"T_0": T_0, "ambient": 0.0})
        np.testing.assert_array_equal(named.q, plain.q)
        np.testing.assert_array_equal(named.innovation, plain.innovation)


def test_a_missing_input_leaves_the_value_among_the_readings():
    row = {"T_1": 0.2, "T_0": [0.1, np.nan], "ambient": 0.0}
    estimate = fleet_of_two().step(0.1, row, {"T_0": [np.nan, 0.3]})
    other = fleet_of_two().step(0.1, {"T_1": 0.2}, {"T_0": [0.1, 0.3], "ambient": 0.0})
    np.testing.assert_array_equal(estimate.innovation, other.innovation)


def test_a_gap_of_one_member_does_not_change_another():
    """Its covariance once had rows of zeros, and its intervals changed after a refit."""
    flux = lp.Scalar(lp.Normal(0.0, 0.5), evolution=lp.fem.Periodic(2.0, harmonics=2))
    model = heat(line(12), lp.LogNormal(0.3, 0.15), {"left": lp.Channel("T_0")})
    model = with_conditions(model, {"right": Flux("J")}, unknowns={"J": flux})
    sensors = lp.Points({"T_1": 0.3, "T_2": 0.55}, noise=0.02)
    fleet = lp.Fleet(model, sensors, lp.SensitivityLaw(), 2, u0=0.1)
    one = lp.Identifier(model, sensors, lp.SensitivityLaw(verdict=False), u0=0.1)
    for k, t in enumerate(0.2 * np.arange(6)):
        T_0 = 0.1 + 0.5 * np.sin(3.0 * t)
        both = fleet.step(t, {"T_1": 0.1, "T_0": [np.nan if k % 2 else T_0, T_0]})
        alone = one.step(t, {"T_1": 0.1, "T_0": T_0})
        np.testing.assert_allclose(both.q_std[1], alone.q_std, rtol=1e-9)


@pytest.mark.slow
def test_a_run_becomes_a_dataset_with_a_dimension_of_members():
    fleet = lp.Fleet(rod(), SENSORS, LAWS["plain"], ["north", "south"])
    result = fleet.run(samples(fleet, steps=6))
    data = result.to_xarray()
    assert dict(data.sizes) == {"member": 2, "time": 6, "sensor": 3, "validation": 0}
    assert data["alpha"].dims == ("member", "time")
    assert data["innovation"].dims == ("member", "time", "sensor")
    last = data.sel(member="south").isel(time=-1)
    value, std = result.last.parameters["alpha"]
    assert (float(last["alpha"]), float(last["alpha_std"])) == (value[1], std[1])
    assert data["alpha"].attrs["units"] == "m^2/s"
    assert (data["status"] == 0).all()


def fleet_of_two():
    return lp.Fleet(rod(), SENSORS, LAWS["plain"], ["north", "south"])


INPUTS = {"T_0": 0.1, "ambient": 0.0}


@pytest.mark.parametrize(
    ("sample", "error", "match"),
    [
        ((0.1, np.zeros((3, 3)), INPUTS), lp.errors.SampleError, r"z has shape \(3, 3\)"),
        ((0.1, [["a", 1, 2]] * 2, INPUTS), lp.errors.SampleError, "not a number"),
        ((0.1, [[0, 1, np.inf]] * 2, INPUTS), lp.errors.SampleError, "'T_3' of member 'north'"),
        ((np.nan, np.zeros((2, 3)), INPUTS), lp.errors.SampleError, "time t is nan"),
        ((0.1, {"T_9": 1.0}, INPUTS), lp.errors.SampleError, "unknown channel 'T_9'"),
        (
            (0.1, {"T_1": [1.0] * 3}, INPUTS),
            lp.errors.SampleError,
            r"channel 'T_1' has shape \(3,\)",
        ),
        ((0.1, np.zeros((2, 3)), {"T_9": 1.0}), lp.errors.SampleError, "unknown input 'T_9'"),
        ((0.1, {"T_1": {"north": 1.0}}, INPUTS), lp.errors.SampleError, "each of the members"),
        ((pd.Timestamp(0), np.zeros((2, 3)), INPUTS), lp.errors.SampleError, "time t is the date"),
        (
            (0.1, {"T_1": 0.1, "T_0": [0.1, 0.2]}, {"T_0": 0.1}),
            lp.errors.SampleError,
            "'T_0' of member 'south' is 0.2 among the readings and 0.1",
        ),
        ((-0.1, np.zeros((2, 3)), INPUTS), lp.errors.TimeOrderError, "not later"),
        (
            (0.1, np.zeros((2, 3)), {"T_0": [0.1, np.nan], "ambient": 0.0}),
            lp.errors.MissingInputError,
            "'T_0' of member 'south'",
        ),
    ],
)
def test_bad_samples_change_nothing(sample, error, match):
    fleet = fleet_of_two()
    with pytest.raises(error, match=match):
        fleet.step(*sample)
    fleet.step(0.1, np.zeros((2, 3)), INPUTS)
    assert fleet.t.tolist() == [0.1, 0.1]
    with pytest.raises(lp.errors.TimeOrderError, match="not later"):
        fleet.step(0.1, np.zeros((2, 3)), INPUTS)


def test_bad_members():
    with pytest.raises(lp.errors.ConfigurationError, match="at least one"):
        lp.Fleet(rod(), SENSORS, LAWS["plain"], 0)
    with pytest.raises(lp.errors.ConfigurationError, match="must differ"):
        lp.Fleet(rod(), SENSORS, LAWS["plain"], ["a", "a"])
    with pytest.raises(lp.errors.ConfigurationError, match="a list of 3 for 2 members"):
        lp.Fleet(rod(), SENSORS, LAWS["plain"], 2, u0=[0.0, 0.0, 0.0])
    with pytest.raises(lp.errors.ConfigurationError, match="got 'north'; expected their count"):
        lp.Fleet(rod(), SENSORS, LAWS["plain"], "north")
    fleet = fleet_of_two()
    estimate = fleet.step(0.1, np.zeros((2, 3)), INPUTS)
    for look in (fleet.identifier, estimate.member):
        for member in ("east", 2):
            with pytest.raises(lp.errors.ConfigurationError, match="it has north, south"):
                look(member)
    with pytest.raises(lp.errors.SampleError, match="no table as a whole"):
        fleet.run(pd.DataFrame())


def test_blocks_are_solved_separately_and_a_singular_one_fails_alone():
    rng = np.random.default_rng(0)
    n, blocks = 9, 6
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 2
    pattern = Pattern.from_entries(*np.nonzero(near), (n, n))
    data = rng.standard_normal((blocks, pattern.nnz))
    data[1] = 0.0
    data[3, 0] = np.nan
    right = rng.standard_normal((3, blocks, n))
    right[0, 4, 2] = np.inf
    solver = BandedBlocks(BandedSolver(pattern))
    x = solver.factorise(solver.band(data)).solve(right.copy())
    assert np.isnan(x[:, [1, 3, 4]]).all()
    for k in (0, 2, 5):
        dense = pattern.matrix(data[k]).toarray()
        np.testing.assert_allclose(x[:, k], np.linalg.solve(dense, right[:, k].T).T, rtol=1e-9)


@pytest.mark.slow
def test_lazy_estimates_are_those_of_their_sample(monkeypatch):
    kept, eager = (lp.Fleet(rod(), SENSORS, law(), 3) for _ in range(2))
    stream, calls, beliefs = samples(kept, 6), [], kept._engine.beliefs

    def counted(state):
        calls.append(state)
        return beliefs(state)

    monkeypatch.setattr(kept._engine, "beliefs", counted)
    later = [kept.step(*sample) for sample in stream]
    now = [(one.q, one.q_std, one.u) for one in (eager.step(*sample) for sample in stream)]
    assert not calls
    for estimate, numbers in zip(later, now, strict=True):
        for found, expected in zip((estimate.q, estimate.q_std, estimate.u), numbers, strict=True):
            np.testing.assert_array_equal(found, expected)
    assert len(calls) == len(stream)


@pytest.mark.parametrize("shift", [3.0, 0.5])
def test_symmetric_tridiagonal_blocks_are_solved_whether_definite_or_not(shift):
    rng = np.random.default_rng(1)
    n, blocks = 8, 3
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1
    pattern = Pattern.from_entries(*np.nonzero(near), (n, n))
    matrices = rng.standard_normal((blocks, n, n))
    matrices = (matrices + matrices.transpose(0, 2, 1)) / 4.0 + 3.0 * np.eye(n)
    matrices[1] += (shift - 3.0) * np.eye(n)
    matrices *= near
    assert (np.linalg.eigvalsh(matrices[1])[0] > 0.0) == (shift == 3.0)
    right = rng.standard_normal((2, blocks, n))
    data = matrices[:, *np.nonzero(near)]
    solver = BandedBlocks.of(BandedSolver(pattern), *data)
    assert solver.symmetric
    factor = solver.factorise(solver.band(data))
    assert (factor.symmetric is not None) == (shift == 3.0)
    x = factor.solve(right.copy())
    for k in range(blocks):
        wanted = np.linalg.solve(matrices[k], right[:, k].T).T
        np.testing.assert_allclose(x[:, k], wanted, rtol=1e-10)
    data[1, 3] = np.nan  # does not affect other blocks
    x = solver.factorise(solver.band(data)).solve(right.copy())
    assert np.isnan(x[:, 1]).all()
    for k in (0, 2):
        wanted = np.linalg.solve(matrices[k], right[:, k].T).T
        np.testing.assert_allclose(x[:, k], wanted, rtol=1e-10)
    data[1] = data[0]
    data[0, 1] += 1e-9
    assert not BandedBlocks.of(BandedSolver(pattern), *data).symmetric


@pytest.mark.long
@pytest.mark.parametrize("name", MODELS)
def test_results_equal_the_results_of_separate_runs(name):
    """Compares numbers, interval ends, shares of the prior, fields, correlations and notes."""
    model = MODELS[name]()
    law = lp.SensitivityLaw(gate=3.0, noise="auto", refit=lp.laws.Refit(start=4), verdict=False)
    fleet = lp.Fleet(model, SENSORS, law, 3, validation=lp.Points({"hidden": 0.4}))
    kept = FleetRecords(model, 4)
    results = [Result(model, fleet.observed, fleet.validation, 4) for _ in range(3)]
    for t, z, inputs in samples(fleet, 9):
        estimate = fleet.step(t, z, inputs)
        kept.add(estimate)
        for k, result in enumerate(results):
            result.add(estimate.member(k))
    assert kept.size > 0
    for k, result in enumerate(results):
        wanted = result.layout.dataset(list(result.records))
        assert wanted.sizes["snapshot"] == 3
        found = result.layout.dataset(list(kept.records(k)))
        xr.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)
    kept.clear()
    assert (kept.size, list(kept.records(0))) == (0, [])


@pytest.mark.parametrize("law", ["drift", "gate, noise"])
@pytest.mark.slow
def test_an_identifier_continues_from_the_state_of_a_member(law):
    fleet = lp.Fleet(rod(), SENSORS, LAWS[law], ["a", "b"])
    stream = samples(fleet, 24)
    for sample in stream[:12]:
        fleet.step(*sample)
    alone = fleet.identifier("b")
    assert alone.t == fleet.t[1]
    again = fleet.identifier(1)
    again.restore(alone.dump())
    for t, z, inputs in stream[12:]:
        estimate = fleet.step(t, z, inputs)
        given = {name: float(values[1]) for name, values in inputs.items()}
        one = alone.step(t, z[1], given)
        np.testing.assert_allclose(estimate.q[1], one.q, rtol=1e-9)
        np.testing.assert_allclose(estimate.u[1], one.u, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(one.q, again.step(t, z[1], given).q)


def test_an_identifier_of_a_member_without_samples_begins_as_the_member_does():
    """It has its own initial errors, and its own state on the shadow's mesh."""
    starts = [0.0, lambda x: np.sin(3.0 * np.pi * x[0])]
    errors = [(0.1,), (lambda x: 0.3 * x[0], lambda x: 0.2 * (1.0 - x[0]))]
    model, law = rod(), lp.SensitivityLaw()
    fleet = lp.Fleet(model, SENSORS, law, 2, u0=starts, u0_errors=errors)
    for k, (start, off) in enumerate(zip(starts, errors, strict=True)):
        one = lp.Identifier(model, SENSORS, law, u0=start, u0_errors=off)
        for who in (one, member := fleet.identifier(k)):
            for t, z, inputs in samples(fleet, steps=8):
                at = {name: np.broadcast_to(value, 2)[k] for name, value in inputs.items()}
                who.step(t, z[k], at)
        for name in ("q", "q_std", "u_std"):
            found, wanted = (getattr(who.estimate(), name) for who in (member, one))
            np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_a_member_that_is_taken_out_late_has_an_estimate():
    rod = lp.models.heat(lp.interval(0.0, 1.0, 10), lp.LogNormal(0.1, std=0.05))
    fleet = Fleet(rod, lp.Points({"a": 0.5}, noise=0.1), lp.SensitivityLaw(), 2, u0=0.0)
    for k in range(30):
        fleet.step(0.1 * (k + 1), np.zeros((2, 1)))
    assert fleet.identifier(0).estimate().verdict.level == "not judged"


@pytest.mark.long
def test_the_verdict_on_a_member_is_that_of_a_separate_run():
    model, law, members = rod(), lp.SensitivityLaw(), 2
    fleet = lp.Fleet(model, SENSORS, law, members)
    assert not fleet.verdict(0).judged  # before the first sample
    separate = [lp.Identifier(model, SENSORS, law) for _ in range(members)]
    for number, (t, z, inputs) in enumerate(samples(fleet, steps=50)):
        z[1, 1] += 0.3  # an offset of one sensor
        if number in (20, 21):  # gaps of a sensor and of an input
            z[0, 0] = np.nan
            inputs = {name: np.array([np.nan, values[1]]) for name, values in inputs.items()}
        noise = np.full_like(z, 0.02 + 0.01 * (number % 2))  # of each reading
        fleet.step(t, np.stack([z, noise], axis=-1), inputs)
        for k, one in enumerate(separate):
            pairs = np.stack([z[k], noise[k]], axis=-1)
            one.step(t, pairs, {name: values[k] for name, values in inputs.items()})
    levels = []
    for k, one in enumerate(separate):
        found, expected = fleet.verdict(k), one._settled(one.estimate()).verdict
        levels.append(found.level)
        assert found.level == expected.level
        assert [each.what for each in found.findings] == [each.what for each in expected.findings]
        assert found.errors is not None
        for mine, own in zip(found.errors.unknowns, expected.errors.unknowns, strict=True):
            assert (mine.low, mine.high) == pytest.approx((own.low, own.high), rel=1e-5)
    assert levels[1] != "trusted"


def test_a_member_without_its_first_samples_is_not_judged():
    law = lp.SensitivityLaw(refit=lp.laws.Refit(start=4, window=10))
    fleet = lp.Fleet(rod(), SENSORS, law, 2)
    for sample in samples(fleet, steps=40):
        fleet.step(*sample)
    verdict = fleet.verdict(0)
    assert verdict.level == "not judged"
    assert "no longer stored" in verdict.untested[0]
