"""A filter that is linear about a reference: state and reduced parameter with a joint factor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import block_diag, lapack

from livepde.errors import LawError
from livepde.fem import Evolution, FieldBlock, Moment, RandomWalk
from livepde.laws.base import Problem
from livepde.laws.consistency import Consistency
from livepde.laws.level import NoiseLevel
from livepde.linalg import Array
from livepde.stepping import ForwardStage, Interval, Kept, StepFailed, advance

__all__ = ["Filter", "Motion", "Point", "reduction"]

LEFT_OUT = 1e-4  # share of the prior variance of a field that modes="auto" leaves out
MOST_MODES = 60  # of a field with modes="auto"
GAIN = 1e-4  # relative error of a square root of the covariance: it steers the gain only
ESTIMATE = 1e-8  # of the estimated deviation of the state
BLOCK = 32  # columns that LAPACK's QR takes at once


@dataclass(frozen=True, eq=False)
class Point:
    """A reference (u, q) and the linear filter about it.

    Attributes
    ----------
    u, q
        Reference state and parameter, shapes (n,) and (m,).
    du, da
        Estimated deviations of u and of the reduced parameter a, shapes (n,) and (k,).
    U, C
        Square root of the joint covariance of u and a, [U; C] [U; C]^T, shapes (n, r) and (k, r).
        As long as nothing moves, r = k and U = L C with the sensitivity L = du/da.
    consistency
        Statistics of the innovations.
    refused
        How many values in a row of each sensor the gate has refused, shape (sensors,).
    level
        Estimated noise as a multiple of the stated one; 1 unless the law finds it.
    evidence
        Logarithm of the likelihood of all samples so far, each given those before.
    age
        Time for which the unknowns have moved.
    kept
        What the last stage has left to the next.
    """

    u: Array
    q: Array
    du: Array
    da: Array
    U: Array = field(metadata={"grows": 1})
    C: Array = field(metadata={"grows": 1})
    consistency: Consistency
    refused: Array
    level: NoiseLevel
    evidence: float
    age: float = 0.0
    kept: Kept = field(default_factory=Kept.none)

    @cached_property
    def deviates(self) -> bool:
        """True if the estimate is not the reference."""
        return bool(self.du.any() or self.da.any())

    def along(self, shift: Array) -> Array:
        """Return by how much the state is expected to move with a shift of a, shape (n,)."""
        if not shift.any():
            return np.zeros(len(self.u))
        weights = np.linalg.lstsq(self.C, shift, rcond=None)[0]
        along: Array = self.U @ weights
        return along


@dataclass(frozen=True, eq=False)
class Motion:
    """How one unknown moves by itself, in reduced coordinates.

    Attributes
    ----------
    part
        Where its reduced coordinates stand: copies times modes.
    evolution, std
        Its model, and the prior deviation of its latent coefficients.
    saturates
        True if it gains the less the closer its variance is to that of the prior: it may move, but
        without data it is not less certain than at first.
    """

    part: slice
    evolution: Evolution
    std: float
    saturates: bool = False

    def drifting(self, rate: float) -> Motion:
        """Return it with a drift of `rate` prior variances per unit of time.

        The same if it moves by itself.
        """
        if not rate or self.evolution.moves:
            return self
        return replace(self, evolution=RandomWalk(float(np.sqrt(rate)) * self.std), saturates=True)

    def transition(self, h: float) -> Array:
        """Return the transition of its coordinates in a time h."""
        F = self.evolution.transition(h)
        return np.asarray(np.kron(F, np.eye((self.part.stop - self.part.start) // len(F))))

    def growth(self, h: float) -> Array:
        """Return the variance its coordinates gain in a time h."""
        gained = self.evolution.growth(h, self.std)
        return np.repeat(gained, (self.part.stop - self.part.start) // len(gained))

    def gained(self, h: float, variance: Array) -> Array:
        """Return what its coordinates gain in a time h, given variances of shape (..., k)."""
        growth = self.growth(h)
        if not self.saturates:
            return growth
        room: Array = np.maximum(1.0 - variance[..., self.part], 0.0)
        return -np.expm1(-growth) * room  # V' = growth (1 - V)/h, whatever the length of the step

    def backward(self, h: float) -> Array:
        """Return what the coordinates are expected to have been a time h before: matrix on them."""
        F = self.transition(h)
        return np.asarray(np.linalg.solve(F @ F.T + np.diag(self.growth(h)), F).T)


@dataclass(frozen=True, eq=False)
class Filter:
    """A filter for a problem, linear about the reference of a `Point`.

    Attributes
    ----------
    problem, forward
        What is filtered, and the forward stage of its steps.
    Phi, motions
        The reduction a_latent = prior + Phi a, shape (m, k), and how its coordinates move.
    noise
        Standard deviation of each sensor, shape (sensors,).
    scale, rank
        A factor of more than `rank` columns is compressed; `scale`, shape (n,), weighs the
        coefficients of the state then: the square root of the mass of each.
    gate, patience
        Innovations beyond `gate` expected deviations are refused, `patience` times in a row.
    adaptive
        True if the noise is a first guess whose multiple is found from the samples.
    """

    problem: Problem
    forward: ForwardStage
    Phi: Array
    motions: tuple[Motion, ...]
    noise: Array
    scale: Array
    rank: int
    gate: float
    patience: int
    adaptive: bool

    @cached_property
    def moves(self) -> bool:
        """True if an unknown moves by itself."""
        return any(motion.evolution.moves for motion in self.motions)

    def transition(self, h: float) -> Array:
        """Return the transition of all reduced coordinates in a time h, shape (k, k)."""
        return _transition(self.motions, h)

    def moved(self, point: Point, h: float) -> Point:
        """Return a point whose unknowns have moved for a time h; those of its state have not.

        What they gain is in new columns of the factor, in the same order for every h.
        """
        if not self.moves or h == 0.0:
            return point
        F = self.transition(h)
        variance = (point.C**2).sum(axis=1)
        gained = np.sqrt(np.concatenate([m.gained(h, variance) for m in self.motions]))
        new = np.diag(gained)[:, gained > 0.0]
        q = self.problem.model.latent.moved(point.q, h)
        U = np.hstack([point.U, np.zeros((len(point.u), new.shape[1]))])
        C, age = np.hstack([F @ point.C, new]), point.age + h
        return replace(point, q=q, da=F @ point.da, U=U, C=C, age=age)

    @cached_property
    def _left_out(self) -> Array:
        """Prior variance of each latent coefficient in the modes that are left out, shape (m,)."""
        model = self.problem.model
        left = np.zeros(len(self.Phi))
        for item in model.latent.parts.values():
            if isinstance(item.block, FieldBlock):
                first = slice(item.part.start, item.part.start + item.size)
                space = model.Q.restricted(first, item.block.fixed)
                left[item.part] = np.tile(space.beyond(self.Phi[first]), item.evolution.copies)
        return left

    @cached_property
    def _still(self) -> Array:
        return np.asarray(np.sqrt(self._left_out))

    def rest(self, age: float) -> Array:
        """Return the deviation of each latent coefficient in the modes that are left out, (m,).

        They are as the prior has them, and have moved for a time `age`.
        """
        if age == 0.0 or not self._left_out.any():
            return self._still
        parts = self.problem.model.latent.parts.values()
        grown = [
            np.repeat(
                (motion.evolution.transition(age) ** 2).sum(axis=1)
                + motion.evolution.growth(age, motion.std),
                item.size,
            )
            for motion, item in zip(self.motions, parts, strict=True)
        ]
        return np.asarray(np.sqrt(self._left_out * np.concatenate(grown)))

    def traced(self, q: Array, start: Array, h: float) -> Array:
        """Return the latent parameter that is expected to have become q in a time h.

        Parameters
        ----------
        start
            One at that time; what no mode sees is taken from it.
        """
        if not self.moves:
            return q
        prior = self.problem.model.latent.prior
        back = block_diag(*(motion.backward(h) for motion in self.motions))
        return start + self.Phi @ (back @ self.reduced(q - prior) - self.reduced(start - prior))

    def latent(self, point: Point) -> Array:
        """Return the estimated latent parameter, not yet bounded."""
        q: Array = point.q + self.Phi @ point.da
        return q

    def predict(self, point: Point, moment: Moment) -> Array:
        """Return what the sensors are expected to show, linear about the reference."""
        predicted = self.problem.predict(point.u, point.q, moment)
        if not point.deviates:
            return predicted
        return predicted + self._seen(point, point.du[:, None], point.da[:, None], moment)[:, 0]

    def output(self, point: Point, moment: Moment) -> Array:
        """Return the derivative of the prediction along the columns of the factor, H [U; C]."""
        return self._seen(point, point.U, point.C, moment)

    def _seen(self, point: Point, du: Array, da: Array, moment: Moment) -> Array:
        """Return by how much the sensors see a change of state and reduced parameter."""
        latent = self.problem.model.latent
        H_u, H_q = self.problem.observed.jacobian(point.u, latent.value(point.q), moment)
        seen: Array = H_u @ du
        return seen if H_q is None else seen + H_q @ latent.tangent(point.q, self.Phi @ da)

    def reduced(self, dq: Array) -> Array:
        """Return a with Phi a = dq: the columns of Phi are orthonormal in Q."""
        a: Array = self.Phi.T @ self.problem.model.Q.dual(dq)
        return a

    def bounded(self, q: Array) -> Array:
        """Return the latent parameter within its bounds."""
        return self.problem.model.latent.clipped(q)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # reported as a status
    def advanced(self, point: Point, interval: Interval) -> tuple[Point, int, StepFailed | None]:
        """Return the filter at the end of an interval, substeps, and why it failed or None."""
        end = self.moved(point, interval.t1 - interval.t0)
        deviates = end.deviates
        kept, tolerance = point.kept, ESTIMATE if deviates else GAIN

        def directions(at: Point) -> Array:
            C = np.column_stack([at.C, at.da]) if deviates else at.C
            return self.problem.model.latent.tangent(at.q, self.Phi @ C)

        at_end = directions(end)

        def stage(c: Array, t: float, h: float) -> Array:
            nonlocal kept
            q, along = end.q, at_end
            if self.moves and t != interval.t1:
                now = self.moved(point, t - interval.t0)
                q, along = now.q, directions(now)
            y, kept = self.forward.advance(c, q, along, h, interval.at(t), kept, tolerance)
            return y

        deviation = [end.du] if deviates else []
        columns = np.column_stack([end.u, end.U, *deviation])
        y, steps, failure = advance(self.problem.control, stage, columns, interval)
        if failure is None and not np.isfinite(y).all():
            failure = StepFailed("not_finite", "the prediction is not finite")
        if failure is not None:
            return point, steps, failure
        r = end.U.shape[1]
        U, C, du = y[:, 1 : 1 + r], end.C, y[:, 1 + r] if deviates else end.du
        if C.shape[1] > self.rank:
            U, C = _compressed(U, C, self.scale, self.rank)
        return replace(end, u=y[:, 0], U=U, C=C, du=du, kept=kept), steps, None

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # reported as a status
    def updated(self, point: Point, interval: Interval, predicted: Array) -> tuple[Point, int]:
        """Return the filter after the sample, and how many values the gate refused."""
        d = interval.z1 - predicted
        present = np.isfinite(d)
        if not present.any():
            return point, 0
        noise = point.level.scale * self.noise
        Y = self.output(point, interval.end) / noise[:, None]
        e = d / (noise * np.sqrt(1.0 + (Y**2).sum(axis=1)))
        used, count = present, 0
        if np.isfinite(self.gate):
            far = present & ~(np.abs(e) <= self.gate)
            refused = np.where(far, point.refused + 1, np.where(present, 0, point.refused))
            used = present & ~(far & (refused <= self.patience))
            count = int(present.sum() - used.sum())
            point = replace(point, refused=refused)
            e = np.where(used, e, np.nan)
        consistency = point.consistency.add(e)
        if not used.any():
            return replace(point, consistency=consistency), count
        d /= noise
        if not used.all():
            Y, d, noise = Y[used], d[used], noise[used]
        W, spread = _contraction(Y)
        half = W.T @ (Y.T @ d)
        U, C = point.U @ W, point.C @ W
        spread += float(np.log(noise).sum())
        evidence = point.evidence - 0.5 * float(d @ d - half @ half) - spread
        new = replace(
            point,
            da=point.da + C @ half,
            du=point.du + U @ half,
            C=C,
            U=U,
            consistency=consistency,
            evidence=evidence,
        )
        if self.adaptive:
            # What the update leaves of the sample, and what is left of its variance.
            seen = Y @ W
            left = float(((d - seen @ half) ** 2).mean() + (seen**2).sum(axis=1).mean())
            new = replace(new, level=point.level.add(left))
        return new, count

    def loosened(self, point: Point, size: float) -> Point:
        """Return the filter with `size` prior deviations added to the uncertainty of each unknown.

        Independent of what the state remembers: the state is as well known as before.
        """
        k = len(point.da)
        C = np.hstack([point.C, size * np.eye(k)])
        U = np.hstack([point.U, np.zeros((len(point.u), k))])
        if C.shape[1] > self.rank:
            U, C = _compressed(U, C, self.scale, self.rank)
        return replace(point, U=U, C=C)

    def fresh(self, point: Point) -> Point:
        """Return the filter with the prior of the unknowns, and the state as it is estimated."""
        k = len(point.da)
        prior = self.problem.model.latent.prior
        state, U = point.u + point.du, np.zeros((len(point.u), k))
        zero = np.zeros(k)
        return replace(point, u=state, q=prior, du=0.0 * point.du, da=zero, U=U, C=np.eye(k))

    def recentred(self, point: Point) -> Point:
        """Return the filter with its reference at the estimate, within the bounds.

        Bounds hold for references and for what is reported, not for the linear filter: what lies
        beyond them stays in da and du, so that nothing the data said is lost.
        """
        estimate = self.latent(point)
        within = self.bounded(estimate)
        if within is estimate or np.array_equal(within, estimate):
            zero = np.zeros(len(point.da))
            return replace(point, u=point.u + point.du, q=estimate, du=0.0 * point.du, da=zero)
        shift = self.reduced(within - point.q)
        beyond = point.along(point.da - shift)
        return replace(
            point,
            u=point.u + point.du - beyond,
            q=point.q + self.Phi @ shift,
            du=beyond,
            da=point.da - shift,
        )


def reduction(
    problem: Problem, modes: int | str | dict[str, int], drift: float
) -> tuple[Array, tuple[Motion, ...]]:
    """Return Phi, shape (m, k), and how its coordinates move.

    Parameters
    ----------
    modes, drift
        As for `SensitivityLaw`.
    """
    model = problem.model
    fields = model.parameter_space.fields
    if isinstance(modes, str) and modes != "auto":
        raise LawError(
            f"SensitivityLaw: modes must be a number, 'auto', or a number for each field; got "
            f"{modes!r}."
        )
    most = MOST_MODES if isinstance(modes, str) else modes
    counts = most if isinstance(most, dict) else dict.fromkeys(fields, most)
    if set(counts) != set(fields):
        raise LawError(
            f"SensitivityLaw: modes names {sorted(counts)}; the fields are {sorted(fields)}."
        )
    if any(count < 1 or count % 1 for count in counts.values()):
        raise LawError(f"SensitivityLaw: modes must be whole numbers of at least 1; got {modes!r}.")
    blocks, motions, start = [], [], 0
    for name, item in model.latent.parts.items():
        first = slice(item.part.start, item.part.start + item.size)
        if isinstance(item.block, FieldBlock):
            part = model.parameter_space.part(name)
            inner = model.Q.restricted(first, item.block.fixed)
            count = min(counts[name], int(inner.free.sum()))
            mass = model.parameter_mass[part, part]
            phi, _ = inner.modes(count, mass)
            if modes == "auto":
                weights = mass.diagonal()
                phi = phi[:, : _enough(phi, weights, inner.spread(weights, phi))]
        else:
            phi = np.eye(item.size) * item.unknown.latent_std
        blocks.append(np.kron(np.eye(item.evolution.copies), phi))
        stop = start + blocks[-1].shape[1]
        motion = Motion(slice(start, stop), item.evolution, item.unknown.latent_std)
        motions.append(motion.drifting(drift))
        start = stop
    Phi: Array = np.asarray(block_diag(*blocks))
    return Phi, tuple(motions)


def _enough(phi: Array, mass: Array, variance: float) -> int:
    """Return how many modes hold all of the prior variance but a share of `LEFT_OUT`."""
    held = np.cumsum(mass @ phi**2)
    short = int((held < (1.0 - LEFT_OUT) * variance).sum())
    return min(short + 1, len(held))


@lru_cache(maxsize=64)
def _transition(motions: tuple[Motion, ...], h: float) -> Array:
    return np.asarray(block_diag(*(motion.transition(h) for motion in motions)))


def _contraction(Y: Array) -> tuple[Array, float]:
    """Return W with W W^T = (I + Y^T Y)^-1, shape (r, r), and the logarithm of 1/|det W|.

    W = R^-1 from a QR factorisation of [I; Y]: nothing is squared.
    """
    count, r = Y.shape
    stacked = np.zeros((r, r + count))  # transposed: LAPACK counts down the columns
    stacked[:, r:] = Y.T
    stacked.flat[:: r + count + 1] = 1.0
    factored, _, _, _ = lapack.dgeqrf(stacked.T, lwork=BLOCK * r, overwrite_a=1)
    root = np.triu(factored[:r])
    # SciPy's triangular solve would start threads for this small matrix; this one does not.
    W: Array = np.asarray(np.linalg.inv(root), dtype=float)
    return W, float(np.log(np.abs(root.diagonal())).sum())


def _compressed(U: Array, C: Array, scale: Array, rank: int) -> tuple[Array, Array]:
    """Return the factor with `rank` columns.

    A rotation gathers all that is uncertain about the parameters, and the state with them, in the
    first columns: they stay as they are. Of the rest, which is the state's alone, the leading
    directions are kept, measured by `scale`.
    """
    k = len(C)
    rotation, root = np.linalg.qr(C.T, mode="complete")
    rotated = U @ rotation
    alone = rotated[:, k:]
    weighted = scale[:, None] * alone
    _, vectors = np.linalg.eigh(weighted.T @ weighted)
    kept = alone @ vectors[:, ::-1][:, : rank - k]
    square: Array = np.zeros((k, rank))
    square[:, :k] = root[:k].T
    return np.hstack([rotated[:, :k], kept]), square
