"""Model of the process, M u' + B(u) + A(u) q = F, defined by weak forms."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
import scipy.sparse as sp

from livepde.diffusion import negative_diffusion
from livepde.errors import ConfigurationError, ModelError, NameClashError
from livepde.fem import (
    START,
    Channel,
    Coefficients,
    Composed,
    Field,
    FieldBlock,
    Form,
    FunctionSpace,
    Inputs,
    Integrand,
    Latent,
    Moment,
    Named,
    On,
    SensorState,
    SensorTerms,
    Sobolev,
    Source,
    Unknown,
    cells,
    compose,
    dot,
    equation_text,
    grad,
    no_term,
    source_density,
    terms_text,
    with_constants,
)
from livepde.fem.measure import unweighted
from livepde.fem.meshes import halved
from livepde.linalg import Array, IntArray
from livepde.records import Layout, name_clashes
from livepde.showing import Shown, listed
from livepde.spaces import BorderedSpace, DualOperator, HilbertSpace, product


def mass_form(u: Any, v: Any, x: Any) -> Any:
    """The L2 inner product u v, summed over the components."""
    return _summed(lambda u, v: u * v, u, v)


def h1_form(u: Any, v: Any, x: Any) -> Any:
    """The H1 inner product u v + grad u . grad v, summed over the components."""
    return _summed(lambda u, v: u * v + dot(grad(u), grad(v)), u, v)


def _summed(form: Callable[[Any, Any], Any], u: Any, v: Any) -> Any:
    if not isinstance(u, Named):
        return form(u, v)
    return sum(form(part, getattr(v, name)) for name, part in vars(u).items())


class Model(Shown):
    """A time-dependent PDE with unknown parameters, M u' + B(t, u) + A(t, u) q = F(t) in X*.

    The paper's abstract equation (main) with C(q, u) = A(u) q + B(u) (Assumption ass:equation),
    tested with the basis of X. A may also be nonlinear in q. The laws then replace A(u) by the
    derivative of A in q at the estimate (Kaltenbacher and Nguyen 2021). A model is immutable.

    Parameters
    ----------
    state
        The field u, or a mapping from names to fields on one mesh, available in forms as u.c, v.c
        and so on. Dirichlet values are numbers, functions g(x, t) or channels.
    parameter
        The unknown: a prior (`Normal`, `LogNormal`, `LogitNormal`: one number), a `Scalar`,
        `Piecewise`, `Scalars` or `Field`, or a mapping from names to those.
    A
        Integrand (q, u, v, x), linear in v; `q.name` if unknowns have names. It may contain the
        whole residual. Linearity in q is detected.
    B
        Integrand (u, v, x), linear in v.
    f
        Source density: a number or f(x, t), or a mapping from components to those. If its second
        argument is called `_` and it does not read x.t, it is evaluated once for each set of
        inputs.
    M
        Integrand (u, v, x) of the mass term, symmetric positive; default u v, summed over the
        components. A component without a mass term is algebraic: its equation holds at all times
        and must determine it (index 1). `GradientLaw` requires a mass term of each component.
    dA, dB
        Optional integrands of the derivatives in u, (q, u, du, v, x) and (u, du, v, x). The default
        is a complex step, exact for analytic integrands.
    inputs
        Names of the channels that forms read as x.inputs["name"], or a mapping from names to units.
        Data in other units are converted to these.
    time_unit, length_unit, formula
        Units of times and coordinates, and the equation as text; default the weak form in code.
    initial
        Integrand (q, v, x), linear in v, such as `q.u0 * v`: a functional whose L2 projection is
        the initial state. Its unknowns are unknowns of the initial state.
    coefficients
        Function q -> {name: value} of further coefficients that A reads as q.name, such as
        lambda q: {"diffusivity": q.k / q.C}. If all of them are numbers and A is linear in unknowns
        and coefficients, a step is as fast as with an A that is linear in the unknowns. If they
        depend on an unknown that varies in space, A is evaluated at each step.
    sensors
        Sensors with a slow response, by name. Their states are coefficients after the coefficients
        of the fields. Identifiers add the slow sensors of observations (`lp.observation.Slow`).

    Notes
    -----
    `A`, `B`, `f` and `M` may each be a list of terms; `On("left", form)` restricts a term to a
    named boundary or subdomain of the mesh. In a form, `x[0]` is a coordinate, `x.t` the time. If a
    term does not depend on `u`, name that argument `_`, as in (q, _, v, x). Then the derivative in
    u does not depend on time and inputs of the term, and factorisations are reused.

    Raises
    ------
    ModelError
        A form cannot be evaluated, has the wrong number of components, or is not linear in v; the
        mass depends on time; or a name has another meaning in the dataset of a run.

    Warns
    -----
    UserWarning
        The diffusion is negative at the prior mean.

    Examples
    --------
    >>> import livepde as lp
    >>> mesh = lp.interval(0.0, 1.0, 20)
    >>> model = lp.Model(  # u_t = div(k grad u)
    ...     state=lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T_left")}),
    ...     parameter={"k": lp.LogNormal(0.1, std=0.05)},
    ...     A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    ... )
    >>> model.channels
    ('T_left',)
    """

    def __init__(
        self,
        state: Field | Mapping[str, Field],
        parameter: Unknown | Mapping[str, Unknown],
        A: Integrand | On | Sequence[Integrand | On],
        B: Integrand | On | Sequence[Integrand | On] = no_term,
        f: Source | On | Sequence[Source | On] = 0.0,
        M: Integrand | On | Sequence[Integrand | On] | None = None,
        *,
        dA: Integrand | Sequence[Integrand] | None = None,
        dB: Integrand | Sequence[Integrand] | None = None,
        inputs: Sequence[str] | Mapping[str, str] = (),
        time_unit: str = "",
        length_unit: str = "",
        formula: str = "",
        initial: Integrand | On | Sequence[Integrand | On] | None = None,
        coefficients: Callable[[Any], Mapping[str, Any]] | None = None,
        sensors: Mapping[str, SensorState] | None = None,
    ) -> None:
        self._parts: dict[str, Any] = {
            **{"A": A, "B": B, "f": f, "M": M, "dA": dA, "dB": dB},
            **{"inputs": inputs, "initial": initial, "coefficients": coefficients},
            "sensors": sensors,
        }
        self.state = state
        self.parameter = parameter
        self.time_unit, self.length_unit = time_unit, length_unit
        units = {"time_unit": time_unit, "length_unit": length_unit}
        self._about: dict[str, Any] = {**units, "formula": formula}
        self.sensors = dict(sensors or {})
        self.state_space = FunctionSpace.of(state, "u").with_sensors(self.sensors)
        self.mesh = self.state_space.mesh
        self.parameter_space = FunctionSpace.of(parameter, "q")
        self.inputs = tuple(inputs)
        self._check_parameter()
        # Computed here to raise errors in boundary values and weights early.
        _ = self.state_space.fixed, self.state_space.weight
        x, q = self.state_space, self.parameter_space
        pair = {"u": x, "v": x}
        self.form_M = self._form("M", x.product if M is None else M, pair)
        self._at_sensors = SensorTerms(self.sensors, self.form_M)
        if more := self._at_sensors.mass:
            self.form_M = self._form("M", x.product if M is None else M, pair, more=more)
        self.form_B = self._form("B", B, pair, "u", dB, more=self._at_sensors.response)
        self.latent = Latent(q)
        self._set_A(A, dA, coefficients)
        sources = f if isinstance(f, Sequence) else [f]
        integrands = [source_density(item, x) for item in sources]
        self.form_F = self._form("f", integrands, {"v": x})
        self._source: tuple[Mapping[str, float] | None, Array] | None = None
        self.form_initial: Form | Composed | None = None
        if initial is not None:
            form = self._form("initial", initial, {"q": q, "v": x}, parameter="q")
            self.form_initial = compose(form, self.latent)
        self._check_diffusion()
        if not self.form_M.constant:
            raise ModelError("M may not depend on time or inputs: move the change into B or f.")

    def _shown(self) -> tuple[str, Mapping[str, str]]:
        rows = {}
        for name, block in self.state_space.fields.items():
            kind = type(block.field.element).__name__
            rows[f"state {name}"] = f"{kind}, {block.size} coefficients"
            if block.field.dirichlet:
                rows[f"state {name}"] += f", Dirichlet values {block.field.boundary_text}"
        formula = self.formula
        rows["equation"] = formula or equation_text(self._parts)
        shown = {} if formula else {"M": "mass M(u, v)"}
        for name, what in {**shown, "initial": "initial state"}.items():
            if self._parts[name] is not None:
                rows[what] = " + ".join(terms_text(self._parts[name]))
        for name in self.parameter_space.unknowns:
            rows[f"unknown {name}"] = self._prior_text(name)
        if self.inputs:
            rows["inputs"] = listed(self.inputs)
        rows["mesh"] = f"{self.mesh.nelements} cells, {self._extent} {self.length_unit}".rstrip()
        rows["unit of time"] = self.time_unit or "not stated"
        return f"Model with {self.X.dim} state coefficients, {self.Q.dim} of unknowns", rows

    @property
    def _extent(self) -> str:
        ends = zip("xyz", self.mesh.p.min(axis=1), self.mesh.p.max(axis=1), strict=False)
        return ", ".join(f"{axis} from {low:g} to {high:g}" for axis, low, high in ends)

    def _prior_text(self, name: str) -> str:
        unknown = self.parameter_space.unknowns[name]
        of = f"field, {type(unknown.element).__name__}, " if isinstance(unknown, Field) else ""
        many = [label for label in self.parameter_space.labels if label.startswith(f"{name}[")]
        named = f" for each of {listed(many)}" if many else ""
        return f"{of}{unknown.prior.text} {unknown.unit}".rstrip() + named

    def __copy__(self) -> Model:
        return self  # a model is immutable

    def __deepcopy__(self, memo: object) -> Model:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments from which pickle rebuilds the model."""
        parts = self.state, self.parameter, self._parts
        try:
            pickle.dumps(parts)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ConfigurationError(
                "this model cannot be pickled, since pickle stores a function by its name, and a "
                f"lambda or an inner function has none ({error}): define forms and values with def "
                "at the top of a module, or pickle what builds the model. Estimates and results "
                "can be pickled."
            ) from error
        return partial(Model, self.state, self.parameter, **self._parts, **self._about), ()

    def _form(
        self,
        name: str,
        integrands: Any,
        spaces: Mapping[str, FunctionSpace],
        nonlinear: str | None = None,
        derivative: Any = None,
        parameter: str | None = None,
        more: Sequence[On] = (),
    ) -> Form:
        mesh, order, inputs = self.mesh, self.order, self.inputs
        if more:  # terms of slow sensors; their derivatives use the complex step
            integrands = integrands if isinstance(integrands, Sequence) else [integrands]
            stated = isinstance(derivative, Sequence)
            derivative = derivative if stated else [derivative] * len(integrands)
            integrands, derivative = [*integrands, *more], [*derivative, *(None for _ in more)]
        return Form(name, integrands, spaces, mesh, order, nonlinear, derivative, inputs, parameter)

    def _set_A(
        self,
        A: Integrand | On | Sequence[Integrand | On],
        dA: Integrand | Sequence[Integrand] | None,
        coefficients: Callable[[Any], Mapping[str, Any]] | None,
    ) -> None:
        """Set `physical_A`, `linear_A` in unknowns and coefficients, and `form_A` in latent q."""
        x = self.state_space
        spaces = {"q": self.parameter_space, "u": x, "v": x}
        computed = self._coefficients(coefficients, dA)
        terms = computed.expanded(A) if computed else A
        own_terms = self._at_sensors.unknown_response
        self.physical_A = self.linear_A = self._form("A", terms, spaces, "u", dA, "q", own_terms)
        # Coefficients that are numbers, with A as a form in unknowns and coefficients; else None.
        self.coefficients = computed if computed and computed.numeric else None
        self.computed = tuple(computed.names) if computed else ()  # names of all coefficients
        if self.coefficients is not None:
            arguments = spaces | {"q": self.coefficients.space}
            self.linear_A = self._form("A", A, arguments, "u", None, "q", own_terms)
        self.form_A = compose(self.physical_A, self.latent)

    def _coefficients(
        self, function: Callable[[Any], Mapping[str, Any]] | None, dA: Any
    ) -> Coefficients | None:
        if function is None:
            return None
        if self.parameter_space.single or dA is not None:
            requirement = "named unknowns" if self.parameter_space.single else "no dA"
            raise ModelError(f"coefficients require {requirement}.")
        prior_value = self.latent.value(self.latent.prior)
        coefficients = Coefficients(self.parameter_space, function, prior_value)
        if clashes := sorted(set(coefficients.names) & set(self.parameter_space.names)):
            raise ModelError(f"coefficients: '{clashes[0]}' is an unknown; choose another name.")
        return coefficients

    def with_unknowns(self, more: Mapping[str, Unknown]) -> Model:
        """Return a copy of the model with more unknowns, such as sensor offsets, not in its forms.

        Raises `ModelError`: this model has one unknown without a name, or a name is taken.
        """
        space = self.parameter_space
        clashes = sorted(set(space.names) & set(more))
        if space.single or clashes:
            text = f"the name '{clashes[0]}' is taken" if clashes else "its one unknown has no name"
            raise ModelError(f"with_unknowns: {text}; write parameter={{name: unknown, ...}}.")
        unknowns = {**cast(Mapping[str, Unknown], self.parameter), **more}
        return Model(self.state, unknowns, **self._parts, **self._about)

    def with_sensors(self, sensors: Mapping[str, SensorState]) -> Model:
        """Return a copy of the model with additional slow sensors."""
        parts = self._parts | {"sensors": {**self.sensors, **sensors}}
        return Model(self.state, self.parameter, **parts, **self._about)

    def with_terms(
        self,
        A: Sequence[Integrand | On] = (),
        B: Sequence[Integrand | On] = (),
        inputs: Sequence[str] = (),
    ) -> Model:
        """Return a copy with additional terms in A, (q, u, v, x), and B, (u, v, x).

        `inputs`: names of the channels that these terms read.

        Raises `ModelError`: the model has dA or dB, which would lack the derivative of the terms.
        """
        parts = dict(self._parts)
        for name, added_terms in (("A", A), ("B", B)):
            if added_terms and parts[f"d{name}"] is not None:
                raise ModelError(f"with_terms: the model has d{name}; add the terms to {name}.")
            terms = parts[name] if isinstance(parts[name], Sequence) else [parts[name]]
            parts[name] = [*terms, *added_terms]
        parts["inputs"] = dict.fromkeys([*self.inputs, *inputs], "") | self._input_units
        about, added = dict(self._about), ", with added conditions and sources"
        if about["formula"] and not about["formula"].endswith(added):
            about["formula"] += added
        return Model(self.state, self.parameter, **parts, **about)

    def with_constant_inputs(self, values: Mapping[str, float]) -> Model:
        """Return a copy of the model with constant values of some inputs."""
        if unknown := sorted(set(values) - set(self.inputs)):
            raise ModelError(
                f"with_constant_inputs: the model has no input '{unknown[0]}'; it has "
                f"{list(self.inputs)}."
            )

        def bound(part: Any) -> Any:
            if isinstance(part, On):
                return On(part.name, bound(part.form))
            if isinstance(part, Mapping):
                return {name: bound(item) for name, item in part.items()}
            if isinstance(part, Sequence):
                return [bound(item) for item in part]
            return with_constants(part, values) if callable(part) else part

        free = {name: unit for name, unit in self._input_units.items() if name not in values}
        # These parts never read channels.
        same = {name: self._parts[name] for name in ("coefficients", "sensors")} | {"inputs": free}
        parts = {name: bound(part) for name, part in self._parts.items() if name not in same}
        return Model(self.state, self.parameter, **parts, **same, **self._about)

    def refined(self) -> Model:
        """Return a copy of the model on a mesh whose elements are halved in every direction.

        Raises `ModelError` or `SpaceError`: a part of the model is only defined on this mesh.
        """
        mesh = halved(self.mesh)

        def finer(part: Any) -> Any:
            if isinstance(part, Mapping):
                return {name: finer(item) for name, item in part.items()}
            return replace(part, mesh=mesh) if isinstance(part, Field) else part

        return Model(finer(self.state), finer(self.parameter), **self._parts, **self._about)

    def _check_parameter(self) -> None:
        shared = set(self.parameter_space.blocks) & set(self.state_space.blocks)
        if shared and not self.state_space.single:
            raise ModelError(f"state and unknowns are both called {sorted(shared)}: rename one.")
        self._check_names()
        for name, block in self.parameter_space.fields.items():
            if block.field.weight is not unweighted:
                raise ModelError(f"parameter '{name}': weight is that of the state: leave it out.")
            if any(value != 0.0 for value in block.field.boundary_values):
                raise ModelError(
                    f"parameter '{name}': only zero boundary values are possible; write a known "
                    "boundary part of q into B."
                )

    def _check_diffusion(self) -> None:
        """Warn if the diffusion is negative at the prior mean, as in u_t = -k u_xx."""
        components, A, B = list(self.state_space.blocks), self.physical_A, self.form_B
        for name in self.state_space.fields:
            component = components.index(name)
            if negative_diffusion(self.form_M, A, B, self.parameter_space.prior, component):
                text = "the model" if self.state_space.single else f"'{name}'"
                warnings.warn(
                    f"the diffusion of {text} is negative at the prior mean, which is ill-posed: "
                    "small disturbances grow without bound. In the weak form of u_t = k u_xx the "
                    "term is + k * dot(grad(u), grad(v)): change its sign in A or B.",
                    stacklevel=4,
                )

    def _check_names(self) -> None:
        """Raise `NameClashError` if two names coincide in the dataset of a run."""
        state, parameter = self.state_space, self.parameter_space
        axes = "xyz"[: self.mesh.dim()]
        clashes = name_clashes(
            Layout.own_names(axes, cells(self.mesh)),
            [key for name, block in state.fields.items() for key in block.variables(name)],
            parameter.labels,
            parameter.fields,
        )
        if clashes:
            raise NameClashError(f"Model: {clashes[0]}")

    @cached_property
    def order(self) -> int:
        """Quadrature order: stated by the fields, or exact for A(u) q with polynomial factors."""
        states = [block.field for block in self.state_space.fields.values()]
        if orders := [field.quadrature for field in states if field.quadrature is not None]:
            return max(orders)
        degrees = [block.field.element.maxdeg for block in self.parameter_space.fields.values()]
        # The degrees of the factors add up: u, its test function, and q.
        return max(field.order for field in states) + max([int(d) for d in degrees], default=0)

    @cached_property
    def state_block(self) -> FieldBlock:
        """Finite-element functions of a state with one component."""
        return self.state_space.component()[0]

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels of the model: inputs of forms and Dirichlet channels."""
        boundary = [value.name for value in self.boundary_values if isinstance(value, Channel)]
        return tuple(dict.fromkeys([*self.inputs, *boundary]))

    @cached_property
    def boundary_values(self) -> list[Any]:
        """Dirichlet values of all components: numbers, functions, channels."""
        fields = [block.field for block in self.state_space.fields.values()]
        return [value for field in fields for value in field.boundary_values]

    @cached_property
    def mass(self) -> sp.csr_array:
        """Matrix of M, shape (n, n)."""
        return self.form_M.matrix("v", "u")

    @cached_property
    def algebraic(self) -> IntArray:
        """Indices of free coefficients without a mass term: algebraic components of the state."""
        mass = np.asarray(abs(self.mass).sum(axis=1)).ravel()
        free = np.ones(self.state_space.dim, dtype=bool)
        free[self.state_space.fixed] = False
        return np.flatnonzero(free & (mass == 0.0))

    @cached_property
    def state_mass(self) -> sp.csr_array:
        """L2 Gram matrix of the state, shape (n, n)."""
        return self.bilinear([self.state_space.product, *self._at_sensors.mass])

    @cached_property
    def X(self) -> HilbertSpace:
        """State space with the inner product of M."""
        return HilbertSpace(self.mass, "X", self.state_space.fixed)

    @cached_property
    def Q(self) -> HilbertSpace:
        """Space of the latent parameter; its Gram matrix is the inverse of the prior covariance."""
        parts = []
        for part in self.latent.parts.values():
            unknown, size, variance = part.unknown, part.size, part.unknown.prior.latent_std**2
            if isinstance(unknown, Field):
                space = self._field_space(unknown, part.block, variance)
            else:
                space = HilbertSpace(sp.csr_array(sp.eye_array(size) / variance), "Q")
            parts += [space] * part.evolution.copies
        return product(parts, "Q", self.latent.fixed)

    def _field_space(self, field: Field, block: Any, variance: float) -> HilbertSpace:
        inner: Any = Sobolev(2.0) if field.inner == "H2" else field.inner
        if isinstance(inner, str):
            inner = {"L2": mass_form, "H1": h1_form}[inner]
        form = inner.form(field.element) if isinstance(inner, Sobolev) else inner
        if form is not None:
            gram = self._on_parameter(field, form) / variance
            return HilbertSpace(sp.csr_array(gram), "Q", block.fixed)
        # This inner product is not a bilinear form, but a Schur complement of a sparse matrix.
        free = np.ones(block.size)
        free[block.fixed] = 0.0
        mass, K = (self._on_parameter(field, form) for form in (mass_form, inner.operator))
        border = inner.border(mass, K, free) / variance
        return BorderedSpace(sp.csr_array(border), block.size, "Q", block.fixed)

    @cached_property
    def parameter_mass(self) -> sp.csr_array:
        """L2 Gram matrix of the parameter, which orders its modes; the identity for numbers."""
        blocks = [
            self._on_parameter(block.field, mass_form)
            if isinstance(block, FieldBlock)
            else sp.eye_array(block.size)
            for block in self.parameter_space.blocks.values()
        ]
        return sp.csr_array(sp.block_diag(blocks, format="csr"))

    def _on_parameter(self, field: Field, integrand: Any) -> sp.csr_array:
        space = FunctionSpace.of(field, "q")
        order = 2 * int(field.element.maxdeg)
        pair = {"u": space, "v": space}
        return Form("inner", integrand, pair, field.mesh, order).matrix("v", "u")

    def bilinear(
        self, integrand: Integrand | On | Sequence[Integrand | On], cells: IntArray | None = None
    ) -> sp.csr_array:
        """Assemble a constant bilinear form (u, v, x) on the state space, shape (n, n).

        With `cells`, the form is integrated over these elements only.
        """
        form = self._form("operator", integrand, {"u": self.state_space, "v": self.state_space})
        if not form.constant:
            raise ModelError("an operator such as M_op may not depend on time or inputs.")
        return (form if cells is None else form.on(cells)).matrix("v", "u")

    @cached_property
    def affine(self) -> bool:
        """True if A(u) q + B(u) is affine in u, so that a step with known q is one linear solve."""
        return self.form_A.affine and self.form_B.affine

    @cached_property
    def constant(self) -> bool:
        """True if A and B do not depend on time or inputs."""
        return self.form_A.constant and self.form_B.constant

    @cached_property
    def steady(self) -> bool:
        """True if the derivatives of A and B in u do not depend on time or inputs."""
        return self.form_A.steady and self.form_B.steady

    def A(self, u: Array, moment: Moment = START, q: Array | None = None) -> DualOperator:
        """Return A(u): Q -> X*, for coefficients u of shape (n,).

        If A is not linear in the latent parameter, this is its derivative at q, by default the
        prior mean.
        """
        q = self.latent.prior if q is None else q
        return DualOperator(self.form_A.matrix("v", "q", moment, u=u, q=q), self.Q, self.X)

    def B(self, u: Array, moment: Moment = START) -> Array:
        """Return B(u) in X*, shape (n,)."""
        return self.form_B.vector("v", moment, u=u)

    def F(self, moment: Moment = START) -> Array:
        """Return the source in X*, shape (n,)."""
        # The last source that does not depend on time, with its inputs, or None if it depends on no
        # inputs. Threads share this pair: it is read once and replaced as a whole.
        cached = self._source
        if cached is not None and (cached[0] is None or cached[0] is moment.inputs):
            return cached[1]
        source, channels = self.form_F.traced("v", moment)
        source.setflags(write=False)
        if not channels:
            self._source = (None, source)
        elif "t" not in channels and isinstance(moment.inputs, Inputs):  # `Inputs` are immutable
            self._source = (moment.inputs, source)
        return source

    @cached_property
    def homogeneous(self) -> bool:
        """True if every Dirichlet value is the number 0: zero boundary values stay zero."""
        return all(isinstance(one, int | float) and one == 0.0 for one in self.boundary_values)

    def impose(self, u: Array, moment: Moment) -> Array:
        """Return u with the Dirichlet values at a moment imposed."""
        return self.state_space.impose(u, moment)

    @property
    def formula(self) -> str:
        """The equation as text; empty if not specified."""
        return str(self._about["formula"])

    @property
    def _input_units(self) -> dict[str, str]:
        inputs = self._parts["inputs"]
        return dict(inputs) if isinstance(inputs, Mapping) else dict.fromkeys(self.inputs, "")

    @property
    def channel_units(self) -> dict[str, str]:
        """Mapping from input, or channel of a boundary value, to its unit; empty if not known."""
        fields = [block.field for block in self.state_space.fields.values()]
        return self._input_units | {
            value.name: field.unit
            for field in fields
            for value in field.boundary_values
            if isinstance(value, Channel)
        }

    def boundary_readings(self, u0: Any) -> dict[str, float]:
        """Return the values of boundary channels at t0 implied by u0: channel -> mean value.

        Omitted are channels on whose boundaries u0 varies by more than a thousandth of its range,
        and channels of components that u0 does not contain.
        """
        if u0 is None:
            return {}
        u = self.state_space.interpolate(u0)
        values: dict[str, Array] = {}
        allowed: dict[str, float] = {}
        for name, block in self.state_space.fields.items():
            initial = u0.get(name) if isinstance(u0, Mapping) else u0
            if initial is None:
                continue
            coefficients = u[self.state_space.part(name)]
            at_vertices = block.at_vertices @ coefficients
            # The second term allows for rounding in a uniform state.
            spread = 1e-3 * float(np.ptp(at_vertices)) + 1e-9 * float(np.abs(at_vertices).max())
            for channel, trace in block.traces(initial, coefficients):
                values[channel] = np.append(values.get(channel, []), trace)
                allowed[channel] = min(spread, allowed.get(channel, spread))
        fits = {channel: np.ptp(trace) <= allowed[channel] for channel, trace in values.items()}
        return {channel: float(trace.mean()) for channel, trace in values.items() if fits[channel]}

    def initial(self, u0: Any, moment: Moment = START) -> Array:
        """Return coefficients of u0: a number, a function of x, coefficients, or a mapping."""
        return self.impose(self.state_space.interpolate(u0), moment)

    def initial_values(self, u0: Any) -> Array:
        """Return coefficients of u0 without boundary values, after validation.

        Raises
        ------
        ModelError
            A mapping without one of the components; values that are not finite.
        SpaceError
            Coefficients with a wrong shape, or an unknown component.
        """
        components = self.state_space.fields
        if isinstance(u0, Mapping) and (missing := [name for name in components if name not in u0]):
            raise ModelError(
                f"u0 has no value for {missing}: give one for each component of the state, "
                f"{list(components)}; one number is that of all of them."
            )
        coefficients = self.state_space.interpolate(u0)
        if not np.isfinite(coefficients).all():
            raise ModelError("u0 has values that are not finite: give finite values.")
        return coefficients

    def initial_state(self, q: Array, moment: Moment = START) -> Array:
        """Return coefficients of the initial state for latent parameters q."""
        boundary = self.impose(np.zeros(self.X.dim), moment)
        if self.form_initial is None:
            return boundary
        # Projection onto functions with the Dirichlet values, whose contribution is subtracted.
        functional = self.form_initial.vector("v", moment, q=q) - self._projection.dual(boundary)
        return self.state_space.completed(boundary + self._projection.riesz(functional))

    @cached_property
    def _projection(self) -> HilbertSpace:
        """The state with the L2 inner product."""
        return HilbertSpace(self.state_mass, "L2", self.state_space.fixed)

    def initial_directions(self, q: Array, directions: Array, moment: Moment = START) -> Array:
        """Return du_0/dq applied to columns, (m, k) -> (n, k); zero if `initial` is not set."""
        if self.form_initial is None:
            return np.zeros((self.X.dim, directions.shape[1]))
        changed = self.form_initial.product("v", "q", directions, moment, q=q)
        return self.state_space.completed(self._projection.riesz(changed))

    def initial_parameter(self, q0: Any = None) -> Array:
        """Return latent coefficients of q0, by default the prior mean; fixed ones are zero."""
        if q0 is None:
            q = self.latent.prior.copy()
        else:
            physical = self.parameter_space.interpolate(q0)
            if not np.isfinite(physical).all():
                raise ModelError("q0 holds values that are not finite.")
            q = self.latent.inverse(physical).copy()
        q[self.latent.fixed] = 0.0
        lower, upper = self.latent.bounds
        if np.any(q < lower) or np.any(q > upper):
            raise ModelError("q0 is outside the bounds of a scalar unknown.")
        return q
