"""Interface of update laws: problem, state, report, belief."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import numpy as np

from livepde.errors import LawError, LinearAlgebraError
from livepde.fem import Moment
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, nonfinite_allowed
from livepde.model import Model
from livepde.observation import Observed
from livepde.stepping import Advance, ImplicitEuler, Interval, Scheme, StepFailed
from livepde.verdict import Verdict

LARGEST = 1e150  # of a sum of squares: the product of two of them is finite
REMEDIES = {
    "ok": "",
    "not_converged": "Reduce `dt_max`, the gain or the damping.",
    "not_finite": "Check the sample, the bounds of the unknowns, and the gain.",
    "departed": "Check the model and the sensors. If such values are possible, increase the "
    "standard deviations of the priors, or set a number for `gain`.",
    "singular": "Check the model's forms at the current estimate, or reduce `dt_max`.",
}


@dataclass(frozen=True)
class Status:
    """Status of a step: success or the kind of failure.

    Attributes
    ----------
    code
        "ok", "not_converged", "not_finite", "singular" or "departed".
    detail
        Description of the failure; empty if the code is "ok".
    """

    code: str = "ok"
    detail: str = ""

    @property
    def ok(self) -> bool:
        """True if the step was taken and nothing is wrong."""
        return self.code == "ok"

    @property
    def taken(self) -> bool:
        """True if the sample was taken: unknowns that would have departed are held meanwhile."""
        return self.code in ("ok", "departed")

    @property
    def remedy(self) -> str:
        """Remedy for this status, as a sentence."""
        return REMEDIES[self.code]

    @classmethod
    def of(cls, failure: StepFailed) -> Status:
        return cls(failure.code, failure.detail)

    def __str__(self) -> str:
        return self.code if self.ok else f"{self.code}: {self.detail}. {self.remedy}"


class InitialReading(NamedTuple):
    """A reading that the initial state was made of.

    Attributes
    ----------
    weight
        How the initial state changes with it, shape (n,).
    noise
        Its standard deviation; NaN: that of the sensor or channel.
    """

    weight: Array
    noise: float = np.nan


@dataclass(frozen=True, eq=False)
class Problem:
    """An identification problem: the model and the sensors that observe its state.

    Attributes
    ----------
    model, observed, control
        The process, its sensors, and how steps are taken.
    input_noise
        Channel of the model -> standard deviation of its noise.
    initial_readings
        Channel -> its reading at the initial time, if the initial state was made of it.
    initial_errors
        Independent errors of the initial state itself, each one standard deviation, shape (errors,
        n).
    initial
        The initial state as it was given: a number, a function of x, coefficients, or a mapping.
    """

    model: Model
    observed: Observed
    control: Advance
    input_noise: Mapping[str, float] = field(default_factory=dict)
    initial_readings: Mapping[str, InitialReading] = field(default_factory=dict)
    initial_errors: Array = field(default_factory=lambda: np.zeros((0, 0)))
    initial: Any = None

    @property
    def initial_rank(self) -> int:
        """Number of independent errors of the initial state that are no errors of unknowns."""
        return len(self.initial_readings) + len(self.initial_errors)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of all input channels: those of the model, then those the sensors read."""
        return tuple(dict.fromkeys([*self.model.channels, *self.observed.observation.inputs]))

    def unread(self, interval: Interval) -> Interval:
        """Return an interval without the readings that the initial state was made of."""
        # The initial state holds these readings already: a second time they would count twice.
        used = [name in self.initial_readings for name in self.observed.names]
        return replace(interval, z1=np.where(used, np.nan, interval.z1)) if any(used) else interval

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        """Return the predicted readings for state u and latent parameter q."""
        return self.observed.predict(u, self.model.latent.value(q), moment)

    def linear_readings(self, interval: Interval, u: Array) -> Interval:
        """Return an interval with its inputs as they are taken, and readings as linear sensors'."""
        interval = interval.driven(self.control.held)
        z0 = self.observed.linearised(interval.z0, u)
        z1 = self.observed.linearised(interval.z1, u)
        return interval if z1 is interval.z1 else replace(interval, z0=z0, z1=z1)

    def physical(self, belief: Belief) -> Belief:
        """Return a belief of latent coefficients as one of the physical parameter."""
        latent = self.model.latent
        if latent.plain:
            return belief
        q, C, prior, rest = belief.q, belief.q_factor, belief.prior_factor, belief.rest
        return replace(
            belief,
            q=latent.value(q),
            q_factor=None if C is None else latent.tangent(q, C),
            prior_factor=None if prior is None else latent.tangent(q, prior),
            rest=None if rest is None or not rest.any() else latent.deviation(q, rest),
        )


