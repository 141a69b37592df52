"""Preview of a case: identifiability, discretisation error and unseen sensor errors."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import tee

import numpy as np

from livepde.cases.case import Prepared
from livepde.diagnostics.identifiability import FLAT, identifiability
from livepde.identifier import Identifier, Sample
from livepde.laws import AnyLaw, AutoLaw, Belief, Replay, SensitivityLaw, Shadows
from livepde.laws.filter_state import FilterState
from livepde.laws.sensitivity_state import SensitivityWork
from livepde.linalg import Array
from livepde.result import Estimate
from livepde.verdict import REFINE, Shifts, discretised

__all__ = ["Identified", "Preview", "linearised", "preview"]

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
        Standard deviations before and after the samples.
    """

    name: str
    prior: float
    posterior: float
    unit: str

    @property
    def left(self) -> float:
        """Remaining share of the prior standard deviation."""
        return self.posterior / self.prior

    @property
    def hardly(self) -> bool:
        """True if the sensors provide hardly any information on it."""
        return self.left > FLAT


@dataclass(frozen=True)
class Preview:
    """Information on the unknowns in the first samples of a case.

    Attributes
    ----------
    unknowns
        One item for each number, two for each field.
    samples
        Number of samples with a measurement.
    sentences
        Sentences on unknowns that are traded off, the number of identified modes of each field,
        shifts of unknowns by the discretisation, and sensor errors that would go undetected.
    last
        The same unknowns for a run of the last samples instead, as many; empty if there are no
        more.
    """

    unknowns: tuple[Identified, ...] = ()
    samples: int = 0
    sentences: tuple[str, ...] = ()
    last: tuple[Identified, ...] = ()


class StatedNoise(SensitivityLaw):
    """The sensitivity law with the covariance of its filter, as if model and noise were right.

    The covariance is not inflated by innovations.
    """

    def factors(self, work: SensitivityWork, x: FilterState) -> tuple[Array, Array]:
        return x.U, x.C


def linearised(law: AnyLaw) -> SensitivityLaw | None:
    """Return the law as a filter linearised at the prior; None for a law without covariance.

    Of a bank it is the member with constant unknowns.
    """
    if isinstance(law, AutoLaw):
        law = law.member
    if not isinstance(law, SensitivityLaw):
        return None
    # A replay that never comes keeps the reference, an infinite gate every reading.
    replay = Replay(NEVER, NEVER)
    return StatedNoise(law.modes, law.noise, law.drift, replay=replay, gate=np.inf, shadows=None)


def preview(prepared: Prepared, samples: Iterable[Sample]) -> Preview:
    """Return the identifiability by the first samples, linearised at the prior.

    The covariance of a filter with a fixed linearisation does not depend on measured values, only
    on their times and on inputs. So the law is linearised at the prior, never moves its reference,
    and its estimates are discarded. The remaining standard deviations are a best case: noise as
    stated, and a model without error. The preview of a law without covariance is empty.
    """
    linear = linearised(prepared.case.law)
    if linear is None:
        return Preview()
    if linear.noise is None and prepared.identifier.observed.noise is None:
        return Preview()  # the law estimates it from the samples
    # Samples may come from a stream, so they are iterated once, for both previews.
    begun, all_of = tee(samples)
    found = _told(prepared, replace(linear, shadows=Shadows()), begun)
    end = deque(enumerate(all_of, 1), maxlen=MOST_SAMPLES)
    if not found.samples or not end or end[-1][0] <= MOST_SAMPLES:
        return found
    last = [sample for _, sample in end]
    late = replace(prepared, first=last[0], assimilate_from=-np.inf)
    return replace(found, last=_told(late, linear, last).unknowns)


def _told(prepared: Prepared, linear: SensitivityLaw, samples: Iterable[Sample]) -> Preview:
    """Return the posterior after the first of some samples, linearised at the prior."""
    identifier = prepared.identifier_with(linear)
    count, estimate = _assimilated(identifier, samples, prepared.assimilate_from)
    model = prepared.case.model
    belief = identifier.latent_belief()
    prior, posterior = belief.prior_factor, belief.q_factor
    if not count or estimate is None or prior is None or posterior is None:
        return Preview()
    latent = model.latent
    # Factors are in latent coefficients; the tangent at the prior makes them physical.
    rest = None if belief.rest is None else latent.deviation(latent.prior, belief.rest)
    before, after = (
        replace(belief, q_factor=latent.tangent(latent.prior, factor), rest=rest)
        for factor in (prior, posterior)
    )
    told = tuple(_compare(prepared, before, after))
    sentences = (
        *identifiability(model, belief).sentences,
        *_shifted(estimate.diagnostics.shifts, {item.name: item.posterior for item in told}),
        *estimate.verdict.unseen,
    )
    return Preview(told, count, sentences)


def _assimilated(
    identifier: Identifier, samples: Iterable[Sample], start: float
) -> tuple[int, Estimate | None]:
    """Step through the first samples; return the number of measurements and the last estimate."""
    count, estimate = 0, None
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        if sample.t >= start:
            count += bool(np.isfinite(estimate.innovation).any())
        if count >= MOST_SAMPLES:
            break
    return count, estimate


def _shifted(shifts: Shifts[float], std: Mapping[str, float]) -> list[str]:
    """Return the shifts of numbers by the discretisation, in posterior standard deviations."""
    known = {
        (label, kind): shift
        for (label, kind), shift in shifts.unknowns.items()
        if kind in REFINE and std.get(label, 0.0) > 0.0
    }
    sizes, totals = dict.fromkeys(REFINE, 0.0), dict.fromkeys(std, 0.0)
    for (label, kind), shift in known.items():
        size = shift / std[label]
        sizes[kind] = max(sizes[kind], abs(size))
        totals[label] += size
    total = max(map(abs, totals.values()), default=0.0)
    return [finding.sentence for finding in discretised(Shifts(total, sizes, known))]


def _compare(prepared: Prepared, before: Belief, after: Belief) -> list[Identified]:
    """Return the standard deviations of all unknowns before and after the samples."""
    space = prepared.case.model.parameter_space
    units = {name: unknown.unit for name, unknown in space.unknowns.items()}
    prior, posterior = (np.asarray(belief.q_std) for belief in (before, after))
    found = [
        Identified(label, float(prior[k]), float(posterior[k]), space.unknown_of(label).unit)
        for label, k in space.labels.items()
    ]
    for name, block in space.fields.items():
        part = space.part(name)
        prior, posterior = (
            np.asarray(belief.deviation(block.at_vertices, part)) for belief in (before, after)
        )
        # A vertex without prior variance has no share that could remain.
        inside = np.flatnonzero(prior > 1e-12 * prior.max())
        left = posterior[inside] / prior[inside]
        for what, k in (("best", inside[left.argmin()]), ("worst", inside[left.argmax()])):
            at = ", ".join(f"{x:.3g}" for x in np.atleast_1d(block.field.mesh.p[:, k]))
            label = f"{name} at {at} ({what})"
            found.append(Identified(label, float(prior[k]), float(posterior[k]), units[name]))
    return found
