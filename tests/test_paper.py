"""The paper's settings by one name."""

from __future__ import annotations

import numpy as np
import pytest

import livepde as lp
from experiments import reference
from livepde.reproduce import seed


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
    found = reference.run(
        reference.Setting(
            q_true=lambda x: 0.025 * x**2 - 0.025 * x,
            u_true=lambda x, t: np.sin(np.pi * x) / (1 + t),
            f=lambda x, t: seed.f([x], t),
            state_ends="clamped",
            parameter_ends="clamped",
            omega=seed.OMEGA,
            gain=100.0,
            c1=1.0,
            steps=10,
        )
    )
    q = np.array([estimate.q for estimate in estimates])
    assert np.abs(q - found.Q).max() < 1e-6 * np.abs(found.Q).max()


@pytest.mark.parametrize("values", [{}, {"boundary": 1.0}, {"left": lambda x, t: t}])
def test_clamped_wants_zero_values(values: dict) -> None:
    mesh = lp.interval(0, 1, 4)
    with pytest.raises(lp.errors.SpaceError, match="clamped=True fixes values and slopes to zero"):
        lp.Field(mesh, lp.fem.hermite(mesh), dirichlet=values, clamped=True)