@dataclass(frozen=True, kw_only=True)
class Fit:
    """A fit of all stored samples.

    Attributes
    ----------
    samples
        Samples with a reading that it used.
    cost
        Half the sum of squares of the residuals in use, in units of their noise, and of the
        unknowns, in prior standard deviations about the prior.
    passes
        Passes over these samples that all fits of the run so far have taken; a pass of the state
        alone counts as its share.
    readings, refused
        Readings of these samples, and those of them that were left out.
    converged
        False if the search did not end in a minimum, or in one that explains the samples.
    """

    samples: int
    cost: float
    passes: float
    readings: int
    refused: int
    converged: bool


class Deferred(NamedTuple):
    """Functions that compute belief and verdict when they are read; the numbers never change."""

    belief: Callable[[], Belief]
    verdict: Callable[[], Verdict]


@dataclass(frozen=True, eq=False)
class Belief:
    """Estimates of a law at one time, with their covariance.

    Attributes
    ----------
    q, u
        Coefficients of parameter and state, shapes (m,) and (n,).
    q_factor, u_factor
        Square roots of the covariances, q_factor @ q_factor.T, shapes (m, k) and (n, k); None for
        a law that has no covariance.
    prior_factor
        Square root of the covariance of q before the first sample, shape (m, k), its columns
        orthonormal in Q.
    rest
        Standard deviation of each coefficient of q in the modes that the law leaves out, which keep
        their prior: independent of q_factor, shape (m,). None: 0.
    """

    q: Array
    u: Array
    q_factor: Array | None = None
    u_factor: Array | None = None
    prior_factor: Array | None = None
    rest: Array | None = None

    @property
    def q_std(self) -> Array | None:
        """Standard deviation of each coefficient of q."""
        if self.q_factor is None:
            return None
        std = _deviation(self.q_factor)
        return std if self.rest is None else np.hypot(std, self.rest)

    @property
    def u_std(self) -> Array | None:
        """Standard deviation of each coefficient of u."""
        return None if self.u_factor is None else _deviation(self.u_factor)

    def deviation(self, rows: Any, part: slice) -> Array | None:
        """Return the standard deviation of rows @ q[part] for a matrix, such as of point values.

        Where a row has several entries the rest counts as if it were fully correlated.
        """
        if self.q_factor is None:
            return None
        std = _deviation(rows @ self.q_factor[part])
        return std if self.rest is None else np.hypot(std, abs(rows) @ self.rest[part])

    def left_out(self, rows: Any, part: slice) -> float:
        """Return the share of the modes that the law leaves out in the variance of rows @ q[part].

        Of the mean over the rows; 0 without a law that leaves out modes, or without variance.
        """
        std = self.deviation(rows, part)
        if std is None or self.rest is None:
            return 0.0
        variance = float(std @ std)
        rest = abs(rows) @ self.rest[part]
        return float(rest @ rest) / variance if variance > 0.0 else 0.0

    def left(self, rows: Any) -> Array:
        """Return the remaining share of the prior standard deviation of some coefficients of q.

        NaN without covariance.
        """
        if self.q_factor is None or self.prior_factor is None:
            return np.full(len(self.q[rows]), np.nan)
        before = np.linalg.norm(self.prior_factor[rows], axis=1)
        after = np.linalg.norm(self.q_factor[rows], axis=1)
        return np.asarray(after / np.where(before > 0.0, before, np.nan))

    def modes_left(self, part: Any) -> Array:
        """Return the remaining share of the prior standard deviation of modes of a part of q.

        The modes are those of the posterior relative to the prior, so that their shares do not
        depend on units: as many as the part has reduced coordinates, the least known first. None
        at all without covariance.
        """
        if self.q_factor is None or self.prior_factor is None:
            return np.zeros(0)
        # In coordinates in which the prior is N(0, I) the singular values are the remaining shares.
        axes, sizes, _ = np.linalg.svd(self.prior_factor[part], full_matrices=False)
        seen = sizes > 1e-12 * sizes.max(initial=0.0)
        reduced = (axes[:, seen].T @ self.q_factor[part]) / sizes[seen, None]
        return np.asarray(np.linalg.svd(reduced, compute_uv=False))


