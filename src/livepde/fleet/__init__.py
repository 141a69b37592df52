"""Identification of many processes with one model."""

from livepde.fleet.estimate import FleetEstimate, FleetRecords, FleetResult
from livepde.fleet.fleet import Fleet
from livepde.fleet.shard import Shard, ShardEstimates

__all__ = ["Fleet", "FleetEstimate", "FleetRecords", "FleetResult", "Shard", "ShardEstimates"]
