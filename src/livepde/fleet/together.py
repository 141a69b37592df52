"""The sensitivity law for all members at once: as long as nothing out of the ordinary happens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from livepde.fem import Moment
from livepde.fleet import innovations
from livepde.fleet.engine import OK, Beliefs, Factors, FleetReport
from livepde.fleet.span import Span
from livepde.fleet.stack import Stack
from livepde.fleet.stage import AffineStage, Moments
from livepde.laws import Belief, SensitivityLaw
from livepde.laws.filter import Filter, Point
from livepde.laws.guards import Scale
from livepde.laws.level import LEARN
from livepde.laws.level import WINDOW as LEVEL_WINDOW
from livepde.laws.past import Past, Samples
from livepde.laws.sensitivity import SensitivityState
from livepde.linalg import Array, BlockFactor, Mask
from livepde.observation import Observed
from livepde.stepping import Interval, advance

__all__ = ["Pasts", "Together", "TogetherState"]


@dataclass(frozen=True, eq=False)
class Pasts:
    """The `Past` of each member: samples in buffers of which the first `rows` are in use.

    Attributes
    ----------
    older, newer
        Filters of before.
    t, z, inputs
        Shapes (members, rows), (members, rows, sensors) and (members, rows, channels).
    rows, between
        Rows in use, and samples between the two filters, shape (members,).
    """

    older: Stack
    newer: Stack
    t: Array
    z: Array
    inputs: Array
    rows: Array
    between: Array

    @classmethod
    def start(cls, now: Stack, length: int, sensors: int, channels: int) -> Pasts:
        """Return pasts that begin now, for older filters of `length` samples ago at least."""
        members, rows = len(now["age"]), 2 * length + 1
        t, none = np.zeros((members, rows)), np.zeros(members, dtype=int)
        z = np.zeros((members, rows, sensors))
        return cls(now, now, t, z, np.zeros((members, rows, channels)), none, none)

    def member(self, k: int) -> Past:
        """Return the past of one member."""
        rows = slice(int(self.rows[k]))
        samples = Samples(self.t[k, rows], self.z[k, rows], self.inputs[k, rows])
        return Past(self.older.member(k), self.newer.member(k), int(self.between[k]), samples)

    def put(self, pasts: Mapping[int, Past]) -> Pasts:
        """Return the pasts with those of some members exchanged."""
        if not pasts:
            return self
        new = self._copied()
        for k, past in pasts.items():
            samples, rows = past.samples, len(past.samples.t)
            new.rows[k], new.between[k] = rows, past.between
            new.t[k, :rows], new.z[k, :rows] = samples.t, samples.z
            new.inputs[k, :rows] = samples.inputs
        older = self.older.put({k: past.older for k, past in pasts.items()})
        newer = self.newer.put({k: past.newer for k, past in pasts.items()})
        return replace(new, older=older, newer=newer)

    def _copied(self) -> Pasts:
        buffers = self.t, self.z, self.inputs, self.rows, self.between
        return Pasts(self.older, self.newer, *(buffer.copy() for buffer in buffers))

    def add(self, now: Stack, span: Span, length: int) -> Pasts:
        """Return the pasts after a sample, as `Past.add` does."""
        new = self._copied()
        empty = np.flatnonzero(new.rows == 0)  # the first sample brings the start
        channels = new.inputs.shape[2]
        new.t[empty, 0], new.z[empty, 0] = span.t0[empty], np.nan
        new.inputs[empty, 0] = span.inputs0[empty, :channels]
        new.rows[empty] = 1
        each = np.arange(len(span))
        new.t[each, new.rows], new.z[each, new.rows] = span.t1, span.z1
        new.inputs[each, new.rows] = span.inputs1[:, :channels]
        new.rows[:] += 1
        due = new.rows - 1 - new.between >= length
        if not due.any():
            return new
        for first in np.unique(new.between[due]):
            which = np.flatnonzero(due & (new.between == first))
            for buffer in (new.t, new.z, new.inputs):
                buffer[which, : buffer.shape[1] - first] = buffer[which, first:]
            new.z[which, 0] = np.nan
        new.rows[due] -= new.between[due]
        new.between[due] = new.rows[due] - 1
        return replace(
            new, older=self.newer.where(due, self.older), newer=now.where(due, self.newer)
        )


@dataclass(frozen=True, eq=False)
class TogetherState:
    """`SensitivityState` of all members, without what belongs to replays and jumps.

    Attributes
    ----------
    now
        The filter of each member.
    pasts, scales
        For `Guards`.
    """

    now: Stack
    pasts: Pasts
    scales: Stack


class Together:
    """Steps members of one affine model with banded matrices by `SensitivityLaw`, as blocks.

    What is out of the ordinary, a member that is late, moved far by a sample, or whose step fails,
    is left to the law itself, member by member: so its rules stand in one place.
    """

    def __init__(self, law: SensitivityLaw, work: Filter) -> None:
        self.law = law
        self.work = work
        self.model = work.problem.model
        self.stage = AffineStage(self.model)
        observed = work.problem.observed
        self._G = observed.G.toarray()
        state = law.init(work, self.model.latent.prior, np.zeros(self.model.X.dim))
        self._template = state
        self._length = law.guards.past if law.guards is not None else 0

    @staticmethod
    def refuses(law: Any, work: Any) -> str:
        """Return why members have to be stepped separately, empty if they need not."""
        if type(law) is not SensitivityLaw:  # a subclass may step in a way of its own
            return f"{type(law).__name__} steps one at a time"
        if law.replay is not None or law.jumps is not None:
            return "replays and the test for jumps go back, each member to a time of its own"
        if work.problem.model.parameter_space.fields:
            return "an unknown is a field"
        observed = work.problem.observed
        if type(observed) is not Observed or not observed.linear or observed.observation.inputs:
            return "the sensors do not see a fixed linear part of the state alone"
        return AffineStage.refuses(work.problem.model) or AffineStage(work.problem.model).refusal

    def start(
        self, q0: Sequence[Array], u0: Sequence[Array], moments: Sequence[Moment]
    ) -> TogetherState:
        states = [
            self.law.start(self.work, q, u, moment)
            for q, u, moment in zip(q0, u0, moments, strict=True)
        ]
        now = Stack.of([self._filled(state.now) for state in states])
        problem = self.work.problem
        sizes = self._length, problem.observed.size, len(problem.channels)
        scales = Stack.of([state.scale for state in states])
        return TogetherState(now, Pasts.start(now, *sizes), scales)

    def member(self, state: TogetherState, k: int) -> SensitivityState:
        """Return the state of a member as the law itself has it."""
        now, empty = state.now.member(k), self._template.samples
        return replace(
            self._template,
            now=now,
            start=now,
            samples=empty,
            reference=now.q,
            past=state.pasts.member(k),
            scale=state.scales.member(k),
        )

    def _put(self, state: TogetherState, alone: Mapping[int, SensitivityState]) -> TogetherState:
        pasts = {
            k: replace(past, older=self._filled(past.older), newer=self._filled(past.newer))
            for k, past in ((k, one.past) for k, one in alone.items())
        }
        return TogetherState(
            state.now.put({k: self._filled(one.now) for k, one in alone.items()}),
            state.pasts.put(pasts),
            state.scales.put({k: one.scale for k, one in alone.items()}),
        )

    def _filled(self, point: Point) -> Point:
        """Return a filter whose factor has all columns it may ever have: more of zeros."""
        more = ((0, 0), (0, self.work.rank - point.C.shape[1]))
        return replace(point, U=np.pad(point.U, more), C=np.pad(point.C, more))

    def begin(self, state: TogetherState, span: Span) -> TogetherState:
        begun = {}
        initial = self.model.form_initial is not None
        for k in range(len(span)):
            member = replace(self.member(state, k), initial=initial)
            begun[k] = self.law.begin(self.work, member, span.member(k))
        return self._put(state, begun)

    def step(self, state: TogetherState, span: Span) -> tuple[TogetherState, FleetReport]:
        new, report, able = self._ordinary(state, span, span.together)
        alone, reports = {}, {}
        for k in np.flatnonzero(~able).tolist():
            member = self.member(state, k)
            alone[k], reports[k] = self.law.step(self.work, member, span.member(k))
        return self._put(new, alone), report.with_members(reports)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # such members step alone
    def _ordinary(
        self, state: TogetherState, span: Span, able: Mask
    ) -> tuple[TogetherState, FleetReport, Mask]:
        """Return state and report after a sample, and for which members they hold."""
        guards, law = self.law.guards, self.law
        before = state.now
        t0 = float(span.t0[able][0])
        moved, steps = self._advanced(before, replace(span, t0=np.full(len(span), t0)), t0)
        if np.isfinite(law.memory):
            moved = moved.changed({"U": np.exp(-(span.t1 - t0) / law.memory) * moved["U"]})
        u, U = moved["u"], moved["U"]
        predicted = (u + moved["du"]) @ self._G.T
        now, refused = self._updated(moved, span.z1, predicted)
        able = able & np.isfinite(U).all(axis=(1, 2)) & np.isfinite(now["da"]).all(axis=1)
        able = able & np.isfinite(u).all(axis=1) & np.isfinite(moved["du"]).all(axis=1)
        if guards is not None:
            able &= ~(np.abs(now["da"] - before["da"]).max(axis=1) > guards.reach)
        now = self._recentred(now)
        scales, pasts = state.scales, state.pasts
        if guards is not None:
            d = span.z1 - predicted
            scales = self._scaled(state.scales, span.z1, d)
            noise = np.sqrt(before["level.square"])[:, None] * self.work.noise
            able &= ~(_beyond(scales, d, noise) > guards.runaway)
        now = now.where(able, before)
        if guards is not None:
            scales = scales.where(able, state.scales)
            pasts = state.pasts.add(now, span, self._length)
            pasts = pasts.put({k: state.pasts.member(k) for k in np.flatnonzero(~able).tolist()})
        told = _consistency(now)
        notes = {
            "innovation_ratio": innovations.ratio(told),
            "innovation_correlation": innovations.correlation(told),
        }
        if law.noise == "auto":
            notes["noise_level"] = np.sqrt(now["level.square"])
        if np.isfinite(law.gate):
            notes["refused"] = refused.astype(float)
        report = FleetReport((OK,) * len(span), predicted, np.full(len(span), steps), notes)
        return TogetherState(now, pasts, scales), report, able

    def _advanced(self, now: Stack, span: Span, t0: float) -> tuple[Stack, int]:
        """Return the filters at the end of the span, and substeps."""
        none = np.zeros(0)
        whole, control = Interval(t0, span.t1, {}, {}, none, none), self.work.problem.control
        # What unknowns gain in one substep is independent of what they gain in the next.
        count = control.count(whole) if self.work.moves else 1
        inner = (t0 + k / count * (span.t1 - t0) for k in range(1, count))
        steps = 0
        for start, stop in pairwise([t0, *inner, span.t1]):
            now, taken = self._carried(now, span, Interval(start, stop, {}, {}, none, none))
            steps += taken
        return now, steps

    def _carried(self, now: Stack, span: Span, part: Interval) -> tuple[Stack, int]:
        """Return the filters at the end of a part of the span, and substeps."""
        end, channels = self._moved(now, part.t1 - part.t0), len(self.stage.channels)
        at_end = self._directions(end)
        factors: dict[tuple[float, float], BlockFactor] = {}

        def stage(columns: Array, t: float, h: float) -> Array:
            (q, slopes), key = at_end, (part.t1, h)
            if self.work.moves and t != part.t1:
                q, slopes = self._directions(self._moved(now, t - part.t0))
                key = (t, h)
            if key not in factors:
                factors[key] = self.stage.factor(q, h)
            at = Moments(t, span.at(t)[:, :channels])
            return self.stage.solve(columns, q, slopes, factors[key], at, h)

        last = [end["du"][None]] if _off_centre(end) else []
        columns = np.concatenate([end["u"][None], end["U"].transpose(2, 0, 1), *last])
        columns, steps, _ = advance(self.work.problem.control, stage, columns, part)
        C, du = end["C"], columns[-1] if last else end["du"]
        U = columns[1 : 1 + C.shape[2]].transpose(1, 2, 0)
        if C.shape[2] > self.work.rank:
            U, C = _compressed(U, C, self.work.scale, self.work.rank)
        return end.changed({"u": columns[0], "U": U, "C": C, "du": du}), steps

    def _directions(self, now: Stack) -> tuple[Array, Array]:
        """Return q, (members, m), and how it changes along the columns, (members, m, r).

        The last column is the deviation of the estimate, if there is one.
        """
        a, C = now["q"].T, now["C"]
        if _off_centre(now):
            C = np.concatenate([C, now["da"][:, :, None]], axis=2)
        return self.model.latent.value(a).T, self._tangent(a, self.work.Phi @ C)

    def _moved(self, now: Stack, h: float) -> Stack:
        """Return filters whose unknowns have moved for a time h, as `Filter.moved` does."""
        work, C = self.work, now["C"]
        if not work.moves:
            return now
        variance = (C**2).sum(axis=2)
        shape = variance.shape
        gained = np.concatenate(
            [
                np.broadcast_to(m.gained(h, variance), (shape[0], m.part.stop - m.part.start))
                for m in work.motions
            ],
            axis=1,
        )
        grows = np.flatnonzero((gained > 0.0).any(axis=0))
        new = np.zeros((*shape, len(grows)))
        new[:, grows, np.arange(len(grows))] = np.sqrt(gained[:, grows])
        latent, q, U = self.model.latent, now["q"], now["U"]
        if latent.generator.nnz:
            units = latent.prior + np.eye(latent.dim)
            T = np.array([latent.moved(unit, h) - latent.prior for unit in units])
            q = latent.prior + (q - latent.prior) @ T
        return now.changed(
            {
                "q": q,
                "da": now["da"] @ work.transition(h).T,
                "U": np.concatenate([U, np.zeros((*U.shape[:2], len(grows)))], axis=2),
                "C": np.concatenate([work.transition(h) @ C, new], axis=2),
                "age": now["age"] + h,
            }
        )

    def _tangent(self, a: Array, directions: Array) -> Array:
        """Return dq/da applied to columns of each member, (members, dim, r): (members, m, r)."""
        latent = self.model.latent
        if latent.plain:
            return directions
        scaled = latent.slopes(a).T[:, :, None] * directions
        members, dim, r = scaled.shape
        product = latent.V @ scaled.transpose(1, 0, 2).reshape(dim, members * r)
        tangent: Array = product.reshape(-1, members, r).transpose(1, 0, 2)
        return tangent

    def _updated(self, now: Stack, z: Array, predicted: Array) -> tuple[Stack, Array]:
        """Return the filters after the sample, and how many values the gate refused of each."""
        work = self.work
        d = z - predicted
        present: Mask = np.asarray(np.isfinite(d))
        used = present
        noise = np.sqrt(now["level.square"])[:, None] * work.noise
        Y = (self._G @ now["U"]) / noise[:, :, None]
        e = d / (noise * np.sqrt(1.0 + (Y**2).sum(axis=2)))
        leaves: dict[str, Array] = {}
        if np.isfinite(work.gate):
            far = present & ~(np.abs(e) <= work.gate)
            held = now["refused"]
            refused = np.where(far, held + 1, np.where(present, 0, held))
            used = present & ~(far & (refused <= work.patience))
            leaves["refused"] = refused
            e = np.where(used, e, np.nan)
        some = np.asarray(present.any(axis=1))
        told = _consistency(now)
        for name, value in innovations.added(told, e).items():
            mask = some[:, None] if value.ndim == 2 else some
            leaves[f"consistency.{name}"] = np.where(mask, value, told[name])
        # A row of zeros tells nothing: what is missing takes part as such.
        Y = np.where(used[:, :, None], Y, 0.0)
        d = np.where(used, d / noise, 0.0)
        members, _, r = Y.shape
        unit = np.broadcast_to(np.eye(r), (members, r, r))
        root: Array = np.asarray(np.linalg.qr(np.concatenate([unit, Y], axis=1), mode="r"))
        W = _inverse(root)
        half = (W.transpose(0, 2, 1) @ (Y.transpose(0, 2, 1) @ d[:, :, None]))[:, :, 0]
        U, C = now["U"] @ W, now["C"] @ W
        spread = np.log(np.abs(np.diagonal(root, axis1=1, axis2=2))).sum(axis=1)
        spread = spread + np.where(used, np.log(noise), 0.0).sum(axis=1)
        leaves["evidence"] = (
            now["evidence"] - 0.5 * ((d * d).sum(axis=1) - (half * half).sum(axis=1)) - spread
        )
        leaves |= {"U": U, "C": C}
        leaves["da"] = now["da"] + (C @ half[:, :, None])[:, :, 0]
        leaves["du"] = now["du"] + (U @ half[:, :, None])[:, :, 0]
        if work.adaptive:
            seen, count = Y @ W, np.maximum(used.sum(axis=1), 1)
            missed = d - (seen @ half[:, :, None])[:, :, 0]
            left = ((missed**2).sum(axis=1) + (seen**2).sum(axis=(1, 2))) / count
            known, any_used = now["level.count"], used.any(axis=1)
            more = np.minimum(known + LEARN, LEVEL_WINDOW)
            square = now["level.square"]
            leaves["level.count"] = np.where(any_used, more, known)
            leaves["level.square"] = np.where(
                any_used, square * (1.0 + (left - 1.0) / more), square
            )
        return now.changed(leaves), present.sum(axis=1) - used.sum(axis=1)

    def _recentred(self, now: Stack) -> Stack:
        """Return the filters with references at the estimates within the bounds.

        What lies beyond stays in da and du, as in `Filter.recentred`.
        """
        Phi, q = self.work.Phi, now["q"]
        estimate = q + now["da"] @ Phi.T
        within = self.work.bounded(estimate)
        beyond = (within != estimate).any(axis=1)
        da, du = np.zeros_like(now["da"]), np.zeros_like(now["du"])
        if beyond.any():
            shift = (self.model.Q.gram @ (within[beyond] - q[beyond]).T).T @ Phi
            left = now["da"][beyond] - shift
            C = now["C"][beyond]
            good = np.isfinite(C).all(axis=(1, 2))
            C[~good] = 0.0  # those step alone
            weights = np.linalg.pinv(C, rcond=np.finfo(float).eps * max(C.shape[1:]))
            along = now["U"][beyond] @ (weights @ left[:, :, None])
            da[beyond], du[beyond] = left, along[:, :, 0]
            estimate[beyond] = q[beyond] + shift @ Phi.T
        return now.changed({"q": estimate, "u": now["u"] + now["du"] - du, "du": du, "da": da})

    @staticmethod
    def _scaled(scales: Stack, z: Array, d: Array) -> Stack:
        """Return the scales after a sample: `Scale.add` knows no members."""
        new = Scale(scales["low"], scales["high"], scales["first"]).add(z, d)
        return scales.changed({"low": new.low, "high": new.high, "first": new.first})

    def believed(self, state: TogetherState, k: int) -> Belief:
        return self.law.belief(self.work, self.member(state, k))

    def beliefs(self, state: TogetherState) -> Beliefs:
        now, latent, Phi = state.now, self.model.latent, self.work.Phi
        a = now["q"] + now["da"] @ Phi.T
        a = np.clip(a, *latent.bounds)
        factor = self._tangent(a.T, Phi @ now["C"])
        prior = self._tangent(a.T, np.broadcast_to(Phi, (len(a), *Phi.shape)))
        spread = innovations.inflation(_consistency(now))
        std = spread[:, None] * np.sqrt((factor**2).sum(axis=2))
        q = latent.value(a.T).T
        return Beliefs(q, now["u"] + now["du"], std, Factors(factor, now["U"], prior, spread))

    def leaves(self, state: TogetherState) -> dict[str, Any]:
        pasts = state.pasts
        stacks = {"now": state.now, "scale": state.scales}
        stacks |= {"older": pasts.older, "newer": pasts.newer}
        found: dict[str, Any] = {
            f"{name}:{path}": leaf
            for name, stack in stacks.items()
            for path, leaf in stack.leaves.items()
        }
        buffers = ("t", "z", "inputs", "rows", "between")
        return found | {f"past:{name}": getattr(pasts, name) for name in buffers}

    def restored(self, template: TogetherState, leaves: Mapping[str, Array]) -> TogetherState:
        for path, leaf in self.leaves(template).items():
            if leaves[path].shape != leaf.shape:
                raise ValueError(f"{path} has shape {leaves[path].shape}, needs {leaf.shape}")

        def stack(name: str, like: Stack) -> Stack:
            return like.changed({path: leaves[f"{name}:{path}"] for path in like.leaves})

        pasts = template.pasts
        buffers = {name: leaves[f"past:{name}"] for name in ("t", "z", "inputs", "rows", "between")}
        pasts = replace(
            pasts, older=stack("older", pasts.older), newer=stack("newer", pasts.newer), **buffers
        )
        return TogetherState(stack("now", template.now), pasts, stack("scale", template.scales))


def _off_centre(now: Stack) -> bool:
    """Return whether the estimate of any member is not its reference."""
    return bool(now["da"].any() or now["du"].any())


def _consistency(now: Stack) -> dict[str, Array]:
    """Return the leaves of the statistics of the innovations."""
    head = "consistency."
    return {
        path.removeprefix(head): leaf for path, leaf in now.leaves.items() if path.startswith(head)
    }


def _beyond(scales: Stack, d: Array, noise: Array) -> Array:
    """Return `Scale.beyond` of each member."""
    ranges = np.maximum(scales["high"] - scales["low"], scales["first"])
    largest = np.maximum(ranges, noise) / noise
    seen = ~np.isnan(largest)
    missed = np.where(seen & ~np.isnan(d), np.abs(d / noise), -np.inf).max(axis=1)
    size = np.where(seen, largest, -np.inf).max(axis=1)
    return np.where(np.isneginf(missed), 0.0, missed / size)


def _inverse(root: Array) -> Array:
    """Return the inverse of each upper triangle; NaN where there is none."""
    good = np.isfinite(root).all(axis=(1, 2))
    if good.all():
        return np.asarray(np.linalg.inv(root), dtype=float)
    inverse = np.full_like(root, np.nan)
    inverse[good] = np.linalg.inv(root[good])
    return inverse


def _compressed(U: Array, C: Array, scale: Array, rank: int) -> tuple[Array, Array]:
    """Return the factors with `rank` columns, as `livepde.laws.filter` compresses one."""
    members, k, _ = C.shape
    rotation, root = np.linalg.qr(C.transpose(0, 2, 1), mode="complete")
    rotated = U @ rotation
    alone = rotated[:, :, k:]
    weighted = scale[:, None] * alone
    square = weighted.transpose(0, 2, 1) @ weighted
    square[~np.isfinite(square).all(axis=(1, 2))] = 0.0  # those step alone
    _, vectors = np.linalg.eigh(square)
    kept = alone @ vectors[:, :, ::-1][:, :, : rank - k]
    small = np.zeros((members, k, rank))
    small[:, :, :k] = root[:, :k].transpose(0, 2, 1)
    return np.concatenate([rotated[:, :, :k], kept], axis=2), small
