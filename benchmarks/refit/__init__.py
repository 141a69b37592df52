"""Refits of stored samples from distant priors, compared with the best known fit.

Each problem has a model as a user of livepde would write it, a truth from another code on a finer
mesh or from a formula, and a lean forward model with livepde's discretisation, but separate code.
SciPy fits the readings with the lean model, from the prior and from the truth. The best fit of both
is the reference. Priors are up to three standard deviations and a factor of ten from the truth.
"""

from benchmarks.refit.run import PARTS, refit

__all__ = ["PARTS", "refit"]
