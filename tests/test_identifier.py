"""The identifier: invalid input, held inputs, checkpoints and results."""

import numpy as np
import pytest
import xarray as xr
from factories import excited, excited_u, laplace, line, observe, truth
from skfem import ElementLineP1, ElementTriP1, MeshTri

import livepde as lp


def rod(**options):
    return lp.Model(
        lp.Field(
            line(10),
            ElementLineP1(),
            dirichlet={"left": 0.0, "right": lp.Channel("T_end")},
            unit="degC",
        ),
        {"k": lp.Scalar(lp.Normal(1.0, std=0.5, bounds=(0.1, 5.0)), unit="m^2/s")},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) - x.inputs["heat"] * v * 0,
        f=lambda x, _: x.inputs["heat"],
        inputs=("heat",),
        time_unit="s",
        **options,
    )


SENSORS = lp.Points({"a": 0.3, "b": 0.6}, noise=0.01, unit="degC")
HIDDEN = lp.Points({"c": 0.8}, unit="degC")


def identifier(**options):
    options = {"validation": HIDDEN, **options}
    return lp.Identifier(rod(), SENSORS, lp.SensitivityLaw(refit=lp.laws.Refit(start=4)), **options)


def sample(t=0.1, **changes):
    return t, {"a": 0.1, "b": 0.2, "c": 0.3, "T_end": 0.5, "heat": 1.0, **changes}


def frozen(ident):
    """Everything that must not change when a sample is refused."""
    return ident.t, ident._so_far.samples, ident._state


@pytest.mark.slow
@pytest.mark.parametrize(
    ("item", "error", "words"),
    [
        ((0.1, [1.0, 2.0, 3.0], {"heat": 1.0, "T_end": 0.0}), lp.errors.SampleError, "needs"),
        ((0.1, "warm", {"heat": 1.0, "T_end": 0.0}), lp.errors.SampleError, "number"),
        (
            (0.1, [1.0, np.inf], {"heat": 1.0, "T_end": 0.0}),
            lp.errors.SampleError,
            "'b' is infinite",
        ),
        ((*sample(a="warm"),), lp.errors.SampleError, "channel 'a': got 'warm'"),
        ((*sample(a=True),), lp.errors.SampleError, "channel 'a'"),
        ((*sample(heat=np.inf),), lp.errors.SampleError, "heat"),
        ((*sample(d=1.0),), lp.errors.SampleError, "unknown channel 'd'"),
        ((0.1, [1.0, 2.0], {"cold": 1.0}), lp.errors.SampleError, "unknown input 'cold'"),
        ((*sample(heat=np.nan),), lp.errors.MissingInputError, "'heat' has no value"),
        ((*sample(t=-1.0),), lp.errors.TimeOrderError, "before the initial time t0"),
        ((*sample(t=np.nan),), lp.errors.SampleError, "time"),
        ((*sample(t="noon"),), lp.errors.SampleError, "time"),
    ],
)
def test_a_bad_sample_is_one_sentence_and_changes_nothing(item, error, words):
    ident = identifier()
    before = frozen(ident)
    with pytest.raises(error, match=words):
        ident.step(*item)
    assert frozen(ident) == before
    assert ident.step(*sample()).status.ok


@pytest.mark.slow
def test_time_must_go_on():
    ident = identifier()
    ident.step(*sample(0.0))  # the start itself
    ident.step(*sample(0.1))
    before = frozen(ident)
    for t in (0.1, 0.05, 0.0):
        with pytest.raises(lp.errors.TimeOrderError, match="not later"):
            ident.step(*sample(t))
    assert frozen(ident) == before


@pytest.mark.slow
def test_nan_and_absent_are_missing_samples():
    one, two, three = (identifier() for _ in range(3))
    t, values = sample()
    first = one.step(t, {**values, "a": np.nan})
    second = two.step(t, {name: v for name, v in values.items() if name != "a"})
    third = three.step(t, {**values, "a": None})
    np.testing.assert_array_equal(first.q, second.q)
    np.testing.assert_array_equal(first.q, third.q)
    assert np.isnan(first.innovation[0])
    assert np.isfinite(first.innovation[1])


