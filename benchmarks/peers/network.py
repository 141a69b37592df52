"""Physics-informed neural network of DeepXDE for the paper's equation."""

from __future__ import annotations

from functools import partial
from time import process_time
from typing import Any

import numpy as np

from benchmarks.peers.augmented import Augmented, best
from benchmarks.problems import Data
from benchmarks.scoring import Judge, Score
from livepde.reproduce import seed_excited

EPOCHS = 10_000  # training epochs, each with new collocation points and values
COLLOCATION = 500
BATCH = 500
WEIGHTS = (10.0, 100.0)  # weights of the data; the equation has weight 1
RATE = 3e-3  # initial learning rate, halved after each quarter of the epochs
WAVES = 16  # number of sines and of cosines of time among the inputs
LAYERS = (32, 32, 32)


def network(data: Data) -> Score | None:
    """Train DeepXDE's network for u and the reduced coordinates; None except `seed-excited`."""
    if data.problem.name != "seed-excited":
        return None
    return best(
        data,
        {
            f"{EPOCHS} epochs, {COLLOCATION} collocation points and {BATCH} values each, weight of "
            f"the data {weight:g}": partial(_network_run, weight)
            for weight in WEIGHTS
        },
    )


def _network_run(weight: float, data: Data) -> Score:
    import deepxde
    import torch

    deepxde.config.set_random_seed(0)
    augmented, model, times = Augmented(data), data.process.model, data.process.times
    last = float(times[-1])

    # The data are nodal values of the Hermite elements; their nodal slopes are mostly noise.
    nodes = np.linspace(0.0, 1.0, seed_excited.N)[1:-1]
    values = model.state_space.probe(nodes[None]).toarray()
    exact_start = values @ model.initial(data.process.u0, augmented.moments[0])
    seen = data.z[1:] @ data.observed.G.toarray() @ values.T

    grid = np.linspace(0.0, 1.0, 401)
    at_grid = model.parameter_space.probe(grid[None]).toarray()
    table = np.column_stack([at_grid @ model.latent.prior, at_grid @ augmented.trajectory.Phi])
    shapes = torch.as_tensor(table, dtype=torch.float32)
    a = deepxde.Variable([0.0] * augmented.k)

    def q(x: Any) -> Any:
        place = x[:, 0].detach() * (len(grid) - 1)
        left = place.long().clamp(0, len(grid) - 2)
        share = (place - left)[:, None]
        here = (1 - share) * shapes[left] + share * shapes[left + 1]
        return here[:, :1] + here[:, 1:] @ a[:, None]

    def residual(x: Any, u: Any) -> Any:
        rate = deepxde.grad.jacobian(u, x, i=0, j=1)
        curvature = deepxde.grad.hessian(u, x, i=0, j=0)
        place = x.detach().numpy().astype(float)
        source = seed_excited.f(place.T[:1], place[:, 1])
        force = torch.as_tensor(source[:, None], dtype=torch.float32)
        return rate - seed_excited.D * curvature + q(x) * u - force

    t, x = np.meshgrid(times[1:], nodes, indexing="ij")
    conditions = [
        deepxde.icbc.PointSetBC(
            np.column_stack([x.ravel(), t.ravel()]), seen.reshape(-1, 1), batch_size=BATCH
        ),
        deepxde.icbc.PointSetBC(np.column_stack([nodes, 0 * nodes]), exact_start[:, None]),
    ]
    domain = deepxde.geometry.GeometryXTime(
        deepxde.geometry.Interval(0.0, 1.0), deepxde.geometry.TimeDomain(0.0, last)
    )
    task = deepxde.data.TimePDE(domain, residual, conditions, num_domain=COLLOCATION)
    waves = 2 * np.pi / last * torch.arange(1, WAVES + 1)
    net = deepxde.nn.FNN([2 + 2 * WAVES, *LAYERS, 1], "tanh", "Glorot normal")

    def features(x: Any) -> Any:
        t = x[:, 1:]
        return torch.cat([x[:, :1], t / last, torch.sin(waves * t), torch.cos(waves * t)], 1)

    net.apply_feature_transform(features)
    net.apply_output_transform(lambda x, u: 4 * x[:, :1] * (1 - x[:, :1]) * u)
    network = deepxde.Model(task, net)
    network.compile(
        "adam",
        lr=RATE,
        loss_weights=[1.0, weight, weight],
        decay=("step", EPOCHS // 4, 0.5),
        external_trainable_variables=[a],
        verbose=0,
    )
    resampled = deepxde.callbacks.PDEPointResampler(period=1, bc_points=True)
    start = process_time()
    network.train(iterations=EPOCHS, display_every=EPOCHS, callbacks=[resampled], verbose=0)
    seconds = process_time() - start
    judge = Judge(data)
    q_found, _ = augmented.known(a.detach().numpy().astype(float), None)
    error, _ = judge.judged([(len(data) - 1, q_found, None)])
    return Score(error, step=seconds / len(data) / data.forward)
