"""Observation operators: sensors and their reconstructions."""

from __future__ import annotations

from livepde.observation.combined import (
    Calibrated,
    Combined,
    CombinedObserved,
    Transformed,
    TransformedObserved,
)
from livepde.observation.functionals import FluxPlates, Functionals
from livepde.observation.operator import (
    Observation,
    Observed,
    Pseudoinverse,
    Reconstructed,
    Reconstruction,
    Reconstructor,
    Split,
)
from livepde.observation.reconstruction import Alpha, Apriori, Discrepancy, Tikhonov
from livepde.observation.sensors import Averages, LineIntegrals, Matrix, Moving, Points
from livepde.observation.slow import Slow
from livepde.observation.subdomain import Full, Subdomain

__all__ = [
    "Alpha",
    "Apriori",
    "Averages",
    "Calibrated",
    "Combined",
    "CombinedObserved",
    "Discrepancy",
    "FluxPlates",
    "Full",
    "Functionals",
    "LineIntegrals",
    "Matrix",
    "Moving",
    "Observation",
    "Observed",
    "Points",
    "Pseudoinverse",
    "Reconstructed",
    "Reconstruction",
    "Reconstructor",
    "Slow",
    "Split",
    "Subdomain",
    "Tikhonov",
    "Transformed",
    "TransformedObserved",
]
