"""Tests of `GradientLaw`: an excitation gate for q, and model checks by the equation error.

*Excitation.* The law holds q while only noise excites it.

The law multiplies r by A(w), w = u_alpha + P u. At rest A(w) is noise that is correlated with the
noise of r. Their product has a nonzero mean, with which q drifts. Noise is independent from sample
to sample; an excitation that is resolved in time is not. With the vector a_k of (A(w_k) e, p) for a
few fixed e and p, the mean of

    (a_k, a_{k-1}) / (|a_k| |a_{k-1}|)

is about 1 for an excitation, and 0 for noise. It may also be 0 for a process faster than the
samples. Therefore two more criteria must hold: |a|^2 has fallen, and its remainder consists of
changes that the estimate u^ does not follow. With b_k = (A(w_k) e, p) - (A(u^_k) e, p), the mean of

    |b_k - b_{k-1}|^2 / (|a_k|^2 + |a_{k-1}|^2)

is about 1 for noise. It is far smaller if the estimate follows exact data, or still has a transient
error. The gate closes only if all three criteria hold.

*Equation.* The observed part of the equation is tested. With test functions p_j that vanish outside
omega, the equation error of the data,

    a_k = (eps_k, p_j),        eps = M u_alpha' + B(u_alpha) + A(u_alpha) q - F,

depends only on the data and q. If model and q are right, eps is due to the noise of u_alpha. The
noise of one sample enters eps of this sample and, by the derivative, of the next sample. So the
products (a_k, a_{k-2}) have mean zero for every noise level, and the scatter of their sum follows
from the products themselves. The error of a wrong model persists from sample to sample. Its size,
less three standard deviations of the sum, is compared with the terms of the unknown and the process

    (A(u_alpha) q, p_j),        (M u_alpha', p_j),

and with (A(u_alpha) e, p_j), e drawn from the prior, if the gain follows from the prior. An error
of a few per cent of these terms is due to mesh, time step and smoothing. Sums weight sample k by
k^2, to forget the start, when q was not yet learned. The bounds were chosen on rods and squares
with right and wrong models (`benchmarks.silent.unjudged`): with a right model and a converged q the
persistent error is at most 0.1; it is up to 0.15 while a constant gain has not yet learned a field.

These tests do not detect errors outside omega, nor errors of mesh and step on their own.
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
TESTS = 8  # number of random smooth test functions
DEVIATIONS = 3.0  # standard deviations of the sum of products that are attributed to chance
LASTS = 0.15  # least persistent error, relative to the terms of q and the process, for a caution
GRAVE = 0.3  # least persistent error for the severity "do not trust"
POWER = 2  # exponent of the sample number in the weight of a sample
UNTESTED = (
    "the mesh and the time step: this law does not estimate their errors",
    "a refit of all samples: this law has none",
    "intervals: GradientLaw has no covariance, SensitivityLaw has one",
    "correlation of the noise in time",
)
OUTSIDE = "the process outside the observed part"


@dataclass(frozen=True)
class ExcitationGate:
    """Holds q of `GradientLaw` with a constant gain while only noise excites it.

    A step holds q and updates u if three criteria held for exponentially weighted means up to the
    previous sample. The correlation of the excitation of q between successive samples was below
    `correlation`. Its mean square was below `energy` times the largest correlated mean square. More
    than the share `noise` of it was changes between samples that the estimate did not follow. An
    unknown with an evolution (evolution=) still evolves. The diagnostic is "at_rest".

    Noise that is correlated in time, for example after an averaging stream stage, does not count as
    noise. If it is at least a third of the excitation, the gate does not detect rests.

    Parameters
    ----------
    window
        Number of samples that the means remember, >= 1.
    correlation
        Least correlation of an excitation, in (0, 1).
    energy
        Mean square at a rest, relative to the largest correlated mean square, in (0, 1).
    noise
        Least share of noise in the mean square at a rest, in (0, 1).
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
        """Return True at a rest, when q is held."""
        return (
            excitation.correlation < self.correlation
            and excitation.energy < self.energy * excitation.largest
            and excitation.noise > self.noise
        )

    def add(self, excitation: ExcitationLevel, a: Array, followed: Array) -> ExcitationLevel:
        """Return the excitation after a sample, from probes at w and at the estimate, (PROBES,)."""
        # Exponentially weighted means with weight 1/window of the new value.
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
        # b_k of the module docstring, and the share of noise in the square.
        left, noise = a - followed, excitation.noise
        if scale > 0.0:
            jump = left - excitation.left
            noise += share * (min(float(jump @ jump) / (size + excitation.size), 1.0) - noise)
        return ExcitationLevel(a, left, size, correlation, energy, correlated, largest, noise)


@dataclass(frozen=True, eq=False)
class ExcitationLevel:
    """Statistics of the excitation of q, to distinguish it from noise."""

    # Probe values at w in the last sample, their difference to the values at the estimate, shape
    # (PROBES,), and the squared norm of the values.
    last: Array
    left: Array
    size: float
    # Exponentially weighted means of the correlation of successive samples, of the square, and of
    # the product with the previous sample, in which noise and outliers have little weight.
    correlation: float
    energy: float
    correlated: float
    largest: float  # the largest `correlated`
    noise: float  # exponentially weighted mean of the share of noise in the square

    @classmethod
    def none(cls) -> ExcitationLevel:
        return cls(np.zeros(PROBES), np.zeros(PROBES), 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)


