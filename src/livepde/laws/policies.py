"""Policies that return a filter to earlier samples: refit, safeguards and jumps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from livepde.errors import LawError
from livepde.laws.innovations import Innovations
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import where

LARGEST = 3.0  # Huber's bound: it clips 0.3 % of Gaussian innovations, and 1 % of their variance
NEARLY = 3.0  # difference of log-likelihoods within which onsets are compared
CHANCE = 1e-2  # a sensor seems stuck if its repetitions in a row are less probable than this


@dataclass(frozen=True)
class Refit:
    """Fit the stored samples again: at the start of a run, at its end, and on demand.

    Each update leaves a linearisation error, which a state with long memory never forgets. Far from
    the truth, it may lead to a wrong estimate. The refit finds the most probable constant unknowns
    given all stored samples. It takes Levenberg-Marquardt steps in a trust region, starts again
    where the solution does not explain the samples, and reconsiders refused readings. See
    `livepde.laws.refit`.

    The samples are fitted each time their number has doubled, so that most of the search uses few
    samples. Such a call of `step` takes longer than others. If a delay is not acceptable, for
    example in a control loop or a live run, `apart` runs the fit in a separate thread.

    This fit is not possible with moving unknowns, noisy inputs or a fading memory. The first
    samples are then smoothed repeatedly (`livepde.laws.iterated_smoother`).

    Parameters
    ----------
    start
        Up to this many samples are fitted at each doubling; at most 64 if unknowns move.
    window
        At most this many samples are stored. When the window is full, the present estimate becomes
        the prior of the next window.
    passes
        Largest number of passes over the samples for a search; beyond it, there is no convergence.
    apart
        True: a fit of more than 64 samples runs in a thread, while samples continue. After an
        eighth more samples the filter switches to its result. Each call of `step` then assimilates
        three of the samples since, until the filter has caught up. Results do not depend on the
        computing time: a call waits for an unfinished fit that is due. Members of a fleet are
        fitted at once. None: True in runs of a case that wait for their source.

    Examples
    --------
    >>> import livepde as lp
    >>> law = lp.SensitivityLaw(refit=lp.Refit())
    >>> never = lp.SensitivityLaw(refit=None)
    """

    start: int = 4096
    window: int = 4096
    passes: int = 40
    # A run may resume with another value, which only changes when a fit is used.
    apart: bool | None = field(default=None, metadata={"begins_anew": True})

    def __post_init__(self) -> None:
        for name, least in (("start", 0), ("window", 2), ("passes", 1)):
            value = getattr(self, name)
            if value < least:
                raise LawError(f"Refit: {name} must be at least {least}; got {value}.")


@dataclass(frozen=True)
class Guards:
    """Safeguards of `SensitivityLaw` against failure of its assumptions; inactive while they hold.

    *Overconfident linearisation.* Some samples move an unknown by more than `reach` prior standard
    deviations, and by more than half a posterior standard deviation. Such a sample is assimilated
    by Gauss-Newton steps over its interval, of at most one prior standard deviation. They end when
    reference and estimate agree within half a posterior standard deviation. If they do not
    converge, the sample is tried up to `temperings` times more, each time with ten times the noise.
    If that fails too, it is not used. Notes: "iterated", "tempered", "held".

    *Runaway.* A step fails, or an innovation exceeds `runaway` times the largest range of any
    sensor so far (both in units of the noise). The law then returns to a state before the last
    samples, inflates its covariance by one prior standard deviation, and propagates it without
    those samples. If that fails too, it starts from the prior. Note: "restarted". If both fail, a
    failed step is reported and changes nothing, and "runaway" notes a large innovation.

    Parameters
    ----------
    reach
        Largest move of an unknown by one sample without iteration, in prior standard deviations.
    iterations
        Largest number of Gauss-Newton steps for a sample.
    temperings
        Number of further attempts, each with ten times the noise, if the steps do not converge.
    runaway
        Smallest innovation of a runaway, as a multiple of the largest range of the sensors.
    past
        A restart goes back by at least this many samples, if available, and less than twice as
        many.
    """

    reach: float = 1.0
    iterations: int = 10
    temperings: int = 2
    runaway: float = 10.0
    past: int = 32

    def __post_init__(self) -> None:
        for name in ("reach", "runaway"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise LawError(f"Guards: {name} must be a positive number; got {value}.")
        for name, least in (("iterations", 1), ("temperings", 0), ("past", 1)):
            value = getattr(self, name)
            if value < least:
                raise LawError(f"Guards: {name} must be at least {least}; got {value}.")

    def within_reach(self, change: Array) -> Mask:
        """Return which members a sample moves by at most `reach`, shape (members,).

        `change`: change of the reduced unknowns, in prior standard deviations, (members, k).
        """
        return np.asarray(np.abs(change).max(axis=1, initial=0.0) <= self.reach)


@dataclass(frozen=True, eq=False)
class Watch:
    """Innovations of the last samples of each member."""

    # Sum of e^2 and number of innovations e in each of the last samples, newest first, shapes
    # (members, samples).
    squares: Array
    counts: Array
    # Samples since the start, and samples until the test resumes, shape (members,).
    seen: IntArray
    resting: IntArray
    # Reference statistics of the innovations. An innovation is clipped to `LARGEST` times the usual
    # size, so that a jump barely changes its own reference.
    usual: Innovations
    # Usual scatter before each of the last samples, newest first, shape (members, samples).
    scatters: Array
    # Number of repeated readings of a sensor while it did not seem stuck, and whether it seemed
    # stuck at the last sample, shapes (members, sensors).
    repeats: IntArray
    stuck: Mask

    def repeating(self, run: IntArray) -> Mask:
        """Return which sensors seem stuck, so that their readings are no evidence of a jump.

        `run`: number of repetitions of each reading in a row, (members, sensors). The test allows
        for sensors of coarse resolution, which often repeat their readings.
        """
        usual = (self.repeats + 1.0) / (self.seen[:, None] + 2.0)
        return np.asarray(run * np.log(usual) < np.log(CHANCE))

    def interrupted(self, which: Mask, rest: int) -> Watch:
        """Return the watch with cleared sums and at least `rest` samples of rest for members."""
        rows = which[:, None]
        return replace(
            self,
            squares=np.where(rows, 0.0, self.squares),
            counts=np.where(rows, 0.0, self.counts),
            resting=np.where(which, np.maximum(self.resting, rest), self.resting),
        )

    def add(self, e: Array, opening: Mask, refused: IntArray | None = None) -> Watch:
        """Return the watch after normalised innovations (members, sensors), NaN where missing.

        `opening`: members whose usual size is not established yet, shape (members,). All their
        innovations count for it, except refused ones, which may be outliers. For other members, it
        ignores the samples of rest after an alarm. `refused`: number of refusals in a row by a
        gate, (members, sensors); None: no refusals.
        """
        seen = np.isfinite(e)
        square = (np.where(seen, e, 0.0) ** 2).sum(axis=1)
        squares = np.concatenate([square[:, None], self.squares[:, :-1]], axis=1)
        count = seen.sum(axis=1).astype(float)
        counts = np.concatenate([count[:, None], self.counts[:, :-1]], axis=1)
        most = LARGEST * np.sqrt(np.where(opening, np.inf, self.usual.ratio))[:, None]
        usual = self.usual
        if refused is not None and np.count_nonzero(refused):
            e = np.where(opening[:, None] & (refused > 0), np.nan, e)
            seen = np.isfinite(e)
        counted = seen.any(axis=1) & (opening | (self.resting == 0))
        if counted.any():
            new = usual.add(np.minimum(np.maximum(e, -most), most))
            usual = new if counted.all() else where(counted, new, usual)
        scatters = np.concatenate([self.usual.scatter[:, None], self.scatters[:, :-1]], axis=1)
        resting = np.maximum(self.resting - 1, 0)
        return Watch(
            squares, counts, self.seen + 1, resting, usual, scatters, self.repeats, self.stuck
        )


@dataclass(frozen=True)
class Jumps:
    """Test for sudden changes of the unknowns, and allow the unknowns to change after an alarm.

    A chi-square test is applied to the innovations of the last 1, 2, 4, ... samples, normalised by
    their expected standard deviation and by their usual size and correlation. After an alarm the
    law returns to the most likely time of the change. It adds `size` prior standard deviations to
    the uncertainty of the unknowns that may jump, and assimilates the samples since. The state and
    the other unknowns keep their estimates from before the jump. If the samples before it have no
    readings, the change is equally likely in each of their intervals. A change between two samples
    acts in part at the first and in part at the second.

    The usual size and correlation are averages over about 500 samples, including the first `settle`
    samples but not the samples of rest after an alarm. After the first `settle` samples,
    innovations are clipped to three times the usual size, so that a jump barely changes the
    reference. A sample is compared with the usual size before it, so that a slow jump is not
    compared with itself.

    Parameters
    ----------
    probability
        Probability of a false alarm in each sample.
    window
        Largest number of samples in a test, a power of two.
    size
        Standard deviation that an alarm adds to the unknowns, in prior standard deviations.
    settle
        Number of samples without a test after the start and after an alarm.
    unknowns
        Names of the unknowns that may jump; default all but the time constants of slow sensors.
        Other unknowns, such as material constants, keep their estimate and covariance.

    Examples
    --------
    >>> import livepde as lp
    >>> law = lp.SensitivityLaw(jumps=lp.Jumps())
    """

    probability: float = 1e-5
    window: int = 32
    size: float = 1.0
    settle: int = 50
    unknowns: Sequence[str] | None = None

    def __post_init__(self) -> None:
        # A power of two has a single bit, which the number below it lacks.
        doubles = self.window >= 1 and not self.window & (self.window - 1)
        for name, holds, rule in (
            ("probability", 0 < self.probability < 1, "lie between 0 and 1"),
            ("window", doubles, "be a power of two"),
            ("size", np.isfinite(self.size) and self.size > 0, "be a positive number"),
            ("settle", self.settle >= 0, "be at least 0"),
        ):
            if not holds:
                raise LawError(f"Jumps: {name} must {rule}; got {getattr(self, name)}.")
        if self.unknowns is not None:
            names = self.unknowns
            if isinstance(names, str) or not (names and all(isinstance(n, str) for n in names)):
                raise LawError(
                    f"Jumps: unknowns must be names, as ('v',), or None for all; got {names!r}."
                )
            object.__setattr__(self, "unknowns", tuple(names))

    @cached_property
    def _lengths(self) -> IntArray:
        """Numbers of samples in the tests, minus 1."""
        return 2 ** np.arange(int(np.log2(self.window)) + 1) - 1

    def part(self, share: float) -> float:
        """Return the size of a part of a jump with a share of its variance."""
        return self.size * math.sqrt(share)

    def start(self, sensors: int, members: int = 1) -> Watch:
        zero, none = np.zeros((members, self.window)), np.zeros(members, dtype=np.int64)
        usual = Innovations.start(sensors, members)
        repeats = np.zeros((members, sensors), dtype=np.int64)
        return Watch(zero, zero, none, none + self.settle, usual, zero + 1.0, repeats, repeats > 0)

    def add(
        self,
        watch: Watch,
        e: Array,
        refused: IntArray | None = None,
        run: IntArray | None = None,
        unread: Mask | None = None,
    ) -> tuple[Watch, Mask]:
        """Return the watch after a sample, and the members with an alarm.

        `e`: normalised innovations, shape (members, sensors), NaN where missing. `refused`, `run`:
        as for `Watch.add` and `Watch.repeating`. `unread`: members with an input that was not read,
        (members,). Its effect on the state lasts, and is not a jump of an unknown.
        """
        if unread is not None:
            watch, e = watch.interrupted(unread, self.settle), np.where(unread[:, None], np.nan, e)
        if run is not None and np.count_nonzero(run) + np.count_nonzero(watch.stuck):
            stuck = watch.repeating(run)
            # Clear the sums, which contain the first reading of the repeated value.
            begins = np.asarray((stuck & ~watch.stuck).any(axis=1))
            repeats = watch.repeats + ((run > 0) & ~stuck)
            watch = replace(watch.interrupted(begins, 0), repeats=repeats, stuck=stuck)
            e = np.where(stuck, np.nan, e)
        new = watch.add(e, watch.seen < self.settle, refused)
        early = watch.resting > 0  # large innovations may be due to a poor first linearisation
        if early.any():
            kept = early[:, None]
            squares = np.where(kept, watch.squares, new.squares)
            counts = np.where(kept, watch.counts, new.counts)
            new = replace(new, squares=squares, counts=counts)
            if early.all():
                return new, np.zeros(len(e), dtype=bool)
        lengths = self._lengths
        sums = np.cumsum(new.squares, axis=1)[:, lengths]
        freedom = np.cumsum(new.counts, axis=1)[:, lengths]

        def unlikely(sums: Array) -> Mask:
            # Survival function of the chi-square distribution at the sums.
            with np.errstate(invalid="ignore"):  # NaN without degrees of freedom
                chance = scipy.special.gammaincc(0.5 * freedom, 0.5 * sums)
            chance = np.where(freedom > 0.0, chance, 1.0).min(axis=1)
            # With Bonferroni's factor, all tests together raise false alarms at the stated rate.
            return np.asarray(chance * len(lengths) < self.probability)

        # The usual scatter is at least 1, so that it cannot add alarms. It takes longer to compute,
        # and is only needed after an alarm without it.
        alarm = unlikely(sums)
        if alarm.any():
            alarm = unlikely(sums / new.scatters[:, lengths] ** 2)
            alarm &= ~early & (new.counts[:, 0] > 0.0)
        if alarm.any():
            new = new.interrupted(alarm, self.settle)
        return new, alarm

    def onsets(self, watch: Watch, e: Array) -> list[int]:
        """Return likely numbers of samples since a jump, including this sample.

        First the number n that maximises the log-likelihood ratio n (r - 1 - log r)/2 of
        innovations with mean square r > 1 against 1, then all others with nearly this ratio.
        Parameters as for `add`, for one member.
        """
        new = watch.add(e, watch.seen < self.settle)
        freedom = np.cumsum(new.counts[0])
        # Ratios are comparable only with one reference size for all n, from before all samples.
        size = new.scatters[0, -1] ** 2 * np.maximum(freedom, 1.0)
        ratio = np.maximum(np.cumsum(new.squares[0]) / size, 1.0)
        likely = 0.5 * freedom * (ratio - 1.0 - np.log(ratio))
        order = np.argsort(-likely, kind="stable")
        found: list[int] = (1 + order[likely[order] >= likely[order[0]] - NEARLY]).tolist()
        return found
