"""Fleet for live streams, whose members have their own sample times and whose log has offsets."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from livepde import checkpoint
from livepde.errors import DataError, OffsetError, RunError, SampleError, optional
from livepde.fem import FunctionSpace
from livepde.fleet.engines import State
from livepde.fleet.estimate import FleetEstimate
from livepde.fleet.fleet import Fleet
from livepde.identifier import Identifier
from livepde.laws import AnyLaw
from livepde.linalg import Array, IntArray
from livepde.model import Model
from livepde.observation import Observation, Observed
from livepde.samples import columns, number, readings

if TYPE_CHECKING:
    import pyarrow as pa

REFUSED = "refused"
FORMAT = 1  # version of the format of `dump`
BLOCK = 256  # members in a block: larger blocks need more memory and are not faster
Item: TypeAlias = Sequence[Any]  # (member, t, z) or (member, t, z, inputs)
LOG = "state.log"  # leaf whose second axis has a different number of rows for each member
ROOM = 8  # additional rows when a log grows


@dataclass(frozen=True, eq=False)
class ShardEstimates:
    """Estimates of the samples of a batch, in the same order.

    Attributes
    ----------
    offset
        Offset of the first sample.
    member, t
        Member and specified time of each sample, shape (samples,).
    q, q_std
        Coefficients of the parameter and their standard deviations, shape (samples, m). NaN for
        refused samples; standard deviations are also NaN for a law without covariance.
    innovation
        Measured minus predicted values, shape (samples, sensors).
    status
        "ok", "refused", or the `Status.code` of a failed step.
    message
        Reason of a refused sample or a failed step; else empty.
    labels, sensors
        Label of each scalar unknown -> its column of q; names of the sensors.
    """

    offset: int
    member: tuple[str, ...]
    t: Array
    q: Array
    q_std: Array
    innovation: Array
    status: list[str]
    message: list[str]
    labels: dict[str, int]
    sensors: tuple[str, ...]

    @classmethod
    def blank(
        cls,
        offset: int,
        items: Sequence[Sequence[Any]],
        space: FunctionSpace,
        sensors: Sequence[str],
    ) -> ShardEstimates:
        """Return estimates of NaN for samples (member, t, ...)."""
        count = len(items)
        return cls(
            offset,
            tuple(str(item[0]) if len(item) else "" for item in items),
            np.array([_time(item[1]) if len(item) > 1 else np.nan for item in items]),
            np.full((count, space.dim), np.nan),
            np.full((count, space.dim), np.nan),
            np.full((count, len(sensors)), np.nan),
            ["ok"] * count,
            [""] * count,
            dict(space.labels),
            tuple(sensors),
        )

    def refuse(self, row: int, message: str) -> None:
        """Mark a sample as refused."""
        self.status[row], self.message[row] = REFUSED, message

    def put(self, rows: Sequence[int], estimate: FleetEstimate) -> None:
        """Set the rows of samples that were stepped as a block."""
        self.q[rows], self.innovation[rows] = estimate.q, estimate.innovation
        if estimate.q_std is not None:
            self.q_std[rows] = estimate.q_std
        for row, status in zip(rows, estimate.statuses, strict=True):
            self.status[row] = status.code
            self.message[row] = "" if status.ok else str(status)

    @property
    def parameters(self) -> dict[str, tuple[Array, Array]]:
        """Label of each scalar unknown -> values and standard deviations, (samples,) each."""
        return {label: (self.q[:, k], self.q_std[:, k]) for label, k in self.labels.items()}

    def to_arrow(self) -> pa.Table:
        """Return an Arrow table with offset, member, t, status, message, and numbers.

        Each scalar unknown has columns NAME and NAME_std, each sensor a column "innovation NAME".
        If an unknown is a field, `q` and `q_std` are columns of lists.

        Raises `ConfigurationError`: pyarrow is not installed.
        """
        with optional("parquet", "Arrow tables need pyarrow"):
            import pyarrow as pa
        columns: dict[str, Any] = {
            "offset": np.arange(self.offset, self.offset + len(self.t)),
            "member": list(self.member),
            "t": self.t,
            "status": self.status,
            "message": self.message,
        }
        for label, (value, std) in self.parameters.items():
            columns |= {label: value, f"{label}_std": std}
        if len(self.labels) < self.q.shape[1]:
            columns |= {"q": list(self.q), "q_std": list(self.q_std)}
        for k, name in enumerate(self.sensors):
            columns[f"innovation {name}"] = self.innovation[:, k]
        # Arrow cannot infer the type of an empty list.
        texts = dict.fromkeys(("member", "status", "message"), pa.string())
        return pa.table(
            {name: pa.array(values, texts.get(name)) for name, values in columns.items()}
        )


def _time(value: object) -> float:
    """Return a time as a float; NaN for other types, whose sample is refused."""
    return float(value) if isinstance(value, int | float | np.number) else np.nan


class Shard:
    """Estimate the unknowns of many processes from a stream of samples with offsets.

    The offset of a sample is its position in the log of record, counted from 0. A shard processes
    all samples of the log once and in order: `step` raises an error for a batch that does not begin
    at `offset`. A shard restored from an older `dump` therefore processes the same samples again
    and returns the same numbers, or it raises an error.

    In contrast to a `Fleet`, each member has its own sample times. Samples of a batch are stepped
    as a block if the last two sample times of their members agree. Estimates equal those of one
    `Identifier` for each member, to rounding.

    Parameters
    ----------
    model, observation, law, members
        As for `Fleet`.
    options
        Further parameters of `Fleet`: q0, u0, t0, validation, and so on.

    Attributes
    ----------
    offset
        Offset of the next sample.

    Raises
    ------
    ConfigurationError
        Parts that do not fit together.

    Examples
    --------
    >>> import livepde as lp
    >>> from livepde.models import heat
    >>> model = heat(lp.interval(0, 1, 20), lp.Normal(0.5, 0.2), {"left": 0.0, "right": 0.0})
    >>> rods = ["north", "south"]
    >>> shard = Shard(model, lp.Points([0.5], noise=0.01), lp.SensitivityLaw(), rods, u0=1.0)
    >>> shard.step(0, [("south", 0.1, [0.9]), ("north", 0.3, [0.7]), ("south", 0.2, [0.8])]).status
    ['ok', 'ok', 'ok']
    >>> shard.step(2, [("south", 0.2, [0.8])])
    Traceback (most recent call last):
    ...
    livepde.errors.OffsetError: samples 2 to 2 were taken already, the shard is at 3: skip them.
    """

    def __init__(
        self,
        model: Model,
        observation: Observation,
        law: AnyLaw,
        members: int | Sequence[str],
        **options: Any,
    ) -> None:
        self._fleet = Fleet(model, observation, law, members, **options)
        self.offset = 0
        self._places = {name: k for k, name in enumerate(self._fleet.members)}
        store = JoinedStates if self._fleet.together else OwnStates
        self._states: JoinedStates | OwnStates = store(self._fleet.template(), len(self))
        self._taken: IntArray = np.zeros(len(self._fleet), dtype=np.int64)  # samples of each member
        self._interrupted = False

    def __len__(self) -> int:
        return len(self._fleet)

    @property
    def members(self) -> tuple[str, ...]:
        """Names of the members."""
        return self._fleet.members

    @property
    def note(self) -> str:
        """Reason why members are stepped one by one; empty if they are stepped as blocks."""
        return self._fleet.note

    def step(self, offset: int, batch: Iterable[Item]) -> ShardEstimates:
        """Process the next samples of the log and return an estimate for each.

        An invalid sample (an unknown member, a time that is not later than the member's last, text
        instead of a number) changes nothing; its status is "refused". If a step fails numerically,
        its status is the reason, as in `Identifier.step`.

        Parameters
        ----------
        offset
            Offset of the first sample of the batch.
        batch
            Samples (member, t, z) or (member, t, z, inputs), in the order of the log; z and inputs
            as for `Identifier.step`. Several samples of a member are allowed.

        Raises
        ------
        OffsetError
            The batch does not begin at `offset` of the shard; the shard is unchanged.
        RunError
            An exception interrupted an earlier step, so that the batch is partly processed.
        """
        self._refuse_interrupted()
        items: list[Item] = [item if isinstance(item, tuple | list) else () for item in batch]
        self._check_offset(offset, len(items))
        space, sensors = self._fleet.model.parameter_space, self._fleet.observed.names
        estimates = ShardEstimates.blank(offset, items, space, sensors)
        self._interrupted = True
        for wave in self._waves(items, estimates):
            for rows in self._blocks(items, wave):
                self._take(items, rows, estimates)
        self._interrupted = False
        self.offset += len(items)
        return estimates

    def _refuse_interrupted(self) -> None:
        if self._interrupted:
            raise RunError(
                f"the step at offset {self.offset} was broken off by an exception, and some "
                "members have taken their samples: load the last dump."
            )

    def _check_offset(self, offset: int, count: int) -> None:
        """Raise `OffsetError` unless the batch continues at the offset of the shard."""
        last, here = offset + count - 1, self.offset
        if offset == here:
            return
        if offset > here:
            raise OffsetError(
                f"the batch begins at {offset}, the shard is at {here}: samples {here} to "
                f"{offset - 1} are missing; read the log again from {here} on."
            )
        if last < here:
            raise OffsetError(
                f"samples {offset} to {last} were taken already, the shard is at {here}: skip them."
            )
        raise OffsetError(
            f"samples {offset} to {here - 1} of the batch were taken already, {here} to {last} "
            f"were not: read the log again from {here} on."
        )

    def _waves(self, items: list[Item], estimates: ShardEstimates) -> Iterable[list[int]]:
        """Group the rows into waves with at most one sample of each member.

        Invalid samples are refused; labelled readings in `items` are replaced by mappings.
        """
        waves: dict[int, list[int]] = {}
        counts: Counter[str] = Counter()
        for row, item in enumerate(items):
            try:
                items[row] = name, *_ = self._checked(item)
            except DataError as error:
                estimates.refuse(row, str(error))
                continue
            waves.setdefault(counts[name], []).append(row)
            counts[name] += 1
        return waves.values()

    def _checked(self, item: Item) -> Item:
        """Return a validated sample, whose labelled readings are converted to a mapping."""
        if not 3 <= len(item) <= 4:
            raise SampleError(f"a sample has {len(item)} parts; give (member, t, z, inputs).")
        if not isinstance(item[0], str) or item[0] not in self._places:
            raise SampleError(f"there is no member {item[0]!r} in this shard.")
        number(item[1], "time t")
        if len(item) == 4 and not isinstance(item[3], Mapping | None):
            raise SampleError(f"inputs are {item[3]!r:.80}; give channel -> number.")
        name, t, z, *inputs = item
        return name, t, self._fleet.labelled(z), *inputs

    def _blocks(self, items: Sequence[Item], wave: Sequence[int]) -> Iterator[list[int]]:
        """Yield blocks of rows whose members have the same last two sample times."""
        groups: dict[tuple[Any, ...], list[int]] = {}
        for row in wave:
            name, t, z, *_ = items[row]
            k = self._places[name]
            ends = float(self._fleet.ends["t"][k]), float(t), self._taken[k] > 0
            group = *ends, self._states.rows(k), isinstance(z, Mapping)
            groups.setdefault(group, []).append(row)
        for rows in groups.values():
            for first in range(0, len(rows), BLOCK):
                yield rows[first : first + BLOCK]

    def _take(self, items: Sequence[Item], rows: Sequence[int], estimates: ShardEstimates) -> None:
        """Step the members of samples together; if one is invalid, one by one."""
        which = np.array([self._places[items[row][0]] for row in rows])
        block = self._subset(which)
        try:
            estimate = block.step(*_joined([items[row] for row in rows], block.observed))
        except DataError as error:
            if len(rows) == 1:
                estimates.refuse(rows[0], str(error))
                return
            for row in rows:
                self._take(items, [row], estimates)
            return
        # Estimates are read first, since they refer to states that are overwritten in place.
        estimates.put(rows, estimate)
        self._states.put(which, self._fleet.adopt(which, block))
        self._taken[which] += 1

    def _subset(self, which: IntArray) -> Fleet:
        """Return a fleet of members that are all at their start, or all have a state."""
        samples = int(self._taken[which[0]])
        state = self._states.take(which) if samples else None
        return self._fleet.subset(which, state, samples)

    def identifier(self, member: str) -> Identifier:
        """Return an identifier in the state of a member, for example for forecasts and fields.

        Steps of this identifier do not change the shard.
        """
        # A copy, since states of the shard are overwritten in place.
        return copy.deepcopy(self._subset(np.array([self._places[member]])).identifier(0))

    def dump(self) -> bytes:
        """Return offset and states of all members as bytes with a checksum.

        Raises `RunError`: an exception interrupted a step.
        """
        self._refuse_interrupted()
        header = {**self._fleet.header, "shard": FORMAT}
        leaves = {"offset": self.offset, "taken": self._taken, **self._fleet.ends}
        leaves |= self._fleet.fingerprint.leaves
        leaves |= {f"state/{path}": leaf for path, leaf in self._states.leaves().items()}
        return checkpoint.packed(header, leaves)

    def load(self, content: bytes) -> None:
        """Continue from the bytes of `dump` at its offset, with identical numbers.

        The shard must be built with the same arguments.

        Raises `RunError`: the content is damaged or of another shard; the shard is unchanged.
        """
        header, leaves = checkpoint.unpacked(content, "the dump")
        if header.get("shard") != FORMAT:
            raise RunError("the dump is of another shard, or of another version of livepde.")
        self._fleet.check(header, leaves, "the dump")
        try:
            offset, taken = int(leaves["offset"]), leaves["taken"].astype(np.int64)
            so_far = self._fleet._so_far.restored(leaves)
            stored = {path.removeprefix("state/"): leaf for path, leaf in leaves.items()}
            states = self._states.restored(stored)
        except (KeyError, ValueError) as error:
            raise RunError(
                f"the dump does not fit this shard ({error}): build it with the law's options as "
                "they were."
            ) from error
        self._fleet._so_far = so_far
        self.offset, self._taken, self._states, self._interrupted = offset, taken, states, False


def _joined(items: Sequence[Item], observed: Observed) -> tuple[float, Any, dict[str, Any]]:
    """Combine samples at one time to the arguments of `Fleet.step`: time, readings and inputs."""
    t, z = float(items[0][1]), [item[2] for item in items]
    inputs = [(item[3] or {}) if len(item) == 4 else {} for item in items]
    measured = columns(z) if isinstance(z[0], Mapping) else _rows(z, observed)
    return t, measured, columns(inputs)


def _rows(rows: Sequence[Any], observed: Observed) -> Array:
    """Return measurements and their noise (NaN: default), shape (members, sensors, 2)."""
    default = np.full(observed.size, np.nan)
    pairs = (readings(row, observed) for row in rows)
    return np.stack([(z, default if noise is None else noise) for z, noise in pairs]).swapaxes(1, 2)


class OwnStates:
    """States of members that are stepped one by one, stored as separate values."""

    def __init__(self, template: State, count: int) -> None:
        self._template = template[0]
        self._states = [self._template] * count

    def rows(self, k: int) -> int:
        """Return 0, since separate states need not have logs of equal length."""
        return 0

    def take(self, which: IntArray) -> State:
        """Return the states of members for their engine."""
        return tuple(self._states[k] for k in which)

    def put(self, which: IntArray, state: State) -> None:
        """Store the states of members after a step."""
        for k, member_state in zip(which.tolist(), state, strict=True):
            self._states[k] = member_state

    def leaves(self) -> dict[str, Any]:
        """Return all states as arrays by name."""
        return checkpoint.flatten(tuple(self._states))

    def restored(self, leaves: Mapping[str, Array]) -> OwnStates:
        """Return the states from `leaves`; raise KeyError or ValueError if they do not fit."""
        states = OwnStates((self._template,), 0)
        indices = range(len(self._states))
        states._states = [checkpoint.rebuild(self._template, leaves, f"state.{k}") for k in indices]
        return states


class JoinedStates:
    """States of members that are stepped as blocks, stored in arrays that are written in place.

    A leaf that is equal for all members, such as the fit before the first refit, is stored once.
    The log has a different number of rows for each member.
    """

    def __init__(self, template: State, count: int) -> None:
        self._template = template
        self._count = count
        self._rows: IntArray = np.zeros(count, dtype=np.int64)
        self._leaves: dict[str, Array] = checkpoint.flatten(template)
        self._log = np.zeros((count, 0, self._leaves.pop(LOG).shape[2]))
        self._shared = set(self._leaves)
        self._taken: dict[str, Array] = {}

    def rows(self, k: int) -> int:
        """Return the number of rows in the log of a member, equal for all members of a block."""
        return int(self._rows[k])

    def take(self, which: IntArray) -> State:
        """Return the states of members, whose logs have the same number of rows."""
        length, first = len(which), int(which[0])
        index: Any = which
        if np.array_equal(which, np.arange(first, first + length)):
            index = slice(first, first + length)  # no copy
        selected = {}
        for path, leaf in self._leaves.items():
            if path not in self._shared:
                selected[path] = leaf[index]
            else:  # a leaf of length 0 keeps that length
                selected[path] = (
                    np.broadcast_to(leaf, (length, *leaf.shape[1:])) if len(leaf) else leaf
                )
        self._taken = selected
        log = self._log[which][:, : self._rows[first]]
        return checkpoint.rebuild(self._template, {**selected, LOG: log})

    def put(self, which: IntArray, state: State) -> None:
        """Store the states of members after a start, or a step from the states of `take`."""
        leaves = checkpoint.flatten(state)
        log = leaves.pop(LOG)
        rows = log.shape[1]
        if rows > self._log.shape[1]:
            self._log = _widened(self._log, rows + ROOM, np.inf)
        self._log[which, :rows], self._log[which, rows:] = log, np.inf
        self._rows[which] = rows
        updates = {path: new for path, new in leaves.items() if new is not self._taken.get(path)}
        # An array may be a view of an array that is overwritten below, for example if the filter
        # becomes the older filter. Views are copied first.
        updates = {path: new if new.base is None else new.copy() for path, new in updates.items()}
        for path, new in updates.items():
            self._store_leaf(which, path, new)
        self._taken = {}

    def _store_leaf(self, which: IntArray, path: str, new: Array) -> None:
        leaf = self._leaves[path]
        if not len(new):  # a leaf without values of members
            self._leaves[path] = new
            return
        if path in self._shared:  # stored once as long as no member differs
            if leaf.shape[1:] == new.shape[1:] and np.array_equal(
                np.broadcast_to(leaf, new.shape), new, equal_nan=leaf.dtype.kind == "f"
            ):
                return
            self._shared.remove(path)
            leaf = np.repeat(leaf, self._count, axis=0)
        if leaf.ndim > 2:  # square roots of covariances, whose number of rows may increase
            rows = max(leaf.shape[1], new.shape[1])
            leaf, new = (_widened(array, rows, 0.0) for array in (leaf, new))
        leaf[which] = new
        self._leaves[path] = leaf

    def leaves(self) -> dict[str, Any]:
        """Return all states as arrays by name."""
        return {"rows": self._rows, LOG: self._log, **self._leaves}

    def restored(self, leaves: Mapping[str, Array]) -> JoinedStates:
        """Return the states from `leaves`; raise KeyError or ValueError if they do not fit."""
        states = JoinedStates(self._template, self._count)
        states._rows, states._log = leaves["rows"].astype(np.int64), leaves[LOG]
        states._leaves = {path: leaves[path] for path in self._leaves}
        lengths = {path: len(leaf) for path, leaf in states._leaves.items()}
        states._shared = {path for path, length in lengths.items() if length < self._count}
        if {len(states._rows), len(states._log), *lengths.values()} - {0, 1, self._count}:
            raise ValueError(f"states of other than {self._count} members")
        if self._count == 1:
            states._shared = set()
        states.take(np.array([0]))  # raises an error if the structure differs from the template
        return states


def _widened(array: Array, room: int, value: float) -> Array:
    """Return an array padded with `value` to at least `room` entries on its second axis."""
    padding = room - array.shape[1]
    if padding <= 0:
        return array
    return np.pad(array, ((0, 0), (0, padding), (0, 0)), constant_values=value)
