"""Update laws (estimators) and damping rules."""

from __future__ import annotations

from livepde.laws.assimilation import MemberReports
from livepde.laws.damping import (
    ConstantDamping,
    Constants,
    Damping,
    ExactBound,
    NoisyBound,
    Norms,
    Residual,
    ResidualDamping,
    SmoothedBound,
    diffusion_operator,
    unobserved_damping,
)
from livepde.laws.equation_tests import ExcitationGate
from livepde.laws.gradient import GradientLaw
from livepde.laws.law import (
    AnyLaw,
    Belief,
    Fit,
    FixedInterval,
    InitialReading,
    Law,
    Problem,
    Report,
    Status,
    numerical,
    stepped,
)
from livepde.laws.policies import Guards, Jumps, Refit
from livepde.laws.sensitivity import SensitivityLaw
from livepde.laws.shadows import Shadows
from livepde.laws.step_diagnostics import Diagnostics

__all__ = [
    "AnyLaw",
    "Belief",
    "ConstantDamping",
    "Constants",
    "Damping",
    "Diagnostics",
    "ExactBound",
    "ExcitationGate",
    "Fit",
    "FixedInterval",
    "GradientLaw",
    "Guards",
    "InitialReading",
    "Jumps",
    "Law",
    "MemberReports",
    "NoisyBound",
    "Norms",
    "Problem",
    "Refit",
    "Report",
    "Residual",
    "ResidualDamping",
    "SensitivityLaw",
    "Shadows",
    "SmoothedBound",
    "Status",
    "diffusion_operator",
    "numerical",
    "stepped",
    "unobserved_damping",
]
