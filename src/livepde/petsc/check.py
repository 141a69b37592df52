"""Check of a `PetscModel`: derivatives against differences, transposes, Dirichlet values."""

from __future__ import annotations

from typing import Any

from livepde.diagnostics import CheckLine, CheckReport
from livepde.errors import ModelError
from livepde.petsc.model import PetscModel
from livepde.petsc.vectors import free_mask, random_vector

__all__ = ["check_petsc_model"]

STEP = 1e-6  # of the differences, relative
CLOSE = 1e-5  # to a derivative, of a central difference with such a step
ROUNDING = 1e-10


def check_petsc_model(
    model: PetscModel, u: Any, q: Any, t: float = 0.0, w: Any = None, *, seed: int = 1
) -> CheckReport:
    """Check what the laws rely on, at a point.

    Parameters
    ----------
    model
        The process.
    u, q
        State and parameter, shapes (n,) and (m,).
    t
        Time.
    w
        Data on omega: with them checked as `PetscObserver` uses it, without as `PetscFilter` does.
    seed
        Of the random directions.
    """
    du = random_vector(u, model.numbers_u, seed)
    du.pointwiseMult(du, free_mask(u, model.fixed))
    dq = random_vector(q, model.numbers_q, seed + 1)
    for direction, at in ((du, u), (dq, q)):
        direction.scale((at.norm() or 1.0) / (direction.norm() or 1.0))
    v = random_vector(u, model.numbers_u, seed + 2)
    slope, A = model.jacobian_u(u, q, t, w), model.jacobian_q(u, q, t, w)
    changes = {
        "dF/du": (_difference(model, (u, q, t, w), du, 0), None if slope is None else slope * du),
        "dF/dq": (_difference(model, (u, q, t, w), dq, 1), A * dq),
    }
    lines = [
        CheckLine.at_most(
            f"{name} as differences",
            _relative(expected, found, model.mass * du),
            CLOSE,
            f"The matrix of {name} has to be the derivative of the residual.",
        )
        for name, (expected, found) in changes.items()
    ]
    back = q.duplicate()
    A.multTranspose(v, back)
    product = float((A * dq).dot(v))
    size = (A * dq).norm() * v.norm() or 1.0
    lines += [
        CheckLine.at_most(
            "(A q, v) = (q, A^T v)",
            abs(product - float(dq.dot(back))) / size,
            ROUNDING,
            "multTranspose has to be the transpose of mult.",
        ),
        *_inner_products(model, du, v, dq, back),
    ]
    if w is not None:
        lines.append(_affine(model, (u, q, t, w), dq))
    return CheckReport("PETSc model", tuple(lines), ModelError)


def _inner_products(model: PetscModel, x: Any, y: Any, p: Any, r: Any) -> list[CheckLine]:
    """Return lines on symmetry and positivity of M, G_Q and the integrals over omega."""
    lines = []
    named = (("M", model.mass, x, y), ("M_op", model.pull, x, y), ("G_Q", model.gram, p, r))
    for name, matrix, a, b in named:
        both = float((matrix * a).dot(b)), float((matrix * b).dot(a))
        size = (matrix * a).norm() * b.norm() or 1.0
        lines.append(
            CheckLine.at_most(
                f"{name} = {name}^T",
                abs(both[0] - both[1]) / size,
                ROUNDING,
                "An inner product must not change when its arguments are exchanged.",
            )
        )
        lines.append(
            CheckLine.at_least(
                f"{name} >= 0",
                float((matrix * a).dot(a)) / ((matrix * a).norm() * a.norm() or 1.0),
                0.0,
                "An inner product must not be negative.",
            )
        )
    return lines


def _affine(model: PetscModel, at: tuple[Any, Any, float, Any], dq: Any) -> CheckLine:
    """Return the line on F being affine in q, on which the paper's law relies."""
    u, q, t, w = at
    once = model.residual(u, q + dq, t, w) - model.residual(u, q, t, w)
    twice = model.residual(u, q + dq * 2.0, t, w) - model.residual(u, q + dq, t, w)
    remedy = "The paper's law needs F affine in q: use PetscFilter."
    return CheckLine.at_most("F affine in q", _relative(once, twice, once), ROUNDING, remedy)


def _difference(
    model: PetscModel, at: tuple[Any, Any, float, Any], direction: Any, which: int
) -> Any:
    """Return the central difference of F in u or q."""
    sides = []
    for sign in (1.0, -1.0):
        u, q, t, w = at
        shift = direction * (sign * STEP)
        moved = (u + shift, q) if which == 0 else (u, q + shift)
        sides.append(model.residual(*moved, t, w))
    return (sides[0] - sides[1]) / (2.0 * STEP)


def _relative(expected: Any, found: Any, scale: Any) -> float:
    """Return the relative difference; None stands for zero."""
    if found is None:
        return float(expected.norm()) / float(scale.norm() or 1.0)
    return float((expected - found).norm()) / float(found.norm() or expected.norm() or 1.0)
