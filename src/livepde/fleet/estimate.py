"""Estimates of all members of a fleet at one time, and over time as a dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from livepde.errors import ConfigurationError
from livepde.estimate import Estimate, kept
from livepde.fem import FunctionSpace
from livepde.fleet.engines import Beliefs, Factors
from livepde.frames import correlation_of, interval_ends, vertex_order
from livepde.laws import Belief, Status
from livepde.laws.step_diagnostics import Diagnostics
from livepde.linalg import Array, IntArray, Mask
from livepde.model import Model
from livepde.records import NOTE, STATUS_CODES, STATUS_FLAGS, Layout, Record, Snapshot
from livepde.showing import listed

if TYPE_CHECKING:
    import xarray as xr

MEMBER = "member"  # dimension of the dataset


def number_of(members: Sequence[str], member: str | int) -> int:
    """Return the number of a member, specified by name or number."""
    if member in members:
        return members.index(str(member))
    if isinstance(member, int) and -len(members) <= member < len(members):
        return member % len(members)
    raise ConfigurationError(
        f"there is no member {member!r} in this fleet: it has {listed(members)}."
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class FleetEstimate:
    """Estimates of all members at one time.

    Attributes
    ----------
    t
        Time of the sample.
    members
        Names of the members.
    read
        Function that returns the beliefs; see `beliefs`.
    innovation, validation_error
        As for `Estimate`, shapes (members, sensors) and (members, validation).
    statuses
        Status of the step of each member; unless ok, q and u are from its last successful step.
    steps
        Number of substeps, shape (members,).
    diagnose
        Function that returns the diagnostics of the law, as arrays of shape (members,).
    held
        Input channel whose last value (at the first sample, first value) was held -> mask of the
        members without a value, shape (members,).
    space
        Function space of the unknowns.
    belief
        Function: number of a member -> its belief.
    state_space
        Function space of the state; None for an estimate that was pickled.
    """

    t: float
    members: tuple[str, ...]
    read: Callable[[], Beliefs]
    innovation: Array
    validation_error: Array
    statuses: tuple[Status, ...]
    steps: Array
    diagnose: Callable[[], Diagnostics[Array]]
    held: Mapping[str, Mask]
    space: FunctionSpace
    belief: Callable[[int], Belief]
    state_space: FunctionSpace | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for pickle and copies, with values instead of functions."""
        beliefs = tuple(map(self.belief, range(len(self.members))))
        values = {
            "read": partial(kept, self.beliefs),
            "diagnose": partial(kept, self.diagnostics),
            "belief": beliefs.__getitem__,
            "space": self.space.described,
            "state_space": None,
        }
        return vars(self) | values

    @cached_property
    def beliefs(self) -> Beliefs:
        """Coefficients of parameter and state with covariances, computed on first access."""
        return self.read()

    @property
    def q(self) -> Array:
        """Coefficients of the parameter, shape (members, m)."""
        return self.beliefs.q

    @property
    def u(self) -> Array:
        """Coefficients of the state, shape (members, n)."""
        return self.beliefs.u

    @property
    def q_std(self) -> Array | None:
        """Standard deviations of q, (members, m); None for a law without covariance."""
        return self.beliefs.q_std

    @cached_property
    def diagnostics(self) -> Diagnostics[Array]:
        """Diagnostics of the law, such as innovation statistics and safeguards."""
        return self.diagnose()

    @property
    def ok(self) -> Mask:
        """Mask of members whose step succeeded, shape (members,)."""
        return np.array([status.ok for status in self.statuses])

    @property
    def parameters(self) -> dict[str, tuple[Array, Array]]:
        """Label of each scalar unknown -> values and standard deviations, (members,) each."""
        std = self.q_std if self.q_std is not None else np.full_like(self.q, np.nan)
        return {label: (self.q[:, k], std[:, k]) for label, k in self.space.labels.items()}

    def member(self, name: str | int) -> Estimate:
        """Return the estimate of a member, by name or number, as from `Identifier.step`."""
        k = number_of(self.members, name)
        return Estimate(
            t=self.t,
            belief=self.belief(k),
            innovation=self.innovation[k],
            validation_error=self.validation_error[k],
            status=self.statuses[k],
            steps=int(self.steps[k]),
            diagnose=lambda: self.diagnostics.member(k),
            held=tuple(channel for channel, members in self.held.items() if members[k]),
            space=self.space,
            state_space=self.state_space,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Row:
    """Record of an estimate without its state: arrays of numbers over the members."""

    t: float
    parameters: Mapping[str, tuple[Array, Array]]
    innovation: Array
    validation_error: Array
    status: IntArray
    steps: Array
    diagnostics: Mapping[str, Array]

    @classmethod
    def of(cls, estimate: FleetEstimate, **more: Any) -> Self:
        """Return the record of an estimate; `more`: fields of a subclass."""
        codes = [STATUS_CODES.index(status.code) for status in estimate.statuses]
        return cls(
            t=estimate.t,
            parameters=estimate.parameters,
            innovation=estimate.innovation,
            validation_error=estimate.validation_error,
            status=np.array(codes, dtype=np.int32),
            steps=estimate.steps,
            diagnostics=estimate.diagnostics.named(),
            **more,
        )


class FleetResult:
    """Estimates of a fleet, added one by one: numbers, innovations and statuses of all samples."""

    def __init__(self, members: Sequence[str], layout: Layout) -> None:
        if MEMBER in layout.scalars:
            raise ConfigurationError(
                f"Fleet: in its dataset '{MEMBER}' would be the dimension of the members and the "
                f"unknown '{MEMBER}': give the unknown another name."
            )
        self.members = tuple(members)
        self.layout = layout
        self.last: FleetEstimate | None = None
        self._rows: list[_Row] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, estimate: FleetEstimate) -> None:
        """Add an estimate."""
        self._rows.append(_Row.of(estimate))
        self.last = estimate

    def _settle(self, estimate: FleetEstimate) -> None:
        """Replace the last parameters by the final ones of a run."""
        self._rows[-1] = replace(self._rows[-1], parameters=estimate.parameters)
        self.last = estimate

    def to_xarray(self) -> xr.Dataset:
        """Return a dataset with dimensions member, time, sensor and validation.

        Scalar unknowns, their standard deviations `_std`, status, steps and diagnostics are over
        (`member`, `time`), innovations over (`member`, `time`, `sensor`).
        """
        import xarray as xr

        rows, layout, axes = self._rows, self.layout, (MEMBER, "time")
        times = np.array([row.t for row in rows])
        data = xr.Dataset(
            coords={
                MEMBER: list(self.members),
                "time": ("time", times, {"units": layout.time_unit}),
                "sensor": list(layout.sensors),
                "validation": list(layout.validation or ()),
            }
        )
        for label in layout.scalars:
            pairs = self._table([np.transpose(row.parameters[label]) for row in rows], 2)
            for k, name in enumerate((label, f"{label}_std")):
                data[name] = (axes, pairs[..., k], dict(layout.numbers[name]))
        unit = {"units": layout.sensor_unit}
        innovations = self._series("innovation", len(layout.sensors))
        data["innovation"] = ((*axes, "sensor"), innovations, unit)
        if layout.validation is not None:
            errors = self._series("validation_error", len(layout.validation))
            data["validation_error"] = ((*axes, "validation"), errors, unit)
        data["status"] = (axes, self._series("status"), dict(STATUS_FLAGS))
        steps = self._series("steps")
        data["steps"] = (axes, steps.astype(np.int32), {"long_name": "substeps taken"})
        for name, values in self._diagnostics():
            # A diagnostic with the name of an unknown gets a prefix.
            data[f"{NOTE}{name}" if name in data else name] = (axes, values)
        data.attrs["scalars"] = "\n".join(layout.scalars)
        return data

    def _diagnostics(self) -> Iterator[tuple[str, Array]]:
        """Iterate over the diagnostics of the law by name, NaN where a sample has no value."""
        missing = np.full(len(self.members), np.nan)
        for name in dict.fromkeys(chain.from_iterable(row.diagnostics for row in self._rows)):
            yield name, self._table([row.diagnostics.get(name, missing) for row in self._rows])

    def _series(self, name: str, *more: int) -> Array:
        return self._table([getattr(row, name) for row in self._rows], *more)

    def _table(self, values: Any, *more: int) -> Array:
        """Return values of shape (times, members, *more) as (members, times, *more)."""
        return np.swapaxes(np.reshape(values, (len(self._rows), len(self.members), *more)), 0, 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _MemberRow(_Row):
    """Record with `Record.numbers` and, at some samples, the fields."""

    numbers: Array
    profiles: Mapping[str, Array] | None
    correlation: Array | None

    def record(self, k: int) -> Record:
        """Return the record of a member."""
        snapshot = None
        if self.profiles is not None:
            profiles = {name: values[k] for name, values in self.profiles.items()}
            correlation = None if self.correlation is None else self.correlation[k]
            snapshot = Snapshot(profiles, {}, correlation)
        diagnostics = {name: values[k].item() for name, values in self.diagnostics.items()}
        return Record(
            t=self.t,
            numbers=self.numbers[k],
            innovation=self.innovation[k],
            validation_error=self.validation_error[k],
            status=int(self.status[k]),
            steps=int(self.steps[k]),
            notes={name: value for name, value in diagnostics.items() if np.isfinite(value)},
            snapshot=snapshot,
        )


class FleetRecords:
    """Estimates of members that are stepped together, as records of single processes.

    `model`: model whose unknowns are numbers.
    `fields_every`: fields of every `fields_every`-th sample are stored.
    """

    def __init__(self, model: Model, fields_every: int = 1) -> None:
        self.model = model
        self.fields_every = fields_every
        self.size = 0  # count of stored numbers
        self._count = 0
        self._rows: list[_MemberRow] = []

    def add(self, estimate: FleetEstimate) -> None:
        """Add an estimate of all members.

        Raises `ConfigurationError`: members are stepped separately.
        """
        beliefs, profiles, correlation = estimate.beliefs, None, None
        factors = beliefs.factors
        if factors is None:
            raise ConfigurationError("what members do that step separately is kept separately.")
        if self._count % self.fields_every == 0:
            profiles = self._profiles(beliefs.u, factors)
            labels = list(self.model.parameter_space.labels.values())
            correlation = correlation_of(factors.q[:, labels]) if len(labels) > 1 else None
        numbers = self._numbers(beliefs, factors)
        row = _MemberRow.of(estimate, numbers=numbers, profiles=profiles, correlation=correlation)
        self._count += 1
        self._rows.append(row)
        self.size += row.numbers.size + row.innovation.size + row.validation_error.size
        self.size += sum(values.size for values in (profiles or {}).values())

    def records(self, k: int) -> Iterator[Record]:
        """Iterate over the records of a member."""
        return (row.record(k) for row in self._rows)

    def clear(self) -> None:
        """Delete all records, after they have been written."""
        self._rows.clear()
        self.size = 0

    def _numbers(self, beliefs: Beliefs, factors: Factors) -> Array:
        """Return `Record.numbers` of all members, shape (members, numbers)."""
        space, columns = self.model.parameter_space, []
        after, prior = (np.linalg.norm(factor, axis=2) for factor in (factors.q, factors.prior))
        # Remaining share of the prior standard deviation; NaN where the prior has none.
        shares = after / np.where(prior > 0.0, prior, np.nan)
        for label, k in space.labels.items():
            value, std = beliefs.q[:, k], after[:, k]
            ends = interval_ends(label, space.unknown_of(label), value, std)
            columns += [value, std, *ends.values(), shares[:, k]]
        return np.stack(columns, axis=1)

    def _profiles(self, u: Array, factors: Factors) -> dict[str, Array]:
        """Return values and standard deviations of the state, (members, vertices) each."""
        profiles: dict[str, Array] = {}
        members, _, r = factors.u.shape
        order = vertex_order(self.model)
        for name, block in self.model.state_space.fields.items():
            index, names = self.model.state_space.part(name), block.variables(name)
            columns = factors.u[:, index].transpose(1, 0, 2).reshape(-1, members * r)
            # Variances at the vertices are sums of squares of rows of the factor.
            squares = ((block.at_vertices @ columns) ** 2).reshape(-1, members, r).sum(axis=2)
            deviations = np.sqrt(squares)
            for end, values in {"": block.at_vertices @ u[:, index].T, "_std": deviations}.items():
                rows = values.T.reshape(members, len(names), -1)[:, :, order]
                profiles |= {f"{key}{end}": rows[:, c] for c, key in enumerate(names)}
        return profiles
