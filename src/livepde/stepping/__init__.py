"""Time schemes, the nonlinear iteration, substeps, and the forward model."""

from __future__ import annotations

from livepde.stepping.corrections import Kept
from livepde.stepping.interval import Advance, Interval, advance
from livepde.stepping.newton import TINY, Near, Newton, Solution, StepFailed
from livepde.stepping.schemes import Alexander2, ImplicitEuler, Scheme, Stage
from livepde.stepping.simulation import simulate
from livepde.stepping.state import ForwardStage

__all__ = [
    "TINY",
    "Advance",
    "Alexander2",
    "ForwardStage",
    "ImplicitEuler",
    "Interval",
    "Kept",
    "Near",
    "Newton",
    "Scheme",
    "Solution",
    "Stage",
    "StepFailed",
    "advance",
    "simulate",
]
