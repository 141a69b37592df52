"""Many identifications of one model at once."""

from __future__ import annotations

from livepde.fleet.estimate import FleetEstimate, FleetResult
from livepde.fleet.fleet import Fleet

__all__ = ["Fleet", "FleetEstimate", "FleetResult"]
