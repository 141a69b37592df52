"""Time schemes, the nonlinear iteration, substeps, and the forward model."""

from __future__ import annotations

from livepde.stepping.banded_stage import BandedStage, member_stage
from livepde.stepping.between import Between, Held
from livepde.stepping.corrections import Kept
from livepde.stepping.interruption import interruptible
from livepde.stepping.interval import End, Interval, Moments, Span, own_noise
from livepde.stepping.member_stage import KeptFactors, MemberStage, StageOfMembers
from livepde.stepping.newton import TINY, Near, Newton, Solution, StepFailed
from livepde.stepping.schemes import (
    LONG_SUBSTEPS,
    MOST_SUBSTEPS,
    Advance,
    Alexander2,
    ImplicitEuler,
    Scheme,
    Stage,
    advance,
)
from livepde.stepping.simulation import simulate
from livepde.stepping.state import ForwardStage

__all__ = [
    "LONG_SUBSTEPS",
    "MOST_SUBSTEPS",
    "TINY",
    "Advance",
    "Alexander2",
    "BandedStage",
    "Between",
    "End",
    "ForwardStage",
    "Held",
    "ImplicitEuler",
    "Interval",
    "Kept",
    "KeptFactors",
    "MemberStage",
    "Moments",
    "Near",
    "Newton",
    "Scheme",
    "Solution",
    "Span",
    "Stage",
    "StageOfMembers",
    "StepFailed",
    "advance",
    "interruptible",
    "member_stage",
    "own_noise",
    "simulate",
]
