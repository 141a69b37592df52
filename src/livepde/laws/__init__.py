"""Update laws and damping rules."""

from __future__ import annotations

from livepde.laws.base import AnyLaw, Belief, Law, Problem, Report, Status
from livepde.laws.damping import ConstantDamping, Damping, Residual, ResidualDamping
from livepde.laws.gradient import GradientLaw
from livepde.laws.operators import observed_operator, unobserved_operator
from livepde.laws.relatives import BaumeisterLaw, KueglerLaw
from livepde.laws.sensitivity import Replay, SensitivityLaw

__all__ = [
    "AnyLaw",
    "BaumeisterLaw",
    "Belief",
    "ConstantDamping",
    "Damping",
    "GradientLaw",
    "KueglerLaw",
    "Law",
    "Problem",
    "Replay",
    "Report",
    "Residual",
    "ResidualDamping",
    "SensitivityLaw",
    "Status",
    "observed_operator",
    "unobserved_operator",
]
