"""Compare the law with its default stopping rule to the same law solved to rounding.

By default `Newton` accepts a predicted stage early, and the next stage corrects the remaining
residual. `livepde.paper.STRICT` solves every stage to 1e-12. Both run on the same data with the
same undivided steps, in settings that barely damp a difference: in two dimensions, with a
diffusivity that vanishes on a part, and with noise that is independent in every coefficient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from livepde.diagnostics.check_report import Check, Table
from livepde.fem import Field, dot, grad, interval, linear, maximum, rectangle
from livepde.identifier import Identifier
from livepde.laws import GradientLaw
from livepde.linalg import Array, Mask
from livepde.model import Model
from livepde.observation import Full, Observation, Subdomain
from livepde.paper import STRICT
from livepde.progress import watched
from livepde.stepping import ImplicitEuler, Newton
from livepde.streams import RelativeNoise, Twin

TIMES = 0.05 * np.arange(101)
CELLS = {1: 30, 2: 8}
PROMISE = 1e-2  # largest difference that the default `Newton.ceiling` allows
TIGHT, KEPT = Newton(ceiling=1e-4), 1e-3  # a tenth of the ceiling and of the allowed difference


@dataclass(frozen=True)
class Square:
    """Setting: dimension, whether D vanishes for x < 1/2, observation, noise level and gain.

    `cells` is the number of cells per side; zero selects the number in `CELLS`.
    """

    d: int = 2
    degenerate: bool = False
    partial: bool = False
    noise: float = 0.0
    gain: float = 100.0
    cells: int = 0

    @property
    def name(self) -> str:
        """Name in tables."""
        kind = "D = 0 for x < 1/2" if self.degenerate else "D = 1"
        seen = "partial" if self.partial else "full"
        size = f", {self.cells} cells" if self.cells else ""
        return f"{self.d}D{size}, {kind}, {seen}, noise {self.noise:.0%}, gain {self.gain:g}"

    def D(self, x: Any) -> Any:
        """Return the diffusivity."""
        return 2.0 * maximum(x[0] - 0.5, 0.0) if self.degenerate else 1.0 + 0.0 * x[0]

    def wave(self, x: Any, k: float) -> Any:
        """Return sin(k pi x), in two dimensions times sin(pi y)."""
        value = np.sin(k * np.pi * x[0])
        return value if self.d == 1 else value * np.sin(np.pi * x[1])

    def build(self) -> tuple[Model, Observation]:
        """Return model and observation."""
        n = self.cells or CELLS[self.d]
        mesh = interval(0.0, 1.0, n) if self.d == 1 else rectangle((0.0, 1.0), (0.0, 1.0), (n, n))
        model = Model(
            Field(mesh, linear(mesh), dirichlet={"boundary": 0.0}),
            Field(mesh, linear(mesh), inner="H1"),
            A=lambda q, u, v, x: q * u * v,
            B=lambda u, v, x: self.D(x) * dot(grad(u), grad(v)),
            f=lambda x, t: (
                15.0 * self.wave(x, 1.0) * (1.0 + 0.5 * np.sin(t))
                + 20.0 * self.wave(x, 2.0) * np.cos(0.7 * t)
            ),
        )
        return model, Subdomain(lambda x: x[0] > 0.3) if self.partial else Full()


@dataclass(frozen=True)
class Apart:
    """Differences between a run and the strict run.

    Attributes
    ----------
    q, u
        Largest |q - strict|, |u - strict| over samples with both ok, over the largest |q|, |u|.
    failed
        Number of failed steps in both runs.
    """

    q: float
    u: float
    failed: int


def apart(setting: Square, newton: Newton | None = None) -> Apart:
    """Run the law with `newton` and strictly, and return the differences."""
    model, observation = setting.build()
    twin = Twin(
        model=model,
        observation=observation,
        scheme=ImplicitEuler(),
        q_true=lambda x: 2.0 + 3.0 * np.sin(np.pi * x[0]) ** 2,
        u0=0.0,
        times=TIMES,
        noise=RelativeNoise(setting.noise) if setting.noise else None,
        seed=0,
    )
    law = GradientLaw(setting.gain, newton=newton or Newton(), gate=None)
    loose, strict = _run(twin, law), _run(twin, replace(law, newton=STRICT))
    ok: Mask = loose[2] & strict[2]
    q, u = (
        float(np.abs(values - exact)[ok].max() / np.abs(exact).max())
        for values, exact in zip(loose[:2], strict[:2], strict=True)
    )
    failed = 2 * len(ok) - int(loose[2].sum()) - int(strict[2].sum())
    return Apart(q, u, failed)


def _run(twin: Twin, law: GradientLaw) -> tuple[Array, Array, Mask]:
    """Return q and u after each sample, and the mask of samples with status ok."""
    identifier = Identifier(twin.model, twin.observation, law, q0=0.0, u0=0.0, halvings=0)
    estimates = [identifier.step(sample.t, sample.z) for sample in twin]
    q, u, ok = zip(*((e.q, e.u, e.status.ok) for e in estimates), strict=True)
    return np.array(q), np.array(u), np.array(ok)


def apart_table(settings: Sequence[Square], progress: bool = False) -> tuple[Table, list[Check]]:
    """Return the table of differences from strict runs, and their checks."""
    shown = watched(settings, len(settings), "against strict") if progress else settings
    rows: list[list[Any]] = []
    for setting in shown:
        default, tight = apart(setting), apart(setting, TIGHT)
        rows.append([setting.name, default.q, default.u, tight.q, tight.u])
        rows[-1].append(default.failed + tight.failed)
    columns = ["setting", "q", "u", "q, ceiling 1e-4", "u, ceiling 1e-4", "failed"]
    table = Table("largest differences from strict solves, relative to |q|, |u|", columns, rows)
    name = f"default against strict, {len(rows)} settings: largest difference of"
    checks = [
        Check(f"{name} {what}{how}", max(float(row[k]) for row in rows), bound, "<=")
        for k, what, how, bound in (
            (1, "q", "", PROMISE),
            (2, "u", "", PROMISE),
            (3, "q", ", ceiling 1e-4", KEPT),
            (4, "u", ", ceiling 1e-4", KEPT),
        )
    ]
    failed = float(sum(row[5] for row in rows))
    return table, [*checks, Check("failed steps, default against strict", failed, 0.0, "<=")]


QUICK = [Square(2, noise=0.01), Square(1, degenerate=True, partial=True, noise=0.01)]
SETTINGS = [
    Square(d, degenerate, partial, noise, gain)
    for d in (1, 2)
    for degenerate in (False, True)
    for partial in (False, True)
    for noise in (0.0, 0.01)
    for gain in (100.0, 1e4)
]
