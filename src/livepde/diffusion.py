"""The sign of the diffusion of a process, u_t = -k u_xx of which is ill-posed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from livepde.fem import Form
from livepde.linalg import Array

Pairing: TypeAlias = Callable[[int, int, float], Array]
"""Numbers of two components, and a value of u -> the factor of both."""
LOWER = ("value", "grad")  # parts of a function up to its first derivatives


def negative_diffusion(M: Form, A: Form, B: Form, prior: Array, component: int) -> bool:
    """Return whether a component has negative diffusion in a direction, on all of the mesh.

    Not where other components or higher derivatives may make up for it, nor for a component
    without a change in time, whose sign is free. `prior`: mean of the unknowns.
    """

    def pairing(of: int, tested: int, u: float) -> Array:
        """Return the factor of two components in A and B."""
        return A.factor(of, tested, u, q=prior) + B.factor(of, tested, u)

    slopes, sign = _owners(M, "grad"), _sign_of_mass(M, component)
    own = [k for k, of in slopes.items() if of == component]
    growing = [k for k in own if sign and _negative(pairing, sign, k)]
    others = [k for k in slopes if k not in own]
    return bool(growing) and not _coupled(M, pairing, growing, others)


def _coupled(M: Form, pairing: Pairing, growing: list[int], others: list[int]) -> bool:
    """Return whether other slopes, or higher derivatives, enter with those that grow."""
    pairs = [(k, k) for k, (_, part) in enumerate(M.owners("u")) if part not in LOWER]
    pairs += [pair for k in growing for j in others for pair in ((k, j), (j, k))]
    return any(pairing(*pair, 1.0).any() for pair in pairs)


def _negative(pairing: Pairing, sign: float, k: int) -> bool:
    """Return whether a diffusivity is negative for small, usual and large values of u."""
    each = (sign * pairing(k, k, u) for u in (0.1, 1.0, 10.0))
    return all(bool((one < 0.0).any() and (one <= 0.0).all()) for one in each)


def _owners(M: Form, part: str) -> dict[int, int]:
    """Return the numbers of values, or of slopes, each with that of its component."""
    return {k: of for k, (of, what) in enumerate(M.owners("u")) if what == part}


def _sign_of_mass(M: Form, component: int) -> float:
    """Return the sign of the mass of all values of a component; 0 if it has none."""
    masses = [M.factor(k, k, 0.0) for k, of in _owners(M, "value").items() if of == component]
    for sign in (1.0, -1.0):
        if all((sign * mass >= 0.0).all() and mass.any() for mass in masses):
            return sign
    return 0.0
