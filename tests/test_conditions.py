"""Fluxes, exchange and sources as conditions of a model and of a case: known, measured, unknown."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from factories import few, line, reaction
from scipy.linalg import expm
from skfem import ElementLineP1

import livepde as lp
from livepde.cases import load
from livepde.errors import CaseError, ModelError
from livepde.models import (
    Exchange,
    Flux,
    Source,
    battery_particle,
    borehole,
    conduction,
    heat,
    with_conditions,
)
from livepde.stepping import Advance, Alexander2, simulate
from livepde.stepping.member_stage import BandedStage

K, C, LENGTH = 2.0, 4.0, 1.0


def slab(dirichlet: Any = None) -> lp.Model:
    return conduction(lp.interval(0.0, LENGTH, 40), lp.Normal(K, 1.0), dirichlet, C=C)


def steady(model: lp.Model, values: Mapping[str, float], inputs: Any = None) -> Any:
    """Return the state at the vertices after a long time."""
    q = model.initial_parameter(values)
    times = np.linspace(0.0, 400.0, 400).tolist()
    *_, (_, u) = simulate(model, q, 0.0, times, Advance(Alexander2()), inputs)
    return model.state_block.at_vertices @ u


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["number", "channel", "unknown"])
def test_a_flux_gives_the_exact_gradient(kind: str) -> None:
    amount = {"number": 6.0, "channel": lp.Channel("J"), "unknown": "J"}[kind]
    unknowns = {"J": lp.Normal(0.0, 1.0)} if kind == "unknown" else {}
    model = with_conditions(slab({"right": 20.0}), {"left": Flux(amount)}, unknowns=unknowns)
    values = {"k": K} | ({"J": 6.0} if unknowns else {})
    inputs = (lambda t: {"J": 6.0}) if kind == "channel" else None
    found = steady(model, values, inputs)
    x = np.linspace(0.0, LENGTH, 41)
    assert found == pytest.approx(20.0 + 6.0 / K * (LENGTH - x), abs=1e-6)


@pytest.mark.parametrize("coefficient", [3.0, "h"])
@pytest.mark.parametrize("ambient", [50.0, "T_w"])
def test_an_exchange_gives_the_exact_profile(coefficient: Any, ambient: Any) -> None:
    given = {"h": 3.0, "T_w": 50.0}
    unknowns = {name: lp.Normal(1.0, 1.0) for name in given if name in (coefficient, ambient)}
    model = with_conditions(
        slab({"right": 0.0}), {"left": Exchange(coefficient, ambient)}, unknowns=unknowns
    )
    found = steady(model, {"k": K, **{name: given[name] for name in unknowns}})
    left = 3.0 * 50.0 / (3.0 + K / LENGTH)  # h (ambient - u) = k u/L
    assert found == pytest.approx(left * (1.0 - np.linspace(0.0, 1.0, 41)), abs=1e-6)


def test_flux_and_exchange_of_one_boundary_add_up() -> None:
    both = {"left": [Flux(6.0), Exchange(3.0, 50.0)]}
    found = steady(with_conditions(slab({"right": 0.0}), both), {"k": K})
    assert found[0] == pytest.approx((6.0 + 150.0) / (3.0 + K))


@pytest.mark.parametrize("over", [None, lambda x: x[0] < 0.5])
def test_a_source_heats_its_region(over: Any) -> None:
    model = with_conditions(slab({"right": 0.0}), sources={"heater": Source(6.0, over)})
    found = steady(model, {"k": K})
    # -k u'' = 6 in the region, u'(0) = 0, u(1) = 0
    exact = 6.0 / K / 2.0 if over is None else 6.0 / K * (0.5**2 / 2.0 + 0.5 * 0.5)
    assert found[0] == pytest.approx(exact, rel=1e-6)


def test_a_source_that_the_mesh_integrates_wrongly_gets_a_warning() -> None:
    """0.1 m instead of 0.14 m of a rod: 29 % of the power were missing without a word."""
    rod = lp.models.conduction(lp.interval(0.0, 1.0, 10), lp.LogNormal(1.0, std=0.5), C=1.0)
    source = Source(1.0, lambda x: (x[0] > 0.33) & (x[0] < 0.47))
    with pytest.warns(UserWarning, match="over 0.1 instead of 0.14, so its power is wrong"):
        with_conditions(rod, sources={"heater": source})
    fitted = lp.fem.line([0.0, 0.1, 0.2, 0.33, 0.4, 0.47, 0.6, 0.8, 1.0])
    rod = lp.models.conduction(fitted, lp.LogNormal(1.0, std=0.5), C=1.0)
    with_conditions(rod, sources={"heater": source})


def test_says_what_is_wrong_with_a_condition() -> None:
    for given, text in (
        ({"boundary": {"top": Flux(1.0)}}, "no boundary 'top'"),
        ({"boundary": {"right": Flux(1.0)}}, "has a value"),
        ({"boundary": {"left": Flux("J")}}, "none of the unknowns"),
        ({"unknowns": {"J": lp.Normal()}}, "no condition names the unknown 'J'"),
        ({"boundary": {"left": Flux(1.0)}, "per": "C"}, "per='C' is not an unknown of the model"),
        ({"sources": {"s": Source(1.0, "core")}}, "no subdomain 'core'"),
        ({"sources": {"s": Source(1.0, lambda x: x[0] > 2.0)}}, "no cell"),
        ({"boundary": {"left": Exchange(-5.0, 20.0)}}, "the coefficient -5.0; expected 0 or more"),
        ({"boundary": {"left": Exchange(np.nan, 20.0)}}, "got nan; expected a finite number"),
        ({"boundary": {"left": Flux(lambda x, t: 1.0)}}, "expected a finite number"),  # type: ignore[arg-type]
    ):
        with pytest.raises(ModelError, match=text):
            with_conditions(slab({"right": 20.0}), **given)  # type: ignore[arg-type]


def test_terms_beside_a_given_derivative_are_refused() -> None:
    model = reaction(line(4), ElementLineP1(), dA=lambda q, u, du, v, x: q * du * v)
    with pytest.raises(ModelError, match="dA"):
        model.with_terms(A=[lambda q, u, v, x: v])


CASE = """\
equation = "conduction"
initial = 20
mesh = { from = 0, to = "10 cm", cells = 20 }
options.C = "3.7e6 J/(m^3 K)"
data = { file = "wall.csv", time = "t", time_unit = "s" }

