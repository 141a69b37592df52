"""The coupled implicit stage of the gradient law: data, equation, solvers."""

from __future__ import annotations

from livepde.laws.coupled.coupled_stage import CoupledStage, KeptFactor
from livepde.laws.coupled.equation import (
    Metric,
    StageData,
    StageIterate,
    StageProblem,
    StageSolver,
    StageTerms,
)
from livepde.laws.coupled.split_forms import StageForms

__all__ = [
    "CoupledStage",
    "KeptFactor",
    "Metric",
    "StageData",
    "StageForms",
    "StageIterate",
    "StageProblem",
    "StageSolver",
    "StageTerms",
]
