"""The laws of the experiment: Baumeister et al. (1997) and Kügler (2010)."""

from typing import Any

import numpy as np
import pytest
from factories import excited, excited_q, excited_u, laplace, observe, reaction
from skfem import ElementLineP1

import livepde as lp
from experiments.related_laws import BaumeisterLaw, KueglerLaw, _FormsAtEstimate, _Linear
from experiments.relatives import EXPECTED, LAWS, law, relatives
from livepde.laws.coupled.coupled_stage import CoupledStage
from livepde.laws.coupled.equation import Metric, StageProblem, StageTerms
from livepde.model import mass_form
from livepde.stepping import Newton
from livepde.streams import Twin

PART = lp.Subdomain(lambda x: (x[0] > 0.3) & (x[0] < 0.87))
H = 0.1
TIMES = H * np.arange(60)


def twin(model: lp.Model, observation: lp.observation.Observation) -> Twin:
    return Twin(
        scheme=lp.ImplicitEuler(),
        model=model,
        observation=observation,
        q_true=excited_q,
        u0=lambda x: excited_u(x, 0.0),
        times=TIMES,
    )


def identifier(model: lp.Model, observation: lp.observation.Observation, law: Any) -> lp.Identifier:
    return lp.Identifier(model, observation, law, q0=0.0, u0=lambda x: excited_u(x, 0.0))


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "observation"),
    [(BaumeisterLaw(100.0), lp.Full()), (KueglerLaw(100.0), lp.Full()), (KueglerLaw(100.0), PART)],
)
def test_contract(law: Any, observation: lp.observation.Observation) -> None:
    model = excited(10)
    samples = list(twin(model, observation))[:8]
    report = lp.diagnostics.check_law(law, lambda law: identifier(model, observation, law), samples)
    assert report.ok, str(report)


@pytest.mark.long
@pytest.mark.parametrize("name", LAWS)
def test_energy_falls_with_exact_data(name: str) -> None:
    """The terms with A cancel in the coupled step, as in (align:neplusnr)."""
    model = excited(10)
    exact, gain = twin(model, lp.Full()), 100.0
    run = identifier(model, lp.Full(), law(name, gain, 1.0))
    energy = [exact.energy(run.step(s.t, s.z), gain) for s in exact]
    assert np.all(np.diff(energy) <= 1e-9 * energy[0])
    assert energy[-1] < 0.75 * energy[0]


def test_baumeister_refuses_partial_data() -> None:
    with pytest.raises(lp.errors.LawError, match=r"all of the state; .* Use GradientLaw"):
        identifier(excited(10), PART, BaumeisterLaw())


def test_baumeister_is_the_papers_law_with_a_linear_pull() -> None:
    """With R = I, (est_exact_q) and (est_exact_u) with theta = mu."""
    model = excited(10)
    paper = identifier(model, lp.Full(), lp.GradientLaw(100.0, _Linear(2.0)))
    other = identifier(model, lp.Full(), BaumeisterLaw(100.0, 2.0))
    for sample in twin(model, lp.Full()):
        one, two = paper.step(sample.t, sample.z), other.step(sample.t, sample.z)
    assert np.array_equal(one.q, two.q)
    assert np.array_equal(one.u, two.u)


def squared(u: Any, v: Any, x: Any) -> Any:
    return laplace(u, v, x) + u**3 * v


@pytest.mark.parametrize("B", [laplace, squared], ids=["affine", "monotone, nonlinear"])
def test_kueglers_stage_solves_its_equations(B: Any) -> None:
    """C is evaluated at u^; once by the products of a bilinear model, once in general."""
    model = reaction(lp.interval(0.0, 1.0, 10), ElementLineP1(), B=B)
    observed = observe(model, PART)
    split, gain, mu, h = observed.split(), 50.0, 3.0, 0.2
    forms = _FormsAtEstimate(model, split, None, None, 0.0)
    stage = CoupledStage(StageTerms(forms, _Linear(mu)), Newton(tolerance=1e-12, share=0.0))
    rng, n = np.random.default_rng(0), model.X.dim
    c = 0.3 * rng.standard_normal(n + model.Q.dim)
    c[:n] *= model.X.free
    u_alpha = split.R @ model.initial(lambda x: excited_u(x, 0.3))
    metric = Metric(1.0 / gain)
    problem = StageProblem(c, h, lp.fem.Moment(0.2), u_alpha, metric)
    y = stage.solve(problem, lambda: np.zeros_like(c))[0].y
    u, q = y[:n], y[n:]
    r = split.R @ u - u_alpha
    omega = model.bilinear(mass_form, split.omega)
    inside, outside = split.omega, np.setdiff1d(np.arange(model.mesh.nelements), split.omega)
    A_in, A_out = (model.form_A.on(part).matrix("v", "q", u=u) for part in (inside, outside))
    assert abs(A_in + A_out - model.A(u).matrix).max() < 1e-13
    state = model.mass @ (u - c[:n]) / h + model.B(u) + model.A(u).matrix @ q
    state += mu * (split.R.T @ (omega @ r)) - model.F(lp.fem.Moment(0.2))
    learned = model.Q.gram @ (q - c[n:]) / (gain * h) - A_in.T @ r
    assert np.abs(state * model.X.free).max() < 1e-10
    assert np.abs(learned * model.Q.free).max() < 1e-10


@pytest.mark.study
def test_reproduction() -> None:
    outcome = relatives()
    assert outcome.ok, [check.name for check in outcome.checks if not check.ok]
    more = 2  # failed steps, and the refusal of partial data
    assert len(outcome.checks) == len(EXPECTED) + more
    assert sum("refused" in row for row in outcome.tables[0].rows) == 2
    assert outcome.figures["error"]() is not None
