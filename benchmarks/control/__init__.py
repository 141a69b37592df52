"""Identified models in control loops, against the true model, a wrong one, and a moving horizon."""

from __future__ import annotations

from benchmarks.control.outcome import PROBLEMS, control

__all__ = ["PROBLEMS", "control"]
