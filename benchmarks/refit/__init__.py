"""Refits of stored samples from distant priors, compared with the best known fit.

Each problem has a model as a user of livepde would write it. Its truth comes from another code on a
finer mesh or from a formula. A lean forward model has livepde's discretisation, but separate code.
SciPy fits the readings with it, from the prior and from the truth. The best fit of livepde and
SciPy is the reference. Priors are within three standard deviations and a factor of ten.
"""

from benchmarks.refit.run import PARTS, refit

__all__ = ["PARTS", "refit"]
