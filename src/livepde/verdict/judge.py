"""Running scores of a filter: the data of its verdict, and the shifts due to causes of misfit.

Let delta be truth minus estimate of [u; a] due to a cause of unit amplitude, and f the direct
effect of that cause on the readings. A Kalman filter without a model of the cause has innovations
r = r_0 + theta g with

    g = H delta + f,    delta <- delta - K g,    delta <- S delta between samples

(Friedland 1969; Willsky and Jones 1976). Causes act on sensors or through a free response p of the
state, so that delta = p + [U C]^T w. Initially w = 0, and predictions map the rows of [U C] as they
map delta. With Y = H [U C]^T and W W^T = (I + Y N^-1 Y^T)^-1, in units of the noise, an update is

    w <- W^T (w - Y f),    since  [U C] <- W^T [U C]  and  K = [U C]^T W W^T Y N^-1.

For each sample only one row of numbers is stored, and rows are summed in batches.
`FilterState.causes` is M, the product of the maps of the rows of [U C] since the last sample, so
that a batch satisfies

    w_k = M_k (w_(k-1) - Y_(k-1) f_(k-1)),    g_k = f_k + Y_k^T w_k.

Thus w requires no solve. It is exact for a linear filter, including moving unknowns, and C^T w is
truth minus estimate of the unknowns per unit of the cause.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from livepde.linalg import Array, Mask, nonfinite_allowed
from livepde.linalg.member_arrays import changed, where
from livepde.stepping import Moments
from livepde.verdict.directions import JUMP, Dictionary, Now, stride
from livepde.verdict.evidence import causes_of, quiet
from livepde.verdict.ledger import WINDOWS, Ledger, batch_of, blocked, summed

MOST_MEMBERS = 16  # largest fleet that is tested for missing terms
MOST_RECORDED = 400  # most numbers in a block of the record of the unknowns
SAME = 1e-12  # relative tolerance for equal readings
REACHED = 1e-6  # tolerance for equal times, as a share of a step


class ScoredSample(NamedTuple):
    """A sample and the prior of a filter at its time, in units of the noise."""

    # C, M: square root of the covariance of the unknowns, (members, r, k), and the product of the
    # maps of its rows since the last sample, (members, r, rank)
    C: Array
    M: Array
    # a, q: functions that return the estimated reduced and latent unknowns, since few judges
    # require them
    a: Callable[[], Array]
    q: Callable[[], Array]
    u: Array  # estimated state
    # Y, d, used: observed square root, (members, r, sensors), innovations minus their shift due to
    # the estimated discretisation error, and mask of the values in use
    Y: Array
    d: Array
    used: Mask
    # z, predicted, noise: readings, predictions, and standard deviations of the noise,
    # (members or 1, sensors)
    z: Array
    predicted: Array
    noise: Array
    at: Moments  # time and inputs


class Judge:
    """Adds samples to a ledger and sums them.

    `dictionary`: the directions.
    `sensors`, `unknowns`, `n`: number of sensors, reduced unknowns and coefficients of the state.
    `rank`: largest number of rows of the square root at a sample.
    `still`: whether all unknowns are constant, so that their record can be kept.
    """

    def __init__(
        self, dictionary: Dictionary, sensors: int, unknowns: int, n: int, rank: int, *, still: bool
    ) -> None:
        self.dictionary = dictionary
        self.sensors, self.unknowns, self.n, self.rank = sensors, unknowns, n, rank
        # The record has (k, k) numbers for each sensor and block. Scores of varying unknowns cannot
        # be accumulated.
        self.recorded = still and 0 < sensors * unknowns**2 <= MOST_RECORDED
        self.windows = len(WINDOWS)
        self.terms = len(dictionary.process.terms) if dictionary.process else 0
        self._drift = dictionary.parts.get("drift", slice(0, 0))
        self._jump, self._process = dictionary.parts["jump"], dictionary.parts["process"]
        # Layout of the row of a sample, see `_row`.
        sizes = {
            "t": 1,
            "used": sensors,
            "d": sensors,
            "noise": sensors,
            "z": sensors,
            "predicted": sensors,
            "Y": rank * sensors,
            "M": rank**2,
            "moved": sensors * dictionary.axes,
            "responses": self.terms * sensors,
            "a": unknowns if self.recorded else 0,
            "C": unknowns**2 if self.recorded else 0,
        }
        ends = np.cumsum(list(sizes.values())).tolist()
        layout = zip(sizes.items(), ends, strict=True)
        self._at = {name: slice(end - size, end) for (name, size), end in layout}
        self.numbers = int(ends[-1])
        self.batch = batch_of(self.numbers)
        self._eye = np.eye(rank)[None]

    def start(self) -> Ledger:
        """Return the ledger of one member before any sample."""
        followed = self.unknowns if self.recorded else 0
        n = self.n if self.terms else 0
        counts = len(self.dictionary), followed, self.terms, n, self.windows, self.rank
        return Ledger.start(self.sensors, *counts, self.batch, self.numbers)

    def add(self, ledger: Ledger, sample: ScoredSample) -> tuple[Array, Ledger]:
        """Return M before the update of this sample, the identity, and the ledger with it."""
        M = sample.M
        members, r, _ = M.shape
        # A full batch is summed when the next sample arrives, so that a verdict in between sums a
        # copy without side effects. The condition also holds before the first sample.
        if np.count_nonzero(ledger.waiting % self.batch) < members:
            M, ledger = self._begin_batch(ledger, sample)
        reached = _reached(ledger, sample.at.t)
        # Missing terms require a solve for each member.
        follows = self.terms > 0 and members <= MOST_MEMBERS
        if follows and np.count_nonzero(reached) < members:
            ledger = self._extend_responses(ledger, sample)
        rows, waiting = ledger.rows.copy(), ledger.waiting
        rows[np.arange(members), waiting] = self._row(sample, M)
        # The update of this sample will multiply M by W^T, and predictions by their maps of the
        # rows of [U C].
        identity = self._eye[:, :r]
        after = changed(ledger, seen=ledger.seen + 1, waiting=ledger.waiting + 1, rows=rows)
        return identity if members == 1 else np.repeat(identity, members, axis=0), after

    def _row(self, sample: ScoredSample, M: Array) -> Array:
        """Return the numbers of a sample, (members, numbers)."""
        members, at = len(M), self._at
        row = np.empty((members, self.numbers))
        row[:, 0] = sample.at.t
        for name in ("used", "d", "noise", "z", "predicted"):
            row[:, at[name]] = getattr(sample, name)
        for name, matrix in (("Y", sample.Y), ("M", M)):
            start, stop = at[name].start, at[name].stop
            row[:, start : start + matrix[0].size] = matrix.reshape(members, -1)
            row[:, start + matrix[0].size : stop] = 0.0  # if the square root has fewer rows
        if self.dictionary.axes:
            row[:, at["moved"]] = self.dictionary.moved(sample.u)
        if self.terms:  # interpolated later for the whole batch
            row[:, at["responses"]] = np.nan
        if self.recorded:
            known = sample.C.shape[1] == self.unknowns
            row[:, at["a"]] = sample.a() if known else 0.0
            row[:, at["C"]] = sample.C.reshape(members, -1) if known else 0.0
        return row

    @nonfinite_allowed()  # nonfinite effects are set to zero
    def summed_up(self, ledger: Ledger, M: Array) -> tuple[Array, Ledger]:
        """Return w and the ledger after all waiting samples are summed.

        `M`: current value, (members, r, rank). `w`: shape (members, r, windows * directions).
        """
        members, at, due = len(ledger.seen), self._at, ledger.due
        # Sum only as many rows as any member has.
        batch = max(int(ledger.waiting.max(initial=0)), 1)
        rows, present = ledger.rows[:, :batch], np.arange(batch) < ledger.waiting[:, None]
        ledger = self._with_interval(ledger, rows, present)
        used = rows[:, :, at["used"]] * present[:, :, None]
        Y = rows[:, :, at["Y"]].reshape(members, batch, self.rank, self.sensors)
        f, growth = self._effects(ledger, rows, used, due)
        before, w = self._coordinates(ledger, rows, present, _in_windows(Y @ f, growth))
        # Stack innovations and g before whitening: (members, batch, sensors, 1 + columns).
        d = rows[:, :, at["d"], None]
        stacked = np.concatenate([d, _in_windows(f, growth) + Y.swapaxes(-1, -2) @ before], axis=-1)
        # T = (1 + Y^T Y)^(-1/2) = 1 + X scale X^T whitens the innovations of a sample.
        X, scale = _whitening(Y)
        stacked += X @ (scale * (X.swapaxes(-1, -2) @ stacked))
        # A single outlier must not be evidence for a cause (Huber's loss).
        stacked[..., 0] = ledger.clipped(stacked[..., 0])
        if not present.all():
            stacked *= present[:, :, None, None]
        # Sums over the waiting samples, in windows that continue or begin with them.
        updates: dict[str, Any] = summed(ledger, due, stacked, used)
        # The record uses raw residuals about the prior mean, d + Y^T a. Its scores do not depend on
        # the current estimate, so blocks of different times can be added.
        if self.recorded:
            updates |= blocked(ledger, *self._record(rows, Y[:, :, : self.unknowns], used))
        z, last = rows[:, :, at["z"]], rows[np.arange(members), np.maximum(ledger.waiting - 1, 0)]
        has_samples = ledger.waiting[:, None] > 0
        shown = np.isfinite(z) & present[:, :, None]
        refused = shown & ~(used > 0.0)
        times = np.concatenate([last[:, at["t"]], ledger.times[:, 1:]], axis=1)
        updates |= self._stuck(ledger, np.where(shown, z, np.nan)) | {
            "sound": _sound(ledger, due),
            "shown": ledger.shown + np.stack([shown.sum(axis=1), refused.sum(axis=1)], axis=1),
            "waiting": np.zeros_like(ledger.waiting),
            "age": np.where(due, 0, ledger.age) + ledger.waiting[:, None],
            "epoch": ledger.epoch + (due & (ledger.age > 0)),
            "last": np.where(has_samples, last[:, at["predicted"]], ledger.last),
            "times": np.where(has_samples, times, ledger.times),
        }
        return M @ w, changed(ledger, **updates)

    def _coordinates(
        self, ledger: Ledger, rows: Array, present: Mask, effect: Array
    ) -> tuple[Array, Array]:
        """Return w before the update of each waiting sample, and w - Y f of the last sample.

        Shapes (members, batch, rank, columns) and (members, rank, columns). Members without a
        sample keep their w.
        """
        M = rows[:, :, self._at["M"]].reshape(*rows.shape[:2], self.rank, self.rank)
        before, w, complete = np.empty_like(effect), ledger.w, bool(present.all())
        for k in range(effect.shape[1]):
            np.matmul(M[:, k], w, out=before[:, k])
            after = before[:, k] - effect[:, k]
            w = after if complete else np.where(present[:, k, None, None], after, w)
        return before, w

    def _record(self, rows: Array, Y: Array, used: Array) -> tuple[Array, Array]:
        """Return sensitivities to the unknowns, and residuals at the prior mean, for the record.

        Shapes (members, batch, k, sensors) and (members, batch, sensors); zero without a value.
        """
        at, k = self._at, self.unknowns
        Y = _sensitivity(rows[:, :, at["C"]].reshape(*rows.shape[:2], k, k), Y)
        residuals: Array = rows[:, :, at["d"]] + (rows[:, :, None, at["a"]] @ Y)[:, :, 0]
        return Y * used[:, :, None], residuals * used

    def _with_interval(self, ledger: Ledger, rows: Array, present: Mask) -> Ledger:
        """Return the ledger with its first interval, as the usual one, and first predictions."""
        if np.isfinite(ledger.times[:, 1]).all() and np.isfinite(ledger.first).all():
            return ledger
        times = np.concatenate([ledger.times[:, :1], rows[:, :, 0]], axis=1)
        steps = np.where(present, np.diff(times, axis=1), np.nan)
        steps = np.concatenate([ledger.times[:, 1:], steps], axis=1)
        first_known = np.isfinite(steps).argmax(axis=1)[:, None]
        unit = np.take_along_axis(steps, first_known, axis=1)
        predicted = rows[:, 0, self._at["predicted"]]
        first = np.where(np.isfinite(ledger.first), ledger.first, predicted)
        return changed(ledger, times=np.concatenate([times[:, :1], unit], axis=1), first=first)

    @staticmethod
    def _stuck(ledger: Ledger, z: Array) -> dict[str, Any]:
        """Return the number of successive repetitions of the latest value, and that value."""
        before = np.concatenate([ledger.value[:, None], z[:, :-1]], axis=1)
        # Fast path for the usual case: no value is missing, and none repeats.
        if np.isfinite(z).all() and not (np.abs(z - before) <= SAME * np.abs(z)).any():
            return {"stuck": np.zeros_like(ledger.stuck), "value": z[:, -1]}
        z = np.concatenate([ledger.value[:, None], z], axis=1)
        order, seen = np.arange(z.shape[1])[:, None], np.isfinite(z)
        latest = np.maximum.accumulate(np.where(seen, order, 0), axis=1)
        value = np.take_along_axis(z, latest, axis=1)  # latest finite value
        same = np.abs(z[:, 1:] - value[:, :-1]) <= SAME * np.abs(z[:, 1:])
        changes = np.where(seen[:, 1:] & ~same, order[1:], 0).max(axis=1)
        repetitions = (seen[:, 1:] & (order[1:] > changes[:, None])).sum(axis=1)
        stuck = np.where(changes > 0, 0, ledger.stuck) + repetitions
        return {"stuck": stuck, "value": value[:, -1]}

    def _begin_batch(self, ledger: Ledger, sample: ScoredSample) -> tuple[Array, Ledger]:
        """Return M and the ledger with a new batch for members whose batch is full or empty."""
        full = ledger.waiting == self.batch
        begins = full | (ledger.waiting == 0)
        members, r, _ = sample.M.shape
        w = np.zeros((members, r, ledger.w.shape[2]))
        if full.any():
            w_full, summed_ledger = self.summed_up(ledger, sample.M)
            w[full] = w_full[full]
            ledger = where(full, summed_ledger, ledger)
        w = self._begin_windows(ledger, sample, ledger.due & begins[:, None], w)
        padded = np.zeros_like(ledger.w)
        padded[:, :r] = w[:, : self.rank]
        mask = begins[:, None, None]
        M = np.where(mask, self._eye[:, :r], sample.M)
        return M, changed(ledger, w=np.where(mask, padded, ledger.w))

    def _begin_windows(self, ledger: Ledger, sample: ScoredSample, due: Mask, w: Array) -> Array:
        """Return w with initial values in windows that begin: zero except for jumps."""
        count = len(self.dictionary)
        if not due.any() or not count:
            return w
        members, r, _ = w.shape
        # Directions of a new window have not shifted the estimate yet: w = 0 ...
        w = w.reshape(members, r, self.windows, count)
        w.transpose(0, 2, 1, 3)[due] = 0.0
        jumps = self.dictionary.jumps
        if jumps and ledger.seen.any():
            # ... but a jump of an unknown is an initial shift C^T w = e of the estimate.
            units = JUMP * np.eye(sample.C.shape[2])[:, jumps]
            for k in np.flatnonzero(due[:, 1:].any(axis=1)).tolist():
                shift = np.linalg.lstsq(sample.C[k].T, units, rcond=None)[0]
                for window in (1 + np.flatnonzero(due[k, 1:])).tolist():
                    w[k, :, window, self._jump] = shift
        return w.reshape(members, r, -1)

    def _effects(self, ledger: Ledger, rows: Array, used: Array, due: Mask) -> tuple[Array, Array]:
        """Return f of the waiting samples, and its factor in each window.

        Shapes (members, batch, sensors, directions) and (members, batch, windows, directions). A
        drift starts with its window and grows by one unit per sample.
        """
        at, (members, batch, _) = self._at, rows.shape
        t, h = rows[:, :, 0], rows[:, :, at["predicted"]]
        before = np.concatenate([ledger.times[:, :1], t[:, :-1]], axis=1)
        # A sensor that is late by one sample shows the prediction of the previous sample.
        last = np.concatenate([ledger.last[:, None], h[:, :-1]], axis=1)
        late = (last - h) * (ledger.times[:, 1:] / (t - before))[:, :, None]
        moved, change = rows[:, :, at["moved"]], h - ledger.first[:, None]
        responses = self._responses(ledger)[:, :batch]
        responses = responses.reshape(members, batch, self.terms, self.sensors)
        f = self.dictionary.effects(rows[:, :, at["noise"]], change, late, moved, responses)
        f *= used[..., None]
        f[~np.isfinite(f)] = 0.0  # without a previous sample, or in rows that are not filled
        growth = np.ones((members, batch, self.windows, len(self.dictionary)))
        age = np.where(due, 0, ledger.age)[:, None] + np.arange(batch)[:, None]
        growth[..., self._drift] = age[..., None]
        return f, growth

    def _responses(self, ledger: Ledger) -> Array:
        """Return readings due to missing terms at waiting samples, (members, batch, numbers)."""
        known = ledger.rows[:, :, self._at["responses"]]
        elapsed = (ledger.rows[:, :, 0] - ledger.reached[:, :1])[:, :, None]
        start, slope = ledger.readings.reshape(len(known), 2, 1, -1).swapaxes(0, 1)
        return np.where(np.isnan(known), start + elapsed * slope, known)

    def _extend_responses(self, ledger: Ledger, sample: ScoredSample) -> Ledger:
        """Return the ledger with responses of the process that extend to the time of a sample.

        One step of the process spans several samples, whose responses are interpolated.
        """
        process, t = self.dictionary.process, sample.at.t
        if process is None:
            return ledger
        rows = ledger.rows.copy()
        rows[:, :, self._at["responses"]] = self._responses(ledger)
        p, readings = ledger.process.copy(), ledger.readings.copy()
        reached, q = ledger.reached.copy(), sample.q()
        for k in np.flatnonzero(~_reached(ledger, t)).tolist():
            # The mean of the first predictions approximates the equilibrium state without loss.
            first = ledger.first[k, np.isfinite(ledger.first[k])]
            equilibrium = float(first.sum()) / max(len(first), 1)
            # The usual interval, or else the time since the first sample.
            unit, elapsed = float(ledger.times[k, 1]), t - float(ledger.rows[k, 0, 0])
            if not np.isfinite(unit):
                unit = elapsed if elapsed > 0.0 else 1.0
            now = Now(sample.u[k], q[k], sample.at.member(k), unit, equilibrium)
            if not np.isfinite(reached[k, 1]):
                p[k] = process.start()
                readings[k] = process.readings(p[k], now), np.zeros_like(readings[k, 1])
                reached[k] = t
                continue
            begin = float(reached[k, 1])
            h = max(stride(int(ledger.seen[k])) * unit, t - begin)
            p[k] = process.advance(p[k], now, h)
            start = readings[k, 0] + (begin - reached[k, 0]) * readings[k, 1]
            readings[k] = start, (process.readings(p[k], now) - start) / h
            reached[k] = begin, begin + h
        return changed(ledger, rows=rows, process=p, readings=readings, reached=reached)


def _reached(ledger: Ledger, t: float) -> Mask:
    """Return whether the responses reach a time; the tolerance is for regular sample times."""
    begin, end = ledger.reached.T
    return np.asarray(end >= t - REACHED * (end - begin))


def _in_windows(effect: Array, growth: Array) -> Array:
    """Return the effect of each direction in each window, (..., k, windows * directions)."""
    return (effect[..., None, :] * growth[:, :, None]).reshape(*effect.shape[:3], -1)


def _sound(ledger: Ledger, due: Mask) -> Mask:
    """Return whether the longest window was free of evidence when it last ended."""
    ending = due[:, -1] & (ledger.age[:, -1] > 0)
    if not ending.any():
        return ledger.sound
    sound = ledger.sound.copy()
    for k in np.flatnonzero(ending).tolist():
        member = ledger.of_member(k)
        sound[k] = quiet(member, causes_of(member).log_e)
    return sound


def _whitening(Y: Array) -> tuple[Array, Array]:
    """Return X and scale with (1 + Y^T Y)^(-1/2) = 1 + X scale X^T, for Y (..., rank, sensors).

    The eigenvectors are those of the smaller matrix: Y Y^T = V L V^T with X = Y^T V, or Y^T Y =
    X L X^T. Shapes (..., sensors, k) and (..., k, 1).
    """
    rank, sensors = Y.shape[-2:]
    if not np.isfinite(Y).all():
        Y = np.where(np.isfinite(Y).all(axis=(-2, -1), keepdims=True), Y, 0.0)
    small = rank < sensors
    Yt = Y.swapaxes(-1, -2)
    values, axes = np.linalg.eigh(Y @ Yt if small else Yt @ Y)
    values = np.maximum(values, 0.0)
    scale = 1.0 / np.sqrt(1.0 + values) - 1.0
    # X = Y^T V has squared norms L, so the scale is divided by L.
    if small:
        scale /= np.where(values > 0.0, values, 1.0)
        axes = Yt @ axes
    return axes, scale[..., None]


def _sensitivity(C: Array, Y: Array) -> Array:
    """Return sensitivities C^-1 Y of the readings, (..., k, sensors); zero if C is singular."""
    determinant = np.linalg.det(C)
    known = np.isfinite(determinant) & (determinant != 0.0)
    if known.all():
        return np.asarray(np.linalg.solve(C, Y))
    safe = np.where(known[..., None, None], C, np.eye(C.shape[-1]))
    return np.asarray(np.where(known[..., None, None], np.linalg.solve(safe, Y), 0.0))
