"""Fields on meshes and weak forms: the only subpackage that imports scikit-fem."""

from __future__ import annotations

from skfem.helpers import dd as hess
from skfem.helpers import ddot, div, dot, grad, mul, trace, transpose

from livepde.fem.coefficients import Coefficients, numbers
from livepde.fem.evolution import Evolution, MeanReverting, Periodic, RandomWalk
from livepde.fem.field_blocks import FieldBlock, base_name
from livepde.fem.fields import (
    Channel,
    Declaration,
    Field,
    Integrand,
    On,
    Piecewise,
    Predicate,
    Scalar,
    Scalars,
    Unknown,
    declared,
    interval,
    line,
)
from livepde.fem.forms import Form, ignores
from livepde.fem.latent import Composed, Latent, LatentPart, compose
from livepde.fem.meshes import (
    box,
    cells,
    grid,
    hermite,
    linear,
    quadratic,
    read_mesh,
    rectangle,
    smooth,
)
from livepde.fem.notation import absolute, maximum, minimum, positive, upwind
from livepde.fem.place import START, Inputs, Moment, Place, with_constants
from livepde.fem.priors import LogitNormal, LogNormal, Normal, Prior
from livepde.fem.random_field import random_field
from livepde.fem.sobolev import Sobolev
from livepde.fem.space import FunctionSpace, Named

__all__ = [
    "START",
    "Channel",
    "Coefficients",
    "Composed",
    "Declaration",
    "Evolution",
    "Field",
    "FieldBlock",
    "Form",
    "FunctionSpace",
    "Inputs",
    "Integrand",
    "Latent",
    "LatentPart",
    "LogNormal",
    "LogitNormal",
    "MeanReverting",
    "Moment",
    "Named",
    "Normal",
    "On",
    "Periodic",
    "Piecewise",
    "Place",
    "Predicate",
    "Prior",
    "RandomWalk",
    "Scalar",
    "Scalars",
    "Sobolev",
    "Unknown",
    "absolute",
    "base_name",
    "box",
    "cells",
    "compose",
    "ddot",
    "declared",
    "div",
    "dot",
    "grad",
    "grid",
    "hermite",
    "hess",
    "ignores",
    "interval",
    "line",
    "linear",
    "maximum",
    "minimum",
    "mul",
    "numbers",
    "positive",
    "quadratic",
    "random_field",
    "read_mesh",
    "rectangle",
    "smooth",
    "trace",
    "transpose",
    "upwind",
    "with_constants",
]
