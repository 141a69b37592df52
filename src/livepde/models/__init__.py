"""Predefined equations: functions that return a `Model`, with descriptions in `EQUATIONS`."""

from __future__ import annotations

from livepde.models.battery import BATTERY_PARTICLE, battery_particle
from livepde.models.borehole import BOREHOLE, GROUTED_BOREHOLE, borehole, fluid, grouted_borehole
from livepde.models.boundary_conditions import Exchange, Flux, Source, with_conditions
from livepde.models.description import Equation, Fluxes, Option, Quantity, Variable
from livepde.models.diffusion import CONDUCTION, HEAT, conduction, heat
from livepde.models.groundwater import (
    ADVECTION_DISPERSION,
    GROUNDWATER,
    MOBILE_IMMOBILE,
    PUMPING_TEST,
    advection_dispersion,
    groundwater,
    mobile_immobile,
    pumping_test,
)
from livepde.models.reaction import (
    ALLEN_CAHN,
    FISHER_KPP,
    POROUS_FISHER,
    REACTION_DIFFUSION,
    allen_cahn,
    fisher_kpp,
    porous_fisher,
    reaction_diffusion,
)
from livepde.models.waves import (
    ADVECTION_DIFFUSION,
    BURGERS,
    KDV,
    KURAMOTO_SIVASHINSKY,
    WAVE,
    advection_diffusion,
    burgers,
    kdv,
    kuramoto_sivashinsky,
    wave,
)

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
