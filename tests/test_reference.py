"""The reference implementation: its elements, equations and solver, and the numbers it gives.

These tests do not use livepde itself, which is compared with this reference elsewhere.
"""

import ast
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from experiments import reference
from experiments.reference import Discretisation, Step, run
from experiments.reference_settings import FULL, PAPER, SETTINGS, TWIN, scaled

UNEVEN = np.array([0.0, 0.08, 0.2, 0.3, 0.45, 0.6, 0.7, 0.87, 0.95, 1.0])


def stationary_f(x, t):
    return (np.pi**2 + PAPER.q_true(x)) * np.sin(np.pi * x)


@cache
def trajectory(name):
    return run(SETTINGS[name])


def product(at, left, right):
    """L2 products of functions of Q or X given at the quadrature points, along the last axis."""
    return (left * right) @ at.weights


def error_q(found):
    """Relative L2 error of q at the end, against the interpolant of q*."""
    at = found.at
    error, exact = (
        (rows[..., at.Q.free] @ at.xi.T) for rows in (found.Q - found.q_true, found.q_true)
    )
    return np.sqrt(product(at, error, error)[-1] / product(at, exact, exact))


def error_u(found):
    at = found.at
    error, exact = (
        (rows[-1, at.X.free] @ at.v.T) for rows in (found.U - found.U_true, found.U_true)
    )
    return np.sqrt(product(at, error, error) / product(at, exact, exact))


def energy(found):
    """||e||_Q^2 / gain + ||r||_X^2 with r = R u - u_alpha."""
    at = found.at
    e = (found.Q - found.q_true)[:, at.Q.free]
    u_alpha = np.array([at.reconstruct(z) for z in found.Z[:, at.X.free]])
    r = (found.U[:, at.X.free] - u_alpha) @ at.v.T * at.inside
    return np.einsum("ki,ij,kj->k", e, at.G_Q, e) / at.setting.gain + product(at, r, r)


def step_of(found, k):
    """The equations of step k of a trajectory."""
    at = found.at
    u, z, F = (rows[:, at.X.free] for rows in (found.U, found.Z, found.F))
    return Step(at, u[k - 1], found.Q[k - 1, at.Q.free], z[k], F[k])


# --- elements ------------------------------------------------------------------------------------


def test_it_imports_numpy_and_the_standard_library_only():
    tree = ast.parse(Path(reference.__file__).read_text(encoding="utf-8"))
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {
        a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names
    }
    assert {m.partition(".")[0] for m in modules} - set(sys.stdlib_module_names) == {"numpy"}


@pytest.mark.parametrize(("kind", "order"), [("P1", 2), ("hermite", 4)])
def test_true_states_converge_in_space(kind, order):
    """One step of implicit Euler that is long enough for -u'' + q u = f."""
    errors = []
    for nodes in (6, 11, 21):
        setting = replace(FULL, nodes=nodes, state=kind, h=1e12, steps=1, f=stationary_f)
        at = Discretisation(setting)
        _, states, _ = reference.truth(at, np.array([0.0, 1e12]))
        errors.append(np.sqrt(at.weights @ (at.v @ states[1] - np.sin(np.pi * at.x)) ** 2))
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.25)


# --- splitting, norms and adjoints ---------------------------------------------------------------


@pytest.mark.parametrize("nodes", [16, 31, 61, 121])
def test_strong_norm_of_the_unobserved_part_does_not_depend_on_the_mesh(nodes):
    at = Discretisation(replace(PAPER, nodes=nodes))
    p = at.X.interpolate(lambda x: np.sin(np.pi * x))
    outside = at.weights * ~at.inside
    exact = (np.pi**2 + 1) * np.sqrt(outside @ np.sin(np.pi * at.x) ** 2)
    assert at.V_hat(p) == pytest.approx(exact, rel=1e-3)
    assert at.V_hat(p) == pytest.approx(3.10, abs=0.01)


# --- reconstruction ------------------------------------------------------------------------------


@pytest.mark.parametrize("omega", [(0.0, 1.0), (0.3, 0.87)])
def test_reconstruction_minimises_Tikhonov(omega):
    at = Discretisation(replace(PAPER, omega=omega, nodes=UNEVEN, alpha=1e-4, penalty="H2"))
    rng = np.random.default_rng(3)
    z = np.zeros(len(at.X.free))
    z[at.observed] = rng.normal(size=len(at.observed))
    second = at.X.basis(at.x, 2)

    def functional(v):
        misfit, bend = at.v @ (v - z), second @ v
        return (at.weights * at.inside) @ (misfit**2 + 1e-4 * bend**2)

    found = at.reconstruct(z)
    for _ in range(10):
        change = np.zeros_like(z)
        change[at.observed] = rng.normal(size=len(at.observed))
        assert functional(found) < functional(found + 1e-3 * change)
        slope = (functional(found + change) - functional(found - change)) / 2
        assert abs(slope) < 1e-10 * functional(found + change)


