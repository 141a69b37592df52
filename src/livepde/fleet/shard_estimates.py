"""Estimates of a batch of samples, a row for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from livepde.errors import optional
from livepde.fem import FunctionSpace
from livepde.fleet.estimate import FleetEstimate
from livepde.linalg import Array

if TYPE_CHECKING:
    import pyarrow as pa

REFUSED = "refused"


@dataclass(frozen=True, eq=False)
class ShardEstimates:
    """Estimates of the samples of a batch, in its order.

    Attributes
    ----------
    offset
        Place of the first sample in the log.
    member, t
        Name of the member, and time as it was given, of each sample, shape (samples,).
    q, q_std
        Coefficients of the parameter and their standard deviations, shape (samples, m); NaN in rows
        that were refused, and where the law has no covariance.
    innovation
        Measured minus predicted values, shape (samples, sensors).
    status
        "ok", "refused", or why the step failed, as `Status.code`.
    message
        Sentences on samples that were refused and steps that failed; else empty.
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
        """Return rows of NaN for samples (member, t, ...)."""
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
        """Mark a sample that was not taken."""
        self.status[row], self.message[row] = REFUSED, message

    def put(self, rows: Sequence[int], estimate: FleetEstimate) -> None:
        """Fill in the rows of samples that were stepped as a block."""
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
        """Return an Arrow table: offset, member, t, status, message, and numbers.

        Each scalar unknown has a column of its name and one with "_std", each sensor one called
        "innovation NAME". Where an unknown is a field, `q` and `q_std` are columns of lists.

        Raises
        ------
        ConfigurationError
            pyarrow is not installed.
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
        # Without rows Arrow cannot tell the type of a list.
        texts = dict.fromkeys(("member", "status", "message"), pa.string())
        return pa.table(
            {name: pa.array(values, texts.get(name)) for name, values in columns.items()}
        )


def _time(value: object) -> float:
    """Return a time, NaN if it is none: the sample is refused."""
    return float(value) if isinstance(value, int | float | np.number) else np.nan
