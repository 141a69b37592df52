"""Identifiability from a belief: unknowns that are determined, correlated, or at a bound.

Prior and posterior are compared in the reduced coordinates of the law, in which the prior is N(0,
I): there the covariance itself is the posterior-to-prior ratio, its eigenvalues do not depend on
units, and the square root of one is the remaining share of the prior standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from livepde.errors import ConfigurationError
from livepde.identifier import Identifier
from livepde.laws import Belief
from livepde.linalg import Array
from livepde.model import Model
from livepde.showing import in_percent
from livepde.verdict import FLAT

# Largest remaining share of the prior standard deviation of a well-determined unknown.
PINNED = 0.1
# Correlation from which a pair of unknowns is named.
TRADED = 0.9
# Smallest coefficient in a unit vector with which an unknown is listed in a combination.
WEIGHT = 0.3


@dataclass(frozen=True)
class InformationGain:
    """Information gain about one unknown.

    Attributes
    ----------
    name
        Label of a number, or name of a field.
    left
        Remaining share of the prior standard deviation; for a field the root mean square over its
        modes.
    modes
        For a field: numbers of pinned and of flat combinations of its modes, and of all modes.
    bound
        Bound at which the number lies; NaN if it lies at none.
    moves
        True if the unknown has an evolution, so that its uncertainty may increase again.
    """

    name: str
    left: float
    modes: tuple[int, int, int] | None = None
    bound: float = np.nan
    moves: bool = False

    @property
    def verdict(self) -> str:
        """Verdict in one word: "at its bound", "pinned", "flat" or "partly"."""
        if np.isfinite(self.bound):
            return "at its bound"
        if self.left <= PINNED:
            return "pinned"
        return "flat" if self.left > FLAT and not self.moves else "partly"


@dataclass(frozen=True)
class Direction:
    """Combination of numbers in prior standard deviations, and its remaining share."""

    weights: Mapping[str, float]
    left: float

    def __str__(self) -> str:
        terms = [f"{'-' if w < 0 else '+'} {abs(w):.2g} {name}" for name, w in self.weights.items()]
        return " ".join(terms).removeprefix("+ ")


@dataclass(frozen=True)
class Identifiability:
    """Information gain of a belief over the prior.

    Attributes
    ----------
    unknowns
        One item for each number and field.
    pairs
        Two names and their correlation, if beyond 0.9. Unless both are pinned, only a combination
        of them is determined. For a number and a field, the multiple correlation with the modes.
    directions
        Leading combinations of three or more numbers that are pinned although no single number is.
    """

    unknowns: tuple[InformationGain, ...]
    pairs: tuple[tuple[str, str, float], ...]
    directions: tuple[Direction, ...]

    @property
    def sentences(self) -> list[str]:
        """Sentences on correlated unknowns and on the determined modes of each field."""
        pinned = {item.name for item in self.unknowns if item.left <= PINNED}
        both = "both are well determined, but an error of one shifts the other."
        one = "the data identify a combination of them, not each alone."
        found = [
            f"{a} and {b} are correlated ({r:+.2f}): {both if pinned >= {a, b} else one}"
            for a, b, r in self.pairs
        ]
        found += [
            f"Of {', '.join(d.weights)}, the data identify only the combination {d}, in prior "
            f"standard deviations. Its standard deviation is {in_percent(d.left)} of the prior's."
            for d in self.directions
        ]
        found += [
            f"{item.name}: the data determine {item.modes[0]} of {item.modes[2]} modes well, "
            f"and leave {item.modes[1]} at their prior."
            for item in self.unknowns
            if item.modes is not None
        ]
        return found


def identifiability(identifier: Identifier) -> Identifiability:
    """Compare the estimates of an identifier with their priors.

    Raises
    ------
    ConfigurationError
        The law has no covariance.

    Examples
    --------
    >>> import livepde as lp, numpy as np
    >>> from skfem import ElementLineP1
    >>> model = lp.Model(
    ...     lp.Field(lp.interval(0, 1, 4), ElementLineP1()),
    ...     {"a": lp.Normal(), "b": lp.Normal()},
    ...     A=lambda q, u, v, x: (q.a - q.b) * u * v,
    ... )
    >>> identifier = lp.Identifier(model, lp.Points([0.5], noise=0.01), lp.SensitivityLaw(), u0=1.0)
    >>> for t in (1.0, 2.0, 3.0):
    ...     _ = identifier.step(t, [1.0])
    >>> (found,) = identifiability(identifier).pairs
    >>> found[:2]
    ('a', 'b')
    """
    return information_gains(identifier.model, identifier._latent_belief())


def information_gains(model: Model, belief: Belief) -> Identifiability:
    """Compare a belief in latent coefficients with its prior; see `identifiability`."""
    prior, posterior = belief.prior_factor, belief.q_factor
    if prior is None or posterior is None:
        raise ConfigurationError(
            "identifiability needs a belief with a covariance: use SensitivityLaw."
        )
    latent, space = model.latent, model.parameter_space
    labels = list(space.labels)
    rows = list(space.labels.values())
    before = np.linalg.norm(latent.tangent(belief.q, prior)[rows], axis=1)
    numbers = latent.tangent(belief.q, posterior)[rows] / before[:, None]
    unknowns = [
        InformationGain(
            label,
            float(np.linalg.norm(row)),
            bound=_bound(model, belief, label),
            moves=space.unknown_of(label).evolution.moves,
        )
        for label, row in zip(labels, numbers, strict=True)
    ]
    pairs = _pairs(labels, numbers)
    # Coordinates of the posterior in the prior modes, where the prior covariance is the identity.
    reduced = prior.T @ model.Q.dual(posterior)
    for name in space.fields:
        item = latent.parts[name]
        block = reduced[np.abs(prior[item.part]).max(axis=0) > 0.0]
        left = belief.modes_left(item.part)
        counts = (int((left <= PINNED).sum()), int((left > FLAT).sum()), len(block))
        rms = float(np.sqrt((left**2).sum() / len(block)))
        unknowns.append(InformationGain(name, rms, counts, moves=item.evolution.moves))
        pairs += [
            (label, name, r)
            for label, row in zip(labels, numbers, strict=True)
            if (r := _explained(row, block)) > TRADED
        ]
    return Identifiability(
        tuple(unknowns), tuple(pairs), tuple(_directions(unknowns, labels, numbers, belief))
    )


def _bound(model: Model, belief: Belief, label: str) -> float:
    """Return the bound at which a number lies; NaN if it lies at none."""
    k = model.parameter_space.labels[label]
    value = model.latent.value(belief.q)[k]
    ends = [end[k] for end in model.latent.limits if end[k] == value]
    return float(ends[0]) if ends else np.nan


def _pairs(labels: list[str], factor: Array) -> list[tuple[str, str, float]]:
    """Return pairs of numbers with a correlation beyond `TRADED`."""
    unit = factor / np.linalg.norm(factor, axis=1)[:, None]
    r = unit @ unit.T
    found = np.argwhere(np.triu(np.abs(r) > TRADED, 1))
    return [(labels[i], labels[j], float(r[i, j])) for i, j in found]


def _explained(row: Array, block: Array) -> float:
    """Return the multiple correlation of a number with the modes of a field."""
    # The best linear prediction of the number by the field is a projection of its row.
    fit = np.linalg.lstsq(block.T, row, rcond=1e-10)[0]
    return float(np.linalg.norm(fit @ block) / np.linalg.norm(row))


def _directions(
    unknowns: list[InformationGain], labels: list[str], factor: Array, belief: Belief
) -> list[Direction]:
    """Return pinned combinations of three or more numbers that are not pinned individually."""
    vectors, sizes, _ = np.linalg.svd(factor, full_matrices=False)
    known = dict(zip(labels, unknowns, strict=False))
    found = []
    for vector, size in zip(vectors.T, sizes, strict=True):
        left = float(size)
        members = {
            name: float(weight)
            for name, weight in zip(labels, vector, strict=True)
            if abs(weight) >= WEIGHT
        }
        open_ = all(known[name].left > PINNED for name in members)
        if left <= PINNED and len(members) > 2 and open_:
            found.append(Direction(members, left))
    return found
