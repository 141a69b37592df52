"""Scores of a sample for the ledger, and sensitivities to the causes of misfit.

Let delta be the difference of the truth and the estimate of [u; a] due to a cause of amplitude one,
and f the direct effect of that cause on the readings. A Kalman filter without a model of the cause
has the innovations r = r_0 + theta g with

    g = H delta + f,    delta <- delta - K g,    delta <- S delta between samples

(Friedland 1969; Willsky and Jones 1976). Causes act on sensors or through a response p of the state
that goes on by itself, so that delta = p + [U C]^T w: it starts with w = 0, and predictions move
the rows of [U C] as they move delta. With Y = H [U C]^T and W W^T = (I + Y N^-1 Y^T)^-1, in units
of the noise, an update is

    w <- W^T (w - Y f),    since  [U C] <- W^T [U C]  and  K = [U C]^T W W^T Y N^-1.

Several samples are summed together. `FilterState.causes` holds M, by which updates and predictions
have moved rows since the last sample; each sample that waits keeps its M and Y. Then

    w_k = M_k (w_(k-1) - Y_(k-1) f_(k-1)),    g_k = f_k + Y_k^T w_k.

So w costs no solve: it is exact for a linear filter, whatever moves, and C^T w is the bias of the
estimate of the unknowns for each unit of the cause.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from livepde.linalg import Array, Mask
from livepde.stepping import Moments
from livepde.verdict.directions import JUMP, Dictionary
from livepde.verdict.evidence import causes_of, quiet
from livepde.verdict.ledger import WINDOWS, Ledger, batch_of, blocked, summed
from livepde.verdict.missing_terms import Now, stride

__all__ = ["Judge", "Seen"]

MOST_MEMBERS = 16  # of a bank that are judged; a fleet of more is not
MOST_RECORDED = 400  # numbers in a block of the record of the unknowns
SAME = 1e-12  # relative difference of readings that are the same


@dataclass(frozen=True, eq=False)
class Seen:
    """Prior of a filter at a sample, with the sample; in units of the noise.

    Attributes
    ----------
    C, causes
        Square root of the covariance of the unknowns, (members, r, k), and M, (members, r, rank).
    a, q
        Functions that return the estimated reduced and latent unknowns: not every judge asks.
    u
        The estimated state.
    Y, d, used
        Observed square root, (members, r, sensors), innovations less their shift by the estimated
        discretisation error, and the mask of the values that are used.
    z, predicted, noise
        Readings, their predictions, and the noise, (members or 1, sensors).
    at
        Time and inputs.
    """

    C: Array
    causes: Array
    a: Callable[[], Array]
    q: Callable[[], Array]
    u: Array
    Y: Array
    d: Array
    used: Mask
    z: Array
    predicted: Array
    noise: Array
    at: Moments


class Judge:
    """Keeps the ledger of a filter.

    Parameters
    ----------
    dictionary
        The directions.
    sensors, unknowns, n
        Number of sensors, of reduced unknowns and of coefficients of the state.
    rank
        Rows of the square root at most when samples come.
    still
        Whether all unknowns stay as they are, so that their record can be kept.
    """

    def __init__(
        self, dictionary: Dictionary, sensors: int, unknowns: int, n: int, rank: int, *, still: bool
    ) -> None:
        self.dictionary = dictionary
        self.sensors, self.unknowns, self.n, self.rank = sensors, unknowns, n, rank
        # The record takes (k, k) numbers for each sensor and block, and the scores of unknowns that
        # move cannot be cumulated.
        self.recorded = still and 0 < sensors * unknowns**2 <= MOST_RECORDED
        self.windows = len(WINDOWS)
        self.terms = len(dictionary.process.terms) if dictionary.process else 0
        self._drift = dictionary.parts.get("drift", slice(0, 0))
        self._jump, self._process = dictionary.parts["jump"], dictionary.parts["process"]
        # Sizes of the parts of a row that waits, in their order.
        sizes = {
            "t": 1,
            "used": sensors,
            "d": sensors,
            "noise": sensors,
            "z": sensors,
            "predicted": sensors,
            "Y": rank * sensors,
            "M": rank**2,
            "moved": sensors * (dictionary.shifts.axes if dictionary.shifts else 0),
            "answers": self.terms * sensors,
            "a": unknowns if self.recorded else 0,
            "C": unknowns**2 if self.recorded else 0,
        }
        ends = np.cumsum(list(sizes.values())).tolist()
        self._at = {
            name: slice(end - size, end)
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self.numbers = int(ends[-1])
        self.batch = batch_of(self.numbers)
        self._fresh = np.eye(rank)

    def widened(self, more: int) -> Judge:
        """Return the judge of a filter whose square root has more rows."""
        sizes = self.sensors, self.unknowns, self.n, self.rank + more
        return Judge(self.dictionary, *sizes, still=self.recorded)

    def start(self) -> Ledger:
        """Return the ledger of one member before any sample."""
        followed = self.unknowns if self.recorded else 0
        n = self.n if self.terms else 0
        counts = len(self.dictionary), followed, self.terms, n, self.windows, self.rank
        return Ledger.start(self.sensors, *counts, self.batch, self.numbers)

    def heard(self, ledger: Ledger, seen: Seen) -> tuple[Array, Ledger]:
        """Return M of a sample, the identity before its update, and the ledger."""
        M, full = seen.causes, ledger.waiting == self.batch
        members, r, _ = M.shape
        # A batch is summed when the next sample comes, so that whoever reads the verdict in between
        # sums a copy and changes nothing.
        if full.any() or not ledger.seen.all():
            M, ledger = self._begun(ledger, seen, full)
        each: dict[str, Array | Mask] = {
            "used": seen.used,
            "d": seen.d,
            "noise": seen.noise,
            "z": seen.z,
            "predicted": seen.predicted,
            "Y": seen.Y,
            "M": M,
        }
        parts: dict[str, Any] = {}
        if self.dictionary.shifts is not None:
            each["moved"] = self.dictionary.moved(seen.u)
        # The answers of the process cost a solve for each term and member.
        if self.terms and members <= MOST_MEMBERS:
            parts = self._answered(ledger, seen)
            each["answers"] = _between(parts, seen.at.t)
        if self.recorded and seen.C.shape[1] == self.unknowns:
            each |= {"a": seen.a(), "C": seen.C}
        row = np.zeros((members, self.numbers))
        row[:, 0] = seen.at.t
        for name, part in each.items():  # those of rows that a square root lacks stay zero
            flat = part.reshape(len(part), -1)
            begin = self._at[name].start
            row[:, begin : begin + flat.shape[1]] = flat
        rows = ledger.rows.copy()
        rows[np.arange(members), ledger.waiting] = row
        more = {"seen": ledger.seen + 1, "waiting": ledger.waiting + 1, "rows": rows}
        # The update of this sample multiplies M by W^T, and predictions by what moves the rows of
        # [U C].
        fresh = np.broadcast_to(self._fresh[:r], (members, r, self.rank))
        return fresh, _changed(ledger, more | parts)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # counted as nothing
    def settled(self, ledger: Ledger, causes: Array) -> tuple[Array, Ledger]:
        """Return w and the ledger after all samples that wait are summed.

        Parameters
        ----------
        causes
            M now, (members, r, rank).

        Returns
        -------
        w
            Shape (members, r, windows times directions).
        """
        members, sensors = len(ledger.seen), self.sensors
        at, due = self._at, ledger.due
        there = np.arange(self.batch) < ledger.waiting[:, None]  # (members, batch)
        # Only as many rows as some member has waiting are summed.
        ledger = self._timed(ledger, there)
        batch = max(int(ledger.waiting.max(initial=0)), 1)
        rows, some = ledger.rows[:, :batch], there[:, :batch, None]
        used = rows[:, :, at["used"]] * some
        Y = rows[:, :, at["Y"]].reshape(members, batch, self.rank, sensors)
        own, answers = self._effects(ledger, rows, used, due)
        # T = (1 + Y^T Y)^(-1/2) whitens the innovations of a sample: r = T d, g <- T g.
        Yt, (X, scale) = Y.swapaxes(-1, -2), _whitening(Y)
        before, w = self._followed(ledger, self._through(own, answers, Yt))
        # With T = 1 + X scale X^T all of g T is f and a product of few columns.
        scaled = (self._through(own, answers, X) + (X.swapaxes(-1, -2) @ Yt) @ before) * scale
        g = np.concatenate([Yt, X], axis=-1) @ np.concatenate([before, scaled], axis=-2)
        g = g.reshape(members, batch, sensors, self.windows, -1)
        owner = self.dictionary.own
        g[:, :, owner, :, np.arange(len(owner))] += own.transpose(3, 0, 1, 2)
        g[..., self._process] += answers.swapaxes(-1, -2)[:, :, :, None]
        d = rows[:, :, at["d"]]
        r = d + (X @ (scale * (X.swapaxes(-1, -2) @ d[..., None])))[..., 0]
        # A single wild value must be no evidence for a cause (Huber's loss).
        r = ledger.clipped(r) * some
        if not some.all():
            g *= some[..., None, None]
        # Sums over the samples that waited, in the windows that go on or begin with them.
        names = ("sums", "noise", "before", "present")
        parts: dict[str, Any] = dict(zip(names, summed(ledger, due, r, g, used), strict=True))
        # The record is of raw residuals about the prior mean, d + Y^T a: its scores do not depend
        # on the estimate of the moment, so that blocks of different times may be added.
        if self.recorded:
            Y, told = self._record(rows, Y[:, :, : self.unknowns])
            Y, told = Y * used[:, :, None], told * used
            new = blocked(ledger, ledger.seen - ledger.waiting, Y, told)
            parts |= dict(zip(("score", "information", "length"), new, strict=True))
        waited = ledger.waiting[:, None]
        parts |= self._stuck(ledger, there)
        parts["sound"] = _sounded(ledger, due)
        shown = np.isfinite(rows[:, :, at["z"]]) & some
        refused = shown & ~(used > 0.0)
        parts["shown"] = ledger.shown + np.stack([shown.sum(axis=1), refused.sum(axis=1)], axis=1)
        last = rows[np.arange(members), np.maximum(ledger.waiting - 1, 0)]
        parts |= {
            "waiting": np.zeros_like(ledger.waiting),
            "age": np.where(due, 0, ledger.age) + waited,
            "epoch": ledger.epoch + (due & (ledger.age > 0)),
            "last": np.where(waited > 0, last[:, at["predicted"]], ledger.last),
            "times": np.where(waited > 0, _replaced(ledger.times, last[:, at["t"]]), ledger.times),
        }
        return causes @ w, replace(ledger, **parts)

    def _through(self, own: Array, answers: Array, X: Array) -> Array:
        """Return X^T f of the effects of all directions, (members, batch, k, columns).

        Parameters
        ----------
        own, answers
            As `_effects` returns them.
        X
            Shape (members, batch, sensors, k).
        """
        members, batch, _, k = X.shape
        found = np.zeros((members, batch, k, self.windows, len(self.dictionary)))
        Xt, owner = X.swapaxes(-1, -2), self.dictionary.own
        found[..., : len(owner)] = Xt[:, :, :, None, owner] * own[:, :, None]
        found[..., self._process] = (Xt @ answers.swapaxes(-1, -2))[:, :, :, None]
        return found.reshape(members, batch, k, -1)

    def _followed(self, ledger: Ledger, effect: Array) -> tuple[Array, Array]:
        """Return w before the update of each sample that waits, and w - Y f of the last one.

        Shapes (members, batch, rank, columns) and (members, rank, columns). Where none is there w
        stays.
        """
        members, batch, rank, _ = effect.shape
        M = ledger.rows[:, :batch, self._at["M"]].reshape(members, batch, rank, rank)
        before, w = np.zeros_like(effect), ledger.w
        for k in range(batch):
            before[:, k] = M[:, k] @ w
            w = np.where((ledger.waiting > k)[:, None, None], before[:, k] - effect[:, k], w)
        return before, w

    def _record(self, rows: Array, Y: Array) -> tuple[Array, Array]:
        """Return sensitivities to the unknowns, and residuals at the prior mean, of the record.

        Shapes (members, batch, k, sensors) and (members, batch, sensors).
        """
        members, batch, _ = rows.shape
        k, at = self.unknowns, self._at
        Y = _sensitivity(rows[:, :, at["C"]].reshape(members, batch, k, k), Y)
        told: Array = rows[:, :, at["d"]] + (rows[:, :, None, at["a"]] @ Y)[:, :, 0]
        return Y, told

    @staticmethod
    def _unit(ledger: Ledger, k: int, t: float) -> float:
        """Return the usual interval of a member, or the time since its first sample."""
        known = float(ledger.times[k, 1])
        since = t - float(ledger.rows[k, 0, 0])
        return known if np.isfinite(known) else since if since > 0.0 else 1.0

    def _timed(self, ledger: Ledger, there: Mask) -> Ledger:
        """Return the ledger with the usual interval, and the first predictions."""
        times = np.concatenate([ledger.times[:, :1], ledger.rows[:, :, 0]], axis=1)
        steps = np.where(there, np.diff(times, axis=1), np.nan)
        unit = ledger.times[:, 1]
        for step in steps.T:
            unit = np.where(np.isfinite(unit), unit, step)
        predicted = ledger.rows[:, 0, self._at["predicted"]]
        first = np.where(np.isfinite(ledger.first), ledger.first, predicted)
        times = np.stack([ledger.times[:, 0], unit], axis=1)
        return replace(ledger, times=times, first=first)

    def _stuck(self, ledger: Ledger, there: Mask) -> dict[str, Any]:
        """Return how often in a row sensors have shown the same value, and that value."""
        values = np.where(there[:, :, None], ledger.rows[:, :, self._at["z"]], np.nan)
        z = np.concatenate([ledger.value[:, None], values], axis=1)
        order, seen = np.arange(self.batch + 1)[:, None], np.isfinite(z)
        latest = np.maximum.accumulate(np.where(seen, order, 0), axis=1)
        value = np.take_along_axis(z, latest, axis=1)  # the last one that was shown
        same = np.abs(z[:, 1:] - value[:, :-1]) <= SAME * np.abs(z[:, 1:])
        changes = np.where(seen[:, 1:] & ~same, order[1:], 0).max(axis=1)
        since = (seen[:, 1:] & (order[1:] > changes[:, None])).sum(axis=1)
        stuck = np.where(changes > 0, 0, ledger.stuck) + since
        return {"stuck": stuck, "value": value[:, -1]}

    def _begun(self, ledger: Ledger, seen: Seen, full: Mask) -> tuple[Array, Ledger]:
        """Return M and the ledger of members whose batch is full, or the first one."""
        begins = full | (ledger.seen == 0)
        members, r, _ = seen.causes.shape
        w = np.zeros((members, r, ledger.w.shape[2]))
        if full.any():
            found, settled = self.settled(ledger, seen.causes)
            w[full] = found[full]
            ledger = settled if full.all() else _where(full, settled, ledger)
        w = self._opened(ledger, seen, ledger.due & begins[:, None], w)
        kept = np.zeros_like(ledger.w)
        kept[:, :r] = w[:, : self.rank]
        chosen = begins[:, None, None]
        M = np.where(chosen, self._fresh[:r], seen.causes)
        return M, replace(ledger, w=np.where(chosen, kept, ledger.w))

    def _opened(self, ledger: Ledger, seen: Seen, due: Mask, w: Array) -> Array:
        """Return w with that of windows that begin: nothing but jumps of the unknowns."""
        count = len(self.dictionary)
        if not due.any() or not count:
            return w
        members, r, _ = w.shape
        # Directions of a new window have not moved the estimate yet: w = 0 ...
        w = w.reshape(members, r, self.windows, count)
        w.transpose(0, 2, 1, 3)[due] = 0.0
        jumps = self.dictionary.jumps
        if jumps and ledger.seen.any():
            # ... but a jump of an unknown is a shift C^T w = e of the estimate from the beginning.
            units = JUMP * np.eye(seen.C.shape[2])[:, jumps]
            for k in np.flatnonzero(due[:, 1:].any(axis=1)).tolist():
                moved = np.linalg.lstsq(seen.C[k].T, units, rcond=None)[0]
                for window in (1 + np.flatnonzero(due[k, 1:])).tolist():
                    w[k, :, window, self._jump] = moved
        return w.reshape(members, r, -1)

    def _effects(self, ledger: Ledger, rows: Array, used: Array, due: Mask) -> tuple[Array, Array]:
        """Return f of the samples that wait: of directions of sensors, and of terms of the process.

        Shapes (members, batch, windows, directions of sensors) and (members, batch, terms,
        sensors).
        """
        at = self._at
        members, batch, _ = rows.shape
        t, h = rows[:, :, 0], rows[:, :, at["predicted"]]
        before = np.concatenate([ledger.times[:, :1], t[:, :-1]], axis=1)
        # A sensor that is late by a sample shows the prediction of the sample before it.
        last = np.concatenate([ledger.last[:, None], h[:, :-1]], axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = ledger.times[:, 1:] / (t - before)
        first = np.broadcast_to(ledger.first[:, None], h.shape)
        noise = rows[:, :, at["noise"]]
        noise = np.where(noise > 0.0, noise, 1.0)  # rows that are not filled yet
        noise, h, first, last, moved = (
            part.reshape(members * batch, -1)
            for part in (noise, h, first, last, rows[:, :, at["moved"]])
        )
        f = self.dictionary.signals(noise, h, first, last, share.ravel(), moved)
        f = f.reshape(members, batch, -1) * used[:, :, self.dictionary.own]
        own = np.repeat(np.where(np.isfinite(f), f, 0.0)[:, :, None], self.windows, axis=2)
        if self._drift.stop > self._drift.start:
            # A drift begins with its window and grows by one unit with each sample.
            age = np.where(due, 0, ledger.age)[:, None] + np.arange(batch)[:, None]
            own[..., self._drift] *= age[..., None]
        answers = rows[:, :, at["answers"]].reshape(members, batch, self.terms, self.sensors)
        answers = answers * (used / noise.reshape(members, batch, -1))[:, :, None]
        return own, np.where(np.isfinite(answers), answers, 0.0)

    def _answered(self, ledger: Ledger, seen: Seen) -> dict[str, Any]:
        """Return responses of the process that reach this sample at least."""
        process, t = self.dictionary.process, seen.at.t
        # One step of the process answers for several samples, which interpolate between its ends.
        behind = ~(ledger.reached[:, 1] >= t)
        if process is None or not behind.any():
            return {"readings": ledger.readings, "reached": ledger.reached}
        p, readings = ledger.process.copy(), ledger.readings.copy()
        reached, q = ledger.reached.copy(), seen.q()
        for k in np.flatnonzero(behind).tolist():
            # Without a better guess, what the sensors showed first is where nothing is lost.
            rest = float(np.nanmean(ledger.first[k])) if np.isfinite(ledger.first[k]).any() else 0.0
            now = Now(seen.u[k], q[k], seen.at.member(k), self._unit(ledger, k, t), rest)
            if not np.isfinite(reached[k, 1]):
                p[k] = process.begun()
                readings[k] = process.shown(p[k], now)
                reached[k] = t
                continue
            begin, steps = float(reached[k, 1]), stride(int(ledger.seen[k]))
            unit = self._unit(ledger, k, t)
            h = max(steps * unit, t - begin)
            p[k] = process.advance(p[k], now, h)
            readings[k, 0] = readings[k, 1]
            readings[k, 1] = process.shown(p[k], now)
            reached[k] = begin, begin + h
        return {"process": p, "readings": readings, "reached": reached}


def _sounded(ledger: Ledger, due: Mask) -> Mask:
    """Return whether nothing spoke against the model in the longest window that ended last."""
    ends = due[:, -1] & (ledger.age[:, -1] > 0)
    if not ends.any():
        return ledger.sound
    sound = ledger.sound.copy()
    for k in np.flatnonzero(ends).tolist():
        sound[k] = quiet(ledger, k, causes_of(ledger, k).log_e)
    return sound


def _between(parts: dict[str, Any], t: float) -> Array:
    """Return the answers of the process at a time, (members, terms, sensors)."""
    found = []
    for (begin, end), (low, high) in zip(parts["reached"].tolist(), parts["readings"], strict=True):
        along = (t - begin) / (end - begin) if end > begin else 0.0
        found.append(low + min(max(along, 0.0), 1.0) * (high - low))
    return np.stack(found) if len(found) > 1 else found[0][None]


def _whitening(Y: Array) -> tuple[Array, Array]:
    """Return X and scale with (1 + Y^T Y)^(-1/2) = 1 + X scale X^T, for Y (..., rank, sensors).

    From the smaller one of Y Y^T = V L V^T, with X = Y^T V, and Y^T Y = X L X^T. Shapes (...,
    sensors, k) and (..., k, 1).
    """
    rank, sensors = Y.shape[-2:]
    Y = np.where(np.isfinite(Y).all(axis=(-2, -1), keepdims=True), Y, 0.0)
    small = rank < sensors
    Yt = Y.swapaxes(-1, -2)
    values, axes = np.linalg.eigh(Y @ Yt if small else Yt @ Y)
    values = np.maximum(values, 0.0)
    scale = 1.0 / np.sqrt(1.0 + values) - 1.0
    # X = Y^T V scaled by L^(-1): a product with the axes of the small matrix Y Y^T.
    if small:
        scale /= np.where(values > 0.0, values, 1.0)
        axes = Yt @ axes
    return axes, scale[..., None]


def _replaced(times: Array, last: Array) -> Array:
    """Return the time of the last sample and the usual interval."""
    return np.concatenate([last, times[:, 1:]], axis=1)


def _changed(ledger: Ledger, parts: dict[str, Any]) -> Ledger:
    """Return a ledger with some fields exchanged: `replace` in a tenth of its time."""
    new: Ledger = object.__new__(Ledger)
    new.__dict__.update(ledger.__dict__)
    new.__dict__.update(parts)
    return new


def _where(chosen: Mask, one: Ledger, other: Ledger) -> Ledger:
    """Return a ledger whose chosen members are of one, the rest of another."""

    def either(name: str) -> Any:
        first, second = getattr(one, name), getattr(other, name)
        return np.where(chosen.reshape(-1, *(1,) * (first.ndim - 1)), first, second)

    return Ledger(**{item.name: either(item.name) for item in fields(Ledger)})


def _sensitivity(C: Array, Y: Array) -> Array:
    """Return how readings change with the unknowns, (..., k, sensors); zero where not known."""
    known = np.isfinite(C).all(axis=(-2, -1)) & (np.abs(np.linalg.det(C)) > 0.0)
    one = np.eye(C.shape[-1])
    safe = np.where(known[..., None, None], C, one)
    return np.asarray(np.where(known[..., None, None], np.linalg.solve(safe, Y), 0.0))
