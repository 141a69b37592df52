"""Reduced coordinates a of the unknowns, q = prior + Phi a, and their evolution in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import block_diag

from livepde.errors import LawError
from livepde.fem import Evolution, FieldBlock, base_name
from livepde.laws.law import Problem
from livepde.linalg import Array, Mask
from livepde.observation.slow import TIME_CONSTANT

LEFT_OUT = 1e-4  # share of the prior variance of a field that modes="auto" omits
MOST_MODES = 60  # largest number of modes of a field with modes="auto"


@dataclass(frozen=True, eq=False)
class ReducedEvolution:
    """Evolution of one unknown in reduced coordinates."""

    part: slice  # slice of the reduced coordinates of the unknown: copies times modes
    # Evolution model of the latent coefficients, and their prior standard deviation.
    model: Evolution
    std: float

    def transition(self, h: float) -> Array:
        # F is the transition of copies, such as the harmonics of a periodic unknown. It is the same
        # for all modes.
        F = self.model.transition(h)
        modes = (self.part.stop - self.part.start) // len(F)
        return F if modes == 1 else np.asarray(np.kron(F, np.eye(modes)))

    def growth(self, h: float) -> Array:
        """Return the variance that the coordinates gain in a time h."""
        gained = self.model.growth(h, self.std)
        return np.repeat(gained, (self.part.stop - self.part.start) // len(gained))

    @property
    def rates(self) -> Array:
        """Rate at which each coordinate relaxes to the prior mean; zero for a random walk."""
        rates = -np.diag(self.model.generator)
        return np.repeat(rates, (self.part.stop - self.part.start) // len(rates))

    def backward(self, h: float, drift: float) -> Array:
        """Return the matrix that predicts the coordinates backwards by a time h."""
        F, growth = self.transition(h), self.growth(h)
        # Gain of Rauch's smoother, P F^T (F P F^T + W)^-1, for the prior P = I.
        growth = growth if self.model.moves else growth + drift * h
        return np.asarray(np.linalg.solve(F @ F.T + np.diag(growth), F).T)


@dataclass(frozen=True, eq=False)
class Reduction:
    """Reduced coordinates a ~ N(0, I) of all unknowns, q = prior + Phi a."""

    problem: Problem  # model and sensors
    # Prior standard deviations for numbers, leading modes of the prior for fields, shape (m, k).
    Phi: Array
    evolutions: tuple[ReducedEvolution, ...]  # evolution models of the coordinates of each unknown

    @classmethod
    def of(cls, problem: Problem, modes: int | str | dict[str, int]) -> Reduction:
        """Return the reduction of a problem; `modes` is defined in `SensitivityLaw`."""
        model = problem.model
        counts = _mode_counts(modes, model.parameter_space.fields)
        blocks, evolutions, start = [], [], 0
        for name, item in model.latent.parts.items():
            first = slice(item.part.start, item.part.start + item.size)
            if isinstance(item.block, FieldBlock):
                part = model.parameter_space.part(name)
                # Modes of N(0, G_Q^-1), in decreasing order of their mean variance over the domain.
                inner = model.Q.restricted(first, item.block.fixed)
                count = min(counts[name], int(inner.free.sum()))
                mass = model.parameter_mass[part, part]
                phi, _ = inner.modes(count, mass)
                if modes == "auto":  # keep all of the variance except the share `LEFT_OUT`
                    weights = mass.diagonal()
                    enough = (1.0 - LEFT_OUT) * inner.spread(weights, phi)
                    phi = phi[:, : 1 + int((np.cumsum(weights @ phi**2) < enough).sum())]
            else:
                phi = np.eye(item.size) * item.unknown.prior.latent_std
            # One block of modes for each copy: mean and harmonics of a periodic unknown.
            blocks.append(np.kron(np.eye(item.evolution.copies), phi))
            stop = start + blocks[-1].shape[1]
            std = item.unknown.prior.latent_std
            evolutions.append(ReducedEvolution(slice(start, stop), item.evolution, std))
            start = stop
        return cls(problem, np.asarray(block_diag(*blocks)), tuple(evolutions))

    @property
    def size(self) -> int:
        """Number of reduced coordinates k."""
        return int(self.Phi.shape[1])

    @cached_property
    def moves(self) -> bool:
        """True if an unknown has an evolution."""
        return any(evolution.model.moves for evolution in self.evolutions)

    @cached_property
    def rates(self) -> Array:
        """Rate at which each coordinate relaxes to the prior mean, shape (k,)."""
        return np.concatenate([evolution.rates for evolution in self.evolutions])

    @cached_property
    def still(self) -> Mask:
        """Mask of the coordinates of constant unknowns, shape (k,)."""
        still = np.ones(self.size, dtype=bool)
        for evolution in self.evolutions:
            still[evolution.part] = not evolution.model.moves
        return still

    @property
    def stay(self) -> list[tuple[str, int]]:
        """Labels and indices of the coordinates of constant unknowns, numbers before fields."""
        numbers, modes = [], []
        for (name, item), evolution in zip(
            self.problem.model.latent.parts.items(), self.evolutions, strict=True
        ):
            if evolution.model.moves:
                continue
            first, count = evolution.part.start, evolution.part.stop - evolution.part.start
            if isinstance(item.block, FieldBlock):
                modes += [(f"{name}, mode {k + 1}", first + k) for k in range(count)]
                continue
            labels = item.block.labels(name)
            named = labels if len(labels) == count else [f"{name}, {k + 1}" for k in range(count)]
            numbers += [(label, first + k) for k, label in enumerate(named)]
        return numbers + modes

    def named(self, names: Sequence[str] | None, who: str) -> Mask:
        """Return the mask of coordinates of named unknowns, (k,). Raises `LawError`.

        None: all but the time constants of slow sensors, which no change of the process changes.
        """
        parts, space = list(self.problem.model.latent.parts), self.problem.model.parameter_space
        missing = [name for name in names or () if name not in space.parts]
        if missing:
            known = list(space.parts)
            raise LawError(f"{who}: there is no unknown '{missing[0]}'; there are {known}.")
        chosen = np.zeros(self.size, dtype=bool)
        for name, evolution in zip(parts, self.evolutions, strict=True):
            both = {name, base_name(name)}
            chosen[evolution.part] = (
                TIME_CONSTANT not in both if names is None else bool(both & set(names))
            )
        return chosen

    def moving(self, drift: float) -> int:
        """Return the number of coordinates that gain variance."""
        return sum(
            evolution.part.stop - evolution.part.start
            for evolution in self.evolutions
            if evolution.growth(1.0).any() or (drift and not evolution.model.moves)
        )

    def transition(self, h: float) -> Array:
        """Return the transition matrix of all coordinates for a time h, shape (k, k)."""
        return _transition(self.evolutions, h)

    def gained(self, h: float, variance: Array, drift: Array) -> Array:
        """Return the variance that coordinates gain in a time h, shape (members, k).

        The gain of a drifting unknown decreases as its variance approaches the prior variance,
        which it never exceeds.
        """
        gained = _growth(self.evolutions, h)
        if not drift.any():
            return np.broadcast_to(gained, variance.shape)
        # Exact solution of V' = drift (1 - V) for a step of any length.
        more = -np.expm1(-drift * h)[:, None] * np.maximum(1.0 - variance, 0.0)
        return np.where(self.still, more, gained)

    def in_prior_units(self, C: Array, age: Array) -> Array:
        """Return rows of a, (members, r, k), in units of the prior at given ages, (members,).

        The prior of moving unknowns changes with the time since the start.
        """
        if not self.moves:
            return C
        each = []
        for rows, h in zip(C, age.tolist(), strict=True):
            F = self.transition(h)
            # Covariance of the prior after the time h, which began as N(0, I).
            variances, axes = np.linalg.eigh(F @ F.T + np.diag(_growth(self.evolutions, h)))
            least = np.finfo(float).eps * variances[-1]
            each.append(rows @ axes / np.sqrt(np.maximum(variances, least)))
        return np.array(each)

    def predict(self, q: Array, h: float) -> Array:
        """Return the expected latent parameters after a time h, shape (members, m)."""
        latent = self.problem.model.latent
        if not latent.generator.nnz:
            return q
        change = q - latent.prior
        for p in latent.parts.values():
            copies = change[:, p.part].reshape(len(q), p.evolution.copies, p.size)
            change[:, p.part] = (p.evolution.transition(h) @ copies).reshape(len(q), -1)
        return np.asarray(latent.prior + change)

    @cached_property
    def _dual(self) -> Array:
        """Transpose of Phi^T times the Gram matrix of Q, shape (m, k)."""
        Q = self.problem.model.Q
        return np.stack([Q.dual(column) for column in self.Phi.T], axis=1)

    def reduced(self, dq: Array) -> Array:
        """Return a with Phi a = dq, (..., k) for (..., m); columns of Phi are orthonormal in Q."""
        return dq @ self._dual

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """Smallest and largest latent parameters, shapes (m,): bounds, and a range about the prior.

        The range is `within` prior standard deviations on each side. For a field, these are the
        standard deviations of its coefficients in the modes; a coefficient without modes is free.
        """
        latent = self.problem.model.latent
        # Prior standard deviation of each latent coefficient in the modes.
        deviation = np.linalg.norm(self.Phi, axis=1)
        reach = np.concatenate(
            [
                np.full(item.part.stop - item.part.start, item.unknown.reach)
                for item in latent.parts.values()
            ]
        )
        farthest = np.where(deviation > 0.0, reach, np.inf) * np.where(
            deviation > 0.0, deviation, 1.0
        )
        lower, upper = latent.bounds
        return (
            np.maximum(lower, latent.prior - farthest),
            np.minimum(upper, latent.prior + farthest),
        )

    def bounded(self, q: Array) -> Array:
        """Return latent parameters clipped to `ends`, shape (..., m); q itself if inside."""
        lower, upper = self.ends
        inside = (q >= lower) & (q <= upper)
        return q if np.count_nonzero(inside) == q.size else np.minimum(np.maximum(q, lower), upper)

    def held(self, q: Array) -> Array:
        """Return the number of latent parameters beyond `within`, (...) for (..., m)."""
        lower, upper = self.ends
        bounds = self.problem.model.latent.bounds  # bounds that the user has set do not count
        return np.asarray(
            (((q < lower) & (lower > bounds[0])) | ((q > upper) & (upper < bounds[1]))).sum(axis=-1)
        )

    def directions(self, q: Array, C: Array) -> Array:
        """Return the changes of the physical parameter along rows of a, (members, r, m)."""
        latent, along = self.problem.model.latent, C @ self.Phi.T
        if latent.plain:
            return along
        # Chain rule with the derivative of the transform, for example the exponential.
        along = latent.slopes(q.T).T[:, None, :] * along
        if latent.dim == latent.space.dim:
            return along
        return np.asarray(latent.V @ along.reshape(-1, latent.dim).T).T.reshape(
            *along.shape[:2], latent.V.shape[0]
        )

    def traced(self, q: Array, start: Array, h: float, drift: float) -> Array:
        """Return the expected latent parameter a time h before it became q, shape (m,)."""
        if not (self.moves or drift):
            return q
        prior = self.problem.model.latent.prior
        # Expected values of a at the start given its values at the end, for each evolution.
        back = block_diag(*(evolution.backward(h, drift) for evolution in self.evolutions))
        return start + self.Phi @ (back @ self.reduced(q - prior) - self.reduced(start - prior))

    @cached_property
    def _left_out(self) -> Array:
        """Prior variance of each latent coefficient in the omitted modes, shape (m,)."""
        model = self.problem.model
        omitted = np.zeros(len(self.Phi))
        for item in model.latent.parts.values():
            if isinstance(item.block, FieldBlock):
                first = slice(item.part.start, item.part.start + item.size)
                space = model.Q.restricted(first, item.block.fixed)
                omitted[item.part] = np.tile(space.beyond(self.Phi[first]), item.evolution.copies)
        return omitted

    def rest(self, age: float, drift: float) -> Array:
        """Return the prior standard deviations in the omitted modes at a given age, (m,)."""
        if age == 0.0 or not self._left_out.any():
            return np.asarray(np.sqrt(self._left_out))
        grown = []
        for evolution, item in zip(
            self.evolutions, self.problem.model.latent.parts.values(), strict=True
        ):
            growth = evolution.model.growth(age, evolution.std)
            growth = growth if evolution.model.moves else growth + drift * age
            variance = (evolution.model.transition(age) ** 2).sum(axis=1) + growth
            grown.append(np.repeat(variance, item.size))
        return np.asarray(np.sqrt(self._left_out * np.concatenate(grown)))


def _mode_counts(modes: int | str | dict[str, int], fields: object) -> dict[str, int]:
    """Return the largest number of modes of each field; raises `LawError`."""
    names = list(fields)  # type: ignore[call-overload]
    if isinstance(modes, str) and modes != "auto":
        raise LawError(
            f"SensitivityLaw: modes must be a number, 'auto', or a number for each field; got "
            f"{modes!r}."
        )
    most = MOST_MODES if isinstance(modes, str) else modes
    counts = most if isinstance(most, dict) else dict.fromkeys(names, most)
    if set(counts) != set(names):
        raise LawError(
            f"SensitivityLaw: modes names {sorted(counts)}; the fields are {sorted(names)}."
        )
    if any(count < 1 or count % 1 for count in counts.values()):
        raise LawError(f"SensitivityLaw: modes must be whole numbers of at least 1; got {modes!r}.")
    return counts


@lru_cache(maxsize=64)
def _transition(evolutions: tuple[ReducedEvolution, ...], h: float) -> Array:
    F = np.eye(evolutions[-1].part.stop if evolutions else 0)
    for evolution in evolutions:
        if evolution.model.moves:
            F[evolution.part, evolution.part] = evolution.transition(h)
    return F


@lru_cache(maxsize=64)
def _growth(evolutions: tuple[ReducedEvolution, ...], h: float) -> Array:
    return np.concatenate([evolution.growth(h) for evolution in evolutions])
