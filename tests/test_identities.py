"""Identities of estimates that hold for all options, tested with random options."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import independent_kalman as kalman
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from skfem import ElementLineP1

import livepde as lp
from livepde.fleet import Fleet
from livepde.observation import Calibrated

CELLS = 5
PLACES = {"a": 0.3, "b": 0.55, "c": 0.9}
NOISE = 0.02
INPUT_NOISE = 0.05
WITHIN = 1000.0  # prior standard deviations: no bound is near
PRIOR = {"s": (0.5, 0.7), "c": (0.2, 0.5), "o": (0.0, 0.1)}
SCHEMES = {"euler": lp.ImplicitEuler(), "alexander": lp.Alexander2()}
MOTIONS = ("stays", "walks", "reverts")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Random options of one run."""

    seed: int
    count: int  # number of samples
    noise: str  # "sensors", "readings": one value per reading, or "some": for some readings
    gaps: str  # "none", "readings", "rows"
    inputs: str  # "all", or "gaps": missing values are held
    motion: str
    wild: str  # "no", "outlier", "jump"
    calibrated: str  # "no", "offset", "curve"
    multiplies: bool  # an unknown also multiplies the state, so that the model is nonlinear
    input_noise: bool
    between: tuple[str, str]  # of T_0 and of Q
    dt_max: float
    scheme: str
    halvings: int
    late: bool  # no sample at t0
    spin_up: bool  # the first readings are not assimilated
    jumps: bool
    gate: float
    guards: bool
    shadows: bool
    verdict: bool
    refit: int  # largest number of samples with a refit; 0: no refits

    @property
    def linear(self) -> bool:
        return not self.multiplies and self.calibrated != "curve"


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Units of state and time, and origin of time, which must not change the results."""

    state: float = 1.0
    time: float = 1.0
    origin: float = 0.0
    order: tuple[str, ...] = ("a", "b", "c")


PLAIN = Frame()


def options(**fixed: Any) -> st.SearchStrategy[Options]:
    drawn = {
        "seed": st.integers(0, 999),
        "count": st.integers(4, 7),
        "noise": st.sampled_from(["sensors", "readings", "some"]),
        "gaps": st.sampled_from(["none", "readings", "rows"]),
        "inputs": st.sampled_from(["all", "gaps"]),
        "motion": st.sampled_from(MOTIONS),
        "wild": st.sampled_from(["no", "outlier", "jump"]),
        "calibrated": st.sampled_from(["no", "offset", "curve"]),
        "multiplies": st.booleans(),
        "input_noise": st.booleans(),
        "between": st.tuples(*2 * [st.sampled_from(["line", "hold", "next"])]),
        "dt_max": st.sampled_from([np.inf, np.inf, 0.09]),
        "scheme": st.sampled_from(sorted(SCHEMES)),
        "halvings": st.sampled_from([0, 8]),
        "late": st.booleans(),
        "spin_up": st.booleans(),
        "jumps": st.booleans(),
        "gate": st.sampled_from([np.inf, 4.0]),
        "guards": st.booleans(),
        "shadows": st.booleans(),
        "verdict": st.booleans(),
        "refit": st.sampled_from([0, 0, 3, 64]),
    }
    drawn |= {name: st.just(value) for name, value in fixed.items()}
    return st.builds(Options, **drawn)


def check(strategy: st.SearchStrategy[Any], examples: int, function: Callable[..., None]) -> None:
    """Check a function with reproducible random options."""
    quiet = [HealthCheck.too_slow, HealthCheck.filter_too_much]
    using = settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=quiet,
    )
    using(given(strategy)(function))()


def drawn(few: int) -> Any:
    """Run a test with random options, and with ten times as many in studies."""
    counts = (
        pytest.param(few, marks=pytest.mark.slow),
        pytest.param(10 * few, marks=pytest.mark.study),
    )
    return pytest.mark.parametrize("examples", counts)


class Bare(lp.SensitivityLaw):
    """Law that reports the covariance of the filter without widening."""

    def factors(self, work: Any, x: Any) -> Any:
        return x.U, x.C


# --- one process ---------------------------------------------------------------------------------


@cache
def model(motion: str, calibrated: bool, multiplies: bool, frame: Frame) -> lp.Model:
    """Return the rod of `independent_kalman`, in the units of a frame."""
    size, rate = frame.state, 1.0 / frame.time
    evolution = {
        "stays": {},
        "walks": {"evolution": lp.RandomWalk(0.4 * np.sqrt(rate))},
        "reverts": {"evolution": lp.MeanReverting(0.8 / rate)},
    }[motion]
    unknowns = {name: lp.Scalar(lp.Normal(*PRIOR[name]), within=WITHIN) for name in "sc"}
    unknowns["s"] = lp.Scalar(lp.Normal(*PRIOR["s"]), **evolution, within=WITHIN)
    if calibrated:
        unknowns["o"] = lp.Scalar(lp.Normal(*PRIOR["o"]), within=WITHIN)
    A = [lambda q, _, v, x: -rate * size * (q.s + q.c * x[0]) * v]
    if multiplies:
        A.append(lambda q, u, v, x: 0.3 * rate * (q.c + q.s) * u * v)
    return lp.Model(
        lp.Field(
            lp.interval(0.0, 1.0, CELLS), ElementLineP1(), dirichlet={"left": lp.Channel("T_0")}
        ),
        unknowns,
        A=A,
        B=lambda u, v, x: rate * (0.3 * lp.dot(lp.grad(u), lp.grad(v)) + 0.4 * u * v),
        f=lambda x, _: rate * x.inputs["Q"] + 0.0 * x[0],
        inputs=["Q"],
    )


def observation(calibrated: str, frame: Frame) -> lp.observation.Observation:
    size, places = frame.state, {name: PLACES[name] for name in frame.order}
    noise = NOISE * size
    curve = 0.2 / size if calibrated == "curve" else 0.0
    if calibrated == "no":
        return lp.Points(places, noise=noise)
    return Calibrated(lp.Points(places), lambda y, q, x: y + size * q.o + curve * y**2, noise=noise)


def law(o: Options, kind: type[lp.SensitivityLaw] = lp.SensitivityLaw) -> lp.SensitivityLaw:
    return kind(
        refit=lp.laws.Refit(start=o.refit) if o.refit else None,
        jumps=lp.Jumps(settle=3) if o.jumps else None,
        gate=o.gate,
        gate_patience=2,
        guards=lp.laws.Guards() if o.guards else None,
        shadows=lp.laws.Shadows() if o.shadows else None,
        verdict=o.verdict,
        rank=40,
    )


def parts(
    o: Options, frame: Frame = PLAIN, kind: type[lp.SensitivityLaw] = lp.SensitivityLaw
) -> Any:
    """Return arguments of an identifier or a fleet."""
    found = model(o.motion, o.calibrated != "no", o.multiplies, frame)
    keywords = {
        "t0": frame.origin,
        "u0": 0.3 * frame.state,
        "scheme": SCHEMES[o.scheme],
        "dt_max": o.dt_max * frame.time,
        "halvings": o.halvings,
        "assimilate_from": frame.origin + (0.15 if o.spin_up else -1.0) * frame.time,
        "between": dict(zip(("T_0", "Q"), o.between, strict=True)),
        "input_noise": {"T_0": INPUT_NOISE * frame.state} if o.input_noise else None,
    }
    return (found, observation(o.calibrated, frame), law(o, kind)), keywords


def identifier(
    o: Options, frame: Frame = PLAIN, kind: type[lp.SensitivityLaw] = lp.SensitivityLaw
) -> lp.Identifier:
    positional, keywords = parts(o, frame, kind)
    return lp.Identifier(*positional, **keywords)


def rod(o: Options) -> kalman.Rod:
    return kalman.Rod(
        cells=CELLS,
        scheme=o.scheme,
        dt_max=o.dt_max,
        between=o.between,
        input_std=INPUT_NOISE if o.input_noise else 0.0,
    )


def sensors(o: Options) -> np.ndarray:
    """Return the matrix of the sensors for (u, s, c, offset)."""
    nodes = np.linspace(0.0, 1.0, CELLS + 1)
    hats = [np.interp(PLACES[name], nodes, e) for name in PLACES for e in np.eye(CELLS + 1)]
    offset = 0.0 if o.calibrated == "no" else 1.0
    return np.column_stack(
        [np.reshape(hats, (3, CELLS + 1)), np.zeros((3, 2)), np.full((3, 1), offset)]
    )


def times(o: Options, rng: np.random.Generator) -> np.ndarray:
    lengths = rng.uniform(0.08, 0.2, o.count)
    if o.gaps == "rows":  # missing rows
        lengths[rng.random(o.count) < 0.3] *= 3.0
    if not o.late:
        lengths[0] = 0.0
    return np.cumsum(lengths)


def opening(first: kalman.Inputs, t: float) -> kalman.Inputs:
    """Return the inputs at t0: the boundary value from u0, and the first known source."""
    return replace(first, T_0=0.3) if t > 0.0 else first


def shown(o: Options, rng: np.random.Generator) -> list[kalman.Row]:
    """Return readings of a rod with unknowns drawn from the prior, with held inputs filled in."""
    mean, std = np.array([PRIOR[name] for name in "sco"]).T
    state = np.append(np.full(CELLS + 1, 0.3), mean + std * rng.uniform(-1.5, 1.5, 3))
    found, t0, last = [], 0.0, None
    for k, t in enumerate(times(o, rng)):
        now = kalman.Inputs(T_0=0.3 + np.sin(3.0 * t), Q=np.cos(5.0 * t))
        if o.inputs == "gaps" and last is not None and rng.random() < 0.4:
            now = replace(now, T_0=last.T_0)
        last = last or opening(now, t)
        if t > t0:
            state = replace(rod(o), input_std=0.0).step(state, t0, t, last, now)
        if o.wild == "jump" and k == o.count // 2:
            state[CELLS + 1] += 5.0 * PRIOR["s"][1]
        z = sensors(o) @ state
        spread = np.where(rng.random(3) < 0.5, 0.25, 4.0) if o.noise != "sensors" else np.ones(3)
        z = z + (0.2 * z**2 if o.calibrated == "curve" else 0.0)
        z = z + NOISE * spread * rng.standard_normal(3)
        if o.wild == "outlier" and k == o.count // 2:
            z[1] += 40.0 * NOISE
        if o.gaps != "none":
            z[rng.random(3) < 0.3] = np.nan
        found.append(kalman.Row(t=float(t), inputs=now, z=z, std=NOISE * spread))
        t0, last = t, now
    return found


def sample(o: Options, rows: list[kalman.Row], k: int, frame: Frame = PLAIN) -> lp.Sample:
    """Return a row as a sample, without held inputs."""
    row, values = rows[k], {}
    for place, name in enumerate(PLACES):
        z, std = row.z[place] * frame.state, row.std[place] * frame.state
        own = o.noise == "readings" or (o.noise == "some" and row.std[place] > NOISE)
        values[name] = z if o.noise == "sensors" or not own else (z, std)
    inputs = {"T_0": row.inputs.T_0 * frame.state, "Q": row.inputs.Q * frame.state}
    if k and row.inputs.T_0 == rows[k - 1].inputs.T_0:
        del inputs["T_0"]
    z = {name: values[name] for name in frame.order}
    return lp.Sample(t=frame.origin + frame.time * row.t, z=z, inputs=inputs)


def samples(o: Options, frame: Frame = PLAIN, member: int = 0) -> list[lp.Sample]:
    rows = shown(o, np.random.default_rng([o.seed, member]))
    return [sample(o, rows, k, frame) for k in range(o.count)]


def stepped(who: lp.Identifier, taken: list[lp.Sample]) -> list[lp.Estimate]:
    return [who.step(one.t, one.z, one.inputs) for one in taken]


def numbers(estimate: lp.Estimate) -> list[np.ndarray]:
    return [estimate.q, estimate.q_std, estimate.u, estimate.u_std, estimate.innovation]


def close(one: lp.Estimate, other: lp.Estimate, size: float = 1.0, rtol: float = 1e-9) -> None:
    """Assert that estimates are equal; the second may have another unit of the state."""
    scales = (1.0, 1.0, size, size, size)
    assert one.status.code == other.status.code
    for a, b, scale in zip(numbers(one), numbers(other), scales, strict=True):
        np.testing.assert_allclose(a, b / scale, rtol=rtol, atol=rtol)


# --- identities -----------------------------------------------------------------------------------


@pytest.mark.slow
@drawn(2)
def test_a_run_that_is_restored_continues_to_the_bit(examples):
    def same(o: Options) -> None:
        taken, who, other = samples(o), identifier(o), identifier(o)
        for cut, one in enumerate(taken):
            if cut == o.count // 2:
                other.restore(who.dump())
            expected = who.step(one.t, one.z, one.inputs)
            if cut < o.count // 2:
                continue
            found = other.step(one.t, one.z, one.inputs)
            assert found.status == expected.status
            for a, b in zip(numbers(found), numbers(expected), strict=True):
                np.testing.assert_array_equal(a, b)
        assert other.dump() == who.dump()

    check(options(), examples, same)


@pytest.mark.slow
@drawn(4)
def test_a_forecast_is_the_next_prediction(examples):
    def same(o: Options) -> None:
        who, taken, last, bounded = identifier(o), samples(o), {}, False
        for one in taken:
            last = last | one.inputs
            expected = None if one.t == who.t else who.forecast([one.t], last)
            found = who.step(one.t, one.z, one.inputs)
            # A restart takes the sample again from another state; bounds hold for estimates, and
            # not for the filter, which keeps what lies beyond.
            beyond, bounded = bounded, found.diagnostics.bounded > 0.0
            if expected is None or beyond or found.diagnostics.restarted == 1.0:
                continue
            z = np.array([np.atleast_1d(one.z[name])[0] for name in PLACES])
            seen = np.isfinite(z)
            predicted = (z - found.innovation)[seen]
            np.testing.assert_allclose(predicted, expected.z[0, seen], rtol=1e-10, atol=1e-10)

    check(options(), examples, same)


@pytest.mark.slow
@drawn(4)
def test_the_last_smoothed_estimate_is_the_last_filtered_one(examples):
    def same(o: Options) -> None:
        assume(o.linear)
        result = identifier(o).run(samples(o))
        last, data = result.last, result.smoothed()
        assert last.status.ok
        for name in ("s", "c"):
            assert float(data[name][-1]) == pytest.approx(last[name].mean, rel=1e-8, abs=1e-8)
            assert float(data[f"{name}_std"][-1]) == pytest.approx(last[name].std, rel=1e-8)
        np.testing.assert_allclose(data["u"][-1], last.u, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(data["u_std"][-1], last.u_std, rtol=1e-8, atol=1e-8)

    # Guards replace an estimate that moves too far, so it is not the filter of all samples.
    check(options(multiplies=False, guards=False), examples, same)


@pytest.mark.slow
@drawn(4)
def test_a_member_of_a_fleet_is_a_single_identifier(examples):
    def same(o: Options) -> None:
        each = [samples(o, member=k) for k in range(2)]
        for one in each[1:]:  # all members of a fleet have equal times
            for k, item in enumerate(one):
                one[k] = replace(item, t=each[0][k].t)
        positional, keywords = parts(o)
        fleet, singles = Fleet(*positional, len(each), **keywords), [identifier(o) for _ in each]
        for k in range(o.count):
            z, inputs = {}, {}
            for name in PLACES:
                pairs = [one[k].z[name] for one in each]
                pairs = [p if isinstance(p, tuple) else (p, np.nan) for p in pairs]
                z[name], z[f"noise of {name}"] = map(list, zip(*pairs, strict=True))
            for name in ("T_0", "Q"):
                inputs[name] = [one[k].inputs.get(name, np.nan) for one in each]
            found = fleet.step(each[0][k].t, z, inputs)
            for m, who in enumerate(singles):
                one = each[m][k]
                close(found.member(m), who.step(one.t, one.z, one.inputs))

    check(options(verdict=False), examples, same)  # a fleet has no verdict


FRAMES = {
    "sensors": Frame(order=("c", "a", "b")),
    "units": Frame(state=1.8, time=60.0),
    "origin": Frame(origin=1000.0),
}


@pytest.mark.slow
@drawn(2)
@pytest.mark.parametrize("name", FRAMES)
def test_order_units_and_origin_change_nothing(name, examples):
    frame = FRAMES[name]
    order = [list(frame.order).index(sensor) for sensor in PLACES]

    def same(o: Options) -> None:
        one = stepped(identifier(o), samples(o))
        other = stepped(identifier(o, frame), samples(o, frame))
        for a, b in zip(one, other, strict=True):
            close(a, replace(b, innovation=b.innovation[order]), frame.state, rtol=1e-7)

    check(options(), examples, same)


LINEAR = {
    "multiplies": False,
    "motion": "stays",
    "halvings": 0,  # steps are not divided
    "gate": np.inf,
    "guards": False,
    "jumps": False,
    "shadows": False,
    "verdict": False,
}


def unread(o: Options, rows: list[kalman.Row]) -> list[kalman.Row]:
    """Return the rows with the error of a held line, which may be a sine of twice the length.

    It is no larger than inputs so far: half of their steepest change, the deviation of a sine.
    Filters of constant unknowns have none, since their refits have none.
    """
    found, seen, steepest, held = [], list[float](), 0.0, 0.0
    t0, last = 0.0, opening(rows[0].inputs, rows[0].t).T_0
    for k, row in enumerate(rows):
        length, missing = row.t - t0, k > 0 and row.inputs.T_0 == rows[k - 1].inputs.T_0
        uncertain = rod(o).between[0] == "line" and (o.motion != "stays" or o.input_noise)
        if missing and seen and uncertain:
            spread = (max(seen) - min(seen)) / np.sqrt(8.0)
            row = replace(row, unread=min(spread, steepest * (held + length)))
        held = held + length if missing else 0.0
        if length > 0.0:
            seen.append(row.inputs.T_0)
            steepest = max(steepest, abs(row.inputs.T_0 - last) / length)
        t0, last = row.t, row.inputs.T_0
        found.append(row)
    return found


def exact(o: Options) -> kalman.Filtered:
    """Return the results of the independent filter."""
    rows = shown(o, np.random.default_rng([o.seed, 0]))
    if o.noise != "readings":
        own = o.noise == "some"
        rows = [replace(r, std=np.where(own & (r.std > NOISE), r.std, NOISE)) for r in rows]
    if o.spin_up:
        rows = [replace(r, z=np.where(r.t < 0.15, np.nan, r.z)) for r in rows]
    rows = unread(o, rows)
    u = np.full(CELLS + 1, 0.3)
    mean, std = np.array([PRIOR[name] for name in "sco"]).T
    zero = np.zeros(CELLS + 1)
    start = kalman.Gaussian(mean=np.append(u, mean), cov=np.diag(np.append(zero, std**2)))
    return kalman.filtered(rod(o), rows, sensors(o), start, 0.0, opening(rows[0].inputs, rows[0].t))


def matches(mean: Any, std: Any, belief: kalman.Gaussian) -> None:
    np.testing.assert_allclose(mean, belief.mean[: len(mean)], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(std, belief.std[: len(mean)], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@drawn(16)
def test_filter_and_smoother_are_those_of_an_independent_code(examples):
    def same(o: Options) -> None:
        assume(o.linear)
        independent = exact(o)
        beliefs, all_told = independent.beliefs, kalman.smoothed(independent)
        result = identifier(o, kind=Bare).run(samples(o))
        estimates = stepped(identifier(o, kind=Bare), samples(o))
        for found, belief in zip(estimates, beliefs, strict=True):
            matches(np.append(found.u, found.q), np.append(found.u_std, found.q_std), belief)
        data = result.smoothed()
        for k, belief in enumerate(all_told):
            means = np.append(data["u"][k], [data["s"][k], data["c"][k]])
            stds = np.append(data["u_std"][k], [data["s_std"][k], data["c_std"][k]])
            matches(means, stds, belief)
        for found in (result.log_evidence, estimates[-1].diagnostics.log_evidence):
            np.testing.assert_allclose(found, independent.log_evidence, rtol=1e-9)

    check(options(**LINEAR), examples, same)
