"""Benchmarks for asv, which records ratios of `python -m benchmarks` for each commit."""

from __future__ import annotations

import sys
from pathlib import Path

# asv imports this folder as a top-level package, from any working directory.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
