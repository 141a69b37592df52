"""Sample intervals, and the behaviour of inputs between readings."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from livepde.errors import ConfigurationError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array, IntArray, Mask

Between: TypeAlias = Literal["line", "hold", "next"]
"""Value of an input between readings: linear, the previous reading, or the next reading."""


@dataclass(frozen=True)
class Held:
    """Channels that are constant between readings; all others are linear.

    A channel in `last` keeps its value until the next reading (`between = "hold"`). The reading of
    a channel in `next` is the mean since the previous one (`between = "next"`).
    """

    last: tuple[str, ...] = ()
    next: tuple[str, ...] = ()

    @classmethod
    def of(cls, between: Mapping[str, Any], inputs: Collection[str]) -> Held:
        """Return the channels from a mapping of channel to behaviour.

        Raises `ConfigurationError`: a channel is not in `inputs`, or a behaviour is unknown.
        """
        if not isinstance(between, Mapping):
            raise ConfigurationError(
                f"between: got {between!r}; expected a mapping from input channel to behaviour, "
                'such as {"heater": "hold"}.'
            )
        for name, behaviour in between.items():
            if name not in inputs:
                raise ConfigurationError(
                    f"between: '{name}' is not an input of this model; the inputs are "
                    f"{list(inputs)}."
                )
            if behaviour not in get_args(Between):
                raise ConfigurationError(
                    f"between of '{name}': got {behaviour!r}; expected 'line', 'hold' or 'next'."
                )
        kinds = {
            kind: [n for n, item in between.items() if item == kind] for kind in ("hold", "next")
        }
        return cls(tuple(sorted(kinds["hold"])), tuple(sorted(kinds["next"])))

    def acting(
        self, channels: Sequence[str], first: Array, last: Array, row: Array
    ) -> tuple[Array, Array]:
        """Return the inputs inside intervals, at their starts and ends.

        `row`: inputs of the samples at the ends. All arrays have shape (..., channels).
        """
        first = np.where([name in self.next for name in channels], row, first)
        return first, np.where([name in self.last for name in channels], first, last)

    def __bool__(self) -> bool:
        return bool(self.last or self.next)

    def __contains__(self, name: object) -> bool:
        return name in self.last or name in self.next


LINES = Held()
NO_INPUTS = np.zeros((1, 0))


@dataclass(frozen=True, eq=False, kw_only=True)
class End:
    """Values at one end of a sample interval, as in `Interval`."""

    t: float
    inputs: Mapping[str, float]
    z: Array
    noise: Array | None = None
    gaps: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    parts: int = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Interval:
    """A sample interval, with inputs and measurements interpolated linearly.

    Attributes
    ----------
    t0, t1
        Times of the last accepted sample and of the current one.
    inputs0, inputs1
        Input channels at both ends, as limits from inside the interval.
    z0, z1
        Measurements at both ends, shape (sensors,), NaN if missing.
    noise
        Standard deviation of each value of z1, shape (sensors,), NaN for the default of the sensor;
        None if all are defaults.
    gaps
        Channel held at either end -> duration of the gap before, and whether it lasts at the end.
    row
        Inputs of the sample at the end, which sensors use and the next interval starts with; None
        if equal to `inputs1`. They differ if a channel switches at the end (`driven`).
    parts
        Number of parts of every substep; 0 if not chosen yet.
    """

    t0: float
    t1: float
    inputs0: Mapping[str, float]
    inputs1: Mapping[str, float]
    z0: Array
    z1: Array
    noise: Array | None = None
    gaps: Mapping[str, tuple[float, bool]] = field(default_factory=dict)
    row: Mapping[str, float] | None = None
    parts: int = 0

    @classmethod
    def between(cls, start: End, stop: End) -> Interval:
        """Return the interval between two ends; its length is zero if both are the same."""
        return cls(
            t0=start.t,
            t1=stop.t,
            inputs0=start.inputs,
            inputs1=stop.inputs,
            z0=start.z,
            z1=stop.z,
            noise=stop.noise,
            gaps=stop.gaps,
            parts=stop.parts,
        )

    def driven(self, held: Held) -> Interval:
        """Return the interval with held channels constant inside it; the map is idempotent."""
        first, last = self.inputs0, self.inputs1
        if first is last or not held:
            return self
        if set(last).issubset(held.next):
            return replace(self, inputs0=last)
        row = last if self.row is None else self.row
        if set(first).issubset(held.last):
            return replace(self, inputs1=first, row=row)
        first = {name: row[name] if name in held.next else x for name, x in first.items()}
        last = {name: first[name] if name in held.last else x for name, x in last.items()}
        return replace(self, inputs0=Inputs(first), inputs1=Inputs(last), row=row)

    def _weight(self, t: float) -> float:
        return (t - self.t0) / (self.t1 - self.t0)

    def at(self, t: float) -> Moment:
        """Return time and inputs at t; at the end, inputs before a switch."""
        if t == self.t1:
            return self._last
        if self.inputs0 is self.inputs1:
            return Moment(t, self._last.inputs)
        s = self._weight(t)
        inputs = {k: (1 - s) * self.inputs0[k] + s * v for k, v in self.inputs1.items()}
        if self.row is not None:  # avoid rounding errors in the values of held channels
            inputs |= {k: v for k, v in self.inputs1.items() if v == self.inputs0[k]}
        return Moment(t, Inputs(inputs))

    @cached_property
    def _last(self) -> Moment:
        return Moment(self.t1, Inputs(self.inputs1))

    @property
    def end(self) -> Moment:
        """Time and inputs of the sample at the end."""
        return self._last if self.row is None else Moment(self.t1, Inputs(self.row))

    @property
    def silent(self) -> Interval:
        """The interval without measurements at the end."""
        return replace(self, z1=np.full_like(self.z1, np.nan))

    @cached_property
    def present(self) -> Array:
        """Mask of the sensors with a value at the end, shape (sensors,)."""
        return np.isfinite(self.z1)

    def z(self, t: float) -> Array:
        """Return measurements interpolated at t; if a value at t0 is missing, the value at t1."""
        if t == self.t1:
            return self.z1
        s = self._weight(t)
        start = np.where(np.isfinite(self.z0), self.z0, self.z1)
        return (1 - s) * start + s * self.z1


def _values(inputs: Mapping[str, float], channels: tuple[str, ...]) -> Array:
    return np.array([list(map(inputs.__getitem__, channels))])


def own_noise(noise: ArrayLike) -> Array | None:
    """Return noise standard deviations of readings; None if all are sensor defaults (NaN)."""
    stds: Array = np.asarray(noise, dtype=float)
    return None if np.isnan(stds).all() else stds


def gaps_of(
    channels: Sequence[str], before: Iterable[float], again: Iterable[float]
) -> dict[str, tuple[float, bool]]:
    """Return the attribute `gaps` of an interval from durations before it and flags at its end."""
    gaps = zip(channels, before, again, strict=True)
    return {name: (past, continues > 0.0) for name, past, continues in gaps if past or continues}


class Moments(NamedTuple):
    """A time, with the input channels of each member.

    `inputs` has shape (members, channels), or (1, channels) if equal for all members. `interval` is
    the interval of a single process that contains the time, and None for members of a fleet.
    """

    t: float
    channels: tuple[str, ...]
    inputs: Array
    interval: Interval | None = None

    def member(self, k: int) -> Moment:
        if self.interval is not None:
            return self.interval.at(self.t)
        row = self.inputs[k if len(self.inputs) > 1 else 0]
        return Moment(self.t, Inputs(dict(zip(self.channels, row.tolist(), strict=True))))


@dataclass(frozen=True, eq=False, kw_only=True)
class Span:
    """Sample intervals of all members, with a common end, as arrays.

    Shapes (members, channels) and (members, sensors), or (1, channels) and (1, sensors) if equal
    for all members. See `Interval` for attributes without a comment.
    """

    # t0, t1: times of the last accepted sample of each member, (members,), and of the current one.
    t0: Array
    t1: float
    channels: tuple[str, ...]
    inputs0: Array
    inputs1: Array
    z0: Array
    z1: Array
    interval: Interval | None = None  # interval of a single process; None for members of a fleet
    noise: Array | None = None
    # Duration of the gap of each channel before this interval, and 1 if it lasts at its end, shape
    # (members, 2, channels) or (1, 2, channels); None without a gap.
    gaps: Array | None = None
    row: Array | None = None
    parts: IntArray | None = None  # shape (members,); None if not chosen yet

    @classmethod
    def of(cls, interval: Interval, channels: tuple[str, ...]) -> Span:
        first = last = NO_INPUTS
        if channels:
            first = last = _values(interval.inputs1, channels)
            if interval.inputs0 is not interval.inputs1:
                first = _values(interval.inputs0, channels)
        gaps = None
        if interval.gaps:
            gaps = np.array([interval.gaps.get(name, (0.0, False)) for name in channels]).T[None]
        return cls(
            t0=np.array([interval.t0]),
            t1=interval.t1,
            channels=channels,
            inputs0=first,
            inputs1=last,
            z0=interval.z0[None],
            z1=interval.z1[None],
            interval=interval,
            noise=None if interval.noise is None else interval.noise[None],
            gaps=gaps,
            row=None if interval.row is None else _values(interval.row, channels),
            parts=np.array([interval.parts]) if interval.parts else None,
        )

    def driven(self, held: Held) -> Span:
        """Return the span with held channels constant inside it; the map is idempotent."""
        first, last = self.inputs0, self.inputs1
        if first is last or not held:
            return self
        row = last if self.row is None else self.row
        if set(self.channels).issubset(held.next):
            return replace(self, inputs0=last)
        if set(self.channels).issubset(held.last):
            return replace(self, inputs1=first, row=row)
        first, last = held.acting(self.channels, first, last, row)
        return replace(self, inputs0=first, inputs1=last, row=row)

    @property
    def stated(self) -> Array:
        """Inputs of the sample at the end, including a switch there."""
        return self.inputs1 if self.row is None else self.row

    def __len__(self) -> int:
        return len(self.t0)

    @property
    def division(self) -> int:
        """Number of parts of every substep, equal for all members; 1 if not chosen yet."""
        return 1 if self.parts is None else int(self.parts[0])

    @property
    def start(self) -> float:
        """Most frequent start time of the members."""
        first = float(self.t0[0])
        if len(self.t0) == 1 or (self.t0 == first).all():
            return first
        times, counts = np.unique(self.t0, return_counts=True)
        return float(times[np.argmax(counts)])

    @property
    def together(self) -> Mask:
        """Mask of the members that start at `start`, shape (members,)."""
        return np.asarray(self.t0 == self.start)

    @property
    def present(self) -> Mask:
        """Mask of members with a measurement at the end, shape (members,) or (1,)."""
        finite = np.isfinite(self.z1)
        if np.count_nonzero(finite) == finite.size:
            return np.ones(len(finite), dtype=bool)
        return np.asarray(finite.any(axis=1))

    def at(self, t: float) -> Moments:
        """Return time and inputs at t for members with a common start; at t1, before a switch."""
        inputs = last = self.inputs1
        # If both ends are the same object, all inputs are constant.
        if t != self.t1 and self.inputs0 is not last:
            s = (t - self.start) / (self.t1 - self.start)
            inputs = (1 - s) * self.inputs0 + s * last
            if self.row is not None:  # avoid rounding errors in the values of held channels
                inputs = np.where(self.inputs0 == last, last, inputs)
        return Moments(t=t, channels=self.channels, inputs=inputs, interval=self.interval)

    @property
    def end(self) -> Moments:
        """Time and inputs of the sample at the end."""
        # The interval returns inputs before a switch, which differ from `stated` if there is a row.
        interval = self.interval if self.row is None else None
        return Moments(t=self.t1, channels=self.channels, inputs=self.stated, interval=interval)

    def part(self, group: IntArray) -> Span:
        def some(array: Array) -> Array:
            return array[group] if len(array) > 1 else array

        parts = {item.name: getattr(self, item.name) for item in fields(self)}
        arrays = {name: some(part) for name, part in parts.items() if isinstance(part, np.ndarray)}
        if self.inputs0 is self.inputs1:  # identity marks constant inputs, so preserve it
            arrays["inputs0"] = arrays["inputs1"]
        return Span(**(parts | arrays))

    def member(self, k: int) -> Interval:
        if self.interval is not None:
            return self.interval
        first, last, row = (
            Inputs(dict(zip(self.channels, inputs[k].tolist(), strict=True)))
            for inputs in (self.inputs0, self.inputs1, self.stated)
        )
        return Interval(
            t0=float(self.t0[k]),
            t1=self.t1,
            inputs0=first,
            inputs1=last,
            z0=self.z0[k],
            z1=self.z1[k],
            noise=None if self.noise is None else self.noise[k],
            gaps={} if self.gaps is None else gaps_of(self.channels, *self.gaps[k].tolist()),
            row=None if self.row is None else row,
            parts=0 if self.parts is None else int(self.parts[k if len(self.parts) > 1 else 0]),
        )
