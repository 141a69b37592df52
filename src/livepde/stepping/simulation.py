"""Time integration of the forward model with a known parameter."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from livepde.fem import Moment
from livepde.linalg import Array
from livepde.model import Model
from livepde.stepping.interval import Interval
from livepde.stepping.schemes import Advance, advance
from livepde.stepping.state import ForwardStage


def simulate(
    model: Model,
    q: Array,
    u0: Any,
    times: Sequence[float],
    control: Advance,
    inputs: Callable[[float], Any] | None = None,
) -> Iterator[tuple[float, Array]]:
    """Yield (t, u) of the forward model at the given times, the first being the initial time.

    Parameters
    ----------
    q
        Coefficients of the parameter, shape (m,).
    u0
        Initial state: a number, a function of x, or coefficients.
    inputs
        Function t -> mapping of input channels.

    Raises
    ------
    StepFailed
        A step failed even when halved as often as `control` allows.
    """
    values = inputs or (lambda t: {})
    forward = ForwardStage(model)
    none = np.zeros(0)
    u = model.impose(model.initial_values(u0), Moment(times[0], values(times[0])))
    yield times[0], u
    for t0, t1 in pairwise(times):
        interval = Interval(t0=t0, t1=t1, inputs0=values(t0), inputs1=values(t1), z0=none, z1=none)

        # The interval is a default, since a closure would see that of a later round.
        def stage(c: Array, t: float, h: float, interval: Interval = interval) -> Array:
            return forward.solve(c, q, h, interval.at(t))

        u, _, failure = advance(control, stage, u, t0, t1)
        if failure is not None:
            raise failure
        yield t1, u
