"""The equation of section 4.1 with a D that varies, vanishes on a part, or is negative on a part.

    u_t - (D u_x)_x + q u = f on (0, 1),   u = 0 at the ends,   z = u on omega = (0.3, 1)

with q* and u* of the excited twin, Q = H^1, q^(0) = 0 and the operators M and N of (MN1), (MN2).

- varying: D = 1 + 0.8 sin(2 pi x).
- degenerate: D = 2 max(x - 1/2, 0), zero on the whole unobserved part and on a part of omega.
- antidiffusion: D = -0.05 outside omega, 1 on it. The true process is ill-posed: its modes in the
  unobserved part grow, and shorter modes grow faster. It cannot be simulated, so the data come from
  the manufactured state u*, which a discrete source makes an exact discrete solution.

Each D is run with nu = 0, 0.1 and 2. The term nu P N P u attracts P u to zero instead of P u*.
Where D >= 0, the dynamics damp p by themselves, and p grows with nu. The error of q does not follow
p: for the varying D, nu = 0.1 improves it and nu = 2 worsens it; for the degenerate D, nu = 2 is
the best of the three. For D < 0 only nu P N P u bounds p, and only for nu > 1, since N has |D|.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from experiments.manufactured import Manufactured
from livepde import paper, plots
from livepde.diagnostics.check_report import Check, Table
from livepde.estimate import Estimate
from livepde.fem import Field, dot, grad, interval, linear
from livepde.laws import ResidualDamping
from livepde.linalg import Array
from livepde.observation import Subdomain
from livepde.progress import watched
from livepde.reproduce.experiment import failures
from livepde.reproduce.seed_excited import q_true, u_true
from livepde.result import Result
from livepde.runs import Outcome
from livepde.stepping import ImplicitEuler
from livepde.streams import Twin

CELLS = 20
OMEGA = 0.3
# Size of p at which a run is stopped; u* is of size 1.
FAILED = 1e3


def omega(x: Any) -> Any:
    """Return whether x is in the observed part of the domain."""
    return x[0] > OMEGA - 1e-9


@dataclass(frozen=True)
class DiffusionCase:
    """Diffusivity D, with the time step h, number of steps, gain and c_1 of its runs."""

    D: Callable[[Any], Any]
    h: float
    steps: int
    gain: float
    c1: float


PROCESSES = {
    "varying": DiffusionCase(lambda x: 1 + 0.8 * np.sin(2 * np.pi * x[0]), 0.02, 500, 1e3, 10.0),
    "degenerate": DiffusionCase(lambda x: 2 * np.maximum(x[0] - 0.5, 0.0), 0.02, 500, 1e3, 10.0),
    # With larger steps, implicit Euler would damp growing modes. This step resolves the growth of
    # every mode: h lambda < 1/2.
    "antidiffusion": DiffusionCase(
        lambda x: np.where(x[0] < OMEGA, -0.05, 1.0), 0.002, 1500, 100.0, 1000.0
    ),
}


@dataclass(frozen=True, eq=False)
class DiffusionRun:
    """Run with errors of q, ||p||_X as `hidden`, ||e||_Q^2/gain + ||r||_X^2 as `energy`."""

    result: Result
    times: Array
    errors: Array
    hidden: Array
    energy: Array
    last: Estimate

    @property
    def failed(self) -> int:
        """Number of failed steps, at most 1: a run ends at its first failed step."""
        return int(not self.last.status.ok)

    @property
    def lost(self) -> bool:
        """True if a step failed or p grew beyond the limit."""
        return bool(self.failed) or bool(self.hidden[-1] > FAILED)


def build(process: DiffusionCase) -> tuple[Manufactured, Subdomain]:
    """Return model and observation."""
    mesh = interval(0, 1, CELLS)
    element = linear(mesh)
    model = Manufactured(
        q_true,
        u_true,
        process.h,
        state=Field(mesh, element, dirichlet={"boundary": 0.0}),
        parameter=Field(mesh, element, inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: process.D(x) * dot(grad(u), grad(v)),
    )
    return model, Subdomain(omega)


def identify(
    process: DiffusionCase, nu: float, what: str = "", progress: bool = False
) -> DiffusionRun:
    """Run the paper's method with one nu; stop when p exceeds the limit."""
    model, sensors = build(process)
    times = process.h * np.arange(process.steps + 1)
    twin = Twin(
        scheme=ImplicitEuler(),
        model=model,
        observation=sensors,
        q_true=q_true,
        u_true=u_true,
        times=times,
        truth="analytic",
    )
    identifier = paper.identifier(
        model,
        sensors,
        gain=process.gain,
        damping=ResidualDamping(process.c1),
        D=process.D,
        nu=nu,
        u0=lambda x: u_true(x, 0.0),
    )
    P = identifier.observed.split().P
    result = Result(model, identifier.observed, None, max(1, process.steps // 100))
    rows: list[tuple[float, float, float, float]] = []
    for k, sample in enumerate(watched(twin, len(twin), what) if progress else twin):
        estimate = identifier.step(sample.t, sample.z)
        result.add(estimate)
        p = model.X.norm(P @ (estimate.u - twin.states[k]))
        rows.append((sample.t, twin.error(estimate.q), p, twin.energy(estimate, process.gain)))
        if not estimate.status.ok or p > FAILED:
            break
    times, errors, hidden, energy = np.array(rows).T
    return DiffusionRun(result, times, errors, hidden, energy, estimate)


def degenerate(*, quick: bool = False, progress: bool = False) -> Outcome:
    """Run each D with every nu, and check the errors.

    Parameters
    ----------
    quick
        Run only the process with the varying D.
    progress
        Show a progress bar for every run.
    """
    courses = {
        (name, nu): identify(process, nu, f"{name}, nu = {nu:g}", progress)
        for name, process in PROCESSES.items()
        if name == "varying" or not quick
        for nu in NUS
    }
    checks = [
        Check(
            f"error of q, {name}, nu = {nu:g}",
            float(courses[name, nu].errors[-1]),
            (expected * (1 - TOLERANCE), expected * (1 + TOLERANCE)),
            "in",
        )
        for (name, nu), expected in EXPECTED.items()
        if (name, nu) in courses
    ]
    plain, better = (float(courses["varying", nu].errors[-1]) for nu in (0.0, 0.1))
    checks.append(Check("error of q, varying: nu = 0.1 over nu = 0", better / plain, HELPS, "<="))
    checks += [
        Check(f"largest |p|, {name}, nu = 0", float(courses[name, 0.0].hidden.max()), BOUNDED, "<=")
        for name in ("varying", "degenerate")
        if (name, 0.0) in courses
    ]
    damped = [course for (name, _), course in courses.items() if name != "antidiffusion"]
    checks.append(failures(damped, ", D >= 0"))
    notes = [
        "Where D >= 0 the process damps p itself and nu > 0 makes p larger; q need not suffer: "
        f"varying, its error is {plain:.3f} with nu = 0, {better:.3f} with nu = 0.1 and "
        f"{courses['varying', NU].errors[-1]:.2f} with nu = {NU:g}.",
        "The part outside of omega is not observed: there the law only extends q smoothly.",
    ]
    shown = courses["varying", NU]
    if not quick:
        shown, lost = courses["antidiffusion", NU], courses["antidiffusion", 0.0]
        checks += _antidiffusion(shown, lost)
        notes.insert(
            0,
            f"Antidiffusion, nu = 0: p grows until the method fails, at t = {lost.times[-1]:.2f}. "
            f"With nu = {NU:g} it stays below {shown.hidden.max():.2f}, to "
            f"t = {shown.times[-1]:g}; it does not vanish, since nu P N P u pulls P u to zero and "
            "not to P u*.",
        )
    return Outcome(
        tables=[_table(courses)],
        checks=checks,
        notes=notes,
        dataset=shown.result.to_xarray(),
        figures={"hidden": partial(_figure, courses)},
    )


def _table(courses: dict[tuple[str, float], DiffusionRun]) -> Table:
    return Table(
        "relative L2 error of q, and the unobserved error p",
        [
            *("D", "nu", "q = 0", "error of q", "largest |p|", "|p| at the end"),
            *("ended at t", "of", "failed"),
        ],
        [
            [
                name,
                nu,
                1.0,
                None if course.lost else float(course.errors[-1]),
                float(course.hidden.max()),
                float(course.hidden[-1]),
                float(course.times[-1]),
                PROCESSES[name].h * PROCESSES[name].steps,
                course.failed,
            ]
            for (name, nu), course in courses.items()
        ],
    )


def _antidiffusion(held: DiffusionRun, lost: DiffusionRun) -> list[Check]:
    """Check that, where D < 0, p is lost with nu = 0 and bounded with the largest nu."""
    return [
        Check("largest |p|, antidiffusion, nu = 0", float(lost.hidden.max()), FAILED, ">="),
        Check(f"largest |p|, antidiffusion, nu = {NU:g}", float(held.hidden.max()), BOUNDED, "<="),
        failures([held], f", antidiffusion, nu = {NU:g}"),
        Check(
            "|e|^2 + |r|^2 at the end over the start, antidiffusion, nu = 2",
            float(held.energy[-1] / held.energy[0]),
            1.0,
            "<=",
        ),
    ]


def _figure(courses: dict[tuple[str, float], DiffusionRun]) -> Any:
    """Plot ||p||_X of all runs over time."""
    drawn, axes = plots.figure()
    series = {f"{n}, nu = {nu:g}": (c.times, c.hidden) for (n, nu), c in courses.items()}
    plots.history(series, ylabel="|p| in X", ax=axes[0])
    return drawn


# Expected results: for each (D, nu) the relative L2 error of q at the end, and bounds on |p|.
# For "varying", the dense implementation in reference.py gives errors against the interpolant of q*
# of 0.1963 with nu = 0 and 0.1160 with nu = 0.1.
NUS = (0.0, 0.1, 2.0)
NU = 2.0
EXPECTED = {
    ("varying", 0.0): 0.198,
    ("varying", 0.1): 0.117,
    ("varying", 2.0): 0.812,
    ("degenerate", 0.0): 0.213,
    ("degenerate", 0.1): 0.210,
    ("degenerate", 2.0): 0.179,
    ("antidiffusion", 2.0): 0.799,
}
TOLERANCE = 0.02
HELPS = 0.65
BOUNDED = 1.0