[boundary]
left = { flux = "J" }

[unknowns]
k = { prior = "20 W/(m K)", std = "10 W/(m K)", transform = "log" }
J = { prior = 0, std = "3 W/cm^2" }

[channels]
T1 = { role = "sensor", column = "T1", at = "5 mm", noise = "0.1 K" }
T2 = { role = "sensor", column = "T2", at = "50 mm", noise = "0.1 K" }
T_cold = { role = "boundary", column = "T3", at = "right" }
"""


def wall(folder: Path, k: float = 28.5, J: float = 2e4) -> Path:
    """Write a case and measurements of a wall, by finite volumes, and return the case."""
    cells, width, rng = 200, 20.0, np.random.default_rng(1)
    h = 0.1 / cells
    x, u = h * (np.arange(cells) + 0.5), np.full(cells, 20.0)
    A = np.diag(np.full(cells, -2.0)) + np.diag(np.ones(cells - 1), 1)
    A += np.diag(np.ones(cells - 1), -1)
    A[0, 0], A[-1, -1] = -1.0, -3.0  # the value at the right end, half a cell away
    A *= k / (3.7e6 * h**2)
    gained = np.zeros(cells)
    gained[0], gained[-1] = J / (3.7e6 * h), 2 * k * 20.0 / (3.7e6 * h**2)
    steady, decay = np.linalg.solve(-A, gained), expm(A * width)
    lines = ["t,T1,T2,T3"]
    for n in range(61):
        T = np.interp([0.005, 0.05], x, u) + 0.1 * rng.standard_normal(2)
        lines.append(f"{n * width},{T[0]:.3f},{T[1]:.3f},20.0")
        u = steady + decay @ (u - steady)  # exact in time
    (folder / "wall.csv").write_text("\n".join(lines) + "\n")
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


@pytest.mark.slow
def test_a_case_finds_conductivity_and_heat_flux(tmp_path: Path) -> None:
    """The law is the default one; the truth comes from finite volumes on another mesh."""
    prepared = load(wall(tmp_path)).prepare()
    for sample in prepared.stream:
        estimate = prepared.identifier.step(sample.t, sample.z, sample.inputs)
    low, high = np.array([estimate[name].interval() for name in ("k", "J")]).reshape(2, 2).T
    assert (low < [28.5, 2e4]).all()
    assert (high > [28.5, 2e4]).all()
    assert estimate.q_std[1] < 500.0


def changed(folder: Path, *pairs: tuple[str, str]) -> Path:
    path, text = folder / "case.toml", CASE
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def test_conditions_of_a_case_are_numbers_and_channels_too(tmp_path: Path) -> None:
    file = changed(
        tmp_path,
        ('left = { flux = "J" }', 'left = { transfer = "h", ambient = "T_air" }'),
        ("J = { prior = 0", 'h = { prior = "5 W/(m^2 K)"'),
        ("3 W/cm^2", "3 W/(m^2 K)"),
        ("[channels]", '[sources]\ns = { value = "P", over = [0, "2 cm"] }\n[channels]'),
        ("[channels]", '[channels]\nT_air = { role = "input", column = "T", unit = "degF" }'),
        ("[channels]", '[channels]\nP = { role = "input", column = "P", unit = "kW/m^3" }'),
    )
    case = load(file)
    assert tuple(case.model.parameter_space.labels) == ("k", "h")
    assert set(case.model.inputs) == {"P", "T_air"}
    assert case.unit("T_air") == "degC"
    assert case.unit("P") == "W/m^3"


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('"J" }', '"j" }', "boundary.left.flux: there is no unknown and no channel 'j'; expected"),
        ('"J" }', '"T1" }', "the channel 'T1' has to be of role 'input'"),
        ('"J" }', '"k" }', "'k' is the conductivity"),
        ('"J" }', '"5 K" }', "boundary.left.flux"),
        ("left =", "lft =", "no boundary 'lft'"),
        ('{ flux = "J" }', '{ transfer = "J" }', "transfer and ambient require each other"),
        ('{ flux = "J" }', '{ value = 1, flux = "J" }', "expected a value, or flux"),
        ("left =", "right =", "'right' has a value"),
        ('"conduction"', '"burgers"', "takes no fluxes"),
    ],
)
def test_a_case_says_what_is_wrong_with_a_condition(
    tmp_path: Path, old: str, new: str, text: str
) -> None:
    with pytest.raises(CaseError, match=text.replace("(", r"\(")):
        load(changed(tmp_path, (old, new)))


def test_sensors_from_a_table_of_positions(tmp_path: Path) -> None:
    sensor = CASE[CASE.index("T1 =") : CASE.index("T_cold")]
    table = 'T = { role = "sensor", positions = "places.csv", noise = "0.1 K" }\n'
    (tmp_path / "places.csv").write_text("name,x\nT1,0.005\nT2,50 mm\n")
    places = load(changed(tmp_path, (sensor, table))).spec.channels
    assert {name: item.at for name, item in places.items() if item.role == "sensor"} == {
        "T1": 0.005,
        "T2": 0.05,
    }
    assert places["T2"].column == "T2"
    for text, found in (
        ("name,x\nT1,0.005\nT1,0.05\n", "row 3: the name 'T1' occurs twice"),
        ("sensor,x\nT1,0.005\n", "expected name, x"),
        ("name,x\nT1,far\n", "row 2"),
        ("name,x\n,0.005\n", "row 2: the name is missing"),
        ("name,x\nT_cold,0.005\n", "a channel 'T_cold' already"),
    ):
        (tmp_path / "places.csv").write_text(text)
        with pytest.raises(CaseError, match=found):
            load(changed(tmp_path, (sensor, table)))
    (tmp_path / "places.csv").unlink()
    with pytest.raises(CaseError, match="cannot be read"):
        load(changed(tmp_path, (sensor, table)))


def test_heat_takes_fluxes_over_the_heat_capacity() -> None:
    """The flux J/C into u_t = div(alpha grad u) is that of J into C u_t = div(k grad u)."""
    mesh = lp.interval(0.0, LENGTH, 40)
    one = with_conditions(slab({"right": 0.0}), {"left": Flux(6.0)})
    two = heat(mesh, lp.Normal(K / C, 1.0), {"right": 0.0})
    two = with_conditions(two, {"left": Flux(6.0 / C)})
    assert steady(one, {"k": K}) == pytest.approx(steady(two, {"alpha": K / C}))


@pytest.mark.slow
def test_a_constant_input_equals_its_channel() -> None:
    mesh = lp.interval(0.0, LENGTH, 40)
    unknowns = {"k": K, "loss": 0.3, "transfer": 0.2}
    scalars = {name: lp.Normal(value, 1.0) for name, value in unknowns.items()}
    model = conduction(mesh, dirichlet={"right": 0.0}, C=C, **scalars)
    constant = model.with_constant_inputs({"ambient": 7.0})
    assert (model.channels, constant.channels) == (("ambient",), ())
    assert constant.constant
    assert not model.constant
    expected = steady(model, unknowns, lambda t: {"ambient": 7.0})
    assert steady(constant, unknowns) == pytest.approx(expected, abs=1e-9)
    with pytest.raises(ModelError, match=r"no input 'Q'; it has \['ambient'\]"):
        model.with_constant_inputs({"Q": 1.0})


@pytest.mark.slow
def test_one_input_is_constant_and_another_a_channel() -> None:
    model = with_conditions(slab({"right": 0.0}), {"left": Flux(lp.Channel("J"))})
    model = with_conditions(model, sources={"s": Source(lp.Channel("P"))})
    part = model.with_constant_inputs({"P": 2.0})
    assert part.channels == ("J",)
    both = steady(model, {"k": K}, lambda t: {"J": 3.0, "P": 2.0})
    assert steady(part, {"k": K}, lambda t: {"J": 3.0}) == pytest.approx(both, abs=1e-9)


def test_a_source_with_a_constant_input_is_assembled_once() -> None:
    f = lp.On("left", lambda x, _: x.inputs["Q"])
    source = reaction(line(4), ElementLineP1(), f=f, inputs=["Q"])
    assert source.with_constant_inputs({"Q": 2.0}).form_F.constant
    assert not source.form_F.constant


TEST = """\
equation = "borehole"
initial = "10 degC"
mesh = { from = "7.5 cm", to = "8 m", cells = 30, spacing = "geometric" }
data = { file = "test.csv", time = "t", time_unit = "h" }
options = { H = "100 m", rho_c = "2.3e6 J/(m^3 K)", T0 = "10 degC" }
unknowns.k = { prior = "2 W/(m K)", std = "0.6 W/(m K)", transform = "log" }
unknowns.R_b = { prior = "0.1 m K/W", std = "0.03 m K/W", transform = "log" }
INPUT
[channels]
T = { role = "sensor", column = "T", quantity = "fluid", noise = "0.05 K" }
COLUMN
"""
COLUMN = 'Q = { role = "input", column = "Q", unit = "kW" }'


def response(folder: Path, given: str, column: str) -> Path:
    rows = [f"{t},{10.0 + 3.0 * np.log1p(t)},5" for t in range(30)]
    (folder / "test.csv").write_text("\n".join(["t,T,Q", *rows]) + "\n")
    path = folder / "case.toml"
    path.write_text(TEST.replace("INPUT", given).replace("COLUMN", column))
    return path


@pytest.mark.long
def test_a_constant_input_of_a_case_is_that_of_a_column(tmp_path: Path) -> None:
    found = []
    for given, column in (("", COLUMN), ('inputs.Q = "5 kW"', "")):
        prepared = load(response(tmp_path, given, column)).prepare()
        for sample in prepared.stream:
            estimate = prepared.identifier.step(sample.t, sample.z, sample.inputs)
        found.append(estimate)
    assert found[1].q == pytest.approx(found[0].q, rel=1e-6)
    assert found[1].q_std == pytest.approx(found[0].q_std, rel=1e-6)


@pytest.mark.parametrize(
    ("given", "column", "text"),
    [
        ('inputs.Q = "5 kW"', COLUMN, "inputs.Q: there is a channel 'Q', too; keep one"),
        ('inputs.q = "5 kW"', "", "inputs: the equation 'borehole' has no 'q' here"),
        ('inputs.Q = "5 K"', "", "inputs.Q: 'K' cannot be converted to 'W'"),
        ("", "", "channels.Q is missing: .* with role = 'input'; or a constant, inputs.Q"),
    ],
)
def test_a_constant_input_that_is_refused(
    tmp_path: Path, given: str, column: str, text: str
) -> None:
    with pytest.raises(CaseError, match=text):
        load(response(tmp_path, given, column))


def test_a_constant_input_that_nothing_reads_is_refused(tmp_path: Path) -> None:
    text = "inputs.ambient: the equation does not read it with these unknowns"
    with pytest.raises(CaseError, match=text):
        load(changed(tmp_path, ("[boundary]", 'inputs.ambient = "12 degC"\n[boundary]')))


# --- an unknown heat capacity --------------------------------------------------------------------


def divided(**options: Any) -> lp.Model:
    return conduction(
        lp.interval(0.0, LENGTH, 40),
        lp.Normal(K, 1.0),
        {"right": 0.0},
        C=lp.Normal(C, 1.0),
        **options,
    )


@pytest.mark.parametrize(
    ("conditions", "own"),
    few(
        8,
        [
            {"boundary": {"left": Flux(6.0)}},
            {"boundary": {"left": Flux(lp.Channel("J"))}},
            {"boundary": {"left": [Flux("J"), Exchange(3.0, 50.0)]}},
            {"sources": {"heater": Source(6.0, lambda x: x[0] < 0.3)}},
        ],
        [{}, *({name: lp.Normal(2.0, 1.0)} for name in ("source", "loss", "transfer"))],
    ),
)
def test_an_unknown_heat_capacity_is_as_the_known_one_of_its_value(conditions, own) -> None:
    """The divided equation and that with C in the mass matrix are one at the same value of C."""
    unknowns = {"J": lp.Normal(6.0, 1.0)} if "[Flux" in str(conditions) else {}
    inputs = {name: 6.0 for name in ("J",) if "Channel" in str(conditions)}
    inputs |= {"ambient": 5.0} if {"loss", "transfer"} & set(own) else {}
    known = conduction(lp.interval(0.0, LENGTH, 40), lp.Normal(K, 1.0), {"right": 0.0}, C=C, **own)
    models = (
        with_conditions(known, **conditions, unknowns=unknowns),
        with_conditions(divided(**own), **conditions, unknowns=unknowns, per="C"),
    )
    states = []
    for model in models:
        q, drive = model.initial_parameter(), (lambda t: inputs) if inputs else None
        *_, (_, u) = simulate(model, q, 0.0, [0.0, 0.2, 0.4], Advance(Alexander2(), 0.02), drive)
        states.append(model.state_block.at_vertices @ u)
    assert np.abs(states[0]).max() > 0.1
    assert states[1] == pytest.approx(states[0], abs=1e-9)


def test_an_unknown_heat_capacity_is_one_number() -> None:
    two = lp.Scalars(["a", "b"], lp.Normal(1.0, 0.1))
    with pytest.raises(ModelError, match="an unknown C must be one number"):
        conduction(lp.interval(0.0, 1.0, 8), lp.Normal(K, 1.0), C=two)


WALL = """
equation = "conduction"
initial = 20
mesh = { from = 0, to = 1, cells = 8 }
data = { file = "wall.csv", time = "t", time_unit = "s" }
CONDITION
[unknowns]
k = { prior = 2, std = 1 }
C = { prior = 4, std = 1 }
[channels]
T = { role = "sensor", column = "T", at = 0, noise = 0.1 }
right = { role = "boundary", column = "T", at = "right" }
q = { role = "input", column = "q" }
"""


@pytest.mark.parametrize(
    ("condition", "text"),
    [
        ("", "unknowns.C: temperatures alone do not determine 'C'"),
        ("boundary.left = { flux = 0 }", "requires a known flux, exchange or source"),
        ('boundary.left = { flux = "q" }\noptions.C = 3', "options.C: unknowns.C is stated, too"),
    ],
)
def test_what_is_missing_for_an_unknown_heat_capacity_is_said(tmp_path, condition, text) -> None:
    (tmp_path / "case.toml").write_text(WALL.replace("CONDITION", condition))
    with pytest.raises(CaseError, match=text):
        load(tmp_path / "case.toml")


def test_a_measured_flux_determines_it(tmp_path) -> None:
    path = tmp_path / "case.toml"
    path.write_text(WALL.replace("CONDITION", 'boundary.left = { flux = "q" }'))
    assert list(load(path).model.parameter_space.labels) == ["k", "C"]


def test_a_measured_flux_leaves_the_matrices_constant() -> None:
    ends = {"left": Flux(lp.Channel("J")), "right": Exchange(10.0, lp.Channel("T_air"))}
    driven = with_conditions(slab(), ends)
    assert driven.steady
    assert not BandedStage.refuses(driven)
    unknown = conduction(lp.interval(0.0, LENGTH, 8), lp.LogNormal(K, 1.0), C=lp.LogNormal(C, 1.0))
    assert not BandedStage.refuses(with_conditions(unknown, ends, per="C"))
    moving = with_conditions(slab(), {"right": Exchange(lp.Channel("h"), 20.0)})
    assert not moving.steady


def test_a_product_of_an_unknown_and_an_input_that_vanishes_at_the_prior_mean_is_seen() -> None:
    """A load that is no line in its input for most unknowns is assembled at each stage."""
    mesh = lp.interval(0.0, LENGTH, 8)
    model = lp.Model(
        lp.Field(mesh, lp.fem.linear(mesh), dirichlet={"left": 0.0}),
        {"a": lp.Normal(0.0, 1.0)},
        A=lambda q, _, v, x: -np.exp(q.a * x.inputs["p"]) * v,
        B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        inputs=["p"],
    )
    u = steady(model, {"a": 0.7}, lambda t: {"p": 1.5})
    x = mesh.p[0]
    exact = np.exp(0.7 * 1.5) * (LENGTH * x - 0.5 * x**2)
    assert np.abs(u - exact).max() < 1e-5


@pytest.mark.parametrize("known", [True, False])
def test_a_flux_into_a_borehole_is_that_through_its_area(known: bool) -> None:
    """It counted 1/r times: the equation is multiplied by the radius."""
    wall, H, Q, rho_c = 0.05, 100.0, 6000.0, 2e6
    mesh = lp.interval(wall, 5.0, 20, geometric=True)
    capacity = rho_c if known else lp.LogNormal(rho_c, std=1e5)
    plain = borehole(mesh, lp.Normal(2.0), lp.Normal(0.1), H=H, rho_c=capacity, T0=10.0)
    half = Flux(0.5 * Q / (2 * np.pi * wall * H))
    heated = with_conditions(plain, {"left": half}, per=None if known else "rho_c")
    times = np.linspace(0.0, 3600.0, 30).tolist()
    ends = []
    for model, power in ((plain, Q), (heated, 0.5 * Q)):
        q = model.initial_parameter({"k": 2.0, "R_b": 0.1} | ({} if known else {"rho_c": rho_c}))
        control = Advance(Alexander2())
        *_, (_, u) = simulate(model, q, 10.0, times, control, lambda t, power=power: {"Q": power})
        ends.append(u)
    assert ends[1] == pytest.approx(ends[0], rel=1e-9)
    assert ends[1].max() > 11.0


def test_amounts_of_a_sphere_are_those_of_its_volume() -> None:
    """What a source and a flux bring into a particle is the mean over its volume times that."""
    R, rate, flux, t = 0.5, 3.0, 0.2, 0.7
    mesh = lp.interval(0.0, R, 15)
    particle = battery_particle(mesh, lp.Normal(1.0), area=1.0, c_max=1.0)
    fed = with_conditions(particle, {"right": Flux(flux)}, {"all": Source(rate)})
    q, times = fed.initial_parameter({"D": 1.0}), np.linspace(0.0, t, 8).tolist()
    *_, (_, u) = simulate(fed, q, 2.0, times, Advance(Alexander2()), lambda t: {"I": 0.0})
    mean = lp.Averages({"all": lambda x: x[0] < 1.0, "centre": "left"}, noise=0.1)
    found = mean.matrix(fed.state_space) @ u
    assert found[0] == pytest.approx(2.0 + t * (rate + 3 * flux / R), rel=1e-9)
    assert found[1] == pytest.approx(u[0], rel=1e-12)
