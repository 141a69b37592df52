"""Where one more sensor would help most, before a case is run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from livepde.cases.case import Prepared
from livepde.cases.preview import MOST_SAMPLES
from livepde.errors import ConfigurationError
from livepde.fem import Inputs, Moment
from livepde.identifier import Identifier, Sample
from livepde.laws import Belief, SensitivityLaw
from livepde.linalg import Array
from livepde.model import Model

__all__ = ["Advice", "advise"]

MOST_CANDIDATES = 400  # positions that are compared


@dataclass(frozen=True, eq=False)
class Advice:
    """The best of all candidate positions for one more sensor.

    Attributes
    ----------
    position
        Coordinates, shape (d,).
    now, then
        Name of each unknown -> share of its prior deviation that the sensors leave, and that they
        would leave with the new one; of a field the root of the share of its mean variance.
    candidates
        How many positions were compared.
    """

    position: Array
    now: Mapping[str, float]
    then: Mapping[str, float]
    candidates: int


def advise(prepared: Prepared, samples: Iterable[Sample]) -> Advice:
    """Return where one more point sensor would reduce the posterior most.

    The criterion is the posterior variance over the prior variance, averaged over the unknowns (of
    a field its mean over the domain; a sum over modes or over units would prefer what happens to be
    many or large). The candidates are the vertices of the mesh, at most 400; the new sensor has the
    median noise of the others, and measures whenever one of them does.

    Linearised at the prior, the information of sensors adds up: with Y the sensitivity of a reading
    to the reduced coordinates a ~ N(0, I), over its noise, the posterior covariance of a is
    (I + sum of Y^T Y)^-1. So one run that assimilates nothing gives the sums of all candidates.

    Raises
    ------
    ConfigurationError
        The law has no covariance, an unknown drifts at random, or it is not clear which component
        of the state a sensor would see.
    """
    case, law = prepared.case, prepared.case.law
    if not isinstance(law, SensitivityLaw):
        raise ConfigurationError(
            "advice on sensors needs a law with a covariance: kind = 'sensitivity'."
        )
    space = case.model.parameter_space
    drifting = [
        name
        for name, unknown in space.unknowns.items()
        if unknown.evolution.growth(1.0, unknown.latent_std).any()
    ]
    if drifting:
        raise ConfigurationError(
            f"advice on sensors: {', '.join(drifting)} drifts at random, and what old samples say "
            "of it does not add up; leave out its evolution (--set)."
        )
    silent = replace(prepared, assimilate_from=np.inf)
    identifier = silent.identifier_with(SensitivityLaw(law.modes, law.noise))
    block, part = case.model.state_space.component(case.observation.of)
    every = -(-block.field.mesh.p.shape[1] // MOST_CANDIDATES)
    values, positions = block.at_vertices[::every], block.field.mesh.p[:, ::every]
    noise = identifier.observed.noise if law.noise is None else law.noise
    noise = np.broadcast_to(np.asarray(noise, dtype=float), identifier.observed.size)
    known: dict[str, float] = {}
    here: Array = np.zeros(0)
    each: Array = np.zeros(0)
    count = 0
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        known |= _inputs(identifier, sample)
        belief, seen = estimate.belief, np.isfinite(estimate.innovation)
        if sample.t < prepared.assimilate_from or not seen.any():
            continue
        if belief.u_factor is None or belief.q_factor is None:
            break
        H_u, H_q = identifier.observed.jacobian(
            estimate.u, estimate.q, Moment(sample.t, Inputs(known))
        )
        Y = H_u @ belief.u_factor
        if H_q is not None:
            Y = Y + H_q @ belief.q_factor
        Y = (Y / noise[:, None])[seen]
        new = (values @ belief.u_factor[part]) / np.median(noise)
        if not count:
            k = Y.shape[1]
            here, each = np.eye(k), np.zeros((len(new), k, k))
        here += Y.T @ Y
        each += new[:, :, None] * new[:, None, :]
        count += 1
        if count >= MOST_SAMPLES:
            break
    if not count:
        raise ConfigurationError("advice on sensors: the data hold no measurement.")
    weights = _weights(case.model, estimate.belief)
    before = np.linalg.inv(here)
    after = np.linalg.inv(here + each)
    mean = sum(weights.values()) / len(weights)
    best = int(np.einsum("ij,cji->c", mean, after).argmin())
    now, then = (
        {name: float(np.sqrt(np.sum(W * P))) for name, W in weights.items()}
        for P in (before, after[best])
    )
    return Advice(positions[:, best], now, then, len(after))


def _inputs(identifier: Identifier, sample: Sample) -> dict[str, float]:
    """Return the inputs that a sample has."""
    given = {**(sample.z if isinstance(sample.z, Mapping) else {}), **(sample.inputs or {})}
    return {name: v for name in identifier.inputs if np.isfinite(v := given.get(name, np.nan))}


def _weights(model: Model, belief: Belief) -> dict[str, Array]:
    """Return unknown -> W with trace(W P) its mean variance over that of the prior, P = I."""
    space, factor = model.parameter_space, belief.q_factor
    if factor is None:
        return {}
    found = {label: np.outer(factor[k], factor[k]) for label, k in space.labels.items()}
    for name in space.fields:
        part = space.part(name)
        found[name] = factor[part].T @ (model.parameter_mass[part, part] @ factor[part])
    return {name: W / np.trace(W) for name, W in found.items()}
