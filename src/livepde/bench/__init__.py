"""The project's benchmarks: ratios measured in one run, never absolute times."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from livepde.bench.step import step
from livepde.runs.outcome import Outcome

__all__ = ["BENCHMARKS"]

BENCHMARKS: Mapping[str, Callable[[], Outcome]] = {"step": step}
