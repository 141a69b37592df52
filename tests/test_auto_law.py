"""A bank of sensitivity laws finds drift, prior scale and noise by itself, in any units."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from factories import driven_rod, readings

import livepde as lp
from livepde.cases import load
from livepde.cases.new_case import write_template
from livepde.laws import MemberReports
from livepde.laws.bank import GUESSED, PATIENCE, first_guess

pytestmark = pytest.mark.slow

POINTS = [0.25, 0.5, 0.75]
NOISE = 0.01


def rod(
    cells: int = 16,
    *,
    std: float = 0.2,
    u: float = 1.0,
    x: float = 1.0,
    t: float = 1.0,
    **unknown: Any,
) -> lp.Model:
    """Return a rod in units that are u, x and t times smaller."""
    unit = x**2 / t
    a = {"a": lp.Scalar(lp.Normal(0.2 * unit, std * unit), **unknown)}
    return driven_rod(a, lambda s: u * np.sin(3 * s / t), lp.interval(0.0, x, cells))


def samples(
    a: Any, count: int, seed: int = 0, noise: float = NOISE, dt: float = 0.05
) -> list[tuple[float, Any]]:
    return readings(rod(), lp.Points(POINTS), a, dt * np.arange(count + 1), noise, seed)


def build(
    law: Any = None, model: lp.Model | None = None, noise: float | None = NOISE, **options: Any
) -> lp.Identifier:
    points = options.pop("points", POINTS)
    observation = lp.Points(points, noise=noise)
    return lp.Identifier(model or rod(), observation, law or lp.AutoLaw(), u0=0.0, **options)


def run(identifier: lp.Identifier, stream: Any) -> list[lp.Estimate]:
    found = [identifier.step(t, z) for t, z in stream]
    assert all(estimate.status.ok for estimate in found)
    return found


def wandering(t: float) -> float:
    return 0.3 + 0.1 * np.sin(0.7 * t) + 0.05 * np.sin(1.9 * t)


def stays(t: float) -> float:
    return 0.3


def missed(found: list[lp.Estimate], a: Any) -> float:
    """Return the root mean square error over the second half."""
    late = found[len(found) // 2 :]
    return float(np.sqrt(np.mean([(e.parameters["a"][0] - a(e.t)) ** 2 for e in late])))


@cache
def moving() -> list[tuple[float, Any]]:
    return samples(wandering, 400)


@cache
def still() -> list[tuple[float, Any]]:
    return samples(stays, 250)


@cache
def bank_moving(noise: float | None = NOISE, count: int = 400) -> list[lp.Estimate]:
    """Return the estimates of the bank for the unknown that moves."""
    return run(build(noise=noise), moving()[:count])


@cache
def bank_still(noise: float | None = NOISE) -> list[lp.Estimate]:
    """Return the estimates of the bank for the unknown that stays."""
    return run(build(lp.AutoLaw(shadows=None), noise=noise), still())


# --- what it finds -------------------------------------------------------------------------------


@pytest.mark.study
def test_an_unknown_that_moves_is_followed_as_with_the_best_drift_in_hindsight():
    auto = bank_moving()
    # Where the unknown may not move a gate would refuse what shows that it does.
    hand = [
        missed(run(build(lp.SensitivityLaw(drift=drift, gate=np.inf)), moving()), wandering)
        for drift in (0.0, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
    ]
    assert missed(auto, wandering) <= 1.3 * min(hand)
    assert hand[0] > 4 * min(hand)
    assert auto[-1].diagnostics.drift > 1e-3


@pytest.mark.long
def test_an_unknown_that_stays_is_found_as_by_a_law_that_knows_it():
    auto = bank_still()
    known = run(build(lp.SensitivityLaw(replay=lp.Replay(), shadows=None)), still())
    (value, std), (expected, deviation) = (e[-1].parameters["a"] for e in (auto, known))
    assert abs(value - expected) <= 0.3 * deviation
    assert deviation <= 1.05 * std <= 3.0 * deviation
    assert auto[-1].diagnostics.drift < 1e-3


def test_members_that_are_not_needed_sleep():
    awake = [estimate.diagnostics.awake for estimate in bank_still()]
    assert awake[0] == 6
    assert np.mean(awake[150:]) <= 3.5
    assert min(awake) <= 2


@pytest.mark.long
def test_a_prior_that_is_too_narrow_is_widened():
    narrow = rod(std=0.01)  # the truth is ten deviations away
    auto, plain = run(build(model=narrow), still()[:120]), lp.SensitivityLaw(replay=lp.Replay())
    known = run(build(plain, narrow), still()[:120])
    assert auto[-1].diagnostics.prior_scale > 2.5
    assert abs(auto[-1].parameters["a"][0] - 0.3) < 0.7 * abs(known[-1].parameters["a"][0] - 0.3)


@pytest.mark.long
def test_the_stated_noise_is_raised_but_not_lowered():
    low, told, high = (bank_still(n)[-1] for n in (0.1 * NOISE, NOISE, 5 * NOISE))
    assert low.diagnostics.noise_level == pytest.approx(10.0, rel=0.1)
    assert high.diagnostics.noise_level == pytest.approx(1.0)
    (value, std), (expected, deviation) = low.parameters["a"], told.parameters["a"]
    assert abs(value - expected) <= deviation
    assert 0.5 * deviation <= std <= 2.0 * deviation
    assert high.parameters["a"][1] > 1.5 * deviation


@pytest.mark.long
def test_the_noise_need_not_be_stated():
    told, silent = (bank_still(noise) for noise in (NOISE, None))
    (value, std), (expected, deviation) = (e[-1].parameters["a"] for e in (silent, told))
    assert abs(value - expected) <= deviation
    assert std <= 2.0 * deviation
    # When a member wakes or sleeps depends on chance: what is alike is what is usual.
    stds = [[e.parameters["a"][1] for e in found[100:]] for found in (silent, told)]
    assert np.median(np.divide(*stds)) == pytest.approx(1.0, rel=0.1)
    prior = silent[GUESSED - 2].parameters["a"]
    assert prior[0] == 0.2
    assert prior[1] >= 0.2  # nothing is learned before there is a guess
    assert silent[GUESSED].parameters["a"][1] < 0.1


@pytest.mark.long
def test_a_jump_is_learned():
    def a(t: float) -> float:
        return 0.3 if t < 15.0 else 0.24

    found = run(build(lp.AutoLaw(shadows=None)), samples(a, 600))
    drifts = [estimate.diagnostics.drift for estimate in found]
    assert max(drifts[290:299]) < 3e-3 < max(drifts[299:329])
    value, std = found[340].parameters["a"]
    assert abs(value - 0.24) <= 3 * std <= 0.06
    value, std = found[-1].parameters["a"]  # and stays since
    assert abs(value - 0.24) <= 3 * std <= 0.005


def test_guesses_of_the_noise():
    rng = np.random.default_rng(0)
    z = np.array([1.0, 5.0]) + np.array([0.1, 2.0]) * rng.standard_normal((200, 2))
    np.testing.assert_allclose(first_guess(z), [0.1, 2.0], rtol=0.2)
    assert first_guess(z[:GUESSED]) is None
    z[:, 1] = 3.0
    assert first_guess(z[: PATIENCE - 1]) is None
    dead = first_guess(z)
    assert dead is not None
    assert dead[1] == dead[0]
    z[:, 0] = np.nan
    assert first_guess(z) is None


# --- what does not matter ------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("unit", "noise"),
    [({"u": 300.0}, NOISE), ({"u": 300.0}, None), ({"x": 0.07}, NOISE), ({"t": 3600.0}, None)],
)
def test_units_scale_out(unit: dict[str, float], noise: float | None):
    u, x, t = (unit.get(name, 1.0) for name in "uxt")
    stream = moving()[:60]
    points = [x * at for at in POINTS]
    scaled = build(None, rod(**unit), noise and u * noise, points=points)
    other = run(scaled, [(t * time, u * z) for time, z in stream])
    for mine, theirs in zip(bank_moving(noise, 60), other, strict=True):
        for k in range(2):
            ours, its = mine.parameters["a"][k], theirs.parameters["a"][k] * t / x**2
            assert its == pytest.approx(ours, rel=1e-6)
        assert np.nan_to_num(theirs.diagnostics.drift) * t == pytest.approx(
            np.nan_to_num(mine.diagnostics.drift), rel=1e-6, abs=1e-9
        )


@pytest.mark.study
@pytest.mark.parametrize("a", [stays, wandering])
def test_the_sampling_rate_hardly_matters(a: Any):
    slow = run(build(), samples(a, 300, dt=0.05))
    fast = run(build(noise=2**0.5 * NOISE), samples(a, 600, noise=2**0.5 * NOISE, dt=0.025))
    assert missed(fast, a) <= 1.3 * missed(slow, a) + 1e-3
    usual, deviation = (
        np.median([e.parameters["a"][1] for e in found[len(found) // 2 :]])
        for found in (slow, fast)
    )
    assert 0.5 * usual <= deviation <= 2.0 * usual
    assert missed([slow[-1], fast[-1]], lambda t: fast[-1].parameters["a"][0]) <= 3 * usual


@pytest.mark.study
def test_the_mesh_hardly_matters():
    coarse, fine = (run(build(model=rod(cells)), moving()) for cells in (32, 64))
    for one, two in zip(coarse[50:], fine[50:], strict=True):
        (value, std), (other, deviation) = one.parameters["a"], two.parameters["a"]
        assert abs(value - other) <= 0.02 * value
        assert deviation == pytest.approx(std, rel=0.1)


# --- the contract --------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("noise", [NOISE, None])
def test_it_keeps_the_contract_of_a_law(noise: float | None):
    lp.diagnostics.check_law(
        lp.AutoLaw(), lambda law: build(law, noise=noise), still()[:15]
    ).raise_if_failed()


@pytest.mark.long
@pytest.mark.parametrize("noise", [NOISE, None])
def test_a_resumed_run_gives_the_same_numbers(noise: float | None, tmp_path: Any):
    """Saved before, at and after a replay, and when members may sleep."""
    stops, first = (5, 45, 70), build(noise=noise)
    for begin, stop in pairwise((0, *stops)):
        run(first, still()[begin:stop])
        first.save(tmp_path / f"{stop}.bin")
    expected = run(build(noise=noise), still()[:90])[-1]
    for stop in stops:
        second = build(noise=noise)
        second.load(tmp_path / f"{stop}.bin")
        found = run(second, still()[stop:90])[-1]
        np.testing.assert_array_equal(found.q, expected.q)
        np.testing.assert_array_equal(found.u, expected.u)
        assert found.belief.q_factor is not None
        np.testing.assert_array_equal(found.belief.q_factor, expected.belief.q_factor)


@pytest.mark.long
def test_missing_samples_are_no_error():
    rng = np.random.default_rng(3)
    holes = [(t, np.where(rng.random(3) < 0.3, np.nan, z)) for t, z in still()]
    for noise in (NOISE, None):
        value, std = run(build(noise=noise), holes)[-1].parameters["a"]
        assert abs(value - 0.3) < 4 * std < 0.02


def test_a_member_that_fails_leaves_the_others_to_go_on(monkeypatch: pytest.MonkeyPatch):
    step = lp.SensitivityLaw.step_members

    def fails(self: Any, work: Any, state: Any, span: Any) -> Any:
        new, reports = step(self, work, state, span)
        drifts = work.filter.drifts(state.now.member) > 0.0
        if span.t1 <= 3.0 or not drifts.any():
            return new, reports
        status = lp.laws.Status("not_finite", "the prediction is not finite")
        failed = {int(k): lp.laws.Report(status, np.zeros(3)) for k in np.flatnonzero(drifts)}
        return new, reports.with_members(failed)

    monkeypatch.setattr(lp.SensitivityLaw, "step_members", fails)
    found = run(build(), still()[:100])
    assert found[-1].diagnostics.awake <= 2
    assert abs(found[-1].parameters["a"][0] - 0.3) < 0.01


def test_a_step_that_fails_for_all_changes_nothing(monkeypatch: pytest.MonkeyPatch):
    identifier = build()
    run(identifier, still()[:20])
    before = identifier.latent_belief().q

    def fails(self: Any, work: Any, state: Any, span: Any) -> Any:
        count = len(state)
        statuses = (lp.laws.Status("singular", "no factor"),) * count
        return state, MemberReports(statuses, np.zeros((count, 3)), np.zeros(count, dtype=int))

    with monkeypatch.context() as patched:
        patched.setattr(lp.SensitivityLaw, "step_members", fails)
        assert identifier.step(*still()[20]).status.code == "singular"
    np.testing.assert_array_equal(identifier.latent_belief().q, before)
    assert identifier.step(*still()[20]).status.ok


@pytest.mark.long
def test_an_unknown_with_an_evolution_of_its_own_keeps_it():
    found = run(build(model=rod(evolution=lp.RandomWalk(0.05))), moving()[:200])
    assert found[0].diagnostics.awake == 2
    assert missed(found, wandering) < 0.02


def test_what_makes_no_sense_is_refused():
    with pytest.raises(
        lp.errors.LawError, match=r"AutoLaw: noise must be a positive number; got -1"
    ):
        lp.AutoLaw(noise=-1.0)
    with pytest.raises(lp.errors.LawError, match="gate must be positive"):
        lp.AutoLaw(gate=0.0)
    with pytest.raises(lp.errors.LawError, match=r"got 'auto'\. The law finds the level by itself"):
        lp.AutoLaw(noise="auto")  # type: ignore[arg-type]
    with pytest.raises(lp.errors.LawError, match="replay must be a Replay; got True"):
        lp.AutoLaw(replay=True)  # type: ignore[arg-type]


def test_a_window_that_is_full_begins_anew():
    law = lp.AutoLaw(replay=lp.Replay(window=32))
    value, std = run(build(law), still()[:120])[-1].parameters["a"]
    assert abs(value - stays(0.0)) <= 3.0 * std <= 0.03


@pytest.mark.long
def test_the_first_interval_may_be_of_any_length():
    late, nothing = moving()[100:180], np.full(len(POINTS), np.nan)
    (value, std), *others = (
        run(build(dt_max=0.05), [*early, *late])[-1].parameters["a"]
        for early in ([(t, nothing) for t, _ in moving()[:100]], [], [(1e-6, nothing)])
    )
    for other, deviation in others:
        assert abs(other - value) <= 0.3 * std
        assert deviation == pytest.approx(std, rel=0.2)


@pytest.mark.long
@pytest.mark.parametrize("resolution", [0.02, 0.1])
def test_readings_of_a_coarse_resolution_tell_their_noise(resolution: float):
    coarse = [(t, np.round(z / resolution) * resolution) for t, z in still()[:200]]
    last = run(build(noise=None), coarse)[-1]
    value, std = last.parameters["a"]
    assert abs(value - stays(0.0)) <= 3.0 * std <= 0.1
    assert 0.1 <= last.diagnostics.noise_level <= 10.0


@pytest.mark.long
def test_a_slow_signal_of_coarse_resolution_starts_the_bank():
    steps = [(t, np.round(0.1 * t * np.ones(len(POINTS)), 1)) for t, _ in still()[: PATIENCE + 40]]
    assert run(build(noise=None), steps)[-1].diagnostics.noise_level > 0.0


@pytest.mark.long
def test_silence_is_not_stored():
    quiet = build(noise=None)
    run(quiet, [(0.05 * k, np.zeros(len(POINTS))) for k in range(1, 601)])
    assert quiet._state.waiting.shape[1] < 200


# --- in a case -----------------------------------------------------------------------------------


def _case(tmp_path: Any, law: str, noise: bool = True) -> Any:
    path, _ = write_template(tmp_path)
    text = path.read_text(encoding="utf-8")
    head, tail = text.partition("[law]")[0], text.partition("[steps]")[2]
    if not noise:
        head = head.replace(', noise = "0.05 K"', "")
    path.write_text(f"{head}[law]\n{law}\n[steps]{tail}", encoding="utf-8")
    return path


@pytest.mark.long
@pytest.mark.parametrize("noise", [True, False])
def test_a_case_says_auto(tmp_path: Any, noise: bool):
    case = load(_case(tmp_path, 'kind = "auto"', noise))
    assert case.law == lp.AutoLaw()
    prepared = case.prepare()
    result = prepared.identifier.run(prepared.stream)
    value = result.to_xarray()["alpha"].values[-1]
    assert 9e-5 <= value <= 1.05e-4


def test_keys_of_other_laws_are_errors_that_name_the_keys_of_this_one(tmp_path: Any):
    with pytest.raises(lp.errors.CaseError, match=r"law\.drift.*noise, modes|law\.drift"):
        load(_case(tmp_path, 'kind = "auto"\ndrift = 1.0'))
