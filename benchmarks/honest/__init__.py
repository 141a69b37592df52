"""Honest twins: whether intervals hold when the truth comes from elsewhere.

Each truth has a code of its own, another scheme on another mesh (collocation, cosine series, finite
volumes with exponentials or TR-BDF2), which shares nothing with livepde but the prior that it is
drawn from. livepde has its defaults: no scheme, gate, refit or law is chosen. The data are white,
autoregressive, heavy-tailed, have a spike, gaps in their channels, or a sensor that is off.
"""

from benchmarks.honest.noise import KINDS
from benchmarks.honest.problems import PROBLEMS
from benchmarks.honest.run import QUICK, honest

__all__ = ["KINDS", "PROBLEMS", "QUICK", "honest"]
