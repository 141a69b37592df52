"""Misfit of a model, and how far its errors may have moved the unknowns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, TypeAlias

from livepde.showing import in_percent

Rank: TypeAlias = Literal["trusted", "caution", "do not trust"]

FAILED = 5.0  # misfit over noise, and ...
OF_SIGNAL = 0.1  # ... misfit over signal from which a fit has failed
HARMLESS = 0.02  # relative effect of an error that the data show, but that does no harm
USELESS = 0.5  # relative effect from which an interval is too wide to use
HIDDEN = 0.1  # relative effect of errors that the data do not show
USUAL = 0.2  # prior standard deviations below which an unknown of either sign is near zero
WIDER = 2.0  # width over that of the noise alone from which such effects count
DIFFERENT = 1.1  # the same from which the interval is shown
MOST = 3  # unknowns in a sentence


@dataclass(frozen=True)
class Allowed:
    """An unknown with an interval that allows for errors of the model."""

    # label, unit: the unknown; of a field the root mean square over the domain
    label: str
    unit: str
    value: float  # the estimate
    # low, high: the 95 % interval that allows for errors of the model
    low: float
    high: float
    # plain_low, plain_high: the 95 % interval if the model is exact
    plain_low: float
    plain_high: float
    wider: float  # width over that of the noise alone
    # Least size that an error is relative to, where the prior allows either sign: an unknown near
    # zero is known well if little of its prior is left.
    usual: float = 0.0
    # Whether it is an error of a sensor, such as an offset, or a correction of an input
    of_sensor: bool = False

    @classmethod
    def of(cls, label: str, unit: str, numbers: Iterable[float], **rest: Any) -> Allowed:
        """Return an unknown with its numbers in the order of the attributes, and the rest."""
        value, low, high, plain_low, plain_high, wider = numbers
        return cls(label, unit, value, low, high, plain_low, plain_high, wider, **rest)

    @property
    def effect(self) -> float:
        """Largest error of the value, relative to it; near zero to `usual`."""
        off = max(abs(self.low - self.value), abs(self.high - self.value))
        size = max(self._size, self.usual)
        return off / size if size > 0.0 else math.inf

    @property
    def _size(self) -> float:
        return max(abs(self.value), abs(self.plain_low), abs(self.plain_high))

    def about(self, value: float, plain_low: float, plain_high: float) -> Allowed:
        """Return a later estimate with an interval that is as much wider than the plain one."""

        def end(wide: float, plain: float, now: float) -> float:
            away = plain - self.value
            return value + (wide - self.value) * ((now - value) / away if away else 1.0)

        low = end(self.low, self.plain_low, plain_low)
        high = end(self.high, self.plain_high, plain_high)
        plain = replace(self, plain_low=plain_low, plain_high=plain_high)
        return replace(plain, value=value, low=low, high=high)

    @property
    def text(self) -> str:
        """The unknown with its interval, and its effect in per cent."""
        unit = f" {self.unit}" if self.unit else ""
        if self._size < self.usual:
            off = f"{in_percent(USUAL * self.effect)} of its prior standard deviation"
        elif self.effect < 1.0:
            off = in_percent(self.effect)
        else:
            off = f"{self.effect:.2g} times its value"
        return (
            f"{self.label} is between {self.low:.4g} and {self.high:.4g}{unit} (error up to {off})"
        )


@dataclass(frozen=True)
class ModelErrors:
    """Misfit of a model, and intervals of its unknowns that allow for its errors.

    Attributes
    ----------
    misfit
        Root mean square of the residuals of the best fit, over the noise that
        successive readings show.
    of_signal
        The same over the standard deviation of the readings in time.
    sensors
        Sensor -> its own misfit over noise.
    unknowns
        The unknowns, those of sensors as well.
    """

    misfit: float
    of_signal: float
    sensors: Mapping[str, float] = field(default_factory=dict)
    unknowns: tuple[Allowed, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether the model misses the readings grossly."""
        return self.misfit > FAILED and self.of_signal > OF_SIGNAL

    @property
    def asked(self) -> list[Allowed]:
        """Unknowns of the model, the one that may be off the most first."""
        own = [one for one in self.unknowns if not one.of_sensor]
        return sorted(own, key=lambda one: -one.effect)

    @property
    def differ(self) -> bool:
        """Whether an interval differs from the plain one by more than a tenth of its width."""

        def far(one: Allowed) -> bool:
            ends = (one.low - one.plain_low, one.high - one.plain_high)
            width = one.plain_high - one.plain_low
            return max(map(abs, ends)) > (DIFFERENT - 1.0) * width

        return any(map(far, self.unknowns))

    def __getitem__(self, label: str) -> Allowed:
        """Return the unknown with a label."""
        return next(one for one in self.unknowns if one.label == label)

    @property
    def effect(self) -> float:
        """Largest relative effect on an unknown of the model; 0 without."""
        return max((one.effect for one in self.asked), default=0.0)

    def about(self, now: Mapping[str, tuple[float, float, float]]) -> ModelErrors:
        """Return the same for later estimates: label -> value, and ends of the plain interval."""
        moved = [one.about(*now[one.label]) if one.label in now else one for one in self.unknowns]
        return replace(self, unknowns=tuple(moved))

    def level(self, *, doubted: bool) -> Rank:
        """Return the level of a run.

        `doubted`: whether a test speaks against the model.
        """
        if self.failed:
            return "do not trust"
        if not self.asked:  # no unknown of which an effect could be harmless
            return "caution" if doubted else "trusted"
        if not doubted:
            return "caution" if self.wide > HIDDEN else "trusted"
        # One unknown that is too uncertain does not take the value from the others.
        if self.wide > USELESS and len(self.useless) == len(self.asked):
            return "do not trust"
        return "trusted" if self.effect <= HARMLESS else "caution"

    @property
    def wide(self) -> float:
        """Largest effect on an unknown whose interval is much wider than by the noise alone."""
        return max((one.effect for one in self.asked if one.wider > WIDER), default=0.0)

    @property
    def useless(self) -> list[str]:
        """Unknowns of the model whose interval is too wide to use."""
        return [one.label for one in self.asked if one.effect > USELESS]

    def sentence(self, *, doubted: bool) -> str:
        """Return fit and effect in words."""
        signal = 100.0 * self.of_signal
        share = f"{signal:.0f}" if signal >= 99.5 else f"{signal:.2g}"
        fit = f"Residuals are {self.misfit:.2g} times the noise and {share} % of the signal."
        if self.failed:
            return f"The fit failed. {fit}"
        # Of many unknowns those are listed whose error may be largest.
        some = [one.text for one in self.asked[:MOST]]
        rest = len(self.asked) - MOST
        more = f" The table lists {rest} more." if rest > 0 else ""
        why = "model errors" if doubted else "model errors that these data cannot reveal"
        return f"{fit} Allowing for {why}, {', '.join(some)}.{more}" if some else fit

    @property
    def remedy(self) -> str:
        """What to do with such intervals."""
        if self.failed:
            return "Do not use the estimates. Find the error in the model or the data first."
        if not (useless := self.useless):
            return "Use these intervals: the others assume an exact model."
        if len(useless) == len(self.asked):
            return "These intervals are too wide to use. Find the error first."
        names = ", ".join(useless[:MOST])
        more = f" and {len(useless) - MOST} more" if len(useless) > MOST else ""
        return f"Use these intervals, but not that of {names}{more}: too wide to use."

    def to_dict(self) -> dict[str, Any]:
        """Return the value as JSON can hold it."""
        own = {**asdict(self), "sensors": dict(self.sensors)}
        found: dict[str, Any] = _without_nonfinite(own)
        return found

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any] | None) -> ModelErrors | None:
        """Return the value that `to_dict` has written; None if there is none."""
        if stored is None:
            return None
        numbers = {key: _number(stored[key]) for key in ("misfit", "of_signal")}
        sensors = {name: _number(value) for name, value in stored["sensors"].items()}
        rows = [{key: _number(value) for key, value in one.items()} for one in stored["unknowns"]]
        return cls(**numbers, sensors=sensors, unknowns=tuple(Allowed(**row) for row in rows))


def _without_nonfinite(value: Any) -> Any:
    """Return nested data with None for infinite numbers, which JSON has not."""
    if isinstance(value, dict):
        return {key: _without_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _number(value: Any) -> Any:
    """Return an infinite number for None: only an effect or a ratio has no bound."""
    return math.inf if value is None else value
