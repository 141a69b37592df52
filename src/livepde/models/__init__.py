"""Predefined equations: functions that return a `Model`, each with an entry in `EQUATIONS`."""

from __future__ import annotations

from livepde.models.advection import ADVECTION_DIFFUSION, advection_diffusion
from livepde.models.allen_cahn import ALLEN_CAHN, allen_cahn
from livepde.models.battery import BATTERY_PARTICLE, battery_particle
from livepde.models.borehole import BOREHOLE, GROUTED_BOREHOLE, borehole, fluid, grouted_borehole
from livepde.models.boundary_conditions import Exchange, Flux, Source, with_conditions
from livepde.models.burgers import BURGERS, burgers
from livepde.models.description import Equation, Fluxes, Option, Quantity, Variable
from livepde.models.diffusion import CONDUCTION, HEAT, conduction, heat
from livepde.models.fisher import FISHER_KPP, POROUS_FISHER, fisher_kpp, porous_fisher
from livepde.models.groundwater import GROUNDWATER, PUMPING_TEST, groundwater, pumping_test
from livepde.models.kdv import KDV, kdv
from livepde.models.kuramoto_sivashinsky import KURAMOTO_SIVASHINSKY, kuramoto_sivashinsky
from livepde.models.reaction import REACTION_DIFFUSION, reaction_diffusion
from livepde.models.transport import (
    ADVECTION_DISPERSION,
    MOBILE_IMMOBILE,
    advection_dispersion,
    mobile_immobile,
)
from livepde.models.wave import WAVE, wave

__all__ = [
    "EQUATIONS",
    "Equation",
    "Exchange",
    "Flux",
    "Fluxes",
    "Option",
    "Quantity",
    "Source",
    "Variable",
    "advection_diffusion",
    "advection_dispersion",
    "allen_cahn",
    "battery_particle",
    "borehole",
    "burgers",
    "conduction",
    "fisher_kpp",
    "fluid",
    "groundwater",
    "grouted_borehole",
    "heat",
    "kdv",
    "kuramoto_sivashinsky",
    "mobile_immobile",
    "porous_fisher",
    "pumping_test",
    "reaction_diffusion",
    "wave",
    "with_conditions",
]

EQUATIONS: dict[str, Equation] = {
    equation.name: equation
    for equation in (
        HEAT,
        CONDUCTION,
        ADVECTION_DIFFUSION,
        BOREHOLE,
        GROUTED_BOREHOLE,
        REACTION_DIFFUSION,
        FISHER_KPP,
        POROUS_FISHER,
        WAVE,
        BURGERS,
        KDV,
        KURAMOTO_SIVASHINSKY,
        ALLEN_CAHN,
        GROUNDWATER,
        PUMPING_TEST,
        BATTERY_PARTICLE,
        ADVECTION_DISPERSION,
        MOBILE_IMMOBILE,
    )
}
