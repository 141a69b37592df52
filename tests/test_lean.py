"""The lean reference and array filters agree with the law of livepde and with naive loops."""

import numpy as np
import pytest
from scipy.linalg import sqrtm

import livepde as lp
from benchmarks import lean
from benchmarks import rods as costs
from benchmarks.layered import ENDS, STEP
from benchmarks.peers import arrays
from benchmarks.peers.augmented import Augmented
from benchmarks.problems import PROBLEMS
from benchmarks.problems.rod import ROD
from livepde.fem import Inputs, Moment

COUNT = 60
# The reference has neither safeguards nor an iterated start.
LAW = lp.SensitivityLaw(guards=None, refit=None, shadows=None)


def moment(sample):
    return Moment(sample[0], Inputs(sample[2]))


def started(given: costs.Rod, members: int):
    """Return matrices, observation in units of the noise, and the filter at the start."""
    matrices = given.matrices
    G = given.sensors.matrix(given.model.state_space).toarray()[:, matrices.order] / costs.NOISE
    u0 = given.model.initial(0.0, moment(given.samples(1)[0]))
    return matrices, G, lean.initial(matrices, u0, members, given.unknowns)


def latent(given: costs.Rod, state: lean.Filter):
    own = given.model.latent
    return own.prior + state.y[:, :, 0] * own.deviations


@pytest.mark.long
@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("nodes", "unknowns"), [(31, 2), (31, 10), (60, 3)])
def test_the_lean_reference_has_the_numbers_of_the_law(nodes, unknowns, ends):
    given = costs.Rod(nodes, unknowns, ends)
    samples = given.samples(COUNT)
    steps = {"scheme": lp.ImplicitEuler(), "halvings": 0}
    identifier = lp.Identifier(given.model, given.sensors, LAW, u0=0.0, **steps)
    identifier.step(*samples[0])
    matrices, G, state = started(given, 1)
    for sample in samples[1:]:
        estimate = identifier.step(*sample)
        z = sample[1][None] / costs.NOISE
        state = lean.step(matrices, G, state, matrices.forcing(moment(sample)), z)
        np.testing.assert_allclose(latent(given, state)[0], estimate.q, rtol=0, atol=1e-10)
    np.testing.assert_allclose(state.x[0, matrices.place, 0], estimate.u, atol=1e-10)
    belief = identifier._latent_belief()
    root = given.model.latent.deviations[:, None] * state.y[0, :, 1:]
    np.testing.assert_allclose(root @ root.T, belief.q_factor @ belief.q_factor.T, atol=1e-10)
    assert abs(estimate.q - 1.0).max() > 0.01  # something was learned


@pytest.mark.long
@pytest.mark.parametrize("ends", ENDS)
def test_members_side_by_side_have_the_numbers_of_a_fleet(ends):
    given, members = costs.Rod(31, 2, ends), 5
    streams = [given.samples(COUNT, seed) for seed in range(members)]
    steps = {"scheme": lp.ImplicitEuler(), "halvings": 0}
    fleet = lp.Fleet(given.model, given.sensors, LAW, members, u0=0.0, **steps)
    matrices, G, state = started(given, members)
    for k in range(COUNT + 1):
        t, z, inputs = streams[0][k][0], np.array([one[k][1] for one in streams]), streams[0][k][2]
        estimate = fleet.step(t, z, inputs)
        if k:
            f = matrices.forcing(Moment(t, Inputs(inputs)))
            state = lean.step(matrices, G, state, f, z / costs.NOISE)
    np.testing.assert_allclose(latent(given, state), estimate.q, rtol=0, atol=1e-10)
    assert np.ptp(estimate.q[:, 0]) > 0.05


def test_a_lean_forward_step_is_one_of_simulate():
    given = costs.Rod(31, 3, "source")
    solve, mass = costs._stepper(given)
    order, place = given.matrices.order, given.matrices.place
    u, f = np.zeros(31), given.model.F() * given.model.X.free
    for _, expected in list(given.forward(given.model.latent.prior, 5))[1:]:
        u = solve(mass @ u + f[order])
        np.testing.assert_allclose(u[place], expected, atol=1e-13)