# --- equations and solver ------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "rule",
    [
        {"c1": 1.0},
        {"c1": 0.1},
        {"c1": 0.0},
        {"c1": 0.0, "mu": 0.1},
        {"c1": 0.0, "mu": 10.0, "floor": 1e-6},
        {"c1": 1.0, "mu": 0.1},
    ],
)
@pytest.mark.parametrize(
    "base", [FULL, replace(TWIN, nodes=11), replace(TWIN, state="P1", inner="L2")]
)
def test_energy_never_grows_with_full_data(rule, base):
    for gain in (1.0, 100.0, 1e4):
        levels = energy(run(replace(base, gain=gain, nodes=16, steps=30, **rule)))
        assert (np.diff(levels) <= 1e-12 * levels[0]).all()


def test_energy_is_lost_to_damping_and_to_implicit_Euler_only():
    """E_k - E_(k-1) = - 2 h theta ||r||_VX~^2 - ||e_k - e_(k-1)||^2 - ||r_k - r_(k-1)||^2."""
    found = run(replace(TWIN, steps=40))
    at, h = found.at, found.at.setting.h
    e, r = (found.Q - found.q_true)[:, at.Q.free], (found.U - found.Z)[:, at.X.free]
    damping = 2 * h * found.theta * np.einsum("ki,ij,kj->k", r, at.M_op, r)
    de, dr = np.diff(e, axis=0), np.diff(r, axis=0)
    Euler = np.einsum("ki,ij,kj->k", de, at.G_Q, de) / at.setting.gain
    Euler += np.einsum("ki,ij,kj->k", dr, at.M, dr)
    levels = energy(found)
    np.testing.assert_allclose(np.diff(levels), -damping[1:] - Euler, atol=1e-12 * levels[0])


@pytest.mark.long
@pytest.mark.parametrize("size", [300.0, 1e5])
@pytest.mark.parametrize("error", [0.0, 1e-3])
def test_estimates_of_q_do_not_depend_on_the_size_of_the_state(size, error):
    one, other = (run(replace(scaled(s, error), steps=150)) for s in (1.0, size))
    np.testing.assert_allclose(one.Q, other.Q, atol=1e-9)
    np.testing.assert_allclose(one.U, other.U / size, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", SETTINGS)
def test_every_setting_is_solved(name):
    found = run(replace(SETTINGS[name], steps=15))
    at = found.at
    again = reference.residuals(at, found.Q, found.U, found.Z, found.F)
    assert found.residuals.max() <= reference.TOLERANCE
    assert again.max() <= 1e-9  # u - u_alpha is rounded here
    bent = found.U + 1e-6 * abs(found.U).max() * np.sin(np.arange(found.U.shape[1]))
    assert reference.residuals(at, found.Q, bent, found.Z, found.F).min() > 1e-9


@pytest.mark.long
def test_a_step_can_have_three_solutions():
    """nu = 0.01, t = 3.6: one continues the step before, one is found from r(0), one is between."""
    found = trajectory("partial, nu = 0.01")
    step = step_of(found, 6)
    solved = [step.solve(theta) for theta in (found.theta[5], 1e-3)]
    assert [step.theta(r) for r, _, _ in solved] == pytest.approx([0.2279, 0.0069], abs=2e-4)
    assert max(residual for *_, residual in solved) < reference.TOLERANCE
    above = step.newton(solved[0][0], 0.16)
    below = step.newton(above, 0.14)
    assert step.theta(above) > 0.16
    assert step.theta(below) < 0.14


# --- numbers -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("nodes", "nu", "of_q", "of_u"),
    [
        (16, 0.0, 0.132, 0.00020),
        (31, 0.0, 0.128, 0.00024),
        (61, 0.0, 0.128, 0.00024),
        (16, 0.01, 0.557, 0.0062),
        (31, 0.01, 0.526, 0.0065),
        (61, 0.01, 0.512, 0.0064),
        (31, 0.1, 3.05, 0.0456),
    ],
)
def test_errors_with_cut_elements_do_not_depend_on_the_mesh(nodes, nu, of_q, of_u):
    found = run(replace(PAPER, nodes=nodes, nu=nu))
    assert error_q(found) == pytest.approx(of_q, rel=5e-3)
    assert error_u(found) == pytest.approx(of_u, rel=3e-2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "of_q"),
    [
        ("partial, gain 1, c_1 = 0.1", 0.836),
        ("partial, c_1 = 0.1", 0.116),
        ("partial, gain 1e4, c_1 = 0.1", 0.0599),
        ("partial, gain 1e4", 0.0643),
        ("partial, clamped", 0.133),
        ("partial, P1", 0.126),
        ("varying D, nu = 0", 0.196),
        ("varying D, nu = 0.1", 0.116),
    ],
)
def test_errors_of_settings(name, of_q):
    assert error_q(trajectory(name)) == pytest.approx(of_q, rel=5e-3)
