"""The process on a mesh whose elements are halved: for the shadow of the mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.fem import FieldBlock, Moment
from livepde.laws.law import Problem
from livepde.linalg import Array, IntArray, compact
from livepde.model import Model
from livepde.observation import Observed
from livepde.stepping import KeptFactors, MemberStage, StageOfMembers, member_stage


@dataclass(frozen=True, eq=False)
class HalvedMesh:
    """A model on the halved mesh, its sensors, and the maps between both meshes."""

    # The process, its observation, and its implicit stage.
    model: Model
    observed: Observed
    stage: MemberStage
    # Prolongation of the state, shape (N, n), and of the latent parameter, shape (M, m).
    P: sp.csr_array | Array
    unknowns: sp.csr_array
    at: IntArray  # which coefficient of the halved mesh is that of each of the mesh, shape (n,)

    @classmethod
    def of(cls, problem: Problem) -> HalvedMesh:
        """Return the process on the halved mesh; raises `LivepdeError` if there is none."""
        coarse, fine = problem.model, problem.model.refined()
        spaces = (fine.state_space, fine.X, fine.parameter_space)
        observed = problem.observed.observation.bind(*spaces)
        P = coarse.state_space.prolongation(fine.state_space)
        # An unknown that moves may have several components, each with the coefficients of a block.
        pairs = zip(coarse.latent.parts.values(), fine.latent.parts.values(), strict=True)
        blocks = [
            sp.kron(sp.eye_array(one.evolution.copies), one.block.prolongation(other.block))
            for one, other in pairs
        ]
        unknowns = sp.csr_array(sp.block_diag(blocks, format="csr"))
        stage: MemberStage = member_stage(fine)
        if any(isinstance(part.block, FieldBlock) for part in coarse.latent.parts.values()):
            stage = _Prolonged(stage, unknowns)
        # A node of the mesh is one of the halved mesh: its row has a single one.
        alone = np.flatnonzero(np.abs(P.max(axis=1).toarray().ravel() - 1.0) < 1e-9)
        at = np.empty(P.shape[1], dtype=np.int64)
        at[np.asarray(P[alone].argmax(axis=1)).ravel()] = alone
        return cls(fine, observed, stage, compact(P), unknowns, at)

    @cached_property
    def G(self) -> sp.csr_array | Array | None:
        """Observation matrix of the state, shape (sensors, N), if it is constant; else None."""
        observation = self.observed.observation
        if type(self.observed) is not Observed or observation.directs or observation.inputs:
            return None
        return compact(self.observed.G)

    def prolong(self, u: Array) -> Array:
        """Return states on the halved mesh, shape (members, N) for (members, n)."""
        return np.asarray((self.P @ u.T).T)

    def initial_difference(self, given: Any, q: Array, u: Array, moment: Moment | None) -> Array:
        """Return the initial state on the halved mesh minus that of the given mesh, shape (N,).

        `given`: the initial state as a user gave it; given coefficients do not define values at the
        new nodes, so that the difference is zero then. `moment`: time and inputs of the start; None
        if not known yet, and the difference is zero then. `q`, `u`: latent parameter and initial
        state, shapes (m,) and (n,).
        """
        coarse = self.prolong(u[None])[0]
        if moment is None:
            return np.zeros_like(coarse)
        if self.model.form_initial is not None:
            return np.asarray(self.model.initial_state(self.unknowns @ q, moment) - coarse)
        if given is None or not _pointwise(given):
            return np.zeros_like(coarse)
        return np.asarray(self.model.initial(given, moment) - coarse)

    def in_readings(
        self, u: Array, q: Array, difference: Array, moment: Callable[[int], Moment]
    ) -> Array:
        """Return the readings of differences on the halved mesh, (members, sensors)."""
        if self.G is not None:
            return np.asarray((self.G @ difference.T).T)
        # Sensors without one constant matrix: their derivative at the prolonged state.
        at, found = self.prolong(u), []
        for k, more in enumerate(difference):
            physical = self.model.latent.value(self.unknowns @ q[k])
            found.append(self.observed.jacobian(at[k], physical, moment(k))[0] @ more)
        return np.array(found)


def refusal(problem: Problem, largest: int) -> str:
    """Return why a process is not followed on the halved mesh; empty if it is."""
    model = problem.model
    size = model.X.dim * 2 ** model.mesh.dim()
    if size > largest:
        return (
            f"the state has about {size} coefficients on the halved mesh, more than `largest` = "
            f"{largest} of the shadows"
        )
    if not problem.observed.observation.portable:
        return "the readings of its sensors are coefficients of the given mesh"
    return ""


def _pointwise(given: Any) -> bool:
    """Return whether an initial state is given at every point of the domain."""
    if isinstance(given, Mapping):
        return all(_pointwise(part) for part in given.values())
    return callable(given) or np.ndim(given) == 0


class _Prolonged(MemberStage):
    """A stage on the halved mesh that takes unknown fields as those of the mesh have them."""

    def __init__(self, stage: MemberStage, unknowns: sp.csr_array) -> None:
        self.stage = stage
        self.unknowns = unknowns

    def twin(self) -> _Prolonged:
        return _Prolonged(self.stage.twin(), self.unknowns)

    def kept(self, members: int) -> KeptFactors:
        return self.stage.kept(members)

    def advance(self, columns: Array, stage: StageOfMembers) -> tuple[Array, KeptFactors]:
        q = np.asarray((self.unknowns @ stage.q.T).T)
        none = np.zeros((len(q), 0, self.unknowns.shape[0]))
        return self.stage.advance(columns, stage._replace(q=q, directions=none))
