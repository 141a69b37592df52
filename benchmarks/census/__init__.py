"""Census of verdicts: runs with and without something wrong, and what each run says of itself.

Truths come from the codes of `benchmarks.honest`, which share nothing with livepde.
"""

from benchmarks.census.faults import FAULTS
from benchmarks.census.run import PROBLEMS, QUICK, census

__all__ = ["FAULTS", "PROBLEMS", "QUICK", "census"]
