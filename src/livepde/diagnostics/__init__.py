"""Checks for user-defined objects, and computable quantities of the paper's theory."""

from __future__ import annotations

from livepde.diagnostics.check_report import Check, CheckReport
from livepde.diagnostics.constants import Spaces, constants
from livepde.diagnostics.error_bounds import Errors, TwinTracker, bounds, conditions
from livepde.diagnostics.excitation import Excitation, ExcitationState, Spectrum
from livepde.diagnostics.form_checks import check_model
from livepde.diagnostics.identifiability import (
    Direction,
    Identifiability,
    InformationGain,
    identifiability,
)
from livepde.diagnostics.law_checks import check_law
from livepde.diagnostics.links import Interpolation, Link, interpolation, link
from livepde.diagnostics.observation_checks import check_observation
from livepde.diagnostics.space_checks import check_space
from livepde.diagnostics.state_parts import Part
from livepde.diagnostics.stopping import (
    OnlineStopping,
    StoppingState,
    noise_size,
    reconstruction_matrix,
    stopping_time,
)
from livepde.diagnostics.theory import OnlineTracker, TheoryReport, theory_report

__all__ = [
    "Check",
    "CheckReport",
    "Direction",
    "Errors",
    "Excitation",
    "ExcitationState",
    "Identifiability",
    "InformationGain",
    "Interpolation",
    "Link",
    "OnlineStopping",
    "OnlineTracker",
    "Part",
    "Spaces",
    "Spectrum",
    "StoppingState",
    "TheoryReport",
    "TwinTracker",
    "bounds",
    "check_law",
    "check_model",
    "check_observation",
    "check_space",
    "conditions",
    "constants",
    "identifiability",
    "interpolation",
    "link",
    "noise_size",
    "reconstruction_matrix",
    "stopping_time",
    "theory_report",
]
