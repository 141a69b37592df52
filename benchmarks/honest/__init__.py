"""Honest twins: coverage of intervals for truths from independent codes.

Each truth has its own code with another scheme on another mesh (collocation, cosine series, finite
volumes with exponentials or TR-BDF2), which shares only the prior with livepde. livepde uses its
defaults for scheme, gate, refit and law. The noise is white, autoregressive or heavy-tailed, or the
data have a spike, gaps in their channels, or a sensor with an offset.
"""

from benchmarks.honest.noise import KINDS
from benchmarks.honest.problems import PROBLEMS
from benchmarks.honest.run import QUICK, honest

__all__ = ["KINDS", "PROBLEMS", "QUICK", "honest"]
