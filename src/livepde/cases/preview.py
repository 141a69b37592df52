"""Preview of a case: identifiability, discretisation errors, position of an additional sensor."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, tee
from typing import Any

import numpy as np

from livepde.cases.case import Prepared
from livepde.diagnostics.information_gain import information_gains
from livepde.errors import ConfigurationError
from livepde.fem import Inputs, Moment
from livepde.identifier import Identifier
from livepde.laws import AnyLaw, Belief, SensitivityLaw, Shadows
from livepde.laws.filter_state import FilterState
from livepde.laws.sensitivity_state import SensitivityWork
from livepde.linalg import Array
from livepde.model import Model
from livepde.observation import Combined, Observation, Points
from livepde.samples import Sample, by_name
from livepde.verdict import FLAT, REFINE, Shifts, discretised

MOST_SAMPLES = 500

MOST_CANDIDATES = 400  # about the largest number of candidate positions
SHORT_LIST = 5  # best candidates with a separate preview, if unknowns vary in time
NEW = "one more sensor"
NOTHING = "advice on sensors: the data contain no measurement."


@dataclass(frozen=True)
class Identified:
    """Standard deviations of an unknown in the preview, before and after the samples."""

    name: str  # label of a number, or name of a field with its best or worst determined vertex
    prior: float
    posterior: float
    unit: str

    @property
    def left(self) -> float:
        """Remaining share of the prior standard deviation."""
        return self.posterior / self.prior

    @property
    def not_identifiable(self) -> bool:
        """Whether the sensors do not identify the unknown."""
        return self.left > FLAT


@dataclass(frozen=True)
class Preview:
    """Information on the unknowns in the first samples of a case."""

    unknowns: tuple[Identified, ...] = ()  # one item for each number, two for each field
    samples: int = 0  # number of samples with a measurement
    sentences: tuple[str, ...] = ()
    last: tuple[Identified, ...] = ()  # by the last `MOST_SAMPLES`, if the data have more samples


class StatedNoise(SensitivityLaw):
    """The sensitivity law for an exact model and noise as stated, linear about the prior."""

    relinearises = False

    def factors(self, work: SensitivityWork, x: FilterState) -> tuple[Array, Array]:
        return x.U, x.C


def linearised(law: AnyLaw) -> SensitivityLaw | None:
    """Return a filter linearised at the prior; None for a law without covariance."""
    if not isinstance(law, SensitivityLaw):
        return None
    return StatedNoise(
        modes=law.modes,
        noise=law.noise,
        drift=law.drift,
        refit=None,
        guards=None,
        gate=np.inf,
        shadows=None,
    )


def preview(prepared: Prepared, samples: Iterable[Sample]) -> Preview:
    """Return the identifiability from the first samples, linearised at the prior.

    The covariance then depends on times of measurements and on inputs, not on measured values. It
    is a best case: exact model, noise as stated. A law without covariance has an empty preview.
    """
    linear = linearised(prepared.case.law)
    if linear is None or (linear.noise is None and prepared.identifier.observed.noise is None):
        return Preview()  # in the second case, the law estimates the noise from the samples
    # Samples may come from a stream, so both previews share one iteration.
    begun, all_of = tee(samples)
    found = _told(prepared, replace(linear, shadows=Shadows()), begun)
    end = deque(enumerate(all_of, 1), maxlen=MOST_SAMPLES)
    if not found.samples or not end or end[-1][0] <= MOST_SAMPLES:
        return found
    last = [sample for _, sample in end]
    late = replace(prepared, first=last[0], assimilate_from=-np.inf)
    return replace(found, last=_told(late, linear, last).unknowns)


def predicted(prepared: Prepared, samples: Iterable[Sample]) -> tuple[Array, Array]:
    """Return the first readings and their prior predictions, both of shape (samples, sensors)."""
    law = SensitivityLaw(
        modes=1, noise=1.0, refit=None, guards=None, shadows=None, gate=np.inf, verdict=False
    )
    who = replace(prepared, assimilate_from=np.inf).identifier_with(law)
    names, read, apart = who.observed.names, list[Array](), list[Array]()
    for sample in islice(samples, MOST_SAMPLES):
        given = by_name(sample.z, ())
        read.append(np.array([given.get(name, np.nan) for name in names], dtype=float))
        apart.append(who.step(sample.t, sample.z, sample.inputs).innovation)
    measured = np.array(read).reshape(-1, len(names))
    return measured, measured - np.array(apart).reshape(measured.shape)


def _told(prepared: Prepared, linear: SensitivityLaw, samples: Iterable[Sample]) -> Preview:
    """Return the preview from the first `MOST_SAMPLES` of given samples."""
    identifier, model = prepared.identifier_with(linear), prepared.case.model
    count, estimate = 0, None
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        seen = np.isfinite(estimate.innovation).any()
        count += int(seen & (sample.t >= prepared.assimilate_from))
        if count >= MOST_SAMPLES:
            break
    belief = identifier._latent_belief()
    prior, posterior = belief.prior_factor, belief.q_factor
    if not count or estimate is None or prior is None or posterior is None:
        return Preview()
    latent = model.latent
    # Factors are in latent coefficients; the tangent at the prior maps them to physical units.
    rest = None if belief.rest is None else latent.deviation(latent.prior, belief.rest)
    before, after = (
        replace(belief, q_factor=latent.tangent(latent.prior, factor), rest=rest)
        for factor in (prior, posterior)
    )
    compared = tuple(_compare(prepared, before, after))
    sentences = (
        *information_gains(model, belief).sentences,
        *_shifted(estimate.diagnostics.shifts, {item.name: item.posterior for item in compared}),
        *estimate.verdict.unseen,
    )
    return Preview(compared, count, sentences)


def _shifted(shifts: Shifts[float], std: Mapping[str, float]) -> list[str]:
    """Return sentences on shifts by the discretisation, in units of posterior std."""
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
    """Return the standard deviations of all unknowns, for fields at the best and worst vertex."""
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
        # The remaining share is undefined at vertices without prior variance.
        inside = np.flatnonzero(prior > 1e-12 * prior.max())
        left = posterior[inside] / prior[inside]
        for what, k in (("best", inside[left.argmin()]), ("worst", inside[left.argmax()])):
            at = ", ".join(f"{x:.3g}" for x in np.atleast_1d(block.field.mesh.p[:, k]))
            label = f"{name} at {at} ({what})"
            found.append(Identified(label, float(prior[k]), float(posterior[k]), units[name]))
    return found


@dataclass(frozen=True, eq=False)
class Advice:
    """The best candidate position for an additional sensor."""

    position: Array  # coordinates, shape (d,)
    # Unknown -> remaining share of its prior standard deviation, without and with the sensor.
    now: Mapping[str, float]
    then: Mapping[str, float]
    candidates: int  # number of compared positions


def advise(prepared: Prepared, samples: Iterable[Sample]) -> Advice:
    """Return the position where an additional point sensor would reduce the posterior most.

    The criterion is the mean over the unknowns of posterior over prior variance; for a field, both
    are means over the domain. The candidates are vertices of the mesh. The new sensor has the
    median noise of the others, and measures whenever at least one of them does.

    Linearised at the prior, the information of sensors is additive. Let Y be the sensitivity of a
    reading, over its noise, to the reduced coordinates a ~ N(0, I). The posterior covariance of a
    is (I + sum of Y^T Y)^-1. One run without assimilation gives the sums for all candidates.
    """
    case, law = prepared.case, linearised(prepared.case.law)
    if law is None:
        text = "advice on sensors needs a law with a covariance: kind = 'sensitivity'."
        raise ConfigurationError(text)
    if law.drift or case.model.latent.random:  # an unknown varies in time
        return _advise_moving(prepared, law, list(samples))
    # Information on a, including the prior, and information from each candidate.
    here, each = np.zeros((0, 0)), np.zeros((0, 0, 0))
    factor: Array | None = None
    for Y, new, q_factor in islice(_sensitivities(prepared, law, samples), MOST_SAMPLES):
        if factor is None:
            k = Y.shape[1]
            here, each = np.eye(k), np.zeros((len(new), k, k))
        here += Y.T @ Y
        each += new[:, :, None] * new[:, None, :]
        factor = q_factor
    if factor is None:
        raise ConfigurationError(NOTHING)
    weights = _weights(case.model, factor)
    before = np.linalg.inv(here)
    after = np.linalg.inv(here + each)
    mean = sum(weights.values()) / len(weights)
    best = int(np.einsum("ij,cji->c", mean, after).argmin())
    now, then = (
        {name: float(np.sqrt(np.sum(W * P))) for name, W in weights.items()}
        for P in (before, after[best])
    )
    _, positions, _ = _candidates(prepared)
    return Advice(positions[:, best], now, then, len(after))


def _sensitivities(
    prepared: Prepared, law: SensitivityLaw, samples: Iterable[Sample]
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield, for each measurement, sensitivities to a of readings and candidates, and q's factor.

    Sensitivities are divided by the noise, with shapes (readings, k) and (candidates, k).
    """
    silent = replace(prepared, assimilate_from=np.inf)
    identifier = silent.identifier_with(SensitivityLaw(law.modes, law.noise, shadows=None))
    values, _, part = _candidates(prepared)
    noise = _noise(identifier, law)
    known: dict[str, float] = {}
    for sample in samples:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        given = by_name(sample.z, ()) | dict(sample.inputs or {})
        known |= {n: v for n in identifier.inputs if np.isfinite(v := given.get(n, np.nan))}
        belief, seen = estimate.belief, np.isfinite(estimate.innovation)
        if sample.t < prepared.assimilate_from or not seen.any():
            continue
        if belief.u_factor is None or belief.q_factor is None:
            return
        # Readings depend on the unknowns through the state and, if H_q exists, directly.
        H_u, H_q = identifier.observed.jacobian(
            estimate.u, estimate.q, Moment(sample.t, Inputs(known))
        )
        Y = H_u @ belief.u_factor
        if H_q is not None:
            Y = Y + H_q @ belief.q_factor
        new = (values @ belief.u_factor[part]) / np.median(noise)
        yield (Y / noise[:, None])[seen], new, belief.q_factor


