"""Validation of the initial state and options of an identifier; construction of its problem."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from numbers import Real
from typing import Any

import numpy as np

from livepde.errors import ConfigurationError
from livepde.fem import SensorState
from livepde.laws import InitialReading, Law, Problem
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.samples import check_noise
from livepde.stepping import Advance, Scheme


def check_parts(*parts: object) -> None:
    """Raise `ConfigurationError` unless the parts are a model, an observation and a law."""
    for part, kind in zip(parts, (Model, Observation, Law), strict=True):
        if not isinstance(part, kind):
            remedy = ": call it" if isinstance(part, type) and issubclass(part, kind) else ""
            raise ConfigurationError(
                "Identifier(model, observation, law): as "
                f"{kind.__name__.lower()}, got {part!r:.80}{remedy}."
            )


def time_option(name: str, value: Any) -> float:
    """Return the value of a time option as a float; raise `ConfigurationError` for other types."""
    if np.ndim(value) or np.asarray(value).dtype.kind not in "iuf" or math.isnan(value):
        raise ConfigurationError(
            f"{name} must be a number, in the unit of time of the model; got {value!r}."
        )
    return float(value)


def check_kinds(validation: Any, scheme: Any) -> None:
    """Raise `ConfigurationError` if `validation` or `scheme` has a wrong type."""
    for option, value, kind, expected in (
        ("validation", validation, Observation, "an observation, such as Points"),
        ("scheme", scheme, Scheme, "a time scheme, such as Alexander2()"),
    ):
        if value is not None and not isinstance(value, kind):
            raise ConfigurationError(f"{option}: got {value!r:.80}; expected {expected}.")


def check_start(model: Model, t0: float, u0: Any, uncertain: Mapping[str, Any]) -> None:
    """Raise `ConfigurationError` for a non-finite t0, or a missing or repeated initial state."""
    if not np.isfinite(t0):
        raise ConfigurationError(f"t0 must be a finite number; got {t0}.")
    for name, stated in uncertain.items():
        if stated and u0 is None:
            raise ConfigurationError(f"{name} describes u0: give u0, too.")
    if u0 is not None and model.form_initial is not None:
        raise ConfigurationError("the model has its own initial state (initial=): leave out u0.")


def assumes_zero(model: Model, u0: Any) -> bool:
    """Return whether no initial state is specified, so that zero is assumed."""
    return u0 is None and model.form_initial is None


def check_ignored(names: Iterable[str], validation: tuple[str, ...]) -> None:
    """Raise `ConfigurationError` if an ignored sensor is not a validation sensor."""
    for name in names:
        if name not in validation:
            raise ConfigurationError(
                f"ignored: '{name}' is none of the sensors in validation, {list(validation)}."
            )


def with_sensors(
    model: Model, observation: Observation, validation: Observation | None = None
) -> Model:
    """Return the model with the unknowns of its sensors and the states of slow sensors."""
    unknowns = model.parameter_space.unknowns
    added = {name: item for name, item in observation.unknowns.items() if name not in unknowns}
    model = model.with_unknowns(added) if added else model
    states = {**_states_of_validation(validation), **observation.states}
    added_states = {name: state for name, state in states.items() if name not in model.sensors}
    return model.with_sensors(added_states) if added_states else model


def _states_of_validation(validation: Observation | None) -> Mapping[str, SensorState]:
    """Return the states of slow validation sensors, whose time constants must be known."""
    states = {} if validation is None else validation.states
    for name, state in states.items():
        if state.unknown:
            raise ConfigurationError(
                f"validation: the time constant of '{name}' is an unknown, which only assimilated "
                "sensors have: give a number."
            )
    return states


def stated_problem(
    model: Model,
    observed: Observed,
    control: Advance,
    u0: Any,
    *,
    input_noise: Mapping[str, float] | None,
    u0_from: Mapping[str, Any] | None,
    u0_errors: Iterable[Any],
) -> Problem:
    """Return the problem defined by the options of an identifier."""
    noise = _input_noise(model, input_noise or {})
    readings = initial_readings(model, observed, u0_from or {})
    return Problem(model, observed, control, noise, readings, initial_errors(model, u0_errors), u0)


def _input_noise(model: Model, given: Mapping[str, float]) -> dict[str, float]:
    stds: Mapping[str, Any] = given
    for name, std in stds.items():
        if name not in model.channels:
            raise ConfigurationError(
                f"input_noise: the model has no channel '{name}'; it has "
                f"{list(model.channels)}. Specify the noise of sensors in the observation."
            )
        if not (isinstance(std, Real) and 0.0 < float(std) < math.inf):
            raise ConfigurationError(
                f"input_noise of '{name}' must be a positive number; got {std!r}."
            )
    return dict(given)


def initial_readings(
    model: Model, observed: Observed, u0_from: Mapping[str, Any]
) -> dict[str, InitialReading]:
    """Return the readings from which u0 was computed, each with the derivative of u0."""
    known = {*observed.names, *model.channels}
    for name in u0_from:
        if name not in known:
            raise ConfigurationError(
                f"u0_from: '{name}' is neither an assimilated sensor nor a channel of the "
                f"model; these are {sorted(known)}."
            )
    readings = {}
    for name, stated in u0_from.items():
        weight, noise = stated if isinstance(stated, tuple) else (stated, math.nan)
        coefficients = model.state_space.interpolate(weight)
        readings[name] = InitialReading(coefficients, check_noise(name, noise))
    return readings


def initial_errors(model: Model, u0_errors: Iterable[Any]) -> Array:
    """Return coefficients of the independent errors of u0, shape (errors, n)."""
    coefficients = np.array([model.state_space.interpolate(error) for error in u0_errors])
    coefficients = coefficients.reshape(-1, model.X.dim)
    if not np.isfinite(coefficients).all():
        raise ConfigurationError("u0_errors: an error of u0 is not finite; give finite values.")
    return coefficients
