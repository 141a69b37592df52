import livepde as lp


def pipe(mesh, unknowns, dirichlet, area=0.00785398, c_water=4.10228e6, T_soil=9.0):
    # u_t + w u_x = D u_xx - K/(c area) (u - T_soil), w = flow/area; flow in m3/h
    return lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), dirichlet=dirichlet, unit="degC"),
        parameter=unknowns,
        A=lambda q, u, v, x: (
            q.D * lp.dot(lp.grad(u), lp.grad(v))
            + q.K / (c_water * area) * (u - T_soil) * v
            + x.inputs["flow"] / 3600 / area * lp.grad(u)[0] * v
        ),
        inputs=["flow"],
        time_unit="s",
    )
