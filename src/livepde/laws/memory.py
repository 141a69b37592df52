"""What the data have taught so far: how `GradientLaw(gain="auto")` tunes itself.

The first line of the method says, on the observed part, that q* leaves the equation error

    eps(q) = M u_alpha' + B(w) + A(w) q - F,        eps(q) - eps(q*) = A(w) (q - q*),

for which r, drawn in by theta, is a filter: M r/h + theta M r = M r_before/h - eps. With M_op = M
and theta = PULL/h all of r comes from the step itself, r = -h M^{-1} eps/(1 + PULL). Let eps(q*) be
noise, white in time and in X with spectral density S, and q - q0 ~ N(0, G_Q^{-1}) the prior (G_Q
is divided by the square of `std`). Then the best q given all data so far minimises

    S ||q - q0||_Q^2 + int ||R^T eps(q)||^2_{M^{-1}} dt,

and its recursion is the method's second line in the metric of the information,

    H q' = theta A(w)^T r,       H = S G_Q + J,       J = int A^T R M^{-1} R^T A dt,

recursive least squares for a field: the gain H^{-1} falls like 1/t where the data excite q, stays
that of the prior where they do not, and what early data taught stays when the excitation dies out.
For M^{-1} stands D^{-1} with a diagonal D >= M (Gershgorin), so J is as sparse as A^T A, and never
larger than what the data have taught: the gain errs to the large side, where the coupled step is
stable and only noise is lost.

S is estimated online. The equation error of a wrong q moves with the excitation and goes on, noise
turns back with the next sample: so S is read from products of successive differences of r, as far
as q can see them,

    S = mean of -c/h (A^T D r_k, A^T D r_{k-1})_{Q*} / trace(G_Q^{-1} A^T R D^{-1} R^T A),
    c = (1 + rho)/(rho^2 (1 - rho)),     rho = 1/(1 + PULL),

where c undoes the filter; the trace is that of a few fixed random probes. The mean weighs a sample
at time t by t^2: it forgets the start, and no time constant is asked for. J weighs it by t: the
first samples were taken with a wrong q and a wrong P u in w, and count less and less; of noise this
costs 15 % (the root of 4/3), and q itself is not moved by it. When S changes, H changes by dS G_Q
for all of the past; the minimiser follows by the term dS G_Q (q - q0). S is not taken below trace(
G_Q^{-1} J)/RESOLUTION: exact data would leave the equation for q singular.

Every number above is a ratio of quantities with the same units: scaling u, q (with `std`), x or t
scales the estimate with them. Nothing refers to the mesh or to the sampling interval but the noise
itself.

Whether q may be where it is says the prior. If all of this holds, q - q0 is Gaussian with the
covariance that the data have taken from that of the prior, so that ||q - q0||_Q^2 is a sum of
chi-squares with weights of at most 1, whose sum k is at most m and at most trace(G_Q^{-1} J)/S,
with a J that has not faded. It is more than k + 2 sqrt(k s) + 2 s with a probability below exp(-s)
only (Laurent and Massart 2000). Where S is too small for the errors there are (those of the mesh,
say), q takes them up and leaves its prior by far.

What S does not know is a bias: smoothing that takes too much or too little leaves an equation error
that moves with w, as a wrong q does, and q takes it up. Counting as noise what is slow in r, too
(sums of A^T r over an eighth of the elapsed time), was tried: such a bias leaves nothing in r, and
exact data are learned more slowly. What helps is smoothing without it (`livepde.laws.smoothing`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.coupled.forms import StageForms
from livepde.linalg import Array, Pattern
from livepde.model import Model

__all__ = ["Learned", "Learning"]

PULL = 10.0  # theta h: r forgets within a step
PROBES = 8  # random vectors for the trace
FORGETS = 2.0  # power of time that weighs a sample in the mean of S
FADES = 1.0  # power of time that weighs a sample in J
MOST_DENSE = 4000  # unknowns of which J may be dense
CHANCE = 1e-6  # that a right model leaves its prior
RESOLUTION = 1e7  # largest ratio of information to prior: deviations of 1 in 3000
_RHO = 1.0 / (1.0 + PULL)
_TURNS = (1.0 + _RHO) / (_RHO**2 * (1.0 - _RHO))


@dataclass(frozen=True, eq=False)
class Learned:
    """What is known after some samples.

    Attributes
    ----------
    origin
        q0, shape (m,).
    information
        Data of J, in its pattern.
    spread
        S of the last step.
    noise, seen
        The two means of which S is the quotient.
    total, given
        trace(G_Q^{-1} J), and what it would be without fading.
    elapsed, samples
        Time and number of samples.
    alike
        Of the last of them how many, before the last one, had the same sensors as that.
    last, before
        The last two r, shape (n,).
    """

    origin: Array
    information: Array
    spread: float
    noise: float
    seen: float
    total: float
    given: float
    elapsed: float
    samples: int
    alike: int
    last: Array
    before: Array


class Learning:
    """The algebra of J and S for a model; J is sparse if sensors select coefficients."""

    def __init__(self, model: Model, selects: bool) -> None:
        self.model = model
        diagonal = model.mass.diagonal()
        held = diagonal > 0.0
        root = np.sqrt(np.where(held, diagonal, 1.0))
        scale = sp.diags_array(1.0 / root)
        rows = abs(scale @ model.mass @ scale).sum(axis=1)
        self.weights = np.where(held, model.X.free / (root**2 * np.maximum(rows, 1.0)), 0.0)
        signs = np.random.default_rng(0).integers(0, 2, (model.X.dim, PROBES))
        self.probes = np.sqrt(self.weights)[:, None] * (2.0 * signs - 1.0)
        if selects:
            A = model.form_A.pattern("v", "q")
            ones = A.matrix(np.ones(A.nnz))
            self.pattern = Pattern.of(sp.csr_array(ones.T @ ones))
        elif model.Q.dim > MOST_DENSE:
            raise LawError(
                "GradientLaw: gain='auto' keeps a dense matrix of all unknowns where sensors read "
                f"no coefficients; {model.Q.dim} are too many, up to {MOST_DENSE} are possible. "
                "Give a number for gain, observe a Subdomain, or use SensitivityLaw."
            )
        else:
            self.pattern = Pattern.of(sp.csr_array(np.ones((model.Q.dim, model.Q.dim))))

    def init(self, q0: Array) -> Learned:
        """Return what is known before the first sample: nothing."""
        r = np.zeros(self.model.X.dim)
        return Learned(q0, np.zeros(self.pattern.nnz), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, r, r)

    def coupling(self, forms: StageForms, w: Array, q: Array, moment: Moment) -> sp.csr_array:
        """Return R^T A(w) over omega, on free coefficients, shape (n, m)."""
        A = forms.A_in.matrix("v", "q", moment, u=w, q=q)
        free, free_q = sp.diags_array(self.model.X.free), sp.diags_array(self.model.Q.free)
        return sp.csr_array(forms.split.R.T @ (free @ A @ free_q))

    def spread(self, learned: Learned, coupling: sp.csr_array, h: float) -> float:
        """Return S for the next step: that of the prior itself before anything is known."""
        if learned.seen > 0.0:
            return max(learned.noise / learned.seen, learned.total / RESOLUTION)
        force = coupling.T @ self.probes
        moved = self.model.Q.riesz(force)
        size = float((force * moved).sum())
        if size <= 0.0:
            return 1.0  # nothing is excited: any value keeps q where it is
        image = np.sqrt(self.weights)[:, None] * (coupling @ moved)
        return h * float((image**2).sum()) / size

    def shift(self, learned: Learned, spread: float, q: Array, h: float) -> Array:
        """Return the pull of a prior that has become heavier or lighter, per time, shape (m,)."""
        before = learned.spread if learned.samples else spread
        pull: Array = (spread - before) * self.model.Q.dual(q - learned.origin) / h
        return pull

    def departure(self, learned: Learned, spread: float, q: Array) -> float:
        """Return ||q - q0||_Q^2 over what a right model exceeds with a chance below `CHANCE`."""
        away = q - learned.origin
        told = min(float(self.model.Q.free.sum()), learned.given / spread)
        rare = -math.log(CHANCE)
        most = told + 2.0 * math.sqrt(told * rare) + 2.0 * rare
        return float(away @ self.model.Q.dual(away)) / most

    def _stored(self, gained: sp.csr_array) -> Array:
        """Return the data of what J gains, in the order of its pattern."""
        gained.sum_duplicates()
        if gained.nnz == self.pattern.nnz:  # no entry of the pattern is missing
            return gained.data
        data, coo = np.zeros(self.pattern.nnz), gained.tocoo()
        data[self.pattern.positions(coo.row, coo.col)] = coo.data
        return data

    def _product(self, coupling: sp.csr_array, one: Array, other: Array) -> float:
        """Return the inner product of two r as far as q can see them."""
        return float((coupling.T @ one) @ self.model.Q.riesz(coupling.T @ other))

    def learn(
        self,
        learned: Learned,
        spread: float,
        coupling: sp.csr_array,
        r: Array,
        h: float,
        same: bool,
    ) -> Learned:
        """Return what is known after a step of length h that ended with A(w) and r.

        `same`: the sensors are those of the sample before. What changes with them is no noise that
        turns back.
        """
        alike = learned.alike + 1 if same and learned.samples else 0
        force = coupling.T @ self.probes
        trace = float((force * self.model.Q.riesz(force)).sum()) / PROBES
        if alike < 2:  # all of r may be noise
            noise = -_TURNS * self._product(coupling, r, -r) / h
        else:
            steps = r - learned.last, learned.last - learned.before
            noise = -_TURNS * self._product(coupling, *steps) / h
        elapsed = learned.elapsed + h
        kept = max(0.0, 1.0 - FORGETS * h / elapsed)
        faded = max(0.0, 1.0 - FADES * h / elapsed)
        gained = sp.csr_array(coupling.T @ sp.diags_array(h * self.weights) @ coupling)
        return replace(
            learned,
            information=faded * learned.information + self._stored(gained),
            spread=spread,
            noise=kept * learned.noise + h * noise,
            seen=kept * learned.seen + h * trace,
            total=faded * learned.total + h * trace,
            given=learned.given + h * trace,
            elapsed=elapsed,
            samples=learned.samples + 1,
            alike=alike,
            last=r,
            before=learned.last,
        )
