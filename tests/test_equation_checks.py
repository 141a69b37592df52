"""Every ready-made equation and kind of unknown passes the shipped checks for random draws."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import livepde as lp
from livepde.fem import line, linear
from livepde.fem.priors import CONSTANT
from livepde.models import EQUATIONS, Option

pytestmark = pytest.mark.slow

REGIONS = {"inner": lambda x: x[0] < 0.5, "outer": lambda x: x[0] >= 0.5}
Range = tuple[float, float]


@dataclass(frozen=True)
class Typical:
    """Where an equation is checked, if not where all of them are.

    Numbers are drawn from 0.3 to 3 unless a range is given; without dimension all is of size one,
    so that terms balance. One of each group in `either` is given.
    """

    mesh: Callable[[], Any] = lambda: line([0.1, 0.3, 0.5, 0.8, 1.2])
    ranges: Mapping[str, Range] = field(default_factory=dict)
    either: tuple[tuple[str, ...], ...] = ()


TYPICAL = {
    "battery_particle": Typical(lambda: line([0.0, 0.3, 0.5, 0.8, 1.2])),
    "grouted_borehole": Typical(
        lambda: lp.interval(0.05, 2.0, 12, geometric=True),
        {"r_p": (0.1, 0.2), "r_b": (0.4, 0.8), "share": (0.2, 0.8)},
    ),
    "groundwater": Typical(
        lambda: lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4)),
        {"radius": (0.4, 0.8), "x": (0.4, 0.6), "y": (0.4, 0.6)},
    ),
    "advection_diffusion": Typical(either=(("v", "K"),)),
    "porous_fisher": Typical(ranges={"m": (1.0, 3.0)}),
    "advection_dispersion": Typical(ranges={"R": (1.0, 3.0)}),
    "mobile_immobile": Typical(ranges={"phi": (0.2, 0.8)}),
}

EVOLUTIONS = (lp.RandomWalk(0.1), lp.MeanReverting(2.0), lp.fem.Periodic(3.0, harmonics=2))
WITHOUT_HARMONICS = (*EVOLUTIONS[:2], CONSTANT)


def number(name: str, typical: Typical) -> st.SearchStrategy[float]:
    return st.floats(*typical.ranges.get(name, (0.3, 3.0)))


@st.composite
def unknown(draw: Any, name: str, text: str, mesh: Any, typical: Typical) -> Any:
    """Draw an unknown of any kind that the equation says it takes, with any prior and evolution."""
    low, high = typical.ranges.get(name, (0.0, 10.0))
    prior = draw(number(name, typical))
    options: dict[str, Any]
    # A normal unknown stays near its mean: nothing else keeps a divisor from zero.
    if name not in typical.ranges and draw(st.booleans()):
        evolution = draw(st.sampled_from((*EVOLUTIONS, CONSTANT)))
        options = {"prior": lp.Normal(prior, 0.05 * prior), "evolution": evolution}
    else:
        std, evolution = (
            prior * draw(st.floats(0.05, 0.5)),
            draw(st.sampled_from(WITHOUT_HARMONICS)),
        )
        between = lp.LogitNormal(prior, std, (0.9 * low, 1.1 * high))
        inside = name in typical.ranges or draw(st.booleans())
        options = {"prior": between if inside else lp.LogNormal(prior, std), "evolution": evolution}
    kinds = ["number"] * ("initial" not in text)
    kinds += ["field"] * ("field" in text)
    kinds += ["regions"] * ("by layer" in text or "by region" in text)
    kind = draw(st.sampled_from(kinds))
    if kind == "field":
        return lp.Field(mesh, linear(mesh), inner="H1", **options)
    return lp.Piecewise(REGIONS, **options) if kind == "regions" else lp.Scalar(**options)


@st.composite
def option(draw: Any, name: str, known: Option, typical: Typical) -> Any:
    if known.choices:
        return draw(st.sampled_from(known.choices))
    return draw(st.booleans() if known.kind is bool else number(name, typical))


@st.composite
def models(draw: Any, name: str) -> lp.Model:
    equation, typical = EQUATIONS[name], TYPICAL.get(name, Typical())
    mesh = typical.mesh()
    optional = [key for key, known in equation.unknowns.items() if known.optional]
    out = {key for key in optional if draw(st.booleans())}
    for group in typical.either:
        out = (out | set(group)) - {draw(st.sampled_from(group))}
    unknowns = {
        key: draw(unknown(key, known.text, mesh, typical))
        for key, known in equation.unknowns.items()
        if key not in out
    }
    known = {key: item for key, item in equation.options.items() if key not in unknowns}
    options = {key: draw(option(key, item, typical)) for key, item in known.items()}
    return equation.build(mesh, unknowns, {}, **options)


@pytest.mark.long
@pytest.mark.parametrize("name", EQUATIONS)
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data(), seed=st.integers(0, 2**31))
def test_every_equation_passes_the_checks(name: str, data: Any, seed: int) -> None:
    model = data.draw(models(name))
    u = 0.7 if model.state_space.single else dict.fromkeys(model.state_space.blocks, 0.7)
    inputs = {channel: data.draw(st.floats(-2.0, 2.0)) for channel in model.channels}
    lp.diagnostics.check_model(model, u=u, t=0.5, inputs=inputs, seed=seed).raise_if_failed()


@pytest.mark.parametrize(
    "name",
    [
        "battery_particle",
        "borehole",
        "grouted_borehole",
        "pumping_test",
        "advection_dispersion",
        "kuramoto_sivashinsky",
    ],
)
def test_equations_with_their_own_boundary_values_refuse_others(name: str) -> None:
    with pytest.raises(
        lp.errors.ModelError, match=rf"^{name} is .*: leave out the values on \['left'\]"
    ):
        EQUATIONS[name].build(line([0.0, 1.0]), {}, {"left": 1.0})


# --- unknowns ------------------------------------------------------------------------------------

MESH = line([0.0, 0.2, 0.5, 0.7, 1.0])
KINDS: dict[str, Callable[..., Any]] = {
    "number": lp.Scalar,
    "by region": lambda **options: lp.Piecewise(REGIONS, **options),
    "by name": lambda **options: lp.Scalars(("a", "b"), **options),
    "field": lambda **options: lp.Field(MESH, linear(MESH), inner="H1", **options),
}
FORMS: dict[str, Callable[[Any, Any, Any, Any], Any]] = {
    "linear": lambda k, u, v, x: k * u * v + lp.dot(lp.grad(u), lp.grad(v)),
    "nonlinear": lambda k, u, v, x: k**2 * u**2 * v + lp.dot(lp.grad(u), lp.grad(v)) / (2 + k**2),
}


@pytest.mark.long
@pytest.mark.parametrize("distribution", [lp.Normal, lp.LogNormal, lp.LogitNormal])
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=8, deadline=None)
@example(  # a value that is almost, but not quite, zero
    form="linear",
    lower=-6e-192,
    width=1.0,
    at=0.25,
    share=0.5,
    evolution=lp.RandomWalk(0.1),
    seed=0,
)
@given(
    form=st.sampled_from([*FORMS]),
    lower=st.floats(-2.0, 0.0),
    width=st.floats(1.0, 5.0),
    at=st.floats(0.2, 0.8),
    share=st.floats(0.05, 0.5),
    evolution=st.sampled_from(EVOLUTIONS),
    seed=st.integers(0, 2**31),
)
def test_every_unknown_passes_the_checks_and_stays_inside(
    form: str,
    distribution: Any,
    kind: str,
    lower: float,
    width: float,
    at: float,
    share: float,
    evolution: Any,
    seed: int,
) -> None:
    upper = np.inf if distribution is lp.LogNormal else lower + width
    prior = distribution(lower + at * width, share * width, bounds=(lower, upper))
    options: dict[str, Any] = {"prior": prior}
    if distribution is lp.Normal and (kind == "field" or evolution.copies > 1):  # without bounds
        options = {"prior": lp.Normal(prior.centre, prior.std)}
    if distribution is lp.Normal or evolution.copies == 1:
        options["evolution"] = evolution
    term = FORMS[form]

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return term(q.k["a"] + q.k["b"] if kind == "by name" else q.k, u, v, x)

    model = lp.Model(lp.Field(MESH, linear(MESH)), {"k": KINDS[kind](**options)}, A)
    lp.diagnostics.check_model(model, u=0.7, seed=seed).raise_if_failed()
    if distribution is not lp.Normal:
        latent = model.latent
        a = 20.0 * np.random.default_rng(seed).standard_normal(latent.dim)
        q = latent.value(a)
        assert np.isfinite(q).all()
        assert lower <= q.min()
        assert q.max() <= upper
