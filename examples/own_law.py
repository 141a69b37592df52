"""Your own update law: the paper's law, but explicit in q. For instruction only."""

from dataclasses import dataclass

import numpy as np
from skfem import ElementLineP1

import livepde as lp
from livepde.diagnostics import CheckReport, check_law
from livepde.stepping import ForwardStage
from livepde.streams import Twin


@dataclass(frozen=True, eq=False)
class State:
    """State of the law, a frozen dataclass of arrays that a checkpoint can save."""

    u: np.ndarray
    q: np.ndarray


@dataclass(frozen=True)
class ExplicitLaw(lp.laws.Law):
    """Step u with the old q, pull R u to the data, then q += h gain A(u)* r."""

    gain: float = 1.0
    pull: float = 1.0

    def prepare(self, problem):
        """Return everything that is computed once."""
        return problem, ForwardStage(problem.model)

    def init(self, work, q0, u0):
        """Return the initial state."""
        return State(u0, q0)

    def step(self, work, state, interval):
        """Return the state at the end of the interval, and a report."""
        problem, forward = work
        model, observed = problem.model, problem.observed
        h = interval.t1 - interval.t0
        u = forward.solve(state.u, state.q, h, interval.end)
        predicted = observed.predict(u, state.q, interval.end)
        split = observed.split(interval.present)  # G without the rows of missing readings
        boundary = model.impose(np.zeros_like(u), interval.end)
        r = split.R @ u - split.reconstruct(interval.z1, boundary)
        q = state.q + h * self.gain * model.A(u, interval.end).adjoint(r)
        new = State(u - h * self.pull / (1 + h * self.pull) * r, q)
        return new, lp.laws.Report(lp.laws.Status(), predicted, steps=1)

    def belief(self, work, state):
        """Return the estimates; a law with a covariance also returns its square roots."""
        return lp.laws.Belief(state.q, state.u)


def problem() -> tuple[lp.Model, lp.Subdomain]:
    """Return a rod with an unknown reaction q(x), observed on its middle."""
    mesh = lp.interval(0.0, 1.0, 20)
    model = lp.Model(
        state=lp.Field(mesh, ElementLineP1(), dirichlet={"boundary": 0.0}),
        parameter=lp.Field(mesh, ElementLineP1(), inner="H1"),
        A=lambda q, u, v, x: q * u * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        f=lambda x, t: 10.0 * (1.0 + np.sin(t)) + 0.0 * x[0],
    )
    return model, lp.Subdomain(lambda x: (x[0] > 0.2) & (x[0] < 0.8))


def main() -> CheckReport:
    """Check the law on a short stream of simulated samples."""
    model, sensors = problem()
    twin = Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=sensors,
        q_true=2.0,
        u0=0.0,
        times=0.05 * np.arange(13),
    )
    report = check_law(ExplicitLaw(), lambda law: lp.Identifier(model, sensors, law), list(twin))
    print(report)
    return report


if __name__ == "__main__":
    main()
