"""Observation operators: sensors and their reconstructions."""

from __future__ import annotations

from livepde.observation.combined import Calibrated, Combined
from livepde.observation.flux_plates import FluxPlates
from livepde.observation.functionals import Functionals
from livepde.observation.moving import Moving
from livepde.observation.nonlinear import Transformed, TransformedObserved
from livepde.observation.operator import Observation, Observed
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
from livepde.observation.sensors import Averages, LineIntegrals, Matrix, Points
from livepde.observation.split import Split
from livepde.observation.subdomain import Full, Subdomain

__all__ = [
    "Alpha",
    "Apriori",
    "Averages",
    "Calibrated",
    "Combined",
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
    "Split",
    "Subdomain",
    "Tikhonov",
    "Transformed",
    "TransformedObserved",
]