@pytest.mark.long
def test_validation_channels_are_scored_and_never_used():
    one, two = identifier(), identifier()
    for k in range(1, 5):
        first = one.step(*sample(0.1 * k, c=0.3))
        second = two.step(*sample(0.1 * k, c=99.0))
    np.testing.assert_array_equal(first.q, second.q)
    assert second.validation_error[0] - first.validation_error[0] == pytest.approx(98.7)


def test_configurations_that_do_not_fit():
    with pytest.raises(lp.errors.ConfigurationError, match="both assimilated and for validation"):
        identifier(validation=lp.Points({"a": 0.5}))
    with pytest.raises(lp.errors.ConfigurationError, match="dt_max"):
        identifier(dt_max=0.0)
    with pytest.raises(lp.errors.ConfigurationError, match="t0"):
        identifier(t0=np.nan)
    with pytest.raises(lp.errors.ModelError, match="bounds"):
        identifier(q0={"k": 100.0})
    with pytest.raises(lp.errors.MissingInputError, match="first sample"):
        identifier().estimate()


def cubic_decay(law, u0=1.0, **options):
    """Return an identifier of a nonlinear reaction, u_t + u^3 + q u = 0, seen in a part."""
    model = lp.Model(
        lp.Field(line(6), ElementLineP1(), quadrature=6),
        lp.Normal(1.0),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: u**3 * v,
    )
    return lp.Identifier(model, lp.Subdomain(lambda x: x[0] < 0.4), law, u0=u0, **options)


def limited(iterations):
    """Return a law that may not iterate often, with a linear pull: it has no other way."""
    newton = lp.stepping.Newton(iterations=iterations, tolerance=1e-3, share=0.0)
    return lp.GradientLaw(damping=lp.laws.ResidualDamping(0.0), newton=newton, gate=None)


@pytest.mark.slow
def test_a_failed_step_reports_and_the_stream_goes_on():
    """Newton is given one iteration for a nonlinear reaction, then enough."""
    ident = cubic_decay(limited(1), u0=3.0)
    z = np.full(ident.observed.size, 0.5)
    before = ident.estimate()
    estimate = ident.step(1.0, z)
    assert estimate.status.code == "not_converged"
    assert "dt_max" in estimate.status.remedy
    assert "not_converged" in str(estimate.status)
    np.testing.assert_array_equal(estimate.u, before.u)
    assert ident.t == 0.0
    good = cubic_decay(lp.GradientLaw())
    good._state = ident._state
    assert good.step(1.5, z).status.ok


@pytest.mark.slow
def test_a_stage_that_is_not_solved_is_halved_as_often_as_asked():
    """With two iterations short substeps can be solved, and long ones cannot."""
    z = np.full(3, 0.5)
    first = {}
    for halvings in (0, 1, 5, 8):
        ident = cubic_decay(limited(2), u0=3.0, halvings=halvings)
        before, first[halvings] = ident.estimate(), ident.step(0.1, z)
        if not first[halvings].status.ok:
            assert first[halvings].status.code == "not_converged"
            np.testing.assert_array_equal(first[halvings].u, before.u)
    assert not first[0].status.ok
    assert not first[1].status.ok
    assert first[8].steps > 2
    np.testing.assert_array_equal(first[5].u, first[8].u)
    assert cubic_decay(lp.GradientLaw()).problem.control.halvings == lp.Advance.halvings == 8


@pytest.mark.slow
def test_without_halvings_solved_steps_are_the_same():
    one, other = cubic_decay(lp.GradientLaw()), cubic_decay(lp.GradientLaw(), halvings=0)
    for k in range(1, 6):
        a, b = (ident.step(0.1 * k, np.full(3, 0.9**k)) for ident in (one, other))
        assert (a.steps, b.steps) == (1, 1)
        np.testing.assert_array_equal(a.u, b.u)
        np.testing.assert_array_equal(a.q, b.q)