class Probes:
    """(A(w) e_k, p_k) for fixed random pairs: each unknown of e_k has norm 1 in Q, p_k = R p_k.

    p_k minimises a Dirichlet integral under a white load in the range of R. It is smooth, so that
    rough parts of w, such as noise, have little weight.
    """

    def __init__(self, model: Model, split: Split) -> None:
        self.form = model.form_A
        self.fixed: Array | None = None
        self.pairs = p, e = pairs(model, split)
        # If (A(w) e, p) is linear in w, it is a matrix product with one row for each pair.
        vq, qu = self.form.tensor("v", "q"), self.form.tensor("q", "u")
        if vq is not None and qu is not None:
            pattern = self.form.pattern("q", "u")
            rows = [pattern.matrix(qu @ p_k).T @ e_k for p_k, e_k in zip(p.T, e.T, strict=True)]
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
    """Return the random functions p and e of `Probes`, shapes (n, PROBES) and (m, PROBES)."""
    rng = np.random.default_rng(0)
    mass, smooth = _smooth_gram(model)
    parts = split.R.T @ smooth @ split.R + split.P.T @ smooth @ split.P
    space = HilbertSpace(sp.csr_array(parts), "probes", model.state_space.fixed)
    # White load: independent values whose variances are the diagonal of the mass matrix.
    root = np.sqrt(mass.diagonal())[:, None]
    white = root * rng.standard_normal((model.X.dim, PROBES))
    p = np.asarray(split.R @ space.riesz(split.R.T @ white))
    # A copy of the space, so that a large factor is not cached in the model.
    e = copy(model.Q).riesz(rng.standard_normal((model.Q.dim, PROBES)))
    # Each unknown is normalised separately: units do not affect its weight.
    for part in (item.part for item in model.latent.parts.values()):
        for e_k in e.T:
            alone = np.zeros_like(e_k)
            alone[part] = e_k[part]
            size = float(alone @ model.Q.dual(alone))
            e_k[part] /= np.sqrt(size) if size > 0.0 else 1.0
    return p, e


def _smooth_gram(model: Model) -> tuple[Any, Any]:
    """Return the matrices of u v and u v + L^2 grad u . grad v, with the size L of the domain."""
    extent = float(np.ptp(model.mesh.p, axis=1).max())
    mass = model.bilinear(mass_form)
    return mass, mass + extent**2 * (model.bilinear(h1_form) - mass)  # both have the same unit


@dataclass(frozen=True, eq=False)
class EquationLedger:
    """Running sums over the equation errors of the data, in constant memory."""

    samples: int  # number of tested samples
    rests: int  # number of samples in which the gate held q
    last: Array  # errors a of the last two samples, shape (2, TESTS); NaN if unknown
    # Weighted sums of (a_k, a_{k-2}), of its square, and of the squares of the reference terms,
    # shape (3,).
    sums: Array

    @classmethod
    def none(cls) -> EquationLedger:
        return cls(samples=0, rests=0, last=np.full((2, TESTS), np.nan), sums=np.zeros(3))

    def add(self, error: Array, square: float) -> EquationLedger:
        samples, sums = self.samples + 1, self.sums
        product = float(error @ self.last[0])
        if math.isfinite(product + square):  # from the third consecutive sample on
            weight = float(samples) ** POWER
            sums = sums + np.array([weight * product, (weight * product) ** 2, weight * square])
        return replace(self, samples=samples, last=np.stack([self.last[1], error]), sums=sums)

    def interrupted(self) -> EquationLedger:
        """Return the sums after a sample that could not be tested."""
        return replace(self, last=np.full_like(self.last, np.nan))

    @property
    def lasting(self) -> float:
        """Persistent equation error relative to the terms of q and the process, >= 0."""
        product, square, terms = self.sums.tolist()
        surely = product - DEVIATIONS * math.sqrt(square)
        return math.sqrt(max(surely, 0.0) / terms) if terms > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class ObservedEquation:
    """Terms of the equation of one step, on the observed part."""

    error: Array  # equation error R^T eps at the end of the step, shape (n,)
    rate: Array  # R^T M u_alpha', shape (n,)
    # State and parameter at which A is evaluated.
    w: Array
    q: Array
    moment: Moment  # time and inputs at the end of the step


class EquationTests:
    """Test functions with support in omega, and the verdict from their products.

    `forms`: forms of the stage with all sensors. `prior`: columns V, shape (m, k), of the prior
    covariance V V^T of q; no columns if the law does not use the prior.
    """

    def __init__(self, forms: StageForms, prior: Array) -> None:
        omega = forms.split.omega
        self.forms = forms
        self.partial = omega is not None and len(omega) < forms.model.mesh.nelements
        self.prior = prior
        self.functions = self._functions(forms.model)

    def _functions(self, model: Model) -> Array:
        """Return test functions, (n, TESTS); no columns if the data do not determine w on omega.

        They minimise a Dirichlet integral under a white load, so that rough noise has little
        weight.
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
        """Whether the data determine the state on a part of the domain, as the tests require."""
        return bool(self.functions.shape[1])

    def add(self, ledger: EquationLedger, at: ObservedEquation) -> EquationLedger:
        p = self.functions
        A_p = self.forms.A_in.matrix("v", "q", at.moment, u=at.w, q=at.q).T @ p  # (m, TESTS)
        terms = np.concatenate([[at.q @ A_p, at.rate @ p], self.prior.T @ A_p])
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
    """Return the note that q was held at rest; `when` is a phrase such as ", last at noon"."""
    text, _ = FINDINGS["rest"].filled(count=count, when=when)
    return Finding("rest", "note", text, "unknowns", float(count))


def _misfit(ledger: EquationLedger) -> list[Finding]:
    size = ledger.lasting
    if size < LASTS:
        return []
    text, remedy = FINDINGS["misfit, equation"].filled(size=percent(size))
    severity: Severity = "do not trust" if size >= GRAVE else "caution"
    return [Finding("misfit", severity, text, evidence=size, remedy=remedy)]
