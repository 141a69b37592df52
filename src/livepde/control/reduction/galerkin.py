"""Galerkin reduction of a model: linearisation, basis of static responses and modes, systems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import eigs, eigsh, splu

from livepde.errors import ConfigurationError, ModelError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed

# Relative difference that is attributed to rounding.
SAME = 1e-9
# Arbitrary time at which a model is evaluated to detect an explicit dependence on time.
LATER = 12345.6789
# Shift of static responses relative to the fastest rate, for processes without a steady state.
SHIFT = 1e-9
# Relative size below which a direction of the snapshots is dropped.
KEPT = 1e-4
# Relative asymmetry that is attributed to rounding.
SYMMETRIC = 1e-10
# Probability of the interval of an unknown number whose ends define the responses in the basis.
LIKELY = 0.95
# Relative nonlinearity in the unknown numbers that is attributed to rounding.
LINEAR = 1e-8

Linear: TypeAlias = tuple[sp.csr_array, Array]
"""K and [E, f] of M u' = -K u + E c + f for the channels c; fixed rows are undefined."""


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


def _modes(K: sp.csc_array, M: sp.csc_array, count: int, shift: float) -> Array:
    """Return the slowest eigenmodes; real and imaginary parts for a nonsymmetric K."""
    n = K.shape[0]
    start, count = np.ones(n), min(count, n - 2)
    if count < 1:  # the basis consists of static responses only
        return np.zeros((n, 0))
    if abs(K - K.T).max() <= SYMMETRIC * abs(K).max():
        return np.asarray(eigsh(K, count, M, sigma=-shift, v0=start)[1])
    _, vectors = eigs(K, count, M, sigma=-shift, v0=start)
    both = np.hstack([vectors.real, vectors.imag])
    return np.asarray(both[:, np.linalg.norm(both, axis=0) > 0.0])


def _orthonormal(columns: Array, M: sp.csc_array) -> Array:
    """Return the dominant directions of columns, orthonormal in M."""
    if not columns.shape[1]:
        return columns
    weights, axes = np.linalg.eigh(columns.T @ (M @ columns))
    kept = weights > KEPT**2 * weights.max()
    found = columns @ (axes[:, kept][:, ::-1] / np.sqrt(weights[kept][::-1]))
    root = np.linalg.cholesky(found.T @ (M @ found))  # again: the Gram matrix has lost digits
    return np.asarray(np.linalg.solve(root, found.T).T)