def _candidates(prepared: Prepared) -> tuple[Any, Array, Any]:
    """Return the evaluation matrix of candidates, positions (d, candidates), and state part."""
    case = prepared.case
    block, part = case.model.state_space.component(case.observation.of)
    if block.vector:
        raise ConfigurationError(
            "advice on sensors requires a state that is one number at each point; this one is a "
            "vector."
        )
    # -(-n // m) is n / m, rounded up.
    every = -(-block.field.mesh.p.shape[1] // MOST_CANDIDATES)
    return block.at_vertices[::every], block.field.mesh.p[:, ::every], part


def _noise(identifier: Identifier, law: SensitivityLaw) -> Array:
    """Return the noise of each sensor, from the law or the observation, shape (sensors,)."""
    found = identifier.observed.noise if isinstance(law.noise, str | None) else law.noise
    return np.broadcast_to(np.asarray(found, dtype=float), identifier.observed.size)


def _advise_moving(prepared: Prepared, law: SensitivityLaw, samples: Sequence[Sample]) -> Advice:
    """Return the advice for unknowns that vary, so that the information in old samples decays.

    The candidates are ranked by the variance reduction of an additional reading, summed over the
    samples of the preview. Each of the best candidates gets a separate preview.
    """
    values, positions, part = _candidates(prepared)
    model, reductions = prepared.case.model, np.zeros(positions.shape[1])
    identifier = prepared.identifier
    noise = float(np.median(_noise(identifier, law)))
    weights: dict[str, Array] = {}
    for belief in _previewed(prepared, law, samples, prepared.case.observation):
        if not weights and (prior := belief.prior_factor) is not None:
            weights = _weights(model, model.latent.tangent(model.latent.prior, prior))
        C = _reduced(model, belief)
        if belief.u_factor is None:
            continue
        Y = (values @ belief.u_factor[part]) / noise
        # An additional reading with row y reduces C C^T by C y y^T C^T / (1 + y^T y).
        gain = np.einsum("cr,rs,cs->c", Y, C.T @ sum(weights.values()) @ C, Y)
        reductions += gain / (1.0 + (Y**2).sum(axis=1))
    if not weights:
        raise ConfigurationError(NOTHING)
    now = _left(weights, C)
    # The ranking considers readings one by one, the previews consider all of them jointly.
    tried = []
    for best in np.argsort(-reductions)[:SHORT_LIST]:
        at: Any = positions[:, best].tolist()
        own, x = prepared.case.observation, at if len(at) > 1 else at[0]
        sensors = Combined([own, Points({NEW: x}, noise=noise, of=own.of)])
        for belief in _previewed(prepared, law, samples, sensors):
            C = _reduced(model, belief)
        then = _left(weights, C)
        tried.append((sum(share**2 for share in then.values()), int(best), then))
    _, place, then = min(tried, key=lambda item: item[0])
    return Advice(positions[:, place], now, then, len(reductions))


def _previewed(
    prepared: Prepared, law: SensitivityLaw, samples: Iterable[Sample], sensors: Observation
) -> Iterator[Belief]:
    """Yield the belief of a filter linearised at the prior after each measurement."""
    identifier = prepared.identifier_with(law, sensors)
    own = [name for name in identifier.observed.names if name != NEW]
    count = 0
    for sample in samples:
        given: Mapping[str, float] = sample.z  # type: ignore[assignment]
        seen = any(np.isfinite(given.get(name, np.nan)) for name in own)
        # The covariance depends on the presence of a reading, not on its value.
        z = {**given, **({NEW: 0.0} if seen and NEW in identifier.observed.names else {})}
        identifier.step(sample.t, z, sample.inputs)
        if seen and sample.t >= prepared.assimilate_from:
            count += 1
            yield identifier._latent_belief()
        if count >= MOST_SAMPLES:
            break


def _reduced(model: Model, belief: Belief) -> Array:
    """Return the square root of the posterior covariance in reduced coordinates, (k, r)."""
    if belief.prior_factor is None or belief.q_factor is None:
        return np.zeros((0, 0))
    reduced: Array = belief.prior_factor.T @ model.Q.dual(belief.q_factor)
    return reduced


def _left(weights: Mapping[str, Array], C: Array) -> dict[str, float]:
    """Return the remaining share of the prior standard deviation of each unknown."""
    return {name: float(np.sqrt(np.sum(W * (C @ C.T)))) for name, W in weights.items()}


def _weights(model: Model, factor: Array) -> dict[str, Array]:
    """Return unknown -> W with trace(W P) its mean variance, relative to its prior (P = I)."""
    space = model.parameter_space
    found = {label: np.outer(factor[k], factor[k]) for label, k in space.labels.items()}
    # The mass matrix integrates the variance of a field over the domain. Division by the trace
    # scales trace(W P) to 1 for the prior.
    for name in space.fields:
        part = space.part(name)
        found[name] = factor[part].T @ (model.parameter_mass[part, part] @ factor[part])
    return {name: W / np.trace(W) for name, W in found.items()}
