"""Test of the sign of the diffusion: u_t = -k u_xx is ill-posed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from livepde.fem import Form
from livepde.linalg import Array

Pairing: TypeAlias = Callable[[int, int, float], Array]
"""(index, index, value of u) -> the factor of a pair of values or slopes in a form."""
LOWER = ("value", "grad")  # values and first derivatives


def negative_diffusion(M: Form, A: Form, B: Form, prior: Array, component: int) -> bool:
    """Return whether a component has negative diffusion in a direction, on the whole mesh.

    False if other components or higher derivatives may compensate for it, and for a component
    without a mass term, whose sign is arbitrary. `prior`: mean of the unknowns.
    """

    def pairing(trial: int, tested: int, u: float) -> Array:
        """Return the factor of a pair in A and B."""
        return A.factor(trial, tested, u, q=prior) + B.factor(trial, tested, u)

    slopes, sign = _owners(M, "grad"), _sign_of_mass(M, component)
    of_component = [k for k, trial in slopes.items() if trial == component]
    negative = [k for k in of_component if sign and _negative(pairing, sign, k)]
    others = [k for k in slopes if k not in of_component]
    return bool(negative) and not _coupled(M, pairing, negative, others)


def _coupled(M: Form, pairing: Pairing, negative: list[int], others: list[int]) -> bool:
    """Return whether the growing slopes are coupled to others, or there are higher derivatives."""
    pairs = [(k, k) for k, (_, part) in enumerate(M.owners("u")) if part not in LOWER]
    pairs += [pair for k in negative for j in others for pair in ((k, j), (j, k))]
    return any(pairing(*pair, 1.0).any() for pair in pairs)


def _negative(pairing: Pairing, sign: float, k: int) -> bool:
    """Return whether a diffusivity is negative for small, moderate and large values of u."""
    factors = (sign * pairing(k, k, u) for u in (0.1, 1.0, 10.0))
    return all(bool((factor < 0.0).any() and (factor <= 0.0).all()) for factor in factors)


def _owners(M: Form, part: str) -> dict[int, int]:
    """Return index of a value (`part` "value") or slope ("grad") -> index of its component."""
    return {k: component for k, (component, kind) in enumerate(M.owners("u")) if kind == part}


def _sign_of_mass(M: Form, component: int) -> float:
    """Return the sign of the mass of all values of a component; 0 if it has none."""
    masses = [M.factor(k, k, 0.0) for k, of in _owners(M, "value").items() if of == component]
    for sign in (1.0, -1.0):
        if all((sign * mass >= 0.0).all() and mass.any() for mass in masses):
            return sign
    return 0.0
