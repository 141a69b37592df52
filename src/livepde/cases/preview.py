"""What the sensors of a case can tell about its unknowns, before it is run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from livepde.cases.case import Prepared
from livepde.identifier import Sample
from livepde.laws import Replay, SensitivityLaw
from livepde.linalg import Array

__all__ = ["HARDLY", "Identified", "preview"]

HARDLY = 0.9  # of the prior deviation left: the sensors have hardly told anything
MOST_SAMPLES = 500
NEVER = 1 << 60


@dataclass(frozen=True)
class Identified:
    """One unknown in the preview.

    Attributes
    ----------
    name
        Label of a number; of a field its name, with the vertices known best and worst.
    prior, posterior
        Deviations before and after.
    """

    name: str
    prior: float
    posterior: float
    unit: str

    @property
    def left(self) -> float:
        """Share of the prior deviation that is left."""
        return self.posterior / self.prior

    @property
    def hardly(self) -> bool:
        """True if the sensors have hardly told anything."""
        return self.left > HARDLY


def preview(prepared: Prepared, samples: Iterable[Sample]) -> tuple[list[Identified], int]:
    """Return what the first samples would tell, linearised at the prior, and how many they are.

    A filter that is linear about one reference has a covariance that does not depend on what is
    measured, only on when and with which inputs. So the law runs about the prior, never moves its
    reference, and its estimates are thrown away. What is left is the best case: noise as stated,
    and a model without error. Nothing for a law without covariance.
    """
    law = prepared.case.law
    if not isinstance(law, SensitivityLaw):
        return [], 0
    linear = SensitivityLaw(law.modes, law.noise, law.drift, replay=Replay(NEVER, NEVER))
    identifier = prepared.identifier_with(linear)
    count = 0
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        if sample.t >= prepared.assimilate_from:
            count += bool(np.isfinite(estimate.innovation).any())
        if count >= MOST_SAMPLES:
            break
    factor = identifier.latent_belief().q_factor if count else None
    if factor is None:
        return [], 0
    latent = prepared.case.model.latent
    Phi = linear.prepare(identifier.problem).Phi
    before, after = (latent.tangent(latent.prior, root) for root in (Phi, factor))
    return _compare(prepared, before, after), count


def _compare(prepared: Prepared, before: Array, after: Array) -> list[Identified]:
    """Return the deviations of all unknowns, from square roots of their covariances."""
    space = prepared.case.model.parameter_space
    units = {name: unknown.unit for name, unknown in space.unknowns.items()}
    found = [
        Identified(
            label,
            float(np.linalg.norm(before[k])),
            float(np.linalg.norm(after[k])),
            units.get(label.split("[")[0], ""),
        )
        for label, k in space.labels.items()
    ]
    for name, block in space.fields.items():
        part = space.part(name)
        prior = np.linalg.norm(block.at_vertices @ before[part], axis=1)
        posterior = np.linalg.norm(block.at_vertices @ after[part], axis=1)
        inside = np.flatnonzero(prior > 1e-12 * prior.max())
        left = posterior[inside] / prior[inside]
        for what, k in (("best", inside[left.argmin()]), ("worst", inside[left.argmax()])):
            at = ", ".join(f"{x:.3g}" for x in np.atleast_1d(block.field.mesh.p[:, k]))
            label = f"{name} at {at} ({what})"
            found.append(Identified(label, float(prior[k]), float(posterior[k]), units[name]))
    return found
