"""Settings of the paper, and the table that locates its equations in the code."""

import importlib
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

import livepde as lp
from experiments import reference
from experiments.__main__ import app as studies
from livepde.laws.coupled.coupled_stage import nearest_root
from livepde.laws.damping import Residual
from livepde.reproduce import EXPERIMENTS, boiger2016, seed

SETTING = reference.Setting(
    q_true=lambda x: 0.025 * x**2 - 0.025 * x,
    u_true=lambda x, t: np.sin(np.pi * x) / (1 + t),
    f=lambda x, t: seed.f([x], t),
    state_ends="clamped",
    parameter_ends="clamped",
    omega=seed.OMEGA,
    gain=100.0,
)


def test_the_papers_space() -> None:
    """N - 2 values and as many slopes; the slopes at the ends are fixed with the values."""
    model, _ = seed.build(clamped=True)
    for space in (model.X, model.Q):
        assert int(space.free.sum()) == 2 * (seed.N - 2)
    u = model.initial(lambda x: seed.u_true(x, 0.0))
    ends = model.state_block.probe(np.array([[0.0, 1e-6, 1.0 - 1e-6, 1.0]])) @ u
    assert np.abs(ends).max() < 1e-9


def test_without_slopes_the_theory_has_no_constant() -> None:
    """||P u*||_V^ grows like h^(-1/2) in the paper's space, and is 3.11 with the slopes."""

    def sizes(ends: reference.Ends) -> list[float]:
        found = []
        for nodes in (31, 61, 121):
            setting = reference.Setting(
                q_true=np.zeros_like,
                u_true=lambda x, t: np.sin(np.pi * x),
                nodes=nodes,
                state_ends=ends,
                omega=seed.OMEGA,
            )
            at = reference.Discretisation(setting)
            found.append(at.V_hat(at.X.interpolate(lambda x: np.sin(np.pi * x))))
        return found

    assert sizes("clamped") == pytest.approx([49.0, 69.2, 97.7], rel=2e-3)
    assert sizes("zero") == pytest.approx([3.11] * 3, rel=2e-3)


def test_nothing_is_held_halved_or_left() -> None:
    law = lp.paper.law(100.0, D=-0.5, nu=2.0, sigma=0.1)
    assert law.gate is None
    assert (law.newton.share, law.newton.tolerance) == (0.0, 1e-12)
    assert law.M_op == law.N_op == lp.laws.diffusion_operator(-0.5)
    assert (law.gain, law.nu, law.sigma) == (100.0, 2.0, 0.1)
    model, omega = seed.build(clamped=True)
    assert lp.paper.identifier(model, omega).problem.control.halvings == 0


@pytest.mark.slow
def test_every_step_is_solved_to_rounding() -> None:
    """The law's run satisfies the equations of the independent implementation."""
    twin = seed.twin_of(clamped=True, times=seed.TIMES[:11])
    run = lp.paper.identifier(twin.model, twin.observation, gain=100.0, u0=seed.start)
    estimates = [run.step(sample.t, sample.z) for sample in twin]
    assert all(estimate.status.ok for estimate in estimates)
    found = reference.run(replace(SETTING, c1=1.0, steps=10))
    q = np.array([estimate.q for estimate in estimates])
    assert np.abs(q - found.Q).max() < 1e-6 * np.abs(found.Q).max()


@pytest.mark.slow
def test_a_stage_is_solved_whose_root_is_a_million_times_from_its_start() -> None:
    """Nodal noise of 1 %, constant mu: theta 7.5e2 follows 4.5e-4; the reference confirms it."""
    case, variant, count = boiger2016.paper_case(), boiger2016.PAPER["nodal, mu = 1"], 106
    twin = case.twin
    run = lp.Identifier(
        twin.model, twin.observation, variant.law, q0=0.0, u0=case.start, halvings=0
    )
    samples = list(case.samples("nodal", 0.01, 3))[:count]
    estimates = [run.step(sample.t, sample.z) for sample in samples]
    assert all(estimate.status.ok for estimate in estimates)
    setting = replace(SETTING, mu=1.0)
    at = reference.Discretisation(setting)
    _, _, loads = reference.truth(at, 0.6 * np.arange(count))
    G = twin.observed.G
    Z = np.array([G.T @ sample.z for sample in samples])
    Q, U = (np.array([getattr(e, name) for e in estimates]) for name in "qu")
    left = reference.residuals(at, Q[-2:], U[-2:], Z[-2:], at.X.extend(loads)[-2:])
    assert left.max() <= 1e-6


def test_the_search_for_theta_ends_where_the_rule_ends() -> None:
    def gap(theta: float) -> float:
        asked.append(theta)
        return 3.0 - theta

    asked: list[float] = []
    assert nearest_root(gap, 1e-6, 1e-12, 10.0) == pytest.approx(3.0)  # 3e6 from the start
    assert max(asked) <= 10.0
    assert nearest_root(gap, 1e6, 1e-12, 1e7) == pytest.approx(3.0)
    assert nearest_root(gap, 1.0, 0.1, 2.0) is None
    assert nearest_root(lambda theta: 0.0, 1.0, 0.1, 2.0) == 1.0


