"""Online-learner interface of an identifier: features as inputs, sensor readings as targets."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from livepde.errors import ConfigurationError, SampleError
from livepde.estimate import Estimate
from livepde.identifier import Identifier


class OnlineRegressor:
    """Online regressor with the methods of river, which learns and predicts single samples.

    A sample has features x, a mapping with the time and the inputs by their names, and a target y:
    the sensor reading, or a mapping from sensor to reading if there are several. Missing features
    hold their last value; missing targets (None, NaN) are ignored.

    Parameters
    ----------
    identifier
        Initial identifier; it is copied, not changed.
    time
        Name of the feature that is the time.

    Attributes
    ----------
    current
        Present identifier.
    estimate
        Estimate of the last sample learned; None before.
    """

    def __init__(self, identifier: Identifier, time: str = "t") -> None:
        self.identifier = identifier
        self.time = time
        self.current = copy.deepcopy(identifier)
        self.estimate: Estimate | None = None

    def learn_one(self, x: Mapping[str, Any], y: Any) -> None:
        """Learn from one sample; `estimate.status` shows whether the step succeeded.

        Raises `DataError`: the sample is invalid, as for `Identifier.step`.
        """
        t, inputs = self._features(x)
        targets = dict(y or {}) if isinstance(y, Mapping | None) else {self._only(): y}
        self.estimate = self.current.step(t, targets, inputs)

    def predict_one(self, x: Mapping[str, Any]) -> Any:
        """Return predicted readings in the form of y, without learning.

        The prediction is None if the step to that time fails.

        Raises `DataError`: the features are invalid, as for `Identifier.forecast`.
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
    """Return an `OnlineRegressor` that is also a river regressor, for river's evaluation tools.

    With several sensors it is a multi-target regressor.

    Raises `ConfigurationError`: River is not installed.
    """
    try:
        from river import base
    except ImportError:
        raise ConfigurationError("A regressor of river needs it: pip install river.") from None
    several = len(identifier.observed.names) > 1
    kind = base.MultiTargetRegressor if several else base.Regressor
    # The class is defined here, since this module can be imported without river.
    return type("RiverRegressor", (OnlineRegressor, kind), {"__doc__": OnlineRegressor.__doc__})(
        identifier, time
    )