@dataclass(frozen=True, eq=False)
class GalerkinReduction:
    """Data of a Galerkin reduction: full model, basis and linearisation point."""

    model: Model  # the full model
    # outputs, sensors: controlled and measured quantities, as observations bound to the full model
    outputs: Observed
    sensors: Observed
    V: Array  # basis, shape (n, r)
    test: Array  # V^T M, shape (r, n); the dual basis in M if V is not orthonormal
    # u, q, inputs: state, parameter and channel -> value of the linearisation point
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
        """Return the data at a linearisation point, with an empty basis."""
        given = dict.fromkeys(model.channels, 0.0) | dict(inputs or {})
        physical = model.latent.value(model.initial_parameter(q))
        start = model.initial(0.0 if u is None else u, Moment(0.0, Inputs(given)))
        if not np.isfinite(start).all():
            raise ConfigurationError(
                "reduce: u is not finite; give the state where it is linearised."
            )
        spaces = (model.state_space, model.X, model.parameter_space)
        seen = outputs.bind(*spaces)
        measured = seen if sensors is None else sensors.bind(*spaces)
        empty = np.zeros((model.X.dim, 0))
        return cls(model, seen, measured, empty, empty.T, start, physical, given)

    def with_basis(self, modes: int, rates: Sequence[float]) -> GalerkinReduction:
        """Return the reduction on an M-orthonormal basis, zero on fixed coefficients.

        It contains the static responses and the responses to inputs exp(rate t) at each of
        `extremes`, and the slowest eigenmodes at the linearisation point.
        """
        mass, free = self.model.mass, np.flatnonzero(self.model.X.free)
        M = sp.csc_array(mass[free][:, free])
        static, slowest = [], np.zeros((len(free), 0))
        for k, (whole, loads) in enumerate(map(self.at, self.extremes())):
            K = sp.csc_array(whole[free][:, free])
            # A small multiple of M makes K + rate M regular: a process with insulated boundaries
            # has no steady state, and its static response would be infinite.
            shift = SHIFT * float(abs(K).sum(axis=1).max() / M.sum(axis=1).max())
            driven = np.ascontiguousarray((loads - whole @ self.boundary)[free])
            static += [splu(sp.csc_array(K + rate * M)).solve(driven) for rate in (shift, *rates)]
            if k == 0 and modes:
                slowest = _modes(K, M, modes, shift)
        responses = np.hstack(static)
        size = np.sqrt(np.maximum(np.einsum("ik,ik->k", responses, M @ responses), 0.0))
        responses = responses[:, size > 0.0] / size[size > 0.0]
        found = _orthonormal(np.hstack([_orthonormal(responses, M), slowest]), M)
        V = np.zeros((mass.shape[0], found.shape[1]))
        V[free] = found
        return replace(self, V=V, test=V.T @ mass)

    @property
    def rows(self) -> list[int]:
        """Positions of the unknown numbers among the coefficients of the parameter."""
        return list(self.model.parameter_space.labels.values())

    @property
    def moves(self) -> bool:
        """True if the systems depend on the linearisation point beyond the unknown numbers."""
        return bool(self.model.parameter_space.fields) or not self.model.affine

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
        # The model is affine in its channels (see `check_linear`): one difference gives the exact
        # column.
        moments = [self._moment(0.0, {name: 1.0}) for name in self.model.channels]
        E = np.column_stack([known - self.residual(self.u, q, moment) for moment in moments])
        values = np.array([self.inputs[name] for name in self.model.channels])
        return K, np.column_stack([E, K @ self.u - known - E @ values])

    def differ(self, one: Array, other: Array) -> bool:
        """Return True if the systems for two parameters differ."""
        free, systems = self.model.X.free, (self.at(one), self.at(other))
        rows = np.repeat(free, np.diff(systems[0][0].indptr))
        parts = (
            (rows * K.data, loads[:, :-1].T * free, loads[:, -1] * free) for K, loads in systems
        )
        return any(map(_differ, *parts))

    @cached_property
    def boundary(self) -> Array:
        """Lifting of boundary channels and of known boundary values, shape (n, channels + 1)."""
        model, zero = self.model, np.zeros(self.model.X.dim)
        off = dict.fromkeys(model.channels, 0.0)
        known = model.impose(zero, Moment(0.0, Inputs(off)))
        columns = [
            model.impose(zero, Moment(0.0, Inputs({**off, name: 1.0}))) - known
            for name in model.channels
        ]
        return np.column_stack([*columns, known])

    def lift(self, x: Array, c: Array) -> Array:
        """Return the state of the full model for coordinates and channels."""
        fixed = self.boundary @ np.append(c, 1.0)
        u: Array = fixed + self.V @ (x - self.test @ fixed)
        return u

    def extremes(self) -> list[Array]:
        """Return the reference parameter, and for each number its two ends of an interval."""
        found, space = [self.q], self.model.parameter_space
        for label, k in space.labels.items():
            unknown = space.unknown_of(label)
            for end in unknown.interval(unknown.prior.centre, unknown.prior.std, LIKELY):
                found.append(self.q.copy())
                found[-1][k] = end
        return found

    def values(self) -> list[Array]:
        """Return parameters at which systems are sampled: the reference, then one per number."""
        reference, *ends = self.extremes()
        pairs = zip(ends[::2], ends[1::2], self.rows, strict=True)
        return [reference, *(high if high[k] > self.q[k] else low for low, high, k in pairs)]

    def parts(self) -> Array:
        """Return [K, E, f] as a constant part and a derivative by each unknown number.

        Shape (1 + m, r, r + channels + 1).
        """
        values = self.values()
        systems = [self._projected(q) for q in values]
        slopes = [
            (systems[k + 1] - systems[0]) / (values[k + 1][row] - self.q[row])
            for k, row in enumerate(self.rows)
        ]
        constant = systems[0] - sum(
            (self.q[row] * slope for row, slope in zip(self.rows, slopes, strict=True)),
            np.zeros_like(systems[0]),
        )
        return np.array([constant, *slopes])

    def _projected(self, q: Array) -> Array:
        """Return [K, E, f] projected on the basis, shape (r, r + channels + 1)."""
        # K acts on u = fixed + V (x - V^T M fixed), where fixed are boundary values.
        (whole, loads), fixed = self.at(q), self.boundary
        K: Array = self.V.T @ (whole @ self.V)
        driven = self.V.T @ (loads - whole @ fixed)
        return np.column_stack([K, driven + K @ (self.test @ fixed)])

    def check_linear(self) -> None:
        """Raise `ModelError` if the model has no linear system with constant coefficients."""
        model, free, q = self.model, self.model.X.free, self.q
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
        expected = steady - self.at(q)[1][:, :-1] @ np.array([*change.values()])
        if _differ(self.residual(self.u, q, there) * free, expected * free):
            raise ModelError(
                "reduce: the model is not linear in its input channels; let a channel be what "
                "enters linearly, as the heat instead of the voltage."
            )

    def check(self) -> None:
        """Raise `ModelError` if unknown numbers do not enter linearly, or vanish from the model."""
        self._check_effects()
        # The parts, made at the ends of single numbers, must give the system where all are halfway.
        both = self.q + 0.5 * sum((q - self.q for q in self.values()[1:]), np.zeros_like(self.q))
        expected = np.tensordot(np.array([1.0, *both[self.rows]]), self.parts(), axes=1)
        found = self._projected(both)
        if np.abs(found - expected).max() > LINEAR * np.abs(expected).max():
            raise ModelError(
                "reduce: the model is not linear in its unknown numbers, so no reduced model has "
                "them as parameters. Write it linear in them. They may have LogNormal priors."
            )

    def check_outputs(self, *, linear: bool) -> None:
        """Raise `ModelError` if an output depends on unknowns, or is not linear in the state.

        `linear`: whether a dependence on the state is refused that is not linear; else outputs are
        linearised at u.
        """
        there = self._elsewhere()
        latent, seen = self.model.latent, self.outputs
        a, rng = latent.inverse(self.q), np.random.default_rng(0)
        moved = np.clip(
            a + latent.deviations * rng.uniform(0.1, 1.0, len(a)) * self.model.Q.free,
            *latent.bounds,
        )
        with np.errstate(all="ignore"):  # of a function that is not defined everywhere
            known, other, start, middle = (
                seen.predict(u, q, self.moment)
                for u, q in (
                    (there, self.q),
                    (there, latent.value(moved)),
                    (self.u, self.q),
                    (0.5 * (self.u + there), self.q),
                )
            )
        for k, name in enumerate(seen.names):
            if np.isfinite([known[k], other[k]]).all() and _differ(known[[k]], other[[k]]):
                raise ModelError(
                    f"reduce: the output '{name}' depends on unknowns, and would stay at their "
                    "prior. Let outputs depend on the state alone."
                )
            ends = 0.5 * (start[[k]] + known[[k]])
            if linear and np.isfinite([ends[0], middle[k]]).all() and _differ(ends, middle[[k]]):
                raise ModelError(
                    f"reduce: the output '{name}' is not linear in the state, so that it is "
                    "linearised at an operating point: name that with u=."
                )

    def _elsewhere(self) -> Array:
        """Return a random state with the boundary values of the linearisation point."""
        free, rng = self.model.X.free, np.random.default_rng(0)
        u: Array = self.u + free * (1.0 + np.abs(self.u).max()) * rng.standard_normal(len(free))
        return u

    def _check_effects(self) -> None:
        """Raise `ModelError` if an unknown number drops out by linearisation."""
        if self.model.affine:
            return
        there = replace(self, u=self._elsewhere())
        for label, q in zip(self.model.parameter_space.labels, self.values()[1:], strict=True):
            if there.differ(self.q, q) and not self.differ(self.q, q):
                raise ModelError(
                    f"reduce: '{label}' has no effect on the model linearised at this state, as a "
                    "coefficient of u has none at u = 0: name another operating point with u=."
                )

    def output(self, observed: Observed) -> Output:
        """Return the output equation of an observation in reduced coordinates."""
        y = observed.predict(self.u, self.q, self.moment)
        H = np.asarray(observed.jacobian(self.u, self.q, self.moment)[0].toarray())
        C = H @ self.V
        # The lifted state, fixed + V (x - V^T M fixed), is affine in x and in the channels.
        fixed = (H - C @ self.test) @ self.boundary
        d = y - H @ self.u + fixed[:, -1]
        return Output(tuple(observed.names), C, fixed[:, :-1], d, observed.noise)
