"""Time schemes as sequences of implicit Euler stages, and step control within an interval.

A *stage* solves M (y - c)/h + R(t, y) = 0 for y. Every scheme here is a sequence of such stages, so
a law implements a single implicit equation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeAlias

import numpy as np

from livepde.errors import ConfigurationError
from livepde.linalg import Array
from livepde.stepping.interval import LINES, Held
from livepde.stepping.newton import StepFailed

# A context variable instead of an attribute of a control: a refit in another thread must not be
# interrupted.
CHECK: ContextVar[Callable[[], None] | None] = ContextVar("livepde_interruption", default=None)


def safe_point() -> None:
    """Call the function set by `interruptible`, if any; to be called before each substep."""
    check = CHECK.get()
    if check is not None:
        check()


@contextmanager
def interruptible(check: Callable[[], None]) -> Iterator[None]:
    """Call `check` before each substep within the context; its exceptions end the computation."""
    token = CHECK.set(check)
    try:
        yield
    finally:
        CHECK.reset(token)


# An interval of more than MOST_SUBSTEPS substeps of `dt_max`, such as a pause of the source, has
# LONG_SUBSTEPS longer ones. Hourly readings with steps of 1 s stay below the limit, and any pause
# takes seconds for a rod. The schemes are L-stable, and shadows divide substeps with large errors.
MOST_SUBSTEPS, LONG_SUBSTEPS = 10_000, 1000
# With more halvings a substep would be shorter than the resolution of usual times.
MOST_HALVINGS = 30
# For a solution proportional to the square root of time, three halvings reduce the error of the
# first steps to a tenth, at the cost of six additional substeps.
MOST_GRADES = 3

# Relative rounding error of a length from its ends: seconds since 1970 have a resolution of
# 2.4e-7 s.
ROUNDING = 1e-5

Stage: TypeAlias = Callable[[Array, float, float], Array]
"""(c, t, h) -> y with M (y - c)/h + R(t, y) = 0."""


@dataclass(frozen=True)
class Scheme(ABC):
    """A one-step method composed of implicit stages."""

    order: ClassVar[int]

    @property
    @abstractmethod
    def weight(self) -> float:
        """Weight of the last stage in the quadrature; the other stages share the remainder."""

    @abstractmethod
    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        """Return the solution at t + h from y at t."""


@dataclass(frozen=True)
class ImplicitEuler(Scheme):
    """The paper's scheme: one stage, first order, L-stable.

    Examples
    --------
    >>> import livepde as lp
    >>> lp.Advance(lp.ImplicitEuler()).scheme.order
    1
    """

    order: ClassVar[int] = 1

    @property
    def weight(self) -> float:
        return 1.0

    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        return stage(y, t + h, h)


@dataclass(frozen=True)
class Alexander2(Scheme):
    """Alexander's two-stage SDIRK: second order, L-stable, stiffly accurate (1977).

    Both stages have the same matrix; gamma = 1 - 1/sqrt(2).

    Examples
    --------
    >>> import livepde as lp
    >>> lp.Advance(lp.Alexander2()).scheme.order
    2
    """

    order: ClassVar[int] = 2
    gamma: ClassVar[float] = 1.0 - np.sqrt(0.5)

    @property
    def weight(self) -> float:
        return self.gamma

    def advance(self, stage: Stage, y: Array, t: float, h: float) -> Array:
        g = self.gamma
        first = stage(y, t + g * h, g * h)
        # The second stage starts from y + (1 - gamma) h k_1 with h k_1 = (first - y)/gamma.
        return stage(y + (1 - g) / g * (first - y), t + h, g * h)


@dataclass(frozen=True)
class Advance:
    """Step control: time scheme, substeps, and halving after a failure.

    Parameters
    ----------
    scheme
        Time scheme.
    dt_max
        Longest substep; a longer interval is divided evenly. An interval of more than
        `MOST_SUBSTEPS` substeps is divided into `LONG_SUBSTEPS` longer ones.
    halvings
        Maximum number of successive halvings of a failed substep; 0: no retry.
    held
        Input channels that are constant between readings; the others are linear.
    parts
        Number of parts of every substep, to repeat an interval with shorter steps.
    start
        Initial time. Unless `halvings` is 0, substeps near it are graded: they are halved at most
        three times while they are longer than half of the time since then. Data that are
        incompatible with the initial state, such as a sudden heat flux, cause a boundary layer
        that grows with the square root of time.

    Examples
    --------
    >>> import livepde as lp
    >>> control = lp.Advance(lp.Alexander2(), dt_max=0.5)
    >>> control.count(2.0)
    4
    """

    scheme: Scheme
    dt_max: float = np.inf
    halvings: int = 8
    held: Held = LINES
    parts: int = 1
    start: float = math.nan

    def __post_init__(self) -> None:
        halvings: Any = self.halvings
        integer = isinstance(halvings, int | np.integer) and not isinstance(halvings, bool)
        if not (integer and 0 <= halvings <= MOST_HALVINGS):
            raise ConfigurationError(
                f"halvings must be a whole number from 0 to {MOST_HALVINGS}; got {halvings!r}."
            )

    def divided(self, parts: int) -> Advance:
        """Return the control with every substep divided into `parts` parts."""
        return self if parts == 1 else replace(self, parts=parts * self.parts)

    def count(self, length: float) -> int:
        """Return the number of equal substeps of an interval of a given length."""
        if length <= self.dt_max:
            return self.parts
        # The factor keeps rounding of the length from adding a substep when dt_max divides it.
        if self.stretches(length):
            return self.parts * LONG_SUBSTEPS
        return self.parts * math.ceil(length / self.dt_max * (1 - ROUNDING))

    def stretches(self, length: float) -> bool:
        """Return whether an interval of a given length has substeps longer than `dt_max`."""
        return length * (1 - ROUNDING) > MOST_SUBSTEPS * self.dt_max

    def grade(self, t: float, h: float) -> int:
        """Return the number of halvings of a substep h at t due to grading near the start."""
        elapsed = t - self.start
        # The factor keeps rounding of the times from halving a step that is half of `elapsed`.
        longest = 0.5 * elapsed * (1 + ROUNDING)
        if not self.halvings or longest >= h or not elapsed >= 0.0:
            return 0
        return sum(longest < h / 2**k for k in range(MOST_GRADES))


def advance(
    control: Advance,
    stage: Stage,
    y: Array,
    t0: float,
    t1: float,
    begin: Callable[[float, float], object] = lambda t, h: None,
) -> tuple[Array, int, StepFailed | None]:
    """Advance y from t0 to t1 by the substeps of a control.

    Times are computed from integer counts, never accumulated. `begin` is called with start and
    length of each attempted substep.

    Returns the state after the last successful substep, the number of successful substeps, and the
    failure of the shortest substep; None if the end of the interval is reached.
    """
    count = control.count(t1 - t0)
    h = control.parts * (t1 - t0) / count
    grades = control.grade(t0, h)
    # A substep has 2^k ticks, where k is the maximum number of halvings.
    ticks = 1 << (control.halvings + grades)
    finest = count * ticks
    width = (t1 - t0) / finest
    # Time is counted in ticks of the finest halving, so that all times are integer multiples of
    # `width`.
    tick, steps = 0, 0
    stride = longest = ticks >> grades
    while tick < finest:
        t = t0 + tick * width
        stop = t1 if tick + stride == finest else t0 + (tick + stride) * width
        # Differences of equidistant times differ by rounding errors. Rounding lengths to 16 units
        # in the last place of the larger time makes them identical, so that equal steps share a
        # factorised matrix. Very short steps are excluded, as rounding would change them.
        unit, length = 16.0 * math.ulp(max(stop, -t)), stop - t
        length = round(length / unit) * unit if length > 1e6 * unit else length
        safe_point()
        begin(t, length)
        try:
            y = control.scheme.advance(stage, y, t, length)
        except StepFailed as failure:
            if stride << control.halvings <= longest:
                return y, steps, failure
            stride >>= 1
            continue
        steps += 1
        tick += stride
        # Longest substep that may start here; it is shorter near the initial time.
        longest = ticks >> control.grade(t0 + tick * width, h) if grades else ticks
        # A stride is doubled only at a multiple of its double, so that substeps remain on the grid
        # of halvings.
        if 2 * stride <= longest and tick % (2 * stride) == 0:
            stride <<= 1
    return y, steps, None