@pytest.mark.parametrize("halvings", [-1, 1.5, "8", None, True, 31])
def test_halvings_that_cannot_be_meant(halvings):
    with pytest.raises(
        lp.errors.ConfigurationError, match="halvings must be a whole number from 0 to 30"
    ):
        cubic_decay(lp.GradientLaw(), halvings=halvings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [
        lp.GradientLaw(gain=100.0),
        lp.SensitivityLaw(modes=5, noise=0.01),
        lp.SensitivityLaw(modes=5, noise=0.01, refit=None),
    ],
)
def test_a_continued_run_is_bit_identical(law, tmp_path):
    model = excited(8)
    times = 0.1 * np.arange(25)
    q_true = model.initial_parameter(2.0)
    states = truth(model, q_true, lambda x: excited_u(x, 0.0), times)

    def build():
        return lp.Identifier(model, lp.Full(), law, q0=0.0, u0=lambda x: excited_u(x, 0.0))

    whole, first, second = build(), build(), build()
    G = whole.observed.G
    for k, t in enumerate(times[1:], start=1):
        expected = whole.step(t, G @ states[k])
        if k < 11:
            first.step(t, G @ states[k])
        elif k == 11:
            first.step(t, G @ states[k])
            first.save(tmp_path / "state.bin")
            second.load(tmp_path / "state.bin")
            assert second.t == first.t
        else:
            found = second.step(t, G @ states[k])
            np.testing.assert_array_equal(found.q, expected.q)
            np.testing.assert_array_equal(found.u, expected.u)


@pytest.mark.slow
def test_saved_before_the_first_sample(tmp_path):
    one, two = identifier(), identifier()
    one.save(tmp_path / "state.bin")
    two.load(tmp_path / "state.bin")
    np.testing.assert_array_equal(one.step(*sample()).q, two.step(*sample()).q)


@pytest.mark.slow
def test_a_checkpoint_of_an_earlier_format_is_refused(monkeypatch):
    ident = identifier()
    ident.step(*sample())
    content = ident.dump()
    monkeypatch.setattr("livepde.identifier.FORMAT", 99)
    with pytest.raises(lp.errors.RunError, match="another version of livepde, in another format"):
        identifier().restore(content)


@pytest.mark.slow
def test_checkpoints_that_cannot_be_used(tmp_path):
    ident = identifier()
    ident.step(*sample())
    path = tmp_path / "state.bin"
    ident.save(path)
    other = lp.Identifier(rod(), lp.Points({"d": 0.5}, noise=0.1), lp.SensitivityLaw())
    with pytest.raises(lp.errors.RunError, match="sensors"):
        other.load(path)
    (tmp_path / "text").write_text("no archive")
    with pytest.raises(lp.errors.RunError, match="damaged"):
        ident.load(tmp_path / "text")
    with pytest.raises(lp.errors.RunError, match="not a checkpoint"):
        ident.load(tmp_path / "nowhere")
    with pytest.raises(lp.errors.RunError, match="Cannot write"):
        ident.save(tmp_path / "no" / "folder" / "state.bin")


def stream(n=20):
    return [lp.Sample(*sample(0.1 * k, a=0.1 + 0.01 * k)) for k in range(n)]


