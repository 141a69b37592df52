"""What the sensors see of the state."""

from __future__ import annotations

from livepde.observation.base import Observation, Observed, Split
from livepde.observation.sensors import Averages, Matrix, Points
from livepde.observation.subdomain import Full, Subdomain

__all__ = [
    "Averages",
    "Full",
    "Matrix",
    "Observation",
    "Observed",
    "Points",
    "Split",
    "Subdomain",
]
