"""Census of verdicts on runs with and without faults.

Truths come from the codes of `benchmarks.honest`, which are independent of livepde.
"""

from benchmarks.census.faults import FAULTS
from benchmarks.census.run import PROBLEMS, QUICK, census

__all__ = ["FAULTS", "PROBLEMS", "QUICK", "census"]
