"""The smoother agrees with dense least squares over all times, and has no side effects."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from commands import bad, call, cut
from factories import driven_rod, readings, short_rod
from skfem import ElementLineP1

import livepde as lp
from benchmarks.silent.exact_walk import mean_and_end
from livepde import checkpoint, runs
from livepde.runs import drive

NOISE = 0.02
MESH = lp.interval(0.0, 1.0, 6)
SENSORS = lp.Points({"a": 0.3, "b": 0.55, "c": 0.8}, noise=NOISE)
EVOLUTIONS = {"walk": lp.RandomWalk(0.4), "reverting": lp.MeanReverting(0.8)}


class Plain(lp.SensitivityLaw):
    """The law with the covariance of the filter itself."""

    def factors(self, work, x):
        return x.U, x.C


def sources(evolution):
    """Return a rod with two unknown sources, one of which moves: linear."""
    return lp.Model(
        lp.Field(MESH, ElementLineP1(), dirichlet={"left": lambda x, t: np.sin(t) + 0 * x[0]}),
        {"s": lp.Scalar(lp.Normal(0.5, 0.7), evolution=evolution), "c": lp.Normal(0.2, 0.5)},
        A=lambda q, u, v, x: -(q.s * (1 + x[0]) + q.c * x[0] ** 2) * v,
        B=lambda u, v, x: 0.3 * lp.dot(lp.grad(u), lp.grad(v)) + 0.4 * u * v,
    )


def irregular(count=30):
    """Return samples from time zero on; some values are missing, two samples whole."""
    rng = np.random.default_rng(0)
    times = np.cumsum(np.append(0.0, rng.uniform(0.05, 0.2, count)))
    z = np.outer(np.sin(times), [0.7, 0.5, 0.2]) + 0.2 * np.sin(3 * times)[:, None]
    z += NOISE * rng.standard_normal(z.shape)
    z[rng.random(z.shape) < 0.2] = np.nan
    z[10:12] = np.nan
    return list(zip(times.tolist(), z, strict=True))


def dense(model, samples):
    """Return means and deviations of (s, c) and of u at all samples, by least squares.

    The unknowns are s and c at the start, and for each interval mean and end of what s gains in it,
    as their Cholesky factor makes them of N(0, 1): the one stage of the scheme sees the mean.
    """
    n, count = model.X.dim, len(samples) - 1
    M, zero = model.mass.toarray(), np.zeros(n)
    B, A = model.form_B.matrix("v", "u", u=zero).toarray(), model.A(zero).matrix.toarray()
    free, evolution = model.X.free.astype(bool), model.latent.parts["s"].evolution
    G = SENSORS.matrix(model.state_space)
    G = G.toarray() if hasattr(G, "toarray") else G

    def path(theta):
        q = np.array([0.5 + 0.7 * theta[0], 0.2 + 0.5 * theta[1]])
        u, found = model.initial(0.0), []
        found.append(np.concatenate([q, u]))
        for k, ((t0, _), (t1, _)) in enumerate(pairwise(samples)):
            h = t1 - t0
            rate, gained = -evolution.generator[0, 0], evolution.growth(h, 0.7)[0]
            root = 0.7 * np.linalg.cholesky(mean_and_end(rate, h, gained))
            mean, end = root @ theta[2 + 2 * k : 4 + 2 * k]
            q = np.array([0.5 + evolution.transition(h)[0, 0] * (q[0] - 0.5), q[1]])
            S, load = M / h + B, M @ u / h - A @ (q + np.array([mean, 0.0]))
            q = q + np.array([end, 0.0])
            u = model.impose(np.zeros(n), lp.fem.Moment(t1))
            u[free] = np.linalg.solve(S[np.ix_(free, free)], (load - S @ u)[free])
            found.append(np.concatenate([q, u]))
        return np.array(found)

    here, whole = path(np.zeros(2 + 2 * count)), np.eye(2 + 2 * count)
    J = np.stack([path(row) - here for row in whole], axis=-1)
    z = np.array([z for _, z in samples])
    seen = np.isfinite(z)
    rows = np.vstack([(np.einsum("sj,tjp->tsp", G, J[:, 2:])[seen]) / NOISE, whole])
    right = np.append((z - here[:, 2:] @ G.T)[seen] / NOISE, np.zeros(len(whole)))
    theta = np.linalg.lstsq(rows, right, rcond=None)[0]
    covariance = np.linalg.inv(rows.T @ rows)
    deviations = np.sqrt(np.einsum("tip,pq,tiq->ti", J, covariance, J))
    return here + J @ theta, deviations


def compared(law, evolution, samples):
    model = sources(evolution)
    steps = {"scheme": lp.ImplicitEuler(), "halvings": 0}
    result = lp.Identifier(model, SENSORS, law, **steps).run(samples)
    data = result.smoothed()
    mean, std = dense(model, samples)
    found = (
        np.column_stack([data.s, data.c, data.u]),
        np.column_stack([data.s_std, data.c_std, data.u_std]),
    )
    columns = [0, 1, *(2 + np.argsort(MESH.p[0]))]
    return found, (mean[:, columns], std[:, columns])


@pytest.mark.slow
@pytest.mark.parametrize("name", EVOLUTIONS)
def test_smoothed_is_the_least_squares_solution_over_all_times(name):
    law = Plain(rank=9, gate=np.inf, refit=None)
    (mean, std), (exact, deviations) = compared(law, EVOLUTIONS[name], irregular())
    np.testing.assert_allclose(mean, exact, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(std, deviations, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_a_square_root_of_fewer_rows_is_as_good():
    """The default rank forgets directions of the state that hardly count."""
    samples = irregular()
    law = Plain(gate=np.inf, refit=None)
    (mean, std), (exact, deviations) = compared(law, EVOLUTIONS["walk"], samples)
    seen = deviations > 0.0
    assert np.abs((mean - exact)[seen] / deviations[seen]).max() < 0.01
    np.testing.assert_allclose(std[seen], deviations[seen], rtol=0.01)


# --- an unknown conductivity ---------------------------------------------------------------------

ROD = lp.interval(0.0, 1.0, 16)
TIMES = 0.1 * np.arange(101)


def conducting(evolution=None):
    """Return a rod with an unknown conductivity `a` whose left end swings."""
    moves = {} if evolution is None else {"evolution": evolution}
    a = lp.Scalar(lp.LogNormal(0.1, 0.05), **moves)
    return driven_rod({"a": a}, lambda t: np.sin(1.3 * t) + 0.5 * np.sin(3.1 * t), ROD)


def swinging(q, seed=0):
    """Return readings of the rod with the conductivity q(t)."""
    return readings(conducting(), SENSORS, lambda t: np.log(q(t)), TIMES, NOISE, seed)


def run(law=None, evolution=None, q=lambda t: 0.12, **options):
    chosen = law or lp.SensitivityLaw(shadows=None)
    identifier = lp.Identifier(conducting(evolution), SENSORS, chosen)
    return identifier.run(swinging(q), **options)


@pytest.mark.slow
def test_what_is_constant_has_one_value_at_all_times():
    result = run()
    data, smoothed = result.to_xarray(), result.smoothed()
    spread = float(smoothed.a_std[0])
    np.testing.assert_allclose(smoothed.a, smoothed.a[-1], rtol=1e-9)
    np.testing.assert_allclose(smoothed.a_std, spread, rtol=1e-9)
    # The run relinearised at each sample, the smoother is linear about the most probable value.
    assert abs(float(smoothed.a[-1] - data.a[-1])) < 0.1 * spread
    np.testing.assert_allclose(spread, data.a_std[-1], rtol=0.02)


@pytest.mark.long
def test_names_times_and_fields_are_those_of_the_run():
    result = run(lp.SensitivityLaw(), lp.RandomWalk(0.2), fields_every=50)
    data, smoothed = result.to_xarray(), result.smoothed()
    notes = {name for name in data.data_vars if str(name).endswith("_shift")}
    assert set(data.data_vars) - set(smoothed.data_vars) - notes <= {
        "innovation", "steps", "refused", "innovation_ratio", "innovation_correlation",
        "smoother_moved", "iterated", "tempered", "held", "bounded",
        "log_evidence", "estimates",  # which repeats the numbers of the others
    }  # fmt: skip
    for name in smoothed.data_vars:
        assert smoothed[name].sizes == data[name].sizes
        assert smoothed[name].attrs == data[name].attrs
    xr.testing.assert_equal(smoothed.time, data.time)
    xr.testing.assert_equal(smoothed.snapshot, data.snapshot)
    assert (smoothed.u_std <= 1.05 * data.u_std).all()
    assert float(smoothed.u_std.mean()) < 0.8 * float(data.u_std.mean())


@pytest.mark.long
def test_a_run_stays_as_it_is():
    identifier = lp.Identifier(conducting(), SENSORS, lp.SensitivityLaw())
    result = identifier.run(swinging(lambda t: 0.12))
    data, state = result.to_xarray(), identifier.dump()
    first = result.smoothed()
    xr.testing.assert_identical(result.to_xarray(), data)
    assert checkpoint.unpacked(identifier.dump(), "")[0] == checkpoint.unpacked(state, "")[0]
    assert identifier.dump() == state
    xr.testing.assert_identical(result.smoothed(), first)
    new = lp.Identifier(conducting(), SENSORS, lp.SensitivityLaw())
    xr.testing.assert_identical(new.smoothed(swinging(lambda t: 0.12)), first)
    assert new.t == 0.0


@pytest.mark.long
def test_a_jump_stays_a_jump():
    """Before and after its interval the unknown is what it was, as certain as all samples say."""
    result = run(lp.SensitivityLaw(jumps=lp.Jumps()), q=lambda t: 0.1 if t < 7.0 else 0.3)
    data, smoothed = result.to_xarray(), result.smoothed()
    ((alarm, onset),) = [
        (t, n) for t, n in zip(data.time.values, data.jump_samples.values, strict=True) if n > 0
    ]
    since = alarm - 0.1 * (onset - 0.5)
    assert abs(since - 7.0) < 0.3
    for part, exact in ((data.time < since, 0.1), (data.time > since + 0.1, 0.3)):
        values, stds = smoothed.a[part], smoothed.a_std[part]
        np.testing.assert_allclose(values, values[0], rtol=1e-8)
        np.testing.assert_allclose(stds, stds[0], rtol=1e-8)
        assert abs(float(values[0]) - exact) < 3.0 * float(stds[0])
    np.testing.assert_allclose(smoothed.a_std[-1], data.a_std[-1], rtol=0.05)


@pytest.mark.long
def test_steps_that_failed_repeat_the_last_that_was_taken():
    stream = swinging(lambda t: 0.12)[:20]
    identifier = lp.Identifier(conducting(lp.RandomWalk(0.2)), SENSORS, lp.SensitivityLaw())
    bad_one = (stream[10][0], np.full(3, 1e300))
    result = identifier.run([*stream[:10], bad_one, *stream[11:]])
    data, smoothed = result.to_xarray(), result.smoothed()
    np.testing.assert_array_equal(smoothed.status, data.status)
    assert np.isfinite(smoothed.a).all()


def test_no_samples_no_times():
    identifier = lp.Identifier(conducting(), SENSORS, lp.SensitivityLaw())
    assert identifier.smoothed([]).sizes["time"] == 0


@pytest.mark.slow
def test_what_cannot_be_smoothed_says_so_in_a_sentence():
    model, stream = conducting(), swinging(lambda t: 0.12)[:3]
    for law, match in (
        (lp.GradientLaw(), "GradientLaw has no covariance"),
        (lp.SensitivityLaw(memory=2.0), "memory= lets the past fade"),
    ):
        result = lp.Identifier(model, SENSORS, law).run(stream)
        with pytest.raises(lp.errors.LawError, match=match):
            result.smoothed()
    identifier = lp.Identifier(model, SENSORS, lp.SensitivityLaw())
    with pytest.raises(lp.errors.ConfigurationError, match="samples of this result are not known"):
        drive(identifier, [lp.Sample(*item) for item in stream]).result.smoothed()
    with pytest.raises(lp.errors.ConfigurationError, match="from its first sample on"):
        identifier.smoothed(stream)


# --- a case --------------------------------------------------------------------------------------


@pytest.fixture
def case(tmp_path, monkeypatch):
    """The case of `livepde init` with a smoother, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    path = short_rod(tmp_path / "rod")
    path.write_text(path.read_text() + "\n[output]\nsmoothed = true\n")
    return "rod/case.toml"


@pytest.mark.long
def test_a_case_writes_it_beside_the_run(case):
    assert call("run", case, "--out", "whole")[0] == 0
    whole = runs.open("whole").dataset
    names = whole.attrs["scalars"].split("\n")
    for name in (*names, "u"):
        assert whole[f"{name}_smoothed"].sizes == whole[name].sizes
        after, before = whole[f"{name}_smoothed_std"], whole[f"{name}_std"]
        assert float(after.mean()) < float(before.mean())
        np.testing.assert_allclose(after[-1], before[-1], rtol=0.1)
    cut("whole", "cut", 20)
    assert call("run", case, "--out", "cut", "--resume")[0] == 0
    xr.testing.assert_identical(runs.open("cut").dataset, whole)
    assert call("report", "whole")[0] == 0
    assert call("export", "whole", "whole.csv")[0] == 0


@pytest.mark.slow
def test_a_case_that_cannot_be_smoothed_is_refused(case):
    assert "lets the past fade" in bad("run", case, "--set", "law.memory='3 h'")
    assert not Path("runs").exists()
    assert "which retain does not keep" in bad("run", case, "--set", "output.retain='1 h'")
