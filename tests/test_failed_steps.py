"""If a step fails, the previous estimate is kept, and the next sample continues."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import livepde as lp
from livepde.errors import LinearAlgebraError, SampleError
from livepde.laws import numerical
from livepde.models import heat

LAWS = {"sensitivity": lp.SensitivityLaw(), "gradient": lp.GradientLaw()}


def rod(law: Any) -> lp.Identifier:
    ends = {"left": lp.Channel("left"), "right": 20.0}
    model = heat(lp.interval(0.0, 1.0, 8), lp.Normal(0.1, std=0.05), ends)
    return lp.Identifier(model, lp.Points({"a": 0.3, "b": 0.6}, noise=0.1), law, u0=20.0)


def sample(k: int) -> tuple[float, list[float], dict[str, float]]:
    return 0.1 * k, [20.0 + 0.02 * k, 20.0 + 0.01 * k], {"left": 20.0 + 5.0 * math.sin(k / 3)}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("place", ["input", "sensor"])
@pytest.mark.parametrize("value", [1e150, -1e308])
def test_a_value_that_overflows_is_a_status(law, place, value):
    who = rod(law)
    for k in range(4):
        who.step(*sample(k))
    t, z, inputs = sample(4)
    if place == "input":
        inputs = {"left": value}
    else:
        z = [value, z[1]]
    before = who.estimate()
    estimate = who.step(t, z, inputs)
    if not estimate.status.ok:
        assert estimate.status.remedy
        np.testing.assert_array_equal(estimate.q, before.q)
        np.testing.assert_array_equal(estimate.u, before.u)
    else:  # a gate has refused the value
        assert np.isfinite(np.vdot(estimate.u, estimate.u))
    for k in range(5, 8):
        estimate = who.step(*sample(k))
    assert estimate.status.ok
    assert np.isfinite(estimate.q).all()
    assert estimate.t == pytest.approx(0.7)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_a_first_sample_without_a_finite_state_is_refused(law):
    who = rod(law)
    t, z, _ = sample(0)
    with pytest.raises(SampleError, match=r"no finite initial state.*'left'"):
        who.step(t, z, {"left": 1e200})
    for k in range(1, 4):
        assert who.step(*sample(k)).status.ok


@dataclass(frozen=True)
class Failing(lp.SensitivityLaw):
    """Raises what it is told at a time, or believes what is not finite then."""

    error: Any = None

    def step(self, work, state, interval):
        new, report = super().step(work, state, interval)
        if interval.t1 != 0.5:
            return new, report
        if self.error is not None:
            raise self.error
        object.__setattr__(new.now, "C", np.full_like(new.now.C, np.nan))
        return new, report


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (np.linalg.LinAlgError("SVD did not converge"), "singular"),
        (LinearAlgebraError("The matrix is singular."), "singular"),
        (ZeroDivisionError("float division by zero"), "singular"),
        (RuntimeError("Factor is exactly singular"), "singular"),
        (OverflowError("math range error"), "not_finite"),
        (ValueError("array must not contain infs or NaNs"), "not_finite"),
        (None, "not_finite"),
    ],
)
def test_what_numbers_raise_is_a_failed_step(error, code):
    who, usual = rod(Failing(error=error)), rod(lp.SensitivityLaw())
    for k in range(9):
        estimate = who.step(*sample(k))
        assert estimate.status.code == (code if k == 5 else "ok")
        if k == 5:
            assert np.isnan(estimate.innovation).all()
            assert str(error or "not finite").rstrip(".") in estimate.status.detail
        else:
            usual_estimate = usual.step(*sample(k))
    np.testing.assert_array_equal(estimate.q, usual_estimate.q)


def test_what_is_wrong_in_a_program_is_raised():
    who = rod(Failing(error=TypeError("no number")))
    for k in range(5):
        who.step(*sample(k))
    with pytest.raises(TypeError, match="no number"):
        who.step(*sample(5))
    assert numerical(ValueError("operands could not be broadcast")) is None
    assert numerical(RuntimeError("no thread")) is None


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_a_step_of_no_length_to_speak_of_is_no_crash(law):
    who = rod(law)
    who.step(*sample(0))
    _, z, inputs = sample(1)
    estimate = who.step(5e-324, z, inputs)
    assert np.isfinite(estimate.q).all()
    for k in range(1, 4):
        estimate = who.step(*sample(k))
    assert estimate.status.ok


@dataclass(frozen=True)
class FailingAt(lp.SensitivityLaw):
    """Fails in the step that ends at a time."""

    at: float = 0.5

    def step(self, work, state, interval):
        if interval.t1 == self.at:
            raise LinearAlgebraError("as told")
        return super().step(work, state, interval)


def heated(kind: str, law: Any = FailingAt(), members: int = 0) -> Any:
    model = heat(
        lp.interval(0.0, 1.0, 8),
        lp.Normal(0.1, std=0.05),
        {"left": lp.Channel("left"), "right": 20.0},
    )
    sensors = lp.Points({"a": 0.3, "b": 0.6}, noise=0.1)
    options: dict[str, Any] = {"u0": 20.0, "between": {"left": kind}}
    if members:
        return lp.Fleet(model, sensors, law, members, **options)
    return lp.Identifier(model, sensors, law, **options)


def switched(k: int) -> tuple[float, list[float], dict[str, float]]:
    """Return a sample of a log of changes: `left` is read at the start and in the fifth row."""
    inputs = {0: {"left": 20.0}, 5: {"left": 30.0}}.get(k, {})
    return 0.1 * k, [math.nan, math.nan], inputs


@pytest.mark.parametrize("restart", [False, True])
def test_what_holds_is_kept_though_its_step_fails(restart: bool):
    who = heated("hold")
    for k in range(6):
        estimate = who.step(*switched(k))
    assert not estimate.status.ok
    if restart:
        other = heated("hold")
        other.restore(who.dump())
        who = other
    forecast = who.forecast([1.0, 40.0])["a"][-1]
    for k in range(6, 9):
        estimate = who.step(*switched(k))
        assert estimate.status.ok
        assert estimate.held == ()
    assert who.estimate().u.max() == pytest.approx(30.0)  # the boundary has its new value
    assert forecast == pytest.approx(27.0, abs=0.1)  # in the steady state, a line from 30 to 20


@pytest.mark.parametrize("kind", ["line", "next"])
def test_what_does_not_hold_is_said_to_be_missing_after_a_failed_step(kind: str):
    who = heated(kind)
    for k in range(6):
        who.step(*switched(k))
    estimate = who.step(*switched(6))
    assert estimate.held == ("left",)
    assert estimate.u.max() == pytest.approx(20.0)


def test_members_keep_what_holds_though_their_step_fails():
    fleet, alone = heated("hold", members=2), heated("hold")
    for k in range(9):
        t, z, inputs = switched(k)
        found, one = fleet.step(t, [z, z], inputs), alone.step(t, z, inputs)
    assert one.status.ok
    assert found.member(1).u == pytest.approx(one.u)
    assert fleet.identifier(0).step(0.9, [math.nan, math.nan]).u == pytest.approx(
        alone.step(0.9, [math.nan, math.nan]).u
    )


def test_a_singular_step_says_its_remedy_once():
    text = "The 3 by 3 matrix is singular: check the model's forms, or take a smaller time step."
    assert str(numerical(LinearAlgebraError(text))) == (
        "singular: The 3 by 3 matrix is singular. Check the model's forms at the current estimate, "
        "or reduce `dt_max`."
    )
