"""Control loops with identified models, true and wrong models, and moving-horizon estimators."""

from __future__ import annotations

from benchmarks.control.outcome import PROBLEMS, control

__all__ = ["PROBLEMS", "control"]
