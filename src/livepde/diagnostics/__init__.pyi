from .check_report import Check, CheckReport
from .form_checks import check_model, check_space
from .information_gain import Direction, Identifiability, InformationGain, identifiability
from .law_checks import check_law, check_observation
from .theory.constants import Spaces, constants
from .theory.error_bounds import (
    Errors,
    OnlineStopping,
    StoppingState,
    TwinTracker,
    bounds,
    conditions,
    noise_size,
    reconstruction_matrix,
    stopping_time,
)
from .theory.excitation import (
    Excitation,
    ExcitationState,
    Interpolation,
    Link,
    Spectrum,
    interpolation,
    link,
)
from .theory.report import OnlineTracker, TheoryReport, theory_report
from .theory.state_parts import Part

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
