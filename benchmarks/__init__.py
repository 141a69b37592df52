"""The project's benchmarks: ratios measured in one run, never absolute times.

`python -m benchmarks NAME`, in the folder of the project, runs one; nothing here is installed.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["ROOT"]

ROOT = Path(__file__).resolve().parents[1]
"""The project's folder, from which processes are started that import the benchmarks."""
