"""Twin experiments: samples of a simulated process with known truth, and errors of estimates.

Only this module uses `q_true` and `u_true`. An identifier receives the samples, never the twin.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from livepde.errors import ConfigurationError
from livepde.estimate import Estimate
from livepde.fem import Moment
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.samples import Sample
from livepde.stepping import Advance, Alexander2, Scheme, StepFailed, simulate

Truth = Literal["analytic", "discrete", "fine"]
Formula = Callable[[Any, float], Any]


class Noise(ABC):
    """Gaussian noise, independent from channel to channel and from sample to sample."""

    @abstractmethod
    def std(self, z: Array, weights: Array | sp.csr_array) -> Array:
        """Return the standard deviation of each channel for exact data z, shape (sensors,).

        Parameters
        ----------
        z
            Exact data, shape (sensors,).
        weights
            Gram matrix of Z, shape (sensors, sensors), so that ||z||_Z^2 = z^T weights z.
        """


@dataclass(frozen=True)
class RelativeNoise(Noise):
    """Noise of a given size relative to each sample: E ||noise||_Z^2 = level^2 ||z||_Z^2.

    Every channel has the same share of the mean square, independent of its unit:
    std_k = level ||z||_Z / sqrt(sensors · weights_kk). In R^k with the Euclidean norm, this is
    level times the root mean square of z. For the slopes of Hermite elements, it is about 1/h times
    the standard deviation of the values, as if slopes were differences of values.
    """

    level: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.level) and self.level >= 0):
            raise ConfigurationError(
                f"RelativeNoise: level must be a number >= 0, 0.01 for 1 %; got {self.level}."
            )

    def std(self, z: Array, weights: Array | sp.csr_array) -> Array:
        size = float(np.sqrt(max(float(z @ (weights @ z)), 0.0)))
        std: Array = self.level * size / np.sqrt(len(z) * weights.diagonal())
        return std


@dataclass(frozen=True)
class AbsoluteNoise(Noise):
    """Noise with a given standard deviation: a number, or a number for each channel."""

    deviation: float | Sequence[float]

    def __post_init__(self) -> None:
        given = np.asarray(self.deviation, dtype=float)
        if given.ndim > 1 or not (np.isfinite(given).all() and np.all(given >= 0)):
            raise ConfigurationError(
                f"AbsoluteNoise: expected one number >= 0, or one for each channel; got "
                f"{self.deviation!r}."
            )

    def std(self, z: Array, weights: Array | sp.csr_array) -> Array:
        given = np.asarray(self.deviation, dtype=float)
        if given.shape not in ((), z.shape):
            raise ConfigurationError(
                f"AbsoluteNoise: {given.size} standard deviations for {len(z)} channels; give "
                "one, or one each."
            )
        return np.broadcast_to(given, z.shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class Twin:
    """A simulated process with known truth; an iterable of `Sample`, independent of the estimator.

    Parameters
    ----------
    model, observation
        Model and observation of the estimator.
    q_true
        The exact parameter: a number, a function of x, coefficients, or a mapping by name.
    times
        Increasing sample times. The first is the initial time, with a sample of the initial state.
    u_true
        Formula of the exact state, u(x, t); for several components, a mapping from names to
        formulas.
    u0
        Initial state if there is no formula: a number, a function of x, or coefficients. Without
        both, the model must define an initial state (`initial`), which is evaluated for q_true.
    truth
        Origin of the exact data.

        "discrete"
            Solution of `model` with q_true, `scheme` and `dt_max`. It has the discretisation of the
            estimator, thus no truncation error (the "inverse crime", which isolates the performance
            of the law).
        "analytic"
            The formula u_true, projected onto the state space. The data then deviate from the
            estimator's scheme by its discretisation error.
        "fine"
            Solution of the model `fine` (a finer mesh, other elements), with steps up to `fine_dt`.
            `portable` sensors (`Points`, `Averages`, ...) observe the fine state itself. For a
            `Subdomain`, `Full` or `Matrix`, whose channels are coefficients of the estimator, the
            fine state is projected onto the estimator's state space.
    scheme, dt_max
        Time scheme of the truth and its longest substep. The default is of second order. For exact
        data of a `GradientLaw`, specify its scheme, implicit Euler.
    fine, fine_dt
        Model (default: `model`) and longest substep of "fine".
    noise
        `RelativeNoise`, `AbsoluteNoise` or None. The same seed gives the same noise.
    seed
        Seed of the noise.
    inputs
        Function of t that returns the values of the model's inputs, which samples contain.

    Raises
    ------
    ConfigurationError
        The arguments that `truth` requires are missing or inconsistent.

    Examples
    --------
    >>> import numpy as np, livepde as lp
    >>> from skfem import ElementLineP1
    >>> rod = lp.Field(lp.interval(0, 1, 10), ElementLineP1(), dirichlet={"boundary": 0.0})
    >>> model = lp.Model(rod, lp.Normal(1.0), lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)))
    >>> twin = Twin(
    ...     model=model,
    ...     observation=lp.Points([0.3]),
    ...     q_true=2.0,
    ...     u0=lambda x: np.sin(np.pi * x[0]),
    ...     times=[0.0, 0.1, 0.2],
    ... )
    >>> [sample.t for sample in twin], twin.baseline()
    ([0.0, 0.1, 0.2], 0.5)
    """

    model: Model
    observation: Observation
    q_true: Any
    times: Sequence[float] | npt.NDArray[np.floating]
    u_true: Formula | Mapping[str, Formula] | None = None
    u0: Any = None
    truth: Truth = "discrete"
    scheme: Scheme = field(default_factory=Alexander2)
    dt_max: float = np.inf
    fine: Model | None = None
    fine_dt: float = np.inf
    noise: Noise | None = None
    seed: int = 0
    inputs: Callable[[float], Mapping[str, float]] | None = None

    def __post_init__(self) -> None:
        if self.truth not in get_args(Truth):
            raise ConfigurationError(
                f"truth='{self.truth}': expected one of {', '.join(get_args(Truth))}."
            )
        times = np.asarray(self.times, dtype=float)
        if times.ndim != 1 or len(times) < 2 or not np.all(np.diff(times) > 0):
            raise ConfigurationError("times must be two or more increasing numbers.")
        if self.truth == "analytic" and self.u_true is None:
            raise ConfigurationError("truth='analytic' needs the formula u_true(x, t).")
        self._check_start()
        if self.truth == "fine" and self.fine is None and not np.isfinite(self.fine_dt):
            raise ConfigurationError("truth='fine' needs a model `fine`, a `fine_dt`, or both.")

    def _check_start(self) -> None:
        """Refuse a twin whose initial state is missing or specified twice."""
        begun = self.model.form_initial is not None
        if begun and self.u0 is not None:
            raise ConfigurationError("the model has its own initial state: leave out u0.")
        if self.u_true is None and self.u0 is None and not begun:
            raise ConfigurationError("give u_true(x, t), or the initial state u0.")

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Sample]:
        rng = np.random.default_rng(self.seed)
        for t, z in zip(self.times, self.exact_data, strict=True):
            if self.noise is not None:
                z = z + self.noise.std(z, self._gram) * rng.standard_normal(len(z))
            yield Sample(t=float(t), z=z.copy(), inputs=self._inputs(float(t)) or None)

    def _inputs(self, t: float) -> Mapping[str, float]:
        return self.inputs(t) if self.inputs is not None else {}

    def _moment(self, t: float) -> Moment:
        return Moment(float(t), self._inputs(float(t)))

    @cached_property
    def observed(self) -> Observed:
        """The observation bound to the estimator's state space."""
        return _bound(self.observation, self.model)

    @cached_property
    def weights(self) -> Array:
        """Gram matrix of Z, shape (sensors, sensors).

        If z are coefficients of the state on omega, ||z||_Z = ||G^+ z||_X; else it is Euclidean.
        """
        weights: Array = self._gram.toarray()
        return weights

    @cached_property
    def _gram(self) -> sp.csr_array:
        if not self.observation.nodal:
            return sp.csr_array(sp.eye_array(self.observed.size))
        # ||z||_Z = ||G^+ z||_X: the Gram matrix is (G^+)^T M G^+ with the mass matrix M of X.
        inverse = self.observed.split().inverse
        return sp.csr_array(inverse.T @ self.model.mass @ inverse)

    @cached_property
    def q(self) -> Array:
        """Coefficients of q_true in the estimator's Q, shape (m,)."""
        return self.model.parameter_space.interpolate(self.q_true)

    def _start(self, model: Model, q: Array) -> Any:
        t = float(self.times[0])
        if self.u_true is not None:
            return self._exact(t)
        return model.initial_state(q, self._moment(t)) if self.u0 is None else self.u0

    def _exact(self, t: float) -> Any:
        """Return u_true at a time: a function of x, or a mapping from names to functions."""
        if isinstance(self.u_true, Mapping):
            return {name: partial(_at, formula, t) for name, formula in self.u_true.items()}
        return partial(_at, self.u_true, t)

    def _simulated(self, model: Model, control: Advance) -> list[Array]:
        q = model.latent.inverse(model.parameter_space.interpolate(self.q_true))
        times = [float(t) for t in self.times]
        try:
            run = simulate(model, q, self._start(model, q), times, control, self._inputs)
            return [u for _, u in run]
        except StepFailed as failure:
            raise ConfigurationError(
                f"the truth of the twin experiment cannot be computed ({failure}): take a smaller "
                "dt_max, or check q_true and u0."
            ) from failure

    @cached_property
    def _fine_states(self) -> list[Array]:
        control = Advance(self.scheme, min(self.fine_dt, self.dt_max))
        return self._simulated(self.fine or self.model, control)

    @cached_property
    def states(self) -> tuple[Array, ...]:
        """Exact state at each time as coefficients of the estimator, each of shape (n,)."""
        if self.truth == "discrete":
            return tuple(self._simulated(self.model, Advance(self.scheme, self.dt_max)))
        space = self.model.state_space
        if self.truth == "analytic" and self.u_true is not None:
            found = [space.interpolate(self._exact(float(t))) for t in self.times]
        elif self.fine is None:
            return tuple(self._fine_states)
        else:
            # The fine state is evaluated at the estimator's quadrature points and projected.
            parts = []
            for name, block in space.fields.items():
                points, of = block.measure.points, "" if space.single else name
                probe = self.fine.state_space.probe(points.reshape(len(points), -1), of=of)
                parts.append([block.project(probe @ u) for u in self._fine_states])
            found = list(map(np.concatenate, zip(*parts, strict=True)))
        times = map(self._moment, self.times)
        return tuple(self.model.impose(u, at) for u, at in zip(found, times, strict=True))

    @cached_property
    def exact_data(self) -> Array:
        """Data without noise, shape (times, sensors)."""
        model, observed, states = self.model, self.observed, self.states
        # Portable sensors observe the fine state itself, without the error of its projection.
        if self.truth == "fine" and self.fine is not None and self.observation.portable:
            model, states = self.fine, tuple(self._fine_states)
            observed = _bound(self.observation, model)
        times = map(self._moment, self.times)
        return np.array(
            [observed.predict(u, self.q, at) for u, at in zip(states, times, strict=True)]
        )

    def u(self, t: float) -> Array:
        """Return the exact state at a sample time as coefficients of the estimator, shape (n,)."""
        found = np.flatnonzero(np.isclose(self.times, t, rtol=1e-12, atol=0.0))
        if not len(found):
            raise ConfigurationError(f"t = {t} is not a sample time of the twin experiment.")
        return self.states[int(found[0])]

    def error(self, q: Array, unknown: str | None = None) -> float:
        """Return the relative L2 error of q, ||q - q_true|| / ||q_true||.

        Parameters
        ----------
        q
            Coefficients in Q, shape (m,).
        unknown
            Name of an unknown; default: all unknowns (numbers contribute their square).
        """
        space = self.model.parameter_space
        part = slice(None) if unknown is None else space.part(unknown)
        mass = self.model.parameter_mass[part, part]
        e, exact = (q - self.q)[part], self.q[part]
        size = float(exact @ (mass @ exact))
        if size == 0.0:
            raise ConfigurationError("q_true is zero, so there is no relative error of q.")
        return float(np.sqrt(e @ (mass @ e) / size))

    def baseline(self, q0: Any = None, unknown: str | None = None) -> float:
        """Return the relative L2 error of q0, by default of the prior mean: without any data."""
        return self.error(self.model.latent.value(self.model.initial_parameter(q0)), unknown)

    def u_error(self, estimate: Estimate) -> float:
        """Return the relative error of the state in X, ||u - u_true|| / ||u_true||."""
        exact, X = self.u(estimate.t), self.model.X
        return X.norm(estimate.u - exact) / X.norm(exact)

    def energy(self, estimate: Estimate, gain: float = 1.0) -> float:
        """Return ||e||_Q^2 + ||r||_X^2 with e = q - q_true and r = R (u - u_true).

        This energy does not increase in the exact-data method (align:neplusnr) if the parameter is
        constant and the model is linear in it. e is the difference of latent coefficients.

        Parameters
        ----------
        gain
            Gain of the law, by which the inner product of Q is divided.
        """
        latent = self.model.latent
        e = latent.inverse(estimate.q) - latent.inverse(self.q)
        r = self.observed.split().R @ (estimate.u - self.u(estimate.t))
        return self.model.Q.inner(e, e) / gain + self.model.X.inner(r, r)


def _at(formula: Any, t: float, x: Any) -> Any:
    return formula(x, t)


def _bound(observation: Observation, model: Model) -> Observed:
    return observation.bind(model.state_space, model.X, model.parameter_space)
