"""What a filter tells the ledger with each sample, and how the causes ride along with it.

Let delta be by how much the truth and the estimate of [u; a] differ because of a cause of amplitude
one, and f what that cause does to the readings directly. A Kalman filter that does not know of it
has the innovations r = r_0 + theta g with

    g = H delta + f,    delta <- delta - K g,    delta <- S delta between samples

(Friedland 1969; Willsky and Jones 1976). Causes act on sensors or through a response p of the state
that goes on by itself, so that delta = p + [U C]^T w: it starts with w = 0, and predictions move
the rows of [U C] as they move delta. With Y = H [U C]^T and W W^T = (I + Y N^-1 Y^T)^-1, in units
of the noise, an update is

    w <- W^T (w - Y f),    since  [U C] <- W^T [U C]  and  K = [U C]^T W W^T Y N^-1.

So w costs no solve: it is exact for a linear filter, whatever moves, and C^T w says by how much the
estimate of the unknowns is off for each unit of the cause.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from livepde.linalg import Array, Mask
from livepde.stepping import Moments
from livepde.verdict.directions import JUMP, Dictionary
from livepde.verdict.ledger import WINDOWS, Ledger, blocked, summed
from livepde.verdict.process import Now, Process, stride

__all__ = ["Judge", "Seen"]

MOST_WHITENED = 64  # sensors whose innovations are whitened together
MOST_MEMBERS = 16  # of a bank that are judged; a fleet of more is not
MOST_RECORDED = 400  # numbers in a block of the record of the unknowns
SAME = 1e-12  # relative difference of readings that are the same


@dataclass(frozen=True, eq=False)
class Seen:
    """What a filter knows when a sample comes, before it uses it; in units of the noise.

    Attributes
    ----------
    C, causes
        Square root of the covariance of the unknowns, (members, r, k), and w of all directions in
        all windows, (members, r, windows times directions).
    a, q, u
        Reduced and latent unknowns and the state, as they are estimated.
    Y, d, used
        Observed square root, (members, r, sensors), innovations and which values are used.
    z, predicted, noise
        Readings, what was expected of them, and the noise, (members or 1, sensors).
    at
        Time and inputs.
    """

    C: Array
    causes: Array
    a: Array
    q: Array
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
    still
        Whether all unknowns stay as they are, so that their record can be kept.
    """

    def __init__(
        self, dictionary: Dictionary, sensors: int, unknowns: int, n: int, *, still: bool
    ) -> None:
        self.dictionary = dictionary
        self.sensors, self.unknowns, self.n = sensors, unknowns, n
        self.recorded = still and 0 < sensors * unknowns**2 <= MOST_RECORDED
        self.windows = len(WINDOWS)
        self._drift = dictionary.parts.get("drift", slice(0, 0))
        self._jump, self._process = dictionary.parts["jump"], dictionary.parts["process"]

    def start(self) -> Ledger:
        """Return the ledger of one member before any sample."""
        terms = len(self.dictionary.process.terms) if self.dictionary.process else 0
        followed = self.unknowns if self.recorded else 0
        counts = len(self.dictionary), followed, terms, self.n if terms else 0
        return Ledger.start(self.sensors, *counts, self.windows)

    @property
    def columns(self) -> int:
        """Number of columns of w."""
        return self.windows * len(self.dictionary)

    def heard(self, ledger: Ledger, seen: Seen) -> tuple[Array, Ledger]:
        """Return w, before the update takes its share of it, and the ledger after a sample."""
        members, sensors = seen.d.shape
        used, due = seen.used.astype(float), ledger.due
        whole = bool(seen.used.all())
        causes = self._opened(ledger, seen, due)
        parts: dict[str, Any] = self._timed(ledger, seen)
        process = self.dictionary.process
        if process is not None and process.terms and members <= MOST_MEMBERS:
            parts |= self._answered(process, ledger, seen, parts["times"][:, 1])
        f = self._effects(ledger, seen, due, parts)
        if not whole:
            f = f * used[:, None]
        g = f + causes.transpose(0, 2, 1) @ seen.Y
        rows = self._whitened(np.concatenate([seen.d[:, None], g], axis=1), seen.Y)
        r = ledger.clipped(rows[:, 0])
        g = rows[:, 1:].reshape(members, self.windows, -1, sensors)
        names = ("sums", "noise", "before", "present")
        parts |= dict(zip(names, summed(ledger, due, r, g, used), strict=True))
        if self.recorded and seen.C.shape[1] == self.unknowns:
            Y = _sensitivity(seen.C, seen.Y)
            if Y is not None:
                told = seen.d + (seen.a[:, None] @ Y)[:, 0]
                new = blocked(ledger, Y, told if whole else told * used)
                parts |= dict(zip(("score", "information", "length"), new, strict=True))
        same = np.abs(seen.z - ledger.value) <= SAME * np.abs(seen.z)
        parts |= {
            "seen": ledger.seen + 1,
            "age": np.where(due, 1, ledger.age + 1),
            "epoch": ledger.epoch + (due & (ledger.age > 0)),
            "first": np.where(np.isfinite(ledger.first), ledger.first, seen.predicted),
            "last": seen.predicted,
            "stuck": np.where(same, ledger.stuck + 1, np.where(seen.used, 0, ledger.stuck)),
            "value": np.where(np.isfinite(seen.z), seen.z, ledger.value),
        }
        return causes - seen.Y @ f.transpose(0, 2, 1), replace(ledger, **parts)

    def _opened(self, ledger: Ledger, seen: Seen, due: Mask) -> Array:
        """Return w with that of windows that begin: nothing but jumps of the unknowns."""
        causes, count = seen.causes, len(self.dictionary)
        if not due.any() or not count:
            return causes
        members, r, _ = causes.shape
        causes = causes.reshape(members, r, self.windows, count).copy()
        causes.transpose(0, 2, 1, 3)[due] = 0.0
        jumps = self.dictionary.jumps
        if jumps and ledger.seen.any():
            units = JUMP * np.eye(seen.C.shape[2])[:, jumps]
            for k in np.flatnonzero(due[:, 1:].any(axis=1)).tolist():
                w = np.linalg.lstsq(seen.C[k].T, units, rcond=None)[0]
                for window in (1 + np.flatnonzero(due[k, 1:])).tolist():
                    causes[k, :, window, self._jump] = w
        return causes.reshape(members, r, -1)

    @staticmethod
    def _timed(ledger: Ledger, seen: Seen) -> dict[str, Any]:
        """Return time and usual interval after this sample."""
        last, unit = ledger.times[:, 0], ledger.times[:, 1]
        unit = np.where(np.isfinite(unit), unit, seen.at.t - last)
        return {"times": np.stack([np.full(len(last), seen.at.t), unit], axis=1)}

    def _effects(self, ledger: Ledger, seen: Seen, due: Mask, parts: dict[str, Any]) -> Array:
        """Return f of all windows, (members, windows times directions, sensors)."""
        members, sensors = seen.d.shape
        with np.errstate(invalid="ignore", divide="ignore"):
            share = parts["times"][:, 1] / (seen.at.t - ledger.times[:, 0])
        first = np.where(np.isfinite(ledger.first), ledger.first, seen.predicted)
        h = seen.predicted
        f = self.dictionary.signals(seen.noise, h, first, ledger.last, share, seen.u)
        if "readings" in parts:
            (begin, end), (low, high) = parts["reached"].T, parts["readings"].transpose(1, 0, 2, 3)
            width = np.where(end > begin, end - begin, 1.0)
            along = np.clip((seen.at.t - begin) / width, 0.0, 1.0)[:, None, None]
            f[:, self._process] = ((1.0 - along) * low + along * high) / seen.noise[:, None]
        f = np.repeat(f[:, None], self.windows, axis=1)
        if self._drift.stop > self._drift.start:
            age = np.where(due, 0, ledger.age)
            f[:, :, self._drift] *= age[:, :, None, None]
        return f.reshape(members, -1, sensors)

    def _answered(
        self, process: Process, ledger: Ledger, seen: Seen, unit: Array
    ) -> dict[str, Any]:
        """Return responses of the process that reach this sample at least."""
        t = seen.at.t
        behind = ~(ledger.reached[:, 1] >= t)
        if not behind.any():
            return {"readings": ledger.readings, "reached": ledger.reached}
        p, readings = ledger.process.copy(), ledger.readings.copy()
        reached = ledger.reached.copy()
        for k in np.flatnonzero(behind).tolist():
            rest = float(np.nanmean(ledger.first[k])) if np.isfinite(ledger.first[k]).any() else 0.0
            now = Now(seen.u[k], seen.q[k], seen.at.member(k), float(unit[k]), rest)
            if not np.isfinite(reached[k, 1]):
                p[k] = process.begun()
                readings[k] = process.shown(p[k], now)
                reached[k] = t
                continue
            begin, steps = float(reached[k, 1]), stride(int(ledger.seen[k]))
            h = max(steps * float(unit[k]), t - begin)
            p[k] = process.advance(p[k], now, h)
            readings[k, 0] = readings[k, 1]
            readings[k, 1] = process.shown(p[k], now)
            reached[k] = begin, begin + h
        return {"process": p, "readings": readings, "reached": reached}

    @staticmethod
    def _whitened(rows: Array, Y: Array) -> Array:
        """Return rows of readings in units of what is expected of the innovations."""
        sensors = Y.shape[2]
        if sensors > MOST_WHITENED:
            size = np.sqrt(1.0 + (Y * Y).sum(axis=1))
            return np.asarray(rows / size[:, None])
        stacked = np.concatenate([np.eye(sensors) + np.zeros_like(Y[:, :1, :1]), Y], axis=1)
        if not np.isfinite(stacked).all():  # such a sample is not used
            return rows
        R = np.linalg.qr(stacked, mode="r")  # nothing is squared before
        return np.asarray(rows @ np.linalg.inv(R))


def _sensitivity(C: Array, Y: Array) -> Array | None:
    """Return how readings change with the unknowns, (members, k, sensors); None if not known."""
    try:
        return np.asarray(np.linalg.solve(C, Y))
    except np.linalg.LinAlgError:
        return None
