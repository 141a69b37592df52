"""Damped wave equation w_tt + d w_t = div(c^2 grad w), as a first-order system in time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from livepde.errors import ModelError
from livepde.fem import Field, Unknown, dot, grad, linear
from livepde.model import Model, Source
from livepde.models.description import Equation, Variable, by_name


def wave(
    mesh: Any,
    c2: Unknown,
    d: Unknown | float = 0.0,
    dirichlet: Mapping[str, Any] | None = None,
    velocity: Mapping[str, Any] | None = None,
    *,
    f: Source = 0.0,
    element: Any = None,
) -> Model:
    """Return w_tt + d w_t - div(c^2 grad w) = f, with unknown squared speed c^2 and damping d.

    The state has two components, the displacement w and its velocity p:

        w_t = p,    p_t + d p - div(c^2 grad w) = f.

    Use the scheme `Alexander2`: implicit Euler damps waves strongly.

    Parameters
    ----------
    mesh
        Any mesh of scikit-fem, or `livepde.interval(...)`; coordinates in m.
    c2
        Squared speed in m^2/s^2: a number, a `Piecewise`, or a `Field`.
    d
        Damping in 1/s: a number or an unknown.
    dirichlet
        Mapping from boundary to the value of w: a number, a function g(x, t), or a `Channel`. Other
        boundaries are free ends.
    velocity
        Mapping from boundary to the value of p where w changes in time: its time derivative.
    f
        Force per mass: a number or f(x, t).
    element
        Element of both components; default of first order.

    Raises
    ------
    ModelError
        A boundary value of w may change in time, but its velocity is not given.

    Examples
    --------
    >>> import livepde as lp
    >>> model = wave(lp.interval(0, 1, 20), lp.Normal(1.0, 0.3), dirichlet={"left": 0.0})
    >>> list(model.state_space.blocks)
    ['w', 'p']
    """
    held, moved = dict(dirichlet or {}), dict(velocity or {})
    for name, value in held.items():
        if name not in moved:
            if not isinstance(value, int | float):
                raise ModelError(
                    f"wave: w on '{name}' may move; give its time derivative, too: "
                    f"velocity={{'{name}': ...}}."
                )
            moved[name] = 0.0
    element = element or linear(mesh)
    known = isinstance(d, int | float)
    level = float(d) if isinstance(d, int | float) else 0.0

    def stiffness(q: Any, u: Any, v: Any, x: Any) -> Any:
        return q.c2 * dot(grad(u.w), grad(v.p))

    # First-order form: implicit one-step schemes and the laws need a single time derivative.
    return Model(
        {
            "w": Field(mesh, element, dirichlet=held, unit="m"),
            "p": Field(mesh, element, dirichlet=moved, unit="m/s"),
        },
        {"c2": c2} if isinstance(d, int | float) else {"c2": c2, "d": d},
        A=stiffness if known else lambda q, u, v, x: stiffness(q, u, v, x) + q.d * u.p * v.p,
        B=lambda u, v, x: -u.p * v.w + level * u.p * v.p,
        f={"p": f},
        time_unit="s",
        length_unit="m",
        formula=WAVE.written(),
    )


WAVE = Equation(
    name="wave",
    summary="waves with damping; unknown squared speed and damping",
    formula="w_tt + d w_t = div(c2 grad w), with the velocity p = w_t",
    state=Variable("m", "displacement"),
    unknowns={
        "c2": Variable("m^2/s^2", "squared speed: a number, by region, or a field"),
        "d": Variable("1/s", "damping"),
    },
    build=by_name(wave),
    element=linear,
    components=("w", "p"),
)
