"""Misfit of a model, and possible effects of its errors on the unknowns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, TypeAlias

from livepde.showing import in_percent

Rank: TypeAlias = Literal["trusted", "caution", "do not trust"]

FAILED = 5.0  # misfit over noise, and ...
OF_SIGNAL = 0.1  # ... misfit over signal above which a fit has failed
HARMLESS = 0.02  # largest relative effect of a detected error that is acceptable
USELESS = 0.5  # relative effect above which an interval is too wide to use
HIDDEN = 0.1  # relative effect of undetectable errors above which there is a caution
USUAL = 0.2  # prior standard deviations below which an unknown of either sign is near zero
WIDER = 2.0  # width over the width due to noise above which undetectable errors count
DIFFERENT = 1.1  # width over the plain width above which the interval is shown
MOST = 3  # unknowns in a sentence


@dataclass(frozen=True)
class Allowed:
    """An unknown with an interval that allows for errors of the model."""

    # label, unit: name and unit of the unknown; a field is represented by its root mean square
    label: str
    unit: str
    value: float  # estimate
    # low, high: 95 % interval that allows for errors of the model
    low: float
    high: float
    # plain_low, plain_high: 95 % interval if the model is exact
    plain_low: float
    plain_high: float
    wider: float  # width of the interval over the width due to noise alone
    # Lower bound of the size to which an error is relative, if the prior allows either sign: the
    # relative error of an unknown near zero is compared with its prior
    usual: float = 0.0
    # Whether the unknown is a sensor error, such as an offset, or a correction of an input
    of_sensor: bool = False

    @classmethod
    def of(cls, label: str, unit: str, numbers: Iterable[float], **rest: Any) -> Allowed:
        """Return an unknown from its numbers, in the order of the attributes, and the rest."""
        value, low, high, plain_low, plain_high, wider = numbers
        return cls(label, unit, value, low, high, plain_low, plain_high, wider, **rest)

    @property
    def effect(self) -> float:
        """Largest error of the value, relative to its size or to `usual`, whichever is larger."""
        error = max(abs(self.low - self.value), abs(self.high - self.value))
        size = max(self._size, self.usual)
        return error / size if size > 0.0 else math.inf

    @property
    def _size(self) -> float:
        return max(abs(self.value), abs(self.plain_low), abs(self.plain_high))

    def about(self, value: float, plain_low: float, plain_high: float) -> Allowed:
        """Return the interval of a later estimate: the plain one, widened by the same factors."""

        def end(wide: float, plain: float, moved: float) -> float:
            distance = plain - self.value
            return value + (wide - self.value) * ((moved - value) / distance if distance else 1.0)

        low = end(self.low, self.plain_low, plain_low)
        high = end(self.high, self.plain_high, plain_high)
        plain = replace(self, plain_low=plain_low, plain_high=plain_high)
        return replace(plain, value=value, low=low, high=high)

    @property
    def text(self) -> str:
        """The unknown with its interval, and its effect as a percentage."""
        unit = f" {self.unit}" if self.unit else ""
        if self._size < self.usual:
            size = f"{in_percent(USUAL * self.effect)} of its prior standard deviation"
        elif self.effect < 1.0:
            size = in_percent(self.effect)
        else:
            size = f"{self.effect:.2g} times its value"
        return (
            f"{self.label} is between {self.low:.4g} and {self.high:.4g}{unit} (error up to {size})"
        )


@dataclass(frozen=True)
class ModelErrors:
    """Misfit of a model, and intervals of its unknowns that allow for its errors.

    Attributes
    ----------
    misfit
        Root mean square of the residuals of the best fit, over the noise estimated from
        successive differences.
    of_signal
        Root mean square of the residuals over the standard deviation of the readings in time.
    sensors
        Sensor -> misfit of its readings over noise.
    unknowns
        All unknowns, including sensor errors.
    """

    misfit: float
    of_signal: float
    sensors: Mapping[str, float] = field(default_factory=dict)
    unknowns: tuple[Allowed, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether the residuals are large compared with both noise and signal."""
        return self.misfit > FAILED and self.of_signal > OF_SIGNAL

    @property
    def asked(self) -> list[Allowed]:
        """Unknowns of the model, by decreasing effect."""
        of_model = [unknown for unknown in self.unknowns if not unknown.of_sensor]
        return sorted(of_model, key=lambda unknown: -unknown.effect)

    @property
    def differ(self) -> bool:
        """Whether an interval differs from the plain one by more than a tenth of its width."""

        def differs(unknown: Allowed) -> bool:
            ends = (unknown.low - unknown.plain_low, unknown.high - unknown.plain_high)
            width = unknown.plain_high - unknown.plain_low
            return max(map(abs, ends)) > (DIFFERENT - 1.0) * width

        return any(map(differs, self.unknowns))

    def __getitem__(self, label: str) -> Allowed:
        """Return the unknown with the given label."""
        return next(unknown for unknown in self.unknowns if unknown.label == label)

    @property
    def effect(self) -> float:
        """Largest relative effect on an unknown of the model; 0 without unknowns."""
        return max((unknown.effect for unknown in self.asked), default=0.0)

    def about(self, now: Mapping[str, tuple[float, float, float]]) -> ModelErrors:
        """Return the errors at later estimates: label -> (value, plain low, plain high)."""
        moved = [one.about(*now[one.label]) if one.label in now else one for one in self.unknowns]
        return replace(self, unknowns=tuple(moved))

    def level(self, *, doubted: bool) -> Rank:
        """Return the level of a run; `doubted`: whether a test contradicts the model."""
        if self.failed:
            return "do not trust"
        if not self.asked:  # without unknowns there are no effects
            return "caution" if doubted else "trusted"
        if not doubted:
            return "caution" if self.wide > HIDDEN else "trusted"
        # A useless interval of one unknown does not invalidate the others.
        if self.wide > USELESS and len(self.useless) == len(self.asked):
            return "do not trust"
        return "trusted" if self.effect <= HARMLESS else "caution"

    @property
    def wide(self) -> float:
        """Largest effect on an unknown whose interval is much wider than noise alone implies."""
        return max((unknown.effect for unknown in self.asked if unknown.wider > WIDER), default=0.0)

    @property
    def useless(self) -> list[str]:
        """Labels of the unknowns of the model whose interval is too wide to use."""
        return [unknown.label for unknown in self.asked if unknown.effect > USELESS]

    def sentence(self, *, doubted: bool) -> str:
        """Return a sentence on misfit and effect."""
        signal = 100.0 * self.of_signal
        share = f"{signal:.0f}" if signal >= 99.5 else f"{signal:.2g}"
        fit = f"Residuals are {self.misfit:.2g} times the noise and {share} % of the signal."
        if self.failed:
            return f"The fit failed. {fit}"
        # List the unknowns with the largest effects.
        texts = [unknown.text for unknown in self.asked[:MOST]]
        unlisted = len(self.asked) - MOST
        more = f" The table lists {unlisted} more." if unlisted > 0 else ""
        reason = "model errors" if doubted else "model errors that these data cannot reveal"
        return f"{fit} Allowing for {reason}, {', '.join(texts)}.{more}" if texts else fit

    @property
    def remedy(self) -> str:
        """Recommended use of the intervals."""
        if self.failed:
            return "Do not use the estimates. Find the error in the model or the data first."
        if not (useless := self.useless):
            if not self.differ:
                return "The plain intervals include these errors."
            return "Use these intervals: the others assume an exact model."
        if len(useless) == len(self.asked):
            return "These intervals are too wide to use. Find the error first."
        names = ", ".join(useless[:MOST])
        more = f" and {len(useless) - MOST} more" if len(useless) > MOST else ""
        return f"Use these intervals, but not that of {names}{more}: too wide to use."

    def to_dict(self) -> dict[str, Any]:
        """Return the errors as a dictionary for JSON."""
        fields = {**asdict(self), "sensors": dict(self.sensors)}
        finite: dict[str, Any] = _without_nonfinite(fields)
        return finite

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any] | None) -> ModelErrors | None:
        """Return the errors from the result of `to_dict`; None if there are none."""
        if stored is None:
            return None
        numbers = {key: _number(stored[key]) for key in ("misfit", "of_signal")}
        sensors = {name: _number(value) for name, value in stored["sensors"].items()}
        rows = [{key: _number(value) for key, value in one.items()} for one in stored["unknowns"]]
        return cls(**numbers, sensors=sensors, unknowns=tuple(Allowed(**row) for row in rows))


def _without_nonfinite(value: Any) -> Any:
    """Return nested data with None instead of nonfinite numbers, which JSON does not support."""
    if isinstance(value, dict):
        return {key: _without_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    """Return infinity for None: of the stored numbers, only ratios can be infinite."""
    return math.inf if value is None else value
