"""Spherical diffusion of lithium in a particle of a battery electrode."""

from __future__ import annotations

from typing import Any

from numpy import exp

from livepde.errors import ModelError, require_positive
from livepde.fem import Field, On, Place, Unknown, dot, grad, linear
from livepde.model import Model
from livepde.models.description import Equation, Option, Variable, by_name

FARADAY = 96485.33212  # C/mol


def battery_particle(
    mesh: Any,
    D: Unknown,
    slope: Unknown | None = None,
    *,
    area: float,
    c_max: float,
    element: Any = None,
) -> Model:
    """Return r^2 c_t = (D(c) r^2 c_r)_r in a sphere that is charged by a current I(t).

    This is the single-particle model of an electrode: one particle represents all particles, and
    the current is distributed evenly over their surface,

        -D(c) c_r = I/(F area)  at the surface,      D(c) = D exp(slope (c/c_max - 1/2)).

    The current in A is the input channel "I"; I > 0 extracts lithium, as in the negative electrode
    during discharge. The state at the right end of the mesh is the concentration at the surface. A
    voltage is a function of it, see `livepde.observation.Calibrated`.

    Parameters
    ----------
    mesh
        Radius in m, from 0 ("left") to the surface ("right"), with cells of size sqrt(D h) at the
        surface for time steps h.
    D
        Diffusivity of lithium at half filling in m^2/s. It is positive, so use `LogNormal`.
    slope
        Derivative of the logarithm of the diffusivity by the filling; default 0, a constant D.
    area
        Total surface of all particles in m^2: 3/R times their volume.
    c_max
        Concentration of the full particle in mol/m^3.
    element
        See `heat`.

    Raises
    ------
    ModelError
        area or c_max is not positive, or the mesh does not start at 0.

    Examples
    --------
    >>> import livepde as lp
    >>> D = lp.LogNormal(1e-14, 1e-14)
    >>> model = battery_particle(lp.interval(0.0, 1e-5, 40), D, area=1.0, c_max=30000.0)
    >>> model.channels
    ('I',)
    """
    for name, value in {"area": area, "c_max": c_max}.items():
        require_positive(f"battery_particle: {name}", value, ModelError)
    if abs(float(mesh.p.min())) > 1e-9 * float(mesh.p.max()):
        raise ModelError(
            f"battery_particle: the mesh begins at {float(mesh.p.min()):g} m; a particle begins at "
            "its centre, 0."
        )
    R = float(mesh.p.max())
    unknowns = {"D": D} if slope is None else {"D": D, "slope": slope}

    # The scaled weight is of order one, so that matrices are well scaled.
    def shell(x: Any) -> Any:
        return (x[0] / R) ** 2

    def diffusion(q: Any, c: Any, v: Any, x: Place) -> Any:
        mobility = q.D if slope is None else q.D * exp(q.slope * (c / c_max - 0.5))
        return mobility * dot(grad(c), grad(v))

    return Model(
        Field(mesh, element or linear(mesh), unit="mol/m^3", weight=shell),
        unknowns,
        A=diffusion,
        f=On("right", lambda x, _: -x.inputs["I"] / (FARADAY * area)),
        inputs={"I": "A"},
        **BATTERY_PARTICLE.about(),
    )


BATTERY_PARTICLE = Equation(
    name="battery_particle",
    summary="spherical diffusion of lithium in a particle of an electrode",
    formula="r^2 c_t = (D(c) r^2 c_r)_r,  D(c) = D exp(slope (c/c_max - 1/2)),  "
    "-D(c) c_r = I/(F area) at the surface",
    state=Variable("mol/m^3", "concentration of lithium"),
    unknowns={
        "D": Variable("m^2/s", "diffusivity at half filling"),
        "slope": Variable("", "growth of the logarithm of D with the filling", optional=True),
    },
    inputs={"I": Variable("A", "current, positive when lithium leaves the particle")},
    options={
        "area": Option("m^2", "surface of all particles"),
        "c_max": Option("mol/m^3", "concentration of the full particle"),
    },
    build=by_name(battery_particle, "is fed by the input I"),
    element=linear,
)
