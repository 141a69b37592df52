"""Galerkin reduction of a full model: basis, linearisation point, projected systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from livepde.control.linear import Linear, Linearisation, Output
from livepde.errors import ConfigurationError, ModelError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed

# Probability of the interval of an unknown number whose ends define the responses in the basis.
LIKELY = 0.95
# Relative nonlinearity in the unknown numbers that is attributed to rounding.
LINEAR = 1e-8


@dataclass(frozen=True, eq=False)
class GalerkinReduction:
    """Data of a Galerkin reduction: full model, basis and linearisation point.

    Attributes
    ----------
    model
        The full model.
    outputs, sensors
        Controlled and measured quantities, as observations bound to the full model.
    V, test
        Basis, shape (n, r), and V^T M, shape (r, n).
    u, q, inputs
        Linearisation point: state, parameter, and value of each channel.
    """

    model: Model
    outputs: Observed
    sensors: Observed
    V: Array
    test: Array
    u: Array
    q: Array
    inputs: Mapping[str, float]

    @classmethod
    def linearised(
        cls,
        model: Model,
        outputs: Observation,
        sensors: Observation | None,
        u: Any,
        q: Any,
        inputs: Mapping[str, float] | None,
    ) -> GalerkinReduction:
        """Return the data at a linearisation point, with a basis that is still empty."""
        given = dict.fromkeys(model.channels, 0.0) | dict(inputs or {})
        physical = model.latent.value(model.initial_parameter(q))
        start = model.initial(0.0 if u is None else u, Moment(0.0, Inputs(given)))
        if not np.isfinite(start).all():
            raise ConfigurationError(
                "reduce: u is not finite; give the state where it is linearised."
            )
        spaces, n = (model.state_space, model.X, model.parameter_space), model.X.dim
        seen = outputs.bind(*spaces)
        measured = seen if sensors is None else sensors.bind(*spaces)
        empty, test = np.zeros((n, 0)), np.zeros((0, n))
        return cls(model, seen, measured, empty, test, start, physical, given)

    @property
    def rows(self) -> list[int]:
        """Positions of the unknown numbers among the coefficients of the parameter."""
        return list(self.model.parameter_space.labels.values())

    @property
    def moves(self) -> bool:
        """True if the systems depend on the linearisation point beyond the unknown numbers."""
        return bool(self.model.parameter_space.fields) or not self.model.affine

    @cached_property
    def linearisation(self) -> Linearisation:
        """Linearisation of the full model."""
        return Linearisation(self.model, self.u, self.inputs)

    @cached_property
    def boundary(self) -> tuple[Array, Array]:
        """Lifting of boundary channels and values, as in `Linearisation.boundary`."""
        return self.linearisation.boundary()

    def lift(self, x: Array, c: Array) -> Array:
        """Return the state of the full model for coordinates and channels."""
        W, known = self.boundary
        fixed = W @ c + known
        u: Array = fixed + self.V @ (x - self.test @ fixed)
        return u

    def moved(
        self, u: Array | None, q: Array | None, inputs: Mapping[str, float] | None
    ) -> GalerkinReduction:
        """Return the reduction with another linearisation point."""
        return replace(
            self,
            u=self.u if u is None else u,
            q=self.q if q is None else q,
            inputs={**self.inputs, **(inputs or {})},
        )

    def extremes(self) -> list[Array]:
        """Return the reference parameter, and those with one number at an end of its interval."""
        found, space = [self.q], self.model.parameter_space
        for label, k in space.labels.items():
            for end in likely(space, label):
                found.append(self.q.copy())
                found[-1][k] = end
        return found

    def values(self) -> list[Array]:
        """Return parameters at which systems are sampled: the reference, then one per number."""
        found, space = [self.q], self.model.parameter_space
        for label, k in space.labels.items():
            low, high = likely(space, label)
            other = self.q.copy()
            other[k] = high if high > other[k] else low
            found.append(other)
        return found

    def parts(self) -> Array:
        """Return [K, E, f] as a constant part and a derivative by each unknown number.

        Shape (1 + m, r, r + channels + 1).
        """
        values = self.values()
        systems = [self._projected(self.linearisation.at(q)) for q in values]
        slopes = [
            (systems[k + 1] - systems[0]) / (values[k + 1][row] - self.q[row])
            for k, row in enumerate(self.rows)
        ]
        constant = systems[0] - sum(
            (self.q[row] * slope for row, slope in zip(self.rows, slopes, strict=True)),
            np.zeros_like(systems[0]),
        )
        return np.array([constant, *slopes])

    def _projected(self, system: Linear) -> Array:
        """Return [K, E, f] projected on the basis, shape (r, r + channels + 1)."""
        # K acts on u = fixed + V (x - V^T M fixed), where fixed = W c + known are boundary values.
        W, known = self.boundary
        fixed = np.column_stack([W, known])
        K: Array = self.V.T @ (system.K @ self.V)
        driven = self.V.T @ (np.column_stack([system.E, system.f]) - system.K @ fixed)
        return np.column_stack([K, driven + K @ (self.test @ fixed)])

    def check(self) -> None:
        """Raise `ModelError` if unknown numbers do not enter linearly, or vanish from the model."""
        self._check_effects()
        # The parts, made at the ends of single numbers, must give the system where all are halfway.
        both = self.q + 0.5 * sum((q - self.q for q in self.values()[1:]), np.zeros_like(self.q))
        expected = np.tensordot(np.array([1.0, *both[self.rows]]), self.parts(), axes=1)
        found = self._projected(self.linearisation.at(both))
        if np.abs(found - expected).max() > LINEAR * np.abs(expected).max():
            raise ModelError(
                "reduce: the model is not linear in its unknown numbers, so no reduced model has "
                "them as parameters. Write it linear in them. They may have LogNormal priors."
            )

    def _check_effects(self) -> None:
        """Raise `ModelError` if an unknown number drops out by linearisation."""
        if self.model.affine:
            return
        free = self.model.X.free
        rng = np.random.default_rng(0)
        elsewhere = self.u + free * (1.0 + np.abs(self.u).max()) * rng.standard_normal(len(free))
        here, there = self.linearisation, replace(self.linearisation, u=elsewhere)
        for label, q in zip(self.model.parameter_space.labels, self.values()[1:], strict=True):
            if there.differ(self.q, q) and not here.differ(self.q, q):
                raise ModelError(
                    f"reduce: '{label}' has no effect on the model linearised at this state, as a "
                    "coefficient of u has none at u = 0: name another operating point with u=."
                )

    def output(self, observed: Observed) -> Output:
        """Return the output equation of an observation in reduced coordinates."""
        moment = self.linearisation.moment
        W, known = self.boundary
        y = observed.predict(self.u, self.q, moment)
        H = np.asarray(observed.jacobian(self.u, self.q, moment)[0].toarray())
        # The lifted state is W c + known + V (x - V^T M (W c + known)), which is affine in x and c.
        C = H @ self.V
        D = H @ W - C @ (self.test @ W)
        d = y - H @ self.u + H @ known - C @ (self.test @ known)
        return Output(tuple(observed.names), C, D, d, observed.noise)


def likely(space: Any, label: str) -> tuple[float, float]:
    """Return the ends of the prior's 95 % interval of an unknown number."""
    unknown = space.unknown_of(label)
    low, high = unknown.interval(unknown.prior.centre, unknown.prior.std, LIKELY)
    return float(low), float(high)