@pytest.mark.long
def test_a_square_is_assembled_as_simulate_does():
    given = costs.Rod(costs.SQUARE, 4, "source")
    model = given.model
    mass, S = lean.assembled(model, model.latent.prior, STEP)
    (_, before), (_, after) = given.forward(model.latent.prior, 1)
    known = mass @ before + model.F() * model.X.free
    np.testing.assert_allclose(S @ after, known, atol=1e-12 * abs(S).max())


# --- filters as arrays ---------------------------------------------------------------------------


@pytest.fixture(params=["rod", "heat2d"])
def data(request):
    problems = {"rod": ROD, "heat2d": PROBLEMS["heat2d"]}
    return problems[request.param].data(0.01, 0).until(5)


@pytest.mark.long
def test_an_ensemble_as_arrays_is_a_loop_over_its_members(data):
    members, inflation = 6, 1.02
    filter_ = arrays.Ensemble(arrays.Stack(data), members, inflation)
    augmented = Augmented(data)
    E = np.hstack([np.tile(augmented.start, (members, 1)), filter_.a])
    n, R = augmented.n, np.diag(data.noise**2)
    for at in range(1, len(data)):
        filter_.step(at)
        E = np.array([augmented.forecast(x, at) for x in E])
        seen = np.array([augmented.output(x, at) for x in E])
        mean, X, Y = E.mean(axis=0), E - E.mean(axis=0), seen - seen.mean(axis=0)
        P = np.linalg.inv((members - 1) * np.eye(members) + Y @ np.linalg.solve(R, Y.T))
        weights = P @ Y @ np.linalg.solve(R, data.z[at] - seen.mean(axis=0))
        root = np.real(sqrtm((members - 1) * P))
        E = mean + X.T @ weights + inflation * root @ X
    mean, factor = filter_.known()
    np.testing.assert_allclose(mean, augmented.latent(E[:, n:].mean(axis=0)), atol=1e-10)
    a = (E[:, n:] - E[:, n:].mean(axis=0)).T / np.sqrt(members - 1)
    expected = augmented.trajectory.Phi @ a
    np.testing.assert_allclose(factor @ factor.T, expected @ expected.T, atol=1e-10)


@pytest.mark.long
def test_an_unscented_filter_as_arrays_is_a_loop_over_its_points(data):
    filter_ = arrays.Unscented(arrays.Stack(data))
    augmented = Augmented(data)
    n, k = augmented.n, augmented.k
    mean, root = np.append(augmented.start, np.zeros(k)), np.vstack([np.zeros((n, k)), np.eye(k)])
    spread = np.sqrt(k + 1.0)
    for at in range(1, len(data)):
        filter_.step(at)
        centre = augmented.forecast(mean, at)
        above = np.array([augmented.forecast(mean + spread * x, at) for x in root.T])
        below = np.array([augmented.forecast(mean - spread * x, at) for x in root.T])
        mean = (centre + 0.5 * (above + below).sum(axis=0)) / (k + 1.0)
        root = (above - below).T / (2.0 * spread)
        shown = augmented.output(mean, at)
        H = np.array([augmented.output(mean + x, at) - shown for x in root.T]).T
        S = H @ H.T + np.diag(data.noise**2)
        mean = mean + root @ H.T @ np.linalg.solve(S, data.z[at] - shown)
        left = np.eye(k) - H.T @ np.linalg.solve(S, H)
        root = root @ np.linalg.cholesky(left)
        covariance = root[n:] @ root[n:].T
        np.testing.assert_allclose(filter_.a, mean[n:], atol=1e-9)
        np.testing.assert_allclose(filter_.C @ filter_.C.T, covariance, atol=1e-9)
        # Points at other columns of the same covariance would be other points.
        filter_.U, filter_.C = (
            full(augmented, root[:n], filter_.stack.matrices.order),
            root[n:].copy(),
        )


def full(augmented, columns, order):
    """Return columns of the state on all coefficients, in the order of the band."""
    whole = np.zeros((augmented.model.X.dim, columns.shape[1]))
    whole[augmented.free] = columns
    return whole[order]
