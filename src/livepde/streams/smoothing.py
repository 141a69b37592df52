"""Causal smoothers as stages of a stream (section 3.3).

The theory wants data that are smooth in time, ||(z^delta - z)_t||_Z <= delta~(t), "which can be
achieved by averaging over sufficiently large time intervals". A stage yields a smoothed sample as
soon as each sample arrives:

    smoothed = LocalPolynomial(width=1.0, degree=2)(stream)
    for sample in smoothed:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        smoothed.std, smoothed.d_rate

Smoothing reduces the noise but may add a lag, which is documented for each stage.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import Any

import numpy as np

from livepde.errors import ConfigurationError, SampleError
from livepde.linalg import Array, Mask
from livepde.samples import Sample, in_order

LARGEST_MEMO = 256  # largest number of stored weights, for spacings and patterns of missing values
RESOLUTION = 1e-9  # offsets that differ by less, relative to the width, have the same weights


class Weights(ABC):
    """Memory and weights of a smoother: z~_k = sum_j w_kj z_j, sum_j w_kj = 1."""

    @abstractmethod
    def add(self, t: float, z: Array) -> tuple[Array, Array, Array]:
        """Process a sample; return z~_k and two variances, relative to that of the raw noise.

        The first, sum_j w_kj^2, is the variance of the noise of z~_k. The second, of the noise of
        z~_k - z~_k-1, is sum_j (w_kj - w_k-1,j)^2, and NaN for the first sample. All have the shape
        (channels,), NaN where z is missing.
        """


@dataclass(frozen=True, kw_only=True)
class Smoother(ABC):
    """A causal smoother: a function of a stream that returns the smoothed stream.

    Parameters
    ----------
    noise
        Standard deviation of the raw noise: a number, or a number for each channel. By default it
        is estimated from all samples so far, by the residuals of values to the straight line
        between their two neighbours (Gasser, Sroka and Jennen-Steinmetz 1986). The estimate assumes
        independent noise in each sample and is biased only by the curvature of the signal.
    channels
        Names of the channels to smooth, for samples with names; default: all channels of the first
        sample except its inputs. Inputs and other channels are passed unchanged, without lag.
    """

    noise: float | Sequence[float] | None = None
    channels: Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.noise is not None:
            noise = np.asarray(self.noise, dtype=float)
            if noise.ndim > 1 or not (np.isfinite(noise).all() and np.all(noise > 0)):
                raise ConfigurationError(
                    f"{type(self).__name__}: noise must be a positive number, or one for each "
                    f"channel; got {self.noise!r}."
                )

    @abstractmethod
    def weights(self) -> Weights:
        """Return weights without samples in memory."""

    @abstractmethod
    def noise_factor(self, h: float) -> float:
        """Return the limit of std / sigma for samples at intervals h with white noise."""

    def __call__(self, stream: Iterable[Any]) -> Smoothed:
        """Return the smoothed stream; its items are `Sample`, (t, z) or (t, z, inputs)."""
        return Smoothed(self, stream)


class Smoothed(Iterable[Sample]):
    """A smoothed stream, with the noise level of the last sample.

    A missing value remains missing: smoothing does not fill gaps.

    Attributes
    ----------
    std
        Standard deviation of the noise of the smoothed channels, sigma sqrt(sum_j w_kj^2), shape
        (channels,); to be used as `noise` of the observation.
    d_rate
        The contribution of noise to d~ = (d_alpha^delta)_t for each channel: the root mean square
        rate of change of the smoothed noise,

            sigma sqrt(sum_j (w_kj - w_k-1,j)^2) / (t_k - t_k-1),

        shape (channels,), NaN for the first sample. The contribution of the lag, the rate of z~ - z
        without noise, is not included.
    sigma
        Standard deviation of the raw noise, specified or estimated, shape (channels,).
    """

    def __init__(self, smoother: Smoother, stream: Iterable[Any]) -> None:
        self.smoother = smoother
        self.stream = stream
        self._reset()

    def _reset(self) -> None:
        self.std = self.d_rate = self.sigma = np.zeros(0)
        self._names: tuple[str, ...] | None = None
        self._noise: _NoiseLevel | None = None

    def __iter__(self) -> Iterator[Sample]:
        self._reset()
        weights = self.smoother.weights()
        before = -np.inf
        for sample in in_order(self.stream, "smoothing"):
            t = float(sample.t)
            z = self._read(sample)
            smooth, variance, change = weights.add(t, z)
            self._learn(t, z)
            self.std = self.sigma * np.sqrt(variance)
            self.d_rate = self.sigma * np.sqrt(change) / (t - before)
            before = t
            yield self._write(sample, smooth)

    def __len__(self) -> int:
        if not isinstance(self.stream, Sized):
            raise TypeError(f"a stream of type {type(self.stream).__name__} has no length")
        return len(self.stream)

    def norm_d_rate(self, gram: Array | None = None) -> float:
        """Return the root mean square of ||d~||_Z after the last sample, from `d_rate`.

        For `Subdomain` and G^+ this norm is ||d~||_X; G_alpha only reduces it in X. The channels
        are assumed to be independent. Under the link conditions (cond:link), the last theorem of
        the paper bounds the limit superior of ||q^ - q*||_Q by 2 gamma_0 / epsilon_0 times the
        supremum of the norm over time (th:parameter_noisesmooth). Only a vanishing data error
        satisfies these conditions.

        Parameters
        ----------
        gram
            Gram matrix of Z, shape (channels, channels); default the identity.
        """
        rate = np.nan_to_num(self.d_rate)
        scale = np.ones_like(rate) if gram is None else np.diag(gram)
        return float(np.sqrt(scale @ rate**2))

    def _read(self, sample: Sample) -> Array:
        if not isinstance(sample.z, Mapping):
            return np.atleast_1d(np.asarray(sample.z, dtype=float))
        if self._names is None:
            chosen = self.smoother.channels
            if chosen is None:
                chosen = [name for name in sample.z if name not in (sample.inputs or {})]
            self._names = tuple(chosen)
        given = [sample.z.get(name) for name in self._names]
        return np.array([np.nan if value is None else float(value) for value in given])

    def _write(self, sample: Sample, smooth: Array) -> Sample:
        if not isinstance(sample.z, Mapping):
            return Sample(t=sample.t, z=smooth, inputs=sample.inputs)
        named = dict(sample.z)
        for name, value in zip(self._names or (), smooth.tolist(), strict=True):
            if name in named:
                named[name] = value
        return Sample(t=sample.t, z=named, inputs=sample.inputs)

    def _learn(self, t: float, z: Array) -> None:
        if self.smoother.noise is not None:
            given = np.asarray(self.smoother.noise, dtype=float)
            if given.ndim == 1 and given.shape != z.shape:
                raise ConfigurationError(
                    f"{type(self.smoother).__name__}: {given.size} values of noise for "
                    f"{z.size} channels; give one, or one each."
                )
            self.sigma = np.broadcast_to(given, z.shape)
            return
        if self._noise is None:
            self._noise = _NoiseLevel(z.shape)
        self.sigma = self._noise.add(t, z)


class _NoiseLevel:
    """Standard deviation of white noise, from residuals to the line between two neighbours."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        # The last two values of each channel and their times, in order.
        self.z = np.full((2, *shape), np.nan)
        self.t = np.full((2, *shape), np.nan)
        self.squares = np.zeros(shape)
        self.counts = np.zeros(shape)

    def add(self, t: float, z: Array) -> Array:
        """Process a sample; return the standard deviation so far, NaN where it is unknown."""
        present = np.isfinite(z)
        # The residual z_1 - (1 - s) z_0 - s z, with t_1 = (1 - s) t_0 + s t, has the variance
        # sigma^2 (1 + (1 - s)^2 + s^2) for white noise; the curvature of the signal is neglected.
        share = (self.t[1] - self.t[0]) / (t - self.t[0])
        rest = self.z[1] - (1.0 - share) * self.z[0] - share * z
        complete = present & np.isfinite(rest)
        scale = 1.0 + (1.0 - share) ** 2 + share**2
        self.squares[complete] += rest[complete] ** 2 / scale[complete]
        self.counts[complete] += 1.0
        self.z[0, present], self.t[0, present] = self.z[1, present], self.t[1, present]
        self.z[1, present], self.t[1, present] = z[present], t
        sigma = np.full(z.shape, np.nan)
        known = self.counts > 0
        sigma[known] = np.sqrt(self.squares[known] / self.counts[known])
        return sigma


