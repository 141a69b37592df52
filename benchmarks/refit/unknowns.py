"""Unknowns, priors distant from the truth, and coordinates a ~ N(0, I) of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import livepde as lp

Array = NDArray[Any]
Kind = Literal["log", "logit", "normal"]

FARTHEST = 3.0  # largest distance between truth and prior, in standard deviations
FACTOR = 10.0  # largest factor between truth and prior, or between their odds for "logit"
WIDTHS = (0.3, 1.0)  # range of the latent standard deviation


@dataclass(frozen=True)
class Belief:
    """Prior of a constant: median and standard deviation."""

    median: float
    std: float


@dataclass(frozen=True)
class Unknown:
    """Unknown constant, or value of a field.

    Attributes
    ----------
    truth
        True value, for a field a typical value.
    kind
        "log" for positive values, "logit" for values in (0, 1), "normal" for any values.
    prior
        Fixed prior; None: the prior is drawn.
    """

    truth: float
    kind: Kind = "log"
    prior: Belief | None = None

    def latent(self, q: Any) -> Any:
        """Return the latent value, which has a Gaussian prior."""
        if self.kind == "log":
            return np.log(q)
        return np.log(q) - np.log1p(-q) if self.kind == "logit" else q

    def value(self, latent: Any) -> Any:
        """Return the value for a latent value, the inverse of `latent`."""
        if self.kind == "log":
            return np.exp(latent)
        return 1.0 / (1.0 + np.exp(-latent)) if self.kind == "logit" else latent

    def slope(self, latent: Any) -> Any:
        """Return the derivative of `value`."""
        q = self.value(latent)
        return q if self.kind == "log" else q * (1.0 - q) if self.kind == "logit" else 1.0

    def declared(self, belief: Belief) -> Any:
        """Return the prior as a user of livepde would write it."""
        if self.kind == "log":
            return lp.LogNormal(belief.median, std=belief.std)
        if self.kind == "logit":
            return lp.LogitNormal(belief.median, std=belief.std, bounds=(0.0, 1.0))
        return lp.Normal(belief.median, std=belief.std)


def drawn(unknowns: Mapping[str, Unknown], rng: np.random.Generator) -> dict[str, Belief]:
    """Draw priors within three standard deviations and a factor of ten of the truth."""
    priors = {}
    for name, unknown in unknowns.items():
        if unknown.prior is not None:
            priors[name] = unknown.prior
            continue
        std = float(np.exp(rng.uniform(*np.log(WIDTHS))))
        shift = std * rng.uniform(-FARTHEST, FARTHEST)
        latent = unknown.latent(unknown.truth) + np.clip(shift, -np.log(FACTOR), np.log(FACTOR))
        priors[name] = Belief(float(unknown.value(latent)), float(std * unknown.slope(latent)))
    return priors


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates a ~ N(0, I) with q = T(latent) and latent = centre + Phi a.

    Attributes
    ----------
    unknowns
        Unknown of each value of q, the same for all values of a field.
    centre, Phi
        Arrays of shapes (m,) and (m, k).
    """

    unknowns: tuple[Unknown, ...]
    centre: Array
    Phi: Array

    @classmethod
    def of(cls, unknowns: Mapping[str, Unknown], priors: Mapping[str, Belief]) -> Coordinates:
        """Return the coordinates of unknown constants with their priors."""
        centre = [item.latent(priors[name].median) for name, item in unknowns.items()]
        std = [
            priors[name].std / item.slope(at)
            for (name, item), at in zip(unknowns.items(), centre, strict=True)
        ]
        return cls(tuple(unknowns.values()), np.array(centre), np.diag(std))

    @property
    def size(self) -> int:
        """Number of coordinates k."""
        return int(self.Phi.shape[1])

    def value(self, a: Array) -> Array:
        """Return q, shape (m,)."""
        return self._each("value", self.centre + self.Phi @ a)

    def tangent(self, a: Array) -> Array:
        """Return dq/da, shape (m, k)."""
        return self._each("slope", self.centre + self.Phi @ a)[:, None] * self.Phi

    def inverse(self, q: Array) -> Array:
        """Return the coordinates of q; a field is projected onto the modes."""
        off = self._each("latent", q) - self.centre
        return np.asarray(np.linalg.lstsq(self.Phi, off, rcond=None)[0])

    def _each(self, function: str, values: Array) -> Array:
        pairs = zip(self.unknowns, values.tolist(), strict=True)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            return np.array([getattr(item, function)(np.float64(x)) for item, x in pairs])
