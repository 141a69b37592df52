"""Layers as a cause of a misfit: a conductivity that changes at places between the sensors.

A step of the conductivity at each of k places has k amplitudes. With the unknowns eliminated, the
columns Z of these steps and the residuals z satisfy S = Z^T P Z, s = Z^T P z (see `LinearModel`),
and the best amplitudes explain s^T S^+ s of the sum of squares z^T P z.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from livepde.linalg import Array, IntArray
from livepde.verdict import Cause
from livepde.verdict.evidence import LinearModel
from livepde.verdict.sentences import clause, quoted

FREE = 0.05  # share of the misfit that each further border has to explain, as `CLOSE` of columns


class Layers(NamedTuple):
    """Possible layers of an unknown conductivity on an interval."""

    name: str  # label of the unknown
    borders: Sequence[float]  # places between the sensors
    ends: tuple[float, float]  # ends of the interval
    columns: IntArray  # columns of the linear model of a step at each border

    def cause(self, model: LinearModel, unit: str) -> Cause:
        """Return the likelier cause of a misfit: two layers, or a border at each place.

        `unit`: unit of length.
        """
        S, s, total = model.left
        excess = max(total - len(model.z), 1e-300)
        choices = [[k] for k in range(len(self.borders))] + [list(range(len(self.borders)))]
        shares = [_explained(S, s, self.columns[k]) / excess - FREE * (len(k) - 1) for k in choices]
        best = int(np.argmax(shares))
        at = [self.borders[k] for k in choices[best]]
        edges = [f"{x:.6g}" for x in (self.ends[0], *at, self.ends[1])]
        layers = [f"layer_{k} = [{a}, {b}]" for k, (a, b) in enumerate(pairwise(edges), 1)]
        regions = f"{{ {', '.join(layers)} }}"
        text, remedy = clause(
            "layers",
            self.name,
            0.0,
            "",
            positive=True,
            at=", ".join(f"{x:.3g}" for x in at),
            unit=unit,
            table=f"`[unknowns.{quoted(self.name)}]`",
            regions=regions,
        )
        setting = f"unknowns.{quoted(self.name)}.regions={regions}"
        share = float(np.clip(shares[best], 0.0, 1.0))
        return Cause("layers", self.name, text, share, remedy, setting)


def _explained(S: Array, s: Array, columns: IntArray) -> float:
    """Return the decrease of the sum of squares by free amplitudes of some columns."""
    own = s[columns]
    inverse = np.linalg.pinv(S[np.ix_(columns, columns)], rcond=1e-9)
    return float(own @ inverse @ own)
