"""Weak forms: the one place where integrands are evaluated.

A form is a scalar functional of several functions, `integral of a(q, u, v, x)`. Each function is
evaluated with the shape functions of *its own* space, so exchanging two spaces of equal size cannot
pass unnoticed (fact 9 of the design). Everything a law needs of a form is a first derivative
(`vector`) or a mixed second derivative (`data`) of that functional:

    A(u) q          = vector("v", q=q, u=u)
    A(u)            = data("v", "q", u=u)          its transpose is the same numbers: exact
    d(A(u) q)/du    = data("v", "u", q=q, u=u)
    d(A(u)^T r)/du  = data("q", "u", u=u, v=r)

Arguments in which the form is linear are replaced by unit jets; derivatives in the others are taken
by a complex step at the quadrature points, exact to rounding, without an automatic differentiation
library, and only as good as the integrand is analytic: abs, max or comparison of u need a form of
the derivative from the user, and `check_model` tells when one is missing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dis import get_instructions
from functools import cached_property
from types import FunctionType
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.errors import LivepdeError, ModelError
from livepde.fem.blocks import Measure
from livepde.fem.fields import Integrand, On
from livepde.fem.place import START, Inputs, Moment, Place
from livepde.fem.space import FunctionSpace, LocalSpace
from livepde.linalg import Array, IntArray, Pattern, PatternOperator

__all__ = ["Form", "FormMatrices"]

STEP = 1e-30  # of the complex step: far below rounding, far above underflow
SMALL = 1e-3  # share of a component's largest value or prior deviation: less is no scale
SHIFT = 1e-3  # of a central difference of fourth order, relative: its errors are about 1e-13
LARGEST_TENSOR = 20_000_000  # entries of a precomputed trilinear form; beyond it, quadrature


@dataclass(frozen=True, eq=False)
class _Term:
    """One integrand on one measure, with every argument's space there."""

    integrand: Integrand
    measure: Measure
    spaces: Mapping[str, LocalSpace]

    def evaluate(self, values: Mapping[str, Array], moment: Moment) -> tuple[Any, Place]:
        place = self.measure.place(moment)
        jets = [self.spaces[name].jets(array) for name, array in values.items()]
        return self.integrand(*jets, place), place

    def weighted(self, density: Any, axes: tuple[int, ...]) -> Array:
        """Return density times quadrature weights, broadcast to (axes..., E, P)."""
        array = np.asarray(density) * self.measure.weights
        return np.broadcast_to(array, (*axes, *self.measure.weights.shape))


class FormMatrices(ABC):
    """Matrices of mixed derivatives with fixed sparsity, from `pattern` and `data`."""

    def __init__(self) -> None:
        self._operators: dict[tuple[str, str], PatternOperator] = {}

    @abstractmethod
    def pattern(self, rows: str, cols: str) -> Pattern:
        """Return the sparsity of the matrices `data(rows, cols)`."""

    @abstractmethod
    def data(self, rows: str, cols: str, moment: Moment = START, **coefficients: Array) -> Array:
        """Return the mixed derivative in `rows` and `cols`, as data of `pattern(rows, cols)`."""

    def matrix(
        self, rows: str, cols: str, moment: Moment = START, **coefficients: Array
    ) -> sp.csr_array:
        """Return `data(...)` as a CSR matrix."""
        return self.pattern(rows, cols).matrix(self.data(rows, cols, moment, **coefficients))

    def product(
        self, rows: str, cols: str, x: Array, moment: Moment = START, **coefficients: Array
    ) -> Array:
        """Return `matrix(...) @ x` without building the matrix again; x of shape (m,) or (m, k)."""
        if (rows, cols) not in self._operators:
            self._operators[rows, cols] = self.pattern(rows, cols).operator()
        operator = self._operators[rows, cols]
        operator.set(self.data(rows, cols, moment, **coefficients))
        return operator.apply(x)


