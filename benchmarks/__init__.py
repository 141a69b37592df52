"""The project's benchmarks, which measure ratios within one run and no absolute times.

Run one in the project's folder with `python -m benchmarks NAME`. They are not installed.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["ROOT"]

ROOT = Path(__file__).resolve().parents[1]
"""The project's folder, in which processes that import the benchmarks are started."""
