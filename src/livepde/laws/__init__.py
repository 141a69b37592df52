"""Update laws and damping rules."""

from __future__ import annotations

from livepde.laws.assimilation import MemberReports
from livepde.laws.damping import ConstantDamping, Damping, Residual, ResidualDamping
from livepde.laws.damping_bounds import (
    Constants,
    ExactBound,
    NoisyBound,
    Norms,
    SmoothedBound,
    unobserved_damping,
)
from livepde.laws.diffusion_operators import diffusion_operator
from livepde.laws.excitation_gate import ExcitationGate
from livepde.laws.gradient import GradientLaw
from livepde.laws.guards import Guards
from livepde.laws.jumps import Jumps
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
from livepde.laws.refit_options import Refit
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
