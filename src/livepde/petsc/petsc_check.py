"""Check of a `PetscModel`: derivatives against differences, transposes, inner products."""

from __future__ import annotations

from typing import Any

from livepde.diagnostics import Check, CheckReport
from livepde.errors import ModelError
from livepde.petsc.petsc_model import PetscModel
from livepde.petsc.vectors import free_mask, random_vector, zeros

STEP = 1e-6  # of the differences, relative
CLOSE = 1e-5  # to a derivative, of a central difference with such a step
ROUNDING = 1e-10


def check_petsc_model(
    model: PetscModel, u: Any, q: Any, t: float = 0.0, w: Any = None, *, seed: int = 1
) -> CheckReport:
    """Check what the laws rely on, at a point u, q, t, in random directions.

    With data w on omega it is what `PetscObserver` relies on, without what `PetscFilter` does.
    """
    du = random_vector(u, model.numbers_u, seed) * free_mask(u, model.fixed)
    dq = random_vector(q, model.numbers_q, seed + 1)
    # Directions as large as u and q keep relative differences well scaled.
    for direction, at in ((du, u), (dq, q)):
        direction.scale((at.norm() or 1.0) / (direction.norm() or 1.0))
    v = random_vector(u, model.numbers_u, seed + 2)
    S, A = model.jacobian_u(u, q, t, w), model.jacobian_q(u, q, t, w)
    slope, driven, back = zeros(u) if S is None else S * du, A * dq, zeros(q)
    A.multTranspose(v, back)
    by_u = model.residual(u + du * STEP, q, t, w) - model.residual(u - du * STEP, q, t, w)
    by_q = model.residual(u, q + dq * STEP, t, w) - model.residual(u, q - dq * STEP, t, w)
    wrong = "The matrix has to be the derivative of the residual."
    exchanged = "An inner product must be symmetric and positive."
    size = driven.norm() * v.norm()
    found = [
        ("dF/du as differences", _apart(by_u / (2.0 * STEP), slope), CLOSE, wrong),
        ("dF/dq as differences", _apart(by_q / (2.0 * STEP), driven), CLOSE, wrong),
    ]
    odd = abs(driven.dot(v) - dq.dot(back)) / (size or 1.0)
    transposed = "multTranspose has to be the transpose of mult."
    found.append(("(A q, v) = (q, A^T v)", odd, ROUNDING, transposed))
    named = (("M", model.mass, du, v), ("M_op", model.pull, du, v), ("G_Q", model.gram, dq, back))
    for name, matrix, a, b in named:
        size = (matrix * a).norm() * b.norm() or 1.0
        odd = abs((matrix * a).dot(b) - (matrix * b).dot(a)) / size
        found.append((f"{name} = {name}^T", odd, ROUNDING, exchanged))
        found.append((f"-(x, {name} x)", -float((matrix * a).dot(a)), 0.0, exchanged))
    if w is not None:
        once = model.residual(u, q + dq, t, w) - model.residual(u, q, t, w)
        twice = model.residual(u, q + dq * 2.0, t, w) - model.residual(u, q + dq, t, w)
        remedy = "The paper's law needs F affine in q: use PetscFilter."
        found.append(("F affine in q", _apart(once, twice), ROUNDING, remedy))
    lines = tuple(Check.at_most(*line) for line in found)
    return CheckReport("PETSc model", lines, ModelError)


def _apart(a: Any, b: Any) -> float:
    """Return the relative difference of two vectors."""
    return float((a - b).norm()) / (max(float(a.norm()), float(b.norm())) or 1.0)
