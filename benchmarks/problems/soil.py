"""Soil of the case soil_layers with its measured data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np

from benchmarks.problems.data import Problem, Process
from livepde.cases import load
from livepde.errors import CaseError
from livepde.linalg import Array


@cache
def _process(_: int) -> Process:
    from benchmarks.cases import find_cases

    path = next((path for path in find_cases() if path.stem == "soil_layers"), None)
    if path is None:
        raise CaseError("the folder of cases has no soil_layers.toml.")
    prepared = load(path).prepare()
    identifier = prepared.identifier
    samples = list(prepared.stream)
    names, hidden = identifier.observed.names, prepared.identifier.validation
    rows = [dict(sample.z) for sample in samples]  # type: ignore[arg-type]
    rows = [row | dict(sample.inputs or {}) for row, sample in zip(rows, samples, strict=True)]

    def values(channels: Sequence[str]) -> Array:
        return np.array([[row.get(name, np.nan) for name in channels] for row in rows])

    case = prepared.case
    inputs = values(identifier.inputs)
    for before, row in pairwise(inputs):
        row[np.isnan(row)] = before[np.isnan(row)]
    observation = replace(case.observation, noise=getattr(case.law, "noise", None))
    return Process(
        model=case.model,
        observation=observation,
        times=np.array([sample.t for sample in samples]),
        exact=values(names),
        q_true=None,
        u0=prepared.u0,
        scheme=case.scheme,
        dt_max=case.dt_max,
        inputs=[dict(zip(identifier.inputs, row, strict=True)) for row in inputs.tolist()],
        validation=case.validation,
        hidden=values(hidden.names if hidden else ()),
        assimilate_from=prepared.assimilate_from,
    )


SOIL = Problem(
    name="soil",
    summary="Soil, April 2025: a diffusivity for each layer; scored by a validation sensor",
    make=_process,
    levels=(None,),
)
