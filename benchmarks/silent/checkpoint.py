"""A checkpoint is accepted by the problem that saved it, and refused by every other problem.

Two problems differ if their models, priors, sensors, options or initial states differ; a problem
rebuilt from the same numbers is the same problem.
"""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from typing import Any

import numpy as np

import livepde as lp
from livepde.diagnostics.check_report import Check
from livepde.errors import RunError
from livepde.fleet import Shard

OTHERS: Mapping[str, Mapping[str, Any]] = {
    "three times the conductivity": {"factor": 3.0},
    "a boundary value": {"left": 1.01},
    "a tenth of the prior's deviation": {"std": 0.005},
    "another prior mean": {"mean": 0.11},
    "a sensor 1 cm off": {"place": 0.51},
    "another noise": {"noise": 0.02},
    "another gate": {"gate": 4.0},
    "another dt_max": {"dt_max": 0.05},
    "another scheme": {"scheme": lp.ImplicitEuler()},
    "another u0": {"u0": 0.1},
}


def _parts(
    *,
    factor: float = 1.0,
    left: float = 1.0,
    mean: float = 0.1,
    std: float = 0.05,
    place: float = 0.5,
    noise: float = 0.01,
    gate: float = 8.0,
    u0: float = 0.0,
    **options: Any,
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    mesh = lp.interval(0.0, 1.0, 20)
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh), dirichlet={"left": left}),
        {"k": lp.LogNormal(mean, std=std)},
        A=lambda q, u, v, x: factor * q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    law = lp.SensitivityLaw(gate=gate)
    return (model, lp.Points({"T": place}, noise=noise), law), {"u0": u0, **options}


def _rod(**changed: Any) -> lp.Identifier:
    positional, options = _parts(**changed)
    return lp.Identifier(*positional, **options)


def _refuses(load: Any, content: bytes) -> bool:
    try:
        load(content)
    except RunError:
        return True
    return False


def _samples() -> list[tuple[float, list[float]]]:
    return [(0.1 * k, [0.05 * k]) for k in range(1, 11)]


def checks() -> list[Check]:
    """Return the checks of checkpoints, shards and pickled results."""
    original = _rod()
    result = original.run(_samples())
    saved = original.dump()
    loaded = [
        name for name, changed in OTHERS.items() if not _refuses(_rod(**changed).restore, saved)
    ]
    rebuilt = _rod()
    rebuilt.restore(saved)
    expected, actual = original.step(1.1, [0.55]), rebuilt.step(1.1, [0.55])
    error = np.abs(np.concatenate([actual.q - expected.q, actual.u - expected.u])).max()
    near = _rod(factor=1.0 + 1e-12, left=1.0 - 1e-12)
    read = pickle.loads(pickle.dumps(result))
    same = read.to_xarray().identical(result.to_xarray())
    return [
        Check(f"checkpoints of {len(OTHERS)} other problems that are loaded", len(loaded), 0, "<="),
        Check("shards of other problems that are loaded", _shards(), 0, "<="),
        Check("the same problem built again: difference of the next estimate", error, 0.0, "<="),
        Check("sums that round differently are refused", _refuses(near.restore, saved), 0, "<="),
        Check("a result that was pickled has another dataset", not same, 0, "<="),
    ]


def _shards() -> int:
    (model, sensors, law), options = _parts()
    shard = Shard(model, sensors, law, ["a", "b"], **options)
    shard.step(0, [("a", *sample) for sample in _samples()])
    saved, loaded = shard.dump(), 0
    for changed in OTHERS.values():
        (model, sensors, law), options = _parts(**changed)
        loaded += not _refuses(Shard(model, sensors, law, ["a", "b"], **options).load, saved)
    return loaded
