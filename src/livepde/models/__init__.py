"""Ready-made equations: each a function that returns a `Model`, and an entry of `EQUATIONS`."""

from __future__ import annotations

from livepde.models.base import Equation, Option, Quantity, Variable
from livepde.models.diffusion import HEAT, heat
from livepde.models.radial import BOREHOLE, borehole, fluid
from livepde.models.reaction import REACTION_DIFFUSION, reaction_diffusion
from livepde.models.wave import WAVE, wave

__all__ = [
    "EQUATIONS",
    "Equation",
    "Option",
    "Quantity",
    "Variable",
    "borehole",
    "fluid",
    "heat",
    "reaction_diffusion",
    "wave",
]

EQUATIONS: dict[str, Equation] = {
    equation.name: equation for equation in (HEAT, BOREHOLE, REACTION_DIFFUSION, WAVE)
}
