"""Many identifications of one model at once."""

from __future__ import annotations

from livepde.fleet.estimate import FleetEstimate, FleetResult
from livepde.fleet.fleet import Fleet
from livepde.fleet.kept import Kept

__all__ = ["Fleet", "FleetEstimate", "FleetResult", "Kept"]
