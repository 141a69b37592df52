"""Checks that a user can run on objects of his own, as the tests run them on ours."""

from __future__ import annotations

from livepde.diagnostics.law import check_law
from livepde.diagnostics.model import check_model
from livepde.diagnostics.observation import check_observation
from livepde.diagnostics.report import CheckLine, CheckReport
from livepde.diagnostics.space import check_space

__all__ = [
    "CheckLine",
    "CheckReport",
    "check_law",
    "check_model",
    "check_observation",
    "check_space",
]