def _deviation(factor: Array) -> Array:
    return np.asarray(np.sqrt((factor**2).sum(axis=1)))


@dataclass(frozen=True, eq=False)
class Report:
    """Report of a step, in addition to the new state.

    Attributes
    ----------
    status
        Status of the step; unless ok, the state is the one before.
    predicted
        Value of each sensor as predicted before the sample was used, shape (sensors,); for a law
        without such a prediction, the output of its estimate.
    steps
        Substeps taken.
    diagnose
        Function that returns the diagnostics; it is called when they are first read.
    parts
        In how many parts the substeps were divided.
    """

    status: Status
    predicted: Array
    steps: int = 0
    diagnose: Callable[[], Diagnostics[float]] = Diagnostics
    parts: int = 1

    @cached_property
    def diagnostics(self) -> Diagnostics[float]:
        """Innovation statistics, safeguards, and other numbers of the law."""
        return self.diagnose()

    def updated(self, more: Diagnostics[float]) -> Report:
        """Return the report with all that other diagnostics know among its own."""
        return replace(self, diagnose=lambda: self.diagnostics.updated(more))


def finite(*arrays: Array | None) -> bool:
    """Return whether products of the squares of some arrays are finite; None counts as empty."""
    total = 0.0  # NaN with any of its terms, which a maximum need not be
    for a in arrays:
        total += 0.0 if a is None else float(np.vdot(a, a))
    return bool(total <= LARGEST)


def numerical(error: Exception) -> Status | None:
    """Return the status of a step that an operation on numbers has ended, None for other errors.

    Such operations raise `ArithmeticError` (overflow, a singular matrix), NumPy's `LinAlgError`,
    the `ValueError` of SciPy for arrays that are not finite, or the `RuntimeError` of SuperLU.
    """
    text = str(error).rstrip(".") or type(error).__name__
    if isinstance(error, StepFailed):
        return Status.of(error)
    if isinstance(error, LinearAlgebraError | np.linalg.LinAlgError | ZeroDivisionError):
        # A status has its remedy, which a solver words as "check the model's forms".
        return Status("singular", re.split(r"[:.] check", text, flags=re.IGNORECASE)[0])
    if isinstance(error, RuntimeError) and "singular" in text:
        return Status("singular", text)
    # SciPy says "array must not contain infs or NaNs".
    if isinstance(error, ArithmeticError) or (isinstance(error, ValueError) and "infs" in text):
        return Status("not_finite", text)
    return None


@dataclass(frozen=True, eq=False, kw_only=True)
class FixedInterval:
    """The samples of a run and its estimates, for a smoother.

    Attributes
    ----------
    opening
        The sample at the initial time as an interval without length, NaN where there is none.
    intervals
        From the initial time to the first sample that was taken later, and so on to the last.
    q
        Latent parameters estimated at the initial time and after each interval.
    jumps
        Numbers of the intervals in which unknowns may have jumped.
    fields
        Where the state is asked for: 0 at the initial time, k after the k-th interval.
    """

    opening: Interval
    intervals: Sequence[Interval]
    q: Sequence[Array]
    jumps: Collection[int]
    fields: Collection[int]


Work = TypeVar("Work")
State = TypeVar("State")


