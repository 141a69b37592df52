"""Regions of a case: layers and boxes by the ends of their sides, and subdomains of the mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from livepde.cases.case_frame import Frame
from livepde.cases.read import did_you_mean

__all__ = ["inside", "sides_of", "subdomain"]


def subdomain(frame: Frame, mesh: Any, name: str, key: str) -> str:
    """Return the name of a subdomain, which the mesh has to have."""
    known = mesh.subdomains or {}
    if name not in known:
        remedy = "it has none: name them in its file, or give the sides of this one."
        if known:
            remedy = did_you_mean(name, known)
        raise frame.error(key, f"the mesh has no subdomain '{name}'; {remedy}")
    return name


def inside(frame: Frame, given: Any, dimension: int, key: str) -> Callable[[Any], Any]:
    """Return whether points x lie in a layer or box; its upper sides do not belong to it."""
    sides = sides_of(frame, given, dimension, key)

    def within(x: Any) -> Any:
        return np.logical_and.reduce(
            [(x[k] >= low) & (x[k] < high) for k, (low, high) in enumerate(sides)]
        )

    return within


def sides_of(frame: Frame, given: Any, dimension: int, key: str) -> list[tuple[float, float]]:
    """Return (low, high) for each coordinate."""
    if len(given) != 2 * dimension:
        expected = {1: "[from, to]", 2: "[x0, x1, y0, y1]"}.get(
            dimension, "the name of a subdomain"
        )
        raise frame.error(key, f"got {list(given)}; expected {expected}.")
    unit = frame.equation.length_unit
    return [frame.pair((given[k], given[k + 1]), unit, key) for k in range(0, len(given), 2)]