def test_a_constant_mu_bounds_theta_beforehand() -> None:
    """mu/(floor ||u_alpha||_V~), whatever r is."""
    rule = lp.laws.ConstantDamping(mu=2.0, floor=1e-2)
    observed = Residual(1.0, 1.0, lambda: 25.0)
    assert rule.most(observed) == pytest.approx(40.0)
    for size in (0.0, 1e-8, 1.0, 1e8):
        r = Residual(size, size, lambda size=size: size, lambda: observed)
        assert rule.theta(r) <= rule.most(observed) * (1 + 1e-12)


def test_nothing_learned_is_no_shift_to_the_right() -> None:
    x, (low, high) = np.linspace(0.0, 1.0, 61), seed.SHIFTED
    exact = seed.q_true([x])
    for q in (0.0 * x, exact, 1e-3 * exact * (1.0 + x)):
        assert not low <= seed.shift(x, q) <= high
    # By hand: of x (x - x^2) the first moment is 1/20, half of the integral 1/24.
    assert seed.shift(x, exact * x) == pytest.approx((1 / 20 - 1 / 24) / (1 / 6), rel=1e-2)


@pytest.mark.parametrize("values", [{}, {"boundary": 1.0}, {"left": lambda x, t: t}])
def test_clamped_wants_zero_values(values: dict) -> None:
    mesh = lp.interval(0, 1, 4)
    with pytest.raises(lp.errors.SpaceError, match="clamped=True fixes values and slopes to zero"):
        lp.Field(mesh, lp.fem.hermite(mesh), dirichlet=values, clamped=True)


PACKAGES = ("livepde.", "experiments.")
ROOT = Path(__file__).parents[1]
WHOLE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
PAGE = WHOLE[WHOLE.index("## Line by line") : WHOLE.index("## Conditions along a run")]
QUOTED = sorted(set(re.findall(r"`([^`]+)`", PAGE)))

# Labels of the paper's equations, assumptions, lemmas, propositions, theorems and figures.
LABELS = re.findall(
    r"\S+",
    """
main ass:equation LipschitzC AbdV AbdX AbdVV est_exact_q est_exact_u est_exact0 erp errorsys_e
errorsys_r errorsys_p id1 align:neplusnr cond:mu_1 est1 estp cond:nu prop:welldefine cond:mu02
th:state def:LA ineq:gamma est_er1 finiteintegral_r2 lem:est_state asspof est_er2 cond:link interpol
lemma1 th:parameter noisy_q noisy_u noisy_0 delta id2 id3 smooth_err_q smooth_err_r smooth_err_p
smooth_err_0 ass:mu_nu cond_d well_defined_noisy Tast est5 est4 ass:mu_noisy lemma_integral
ass:persistence_noisy thetatil ass:link_noisy lemma1_noisy th:parameter_noisy method_smooth_q
method_smooth_u method_smooth_0 err_smooth_r ass:mu_nu_smooth prop:wellposed_noisesmooth
cond:mu_smooth_2 th:state_noisesmooth lem:est_state_noisesmooth lemma1_noisesmooth
th:parameter_noisesmooth PDEdiff obsdiff MN1 MN2 fig:figure1 fig:figure2
""",
)


@pytest.mark.parametrize("name", [name for name in QUOTED if name.startswith(PACKAGES)])
def test_functions_exist(name: str) -> None:
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[cut:]:
            found = getattr(found, attribute)
        return
    pytest.fail(f"{name} cannot be imported")


@pytest.mark.parametrize("name", [name for name in QUOTED if name.startswith("test_")])
def test_tests_exist(name: str) -> None:
    file, _, function = name.partition("::")
    source = (ROOT / "tests" / file).read_text(encoding="utf-8")
    assert not function or re.search(rf"^def {function}\(", source, re.MULTILINE)


def test_commands_and_files_exist() -> None:
    for name in QUOTED:
        if name.startswith("livepde reproduce "):
            assert name.split()[-1] in EXPERIMENTS
        elif name.startswith("python -m experiments "):
            assert name.split()[-1] in get_command(studies).commands
        elif name.startswith("experiments/"):
            assert (ROOT / name).exists()
        else:
            assert name.startswith((*PACKAGES, "test_")), name


@pytest.mark.parametrize("label", LABELS)
def test_no_label_is_left_out(label: str) -> None:
    assert re.search(rf"(?<![\w:]){re.escape(label)}(?![\w:])", PAGE)


def test_every_row_is_full() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and "---" not in line]
    for row in rows:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert len(cells) == 3, row
        assert all(cells), row
