"""The equation of a buried pipe whose flow changes: advection, dispersion and heat loss."""

import livepde as lp

AREA, CAPACITY, SOIL = 7.854e-3, 4.1e6, 9.0  # m^2, J/(m^3 K), degC


def pipe(mesh, unknowns, dirichlet):
    """Return u_t + w u_x = D u_xx - K/(c area) (u - T_soil), w = flow/area; the flow in m^3/h."""
    return lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet=dirichlet, unit="degC"),
        parameter=unknowns,
        A=lambda q, u, v, x: (
            q.D * lp.dot(lp.grad(u), lp.grad(v))
            + q.K / (CAPACITY * AREA) * (u - SOIL) * v
            + x.inputs["flow"] / 3600 / AREA * lp.grad(u)[0] * v
        ),
        inputs=["flow"],
        time_unit="s",
    )
