"""Replays in slices: what they cost a step, and that they end where whole ones do."""

from itertools import pairwise

import numpy as np
import pytest

import livepde as lp
from livepde.laws import replay_slices
from livepde.models import heat

MESH = lp.interval(0.0, 1.0, 12)
SENSORS = lp.Points([0.3, 0.7], noise=0.05)


def rod(**replay):
    model = heat(MESH, lp.Normal(0.05, 0.03))
    law = lp.SensitivityLaw(replay=lp.Replay(**replay))
    return lp.Identifier(model, SENSORS, law, u0=lambda x: 10.0 * np.sin(np.pi * x[0]))


def readings(count, alpha=0.09):
    """Readings of a rod whose ends stay as they are: the first mode decays."""
    rng, at = np.random.default_rng(0), np.array([0.3, 0.7])
    for t in 0.01 * np.arange(1, count + 1):
        decay = np.exp(-alpha * np.pi**2 * t)
        yield t, 10.0 * decay * np.sin(np.pi * at) + 0.05 * rng.standard_normal(2)


@pytest.fixture
def assimilated(monkeypatch):
    """Stored samples that replays have taken again so far, for each call."""
    taken, assimilate = [], replay_slices.assimilate

    def counted(*given):
        taken.append(1)
        return assimilate(*given)

    monkeypatch.setattr(replay_slices, "assimilate", counted)
    return taken


@pytest.mark.slow
def test_a_step_takes_no_more_stored_samples_again_than_a_slice(assimilated):
    identifier, counts = rod(slice=6, iterations=4), [0]
    for sample in readings(200):
        identifier.step(*sample)
        counts.append(len(assimilated))
    each = [b - a for a, b in pairwise(counts)]
    assert max(each) == 6
    assert sum(each) > 200


@pytest.mark.long
@pytest.mark.parametrize("apart", [1, 5])  # samples from one reading to the next
def test_where_a_replay_ends_does_not_depend_on_the_slices(apart):
    ends = {}
    for size in (3, 16, 1000):
        identifier, estimates = rod(slice=size, iterations=2), []
        for k, (t, z) in enumerate(readings(200 * apart), start=1):
            estimates.append(identifier.step(t, z if k % apart == 0 else z * np.nan))
        done = [k + 1 for k, e in enumerate(estimates) if not np.isnan(e.diagnostics.replay_left)]
        assert len(done) == 5  # due at 8, 16, 32, 64 and 128
        ends[size] = done[-1], estimates[-1]
    assert ends[3][0] > ends[16][0] > ends[1000][0] == 128 * apart
    for size in (3, 16):
        np.testing.assert_array_equal(ends[size][1].q, ends[1000][1].q)
        np.testing.assert_array_equal(ends[size][1].u, ends[1000][1].u)


@pytest.mark.slow
def test_a_run_ends_with_what_the_replay_under_way_finds():
    whole, sliced = rod(slice=1000, iterations=1), rod(slice=2, iterations=1)
    found, result = whole.run(readings(64)), sliced.run(readings(64))
    assert not np.array_equal(sliced.estimate().q, result.last.q)
    np.testing.assert_array_equal(result.last.q, found.last.q)
    data, wanted = result.to_xarray(), found.to_xarray()
    assert float(data["alpha"][-1]) == float(wanted["alpha"][-1])
    np.testing.assert_array_equal(data["u"][-1], wanted["u"][-1])
    sliced.step(1.0, [0.0, 0.0])  # it goes on from where it was


@pytest.mark.slow
def test_a_run_interrupted_within_a_replay_goes_on_to_the_bit():
    samples = list(readings(90))
    straight = rod(slice=3, iterations=2)
    for sample in samples:
        estimate = straight.step(*sample)
    first, second = (rod(slice=3, iterations=2) for _ in range(2))
    for sample in samples[:70]:
        first.step(*sample)
    assert first._state.replay.active[0]
    second.restore(first.dump())
    for sample in samples[70:]:
        resumed = second.step(*sample)
    np.testing.assert_array_equal(resumed.q, estimate.q)
    np.testing.assert_array_equal(resumed.u, estimate.u)


@pytest.mark.slow
def test_a_fleet_ends_as_its_members_do():
    law = lp.SensitivityLaw(replay=lp.Replay(slice=2, iterations=1))
    fleet = lp.Fleet(
        heat(MESH, lp.Normal(0.05, 0.03)),
        SENSORS,
        law,
        members=["a", "b"],
        u0=[lambda x: 10.0 * np.sin(np.pi * x[0])] * 2,
    )
    samples = list(readings(64))
    result = fleet.run([(t, np.array([z, z])) for t, z in samples])
    alone = rod(slice=2, iterations=1).run(samples)
    np.testing.assert_allclose(result.last.q[0], alone.last.q, rtol=1e-10)
    np.testing.assert_array_equal(result.last.q[0], result.last.q[1])
    assert float(result.to_xarray()["alpha"][1, -1]) == result.last.q[1, 0]


def test_a_slice_too_small_is_refused():
    with pytest.raises(lp.errors.LawError, match="slice"):
        lp.Replay(slice=4)
