"""Many identifications of one model at once."""

from __future__ import annotations

from livepde.fleet.estimate import FleetEstimate, FleetResult
from livepde.fleet.fleet import Fleet
from livepde.fleet.fleet_records import FleetRecords
from livepde.fleet.shard import Shard
from livepde.fleet.shard_estimates import ShardEstimates

__all__ = ["Fleet", "FleetEstimate", "FleetRecords", "FleetResult", "Shard", "ShardEstimates"]
