"""Heat a room behind a wall of unknown layers: warm by day, at the lowest energy cost."""

import numpy as np

import livepde as lp
import livepde.control as ct

HOUR, PERIOD, POWER, COLD = 3600.0, 1800.0, 40.0, 8.0  # s, s, W for each m^2 of wall, degC
# End in m, data-sheet conductivity in W/(m K), heat capacity in J/(m^3 K). The room is a layer that
# conducts so well that it has one temperature; the air film has almost no heat capacity.
LAYERS = {
    "room": (0.02, 10.0, 6e5),
    "film": (0.03, 0.08, 1.2e3),
    "masonry": (0.23, 0.8, 1.6e6),
    "insulation": (0.28, 0.06, 5e4),
    "render": (0.36, 0.9, 1.6e6),
}
ENDS, SHEET, CAPACITY = np.array([*LAYERS.values()]).T
WALL = ["masonry", "insulation", "render"]
TRUE = {"masonry": 1.4, "insulation": 1.7, "render": 1.0}  # conductivities over data sheets


def layer(x, name):
    """Return 1 in a layer, 0 elsewhere."""
    return np.searchsorted(ENDS, x[0], side="right") == [*LAYERS].index(name)


def each(x, values, names=tuple(LAYERS)):
    """Return a function of x that is constant in each layer."""
    return sum(value * layer(x, name) for name, value in zip(names, values, strict=True))


def room(cells: int) -> lp.Model:
    """Return room and wall; the wall's conductivities over the data sheets are unknown."""
    nodes = [np.linspace(a, b, cells + 1)[1:] for a, b in zip([0.0, *ENDS], ENDS, strict=False)]
    mesh = lp.fem.line([0.0, *np.concatenate(nodes)]).with_subdomains(
        {"air": lambda x: x[0] < 0.02}
    )
    regions = {name: (lambda x, name=name: layer(x, name)) for name in WALL}
    k = lp.Piecewise(regions, lp.LogNormal(1.0, std=0.6))
    return lp.Model(
        state=lp.Field(mesh, lp.linear(mesh), unit="degC"),
        parameter={"k": k},
        A=lambda q, u, v, x: q.k * each(x, SHEET) * lp.dot(lp.grad(u), lp.grad(v)),
        B=[
            lambda u, v, x: each(x, SHEET[:2], ("room", "film")) * lp.dot(lp.grad(u), lp.grad(v)),
            lp.On("air", lambda u, v, x: 0.6 / 0.02 * u * v),  # ventilation loss, 0.6 W/(m^2 K)
            lp.On("right", lambda u, v, x: 20.0 * u * v),
        ],
        f=[
            lp.On("air", lambda x, t: (x.inputs["heater"] + 0.6 * x.inputs["outside"]) / 0.02),
            lp.On("right", lambda x, t: 20.0 * x.inputs["outside"]),
        ],
        M=lambda u, v, x: each(x, CAPACITY) * u * v,
        inputs=["heater", "outside"],
        time_unit="s",
    )


def outside(t):
    """Return the outside temperature, which is measured and forecast."""
    return 1.0 + 5.0 * np.sin(2.0 * np.pi * (t / HOUR - 9.0) / 24.0)


def least(t):
    """Return the lowest allowed air temperature; people are present from 6 to 18 h."""
    return np.where((t / HOUR % 24 >= 6) & (t / HOUR % 24 < 18), 20.0, 15.0)


def main(days: int = 4) -> dict[str, tuple[float, float]]:
    """Heat a cold building; return the estimates, and the hours too cold on the last day."""
    model, truth = room(4), room(10)
    sensors = lp.Points({"air": 0.0, "face": 0.03}, noise=0.1)
    applied = {"heater": "next", "outside": "next"}  # inputs applied since the previous sample
    identifier = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=COLD, between=applied)
    reduced = ct.reduce(model, lp.Points({"air": 0.0}), ["heater"], sensors=sensors, u=COLD)
    goal = ct.Goal(
        track={},
        move={"heater": 1e-6},
        inputs={"heater": (0.0, POWER)},
        limits={"air": (15.0, 24.0)},
        price={"heater": 1.0 / POWER},
        penalty=5.0,  # cost of 1 K too cold for half an hour, over the cost of full power
    )
    controller = ct.MPC(reduced, goal, PERIOD, horizon=18)
    loop = ct.Loop(identifier, controller, ct.Trust(spread=2.0))

    u, q = truth.initial(COLD), np.log([TRUE[name] for name in WALL])
    sees = lambda u: np.interp([0.0, 0.03], truth.mesh.p[0], u)  # noqa: E731
    rng, cold = np.random.default_rng(0), 0.0
    for k in range(48 * days):
        t = PERIOD * k
        coming = t + PERIOD * (1 + np.arange(18))
        action = loop.step(
            t,
            sees(u) + rng.normal(0.0, 0.1, 2),
            {"outside": outside(t)},
            forecast={"outside": outside(coming)},
            limits={"air": (least(coming), 24.0)},
        )
        inputs = {**action.inputs, "outside": float(outside(t + PERIOD))}
        times, advance = np.linspace(t, t + PERIOD, 7).tolist(), lp.Advance(lp.ImplicitEuler())
        *_, (_, u) = lp.simulate(truth, q, u, times, advance, lambda _, held=inputs: held)
        if k >= 48 * (days - 1) and sees(u)[0] < least(t + PERIOD) - 0.2:
            cold += PERIOD / HOUR
        if k % 12 == 11:
            found = ", ".join(f"{v:.2f} ± {s:.2f}" for v, s in action.estimate.parameters.values())
            print(f"{t / HOUR + 0.5:4.0f} h: air {sees(u)[0]:5.2f}, {found} ({action.source})")
    return action.estimate.parameters | {"hours too cold": (cold, 0.0)}


if __name__ == "__main__":
    main()
