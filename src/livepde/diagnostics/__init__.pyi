"""Checks that a user can run on objects of his own, and the paper's theory made computable."""

from .bounds import Errors, TwinTracker, bounds, conditions
from .constants import Part, Spaces, constants
from .excitation import Excitation, ExcitationState, Spectrum
from .identifiability import Direction, Identifiability, Known, identifiability
from .law import check_law
from .links import Interpolation, Link, interpolation, link
from .model import check_model
from .observation import check_observation
from .report import CheckLine, CheckReport
from .space import check_space
from .stopping import (
    OnlineStopping,
    StoppingState,
    noise_size,
    reconstruction_matrix,
    stopping_time,
)
from .theory import OnlineTracker, Sheet, TheoryReport, theory_report

__all__ = [
    "CheckLine",
    "CheckReport",
    "Direction",
    "Errors",
    "Excitation",
    "ExcitationState",
    "Identifiability",
    "Interpolation",
    "Known",
    "Link",
    "OnlineStopping",
    "OnlineTracker",
    "Part",
    "Sheet",
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
