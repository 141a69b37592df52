"""Checks of Hilbert spaces and of weak forms: linearity, derivatives, assembly and mass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.check_report import Check, CheckReport
from livepde.errors import LinearAlgebraError, ModelError, SpaceError
from livepde.fem import Composed, Form, Inputs, Moment
from livepde.linalg import Array, Pattern, analyse
from livepde.model import Model
from livepde.spaces import HilbertSpace

ROUNDING = 1e-12


def check_space(space: HilbertSpace, *, seed: int = 0) -> CheckReport:
    """Check symmetry, positivity and the Riesz map of a space, such as `model.X` or `model.Q`.

    Examples
    --------
    >>> import scipy.sparse as sp
    >>> import livepde as lp
    >>> check_space(lp.spaces.HilbertSpace(sp.csr_array([[2.0, 1.0], [1.0, 2.0]]))).ok
    True
    """
    rng, gram = np.random.default_rng(seed), space.tangent_gram
    lines = [
        Check.at_most(
            "G = G^T",
            relative(gram - gram.T, gram),
            ROUNDING,
            "Write the inner product as a form that does not change when u and v are exchanged.",
        ),
        definite(space),
    ]
    if lines[-1].ok:
        x = rng.standard_normal(space.dim) * space.free
        functional = rng.standard_normal(space.dim)
        y = space.riesz(functional)
        size = (space.norm(x) * space.norm(y)) or 1.0
        singular = (
            "The Gram matrix is close to singular: add a zero-order term to the inner product or "
            "fix boundary values."
        )
        lines += [
            Check.at_most(
                "(riesz(f), x) = f(x)",
                abs(space.inner(y, x) - float(functional @ x)) / size,
                ROUNDING,
                singular,
            ),
            Check.at_most(
                "riesz(dual(x)) = x",
                space.norm(space.riesz(space.dual(x)) - x) / (space.norm(x) or 1.0),
                1e-9,
                singular,
            ),
        ]
    return CheckReport(f"space {space.name}", tuple(lines), SpaceError)


def definite(space: HilbertSpace) -> Check:
    """Return the line on positive definiteness: the Gram matrix can be factorised."""
    remedy = ""
    try:
        _ = space.factor
    except (SpaceError, LinearAlgebraError) as error:
        remedy = str(error)
    return Check.at_most("G positive definite (failures)", bool(remedy), 0, remedy)


def relative(difference: sp.csr_array | Array, reference: sp.csr_array | Array) -> float:
    """Return the largest entry of a difference relative to the largest entry of a reference."""
    return relative_to(largest(difference), largest(reference))


def relative_to(error: float, size: float) -> float:
    """Return an error relative to a size; the error itself if the size is zero."""
    return error / size if size > 0 else error


def largest(matrix: sp.csr_array | Array) -> float:
    """Return the largest entry in modulus; NaN if one is not finite."""
    data = matrix.data if sp.issparse(matrix) else np.asarray(matrix)
    return float(np.abs(data).max(initial=0.0))


# Relative nonlinearity of an integrand; functions such as exp have larger rounding errors.
LINEARITY = 1e-10
# Step sizes of the Taylor tests.
STEPS = 0.5 ** np.arange(2, 22)
# Remainders below this share of the function value are rounding errors.
FLOOR = 1e-11
# Largest norm of the inverse for algebraic components, with rows scaled to size 1: beyond, their
# equations do not determine them.
LARGEST_INVERSE = 1e12
# Smallest accepted rate of a Taylor remainder, whose theoretical rate is 2.
SLOWEST = 1.8


def check_model(
    model: Model,
    *,
    q: Any = None,
    u: Any = None,
    spread: float | None = None,
    t: float = 0.0,
    inputs: Mapping[str, float] | None = None,
    seed: int = 0,
) -> CheckReport:
    """Check the forms of a model by random evaluations at typical values.

    Tested are linearity in q and in the test function v; transpose and adjoint, (A(u)* r, xi)_Q =
    <A(u) xi, r>; derivatives, by Taylor remainders f(u + s du) - f(u) - s f'(u) du, which decrease
    as s^2 or vanish for affine forms; assembled matrices against quadrature of the integrand; and
    the mass. If mass and diffusion increase with x[0] like the volume around an axis or a point,
    `Field.weight` must specify this. Components without a mass term must be determined by their
    equations. Print the report, or call `raise_if_failed`, which raises `ModelError`.

    Parameters
    ----------
    q, u
        A typical parameter (default the prior mean) and a typical state (default the initial state
        of the model, or zero): numbers, functions of x, or coefficients.
    spread
        Size of the random variations of u; default a tenth of the largest |u| of each component.
        For a component that is zero, a tenth of the largest |u| of all, or 1 if u = 0.
    t, inputs
        Time, and channel -> value; the default value of a channel is 1.
    seed
        Seed of the random vectors.

    Examples
    --------
    >>> import livepde as lp
    >>> from skfem import ElementLineP1
    >>> mesh = lp.interval(0.0, 1.0, 8)
    >>> model = lp.Model(
    ...     lp.Field(mesh, ElementLineP1()),
    ...     lp.Normal(1.0),
    ...     A=lambda q, u, v, x: q * u * v,
    ...     B=lambda u, v, x: abs(u) * v,  # has no complex derivative, and no dB= is given
    ... )
    >>> [line.name for line in check_model(model).failed]
    ["B'(u): rate of the Taylor remainder"]
    """
    rng = np.random.default_rng(seed)
    point = _TestPoint.random(model, q, u, spread, t, inputs, rng)
    lines = [
        *_finite(model, point),
        *_linear(model, point),
        *_agreement(model, point),
        *_adjoint(model, point),
        *_derivatives(model, point),
        *_mass(model),
        *_volume_element(model),
        *_algebraic(model, point),
    ]
    return CheckReport("model", tuple(lines), ModelError)


@dataclass(frozen=True, eq=False)
class _TestPoint:
    """Test point of a model: random functions of typical size, and directions du, dq."""

    moment: Moment
    q: Array
    dq: Array
    u: Array
    du: Array
    r: Array

    @classmethod
    def random(
        cls,
        model: Model,
        q: Any,
        u: Any,
        spread: float | None,
        t: float,
        inputs: Mapping[str, float] | None,
        rng: np.random.Generator,
    ) -> _TestPoint:
        unknown = set(inputs or {}) - set(model.channels)
        if unknown:
            raise ModelError(
                f"check_model: no channel is called {sorted(unknown)}; {list(model.channels)} are."
            )
        channels = {**dict.fromkeys(model.channels, 1.0), **(inputs or {})}
        moment = Moment(t, Inputs(channels))
        n, m = model.X.dim, model.Q.dim
        start = model.initial_parameter(q)
        centre = model.initial_state(start, moment) if u is None else model.initial(u, moment)
        width = _widths(model, centre, spread)
        std = model.latent.deviations
        lower, upper = model.latent.bounds
        varied = np.clip(start + std * rng.standard_normal(m), lower, upper) * model.Q.free
        return cls(
            moment,
            varied,
            std * rng.standard_normal(m) * model.Q.free,
            centre + width * rng.standard_normal(n) * model.X.free,
            width * rng.standard_normal(n) * model.X.free,
            rng.standard_normal(n) * model.X.free,
        )


def _widths(model: Model, centre: Array, spread: float | None) -> Array:
    """Return the size of the random variations of each coefficient of a state, shape (n,)."""
    common = spread or 0.1 * float(np.abs(centre).max()) or 1.0
    found = np.full(len(centre), common)
    if spread is None:
        for name in model.state_space.unknowns:
            part = model.state_space.part(name)
            found[part] = 0.1 * float(np.abs(centre[part]).max()) or common
    return found


def _densities(form: Form, moment: Moment, **coefficients: Array) -> Array:
    """Return the weighted integrand at all quadrature points, by plain evaluation of the form."""
    found = [np.zeros(1)]  # a form may have no term
    for term in (piece for whole in form.terms for _, piece in whole.pieces()):
        values = {key: local.values(coefficients[key]) for key, local in term.spaces.items()}
        density, _ = term.evaluate(values, moment)
        weights = term.measure.weights
        found.append(np.broadcast_to(np.asarray(density) * weights, weights.shape).ravel())
    return np.concatenate(found)


def _plain(form: Form | Composed) -> Form:
    """Return the form in the physical parameter."""
    return form.form if isinstance(form, Composed) else form


def _finite(model: Model, at: _TestPoint) -> list[Check]:
    values = {
        "F": model.F(at.moment),
        "B(u)": model.B(at.u, at.moment),
        "A(u)": model.A(at.u, at.moment, at.q).matrix.data,
    }
    return [
        Check.at_most(
            f"{name} finite (failures)",
            int((~np.isfinite(value)).sum()),
            0,
            f"{name} holds infinite or undefined values at the u, q and t given: check divisions, "
            "roots and logarithms, or give a typical u= and q= to check_model.",
        )
        for name, value in values.items()
    ]


def _linear(model: Model, at: _TestPoint) -> list[Check]:
    lines = []
    in_v = "write each term as a factor times v or grad(v); a term without v belongs nowhere."
    in_q = "it seemed linear at moderate values; rescale q, or write its law without thresholds."
    latent, form_A = model.latent, _plain(model.form_A)
    other = latent.value(at.q + 0.1 * at.dq)
    arguments = {"q": latent.value(at.q), "u": at.u, "v": at.r}
    others = {"q": other, "u": at.du, "v": at.du}
    cases = (
        *([(form_A, "A", "q", in_q)] if form_A.linear_in_parameter else []),
        (form_A, "A", "v", in_v),
        (model.form_B, "B", "v", in_v),
        (model.form_M, "M", "u", "M(u, v, x) must be bilinear: move what is not into B."),
        (model.form_M, "M", "v", in_v),
    )
    for form, name, slot, remedy in cases:
        base = {key: arguments[key] for key in form.spaces}
        a, b = base[slot], others[slot]
        fa, fb, both, zero = (
            _densities(form, at.moment, **{**base, slot: x}) for x in (a, b, 2 * a - 3 * b, 0 * a)
        )
        error = max(largest(both - 2 * fa + 3 * fb), largest(zero))
        size = largest(fa) + largest(fb)
        lines.append(
            Check.at_most(
                f"{name} linear in {slot}",
                relative_to(error, size),
                LINEARITY,
                f"{name} is not linear in {slot}: {remedy}",
            )
        )
    return lines


def _agreement(model: Model, at: _TestPoint) -> list[Check]:
    """Compare assembled matrices and shortcuts for affine forms with plain quadrature."""
    remedy = (
        "as assembled is not what its integrand gives: it is not linear in v or q, or it looks "
        "affine in u at moderate values and is not at the u given (a threshold far away: rescale)."
    )
    lines = []
    for name, form in (("B(u)", model.form_B), ("A(u) q", model.form_A)):
        given = {"u": at.u} if name == "B(u)" else {"u": at.u, "q": at.q}
        plain = {**given, **({"q": model.latent.value(at.q)} if "q" in given else {})}
        density = _densities(_plain(form), at.moment, **plain, v=at.r)
        value = form.vector("v", at.moment, **given) @ at.r
        size = float(np.abs(density).sum())
        error = abs(float(value - density.sum()))
        lines.append(
            Check.at_most(
                f"{name} assembled = quadrature",
                relative_to(error, size),
                LINEARITY,
                f"{name} {remedy}",
            )
        )
    return lines


def _adjoint(model: Model, at: _TestPoint) -> list[Check]:
    A = model.A(at.u, at.moment, at.q)
    transpose = model.form_A.matrix("q", "v", at.moment, u=at.u, q=at.q)
    star = A.adjoint(at.r)
    size = model.Q.norm(star) * model.Q.norm(at.dq)
    error = abs(model.Q.inner(star, at.dq) - A(at.dq) @ at.r)
    return [
        Check.at_most(
            "A(u)^T = transpose of A(u)",
            relative(transpose - A.matrix.T, A.matrix),
            ROUNDING,
            "A must be linear in v.",
        ),
        Check.at_most(
            "(A(u)* r, xi)_Q = <A(u) xi, r>",
            relative_to(float(error), size),
            ROUNDING,
            "The inner product of the parameter is close to singular: use inner='H1', or fix "
            "boundary values.",
        ),
    ]


def _derivatives(model: Model, at: _TestPoint) -> list[Check]:
    A, B, moment = model.form_A, model.form_B, at.moment
    u, q, r, dq = at.u, at.q, at.r, 0.1 * at.dq
    by_hand = "dA" if any(term.derivative for term in _plain(A).terms) else ""

    def pulled(u: Array, q: Array) -> Array:
        return A.matrix("v", "q", moment, u=u, q=q).T @ r

    in_u: list[tuple[str, str, Callable[[Array], Array], sp.csr_array]] = [
        (
            "B'(u)",
            "dB" if any(term.derivative for term in B.terms) else "",
            lambda u: B.vector("v", moment, u=u),
            B.matrix("v", "u", moment, u=u),
        ),
        (
            "d(A(u) q)/du",
            by_hand,
            lambda u: A.vector("v", moment, q=q, u=u),
            A.matrix("v", "u", moment, u=u, q=q),
        ),
        (
            "d(A(u)^T r)/du",
            by_hand,
            lambda u: pulled(u, q),
            A.matrix("q", "u", moment, u=u, v=r, q=q),
        ),
    ]
    states = {name: model.state_space.part(name) for name in model.state_space.unknowns}
    unknowns = {name: one.part for name, one in model.latent.parts.items()}
    found = [
        _taylor(name, given, f, J, u, at.du, (unknowns if "^T" in name else states, states))
        for name, given, f, J in in_u
    ]
    if A.linear_in_parameter:
        return found
    driven, pull = A.matrix("v", "q", moment, u=u, q=q), A.matrix("q", "q", moment, u=u, v=r, q=q)

    def push(q: Array) -> Array:
        return A.vector("v", moment, q=q, u=u)

    return [
        *found,
        _taylor("d(A(u) q)/dq", "", push, driven, q, dq, (states, unknowns)),
        _taylor("d(A(u)^T r)/dq", "", lambda q: pulled(u, q), pull, q, dq, (unknowns, unknowns)),
    ]


def _taylor(
    name: str,
    given: str,
    function: Callable[[Array], Array],
    slope: sp.csr_array,
    at: Array,
    along: Array,
    parts: tuple[Mapping[str, slice], Mapping[str, slice]],
) -> Check:
    """Return the rate of the Taylor remainder, or its size if it is at rounding level.

    `parts`: names and coefficients of the parts of the value, and of the argument. Each pair is
    tested, because rounding errors of the other parts would hide an error in a small part.
    """
    remedy = (
        f"{given}= does not match {given[1]}: correct it, or leave it out and let a complex "
        "step take the derivative."
        if given
        else "a complex step cannot see abs, max, min or a comparison: write them as "
        f"livepde.fem.absolute, maximum, minimum, or give d{name[0]}= with the derivative in u."
    )
    if name.startswith("d("):
        remedy = remedy.replace("dd=", "dA=")
    rows, columns = parts
    start, found = function(at), dict[str, Check]()
    for column, part in columns.items():
        step = np.zeros_like(along)
        step[part] = along[part]
        change = slope @ step
        remainders = np.array([function(at + s * step) - start - s * change for s in (1.0, *STEPS)])
        for row, of in rows.items():
            size = largest(start[of]) + largest(change[of])
            left = np.abs(remainders[:, of]).max(axis=1, initial=0.0)
            found[f"{name} of '{row}' by '{column}'"] = _rate(name, left, size, remedy)
    for which, check in found.items():
        if not check.ok:
            more = which if len(found) > 1 else name
            return replace(check, name=check.name.replace(name, more, 1))
    return max(found.values(), key=lambda check: check.sense == ">=")


def _rate(name: str, remainders: Array, size: float, remedy: str) -> Check:
    """Return the check of Taylor remainders for steps 1 and `STEPS`; `size`: of the values."""
    if remainders[0] <= FLOOR * size:
        value = relative_to(float(remainders[0]), size)
        return Check.at_most(f"{name}: affine, remainder", value, FLOOR, remedy)
    small = remainders[1:]
    above = small > FLOOR * size
    rates = np.log2(small[:-1] / np.maximum(small[1:], 1e-300))[above[:-1] & above[1:]]
    # The smallest steps decide: an error of size s in the derivative dominates the remainder only
    # for steps below s.
    rate = float(np.median(rates[-3:])) if len(rates) else np.inf
    return Check.at_least(f"{name}: rate of the Taylor remainder", rate, SLOWEST, remedy)


def _mass(model: Model) -> list[Check]:
    """Check the mass matrix on the components with a mass term."""
    M, space = model.mass, model.X
    if len(model.algebraic):
        rest = np.setdiff1d(np.flatnonzero(model.X.free), model.algebraic)
        space = HilbertSpace(sp.csr_array(M[rest][:, rest]), "X")
    line = definite(space)
    return [
        Check.at_most(
            "M = M^T", relative(M - M.T, M), ROUNDING, "M(u, v, x) must be symmetric in u and v."
        ),
        Check.at_most("M positive definite (failures)", line.value, 0, line.remedy),
    ]


def _volume_element(model: Model) -> list[Check]:
    """Check that the terms contain no volume element, which `Field.weight` should specify.

    The check fails if both mass and diffusion are proportional to x[0], or to its square, in each
    cell: a factor common to both is a cross-section or volume rather than a property of a material.
    """
    measure = model.form_M.terms[0].measure
    x = measure.points[0]
    if measure.name is not None or not measure.kept or (x <= 0.0).any():
        return []
    factors = [np.broadcast_to(one, x.size).reshape(x.shape) for one in _own_factors(model)]
    powers = (p for p in (1, 2) if all(_is_constant(one / x**p) for one in factors))
    power = next(powers, 0)
    return [
        Check.at_most(
            "power of x[0] in mass and diffusion, but not in `weight`",
            power,
            0,
            f"Set weight=lambda x: {'x[0]' if power == 1 else 'x[0] ** 2'} of the state, and "
            "leave this factor out of all terms. Otherwise means over regions are not means over "
            "volumes.",
        )
    ]


def _own_factors(model: Model) -> list[Array]:
    """Return the mass factor of each component, and the diffusion factors of its gradient."""
    q = model.parameter_space.prior
    return [
        model.form_M.factor(k, k, 0.0)
        if part == "value"
        else model.physical_A.factor(k, k, 1.0, q=q) + model.form_B.factor(k, k, 1.0)
        for k, (_, part) in enumerate(model.form_M.owners("u"))
        if part in ("value", "grad")
    ]


def _is_constant(factor: Array) -> bool:
    """Return whether a factor, (cells, points), is constant in each cell and not zero in all."""
    same = np.ptp(factor, axis=1) <= LINEARITY * np.abs(factor).max(axis=1)
    return bool(same.all() and factor.any())


def _algebraic(model: Model, at: _TestPoint) -> list[Check]:
    """Check that the equations of components without a mass term determine them (index 1)."""
    rows = model.algebraic
    if not len(rows):
        return []
    u, q, moment = at.u, at.q, at.moment
    slope = model.form_B.matrix("v", "u", moment, u=u)
    slope = slope + model.form_A.matrix("v", "u", moment, u=u, q=q)
    block = sp.csr_array(sp.csr_array(slope)[rows][:, rows])
    size = np.maximum(np.asarray(abs(block).max(axis=1).todense()).ravel(), 1e-300)
    scaled = sp.csr_array(sp.diags_array(1.0 / size) @ block)
    try:
        x = analyse(Pattern.of(scaled)).factorise(scaled.data).solve(np.ones(len(rows)))
        condition = float(np.abs(x).max())
    except LinearAlgebraError:
        condition = np.inf
    return [
        Check.at_most(
            "algebraic components: size of their inverse",
            condition if np.isfinite(condition) else np.inf,
            LARGEST_INVERSE,
            "a component has no mass term, and its own equation does not determine it at given "
            "other components: fix its level by a Dirichlet value, or give M a term for it.",
        )
    ]
