"""Runs: what they hand back and the directory they leave."""

from __future__ import annotations

from livepde.runs.outcome import Check, Outcome, Table

__all__ = ["Check", "Outcome", "Table"]
