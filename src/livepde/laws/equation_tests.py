"""Tests of `GradientLaw` on its own equation: what excites q, and whether the model holds.

*Excitation.* The law holds q while nothing but noise excites it.

The law multiplies r by A(w), w = u_alpha + P u. At rest A(w) is noise, the same as in r, so that
their product has a mean, and q drifts with it. Noise is independent from sample to sample, and an
excitation that is resolved in time is not: with the vector a_k of (A(w_k) e, p) for a few fixed e
and p, the mean of

    (a_k, a_{k-1}) / (|a_k| |a_{k-1}|)

is about 1 for an excitation, and 0 for noise. It may be 0 for a process faster than the samples,
too. So |a|^2 must have fallen, and the rest of it must be change that the estimate u^ does not
follow: with b_k of (A(w_k) e, p) - (A(u^_k) e, p) the mean of

    |b_k - b_{k-1}|^2 / (|a_k|^2 + |a_{k-1}|^2)

is about 1 for noise, and far smaller where the estimate follows exact data, or is still off after a
transient. Only all three together close the gate.

*Equation.* The tests are of the equation on the observed part.
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
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LawError
from livepde.fem import Moment
from livepde.laws.coupled.equation import StageForms
from livepde.linalg import Array
from livepde.model import Model, h1_form, mass_form
from livepde.observation import Split
from livepde.spaces import HilbertSpace
from livepde.verdict import FEWEST, Finding, Severity, Verdict, too_few
from livepde.verdict.sentences import FINDINGS, percent

PROBES = 16  # pairs of random functions: their products scatter by a quarter
TESTS = 8  # test functions: random, and smooth
DEVIATIONS = 3.0  # of the sum of products, that may be chance
LASTS = 0.15  # error that goes on, over what q and the process do, from which it is a caution
GRAVE = 0.3  # the same, from which the estimate is not to be trusted
POWER = 2  # of the number of a sample, that weighs it
UNTESTED = (
    "the mesh and the time step: this law does not estimate their errors",
    "a refit of all samples: this law has none",
    "intervals: GradientLaw has no covariance, SensitivityLaw has one",
    "correlation of the noise in time",
)
OUTSIDE = "the process outside the observed part"


@dataclass(frozen=True)
class ExcitationGate:
    """Holds q of `GradientLaw` with a constant gain while nothing but noise excites it.

    A step holds q, and u goes on, if up to the sample before, in fading means, the excitation of q
    was correlated from sample to sample by less than `correlation`, its mean square was less than
    `energy` of the largest that was correlated, and more than the share `noise` of it changed from
    sample to sample as the estimate did not. An unknown that moves by itself (evolution=) goes on
    by that. Note: "at_rest".

    Noise that is itself correlated in time, as behind a stream stage that averages, is no noise
    here; where it is a third of the excitation or more, rests are not told from it.

    Parameters
    ----------
    window
        Samples that the means remember, >= 1.
    correlation
        Least correlation of an excitation, in (0, 1).
    energy
        Share of the largest mean square to which a rest has fallen, in (0, 1).
    noise
        Share of the square that is noise at a rest, in (0, 1).
    """

    window: float = 30.0
    correlation: float = 0.5
    energy: float = 0.1
    noise: float = 0.25

    def __post_init__(self) -> None:
        if not (np.isfinite(self.window) and self.window >= 1):
            raise LawError(f"ExcitationGate: window must be a number >= 1; got {self.window}.")
        for name in ("correlation", "energy", "noise"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise LawError(f"ExcitationGate: {name} must lie between 0 and 1; got {value}.")

    def closed(self, excitation: ExcitationLevel) -> bool:
        """Return true at a rest: q is held."""
        return (
            excitation.correlation < self.correlation
            and excitation.energy < self.energy * excitation.largest
            and excitation.noise > self.noise
        )

    def add(self, excitation: ExcitationLevel, a: Array, followed: Array) -> ExcitationLevel:
        """Return the excitation after a sample, from probes at w and at the estimate, (PROBES,)."""
        # Fading means: each moves by the share 1/window towards its new value.
        size = float(a @ a)
        scale = math.sqrt(size * excitation.size)
        share = 1.0 / self.window
        product = float(a @ excitation.last)
        correlation = excitation.correlation
        if scale > 0.0:
            correlation += share * (product / scale - correlation)
        energy = excitation.energy + share * (size - excitation.energy)
        correlated = excitation.correlated + share * (product - excitation.correlated)
        largest = max(excitation.largest, correlated)
        # b_k of the docstring of this module, and the share of the square that is noise.
        left, noise = a - followed, excitation.noise
        if scale > 0.0:
            jump = left - excitation.left
            noise += share * (min(float(jump @ jump) / (size + excitation.size), 1.0) - noise)
        return ExcitationLevel(a, left, size, correlation, energy, correlated, largest, noise)


@dataclass(frozen=True, eq=False)
class ExcitationLevel:
    """Statistics of the excitation of q, to distinguish it from noise."""

    # Values of the probes in the last sample, and their difference from those at the estimate,
    # shape (PROBES,); and the squared norm of the values.
    last: Array
    left: Array
    size: float
    # Fading means: of the correlation of successive samples, of the square, and of the product with
    # the sample before, in which noise and outliers have little part.
    correlation: float
    energy: float
    correlated: float
    largest: float  # the largest `correlated`
    noise: float  # fading mean of the share of the square that is noise

    @classmethod
    def none(cls) -> ExcitationLevel:
        return cls(np.zeros(PROBES), np.zeros(PROBES), 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)


class Probes:
    """(A(w) e_k, p_k) for fixed random pairs: e_k in the unit balls of Q, p_k = R p_k.

    p_k minimises a Dirichlet integral under a white load, in the range of R: so the rough parts of
    w, such as noise, do not outweigh the smooth ones.
    """

    def __init__(self, model: Model, split: Split) -> None:
        self.form = model.form_A
        self.fixed: Array | None = None
        self.pairs = p, e = pairs(model, split)
        # Where (A(w) e, p) is linear in w, it is one product with a row for each pair.
        vq, qu = self.form.tensor("v", "q"), self.form.tensor("q", "u")
        if vq is not None and qu is not None:
            pattern = self.form.pattern("q", "u")
            rows = [pattern.matrix(qu @ one).T @ other for one, other in zip(p.T, e.T, strict=True)]
            self.fixed = np.array(rows)
            self.pairs = np.zeros((0, PROBES)), np.zeros((0, PROBES))  # no longer needed

    def __call__(self, states: Array, q: Array, moment: Moment) -> Array:
        """Return the probe values of several states, shapes (n, k) -> (PROBES, k)."""
        if self.fixed is not None:
            return self.fixed @ states
        p, e = self.pairs
        matrices = (self.form.matrix("v", "q", moment, u=w, q=q) for w in states.T)
        return np.stack([((A @ e) * p).sum(axis=0) for A in matrices], axis=1)


def pairs(model: Model, split: Split) -> tuple[Array, Array]:
    """Return p and e of the probes, shapes (n, PROBES) and (m, PROBES)."""
    rng = np.random.default_rng(0)
    mass, smooth = _smooth_gram(model)
    parts = split.R.T @ smooth @ split.R + split.P.T @ smooth @ split.P
    space = HilbertSpace(sp.csr_array(parts), "probes", model.state_space.fixed)
    # A white load: independent, with the variances on the diagonal of the mass matrix.
    root = np.sqrt(mass.diagonal())[:, None]
    white = root * rng.standard_normal((model.X.dim, PROBES))
    p = np.asarray(split.R @ space.riesz(split.R.T @ white))
    # A copy of the space: the factor of a large one is not kept.
    found = copy(model.Q).riesz(rng.standard_normal((model.Q.dim, PROBES)))
    # Each unknown by itself, so that one in another unit does not outweigh it.
    for part in (item.part for item in model.latent.parts.values()):
        for e in found.T:
            alone = np.zeros_like(e)
            alone[part] = e[part]
            size = float(alone @ model.Q.dual(alone))
            e[part] /= np.sqrt(size) if size > 0.0 else 1.0
    return p, found


def _smooth_gram(model: Model) -> tuple[Any, Any]:
    """Return the matrices of u v and u v + L^2 grad u . grad v, with the size L of the domain."""
    extent = float(np.ptp(model.mesh.p, axis=1).max())
    mass = model.bilinear(mass_form)
    return mass, mass + extent**2 * (model.bilinear(h1_form) - mass)  # both have one unit


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
        return cls(samples=0, rests=0, last=np.full((2, TESTS), np.nan), sums=np.zeros(3))

    def add(self, error: Array, square: float) -> EquationLedger:
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
    """Test functions within omega, and the judgement of their products.

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
        mass, smooth = _smooth_gram(model)
        space = HilbertSpace(sp.csr_array(smooth), "tests", np.flatnonzero(free == 0.0))
        load = np.random.default_rng(0).standard_normal((model.X.dim, TESTS))
        p: Array = np.asarray(space.riesz(np.sqrt(mass.diagonal())[:, None] * load))
        return np.asarray(p / np.sqrt((p * (mass @ p)).sum(axis=0)))

    @property
    def possible(self) -> bool:
        """Whether the data determine the state somewhere, so that its equation can be tested."""
        return bool(self.functions.shape[1])

    def add(self, ledger: EquationLedger, at: ObservedEquation) -> EquationLedger:
        p = self.functions
        seen = self.forms.A_in.matrix("v", "q", at.moment, u=at.w, q=at.q).T @ p  # (m, TESTS)
        terms = np.concatenate([[at.q @ seen, at.rate @ p], self.prior.T @ seen])
        return ledger.add(at.error @ p, float((terms**2).sum()))

    def verdict(self, ledger: EquationLedger) -> Verdict:
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