class Form(FormMatrices):
    """A sum of integrals, linear in every argument not named in `nonlinear`.

    Parameters
    ----------
    name
        For messages: A, B, M, ...
    integrands
        One integrand or several; an `On` restricts one to a boundary or subdomain. Each is called
        with one jet per argument, in the order of `spaces`, and the place x.
    spaces
        Argument -> function space.
    order
        Quadrature order.
    nonlinear
        The argument in which the form need not be linear, u.
    parameter
        An argument in which it may be nonlinear, q: found out by probing.
    derivative
        Optional integrand of the derivative in the nonlinear argument: the same arguments, with
        the direction behind that argument, as in dB(u, du, v, x).
    inputs
        Names of the input channels that integrands may read.
    """

    def __init__(
        self,
        name: str,
        integrands: Integrand | On | Sequence[Integrand | On],
        spaces: Mapping[str, FunctionSpace],
        mesh: Any,
        order: int,
        nonlinear: str | None = None,
        derivative: Integrand | Sequence[Integrand] | None = None,
        inputs: Sequence[str] = (),
        parameter: str | None = None,
    ) -> None:
        super().__init__()
        items = integrands if isinstance(integrands, Sequence) else [integrands]
        self.name = name
        self.spaces = dict(spaces)
        self.nonlinear = nonlinear
        self.terms: list[_Term] = []
        for item in items:
            integrand, where = (item.form, item.name) if isinstance(item, On) else (item, None)
            measure = Measure(mesh, order, where)
            locals_ = {key: space.local(measure) for key, space in spaces.items()}
            self.terms.append(_Term(integrand, measure, locals_))
        given = derivative if isinstance(derivative, Sequence) else [derivative] * len(items)
        if len(given) != len(items):
            raise ModelError(
                f"Form {name}: give one derivative for each of its {len(items)} terms."
            )
        self.derivatives = list(given)
        self._inputs = Inputs(dict.fromkeys(inputs, 1.0))
        self._constants: dict[tuple[str, str], Array] = {}
        self._offsets: dict[str, Array] = {}
        self._slopes: dict[str, sp.csr_array] = {}
        self._tensors: dict[tuple[str, str], sp.csr_array | None] = {}
        self._patterns: dict[tuple[str, str], Pattern] = {}
        self._gathers: dict[tuple[str, str], list[sp.csr_array]] = {}
        self._moving: list[bool] = []  # terms that read time or inputs, and the nonlinear argument
        self.uses: frozenset[str] = self._probe()
        self.parameter = parameter
        self.linear_in_parameter = parameter is None or self._linear(parameter)
        curved = {nonlinear} if self.linear_in_parameter else {nonlinear, parameter}
        self._curved = frozenset(key for key in curved if key is not None)

    def _probe(self) -> frozenset[str]:
        """Evaluate once: find errors early, and what of time and inputs the form reads."""
        rng = np.random.default_rng(0)
        used: set[str] = set()
        for term in self.terms:
            values = {
                key: rng.standard_normal((local.components, *local.shape))
                for key, local in term.spaces.items()
            }
            try:
                with np.errstate(all="ignore"):  # roots and logarithms of random numbers
                    density, place = term.evaluate(values, Moment(0.0, self._inputs))
                shape = np.broadcast_shapes(np.shape(density), term.measure.weights.shape)
            except LivepdeError:
                raise
            except Exception as error:
                raise ModelError(
                    f"Form {self.name}({', '.join(self.spaces)}, x) failed at its first "
                    f"evaluation: {type(error).__name__}: {error}"
                ) from error
            if shape != term.measure.weights.shape:
                raise ModelError(
                    f"Form {self.name}({', '.join(self.spaces)}, x) gave shape "
                    f"{np.shape(density)} where a scalar per point is expected: is a dot(...) "
                    "or a component index missing?"
                )
            used |= place.used
            self._moving.append(bool(place.used) and self._mentions_state(term.integrand))
        return frozenset(used)

    @property
    def constant(self) -> bool:
        """True if the form reads neither time nor inputs."""
        return not self.uses

    def _mentions_state(self, integrand: Integrand) -> bool:
        """Return false if a function never uses its nonlinear argument, whatever its branches."""
        if self.nonlinear is None:
            return False
        position = list(self.spaces).index(self.nonlinear)
        if not isinstance(integrand, FunctionType) or integrand.__code__.co_argcount <= position:
            return True
        code = integrand.__code__
        name = code.co_varnames[position]
        used = [item.argval for item in get_instructions(code) if item.opname.count("FAST")]
        named = [name in item if isinstance(item, tuple) else item == name for item in used]
        return any(named) or name in code.co_cellvars

    @property
    def steady(self) -> bool:
        """True if the derivative in the nonlinear argument reads neither time nor inputs."""
        return not any(self._moving)

    @cached_property
    def affine(self) -> bool:
        """True if the form is affine in its nonlinear argument (probed at several magnitudes)."""
        return self.nonlinear is None or self._affine(self.nonlinear, homogeneous=False)

    def _linear(self, slot: str) -> bool:
        return self._affine(slot, homogeneous=True)

    def _affine(self, slot: str, homogeneous: bool) -> bool:
        """Return true if the form is affine (linear, if homogeneous) in an argument."""
        rng = np.random.default_rng(1)
        probe = Moment(0.3, self._inputs)
        for term in self.terms:
            values = {
                key: rng.standard_normal((local.components, *local.shape))
                for key, local in term.spaces.items()
            }

            def at(x: Array, term: _Term = term, values: dict[str, Array] = values) -> Array:
                density, _ = term.evaluate({**values, slot: x}, probe)
                return np.asarray(density)

            for scale in (1e-3, 1.0, 1e3, 1e6, 1e9):
                a, b = scale * rng.standard_normal((2, *values[slot].shape))
                with np.errstate(all="ignore"):
                    zero = at(0 * a)
                    change = at(a + b) - at(a) - at(b) + (0 * zero if homogeneous else zero)
                    sizes = np.abs(np.concatenate([at(a).ravel(), at(b).ravel()]))
                    size = max(sizes[np.isfinite(sizes)].max(initial=0.0), 1e-300)
                # Points where the form is not a number (a root of a negative one) say nothing.
                finite = np.isfinite(change)
                if not finite.any() or np.abs(change[finite]).max() > 1e-11 * size:
                    return False
        return True

    @property
    def _trilinear(self) -> bool:
        """True if the form is constant, affine in u and linear in all other arguments."""
        return self.constant and self.linear_in_parameter and self.affine

    def vector(self, slot: str, moment: Moment = START, **coefficients: Array) -> Array:
        """Return the derivative in the linear argument `slot`, shape (dim of its space,)."""
        others = [key for key in self.spaces if key != slot]
        if self._trilinear and others:
            linear = [key for key in others if key != self.nonlinear]
            if not linear:  # B(u) = B(0) + B' u
                if slot not in self._slopes:
                    self._slopes[slot] = self.matrix(slot, others[0], moment)
                return self._slopes[slot] @ coefficients[others[0]] + self._offset(slot)
            rest = {key: coefficients[key] for key in others if key != linear[0]}
            return self.product(slot, linear[0], coefficients[linear[0]], moment, **rest)
        return self._vector(slot, moment, coefficients)

    def _offset(self, slot: str) -> Array:
        """Return the vector of an affine form where its other argument is zero, computed once."""
        if slot not in self._offsets:
            zero = {key: np.zeros(space.dim) for key, space in self.spaces.items()}
            self._offsets[slot] = self._vector(slot, START, zero)
        return self._offsets[slot]

    def _vector(self, slot: str, moment: Moment, coefficients: Mapping[str, Array]) -> Array:
        result = np.zeros(self.spaces[slot].dim)
        for term in self.terms:
            place = term.measure.place(moment)
            jets = [
                local.unit_jets(0, 1)
                if key == slot
                else local.jets(local.values(coefficients[key]))
                for key, local in term.spaces.items()
            ]
            local = term.spaces[slot]
            weighted = term.weighted(term.integrand(*jets, place), (local.components,))
            result += local.evaluation_transposed @ weighted.ravel()
        return result

    def pattern(self, rows: str, cols: str) -> Pattern:
        """Return the sparsity of the matrices `data(rows, cols)`."""
        if (rows, cols) not in self._patterns:
            pairs = [self._entries(term, rows, cols) for term in self.terms]
            pattern = Pattern.from_entries(
                np.concatenate([i for i, _ in pairs]),
                np.concatenate([j for _, j in pairs]),
                (self.spaces[rows].dim, self.spaces[cols].dim),
            )
            self._patterns[rows, cols] = pattern
            self._gathers[rows, cols] = [pattern.gather(i, j) for i, j in pairs]
        return self._patterns[rows, cols]

    @staticmethod
    def _entries(term: _Term, rows: str, cols: str) -> tuple[IntArray, IntArray]:
        i, j = term.spaces[rows].dofs, term.spaces[cols].dofs
        shape = (len(i), len(j), i.shape[1])
        return np.broadcast_to(i[:, None], shape).ravel(), np.broadcast_to(j, shape).ravel()

    def data(self, rows: str, cols: str, moment: Moment = START, **coefficients: Array) -> Array:
        """Return the mixed derivative in `rows` and `cols`, as data of `pattern(rows, cols)`.

        The second derivative in one argument for rows = cols. Constant bilinear forms are assembled
        once; constant trilinear ones become one sparse product with the third coefficients.
        """
        if rows == cols and rows not in self._curved:
            return np.zeros(self.pattern(rows, cols).nnz)
        others = [key for key in self.spaces if key not in (rows, cols)]
        if self._trilinear:
            if not others:
                return self._constant(rows, cols)
            if len(others) == 1:
                tensor = self._tensor(rows, cols, others[0])
                if tensor is not None:
                    product: Array = tensor @ coefficients[others[0]]
                    if others[0] == self.nonlinear:
                        product += self._constant(rows, cols)
                    return product
        return self._quadrature(rows, cols, moment, coefficients)

    def _quadrature(
        self, rows: str, cols: str, moment: Moment, coefficients: Mapping[str, Array]
    ) -> Array:
        pattern = self.pattern(rows, cols)
        result = np.zeros(pattern.nnz)
        for term, gather, given in zip(
            self.terms, self._gathers[rows, cols], self.derivatives, strict=True
        ):
            density = self._density(term, rows, cols, moment, coefficients, given)
            r, c = term.spaces[rows], term.spaces[cols]
            weighted = term.weighted(density, (r.components, c.components))
            half = np.einsum("klep,kiep->liep", weighted, r.phi, optimize=False)
            local = np.einsum("liep,ljep->ije", half, c.phi, optimize=False)
            result += gather @ local.ravel()
        return result

    def _density(
        self,
        term: _Term,
        rows: str,
        cols: str,
        moment: Moment,
        coefficients: Mapping[str, Array],
        given: Integrand | None,
    ) -> Array:
        """Return the integrand's derivative in `rows`, `cols`: (components, components, E, P).

        Unit jets in arguments in which the form is linear; a complex step in one that is not; a
        central difference of complex steps if both are not (only Jacobians of iterations use it),
        in the one in which the form is affine, where there is one: then it is exact.
        """
        place = term.measure.place(moment)
        if self.nonlinear not in (rows, cols):
            given = None
        curved = [axis for axis, key in enumerate((rows, cols)) if key in self._curved]
        if given is not None:  # the user's derivative takes the place of one complex step
            curved = [axis for axis in curved if (rows, cols)[axis] != self.nonlinear]
        if len(curved) == 2 and rows != cols == self.nonlinear and self.affine:
            curved.reverse()
        stepped = curved[-1] if curved else None
        shifted = curved[0] if len(curved) == 2 else None

        def evaluate(shift: float) -> Array:
            jets: list[Any] = []
            for key, local in term.spaces.items():
                axes = [axis for axis, name in enumerate((rows, cols)) if name == key]
                if axes and key not in self._curved:
                    jets.append(local.unit_jets(axes[0], 2))
                    continue
                here = local.values(coefficients[key]) if key in coefficients else local.zeros()
                if not axes:
                    jets.append(local.jets(here))
                    continue
                value: Any = here[:, None, None]
                if shifted in axes:
                    value = value + shift * self._scale(key, local, here) * local.units(axes[0], 2)
                if stepped in axes:
                    value = value + 1j * STEP * local.units(axes[-1], 2)
                jets.append(local.jets(value))
                if given is not None and key == self.nonlinear:
                    jets.append(local.unit_jets(axes[0], 2))
            density = (term.integrand if given is None else given)(*jets, place)
            slope: Array = np.asarray(density) if stepped is None else np.imag(density) / STEP
            return slope

        if shifted is None:
            return evaluate(0.0)
        key = (rows, cols)[shifted]
        local = term.spaces[key]
        here = local.values(coefficients[key]) if key in coefficients else local.zeros()
        near = evaluate(SHIFT) - evaluate(-SHIFT)
        far = evaluate(2.0 * SHIFT) - evaluate(-2.0 * SHIFT)
        difference = (8.0 * near - far) / (12.0 * SHIFT)
        scaled: Array = difference / np.swapaxes(self._scale(key, local, here)[:, 0], 0, shifted)
        return scaled

    def _scale(self, key: str, local: LocalSpace, values: Array) -> Array:
        """Return the size of each component at each point, not too small: (components, 1, 1, E, P).

        For the parameter not far below its prior deviation: a value near zero has no size.
        """
        size = np.abs(values)
        whole = size.max(axis=(1, 2), keepdims=True)
        if key == self.parameter:
            unknowns = local.space.unknowns.values()
            counts = [len(item.phi) for item in local.locals]
            std = np.repeat([float(item.std) for item in unknowns], counts)
            whole = np.maximum(whole, std[:, None, None])
        whole = np.where(whole > 0.0, whole, 1.0)
        return np.where(size > SMALL * whole, size, whole)[:, None, None]

    def _constant(self, rows: str, cols: str) -> Array:
        """Return data(rows, cols) of an affine form at zero, computed once."""
        if (rows, cols) not in self._constants:
            self._constants[rows, cols] = self._quadrature(rows, cols, START, {})
        return self._constants[rows, cols]

    def tensor(self, rows: str, cols: str) -> sp.csr_array | None:
        """Return the matrix T with data(rows, cols) = T @ (coefficients of the third argument).

        None unless the form is trilinear and constant, and T is of reasonable size.
        """
        (third,) = [key for key in self.spaces if key not in (rows, cols)]
        if not self._trilinear:
            return None
        if third == self.nonlinear and np.any(self._constant(rows, cols)):
            return None
        return self._tensor(rows, cols, third)

    def _tensor(self, rows: str, cols: str, third: str) -> sp.csr_array | None:
        if (rows, cols) in self._tensors:
            return self._tensors[rows, cols]
        size = sum(
            int(np.prod([len(local.dofs) for local in term.spaces.values()]))
            * term.measure.weights.shape[0]
            for term in self.terms
        )
        if size > LARGEST_TENSOR:
            self._tensors[rows, cols] = None
            return None
        pattern = self.pattern(rows, cols)
        total = sp.csr_array((pattern.nnz, self.spaces[third].dim))
        axes = {rows: 0, cols: 1, third: 2}
        for term in self.terms:
            values = {key: local.units(axes[key], 3) for key, local in term.spaces.items()}
            density, _ = term.evaluate(values, START)
            if self.nonlinear is not None:
                values[self.nonlinear] = 0.0 * values[self.nonlinear]
                density = density - term.evaluate(values, START)[0]
            r, c, t = term.spaces[rows], term.spaces[cols], term.spaces[third]
            weighted = term.weighted(density, (r.components, c.components, t.components))
            step = np.einsum("klmep,kiep->ilmep", weighted, r.phi, optimize=False)
            step = np.einsum("ilmep,ljep->ijmep", step, c.phi, optimize=False)
            local = np.einsum("ijmep,mnep->ijne", step, t.phi, optimize=False)
            i = np.broadcast_to(r.dofs[:, None, None], local.shape).ravel()
            j = np.broadcast_to(c.dofs[None, :, None], local.shape).ravel()
            n = np.broadcast_to(t.dofs[None, None, :], local.shape).ravel()
            entries = (local.ravel(), (pattern.positions(i, j), n))
            total = total + sp.csr_array(entries, shape=total.shape)
        total = sp.csr_array(total)
        total.eliminate_zeros()
        self._tensors[rows, cols] = total
        return total