class _Window(Weights):
    """Weights from the offsets t_j - t_k of the samples in a window (t_k - width, t_k]."""

    def __init__(self, smoother: _WindowSmoother) -> None:
        self.smoother = smoother
        self.times: list[float] = []
        self.values: list[Array] = []
        self.last: Array = np.zeros((0, 0))
        self._memo: dict[bytes, Array] = {}

    def add(self, t: float, z: Array) -> tuple[Array, Array, Array]:
        if self.values and self.values[-1].shape != z.shape:
            raise SampleError(
                f"smoothing: a sample of shape {z.shape} after samples of "
                f"shape {self.values[-1].shape}."
            )
        self.times.append(t)
        self.values.append(z)
        width = self.smoother.width
        # A sample at the start of the window (t - width, t] is outside, regardless of rounding.
        gone = 0
        while self.times[gone] <= t - width * (1 - RESOLUTION):
            gone += 1
        del self.times[:gone], self.values[:gone]
        values = np.array(self.values)
        weights = self._weights(np.array(self.times) - t, np.isfinite(values))
        change = np.full(z.shape, np.nan)
        if len(self.last):
            # Contributions of samples in both windows, samples that left, and new samples.
            kept = self.last[gone:]
            change = ((weights[: len(kept)] - kept) ** 2).sum(axis=0)
            change += (self.last[:gone] ** 2).sum(axis=0) + (weights[len(kept) :] ** 2).sum(axis=0)
        self.last = weights
        smooth = (weights * np.nan_to_num(values)).sum(axis=0)
        variance = (weights**2).sum(axis=0)
        return smooth, variance, change

    def _weights(self, offsets: Array, present: Any) -> Array:
        """Return weights of shape (samples, channels), NaN where the newest value is missing."""
        weights = np.zeros(present.shape)
        if present.all():
            weights[:] = self._of(offsets)[:, None]
            return weights
        # Channels with the same missing samples have the same weights.
        patterns, which = np.unique(present.T, axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            column = np.zeros(len(offsets))
            if pattern[-1]:
                column[pattern] = self._of(offsets[pattern])
            else:
                column[:] = np.nan
            weights[:, which.ravel() == k] = column[:, None]
        return weights

    def _of(self, offsets: Array) -> Array:
        # Equidistant samples always have the same offsets, up to rounding.
        rounded = np.round(offsets / (self.smoother.width * RESOLUTION))
        key = rounded.tobytes()
        if key not in self._memo:
            if len(self._memo) >= LARGEST_MEMO:
                self._memo.clear()
            self._memo[key] = self.smoother.window(rounded * RESOLUTION)
        return self._memo[key]


@dataclass(frozen=True)
class _WindowSmoother(Smoother):
    """A smoother over the samples in the window (t - width, t]."""

    width: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive(self, "width", self.width)

    def weights(self) -> Weights:
        return _Window(self)

    def noise_factor(self, h: float) -> float:
        _positive(self, "h", h)
        count = int(np.ceil(self.width * (1 - RESOLUTION) / h))
        offsets: Array = -h / self.width * np.arange(count, dtype=float)[::-1]
        return float(np.linalg.norm(self.window(offsets)))

    @abstractmethod
    def window(self, s: Array) -> Array:
        """Return the weights of samples at times t_k + width · s, -1 < s <= 0 and s[-1] = 0."""


def _positive(owner: object, name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ConfigurationError(
            f"{type(owner).__name__}: {name} must be a positive number; got {value}."
        )


@dataclass(frozen=True)
class WindowAverage(_WindowSmoother):
    """The mean over the samples in the window (t - width, t].

    Exact for constants. A linear trend is delayed by the lag: t_k minus the mean of the times, half
    the width for equidistant samples. The standard deviation of the noise is inversely proportional
    to the square root of the number of samples.

    >>> stage = WindowAverage(3.0, noise=1.0)([(0, [0.0]), (1, [1.0]), (2, [2.0]), (3, [3.0])])
    >>> [float(sample.z[0]) for sample in stage], stage.std.round(3).tolist()
    ([0.0, 0.5, 1.0, 2.0], [0.577])
    """

    def window(self, s: Array) -> Array:
        return np.full(len(s), 1.0 / len(s))


@dataclass(frozen=True)
class LocalPolynomial(_WindowSmoother):
    """The value at t of the least-squares polynomial through the samples in (t - width, t].

    Exact for polynomials up to `degree` at any spacing of the samples, so that a linear trend has
    no lag (degree >= 1). The error for a smooth signal is of order width^(degree + 1). The variance
    of the noise is about (degree + 1)^2 over the number of samples. With fewer than degree + 1
    samples, the degree is reduced.

    Parameters
    ----------
    width
        Length of the window, in the unit of time.
    degree
        Degree of the polynomial, >= 0; 0 is `WindowAverage`.
    """

    degree: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.degree < 0:
            raise ConfigurationError(f"LocalPolynomial: degree must be >= 0; got {self.degree}.")

    def window(self, s: Array) -> Array:
        degree = min(self.degree, len(s) - 1)
        powers = np.vander(s, degree + 1, increasing=True)
        # The row of the constant term: the value of the polynomial at the newest sample, s = 0.
        fit: Array = np.linalg.pinv(powers)[0]
        return fit


@dataclass(frozen=True)
class Exponential(Smoother):
    """Exponential smoothing, z~_k = z~_k-1 + a (z_k - z~_k-1), a = 1 - exp(-(t_k - t_k-1)/time).

    Exact for constants. The lag is h (1 - a)/a for equidistant samples, about `time`. For each
    channel, t_k-1 is the time of its last sample with a value.

    Parameters
    ----------
    time
        Time constant, in the unit of time.
    """

    time: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive(self, "time", self.time)

    def weights(self) -> Weights:
        return _Fading(self.time)

    def noise_factor(self, h: float) -> float:
        _positive(self, "h", h)
        # Fixed point of the recursion of the variance, v = (1 - a)^2 v + a^2.
        share = float(-np.expm1(-h / self.time))
        return float(np.sqrt(share / (2.0 - share)))


@dataclass
class _Fading(Weights):
    time: float
    # Smoothed value, variance and time of the last sample with a value, for each channel.
    state: tuple[Array, Array, Array] | None = None
    seen: Mask | None = None  # whether the last sample had a value, for each channel

    def add(self, t: float, z: Array) -> tuple[Array, Array, Array]:
        present = np.isfinite(z)
        if self.state is None or self.seen is None:
            nothing = np.full(z.shape, np.nan)
            self.state, self.seen = (nothing, nothing, nothing), np.zeros_like(present)
        smooth, variance, times = self.state
        if smooth.shape != z.shape:
            raise SampleError(
                f"smoothing: a sample of shape {z.shape} after samples of shape {smooth.shape}."
            )
        first = present & np.isnan(smooth)
        share = -np.expm1(-(t - times) / self.time)
        # z~_k - z~_k-1 = a (z_k - z~_k-1), where the noises of z_k and z~_k-1 are independent.
        change = share**2 * (1.0 + variance)
        new = np.where(first, z, smooth + share * (z - smooth))
        spread = np.where(first, 1.0, (1.0 - share) ** 2 * variance + share**2)
        result = (
            np.where(present, new, np.nan),
            np.where(present, spread, np.nan),
            np.where(present & self.seen, change, np.nan),
        )
        self.state = (
            np.where(present, new, smooth),
            np.where(present, spread, variance),
            np.where(present, t, times),
        )
        self.seen = present
        return result
