"""What the sensors see of the state."""

from __future__ import annotations

from livepde.observation.base import Observation, Observed, Split
from livepde.observation.nonlinear import Transformed, TransformedObserved
from livepde.observation.reconstruction import (
    Alpha,
    Apriori,
    Discrepancy,
    Pseudoinverse,
    Reconstructed,
    Reconstruction,
    Reconstructor,
    Tikhonov,
)
from livepde.observation.sensors import Averages, Matrix, Points
from livepde.observation.subdomain import Full, Subdomain

__all__ = [
    "Alpha",
    "Apriori",
    "Averages",
    "Discrepancy",
    "Full",
    "Matrix",
    "Observation",
    "Observed",
    "Points",
    "Pseudoinverse",
    "Reconstructed",
    "Reconstruction",
    "Reconstructor",
    "Split",
    "Subdomain",
    "Tikhonov",
    "Transformed",
    "TransformedObserved",
]
