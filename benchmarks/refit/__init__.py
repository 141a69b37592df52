"""Refits: whether stored samples are fitted as well as they can be, from any honest prior.

Each problem has a model as a user of livepde writes it, a truth by another code on a finer mesh or
by a formula, and a lean forward model with the discretisation of livepde that shares no code with
it. SciPy fits the same readings with that model, from the prior and from the truth; its least cost
is the best known one. Priors are up to three standard deviations and a factor of ten off.
"""

from benchmarks.refit.run import PARTS, refit

__all__ = ["PARTS", "refit"]
