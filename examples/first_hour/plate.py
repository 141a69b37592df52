"""A diffusivity field on a Gmsh mesh from 30 noisy thermometers, with its standard deviation."""

import pandas as pd

import livepde as lp
from livepde.models import heat

FOLDER = "examples/first_hour/"
mesh = lp.read_mesh(FOLDER + "plate.msh")  # boundaries "heated" and "closed"
smooth = lp.Sobolev(2, 0.3).pointwise(2)  # correlated over about 0.3 m
prior = lp.LogNormal(1e-4, std=4e-5)  # at each point
alpha = lp.Field(mesh, lp.linear(mesh), inner=smooth, prior=prior, unit="m^2/s")
model = heat(mesh, alpha, {"heated": lp.Channel("T_hot")})

places = pd.read_csv(FOLDER + "places.csv", index_col="name")
sensors = lp.Points({name: tuple(at) for name, at in places.iterrows()}, noise=0.2)
identifier = lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=20.0)
rows = pd.read_csv(FOLDER + "plate.csv", index_col="time_s")
result = identifier.run((time, row.to_dict()) for time, row in rows.iterrows())
data = result.to_xarray()  # data["alpha"] and data["alpha_std"] at the vertices
result.plot().savefig("plate.png")
