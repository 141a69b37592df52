"""Policies by which a filter goes back to earlier samples: refit, safeguards and jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from livepde.errors import LawError
from livepde.laws.innovations import Innovations
from livepde.linalg import Array, IntArray, Mask
from livepde.linalg.member_arrays import where

LARGEST = 3.0  # Huber's bound: of Gaussian innovations it cuts off 0.3 %, and 1 % of their variance
CHANCE = 1e-2  # of so many repetitions in a row, below which a sensor seems stuck


@dataclass(frozen=True)
class Refit:
    """Fit the stored samples again: at the start of a run, at its end, and on demand.

    An update leaves a second-order error that a state with long memory never forgets, and far from
    the truth it may end anywhere. The refit is a search for the most probable constant unknowns
    given all stored samples: Levenberg-Marquardt steps in a trust region, new starts where the end
    does not explain the samples, and a second look at refused readings. See `livepde.laws.refit`.

    The samples are fitted each time their number has doubled, so that most of the search is over
    while they are few. Such a call of `step` takes longer than others. Where it must not, as in a
    control loop or a live run, `apart` fits them in a thread of its own.

    Unknowns that move, noisy inputs and a fading memory have no such fit: there the samples of the
    start are smoothed again, as `livepde.laws.iterated_smoother` does.

    Parameters
    ----------
    start
        Up to this many samples are taken again at each doubling; 64 at most of unknowns that move.
    window
        At most this many samples are stored. When it is full, the estimate of that moment becomes
        the prior of the next window.
    passes
        A search that takes more passes over the samples has not converged.
    apart
        True: a fit of more than 64 samples runs in a thread, while samples continue. An eighth more
        samples later the filter goes over to it; then each call of `step` takes three of the
        samples in between, until all are taken. The numbers do not depend on the time that the fit
        takes: a call waits for it where it is due and not there yet. Members of a fleet are fitted
        at once. None: in runs of a case that wait for their source.

    Examples
    --------
    >>> import livepde as lp
    >>> law = lp.SensitivityLaw(refit=lp.Refit())
    >>> never = lp.SensitivityLaw(refit=None)
    """

    start: int = 4096
    window: int = 4096
    passes: int = 40
    # It moves when a fit is used, not what the run is of.
    apart: bool | None = field(default=None, metadata={"begins_anew": True})

    def __post_init__(self) -> None:
        for name, least in (("start", 0), ("window", 2), ("passes", 1)):
            value = getattr(self, name)
            if value < least:
                raise LawError(f"Refit: {name} must be at least {least}; got {value}.")


@dataclass(frozen=True)
class Guards:
    """Safeguards of `SensitivityLaw` against failure of its assumptions; inert while they hold.

    *Overconfident linearisation.* A sample that moves an unknown by more than `reach` prior
    standard deviations, and by more than half a posterior standard deviation, is assimilated by
    Gauss-Newton steps over its interval, each at most one prior standard deviation long, until
    reference and estimate agree within half a posterior standard deviation. Where the steps do not
    converge, the sample is taken again with ten times its noise, and so on; after `temperings` such
    attempts it is not used. Notes: "iterated", "tempered", "held".

    *Runaway.* A step fails, or a prediction misses the data by more than `runaway` times the
    largest range that any sensor has ever shown (each in units of its noise). The law then goes
    back to before the last samples, inflates the covariance there by one prior standard deviation,
    and propagates the state without those samples; if that fails as well, it starts again from the
    prior. Note: "restarted". If nothing helps, a failed step is reported as such and changes
    nothing; "runaway" notes a prediction that still misses the data.

    Parameters
    ----------
    reach
        Largest move of an unknown by one sample without iteration, in prior standard deviations.
    iterations
        At most this many Gauss-Newton steps for a sample.
    temperings
        How often a sample whose steps do not converge is taken again with ten times its noise.
    runaway
        Smallest innovation of a runaway, as a multiple of the largest range of the sensors.
    past
        A restart goes back by this many samples at least, if there are so many, and by less than
        twice as many.
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

        `change` is that of the reduced unknowns, in prior standard deviations, (members, k).
        """
        return np.asarray(np.abs(change).max(axis=1, initial=0.0) <= self.reach)


@dataclass(frozen=True, eq=False)
class Watch:
    """Innovations of the last samples of each member."""

    # Sum of e^2 and number of innovations e of each of the last samples, newest first, shapes
    # (members, samples).
    squares: Array
    counts: Array
    # Samples since the start, and samples that are not looked at yet, shape (members,).
    seen: IntArray
    resting: IntArray
    # Statistics of the innovations, with which new ones are compared: none counts for more than
    # `LARGEST` times the usual size, so that a jump hardly changes its own yardstick.
    usual: Innovations
    # Usual scatter before each of the last samples, newest first, shape (members, samples).
    scatters: Array
    # Readings that repeated the one before, of sensors that did not seem stuck; and which sensors
    # seemed stuck at the last sample, (members, sensors).
    repeats: IntArray
    stuck: Mask

    def repeating(self, run: IntArray) -> Mask:
        """Return which sensors seem stuck; their readings are not evidence of a jump.

        `run`: how often in a row each reading has been repeated, (members, sensors). A sensor of a
        coarse resolution repeats its readings often.
        """
        usual = (self.repeats + 1.0) / (self.seen[:, None] + 2.0)
        return np.asarray(run * np.log(usual) < np.log(CHANCE))

    def interrupted(self, which: Mask, rest: int) -> Watch:
        """Return the value in which some members forget their sums, and rest for some samples."""
        rows = which[:, None]
        return replace(
            self,
            squares=np.where(rows, 0.0, self.squares),
            counts=np.where(rows, 0.0, self.counts),
            resting=np.where(which, np.maximum(self.resting, rest), self.resting),
        )

    def add(self, e: Array, opening: Mask, refused: IntArray | None = None) -> Watch:
        """Return the value after normalised innovations (members, sensors), NaN where missing.

        `opening`: members that still have to find the usual size, shape (members,): there any
        innovation counts, while those after an alarm, which learn anew, are left out. `refused`:
        how many values in a row of each sensor a gate has refused, (members, sensors); None: it
        refuses none. They may be wild, and do not count for the usual size before it is found.
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
    """Watch for sudden changes of the unknowns, and let them move when there is one.

    The innovations of the last 1, 2, 4, ... samples, normalised by their expected standard
    deviation and by their usual size and correlation, are compared with the chi-square
    distribution. After an alarm the law goes back to where the innovations most likely became too
    large, adds `size` prior standard deviations to the uncertainty of the unknowns that may jump,
    and takes the samples since again: so it learns anew without a restart, and keeps the estimates
    of the state and of the other unknowns from before the jump.

    The usual size and correlation are those of the last 500 samples that were looked at, with the
    first `settle`; after these none counts for more than three times the usual size. So a jump
    hardly changes the yardstick of the next one. Samples are compared with the usual size before
    them, so that a jump that shows slowly is not compared with itself.

    Parameters
    ----------
    probability
        Of a false alarm, in each sample.
    window
        Longest number of samples, a power of two.
    size
        Standard deviation that an alarm adds to the unknowns, as a multiple of that of the prior.
    settle
        So many samples after the start, and after an alarm, are not looked at.
    unknowns
        Names of the unknowns that may jump; default all. A material constant that is not among them
        keeps its estimate and its covariance.

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
        """Numbers of samples that are looked at, less one."""
        return 2 ** np.arange(int(np.log2(self.window)) + 1) - 1

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
        """Return the value after a sample, and for which members there is an alarm.

        `e`: normalised innovations, shape (members, sensors), NaN where missing. `refused`, `run`:
        as for `Watch.add` and `Watch.repeating`. `unread`: members with an input that was not read,
        (members,): what it did is no jump of an unknown, and moves the state for some time.
        """
        if unread is not None:
            watch, e = watch.interrupted(unread, self.settle), np.where(unread[:, None], np.nan, e)
        if run is not None and np.count_nonzero(run) + np.count_nonzero(watch.stuck):
            stuck = watch.repeating(run)
            # The sums contain the first reading of the repeated value, and are cleared.
            begins = np.asarray((stuck & ~watch.stuck).any(axis=1))
            repeats = watch.repeats + ((run > 0) & ~stuck)
            watch = replace(watch.interrupted(begins, 0), repeats=repeats, stuck=stuck)
            e = np.where(stuck, np.nan, e)
        new = watch.add(e, watch.seen < self.settle, refused)
        early = watch.resting > 0  # the first linearisations are poor: what they miss is no jump
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
            # Survival function of the chi-square distribution: the chance of so large a sum.
            with np.errstate(invalid="ignore"):  # no freedom, no chance
                chance = scipy.special.gammaincc(0.5 * freedom, 0.5 * sums)
            chance = np.where(freedom > 0.0, chance, 1.0).min(axis=1)
            # The least chance of several tests: by Bonferroni's factor all of them together raise
            # false alarms at the stated rate.
            return np.asarray(chance * len(lengths) < self.probability)

        # The usual scatter, which takes longer to find, is at least 1: what is likely without it is
        # with it, too.
        alarm = unlikely(sums)
        if alarm.any():
            alarm = unlikely(sums / new.scatters[:, lengths] ** 2)
            alarm &= ~early & (new.counts[:, 0] > 0.0)
        if alarm.any():
            new = new.interrupted(alarm, self.settle)
        return new, alarm

    def onset(self, watch: Watch, e: Array) -> int:
        """Return of how many samples, up to this one, innovations are most likely too large.

        The number n that maximises the likelihood ratio n (r - 1 - log r)/2 of innovations of mean
        square r > 1 since n samples against 1. Parameters as for `add`, of one member.
        """
        new = watch.add(e, watch.seen < self.settle)
        freedom = np.cumsum(new.counts[0])
        # One yardstick for all n, from before all of them: ratios by several are not comparable.
        size = new.scatters[0, -1] ** 2 * np.maximum(freedom, 1.0)
        ratio = np.maximum(np.cumsum(new.squares[0]) / size, 1.0)
        return 1 + int(np.argmax(freedom * (ratio - 1.0 - np.log(ratio))))
