"""Thermal resistance R and transmittance U of a wall, from the conductivities of its layers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

# Attributes of a dataset: layers as JSON, label of a conductivity -> thickness in m; and the sum of
# the surface resistances in m^2 K/W, if they are stated.
LAYERS, SURFACES = "wall_layers", "surface_resistance"


@dataclass(frozen=True)
class Resistance:
    """R = sum of thickness/k of a wall, without its surfaces.

    Attributes
    ----------
    R
        Value in m^2 K/W.
    relative
        Standard deviation of ln R, to first order in those of ln k.
    surfaces
        Sum of the surface resistances in m^2 K/W; None if they are not stated.
    """

    R: float
    relative: float
    surfaces: float | None = None

    @property
    def U(self) -> float:
        """Transmittance 1/(R + surface resistances) in W/(m^2 K)."""
        return 1.0 / (self.R + (self.surfaces or 0.0))

    @property
    def relative_U(self) -> float:
        """Standard deviation of ln U."""
        return self.relative * self.R * self.U


def resistance(data: xr.Dataset) -> Resistance | None:
    """Return the resistance of the wall of a run at its end; None if the run is of no wall."""
    layers: Mapping[str, float] = json.loads(data.attrs.get(LAYERS, "{}"))
    if not layers or not data.sizes["time"]:
        return None
    k = np.array([float(data[label][-1]) for label in layers])
    relative = np.array([float(data[f"{label}_std"][-1]) for label in layers]) / k
    parts = np.array([*layers.values()]) / k
    correlation = np.eye(len(k))
    if len(k) > 1 and "correlation" in data:
        names = [str(name) for name in data["unknown"].values]
        rows = [names.index(label) for label in layers]
        correlation = data["correlation"].values[np.ix_(rows, rows)]
    R = float(parts.sum())
    # d ln R / d ln k_i = -R_i / R.
    slopes = relative * parts / R
    variance = float(slopes @ correlation @ slopes)
    surfaces = data.attrs.get(SURFACES)
    return Resistance(R, variance**0.5, None if surfaces is None else float(surfaces))
