"""Reduced-order models that keep the unknown numbers as parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm

from livepde.control.reduction.galerkin import Discrete, GalerkinReduction, Output
from livepde.errors import ConfigurationError
from livepde.fem import Inputs, Moment
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.stepping import Advance, Alexander2, simulate

# Substeps of the full model per sample in `error`, so that its own time error is small.
FINER = 8


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """Reduced model x' = -K(q) x + E(q) c + f(q), affine in the unknown numbers q.

    The coordinates x = V^T M u refer to a basis V that is orthonormal in the mass M. They include
    boundary values, so that no time derivative of a boundary channel occurs. See `reduce`.

    Attributes
    ----------
    unknowns, channels, controls
        Labels of the unknown numbers q (m), names of all channels c, and names of the channels set
        by a controller; the others are disturbances.
    K, E, f
        Constant part and derivative by each unknown number, shapes (1 + m, r, r), (1 + m, r,
        channels) and (1 + m, r).
    outputs, sensors
        Output equations of the controlled and of the measured quantities.
    prior, std
        Prior means and standard deviations of the unknown numbers, shapes (m,).
    lower, upper
        Bounds of the unknown numbers, shapes (m,).
    frame
        Galerkin reduction of the full model.
    """

    unknowns: tuple[str, ...]
    channels: tuple[str, ...]
    controls: tuple[str, ...]
    K: Array
    E: Array
    f: Array
    outputs: Output
    sensors: Output
    prior: Array
    std: Array
    lower: Array
    upper: Array
    frame: GalerkinReduction

    @classmethod
    def of(cls, frame: GalerkinReduction, controls: tuple[str, ...]) -> ReducedModel:
        """Return the reduced model of a reduction."""
        parts, r = frame.parts(), frame.V.shape[1]
        space = frame.model.parameter_space
        unknowns = [space.unknown_of(label) for label in space.labels]
        return cls(
            unknowns=tuple(space.labels),
            channels=frame.model.channels,
            controls=controls,
            K=parts[:, :, :r],
            E=parts[:, :, r:-1],
            f=parts[:, :, -1],
            outputs=frame.output(frame.outputs),
            sensors=frame.output(frame.sensors),
            prior=space.prior[frame.rows],
            std=np.array([unknown.prior.std for unknown in unknowns]),
            lower=np.array([float(unknown.prior.bounds[0]) for unknown in unknowns]),
            upper=np.array([float(unknown.prior.bounds[1]) for unknown in unknowns]),
            frame=frame,
        )

    def __repr__(self) -> str:
        return (
            f"ReducedModel({self.size} coordinates, unknowns={list(self.unknowns)}, "
            f"controls={list(self.controls)}, disturbances={list(self.disturbances)}, "
            f"outputs={list(self.outputs.names)}, sensors={list(self.sensors.names)})"
        )

    @property
    def size(self) -> int:
        """Number of coordinates r."""
        return int(self.K.shape[1])

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Channels that are not set by a controller."""
        return tuple(name for name in self.channels if name not in self.controls)

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the positions of channels among all of them."""
        return [self.channels.index(name) for name in names]

    def values(self, inputs: Mapping[str, float]) -> Array:
        """Return the channels as an array, shape (channels,)."""
        missing = [name for name in self.channels if name not in inputs]
        if missing:
            raise ConfigurationError(
                f"The channels {missing} have no value; give one for each of {list(self.channels)}."
            )
        return np.array([float(inputs[name]) for name in self.channels])

    def system(self, q: Array) -> tuple[Array, Array, Array]:
        """Return K, E and f for unknown numbers of shape (m,)."""
        weights = np.concatenate([[1.0], q])
        K, E, f = (np.tensordot(weights, part, axes=1) for part in (self.K, self.E, self.f))
        return K, E, f

    def matrices(self, q: Array, h: float) -> Discrete:
        """Return the exact discretisation over a time h in which channels are held.

        Parameters
        ----------
        q
            Unknown numbers, shape (m,).
        """
        K, E, f = self.system(q)
        # Van Loan's method: one exponential of the augmented matrix gives A, B and f together, also
        # for singular K.
        upper, r = h * np.column_stack([-K, E, f]), self.size
        moved = expm(np.vstack([upper, np.zeros((upper.shape[1] - r, upper.shape[1]))]))[:r]
        return Discrete(moved[:, :r], moved[:, r:-1], moved[:, -1])

    def project(self, u: Array) -> Array:
        """Return the coordinates of a state of the full model, shape (r,)."""
        test = self.frame.test
        if len(u) != test.shape[1]:
            raise ConfigurationError(
                f"A state of {len(u)} coefficients; the reduced model was made from a model with "
                f"{test.shape[1]}: reduce the model that the identifier has."
            )
        x: Array = test @ u
        return x

    def lift(self, x: Array, inputs: Mapping[str, float]) -> Array:
        """Return the state of the full model for coordinates x, shape (n,)."""
        return self.frame.lift(x, self.values(inputs))

    @property
    def start(self) -> Array:
        """Coordinates of the linearisation point, shape (r,)."""
        return self.project(self.frame.u)

    def numbers(self, q: Array) -> Array:
        """Return the unknown numbers among the coefficients of a parameter, shape (m,)."""
        return np.asarray(q[self.frame.rows])

    def given(self, q: Mapping[str, float] | None) -> Array:
        """Return unknown numbers by label; others are set to the prior, shape (m,)."""
        numbers = self.prior.copy()
        for label, value in (q or {}).items():
            if label not in self.unknowns:
                raise ConfigurationError(
                    f"q names '{label}'; the unknown numbers are {list(self.unknowns)}."
                )
            k = self.unknowns.index(label)
            if not (np.isfinite(value) and self.lower[k] <= value <= self.upper[k]):
                raise ConfigurationError(
                    f"q['{label}'] must be a number from {self.lower[k]:g} to {self.upper[k]:g}; "
                    f"got {value}."
                )
            numbers[k] = value
        return numbers

    def shifted(self, q: Array, shift: Array) -> Array:
        """Return unknown numbers shifted in latent values, to first order by `shift`, (m,)."""
        space = self.frame.model.parameter_space
        moved = [
            space.unknown_of(label).prior.transform.shifted(value, abs(by), np.sign(by))
            for label, value, by in zip(self.unknowns, q, shift, strict=True)
        ]
        return np.array(moved, dtype=float)

    def seen(self, x: Array, q: Array, inputs: Mapping[str, float]) -> tuple[Array, Array]:
        """Return predicted readings, (sensors,), and their derivative in x, (sensors, r).

        Sensors that are nonlinear in the state, or depend on unknown numbers, are linearised at x
        and q.
        """
        frame, c = self.frame, self.values(inputs)
        observed = frame.sensors
        # Linear sensors have a constant output equation; all others need the lifted state of the
        # full model.
        if type(observed) is Observed and observed.linear:
            return self.sensors(x, c), self.sensors.C
        full, moment = frame.q.copy(), Moment(0.0, Inputs(inputs))
        full[frame.rows] = q
        u = frame.lift(x, c)
        H = observed.jacobian(u, full, moment)[0]
        return observed.predict(u, full, moment), np.asarray(H @ frame.V)

    def about(
        self,
        u: Array | None = None,
        q: Array | None = None,
        inputs: Mapping[str, float] | None = None,
    ) -> ReducedModel:
        """Return the model on the same basis, linearised at another point.

        Models with unknown fields or not affine in u require it. A loop does this automatically.

        Parameters
        ----------
        u, q
            Coefficients of state and parameter, shapes (n,) and (m,); default the present ones.
        inputs
            Channel -> value; other channels keep their present value.

        Raises
        ------
        ConfigurationError
            Wrong shape, or a channel that the model does not have.
        """
        frame = self.frame
        for what, given, mine in (("u", u, frame.u), ("q", q, frame.q)):
            if given is not None and np.shape(given) != mine.shape:
                raise ConfigurationError(
                    f"about: {what} has shape {np.shape(given)}; the model has {len(mine)} "
                    f"coefficients, so it needs {mine.shape}."
                )
        _known("about", inputs, self.channels)
        frame = replace(
            frame,
            u=frame.u if u is None else u,
            q=frame.q if q is None else q,
            inputs={**frame.inputs, **(inputs or {})},
        )
        return ReducedModel.of(frame, self.controls)

    def error(
        self, q: Mapping[str, float] | None = None, *, h: float, samples: int = 100
    ) -> dict[str, float]:
        """Return the relative model reduction error of each output, the largest over all times.

        It is the error of the response to a unit step of each control in turn, relative to the
        largest response of the output to any control.

        Parameters
        ----------
        q
            Unknown numbers by label; default the prior.
        h, samples
            Sampling period, and number of samples.
        """
        if not h > 0.0 or samples < 1:
            raise ConfigurationError(
                f"error: h must be positive, and samples at least 1; got {h} and {samples}."
            )
        frame, numbers = self.frame, self.given(q)
        full = frame.q.copy()
        full[frame.rows] = numbers
        step = self.matrices(numbers, h)
        size, missed = np.zeros((2, len(self.outputs.names)))
        model, times = frame.model, (h * np.arange(samples + 1)).tolist()
        for control in self.controls:
            inputs = dict(frame.inputs) | {control: frame.inputs[control] + 1.0}
            # The boundary values of the initial state must be those after the step of the control,
            # since the reduced coordinates include them.
            u0 = model.impose(frame.u, Moment(0.0, Inputs(inputs)))
            states = simulate(
                model,
                model.latent.inverse(full),
                u0,
                times,
                Advance(Alexander2(), h / FINER),
                lambda t, inputs=inputs: inputs,  # type: ignore[misc]
            )
            c, x, rows = self.values(inputs), self.project(u0), []
            for t, u in states:
                if t > 0.0:
                    x = step(x, c)
                exact = frame.outputs.predict(u, full, Moment(t, Inputs(inputs)))
                rows.append((exact, self.outputs(x, c)))
            exact, found = np.array(rows).transpose(1, 0, 2)
            size = np.maximum(size, np.abs(exact - exact[0]).max(axis=0))
            missed = np.maximum(missed, np.abs(found - exact).max(axis=0))
        worst = missed / np.where(size > 0.0, size, 1.0)
        return dict(zip(self.outputs.names, worst.tolist(), strict=True))


def _known(what: str, inputs: Mapping[str, float] | None, channels: Sequence[str]) -> None:
    for name, value in (inputs or {}).items():
        if name not in channels:
            raise ConfigurationError(
                f"{what}: inputs names '{name}'; the channels are {list(channels)}."
            )
        if not np.isfinite(value):
            raise ConfigurationError(
                f"{what}: inputs['{name}'] must be a finite number; got {value}."
            )


def reduce(
    model: Model,
    outputs: Observation,
    controls: Sequence[str],
    *,
    sensors: Observation | None = None,
    modes: int = 6,
    rates: Sequence[float] = (),
    u: Any = None,
    q: Any = None,
    inputs: Mapping[str, float] | None = None,
) -> ReducedModel:
    """Return a reduced-order model that keeps the unknown numbers as parameters.

    The basis contains the static responses to all channels, with the unknown numbers at the prior
    and at the ends of its 95 % interval, so that steady states are exact there, and the slowest
    eigenmodes. The projection is a Galerkin projection.

    Parameters
    ----------
    model
        The process, linear in its unknown numbers and its input channels. It is linearised if it is
        not affine in u.
    outputs
        Observation of the controlled or limited quantities, of the state alone. Those that are not
        linear in it are linearised at u.
    controls
        Channels set by a controller. All others are disturbances.
    sensors
        Observation of the measured quantities; default `outputs`.
    modes
        Number of eigenmodes in addition to the static responses.
    rates
        Rates (reciprocal times) at which responses are also exact: take 1/period if an output lies
        where a control acts, so that it responds at once.
    u, q, inputs
        Operating point, as u0 and q0 of `Identifier`: default zero, the prior, and zero. A model
        that is not affine in u is linearised there, and u has no default. The value of an unknown
        field is taken from q; see `ReducedModel.about`.

    Raises
    ------
    ModelError
        The model depends on time, or is not linear in unknown numbers or channels; an unknown
        number has no effect on the model linearised at u; or an output depends on unknowns, or is
        not linear in the state and u is missing.
    ConfigurationError
        A control is not a channel of the model, or the model is to be linearised and u is missing.
    """
    chosen = {*controls} & {*model.channels}
    if isinstance(controls, str) or not 0 < len(controls) == len(chosen):
        raise ConfigurationError(
            f"reduce: controls={controls!r}; the channels of the model are "
            f"{list(model.channels)}: give a list of one or more of them, each once."
        )
    _known("reduce", inputs, model.channels)
    if modes != int(modes) or modes < 0:
        raise ConfigurationError(f"reduce: modes must be a whole number, at least 0; got {modes}.")
    for rate in rates:
        if not 0.0 < rate < np.inf:
            raise ConfigurationError(f"reduce: rates must be positive numbers; got {rate}.")
    if u is None and not model.affine:
        raise ConfigurationError(
            "reduce: the model is not affine in its state, so that it is linearised at an "
            "operating point: name that with u=, a number, a function of x or coefficients."
        )
    frame = GalerkinReduction.linearised(model, outputs, sensors, u, q, inputs)
    frame.check_linear()
    frame.check_outputs(linear=u is None)
    frame = frame.with_basis(modes, rates)
    frame.check()
    return ReducedModel.of(frame, tuple(controls))