@pytest.mark.long
def test_a_table_of_a_result():
    law = lp.SensitivityLaw(gate=np.inf)  # of the readings that are used
    result = lp.Identifier(rod(), SENSORS, law, validation=HIDDEN).run(stream())
    table = result.table()
    assert table["k"]["value"] == pytest.approx(float(result.last.q[0]))
    errors = result.to_xarray()["innovation"].sel(sensor="a").values
    assert table["innovation:a"]["rmse"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert table["validation_error:c"]["count"] == 20


def test_a_field_in_the_plane():
    mesh = MeshTri().refined(2)
    model = lp.Model(
        lp.Field(mesh, ElementTriP1(), dirichlet={"boundary": 0.0}),
        lp.Field(mesh, ElementTriP1(), inner="H1", name="q"),
        A=lambda q, u, v, x: q * u * v,
        B=laplace,
        f=1.0,
    )
    ident = lp.Identifier(model, lp.Full(), lp.GradientLaw())
    result = ident.run([(0.1 * k, np.zeros(ident.observed.size)) for k in range(1, 4)])
    data = result.to_xarray()
    assert data["q"].shape == (3, mesh.p.shape[1])
    np.testing.assert_array_equal(data["y"].values, mesh.p[1])
    assert "validation_error" not in data


@pytest.mark.long
def test_progress_is_silent_where_nobody_watches(capsys):
    identifier().run(stream(), progress=True)
    assert capsys.readouterr() == ("", "")


def test_substeps_are_those_made_by_hand():
    model = excited(8)
    z = np.zeros(observe(model, lp.Full()).size)
    law = lp.GradientLaw(newton=lp.stepping.Newton(tolerance=1e-12, share=0.0))
    divided = lp.Identifier(model, lp.Full(), law, q0=1.0, dt_max=0.1)
    estimate = divided.step(0.4, z)
    assert estimate.steps == 4
    by_hand = lp.Identifier(model, lp.Full(), law, q0=1.0)
    for k in range(1, 5):
        found = by_hand.step(0.1 * k, z)
    np.testing.assert_allclose(estimate.u, found.u, atol=1e-8)
    np.testing.assert_allclose(estimate.q, found.q, atol=1e-8)


@pytest.mark.long
def test_samples_of_other_tables():
    import pandas as pd

    twice = pd.Series([1.0, 2.0, 3.0], index=["a", "b", "b"])
    with pytest.raises(lp.errors.SampleError, match="two values of the sample have the same name"):
        identifier(validation=None).step(0.1, twice, {"heat": 1.0, "T_end": 0.0})
    _, named = sample()
    expected = identifier().step(0.1, named).u
    by_names = xr.Dataset({name: ((), value) for name, value in named.items()})
    assert np.array_equal(identifier().step(0.1, by_names).u, expected)
    plain, inputs = identifier(validation=None), {"heat": 1.0, "T_end": 0.5}
    by_order = identifier(validation=None).step(0.1, [0.1, 0.2], inputs).u
    assert np.array_equal(plain.step(0.1, xr.DataArray([0.1, 0.2]), inputs).u, by_order)


@pytest.mark.parametrize("kind", ["tuples", "two channels", "records"])
def test_a_stream_that_gives_no_samples(kind):
    import pandas as pd

    table = pd.DataFrame([{"t": t, **values} for t, values in (sample(0.1), sample(0.2))])
    streams = {"tuples": table.itertuples(), "records": table.to_dict("records")}
    streams["two channels"] = table[["a", "b"]].itertuples()
    with pytest.raises(lp.errors.SampleError, match=r"a stream gives \(t, z\).* run\(table\)"):
        identifier().run(streams[kind])


def test_numbers_where_something_else_is_expected():
    mesh = lp.interval(0.0, 1.0, 4)
    with pytest.raises(
        lp.errors.SpaceError, match=r"got 0\.5 as an unknown; write Normal\(0\.5, std\)"
    ):
        lp.Model(lp.Field(mesh, ElementLineP1()), {"k": 0.5}, A=lambda q, u, v, x: q.k * u * v)
    with pytest.raises(lp.errors.SpaceError, match=r"cells >= 1, whole"):
        lp.interval(0.0, 1.0, 2.5)
    with pytest.raises(
        lp.errors.SpaceError, match="got 'interpolate'; expected a number, or a function"
    ):
        identifier(u0="interpolate")
    with pytest.raises(
        lp.errors.ObservationError, match=r"noise: got \{'a': 0\.1\}; expected one number"
    ):
        lp.Identifier(rod(), lp.Points({"a": 0.3}, noise={"a": 0.1}), lp.SensitivityLaw())


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ((SENSORS, rod(), lp.SensitivityLaw()), "as model, got Points"),
        ((rod(), lp.SensitivityLaw(), SENSORS), "as observation, got Sensitivity"),
        ((rod(), SENSORS, lp.SensitivityLaw), "as law, got .*Law'>: call it"),
        ((rod(), SENSORS, "gradient"), "as law, got 'gradient'"),
    ],
)
def test_what_is_no_part_of_an_identifier_is_said(parts, words):
    with pytest.raises(lp.errors.ConfigurationError, match=words):
        lp.Identifier(*parts)
