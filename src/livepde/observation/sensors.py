"""Sensors: values at points, averages over regions, and any matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import ObservationError
from livepde.fem import FieldBlock, FunctionSpace, Predicate
from livepde.observation.base import Direct, Observation

__all__ = ["Averages", "Matrix", "Points"]


@dataclass(frozen=True, eq=False)
class Points(Observation):
    """Point sensors, z_k = u(x_k).

    Parameters
    ----------
    points
        Positions: a sequence, or a mapping from sensor name to position. In 1D numbers, else
        sequences of d coordinates.
    direct
        Sensor name -> (q, x) for sensors that see a parameter directly, linear in q:
        z_k = u(x_k) + direct(q, x), as in {"T_fluid": lambda q, x: q.R_b * x.inputs["Q"] / H}.
    of
        Component of the state; may be left out if it has only one.

    >>> Points({"TS_10": 0.10, "TS_20": 0.20}, noise=0.1, unit="degC").names(2)
    ('TS_10', 'TS_20')
    """

    points: Mapping[str, Any] | Sequence[Any]
    direct: Mapping[str, Direct] = field(default_factory=dict)
    of: str = ""

    def __post_init__(self) -> None:
        if len(self.points) == 0:
            raise ObservationError("Points: give at least one position.")

    def names(self, count: int) -> tuple[str, ...]:
        if isinstance(self.points, Mapping):
            return tuple(self.points)
        return super().names(count)

    @property
    def directs(self) -> Mapping[str, Direct]:
        return self.direct

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        mapping = isinstance(self.points, Mapping)
        positions = list(self.points.values()) if isinstance(self.points, Mapping) else self.points
        array = np.array([np.atleast_1d(p) for p in positions], dtype=float).T
        what = f"sensors {list(self.points)}: number" if mapping else "sensor"
        return state.probe(array, what, self.of)


@dataclass(frozen=True, eq=False)
class Averages(Observation):
    """Mean values over regions, z_k = (integral of u over omega_k) / |omega_k|.

    Parameters
    ----------
    regions
        Sensor name -> predicate on x, evaluated at the quadrature points of the mesh.
    of
        Component of the state; may be left out if it has only one.
    """

    regions: Mapping[str, Predicate]
    of: str = ""

    def __post_init__(self) -> None:
        if not self.regions:
            raise ObservationError("Averages: give at least one region.")

    def names(self, count: int) -> tuple[str, ...]:
        return tuple(self.regions)

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        block, _ = state.component(self.of)
        rows = [self._row(block, name, region) for name, region in self.regions.items()]
        return state.widen(sp.csr_array(np.array(rows)), self.of)

    @staticmethod
    def _row(state: FieldBlock, name: str, region: Predicate) -> Any:
        basis = state.basis
        weights = region(np.asarray(basis.global_coordinates())) * basis.dx
        size = float(weights.sum())
        if size <= 0:
            raise ObservationError(f"Averages: region '{name}' holds no part of the mesh.")
        row = np.zeros(state.size)
        for i in range(basis.Nbfun):
            phi = np.asarray(basis.basis[i][0])
            np.add.at(row, state.element_dofs[i], (phi * weights).sum(axis=-1))
        return row / size


@dataclass(frozen=True, eq=False)
class Matrix(Observation):
    """Any linear observation, given by its matrix G on the coefficients of the state.

    Parameters
    ----------
    G
        Shape (sensors, n), dense or sparse.
    labels
        A name for each row.
    """

    G: Any
    labels: Sequence[str] | None = None

    def names(self, count: int) -> tuple[str, ...]:
        if self.labels is None:
            return super().names(count)
        if len(self.labels) != count:
            raise ObservationError(f"Matrix: {len(self.labels)} labels for {count} rows.")
        return tuple(self.labels)

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        given: Any = self.G if sp.issparse(self.G) else np.atleast_2d(self.G)
        matrix = sp.csr_array(given)
        if matrix.shape[1] != state.dim:
            raise ObservationError(
                f"Matrix: G has {matrix.shape[1]} columns; the state has {state.dim} coefficients."
            )
        return matrix
