"""Time schemes, the nonlinear solver, step control, and the forward model."""

from __future__ import annotations

from livepde.stepping.forward import ForwardStage, simulate
from livepde.stepping.interval import (
    Between,
    End,
    Held,
    Interval,
    Moments,
    Span,
    gaps_of,
    own_noise,
)
from livepde.stepping.member_stage import (
    BandedStage,
    KeptFactors,
    MemberStage,
    StageOfMembers,
    member_stage,
)
from livepde.stepping.newton import TINY, Kept, Near, Newton, Solution, StepFailed
from livepde.stepping.schemes import (
    LONG_SUBSTEPS,
    MOST_SUBSTEPS,
    Advance,
    Alexander2,
    ImplicitEuler,
    Scheme,
    Stage,
    advance,
    interruptible,
)
from livepde.stepping.sweep import Steps, Sweep

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
    "Steps",
    "Sweep",
    "advance",
    "gaps_of",
    "interruptible",
    "member_stage",
    "own_noise",
    "simulate",
]
