"""An identifier as an online learner: features in, what the sensors show out."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from livepde.errors import ConfigurationError, SampleError
from livepde.identifier import Identifier
from livepde.result import Estimate

__all__ = ["OnlineRegressor", "river_regressor"]


class OnlineRegressor:
    """Learns and predicts one sample at a time, by the names that online learners use.

    A sample has features x, a mapping with the time and the inputs by their names, and a target y:
    what the sensors show, a number if there is one sensor, else a mapping from sensor to number.
    Missing features hold their last value, missing targets (None, NaN) are not learned from.

    Parameters
    ----------
    identifier
        Where learning begins; it stays as it is.
    time
        The feature that is the time.

    Attributes
    ----------
    current
        The identifier that learns.
    estimate
        Of the last sample that was learned; None before.
    """

    def __init__(self, identifier: Identifier, time: str = "t") -> None:
        self.identifier = identifier
        self.time = time
        self.current = copy.deepcopy(identifier)
        self.estimate: Estimate | None = None

    def learn_one(self, x: Mapping[str, Any], y: Any) -> None:
        """Take one sample; how it went says `estimate.status`.

        Raises
        ------
        DataError
            A sample that cannot be used, as `Identifier.step` says.
        """
        t, inputs = self._features(x)
        targets = dict(y or {}) if isinstance(y, Mapping | None) else {self._only(): y}
        self.estimate = self.current.step(t, targets, inputs)

    def predict_one(self, x: Mapping[str, Any]) -> Any:
        """Return what the sensors will show, in the form of y; nothing is learned.

        None if there is no prediction: the step to that time fails.

        Raises
        ------
        DataError
            Features that cannot be used, as `Identifier.forecast` says.
        """
        t, inputs = self._features(x)
        found = self.current.forecast(t, inputs)
        if not found.status.ok:
            return None
        names = self.current.observed.names
        shown = {name: float(found[name][0]) for name in names}
        return shown if len(names) > 1 else shown[names[0]]

    def _features(self, x: Mapping[str, Any]) -> tuple[float, dict[str, Any]]:
        if self.time not in x:
            raise SampleError(f"the features {list(x)} have no '{self.time}', the time.")
        return x[self.time], {name: value for name, value in x.items() if name != self.time}

    def _only(self) -> str:
        names = self.current.observed.names
        if len(names) > 1:
            raise SampleError(f"y: expected a mapping, a number for each of {list(names)}.")
        return names[0]


def river_regressor(identifier: Identifier, time: str = "t") -> Any:
    """Return an `OnlineRegressor` that is a regressor of river, for its metrics and evaluations.

    With several sensors it is one for several targets.

    Raises
    ------
    ConfigurationError
        River is missing.
    """
    try:
        from river import base
    except ImportError:
        raise ConfigurationError("A regressor of river needs it: pip install river.") from None
    several = len(identifier.observed.names) > 1
    kind = base.MultiTargetRegressor if several else base.Regressor
    return type("RiverRegressor", (OnlineRegressor, kind), {"__doc__": OnlineRegressor.__doc__})(
        identifier, time
    )
