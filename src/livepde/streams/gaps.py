"""Gaps and spikes of input and boundary channels, which are also measurements.

A gap is interpolated between its neighbours: by PCHIP if two values on each side are known, else by
a straight line. Gaps at the end of a record are not filled: the identifier holds the last value and
reports it.

A spike is a single value far from the cubic through two neighbours on each side. It is refused and
leaves a gap. If the large residuals remain without the value, the channel has really changed, such
as an actuator, and all values are kept. A step that is recorded as two rows, much closer than the
usual interval, ends one curve and begins another.

Channels that are constant between two readings have no spikes. A value that holds until the next
reading is never missing. A missing mean is part of the next mean.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import scipy  # scipy.interpolate and scipy.ndimage are slow to load, and rarely needed

from livepde.errors import ConfigurationError
from livepde.linalg import Array, IntArray, Mask
from livepde.samples import Sample, in_order, number
from livepde.stepping import Between, Held
from livepde.streams.table import DataTable

# With 12, none of 1000 records `channel(seed)` of tests/test_gaps.py loses a value, and 297 of 300
# spikes of 60 standard deviations of the noise are detected, but only 103 of 300 spikes of 40.
BEYOND = 12.0
LOCAL = 31  # number of residuals whose median is the local scale
FEWEST = 8  # smallest number of residuals that determine a scale
RECENT = 64  # number of past values of a channel that determine the scale of residuals
CENTRE, NEIGHBOURS = 2, 5  # index of the centre among the values of a residual, and their number
LEFT = 0.2  # share of a residual that may remain without a spike; after a step, 0.3 remains
SHORT = 1.0 / 16.0  # largest interval of two rows that record a step, in usual intervals
STAYS = 0.5  # largest change before and after such a step, relative to the step
LONG = 10  # rows of a gap; longer gaps are reported, since interpolation may be poor
ROUNDING = 1e-12  # smallest relevant residual, relative to the largest value of a channel
ABOUT = 3  # values on each side that must have small residuals without a spike
GAUSS = 1.4826  # standard deviation over median absolute deviation of Gaussian noise

Series = Sequence[tuple[float, float]]
"""Times and known values of a channel, in order of time."""
Waiting: TypeAlias = deque[tuple[Sample, dict[str, float]]]
"""Waiting samples with the values of the channels, NaN where missing."""


def _residuals(t: Array, x: Array) -> tuple[Array, Array]:
    """Return residuals to the cubic through two neighbours on each side, and their weights.

    Residuals, shape (values - 4,), are reduced if the neighbours are far away. They are linear
    combinations of five values each, with the weights, shape (values - 4, 5).
    """
    window = np.lib.stride_tricks.sliding_window_view
    times, values = window(t, NEIGHBOURS), window(x, NEIGHBOURS)
    weights = np.ones(times.shape)
    others = [k for k in range(NEIGHBOURS) if k != CENTRE]
    for i in others:
        for j in others:
            if j != i:
                weights[:, i] *= (times[:, CENTRE] - times[:, j]) / (times[:, i] - times[:, j])
        weights[:, i] *= -1.0
    # The error of a cubic is proportional to the product of the distances, so that a large residual
    # next to a gap does not indicate a spike.
    reach = np.abs(np.prod([times[:, CENTRE] - times[:, i] for i in others], axis=0))
    # If two neighbours are very close, the slope of the cubic is dominated by their noise.
    noise = np.sqrt((weights * weights).sum(axis=1))
    far = np.maximum(reach / np.median(reach), noise / np.median(noise))
    weights /= np.maximum(1.0, far)[:, None]
    return (weights * values).sum(axis=1), weights


def _curves(t: Array, x: Array) -> IntArray:
    """Return the number of the curve of each value; steps of two close rows separate curves."""
    steps, change = np.diff(t), np.abs(np.diff(x))
    near = np.maximum(np.append(0.0, change[:-1]), np.append(change[1:], 0.0))
    parts = (steps < SHORT * np.median(steps)) & (near < STAYS * change)
    return np.append(0, np.cumsum(parts))


def _threshold(x: Array, size: Array, beyond: float) -> Array:
    """Return the thresholds of residuals, from their global and local scale."""
    absolute = np.abs(size)
    usual = float(np.median(absolute))
    steps = np.abs(np.diff(x))
    # Most residuals of a channel with a coarse resolution are zero. Without this bound, one step of
    # the resolution would count as a spike.
    resolution = steps[steps > 0.0].min(initial=math.inf)
    local = np.full_like(absolute, usual)
    # The local scale only raises the threshold, so it is not needed if no residual exceeds this.
    suspect = absolute.max() > beyond * max(GAUSS * usual, resolution)
    if suspect and len(absolute) > LOCAL:  # SciPy before 1.15.3 corrupts memory for short arrays
        # A window reflected at an end would count a spike there twice. The ends therefore have the
        # median of the first and the last complete window.
        half = LOCAL // 2
        local = scipy.ndimage.median_filter(absolute, size=LOCAL)
        local[:half], local[-half:] = local[half], local[-half - 1]
    return np.asarray(beyond * np.maximum(GAUSS * (usual + local), resolution))


def find_spikes(t: Array, x: Array, beyond: float = BEYOND) -> Mask:
    """Return which known values of a channel are spikes, shape (values,).

    `t`, `x`: increasing times, and finite values.
    `beyond`: distance from the cubic through the neighbours above which a value is suspect, in
    units of the sum of the global and the local robust standard deviation.
    """
    spikes = np.zeros(len(x), dtype=bool)
    if len(x) < FEWEST + NEIGHBOURS - 1:
        return spikes
    # Weighted sums of very large values would overflow.
    x = x / (np.abs(x).max() or 1.0)
    size, weights = _residuals(t, x)
    curve = _curves(t, x)
    whole = np.flatnonzero(curve[NEIGHBOURS - 1 :] == curve[: 1 - NEIGHBOURS])
    if len(whole) < FEWEST:
        return spikes
    across = np.ones(len(size), dtype=bool)
    across[whole] = False
    size[across], weights[across] = 0.0, 0.0
    excess = np.zeros(len(size))
    threshold = np.maximum(_threshold(x, size[whole], beyond), ROUNDING)
    excess[whole] = np.abs(size[whole]) / threshold
    # The largest residual is first, because a spike also increases the residuals of its neighbours.
    for row in np.argsort(-excess)[: int((excess > 1.0).sum())].tolist():
        if excess[row] <= 1.0:  # explained by an earlier suspect
            continue
        suspect = _suspect(size, weights, row)
        (own,) = np.nonzero(curve == curve[suspect])
        limit = LEFT * float(abs(size[row]))
        spikes[suspect] = _explains(t[own], x[own], suspect - int(own[0]), limit)
        excess[max(suspect - NEIGHBOURS + 1, 0) : suspect + 1] = 0.0
        excess[row] = 0.0
    return spikes


def _suspect(size: Array, weights: Array, row: int) -> int:
    """Return the index of the value whose error best explains the residuals near `row`."""
    # The centre of the largest residual need not be the spike, since for uneven times a neighbour
    # may have a larger weight. All residuals that contain a value are compared with its pattern.
    best, most = row + CENTRE, -1.0
    for value in range(row, row + NEIGHBOURS):
        rows = np.arange(max(value - NEIGHBOURS + 1, 0), min(value + 1, len(size)))
        column = weights[rows, value - rows]
        match = abs(float(column @ size[rows])) / math.sqrt(float(column @ column))
        # Rounding must not decide between values that match equally well.
        if match > most * (1.0 + 1e-9):
            best, most = value, match
    return best


def _explains(t: Array, x: Array, suspect: int, largest: float) -> bool:
    """Return whether the values around a suspect have small residuals without it."""
    # A spike and the start of a change look the same without two values on each side.
    if not CENTRE <= suspect < len(x) - CENTRE:
        return False
    first = max(suspect - ABOUT, 0)
    about = np.delete(np.arange(first, min(suspect + ABOUT + 1, len(x))), suspect - first)
    if len(about) < NEIGHBOURS:
        return False
    size, _ = _residuals(t[about], x[about])
    return bool((np.abs(size) <= largest).all())


def bridged(t: float, past: Series, later: Series) -> float:
    """Interpolate a channel in a gap; NaN if the time is not between known values.

    The interpolation is PCHIP if two values on each side are known, else linear.

    >>> bridged(1.0, [(0.0, 2.0)], [(2.0, 4.0)])
    3.0
    """
    if not (past and later):
        return math.nan
    (t0, x0), (t1, x1) = past[-1], later[0]
    if len(past) < 2 or len(later) < 2:
        return x0 + (t - t0) / (t1 - t0) * (x1 - x0)
    times, values = zip(*past[-2:], *later[:2], strict=True)
    return float(scipy.interpolate.PchipInterpolator(times, values)(t))


def _spikes_after(past: Series, later: Series, beyond: float) -> list[bool]:
    """Return which of the later values are spikes; the last two cannot be judged yet."""
    if len(later) <= CENTRE or not math.isfinite(beyond):
        return [False] * len(later)
    t, x = np.array([*past, *later]).T
    return list(map(bool, find_spikes(t, x, beyond)[len(past) :]))


def filled_column(t: Array, x: Array, beyond: float = BEYOND) -> tuple[Array, Mask, Mask]:
    """Return a channel without gaps, and masks of its interpolated values and refused spikes.

    Gaps before the first and after the last value remain.
    """
    known = np.flatnonzero(np.isfinite(x))
    spikes = np.zeros(len(x), dtype=bool)
    if math.isfinite(beyond):
        spikes[known] = find_spikes(t[known], x[known], beyond)
    known = known[~spikes[known]]
    new, gaps = np.where(spikes, math.nan, x), np.zeros(len(x), dtype=bool)
    if len(known) < 2:
        return new, gaps, spikes
    gaps[known[0] : known[-1]] = ~np.isfinite(new[known[0] : known[-1]])
    # Interpolation is linear in the first and the last interval, because PCHIP needs values on both
    # sides for its slopes, and the results must agree with those of `bridged` on a stream.
    new[gaps] = np.interp(t[gaps], t[known], x[known])
    inner = gaps & (t > t[known[1]]) & (t < t[known[-2]])
    if inner.any():
        line = scipy.interpolate.PchipInterpolator(t[known], x[known])
        new[inner] = line(t[inner])
    return new, gaps, spikes


def fill_table(
    table: DataTable,
    interpolated: Iterable[str],
    screened: Iterable[str],
    *,
    means: Iterable[str] = (),
) -> DataTable:
    """Return a complete record without spikes, and without gaps between known values.

    Its remarks count interpolated values as "interpolated", or as "bridged" in gaps of more than
    `LONG` rows; refused values as "spike"; missing values at the end as "ended" if there are more
    than `LONG`; and other gaps as "missing". A reading of the channels `means` is the mean since
    the last reading, so that a gap is part of the next mean.
    """
    values, remarks = table.values.copy(), dict(table.remarks)
    fills, screens, of_means = set(interpolated), set(screened), set(means)
    for k, name in enumerate(table.names):
        if name not in fills | screens | of_means:
            continue
        if name in of_means:
            import pandas as pd  # slow to load, and rarely needed

            column = pd.Series(values[:, k]).bfill().to_numpy(copy=True)
            gaps = np.isnan(values[:, k]) & ~np.isnan(column)
            spikes, fills = np.zeros_like(gaps), fills | {name}
        else:
            limit = BEYOND if name in screens else math.inf
            column, gaps, spikes = filled_column(table.t, values[:, k], limit)
        if name not in fills:
            column[gaps], gaps = math.nan, np.zeros_like(gaps)
        values[:, k] = column
        after = int(np.isfinite(column)[::-1].argmax())  # missing values at the end
        ended = after if after > LONG else 0
        left = np.isnan(column).sum() - ended
        bridges = 0
        if gaps.any():
            numbered, _ = scipy.ndimage.label(gaps)
            bridges = int((np.bincount(numbered)[numbered[gaps]] > LONG).sum())
        counts = {"spike": spikes.sum(), "interpolated": gaps.sum() - bridges, "bridged": bridges}
        counts |= {"ended": ended, "missing": left}
        remarks |= {(kind, name): int(number) for kind, number in counts.items() if number}
    return replace(table, values=values, remarks=remarks)


@dataclass(frozen=True)
class FillGaps:
    """Stage of a stream that interpolates gaps of input channels and refuses spikes.

    A sample that lacks a value of one of the channels waits for the next value, at most for `wait`
    or `samples`. After that, it is passed on unchanged. If spikes are refused, every sample waits
    for the next two values of each channel, which is a lag of two samples.

    Parameters
    ----------
    channels
        Names of the input and boundary channels.
    wait
        Longest time for which a sample waits, in the unit of the stream.
    samples
        Largest number of later samples that a sample waits for.
    spikes
        Distance from its neighbours above which a value is refused, in robust standard deviations.
        Infinity: spikes are not refused, and only samples with gaps wait.
    between
        Channel -> its behaviour between two readings, see `Identifier`. Only channels that are a
        "line" have spikes. A "hold" value is never missing, and a missing "next" value equals the
        next value.

    Examples
    --------
    >>> stage = FillGaps(["T_left"], spikes=math.inf)
    >>> stream = [(k, {"T_left": x}) for k, x in enumerate([1.0, None, 3.0])]
    >>> [sample.z["T_left"] for sample in stage(stream)]
    [1.0, 2.0, 3.0]
    """

    channels: Sequence[str]
    wait: float = math.inf
    samples: int | None = None
    spikes: float = BEYOND
    between: Mapping[str, Between] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.channels, str) or not self.channels:
            raise ConfigurationError(
                f"FillGaps: channels must be a sequence of names; got {self.channels!r}."
            )
        if not self.wait >= 0.0:
            raise ConfigurationError(f"FillGaps: wait must be a time >= 0; got {self.wait}.")
        if self.samples is not None and self.samples < 0:
            raise ConfigurationError(f"FillGaps: samples must be >= 0; got {self.samples}.")
        if not self.spikes > 0.0:
            raise ConfigurationError(f"FillGaps: spikes must be positive; got {self.spikes}.")
        Held.of(self.between, self.channels)  # raises for another channel or behaviour

    def __call__(self, stream: Iterable[Any]) -> Filled:
        """Return the stream without gaps; its items are `Sample`, (t, z) or (t, z, inputs)."""
        return Filled(self, stream)


class Filled(Iterable[Sample]):
    """A stream without gaps in its input channels.

    `counts`: (kind, channel) -> number of values in the last iteration that were "interpolated",
    refused as a "spike", or passed on as "missing".
    """

    def __init__(self, stage: FillGaps, stream: Iterable[Any]) -> None:
        self.stage = stage
        self.stream = stream
        self.counts: Counter[tuple[str, str]] = Counter()

    def __iter__(self) -> Iterator[Sample]:
        self.counts = Counter()
        recent: dict[str, deque[tuple[float, float]]] = {
            name: deque(maxlen=RECENT) for name in self.stage.channels
        }
        waiting: Waiting = deque()
        for sample in in_order(self.stream, "FillGaps"):
            waiting.append((sample, self._values(sample)))
            while waiting and self._decided(waiting):
                yield self._released(waiting, recent)
        while waiting:
            yield self._released(waiting, recent)

    def _values(self, sample: Sample) -> dict[str, float]:
        """Return the values of the channels in a sample, NaN where missing."""
        named = {**(sample.z if isinstance(sample.z, Mapping) else {}), **(sample.inputs or {})}
        return {name: number(named.get(name), f"input '{name}'") for name in self.stage.channels}

    def _later(self, waiting: Waiting, name: str) -> Series:
        """Return the known values of a channel after the first waiting sample."""
        found = [(float(sample.t), values[name]) for sample, values in list(waiting)[1:]]
        return [pair for pair in found if math.isfinite(pair[1])]

    def _decided(self, waiting: Waiting) -> bool:
        """Return whether the first waiting sample can be released."""
        stage, (first, values) = self.stage, waiting[0]
        expired = waiting[-1][0].t - first.t > stage.wait
        if expired or (stage.samples is not None and len(waiting) > stage.samples):
            return True
        screens = math.isfinite(stage.spikes)
        for name in stage.channels:
            own = stage.between.get(name, "line")
            needed = CENTRE if screens and own == "line" else int(math.isnan(values[name]))
            if own != "hold" and len(self._later(waiting, name)) < needed:
                return False
        return True

    def _released(
        self, waiting: Waiting, recent: Mapping[str, deque[tuple[float, float]]]
    ) -> Sample:
        """Remove and return the first waiting sample, with gaps filled if possible."""
        sample, values = waiting[0]
        t, changed = float(sample.t), {}
        for name in self.stage.channels:
            later, past = self._later(waiting, name), recent[name]
            own = self.stage.between.get(name, "line")
            value, kind = decided(t, values[name], list(past), later, self.stage.spikes, own)
            for each in kind:
                self.counts[each, name] += 1
            # This value is without spikes: a refused spike must not affect later decisions.
            if math.isfinite(value):
                past.append((t, value))
            if kind:
                changed[name] = value
        waiting.popleft()
        return sample if not changed else _with(sample, changed)


def decided(
    t: float,
    value: float,
    past: Series,
    later: Series,
    beyond: float = BEYOND,
    between: Between = "line",
) -> tuple[float, tuple[str, ...]]:
    """Return the value of a channel in a sample without gap or spike, and the kinds of remarks.

    `past`, `later`: known values before and after. If `beyond` is infinite, spikes are kept.
    """
    kinds: tuple[str, ...] = ()
    if between == "hold":
        return value, kinds
    if between == "next":
        if math.isfinite(value):
            return value, kinds
        return (later[0][1], ("interpolated",)) if later else (value, ("missing",))
    if math.isfinite(value):
        if not _spikes_after(past, [(t, value), *later], beyond)[0]:
            return value, ()
        kinds = ("spike",)
    # Later values have not been judged yet and may also be spikes.
    spikes = _spikes_after(past, later, beyond)
    plausible = [pair for pair, spike in zip(later, spikes, strict=True) if not spike]
    found = bridged(t, past, plausible)
    return found, (*kinds, "interpolated" if math.isfinite(found) else "missing")


def _with(sample: Sample, values: Mapping[str, float]) -> Sample:
    """Return a copy of a sample with new values of channels, each in z or inputs as before."""
    inputs = None if sample.inputs is None else dict(sample.inputs)
    if not isinstance(sample.z, Mapping):
        return Sample(t=sample.t, z=sample.z, inputs={**(inputs or {}), **values})
    named = dict(sample.z)
    for name, value in values.items():
        target = inputs if inputs is not None and name in inputs else named
        target[name] = value
    return Sample(t=sample.t, z=named, inputs=inputs)
