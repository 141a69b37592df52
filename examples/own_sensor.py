"""Your own sensor: a differential thermometer, z = u(a) - u(b)."""

from dataclasses import dataclass

import scipy.sparse as sp
from skfem import ElementLineP1

import livepde as lp
from livepde.diagnostics import CheckReport, check_observation
from livepde.fem import FunctionSpace


@dataclass(frozen=True, eq=False)
class Differences(lp.observation.Observation):
    """Differences of the state between pairs of points."""

    pairs: tuple[tuple[float, float], ...]

    def matrix(self, state: FunctionSpace) -> sp.csr_array:
        """Return G, one row per pair; `state.probe` evaluates the state at points."""
        first = state.probe([[a for a, _ in self.pairs]])
        second = state.probe([[b for _, b in self.pairs]])
        return sp.csr_array(first - second)


def main() -> CheckReport:
    """Check the sensor with a model, such as that R and P are projections and G^+ reconstructs."""
    model = lp.Model(
        state=lp.Field(lp.interval(0.0, 1.0, 50), ElementLineP1(), dirichlet={"left": 0.0}),
        parameter=lp.Normal(1.0),
        A=lambda q, u, v, x: q * lp.dot(lp.grad(u), lp.grad(v)),
    )
    report = check_observation(Differences(((0.2, 0.4), (0.5, 0.9)), noise=0.01), model)
    print(report)
    return report


if __name__ == "__main__":
    main()
