"""The covariance that is reported: wider than the filter's own where innovations bear it out."""

from __future__ import annotations

import numpy as np

from livepde.laws.filter import Filter
from livepde.laws.filter_state import FilterState
from livepde.laws.reduction import Reduction
from livepde.linalg import Array


def robust_factors(reduction: Reduction, x: FilterState) -> tuple[Array, Array]:
    """Return a square root [U C] of the robust covariance, (members, r, n) and (members, r, k).

    The sandwich V = P (1 + lambda F) P of Huber (1967) and White (1982), with the prior inside: in
    units of the prior of this time P is the covariance of the filter, F = P^-1 - 1 the information
    of the samples, and lambda the square of `Innovations.inflation`, the factor by which a mean of
    the innovations scatters more than the filter expects. A direction with the remaining share p of
    its prior variance gets the variance p (p + lambda (1 - p)), and never more than its prior: an
    unobserved direction keeps its variance, however wrong the sensors are.

    The uncertainty of the state beside the unknowns has no prior: its variance counts `lambda`
    times.
    """
    inflation = x.innovations.inflation
    if (inflation == 1.0).all():
        return x.U, x.C
    k = x.C.shape[2]
    finite = np.isfinite(x.C).all(axis=(1, 2)) & np.isfinite(inflation)
    C = reduction.in_prior_units(np.where(finite[:, None, None], x.C, 0.0), x.age)
    # In the principal axes of the posterior relative to the prior each direction has its share p of
    # its own, `left` squared.
    rotation, left, _ = np.linalg.svd(C)
    share = np.minimum(left * left, 1.0)
    # Factors on standard deviations: for the first k rows as the docstring says, for the others,
    # which are the state's alone, the square root of lambda.
    widths = np.repeat(inflation[:, None], rotation.shape[1], axis=1)
    widened = share + inflation[:, None] ** 2 * (1.0 - share)
    widths[:, :k] = np.sqrt(np.minimum(widened, 1.0 / np.maximum(share, np.finfo(float).tiny)))
    widths[~finite] = 1.0
    rows = widths[:, :, None] * rotation.transpose(0, 2, 1)
    return rows @ x.U, rows @ x.C


def reported_factors(filter_: Filter, x: FilterState) -> tuple[Array, Array]:
    """Return a square root [U C] of the covariance that is reported, as `robust_factors` does.

    It has one row more for the discretisation error, where shadows follow it.
    """
    U, C = robust_factors(filter_.reduction, x)
    if filter_.shadows is None:
        return U, C
    u, a = filter_.shadows.widening(x)
    return np.concatenate([U, u], axis=1), np.concatenate([C, a], axis=1)
