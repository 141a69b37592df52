"""How large an error of the time step may be: small against the noise of the sensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from livepde.laws.filter_state import FilterState
from livepde.laws.law import Problem
from livepde.linalg import Array
from livepde.stepping import Moments, Span

# Of the noise of a reading: the error of one step, root mean square over the domain. A front that
# passes a sensor shows the errors of ten to twenty steps, in a few readings: with this share they
# shift the unknowns by less than 0.3 standard deviations (tests/test_step_choice.py).
ALLOWED = 0.03


@dataclass(frozen=True, eq=False)
class StepTolerance:
    """Size of an error of the state in units of what is allowed.

    A component of the state counts by its root mean square, times the largest reading, in units of
    its noise, of a state of size one: constant, or linear in a coordinate. So components that no
    sensor sees do not count.
    """

    problem: Problem  # model and sensors
    # Readings of rows of state and reduced unknowns: `MemberSensors.rows`.
    rows: Callable[[FilterState, Array, Array, Moments], Array]
    noise: Array  # standard deviation of each sensor, shape (sensors,)

    @cached_property
    def _weights(self) -> Array:
        """Weights of the squares of coefficients in the mean square of each part, (parts, n)."""
        model = self.problem.model
        mass = np.maximum(model.mass.diagonal(), 0.0)
        found = []
        for part in model.state_space.parts.values():
            weights = np.zeros(len(mass))
            weights[part] = mass[part] / max(float(mass[part].sum()), 1e-300)
            found.append(weights)
        return np.array(found)

    @cached_property
    def _tests(self) -> tuple[Array, Array]:
        """States of size one, (tests, n), and the part of each."""
        space = self.problem.model.state_space
        states, parts = [], []
        for number, (name, block) in enumerate(space.fields.items()):
            p = block.field.mesh.p
            middle, half = 0.5 * (p.max(axis=1) + p.min(axis=1)), 0.5 * np.ptp(p, axis=1)
            functions = [lambda x: np.ones(x.shape[1:])]
            for axis in np.flatnonzero(half > 0.0):
                functions.append(
                    lambda x, i=axis, m=middle, w=half: (x[i] - m[i]) / w[i]  # type: ignore[misc]
                )
            for function in functions:
                state = np.zeros(space.dim)
                state[space.part(name)] = block.interpolate(function)
                states.append(state)
                parts.append(number)
        return np.array(states), np.array(parts)

    def excess(self, error: Array, x: FilterState, span: Span) -> Array:
        """Return the sizes of errors of the state after a span, (members, n), over what is allowed.

        A reading counts by its noise if that is smaller than the noise of its sensor.
        """
        (states, parts), at = self._tests, span.end
        noise = self.noise if span.noise is None else np.fmin(self.noise, span.noise)
        members, k = len(error), x.C.shape[2]
        U = np.broadcast_to(states, (members, *states.shape))
        seen = self.rows(x, U, np.zeros((members, len(states), k)), at)
        seen = np.abs(seen)
        if np.isnan(at.inputs).any():
            # A sensor whose place is missing shows nothing now: elsewhere it shows values.
            seen = np.where(np.isnan(seen) | ~seen.any(axis=1, keepdims=True), 1.0, seen)
        level = np.sqrt(x.level)[:, None]
        gain = (seen / noise[..., None, :]).max(axis=2, initial=0.0) / level
        sizes = np.sqrt((error * error) @ self._weights.T)  # (members, parts)
        found = (gain * sizes[:, parts]).max(axis=1, initial=0.0) / ALLOWED
        return np.where(np.isfinite(found), found, 0.0)
