"""Frame of a case: file, specification, equation, and unit conversion with a location."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from livepde.cases.read import did_you_mean
from livepde.cases.schema import CaseSpec, ChannelSpec
from livepde.cases.units import LARGEST, SMALLEST, convert
from livepde.errors import CaseError
from livepde.models import Equation

__all__ = ["Frame"]


@dataclass(frozen=True, eq=False)
class Frame:
    """A case file's specification and its equation.

    Attributes
    ----------
    path
        The case file.
    spec
        Its content, checked key by key.
    equation
        The PDE it names.
    reader
        The function that reads its data, if it names one.
    """

    path: Path
    spec: CaseSpec
    equation: Equation
    reader: Callable[..., Any] | None

    @property
    def name(self) -> str:
        """Name of the case: that of its file, or of its folder if the file is 'case.toml'."""
        path = self.path.absolute()
        return path.stem if path.stem != "case" else path.parent.name or "case"

    @property
    def constants(self) -> dict[str, float]:
        """The inputs of the equation that are constants, in its units."""
        known, given = self.equation.inputs, self.spec.inputs
        self.only(given, known, "inputs")
        for name in given:
            if name in self.spec.channels:
                raise self.error(f"inputs.{name}", f"there is a channel '{name}', too; keep one.")
        return {
            name: self.convert(value, known[name].unit, f"inputs.{name}")
            for name, value in given.items()
        }

    def error(self, key: str, text: str) -> CaseError:
        """Return an error that names file and key."""
        return CaseError(f"{self.path}: {key}: {text}")

    def missing(self, key: str, text: str) -> CaseError:
        """Return an error about a key that is missing."""
        return CaseError(f"{self.path}: {key} is missing: {text}")

    @contextmanager
    def located(self, key: str, kind: type[Exception]) -> Iterator[None]:
        """Raise errors of one kind within the block as errors that name file and key."""
        try:
            yield
        except kind as error:
            raise self.error(key, str(error)) from None

    def where(self, key: str) -> str:
        """Return file and key for a message."""
        return f"{self.path}: {key}"

    def convert(self, value: Any, unit: str, key: str, *, difference: bool = False) -> float:
        """Return a quantity in the model's unit."""
        return convert(value, unit, self.where(key), difference=difference)

    def positive(self, value: Any, unit: str, key: str, default: float = np.nan) -> float:
        """Return a difference or duration in the model's unit, > 0; a default if there is none."""
        if value is None:
            return default
        number = self.convert(value, unit, key, difference=True)
        if not number > 0:
            raise self.error(key, f"got {value!r}; expected more than 0.")
        if not SMALLEST <= number <= LARGEST:
            text = f"got {value!r}; expected a number from {SMALLEST:g} to {LARGEST:g}."
            raise self.error(key, text)
        return number

    def pair(self, pair: tuple[Any, Any], unit: str, key: str) -> tuple[float, float]:
        """Return an increasing pair in the model's unit."""
        low, high = (self.convert(value, unit, key) for value in pair)
        if not low < high:
            raise self.error(key, f"got [{low:g}, {high:g}] {unit}; needs the lower one first.")
        return low, high

    def only(self, given: Iterable[str], known: Iterable[str], key: str) -> None:
        """Raise unless every name given is known to the equation."""
        for name in given:
            self.require(
                name, known, key, f"the equation '{self.equation.name}' has no '{name}' here"
            )

    def require(self, name: str, known: Iterable[str], key: str, text: str) -> None:
        """Raise an error that begins with `text` unless a name is one of `known`."""
        if name not in known:
            raise self.error(key, f"{text}; {did_you_mean(name, known)}")

    def roles(self, *roles: str) -> dict[str, ChannelSpec]:
        """Return the channels of some roles."""
        return {name: item for name, item in self.spec.channels.items() if item.role in roles}

    def unit(self, channel: str) -> str:
        """Return the model's unit of a channel."""
        if self.spec.channels[channel].role == "input":
            return self.equation.inputs[channel].unit
        if self.spec.channels[channel].role == "position":
            return self.equation.length_unit
        return self.equation.state.unit