class Law(ABC, Generic[Work, State]):
    """An update law: a frozen configuration; the evolving part is an explicit state value.

    A law of your own is one class with these four methods. The state is a frozen dataclass of
    arrays and numbers: saving it is checkpointing. Identifiers share a law, and copies of an
    identifier share its work, maybe in threads: neither may change once it is made.

    Attributes
    ----------
    scheme
        Time scheme of an identifier that states none: the paper's, implicit Euler.
    graded_start
        True if steps at the start of a run are graded, as `Advance.start` says.
    """

    scheme: ClassVar[Scheme] = ImplicitEuler()
    graded_start: ClassVar[bool] = False

    @abstractmethod
    def prepare(self, problem: Problem) -> Work:
        """Return matrices, modes and stages, computed once. Raises `LawError`."""

    @abstractmethod
    def init(self, work: Work, q0: Array, u0: Array) -> State:
        """Return the state at the start, from coefficients q0 (m,) and u0 (n,)."""

    def start(self, work: Work, q0: Array, u0: Array, moment: Moment) -> State:
        """Return the state at the start of a run, at a moment; here that of `init`.

        For a law that knows how the initial state depends on the parameter (`Model.initial`).
        """
        return self.init(work, q0, u0)

    def begin(self, work: Work, state: State, interval: Interval) -> State:
        """Return the state after a sample at the initial time; here the same.

        `interval` has no length: it holds the sample and the inputs.
        """
        return state

    @abstractmethod
    def step(self, work: Work, state: State, interval: Interval) -> tuple[State, Report]:
        """Return the state at the end of the interval; the old one if the step failed."""

    def settled(self, work: Work, state: State) -> State:
        """Return the state after a fit of all stored samples; here the same state."""
        return state

    def final(self, work: Work, state: State, *, columns: bool = True) -> Deferred:
        """Return belief and verdict as `deferred`, for the end of a run; here the same.

        Parameters
        ----------
        columns
            Whether the verdict looks for errors of single columns of the data, which may take
            several times as long as the run.
        """
        return self.deferred(work, state)

    def live(self) -> Law[Work, State]:
        """Return the law for a run that waits for its source; here the same.

        If some steps of a law take long, the law returned moves that work into a thread.
        """
        return self

    def fit(self, work: Work, state: State) -> Fit | None:
        """Return the last fit of all stored samples, None for a law without."""
        return None

    def diagnosed(self, work: Work, state: State) -> Diagnostics[float]:
        """Return the diagnostics of the estimate between two samples."""
        return Diagnostics()

    def weighs_readings(self) -> bool:
        """Return whether a reading may have its own noise (`Interval.noise`); here not."""
        return False

    def reading_noise(self, work: Work, state: State) -> Array | None:
        """Return the standard deviation of the noise of each sensor; None if none is known."""
        return None

    def unsmoothed(self, work: Work) -> str:
        """Return why the law smooths nothing, empty if it has `smoothed`."""
        return f"{type(self).__name__} has no covariance that a smoother could follow"

    def smoothed(
        self, work: Work, before: State, after: State, data: FixedInterval
    ) -> Iterator[Belief]:
        """Iterate over beliefs given all samples of a run, from the last one to the initial time.

        Where the state is not asked for the belief has no coefficients of it.

        Parameters
        ----------
        before, after
            State before the first and after the last sample.
        """
        raise LawError(f"smoothed: {self.unsmoothed(work)}.")

    def stepped_alone(self, work: Work) -> str:
        """Return why the members of a fleet are stepped one by one; empty if as arrays.

        A law that steps them as arrays has `step_members` and `member_belief`.
        """
        return f"{type(self).__name__} steps one at a time"

    def finite(self, work: Work, state: State) -> bool:
        """Return whether the belief and its squares are finite; here the belief is computed.

        A law whose belief is not cheap overrides this by a test of the arrays behind it.
        """
        belief = self.belief(work, state)
        return finite(belief.q, belief.u, belief.q_factor, belief.u_factor)

    @abstractmethod
    def belief(self, work: Work, state: State) -> Belief:
        """Return estimates and, if the law has them, covariances."""

    def deferred(self, work: Work, state: State) -> Deferred:
        """Return belief and verdict, to be computed when an estimate is read.

        Here the belief is found at once, and innovations are not judged. Estimates are kept, and
        with them the data that such functions hold: a law overrides this where these data are not
        much larger than the belief itself and never change afterwards.
        """
        belief = self.belief(work, state)
        return Deferred(lambda: belief, self.unjudged)

    def unjudged(self) -> Verdict:
        """Return the verdict where no innovation is judged."""
        why = f"innovations: {type(self).__name__} does not test their size"
        return Verdict.of((), (why,), judged=False)


AnyLaw = Law[Any, Any]


@nonfinite_allowed()  # seen in the result
def stepped(
    law: Law[Work, State], work: Work, problem: Problem, before: State, interval: Interval
) -> tuple[State, Report]:
    """Return state and report after a sample; the state before it after a numerical failure.

    A numerical failure is an operation that raises, or a belief of the law that is not finite, be
    it only the squares of its numbers. A sample at the initial time is an interval without length.
    """
    try:
        if interval.t1 > interval.t0:
            state, report = law.step(work, before, interval)
        else:
            state, belief = law.begin(work, before, interval), law.belief(work, before)
            report = Report(Status(), problem.predict(belief.u, belief.q, interval.end))
        if not report.status.taken or law.finite(work, state):
            return state, report
        failure = Status("not_finite", "what the law believes after it is not finite")
    except Exception as error:
        found = numerical(error)
        if found is None:
            raise
        failure = found
    return before, Report(failure, np.full(problem.observed.size, np.nan))
