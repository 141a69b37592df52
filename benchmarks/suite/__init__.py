"""What asv follows from commit to commit: ratios that `python -m benchmarks` prints."""

from __future__ import annotations

import sys
from pathlib import Path

# asv imports this folder as a package of its own, from wherever it runs.
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
