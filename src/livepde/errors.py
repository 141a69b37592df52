"""The exceptions of livepde.

::

    LivepdeError
    ├── ConfigurationError          parts or options that do not fit together
    │   ├── SpaceError              mesh, element, inner product, prior
    │   ├── ModelError              weak forms and their arguments
    │   │   └── NameClashError      a name with two meanings in a run's dataset
    │   ├── ObservationError        sensors, subdomains, matrices
    │   ├── LawError                an update law that does not support the problem
    │   └── CaseError               a case file: wrong key, value, unit, range
    ├── DataError                   one sample that cannot be used; the estimate is unchanged
    │   ├── SampleError             wrong shape, text, infinity, unknown channel
    │   ├── TimeOrderError          time going backwards
    │   ├── MissingInputError       an input without any value yet
    │   └── OffsetError             a batch that does not continue at the offset of a shard
    ├── RunError                    a run directory that is occupied, missing or damaged
    └── LinearAlgebraError          a matrix that cannot be factorised

A step that fails numerically raises no exception: the `Status` of the estimate reports it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = [
    "CaseError",
    "ConfigurationError",
    "DataError",
    "LawError",
    "LinearAlgebraError",
    "LivepdeError",
    "MissingInputError",
    "ModelError",
    "NameClashError",
    "ObservationError",
    "OffsetError",
    "RunError",
    "SampleError",
    "SpaceError",
    "TimeOrderError",
]


class LivepdeError(Exception):
    """Base class of all errors of livepde; messages contain place, problem and remedy.

    Examples
    --------
    >>> import livepde as lp
    >>> try:
    ...     lp.LogNormal(-1.0, std=0.1)
    ... except lp.LivepdeError as error:
    ...     print(type(error).__name__)
    SpaceError
    """


class ConfigurationError(LivepdeError, ValueError):
    """Parts that do not fit together."""


class SpaceError(ConfigurationError):
    """A mesh, element, inner product or prior that does not give a Hilbert space."""


class ModelError(ConfigurationError):
    """A weak form that cannot be evaluated or is not linear where it must be."""


class NameClashError(ModelError):
    """Unknowns or components with names that have another meaning in a run's dataset."""


class ObservationError(ConfigurationError):
    """Sensors that do not fit the state space."""


class LawError(ConfigurationError):
    """An update law that does not support the problem."""


class CaseError(ConfigurationError):
    """A case file with a wrong key, value, unit or range."""


class DataError(LivepdeError, ValueError):
    """A sample that cannot be used; the estimate is unchanged."""


class SampleError(DataError):
    """A sample with a wrong shape, an infinite value, text, or an unknown channel."""


class TimeOrderError(DataError):
    """A sample that is not later than the previous sample."""


class MissingInputError(DataError):
    """An input or boundary channel without any value yet."""


class OffsetError(DataError):
    """A batch that does not begin at the offset of a shard: repeated, or after a gap."""


class RunError(LivepdeError, OSError):
    """A run directory that is occupied, missing or damaged."""


class LinearAlgebraError(LivepdeError, ArithmeticError):
    """A matrix that is singular to working precision."""


def require_positive(what: str, value: float, kind: type[LivepdeError]) -> None:
    """Raise an error of type `kind` unless a number is positive and finite."""
    if not (math.isfinite(value) and value > 0):
        raise kind(f"{what} must be a positive number; got {value}.")


@contextmanager
def optional(
    extra: str, what: str, kind: type[LivepdeError] = ConfigurationError
) -> Iterator[None]:
    """Convert the ImportError of an optional package to an error that names its extra.

    >>> with optional("mqtt", "MQTT needs paho-mqtt"):
    ...     import no_such_package
    Traceback (most recent call last):
    livepde.errors.ConfigurationError: MQTT needs paho-mqtt: pip install 'livepde[mqtt]'.
    """
    try:
        yield
    except ImportError as error:
        raise kind(f"{what}: pip install 'livepde[{extra}]'.") from error
