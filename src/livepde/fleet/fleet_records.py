"""Records of the estimates of a fleet: for each member as those of a single run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from livepde.errors import ConfigurationError
from livepde.fleet.engines import Beliefs, Factors
from livepde.fleet.estimate import FleetEstimate
from livepde.linalg import Array
from livepde.model import Model
from livepde.records import STATUS_CODES, Record, Snapshot
from livepde.result import interval_ends, vertex_order


@dataclass(frozen=True, eq=False, kw_only=True)
class _MemberRow:
    """Record of an estimate, each array over members."""

    t: float
    numbers: Array
    innovation: Array
    withheld_error: Array
    status: Sequence[int]
    steps: Sequence[int]
    diagnostics: Mapping[str, Sequence[float]]
    profiles: Mapping[str, Array] | None
    correlation: Array | None

    def record(self, k: int) -> Record:
        """Return the record of a member."""
        snapshot = None
        if self.profiles is not None:
            profiles = {name: values[k] for name, values in self.profiles.items()}
            correlation = None if self.correlation is None else self.correlation[k]
            snapshot = Snapshot(profiles, {}, correlation)
        diagnostics = {name: values[k] for name, values in self.diagnostics.items()}
        return Record(
            t=self.t,
            numbers=self.numbers[k],
            innovation=self.innovation[k],
            withheld_error=self.withheld_error[k],
            status=self.status[k],
            steps=self.steps[k],
            notes={name: value for name, value in diagnostics.items() if np.isfinite(value)},
            snapshot=snapshot,
        )


class FleetRecords:
    """Estimates of members that step together, as `Result` keeps those of one.

    Parameters
    ----------
    model
        Whose unknowns are numbers.
    fields_every
        Fields of every so many samples are kept.
    """

    def __init__(self, model: Model, fields_every: int = 1) -> None:
        self.model = model
        self.fields_every = fields_every
        self.size = 0  # numbers that wait
        self._count = 0
        self._rows: list[_MemberRow] = []

    def add(self, estimate: FleetEstimate) -> None:
        """Add one estimate of all members.

        Raises
        ------
        ConfigurationError
            Members step separately: each has an `Estimate` of its own.
        """
        beliefs, profiles, correlation = estimate.beliefs, None, None
        factors = beliefs.factors
        if factors is None:
            raise ConfigurationError("what members do that step separately is kept separately.")
        if self._count % self.fields_every == 0:
            profiles, correlation = self._profiles(beliefs.u, factors), self._correlation(factors)
        row = _MemberRow(
            t=estimate.t,
            numbers=self._numbers(beliefs, factors),
            innovation=estimate.innovation,
            withheld_error=estimate.withheld_error,
            status=[STATUS_CODES.index(status.code) for status in estimate.statuses],
            steps=estimate.steps.tolist(),
            diagnostics={
                name: values.tolist() for name, values in estimate.diagnostics.named().items()
            },
            profiles=profiles,
            correlation=correlation,
        )
        self._count += 1
        self._rows.append(row)
        self.size += row.numbers.size + row.innovation.size + row.withheld_error.size
        self.size += sum(values.size for values in (profiles or {}).values())

    def records(self, k: int) -> Iterator[Record]:
        """Iterate over the records of a member."""
        return (row.record(k) for row in self._rows)

    def clear(self) -> None:
        """Drop the rows, once they are written."""
        self._rows.clear()
        self.size = 0

    def _numbers(self, beliefs: Beliefs, factors: Factors) -> Array:
        """Return `Record.numbers` of all members, shape (members, numbers)."""
        space, columns = self.model.parameter_space, []
        after, before = (np.linalg.norm(factor, axis=2) for factor in (factors.q, factors.prior))
        # Share of the prior standard deviation that remains; NaN where the prior had none.
        shares = after / np.where(before > 0.0, before, np.nan)
        for label, k in space.labels.items():
            value, std = beliefs.q[:, k], after[:, k]
            ends = interval_ends(label, space.unknown_of(label), value, std)
            columns += [value, std, *ends.values(), shares[:, k]]
        return np.stack(columns, axis=1)

    def _profiles(self, u: Array, factors: Factors) -> dict[str, Array]:
        """Return values and standard deviations of the state, (members, vertices) each."""
        found: dict[str, Array] = {}
        members, _, r = factors.u.shape
        order = vertex_order(self.model)
        for name, block in self.model.state_space.fields.items():
            part, names = self.model.state_space.part(name), block.variables(name)
            columns = factors.u[:, part].transpose(1, 0, 2).reshape(-1, members * r)
            # Variances at the vertices: sums of squares of the rows of the factor there.
            squares = ((block.at_vertices @ columns) ** 2).reshape(-1, members, r).sum(axis=2)
            deviations = np.sqrt(squares)
            for end, values in {"": block.at_vertices @ u[:, part].T, "_std": deviations}.items():
                rows = values.T.reshape(members, len(names), -1)[:, :, order]
                found |= {f"{key}{end}": rows[:, c] for c, key in enumerate(names)}
        return found

    def _correlation(self, factors: Factors) -> Array | None:
        """Return how the estimates of numbers are correlated, (members, numbers, numbers)."""
        labels = list(self.model.parameter_space.labels.values())
        if len(labels) < 2:
            return None
        rows = factors.q[:, labels]
        size = np.linalg.norm(rows, axis=2)
        unit = rows / np.where(size > 0.0, size, 1.0)[:, :, None]
        correlation: Array = unit @ unit.transpose(0, 2, 1)
        return correlation
