"""Linear state-space forms for given unknown numbers: of a model, and of a reduced one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from livepde.errors import ModelError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array
from livepde.model import Model

# Relative difference that is attributed to rounding.
SAME = 1e-9
# Arbitrary time at which a model is evaluated to detect an explicit dependence on time.
LATER = 12345.6789


@dataclass(frozen=True, eq=False)
class Linear:
    """Linear system M u' = -K u + E c + f for the channels c.

    Attributes
    ----------
    K, E, f
        Shapes (n, n), (n, channels) and (n,); rows of fixed coefficients are undefined.
    """

    K: sp.csr_array
    E: Array
    f: Array


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Linearisation of a model at a state and inputs; exact if it is affine in both.

    Attributes
    ----------
    model
        The process.
    u, inputs
        Linearisation point: coefficients, shape (n,), and a value for each channel.
    """

    model: Model
    u: Array
    inputs: Mapping[str, float]

    @cached_property
    def moment(self) -> Moment:
        """Time zero with the inputs of the linearisation point."""
        return self._moment(0.0, {})

    def _moment(self, t: float, change: Mapping[str, float]) -> Moment:
        values = {name: self.inputs[name] + change.get(name, 0.0) for name in self.model.channels}
        return Moment(t, Inputs(values))

    def residual(self, u: Array, q: Array, moment: Moment) -> Array:
        """Return B(u) + A(u) q - F for physical coefficients q."""
        model = self.model
        a = model.latent.inverse(q)
        change: Array = model.form_A.vector("v", moment, q=a, u=u) + model.B(u, moment)
        return change - model.F(moment)

    def slope(self, q: Array, moment: Moment) -> sp.csr_array:
        """Return the derivative of the residual in u, shape (n, n)."""
        model, a = self.model, self.model.latent.inverse(q)
        slope = model.form_A.matrix("v", "u", moment, u=self.u, q=a)
        return sp.csr_array(slope + model.form_B.matrix("v", "u", moment, u=self.u))

    def at(self, q: Array) -> Linear:
        """Return the system for physical coefficients q, shape (m,)."""
        K, known = self.slope(q, self.moment), self.residual(self.u, q, self.moment)
        columns = [
            # The model is affine in its channels (see `check`): one difference gives the exact
            # column.
            known - self.residual(self.u, q, self._moment(0.0, {name: 1.0}))
            for name in self.model.channels
        ]
        E = np.column_stack(columns) if columns else np.zeros((len(known), 0))
        values = np.array([self.inputs[name] for name in self.model.channels])
        return Linear(K, E, K @ self.u - known - E @ values)

    def differ(self, one: Array, other: Array) -> bool:
        """Return True if the systems for two parameters differ."""
        free = self.model.X.free
        first, second = self.at(one), self.at(other)
        rows = np.repeat(free, np.diff(first.K.indptr))
        pairs = ((rows * first.K.data, rows * second.K.data), (first.E.T * free, second.E.T * free))
        known = (first.f * free, second.f * free)
        return any(_differ(*pair) for pair in (*pairs, known))

    def boundary(self) -> tuple[Array, Array]:
        """Return the lifting of boundary channels, (n, channels), and of known values, (n,).

        They are zero at free coefficients.
        """
        model, zero = self.model, np.zeros(self.model.X.dim)
        off = Moment(0.0, Inputs(dict.fromkeys(model.channels, 0.0)))
        known = model.impose(zero, off)
        columns = []
        for name in model.channels:
            values = dict.fromkeys(model.channels, 0.0) | {name: 1.0}
            columns.append(model.impose(zero, Moment(0.0, Inputs(values))) - known)
        return np.column_stack(columns) if columns else np.zeros((len(zero), 0)), known

    def check(self, q: Array) -> None:
        """Raise `ModelError` if the model has no linear system with constant coefficients."""
        model, free = self.model, self.model.X.free
        # An explicit dependence on time is detected by evaluation at an arbitrary other time.
        steady = self.residual(self.u, q, self.moment)
        later = self.residual(self.u, q, self._moment(LATER, {}))
        moved = model.impose(self.u, self._moment(LATER, {})) - model.impose(self.u, self.moment)
        if _differ(steady * free, later * free) or moved.any():
            raise ModelError(
                "reduce: the model reads the time. Make what changes with time an input channel, "
                "so that a controller can be given its forecast."
            )
        # A random change of all channels at once detects products of channels with the state, and
        # of channels with each other.
        rng = np.random.default_rng(0)
        change = dict(zip(model.channels, rng.standard_normal(len(model.channels)), strict=True))
        there = self._moment(0.0, change)
        if _differ(self.slope(q, self.moment).data, self.slope(q, there).data):
            raise ModelError(
                "reduce: a channel multiplies the state, so that the model is not linear in its "
                "inputs. Let it be a known number in the form, or a source or boundary value."
            )
        linear = self.at(q)
        step = np.array([change[name] for name in model.channels])
        expected = steady - linear.E @ step
        if _differ(self.residual(self.u, q, there) * free, expected * free):
            raise ModelError(
                "reduce: the model is not linear in its input channels; let a channel be what "
                "enters linearly, as the heat instead of the voltage."
            )


def _differ(one: Array, other: Array) -> bool:
    size = max(float(np.abs(one).max(initial=0.0)), float(np.abs(other).max(initial=0.0)))
    return bool(np.abs(one - other).max(initial=0.0) > SAME * size)


@dataclass(frozen=True, eq=False)
class Output:
    """Output equation of a reduced model: y = C x + D c + d for the channels c.

    Attributes
    ----------
    names
        Names of the outputs.
    C, D, d
        Shapes (outputs, r), (outputs, channels) and (outputs,).
    noise
        Measurement noise of each output as a standard deviation, shape (outputs,); None if unknown.
    """

    names: tuple[str, ...]
    C: Array
    D: Array
    d: Array
    noise: Array | None = None

    def __call__(self, x: Array, c: Array) -> Array:
        """Return the outputs, shape (outputs,)."""
        y: Array = self.C @ x + self.D @ c + self.d
        return y


@dataclass(frozen=True, eq=False)
class Discrete:
    """Discrete-time model x+ = A x + B c + f with a zero-order hold of the channels c."""

    A: Array
    B: Array
    f: Array

    def with_offset(self, offset: Array | None) -> Discrete:
        """Return the model with a constant added to the channels, shape (channels,)."""
        return self if offset is None else replace(self, f=self.f + self.B @ offset)

    def __call__(self, x: Array, c: Array) -> Array:
        """Return the state at the end of the step."""
        after: Array = self.A @ x + self.B @ c + self.f
        return after
