"""Tests of the equation on the observed part: whether the model of `GradientLaw` holds there.

With test functions p_j that vanish outside of omega the equation error of the data,

    a_k = (eps_k, p_j),        eps = M u_alpha' + B(u_alpha) + A(u_alpha) q - F,

needs nothing but the data and q. If model and q are right, all of it comes from the noise of
u_alpha, and the noise of one sample is in eps of this sample and, by the derivative, of the next.
So the products (a_k, a_{k-2}) have the mean zero, whatever the level of the noise, and the scatter
of their sum follows from the products themselves. What a wrong model leaves goes on from sample to
sample. Its size, less three standard deviations of that sum, is compared with what q does and what
the process does,

    (A(u_alpha) q, p_j),        (M u_alpha', p_j),

and for a law that is tuned by the prior with (A(u_alpha) e, p_j), e drawn from the prior: an error
of a few per cent of them is that of mesh, time step and smoothing. Sums weigh the sample k by k^2:
they forget the start, when q was not yet learned. The bounds were chosen on rods and squares with
right models and wrong ones (`benchmarks.silent.unjudged`): with a right model and a q that is
learned 0.1 is left at most, and up to 0.15 where a constant gain has not learned a field yet.

Nothing of this sees the process outside of omega, nor errors of mesh and step by themselves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from livepde.fem import Moment
from livepde.laws.coupled.split_forms import StageForms
from livepde.linalg import Array
from livepde.model import Model, h1_form, mass_form
from livepde.spaces import HilbertSpace
from livepde.verdict import FEWEST, Finding, Severity, Verdict, too_few
from livepde.verdict.sentences import FINDINGS, percent

TESTS = 8  # test functions: random, and smooth
DEVIATIONS = 3.0  # of the sum of products, that may be chance
LASTS = 0.15  # error that goes on, over what q and the process do, from which it is a caution
GRAVE = 0.3  # the same, from which the estimate is not to be trusted
POWER = 2  # of the number of a sample, that weighs it
UNTESTED = (
    "the mesh and the time step: this law does not estimate their errors",
    "a refit of all samples: this law has none",
    "intervals: this law has no covariance",
    "correlation of the noise in time",
)
OUTSIDE = "the process outside the observed part"


@dataclass(frozen=True, eq=False)
class EquationLedger:
    """Running sums over the equation errors of the data, in constant memory."""

    samples: int  # number of samples that were tested
    rests: int  # number of samples in which q was held because nothing excited it
    last: Array  # the errors a of the last two samples, shape (2, TESTS); NaN before
    # Weighed sums of (a_k, a_{k-2}), of its square, and of the squared terms that it is compared
    # with, shape (3,).
    sums: Array

    @classmethod
    def none(cls) -> EquationLedger:
        """Return the value before any sample."""
        return cls(samples=0, rests=0, last=np.full((2, TESTS), np.nan), sums=np.zeros(3))

    def add(self, error: Array, square: float) -> EquationLedger:
        """Return the value after a sample.

        `error`: the errors a, shape (TESTS,). `square`: the sum of the squared terms that they are
        compared with.
        """
        samples, sums = self.samples + 1, self.sums
        product = float(error @ self.last[0])
        if math.isfinite(product + square):  # the third sample in a row, or a later one
            weight = float(samples) ** POWER
            sums = sums + np.array([weight * product, (weight * product) ** 2, weight * square])
        return replace(self, samples=samples, last=np.stack([self.last[1], error]), sums=sums)

    def interrupted(self) -> EquationLedger:
        """Return the value after a sample that could not be tested."""
        return replace(self, last=np.full_like(self.last, np.nan))

    @property
    def lasting(self) -> float:
        """Persistent part of the equation error, over what q and the process do; at least 0."""
        product, square, terms = self.sums.tolist()
        surely = product - DEVIATIONS * math.sqrt(square)
        return math.sqrt(max(surely, 0.0) / terms) if terms > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class ObservedEquation:
    """The equation of one step, on the observed part."""

    error: Array  # the equation error R^T eps at its end, shape (n,)
    rate: Array  # R^T M u_alpha', shape (n,)
    # State and parameter that A is evaluated at.
    w: Array
    q: Array
    moment: Moment  # time and inputs at its end


class EquationTests:
    """Test functions within omega, and the judgement of what they see.

    `forms`: forms of a stage of all sensors. `prior`: columns V, shape (m, k), with the covariance
    V V^T of q that a prior states; none where the law does not go by the prior.
    """

    def __init__(self, forms: StageForms, prior: Array) -> None:
        omega = forms.split.omega
        self.forms = forms
        self.partial = omega is not None and len(omega) < forms.model.mesh.nelements
        self.prior = prior
        self.functions = self._functions(forms.model)

    def _functions(self, model: Model) -> Array:
        """Return the test functions, shape (n, TESTS); no columns where the data are no function.

        They minimise a Dirichlet integral under a white load, so that rough noise has little part.
        """
        free = self.forms.tests.free
        if self.forms.W is not None or not free.any():
            return np.zeros((model.X.dim, 0))
        extent = float(np.ptp(model.mesh.p, axis=1).max())
        mass = model.bilinear(mass_form)
        # u v + extent^2 grad u . grad v: with the size of the domain both terms have one unit.
        smooth = mass + extent**2 * (model.bilinear(h1_form) - mass)
        space = HilbertSpace(sp.csr_array(smooth), "tests", np.flatnonzero(free == 0.0))
        load = np.random.default_rng(0).standard_normal((model.X.dim, TESTS))
        p: Array = np.asarray(space.riesz(np.sqrt(mass.diagonal())[:, None] * load))
        found: Array = p / np.sqrt((p * (mass @ p)).sum(axis=0))
        return found

    @property
    def possible(self) -> bool:
        """Whether the data determine the state somewhere, so that its equation can be tested."""
        return bool(self.functions.shape[1])

    def add(self, ledger: EquationLedger, at: ObservedEquation) -> EquationLedger:
        """Return the ledger after a sample."""
        p = self.functions
        seen = self.forms.A_in.matrix("v", "q", at.moment, u=at.w, q=at.q).T @ p  # (m, TESTS)
        terms = np.concatenate([[at.q @ seen, at.rate @ p], self.prior.T @ seen])
        return ledger.add(at.error @ p, float((terms**2).sum()))

    def verdict(self, ledger: EquationLedger) -> Verdict:
        """Return the verdict on a run with this ledger."""
        rests = [rested(ledger.rests)] if ledger.rests else []
        if not self.possible:
            why = "the sensors do not determine the state on any part of the domain"
            return Verdict.of(rests, (f"the equation: {why}", *UNTESTED), judged=False)
        outside = (OUTSIDE,) if self.partial else ()
        if ledger.samples < FEWEST:
            why = too_few("the equation", ledger.samples)
            return Verdict.of(rests, (why, *outside, *UNTESTED), judged=False)
        return Verdict.of([*_misfit(ledger), *rests], (*outside, *UNTESTED))


def rested(count: int, when: str = "") -> Finding:
    """Return the note that q was held because nothing excited it; `when` as in ", last at noon"."""
    text, _ = FINDINGS["rest"].filled(count=count, when=when)
    return Finding("rest", "note", text, "unknowns", float(count))


def _misfit(ledger: EquationLedger) -> list[Finding]:
    size = ledger.lasting
    if size < LASTS:
        return []
    text, remedy = FINDINGS["misfit, equation"].filled(size=percent(size))
    severity: Severity = "do not trust" if size >= GRAVE else "caution"
    return [Finding("misfit", severity, text, evidence=size, remedy=remedy)]
