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
from livepde.fem import Inputs, Moment
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, nonfinite_allowed
from livepde.model import Model
from livepde.observation import Observed
from livepde.stepping import Advance, ImplicitEuler, Interval, Scheme, StepFailed
from livepde.verdict import Verdict

LARGEST = 1e150  # largest sum of squares: the product of two such sums is finite
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
        """True if the step succeeded."""
        return self.code == "ok"

    @property
    def taken(self) -> bool:
        """True if the sample was used; with "departed", the unknowns are held meanwhile."""
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
    """A reading that was used for the initial state.

    Attributes
    ----------
    weight
        Derivative of the initial state with respect to the reading, shape (n,).
    noise
        Standard deviation of the reading; NaN: noise of the sensor or channel.
    """

    weight: Array
    noise: float = np.nan


@dataclass(frozen=True, eq=False)
class Problem:
    """An identification problem: the model and the sensors that observe its state.

    Attributes
    ----------
    model, observed, control
        The process, its sensors, and the control of the time steps.
    input_noise
        Channel of the model -> standard deviation of its noise.
    initial_readings
        Channel -> its reading at the initial time, if the initial state was computed from it.
    initial_errors
        Independent errors of the initial state, of one standard deviation each, shape (errors, n).
    initial
        The initial state from the user: a number, a function of x, coefficients, or a mapping.
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
        """Number of independent errors of the initial state, not including the unknowns."""
        return len(self.initial_readings) + len(self.initial_errors)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of all input channels: first of the model, then of the sensors."""
        return tuple(dict.fromkeys([*self.model.channels, *self.observed.observation.inputs]))

    def unread(self, interval: Interval) -> Interval:
        """Return an interval without the readings that were used for the initial state."""
        # Such readings must not count twice.
        used = [name in self.initial_readings for name in self.observed.names]
        return replace(interval, z1=np.where(used, np.nan, interval.z1)) if any(used) else interval

    def predict(self, u: Array, q: Array, moment: Moment) -> Array:
        """Return the predicted readings for state u and latent parameter q."""
        return self.observed.predict(u, self.model.latent.value(q), moment)

    def linear_readings(self, interval: Interval, u: Array) -> Interval:
        """Return an interval with inputs as the model uses them and linearised readings."""
        interval = interval.driven(self.control.held)
        z0 = self.observed.linearised(interval.z0, u)
        z1 = self.observed.linearised(interval.z1, u)
        return interval if z1 is interval.z1 else replace(interval, z0=z0, z1=z1)

    def physical(self, belief: Belief) -> Belief:
        """Return the belief about the physical parameter for one about latent coefficients."""
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
        Number of samples with a reading.
    cost
        Half the sum of squares of the residuals in use, in units of their noise, and of the
        unknowns, in prior standard deviations about the prior.
    passes
        Passes over these samples in all fits of the run so far. A pass without derivatives counts
        as a fraction.
    readings, refused
        Number of readings in these samples, and number of readings left out.
    converged
        True if the search ended in a minimum that explains the samples.
    """

    samples: int
    cost: float
    passes: float
    readings: int
    refused: int
    converged: bool


class Deferred(NamedTuple):
    """Functions that compute belief and verdict on demand; their results never change."""

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
        a law without covariance.
    prior_factor
        Square root of the covariance of q before the first sample, shape (m, k), with columns
        orthonormal in Q.
    rest
        Prior standard deviation of each coefficient of q in the modes that the law omits,
        independent of q_factor, shape (m,). None: 0.
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
        """Return the standard deviation of rows @ q[part] for a matrix, such as point values.

        For a row with several entries, `rest` is treated as fully correlated.
        """
        if self.q_factor is None:
            return None
        std = _deviation(rows @ self.q_factor[part])
        return std if self.rest is None else np.hypot(std, abs(rows) @ self.rest[part])

    def left_out(self, rows: Any, part: slice) -> float:
        """Return the share of omitted modes in the mean variance of rows @ q[part] over the rows.

        It is 0 if the law omits no modes or has no covariance.
        """
        std = self.deviation(rows, part)
        if std is None or self.rest is None:
            return 0.0
        variance = float(std @ std)
        rest = abs(rows) @ self.rest[part]
        return float(rest @ rest) / variance if variance > 0.0 else 0.0

    def left(self, rows: Any) -> Array:
        """Return the posterior over prior standard deviation of the coefficients q[rows].

        NaN without covariance.
        """
        if self.q_factor is None or self.prior_factor is None:
            return np.full(len(self.q[rows]), np.nan)
        before = np.linalg.norm(self.prior_factor[rows], axis=1)
        after = np.linalg.norm(self.q_factor[rows], axis=1)
        return np.asarray(after / np.where(before > 0.0, before, np.nan))

    def modes_left(self, part: Any) -> Array:
        """Return the posterior over prior standard deviation of the modes of a part of q.

        The modes are the principal axes of the posterior relative to the prior, so that the ratios
        do not depend on units. There is one mode for each reduced coordinate of the part, the most
        uncertain first. The result is empty without covariance.
        """
        if self.q_factor is None or self.prior_factor is None:
            return np.zeros(0)
        # In coordinates with the prior N(0, I), the singular values are these ratios.
        axes, sizes, _ = np.linalg.svd(self.prior_factor[part], full_matrices=False)
        seen = sizes > 1e-12 * sizes.max(initial=0.0)
        reduced = (axes[:, seen].T @ self.q_factor[part]) / sizes[seen, None]
        return np.asarray(np.linalg.svd(reduced, compute_uv=False))


def _deviation(factor: Array) -> Array:
    return np.asarray(np.sqrt((factor**2).sum(axis=1)))


@dataclass(frozen=True, eq=False)
class Report:
    """Report of a step, which accompanies the new state.

    Attributes
    ----------
    status
        Status of the step. After a failure, the state is the state before the step.
    predicted
        Value of each sensor as predicted before the sample was used, shape (sensors,); for a law
        without such a prediction, the output of its estimate.
    steps
        Number of substeps.
    diagnose
        Function that returns the diagnostics; called when they are first read.
    parts
        Number of parts into which the substeps were divided.
    """

    status: Status
    predicted: Array
    steps: int = 0
    diagnose: Callable[[], Diagnostics[float]] = Diagnostics
    parts: int = 1

    @cached_property
    def diagnostics(self) -> Diagnostics[float]:
        """Innovation statistics, actions of safeguards, and other numbers of the law."""
        return self.diagnose()

    def updated(self, more: Diagnostics[float]) -> Report:
        """Return the report with the known values of `more` in its diagnostics."""
        return replace(self, diagnose=lambda: self.diagnostics.updated(more))


def finite(*arrays: Array | None) -> bool:
    """Return True if products of the squares of arrays are finite; None counts as empty."""
    total = 0.0  # a sum propagates NaN, a maximum may not
    for a in arrays:
        total += 0.0 if a is None else float(np.vdot(a, a))
    return bool(total <= LARGEST)


def numerical(error: Exception) -> Status | None:
    """Return the status of a step that failed with a numerical error; None for other errors.

    Numerical errors are `ArithmeticError` (overflow, a singular matrix), NumPy's `LinAlgError`,
    the `ValueError` of SciPy for nonfinite arrays, and the `RuntimeError` of SuperLU.
    """
    text = str(error).rstrip(".") or type(error).__name__
    if isinstance(error, StepFailed):
        return Status.of(error)
    if isinstance(error, LinearAlgebraError | np.linalg.LinAlgError | ZeroDivisionError):
        # The remedy of the status replaces the solver's: "check the model's forms".
        return Status("singular", re.split(r"[:.] check", text, flags=re.IGNORECASE)[0])
    if isinstance(error, RuntimeError) and "singular" in text:
        return Status("singular", text)
    # SciPy's message is "array must not contain infs or NaNs".
    if isinstance(error, ArithmeticError) or (isinstance(error, ValueError) and "infs" in text):
        return Status("not_finite", text)
    return None


@dataclass(frozen=True, eq=False, kw_only=True)
class FixedInterval:
    """The samples of a run and its estimates, for a smoother.

    Attributes
    ----------
    opening
        The sample at the initial time as an interval of length zero; NaN where missing.
    intervals
        The intervals between samples that were used, beginning at the initial time.
    q
        Latent parameters estimated at the initial time and after each interval.
    jumps
        Indices of the intervals at whose starts unknowns may have jumped, and the share of the
        variance of a jump there; shares of several jumps add up.
    fields
        Times at which the state is requested: 0 is the initial time, k the end of interval k.
    """

    opening: Interval
    intervals: Sequence[Interval]
    q: Sequence[Array]
    jumps: Mapping[int, float]
    fields: Collection[int]


Work = TypeVar("Work")
State = TypeVar("State")


class Law(ABC, Generic[Work, State]):
    """An update law (estimator): a frozen configuration with an explicit state.

    To define your own law, implement the four abstract methods in a subclass. The state is a frozen
    dataclass of arrays and numbers: a checkpoint stores it. Identifiers share a law, and copies of
    an identifier share its work, possibly in threads. Both must be immutable.

    Attributes
    ----------
    scheme
        Default time scheme of an identifier: implicit Euler, as in the paper.
    graded_start
        True if steps at the start of a run are graded, see `Advance.start`.
    """

    scheme: ClassVar[Scheme] = ImplicitEuler()
    graded_start: ClassVar[bool] = False

    @abstractmethod
    def prepare(self, problem: Problem) -> Work:
        """Return matrices, modes and stages, which are computed once. Raises `LawError`."""

    @abstractmethod
    def init(self, work: Work, q0: Array, u0: Array) -> State:
        """Return the state at the start, from coefficients q0 (m,) and u0 (n,)."""

    def start(self, work: Work, q0: Array, u0: Array, moment: Moment) -> State:
        """Return the state at the start of a run; default: the result of `init`.

        Override this if the law uses how the initial state depends on the parameter
        (`Model.initial`).
        """
        return self.init(work, q0, u0)

    def begin(self, work: Work, state: State, interval: Interval) -> State:
        """Return the state after a sample at the initial time; default: the state unchanged.

        `interval` has the length zero and contains the sample and the inputs.
        """
        return state

    @abstractmethod
    def step(self, work: Work, state: State, interval: Interval) -> tuple[State, Report]:
        """Return the state at the end of the interval, or the old state if the step failed."""

    def settled(self, work: Work, state: State) -> State:
        """Return the state after a fit of all stored samples; default: the state unchanged."""
        return state

    def final(self, work: Work, state: State, *, columns: bool = True) -> Deferred:
        """Return belief and verdict at the end of a run; default: the result of `deferred`.

        Parameters
        ----------
        columns
            True if the verdict tests for errors of single columns of the data, which may take
            several times as long as the run.
        """
        return self.deferred(work, state)

    def live(self) -> Law[Work, State]:
        """Return the law for a run that waits for its source; default: this law.

        A law with some slow steps returns a law that moves this work into a thread.
        """
        return self

    def fit(self, work: Work, state: State) -> Fit | None:
        """Return the last fit of all stored samples; None if there is no fit."""
        return None

    def diagnosed(self, work: Work, state: State) -> Diagnostics[float]:
        """Return the diagnostics of the estimate between two samples."""
        return Diagnostics()

    def weighs_readings(self) -> bool:
        """Return True if a reading may have its own noise (`Interval.noise`); default: False."""
        return False

    def reading_noise(self, work: Work, state: State) -> Array | None:
        """Return the standard deviation of the noise of each sensor, or None if unknown."""
        return None

    def unsmoothed(self, work: Work) -> str:
        """Return the reason why the law has no smoother; empty if it implements `smoothed`."""
        return f"{type(self).__name__} has no covariance that a smoother could follow"

    def smoothed(
        self, work: Work, before: State, after: State, data: FixedInterval
    ) -> Iterator[Belief]:
        """Iterate over beliefs given all samples of a run, backwards in time.

        The belief includes the state only at the times in `data.fields`.

        Parameters
        ----------
        before, after
            State before the first and after the last sample.
        """
        raise LawError(f"smoothed: {self.unsmoothed(work)}.")

    def stepped_alone(self, work: Work) -> str:
        """Return the reason why members of a fleet are stepped separately; empty if as arrays.

        A law that steps members as arrays implements `step_members` and `member_belief`.
        """
        return f"{type(self).__name__} steps one at a time"

    def for_fleet(self) -> Law[Work, State]:
        """Return the law that steps the members of a fleet; default: this law.

        A law whose verdict costs more than its step leaves it out, and implements `reassessed`.
        """
        return self

    def work_from(self, work: Work, problem: Problem) -> Work:
        """Return the prepared data for another initial state; default: `work` itself.

        `problem` differs from that of `work` only in `Problem.initial` and the errors of the
        initial state.
        """
        return work

    def reassessed(
        self, problem: Problem, state: State, t0: float, start: Callable[[Work, Inputs], State]
    ) -> tuple[Work, State] | Verdict:
        """Process the stored samples of a member of a fleet again, for its verdict.

        Return work and state after them, or a verdict that states why they cannot be assessed. The
        default is the verdict of a law without tests.

        Parameters
        ----------
        state
            State of the law that `for_fleet` returned.
        t0, start
            Initial time, and a function that returns the state there.
        """
        return self.unjudged()

    def finite(self, work: Work, state: State) -> bool:
        """Return True if the belief and its squares are finite.

        The default computes the belief. A law with an expensive belief should override this.
        """
        belief = self.belief(work, state)
        return finite(belief.q, belief.u, belief.q_factor, belief.u_factor)

    @abstractmethod
    def belief(self, work: Work, state: State) -> Belief:
        """Return estimates and, if available, covariances."""

    def deferred(self, work: Work, state: State) -> Deferred:
        """Return belief and verdict, to be computed when an estimate is read.

        The default computes the belief at once, and its verdict tests no innovations. Stored
        estimates keep the data that these functions use. Override this if the data are not much
        larger than the belief and never change.
        """
        belief = self.belief(work, state)
        return Deferred(lambda: belief, self.unjudged)

    def unjudged(self) -> Verdict:
        """Return the verdict of a law that tests no innovations."""
        why = f"innovations: {type(self).__name__} does not test their size"
        return Verdict.of((), (why,), judged=False)


AnyLaw = Law[Any, Any]


@nonfinite_allowed()  # the result is checked
def stepped(
    law: Law[Work, State], work: Work, problem: Problem, before: State, interval: Interval
) -> tuple[State, Report]:
    """Return state and report after a sample; after a numerical failure, the state before it.

    A numerical failure is an operation that raises an error, or a belief that is not finite or has
    nonfinite squares. A sample at the initial time is an interval of length zero.
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
        status = numerical(error)
        if status is None:
            raise
        failure = status
    return before, Report(failure, np.full(problem.observed.size, np.nan))
