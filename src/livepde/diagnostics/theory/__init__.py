"""The paper's theory as computable quantities: only the command line and tests use it."""

from __future__ import annotations

from livepde.diagnostics.theory.constants import Spaces, constants
from livepde.diagnostics.theory.error_bounds import (
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
from livepde.diagnostics.theory.excitation import (
    Excitation,
    ExcitationState,
    Interpolation,
    Link,
    Spectrum,
    interpolation,
    link,
)
from livepde.diagnostics.theory.report import OnlineTracker, TheoryReport, theory_report
from livepde.diagnostics.theory.state_parts import Part

__all__ = [
    "Errors",
    "Excitation",
    "ExcitationState",
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
    "conditions",
    "constants",
    "interpolation",
    "link",
    "noise_size",
    "reconstruction_matrix",
    "stopping_time",
    "theory_report",
]
