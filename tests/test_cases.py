"""Case files: valid contents, refused contents, and the shipped cases on measured data."""

import dataclasses
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from factories import short_rod

import livepde as lp
from livepde import cases
from livepde.cases.new_case import write_template
from livepde.cases.preview import Preview, preview
from livepde.cases.proposals import proposed
from livepde.cases.read import parse
from livepde.cases.schema import SensitivitySpec
from livepde.cases.variants import Variant, VariantRun
from livepde.fem import Inputs, Moment
from livepde.runs import checks_of, drive, measures, tables
from livepde.units import convert

SHIPPED = Path(__file__).resolve().parents[1] / "cases"


@pytest.fixture
def rod(tmp_path):
    """Return a function that edits the template and returns the path of the case."""
    case = short_rod(tmp_path / "rod", 91)

    def edited(*changes: tuple[str, str]) -> Path:
        text = case.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        case.write_text(text)
        return case

    return edited


def result_of(path, **options):
    prepared = cases.load(path, **options).prepare()
    run = drive(prepared.identifier, prepared.stream, fields_every=50, journal=prepared.journal())
    if run.error:
        raise run.error
    return prepared, run.result.to_xarray()


# --- units -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (3, "m", 3.0),
        ("20 h", "s", 72000.0),
        ("6e-7 m^2/s", "m^2/s", 6e-7),
        ("2.55 MJ/m^3/K", "J/(m^3 K)", 2.55e6),
        ("2.5 W/(m*degC)", "W/(m K)", 2.5),
        ("295.25 K", "degC", 22.1),
        ("10 %", "", 0.1),
        ("0.01 1/day", "1/s", 0.01 / 86400),
        ("36 m3/h", "m^3/s", 0.01),
        ("2 kJ m-3 K-1", "J/(m^3 K)", 2000.0),
        ("6 cm2/min", "m^2/s", 1e-5),
    ],
)
@pytest.mark.slow
def test_quantities_are_parsed_with_their_units(value, unit, expected):
    assert convert(value, unit, "key") == pytest.approx(expected, rel=1e-9)


def test_decibels_are_refused_as_a_unit():
    with pytest.raises(
        lp.errors.CaseError, match="here: 'dB' has no linear scale; expected no unit"
    ):
        convert("3 dB", "", "here")


def test_standard_deviations_of_temperatures_are_differences():
    assert convert("0.1 K", "degC", "key", difference=True) == pytest.approx(0.1)
    assert convert("0.9 degF", "degC", "key", difference=True) == pytest.approx(0.5)
    assert convert("0.1 degC", "degC", "key", difference=True) == 0.1


@pytest.mark.parametrize(
    ("value", "unit"),
    [
        ("20 h", "m"), ("20 hx", "s"), ("5", "s"), ("h", "s"), ("3 m", ""), ("5 m^", "m"),
        ("5 m/(s", "m"), ("1 $", "m"), ("3 import os", "m"), ("", "m"), ("1 2", "m"),
        ("1 m999", "m"), ("1 m2^3", "m"), ("1 m3/h", "m/s"),
    ],
)  # fmt: skip
def test_wrong_quantities_name_the_key(value, unit):
    with pytest.raises(lp.errors.CaseError, match=r"case.toml: mesh.to"):
        convert(value, unit, "case.toml: mesh.to")


@pytest.mark.slow
def test_pint_is_loaded_only_for_a_case():
    code = "import sys, livepde, livepde.cli; sys.exit('pint' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


# --- valid cases -----------------------------------------------------------------------------


@pytest.mark.slow
def test_template_runs_and_finds_the_truth(tmp_path):
    prepared, data = result_of(write_template(tmp_path / "rod")[0])
    case = prepared.case
    assert all(check.ok for check in checks_of(case.expected, data))
    assert not case.notes
    assert case.title == "A metal rod, heated and cooled at its left end"
    assert data.sizes["time"] == 181
    assert int(np.isnan(data.innovation.sel(sensor="T_10")).sum()) == 2
    assert set(data.validation.values) == {"T_20"}
    found = preview(prepared, prepared.stream)
    rows, count = found.unknowns, found.samples
    assert count == 181
    (row,) = rows
    assert row.left < 0.01
    assert not row.not_identifiable


@pytest.mark.slow
def test_sensors_within_one_cell_are_named(rod):
    def noted(cells: int, places: tuple[str, str, str]) -> bool:
        at = {f"channels.T_{k}.at": x for k, x in zip((10, 20, 30), places, strict=True)}
        notes = cases.load(rod(), settings={**at, "mesh.cells": cells}).notes
        return any("(T_10, T_20, T_30) lie in one cell of the mesh" in note for note in notes)

    assert noted(1, ("10 cm", "20 cm", "30 cm"))
    assert noted(40, ("10.2 cm", "10.5 cm", "10.8 cm"))
    assert not noted(40, ("10.5 cm", "10.5 cm", "10.5 cm"))
    assert not noted(40, ("10 cm", "10.5 cm", "11.5 cm"))


def test_the_template_does_not_overwrite_a_case(tmp_path):
    write_template(tmp_path)
    (tmp_path / "case.toml").unlink()
    with pytest.raises(lp.errors.RunError, match="Nothing was written"):
        write_template(tmp_path)
    assert not (tmp_path / "case.toml").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(lp.errors.RunError, match="cannot be written"):
        write_template(tmp_path / "file" / "below")


@pytest.mark.long
def test_units_of_columns(rod, tmp_path):
    """The data in Fahrenheit, minutes and scaled numbers give the estimate of the original data."""
    import pandas as pd

    path = rod()
    _, first = result_of(path)
    frame = pd.read_csv(path.parent / "rod.csv")
    frame["time_s"] /= 60.0
    frame[frame.columns[1:]] = frame[frame.columns[1:]] * 1.8 + 32.0
    frame.to_csv(path.parent / "rod.csv", index=False)
    changes = [('time_unit = "s"', 'time_unit = "min"'), ('prior = "5e-5 m^2/s"', "prior = 0.5"),
               ('std = "3e-5 m^2/s"', 'std = 0.3\nunit = "cm^2/s"'),
               ("to = \"40 cm\"", "to = 0.4")]  # fmt: skip
    changes += [(f'column = "{name}"', f'column = "{name}", unit = "degF"')
                for name in frame.columns[1:]]  # fmt: skip
    _, second = result_of(rod(*changes))
    assert float(second.alpha[-1]) == pytest.approx(float(first.alpha[-1]), rel=1e-8)
    assert float(second.alpha_std[-1]) == pytest.approx(float(first.alpha_std[-1]), rel=1e-6)


LAYERS = ("bounds = [", 'regions = { a = [0, "20 cm"], b = ["20 cm", "40 cm"] }\nbounds = [')
FIELD = ('bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]', 'field = true\nlength = "20 cm"')
GRADIENT = ('kind = "sensitivity" ', 'kind = "gradient"\ngain = 1e-12\n#')
DRIFT = '# drift = "0.1 1/h"'  # template comment to replace by an option of the law


@pytest.mark.slow
def test_layers_may_have_separate_priors(rod):
    own = """{ over = ["20 cm", "40 cm"], prior = 0.8, std = "3e-5 m^2/s",
        evolution = { kind = "mean-reverting", time = "1 h" } }"""
    layers = (LAYERS[0], LAYERS[1].replace('["20 cm", "40 cm"]', " ".join(own.split())))
    case = cases.load(rod(layers, ('prior = "5e-5 m^2/s"', 'prior = 0.5\nunit = "cm^2/s"')))
    space = case.model.parameter_space
    a, b = (space.unknown_of(f"alpha[{name}]") for name in "ab")
    assert (a.prior.centre, b.prior.centre) == pytest.approx((5e-5, 8e-5))
    assert b.prior.std == pytest.approx(3e-5)
    assert (a.evolution.moves, b.evolution) == (False, lp.MeanReverting(3600.0))
    assert b.prior.bounds == a.prior.bounds
    assert len(preview(case.prepare(), case.prepare().stream).unknowns) == 2


@pytest.mark.parametrize("spacing", ["uniform", "geometric"])
def test_nodes_move_to_the_ends_of_layers_and_sources(rod, spacing):
    heated = '[sources]\nheater = { value = "1 K/s", over = ["5 cm", "33.3 cm"] }\n[channels] '
    cells = f'cells = 39\nspacing = "{spacing}"'
    more = [("from = 0", "from = 0.001"), ("a = [0,", "a = [0.001,")]
    path = rod(LAYERS, ("cells = 40 ", cells), ("[channels]", heated), *more)
    case = cases.load(path)
    assert not any("inside a cell" in note for note in case.notes)
    nodes = case.mesh.p[0]
    assert len(nodes) == 40
    for edge in (0.05, 0.2, 0.333):
        assert np.abs(nodes - edge).min() < 1e-12
    plain = lp.interval(0.001, 0.4, 39, geometric=spacing == "geometric").p[0]
    assert int((np.abs(nodes - plain) > 1e-12).sum()) == 3


def test_layers_that_end_inside_a_cell_get_one_note(rod):
    path = rod(LAYERS, (MESH, "nodes = [0, 0.1, 0.19, 0.3, 0.4]\n#"))
    notes = [note for note in cases.load(path).notes if "inside a cell" in note]
    assert notes == [
        "Layer 'a' of alpha, layer 'b' of alpha end inside a cell. Add the ends to `mesh.nodes`."
    ]


HEATED_PLATE = """
equation = "conduction"
initial = 20
[mesh]
x = [0, "1 m"]
y = [0, "50 cm"]
cells = [10, 10]
[options]
C = 2e6
[sources]
heater = { value = "P", over = ["26 cm", "44 cm", "11 cm", "33 cm"] }
[data]
file = "plate.csv"
time_unit = "s"
[unknowns.k]
prior = 20
std = 10
transform = "log"
[channels]
P = { role = "input", column = "P" }
T = { role = "sensor", column = "T", at = ["60 cm", "20 cm"], noise = "0.1 K" }
"""


def test_a_source_in_a_box_of_a_rectangle_has_its_power(tmp_path):
    """The total power does not depend on where the cells of the mesh end."""
    (tmp_path / "plate.csv").write_text("time,P,T\n0,1,20\n60,1,20\n")
    (path := tmp_path / "case.toml").write_text(HEATED_PLATE)
    case = cases.load(path)
    moment = Moment(0.0, Inputs({"P": 1.0}))
    power = -case.model.B(case.model.state_space.interpolate(0.0), moment).sum()
    assert power == pytest.approx(0.18 * 0.22, rel=1e-12)
    assert not any("inside a cell" in note for note in case.notes)
    given = [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0]
    path.write_text(
        HEATED_PLATE.replace("cells = [10, 10]", "")
        .replace('x = [0, "1 m"]', f"x = {given}")
        .replace('y = [0, "50 cm"]', "y = [0, 0.11, 0.33, 0.5]")
    )
    with pytest.warns(UserWarning, match="its border crosses cells of the mesh"):
        notes = cases.load(path).notes
    assert notes == ["Source 'heater' ends inside a cell. Add the ends to `mesh.x` and `mesh.y`."]


@pytest.mark.slow
def test_a_case_estimates_a_field(rod):
    prepared, data = result_of(rod(FIELD))
    assert data.attrs["fields"] == "alpha"
    best, worst = preview(prepared, prepared.stream).unknowns
    assert best.left < worst.left
    assert 3e-5 <= best.prior <= 1.01 * np.sqrt(2) * 3e-5  # std inside, more at free ends


@pytest.mark.slow
def test_gradient_law_on_averages(rod):
    path = rod(GRADIENT,
               ('at = "10 cm", noise = "0.05 K"', 'over = ["8 cm", "12 cm"]'),
               ('at = "30 cm", noise = "0.05 K"', 'over = ["28 cm", "32 cm"]'))  # fmt: skip
    prepared, data = result_of(path)
    assert isinstance(prepared.case.law, lp.GradientLaw)
    (note,) = prepared.case.notes
    assert "no intervals" in note
    assert preview(prepared, prepared.stream) == Preview()
    assert (data.status == 0).all()


def test_the_self_tuning_gradient_law_refuses_a_diffusivity_from_means():
    """A rod of 1 m, heated and cooled at its left end, is observed as means over its tenths."""
    ends = {"left": lp.Channel("left")}
    rod = lp.models.heat(lp.interval(0, 1, 40), lp.Normal(0.05, std=0.05), ends)
    means = lp.Averages(
        {f"T{k}": (lambda x, k=k: (x[0] > k / 10) & (x[0] < (k + 1) / 10)) for k in range(10)}
    )
    with pytest.raises(lp.LivepdeError, match="use SensitivityLaw"):
        lp.Identifier(rod, means, lp.GradientLaw(gain="auto"), u0=0.0)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("true", lp.observation.Tikhonov("V", lp.observation.Discrepancy(1.1))),
        (
            '{ norm = "X", tau = 1.5 }',
            lp.observation.Tikhonov("X", lp.observation.Discrepancy(1.5)),
        ),
        ("false", lp.observation.Pseudoinverse()),
    ],
)
def test_tikhonov_from_a_case(rod, keys, expected):
    kind = ('kind = "sensitivity" ', f'kind = "gradient"\ngain = 1e-12\ntikhonov = {keys}\n#')
    prepared = cases.load(rod(kind)).prepare()
    assert prepared.identifier.observed.observation.reconstruction == expected
    assert (
        prepared.identifier.validation.observation.reconstruction == lp.observation.Pseudoinverse()
    )
    for sample in list(prepared.stream)[:4]:
        estimate = prepared.identifier.step(sample.t, sample.z, sample.inputs)
    assert estimate.status.ok
    assert (not np.isnan(estimate.diagnostics.alpha)) == (keys != "false")


def test_tikhonov_by_discrepancy_needs_the_noise(rod):
    kind = ('kind = "sensitivity" ', 'kind = "gradient"\ntikhonov = true\n#')
    with pytest.raises(lp.errors.CaseError, match="noise of every sensor"):
        cases.load(rod(kind, (', noise = "0.05 K"', ""))).prepare()


def test_gradient_law_on_points_gets_a_note(rod):
    case = cases.load(rod(GRADIENT))
    assert "point sensors mislead" in case.notes[0]
    assert isinstance(
        cases.load(rod(("gain = 1e-12", "mu = 2"))).law.damping, lp.laws.ConstantDamping
    )


def test_gradient_law_has_no_intervals_and_names_settings_that_have(rod):
    path = rod(GRADIENT)
    prepared = cases.load(path).prepare()
    settings = prepared.case.with_intervals
    assert settings == ("law.kind=sensitivity", "law.gain=")
    assert "with `--set law.kind=sensitivity --set law.gain=`." in prepared.case.notes[-1]
    base = VariantRun(Variant("as stated"))
    assert proposed(prepared, base) == [Variant("Kalman filter", settings)]
    other = cases.load(path, settings=parse(settings))
    assert isinstance(other.law, lp.SensitivityLaw)
    assert not other.with_intervals
    noiseless = cases.load(rod((', noise = "0.05 K"', ""))).prepare()  # of one: all or none
    assert "state the `noise` of each sensor" in noiseless.case.notes[-1]
    assert not proposed(noiseless, base)


def test_sensitivity_options(rod):
    law = cases.load(rod((DRIFT, 'drift = "0.1 1/h"\nmemory = "1 h"\nnoise = "0.1 K"\n#'))).law
    assert (law.modes, law.noise, law.memory) == ("auto", 0.1, 3600.0)
    assert law.drift == pytest.approx(0.1 / 3600)
    assert law.refit == lp.Refit()
    some = cases.load(rod(('drift = "0.1 1/h"', "refit = {start = 16}"), ('memory = "1 h"', "")))
    assert some.law.refit == lp.Refit(start=16)
    assert cases.load(rod(("{start = 16}", "false"))).law.refit is None


@pytest.mark.slow
def test_the_noise_level_is_estimated(rod):
    path = rod(
        (DRIFT, 'noise = "auto"'), ('kind = "sensitivity"', 'kind = "sensitivity"\ngate = 9')
    )
    case = cases.load(path)
    assert (case.law.noise, case.law.gate) == ("auto", 9.0)
    _, result = result_of(path)
    assert float(result["alpha"][-1]) == pytest.approx(9.7e-5, rel=0.02)
    path.write_text(re.sub(r', noise = "[^"]*"', "", path.read_text()))
    with pytest.raises(lp.errors.CaseError, match=r"law\.noise: 'auto' scales a first guess"):
        cases.load(path)


@pytest.mark.slow
def test_constant_boundary_and_initial_value(rod):
    path = rod(
        ('T_right = { role = "boundary", column = "T_right", at = "right" }', ""),
        ("[data]", '[boundary]\nright = "293.15 K"\n\n[data]'),
        ('initial = "interpolate"', 'initial = "20 degC"'),
    )
    prepared, data = result_of(path)
    assert prepared.case.model.channels == ("T_left",)
    assert float(data.u[-1, -1]) == pytest.approx(20.0)


@pytest.mark.slow
def test_every_and_assimilate_from(rod):
    path = rod(("time_unit = ", 'every = 2\nassimilate_from = "10 min"\ntime_unit = '))
    prepared, data = result_of(path)
    assert data.sizes["time"] == 46
    assert prepared.assimilate_from == 600.0
    assert float(data.alpha[14]) == 5e-5  # at t = 560 s
    assert float(data.alpha[16]) != 5e-5
    assert data.attrs["assimilate_from"] == 600.0


@pytest.mark.slow
def test_reaction_diffusion_without_units(tmp_path):
    rows = [f"{t / 10},{np.exp(-t / 10)},{np.exp(-t / 10)}" for t in range(30)]
    (tmp_path / "data.csv").write_text("t,a,b\n" + "\n".join(rows))
    (tmp_path / "case.toml").write_text("""
equation = "reaction_diffusion"
initial = 1.0
mesh = { x = [0, 1], y = [0, 1], cells = [4, 4] }
options = { f = 0.0 }
data = { file = "data.csv", time = "t" }
unknowns.q = { prior = 1.0, std = 1.0 }
law = { kind = "sensitivity", noise = 0.1 }
[channels]
a = { role = "sensor", column = "a", at = [0.5, 0.5] }
b = { role = "validation", column = "b", at = [0.5, 0.75] }
""")
    _, data = result_of(tmp_path / "case.toml")
    assert np.isfinite(data.q).all()
    assert {"x", "y"} <= set(data.coords)


def own_code(rod, body: str, *, plain: bool = False) -> Path:
    path = rod(('equation = "heat"  ', 'equation = "own.py:build"  '))
    if plain:  # a function has no units
        path.write_text(re.sub(r'"([-.\de]+) (?:m\^2/s|K)"', r"\1", path.read_text()))
    (path.parent / "own.py").write_text(body)
    return path


@pytest.mark.slow
def test_own_function_runs(rod):
    body = "from livepde.models import heat\n\ndef build(mesh, unknowns, dirichlet):\n"
    body += "    return heat(mesh, unknowns['alpha'], dirichlet)\n"
    _, data = result_of(own_code(rod, body, plain=True), allow_code=True)
    assert float(data.alpha[-1]) == pytest.approx(9.7e-5, rel=0.03)


@pytest.mark.slow
def test_own_equation_object_keeps_units(rod):
    body = "from livepde.models import EQUATIONS\nbuild = EQUATIONS['heat']\n"
    _, data = result_of(own_code(rod, body), allow_code=True)
    assert float(data.alpha[-1]) == pytest.approx(9.7e-5, rel=0.03)


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ("import nowhere_to_be_found", "ModuleNotFoundError"),
        ("other = 3", "no function 'build'"),
        ("def build(mesh, unknowns, dirichlet):\n    return 3", "returned int"),
        ("def build(mesh, unknowns, dirichlet):\n    return 1 / 0", "ZeroDivisionError"),
        ("import livepde\nraise livepde.errors.ModelError('mine')", "mine"),
        (
            "import livepde\ndef build(mesh, unknowns, dirichlet):\n"
            "    raise livepde.errors.ModelError('mine')",
            "mine",
        ),
    ],
)
def test_own_code_that_fails(rod, body, named):
    path = own_code(rod, body, plain=True)
    with pytest.raises(lp.LivepdeError, match=named):
        cases.load(path, allow_code=True)


def test_own_module(rod):
    path = rod(('equation = "heat"  ', 'equation = "livepde.models.diffusion:HEAT"  '))
    assert cases.load(path, allow_code=True).equation.name == "heat"
    path = rod(("livepde.models.diffusion:HEAT", "missing.py:build"))
    with pytest.raises(lp.errors.CaseError, match=r"there is no file '.*missing\.py'"):
        cases.load(path, allow_code=True)
    path.with_name("broken.py").write_text("import missing_module")
    path = rod(("missing.py:build", "broken.py:build"))
    with pytest.raises(
        lp.errors.CaseError, match=r"loading 'broken\.py' failed with ModuleNotFound"
    ):
        cases.load(path, allow_code=True)


def test_code_where_the_user_is_and_not_the_case(rod, monkeypatch):
    path = rod(('equation = "heat"  ', 'equation = "mine.py:rod"  '))
    monkeypatch.chdir(path.parents[1])
    Path("mine.py").write_text("")
    with pytest.raises(
        lp.errors.CaseError, match=r"next to the case; did you mean '\.\./mine\.py'\?"
    ):
        cases.load(path, allow_code=True)


def test_a_unit_where_a_function_has_none(rod):
    path = rod(('equation = "heat"  ', 'equation = "mine.py:rod"  '))
    path.with_name("mine.py").write_text("def rod(mesh, unknowns, dirichlet):\n    pass\n")
    with pytest.raises(
        lp.errors.CaseError, match=r"prior: got '5e-5 m\^2/s'; .* add `unknowns\.alpha\.unit`"
    ):
        cases.load(path, allow_code=True)


# --- refused cases ---------------------------------------------------------------------------

MESH = 'from = 0\nto = "40 cm"\ncells = 40'
REFERENCE = '[reference]\nalpha = "0.97 cm^2/s"\nsource = "made up"\n[expect]'
VARIANTS = """
[[variants]]
name = "noisier"
set = { law.noise = "1 K", "data.every" = 2 }
seeds = 3
expect = { rmse = "<= 1", alpha.error = "<= 0.1" }

[expect]"""

# test_input_errors.py has the most common mistakes of new users.
REFUSED = [
    ("cells = 40", "cels = 40", "no key 'mesh.cels'; did you mean 'cells'?"),
    ("cells = 40", 'cells = "many"', "mesh.cells: got 'many'; expected a whole number"),
    ("cells = 40", "cells = [4, 4]", "one number for an interval"),
    ("cells = 40 ", "x = [0, 1]\ncells = 3 #", "mesh: expected from and to"),
    ("cells = 40 ", 'spacing = "geometric"\ncells = 40 #', "needs from > 0"),
    ('to = "40 cm"', 'to = "40 s"', "mesh.to: 's' cannot be converted to 'm'"),
    ('to = "40 cm"', 'to = "40 cmm"', "'cmm' is not a unit"),
    ('to = "40 cm"', "to = -1", "needs from < to"),
    ("bounds = [", 'transform = "log"\nbounds = [', "alpha: transform='log' has no upper bound"),
    ('bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]', 'transform = "logit"', "needs two finite bounds"),
    (
        'prior = "5e-5 m^2/s"',
        'prior = 1e-6\ntransform = "logit"',
        "alpha: prior 1e-06 is outside the range of transform='logit'",
    ),
    ('prior = "5e-5 m^2/s"', "prior = true", "unknowns.alpha.prior: got True"),
    ('prior = "5e-5 m^2/s"', "", "the key 'unknowns.alpha.prior' is missing"),
    ('bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]', "bounds = [2, 1]", "got [2, 1] m^2/s; needs the low"),
    ('dt_max = "20 s"', 'dt_max = "20 sm"', "expected a unit such as s, min, h or d."),
    ('time_unit = "s"', 'decimal = ";"', "data.decimal: got ';'"),
    ('time_unit = "s"', 'encoding = "utf-9"', "expected the name of an encoding, as 'utf-8'"),
    ('time_unit = "s"', 'time_format = "%H:%M"', "data.time_format: got '%H:%M'; expected year"),
    (DRIFT, "guards = { reach = 0 }", "law.guards: reach must be a positive number; got"),
    (DRIFT, "shadows = { mesh = 1 }", "law.shadows: mesh must be true or false; got 1"),
    (DRIFT, "jumps = { size = true }", "law.jumps: size must be a number; got True"),
    (DRIFT, "gate = true", "law.gate: got True; expected a number"),
    (DRIFT, 'jumps = { unknowns = "k" }', "law.jumps.unknowns: got 'k'; expected a list"),
    ('bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]', "bounds = [3]", "bounds: got [3]; expected more ent"),
    ('std = "3e-5 m^2/s"', "std = 0.0", "unknowns.alpha.std: got 0.0; expected more than 0"),
    ('bounds = ["1e-6', 'field = true\nbounds = ["1e-6', "a field has no regions"),
    ('bounds = ["1e-6', 'length = 1\nbounds = ["1e-6', "length requires field = true"),
    ("bounds = [", "regions = { a = [0, 0.3] }\nbounds = [", "lies in 0 layers"),
    ("bounds = [", "regions = { a = [0, 0.3], b = [0.2, 0.4] }\nbounds = [", "lies in 2 layers"),
    ("bounds = [", "regions = { a = [3, 4] }\nbounds = [", "contains no cell"),
    ('equation = "heat"', 'equation = "heet"', "did you mean 'heat'?"),
    ("[law]", "[options]\nD = 1\n[law]", "has no 'D' here; expected one of"),
    ('kind = "sensitivity"', 'kind = "sensitive"', "law.kind: got 'sensitive'; did you mean"),
    (DRIFT, "refit = {strat = 3}", "did you mean 'start'?"),
    (DRIFT, "noise = -1", "law.noise: got -1"),
    ('kind = "sensitivity" ', 'kind = "gradient"\nc1 = 1\nmu = 1 #', "are two damping rules"),
    ('scheme = "alexander2"', 'scheme = "rk4"', "steps.scheme: got 'rk4'"),
    ('dt_max = "20 s"', 'dt_max = "-20 s"', "steps.dt_max: got '-20 s'"),
    ('column = "T_20"', 'colunm = "T_20"', "did you mean 'column'?"),
    ('column = "T_20"', 'column = "T_20", columns = ["T_10"]', "expected column = name"),
    ('at = "20 cm"', "at = [0.1, 0.1]", "got 2 coordinates; needs 1"),
    ('at = "20 cm"', 'quantity = "fluid"', "has no quantity 'fluid'"),
    (', at = "20 cm"', "", "expected one of: at = position"),
    ('at = "left"', 'at = "lft"', "did you mean 'left'?"),
    ('at = "left"', "at = 0.0", "needs at = the name of a boundary"),
    ('at = "left"', 'at = "right"', "has a value already"),
    ('role = "boundary", column = "T_left", at = "left"', 'role = "input", column = "T_left"',
     "has no 'T_left' here"),
    ('role = "boundary", column = "T_left", at = "left"',
     'role = "input", column = "T_left", at = 1', "role input has no place"),
    (', noise = "0.05 K"', "", "law.noise is missing"),
    ('noise = "0.05 K"', 'noise = "0 K"', "T_10.noise: got '0 K'"),
    ('at = "10 cm"', 'over = "lft"', "the mesh has no part 'lft'; did you mean 'left'?"),
    ('at = "20 cm"', 'at = 0.2, offset = 1', "offset requires role = 'sensor'"),
    ('at = "left"', 'at = "left", of = "u"', "of requires a sensor"),
    ('at = "20 cm"', "each = [0, 0.4, 5]", "each needs column = a name with {}"),
    ('noise = "0.05 K" }', 'noise = "0.05 K", correlated = { tim = 3 } }', "did you mean 'time'?"),
    ('role = "sensor"', 'role = "validation"', "there is no sensor. Add"),
    ("[law]", "[boundary]\nlft = 3\n[law]", "boundary: no boundary 'lft'"),
    ('rmse = "<= 0.15"', 'rmse = "lots"', "expect.rmse: got 'lots'; expected [low, high]"),
    ("title =", "titel =", "no key 'titel'; did you mean 'title'?"),
    ("title =", "title = 3 #", "title: got 3; expected text"),
    ("[mesh]", "[mesh", "is not valid TOML"),
    ("T_20 = {", "T_21 = 3 #", "channels.T_21: got 3; expected a table"),
    ('at = "20 cm"', 'at = 0.2, spikes = "keep"', "require a boundary or input channel"),
    ('at = "20 cm"', 'at = 0.2, between = "hold"', "between requires a boundary or input channel"),
    ('at = "left"', 'at = "left", between = "step"', "channels.T_left.between: got 'step'"),
    ('at = "left"', 'at = "left", between = "hold", missing = "skip"', "is never missing"),
    ('at = "left"', 'at = "left", between = "next", spikes = "refuse"', 'between = "line"'),
    (MESH, "nodes = [0, 0.4, 0.3] #", "mesh.nodes: line: needs at least two increasing nodes"),
    (MESH, "nodes = [0, 0.4]\ncells = 3 #", "mesh: expected from and to"),
    (MESH, 'nodes = [0, 0.4]\nspacing = "geometric" #', "spacing requires an interval with cells"),
    (MESH, 'nodes = [0, 0.4]\nunit = "mm" #', "unit requires file"),
    (MESH, "x = [0, 1, 2]\ny = [0, 1]\ncells = [2, 2] #", "x and y: expected [from, to] each; or"),
    (MESH, "x = [0, 2, 1]\ny = [0, 1] #", "mesh: grid: needs at least two increasing nodes"),
    *(("bounds = [", f"regions = {{ a = {region} }}\nbounds = [", f"alpha.regions.a{named}")
      for region, named in (
        ("{ prior = 1 }", ".over' is missing"),
        ("{ over = [0, 1], priro = 1 }", ".priro'; did you mean 'prior'"),
        ('{ over = [0, 1], prior = "1 m" }', ".prior: 'm' cannot be converted"),
        ('{ over = [0, 1], prior = "1e-2 m^2/s" }', ": the prior 0.01 is outside"),
        ("3", ": got 3"))),
    ("bounds = [", 'evolution = { kind = "random-walk" } #', "'random-walk' takes rate"),
    ("bounds = [", 'evolution = { kind = "periodic", rate = 1 } #', "takes harmonics and period"),
    ("bounds = [", 'evolution = { kind = "periodic", perod = 1 } #', "did you mean 'period'?"),
    ("bounds = [", 'evolution = { kind = "mean-reverting", time = "2 m" } #', "time: 'm'"),
    ("time_unit", "options = { a = 1 }\ntime_unit", "options require a reader"),
    ("time_unit", 'reader = "a.py:b"\ntime_unit', "are two sources"),
    ("[expect]", REFERENCE.replace("alpha", "alhpa"), "there is no unknown number 'alhpa'; did"),
    ("[expect]", REFERENCE.replace("cm^2", "cm"), "reference.alpha: 'cm/s' cannot be converted"),
    *(("[expect]", VARIANTS.replace(old, new), named) for old, new, named in (
        ("seeds", "sedes", "there is no key 'variants[0].sedes'; did you mean 'seeds'?"),
        ("seeds = 3", 'seeds = 3\n[[variants]]\nname = "noisier"', "two have the name 'noisier'"),
        ('name = "noisier"', "", "the key 'variants[0].name' is missing"),
        ('rmse = "<= 1"', "rmse = 1", "variants[0].expect.rmse: got 1"))),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new", "named"), REFUSED)
def test_an_invalid_case_is_refused_with_one_sentence(rod, old, new, named):
    path = rod((old, new))
    with pytest.raises(lp.errors.CaseError) as error:
        cases.load(path)
    message = str(error.value)
    assert named in message
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


REFUSED_WITH_DATA = [
    ('file = "rod.csv"', "", "data.file is missing"),
    ('initial = "interpolate"', 'initial = "interplate"', "did you mean 'interpolate'?"),
    ('initial = "interpolate"', 'initial = "20 m"', "initial: 'm' cannot be converted"),
    ("time_unit", "start = 2025-01-01\ntime_unit", "the times are numbers"),
    ("time_unit", 'start = "2 h"\ntime_unit', "no row lies between"),
    ("time_unit", "assimilate_from = 2025-01-01\ntime_unit", "the times of the data are numbers"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new", "named"), REFUSED_WITH_DATA)
def test_invalid_data_are_refused_with_one_sentence(rod, old, new, named):
    case = cases.load(rod((old, new)))
    with pytest.raises(lp.LivepdeError) as error:
        case.prepare()
    assert named in str(error.value)


def test_a_first_row_without_values_is_left_out(rod):
    path = rod()
    lines = (path.parent / "rod.csv").read_text().splitlines()
    first = float(lines[2].partition(",")[0])
    lines[1] = "0,,,,,"
    (path.parent / "rod.csv").write_text("\n".join(lines))
    prepared = cases.load(path).prepare()
    assert prepared.stream.t[0] == first
    assert prepared.identifier.t == first


def test_missing_case(tmp_path):
    with pytest.raises(lp.errors.CaseError, match="livepde init"):
        cases.load(tmp_path / "case.toml")
    (tmp_path / "case.toml").write_text("")
    with pytest.raises(lp.errors.CaseError, match=r"did you mean '.*case\.toml'"):
        cases.load(tmp_path / "cas.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(lp.errors.CaseError, match="row 1 is not UTF-8 text; save it as UTF-8"):
        cases.load(tmp_path / "bytes.toml")


@pytest.mark.slow
def test_dates(rod):
    path = rod()
    lines = (path.parent / "rod.csv").read_text().splitlines()
    rows = [lines[0]]
    for line in lines[1:]:
        t, rest = line.split(",", 1)
        rows.append(
            f"2025-04-01 {int(t) // 3600 + 9:02d}:{int(t) // 60 % 60:02d}:{int(t) % 60:02d},{rest}"
        )
    (path.parent / "rod.csv").write_text("\n".join(rows))
    for start in ("2025-04-01T09:10:00", '"2025-04-01 09:10"', '"2025-04-01T09:10:00+00:00"'):
        text = path.read_text()
        other = path.with_name("dates.toml")
        other.write_text(text.replace("time_unit = ", f"assimilate_from = {start}\ntime_unit = "))
        prepared = cases.load(other).prepare()
        assert prepared.assimilate_from == 600.0
    assert str(prepared.origin) == "2025-04-01 09:00:00"
    other.write_text(text.replace("time_unit = ", "assimilate_from = 2025-04-02\ntime_unit = "))
    assert cases.load(other).prepare().assimilate_from == 15 * 3600.0
    other.write_text(text.replace("time_unit = ", 'assimilate_from = "2025-04-99"\ntime_unit = '))
    with pytest.raises(lp.errors.CaseError, match="expected a date"):
        cases.load(other).prepare()


@pytest.mark.slow
def test_lines_instead_of_a_file(rod):
    lines = ['{"time_s": %d, "T_left": %g, "T_right": 20}' % (20 * k, 20 + k) for k in range(5)]  # noqa: UP031
    prepared = cases.load(rod()).prepare(iter(lines))
    data = prepared.identifier.run(prepared.stream).to_xarray()
    assert data.sizes["time"] == 5
    with pytest.raises(lp.errors.DataError, match="no sample"):
        cases.load(rod()).prepare(iter(()))
    path = rod().with_name("lines.jsonl")
    path.write_text("\n".join(lines))
    with pytest.raises(lp.errors.DataError, match="there is no column 'T_10'"):
        cases.load(rod()).prepare(str(path))
    lines[2] = lines[2].replace("}", ', "T_10": 20, "T_20": 20, "T_30": null}')
    path.write_text("\n".join(lines))
    samples = list(cases.load(rod()).prepare(str(path)).stream)
    assert len(samples) == 5
    assert [sample.z["T_10"] for sample in samples if np.isfinite(sample.z["T_10"])] == [20.0]


def test_borehole_needs_its_options_and_input(tmp_path):
    path = SHIPPED / "thermal_response.toml"
    text = path.read_text()
    for old, new, named in (
        ('H = "18.3 m"', "", "options.H is missing: the length of the borehole"),
        ('role = "input"', 'role = "boundary"\nat = "left"', "channels.Q is missing"),
        ("[unknowns.R_b]", "[unknowns.Rb]", "did you mean 'R_b'?"),
    ):
        assert old in text
        other = tmp_path / "case.toml"
        other.write_text(text.replace(old, new))
        with pytest.raises(lp.errors.CaseError) as error:
            cases.load(other)
        assert named in str(error.value)


# --- meshes, regions, and time-varying or positive unknowns -----------------------------------


def test_nodes(rod):
    path = rod((MESH, 'nodes = [0, "10 cm", 0.2, 0.3, "400 mm"] #'))
    mesh = cases.load(path).mesh
    np.testing.assert_allclose(mesh.p[0], [0.0, 0.1, 0.2, 0.3, 0.4])
    assert set(mesh.boundaries) == {"left", "right"}


PLANE = """
equation = "reaction_diffusion"
initial = 1.0
mesh = { x = [0, 2], y = [0, 1], cells = [4, 2] }
data = { file = "data.csv", time = "t" }
unknowns.q = { prior = 1.0, std = 1.0, regions = REGIONS }
law = { kind = "sensitivity", noise = 0.1 }
channels.a = { role = "sensor", column = "a", at = [0.5, 0.5] }
"""


@pytest.mark.parametrize(
    ("regions", "named"),
    [
        ("{ a = [0, 1, 0, 1], b = [1, 2, 0, 1] }", ""),
        ("{ a = [0, 1, 0, 1] }", "lies in 0 regions"),
        ("{ a = [0, 1, 0, 1], b = [0, 2, 0, 1] }", "lies in 2 regions"),
        ("{ a = [0, 1] }", "expected [x0, x1, y0, y1]"),
        ("{ a = [5, 6, 0, 1] }", "contains no cell of the mesh, which spans 0 to 2 x 0 to 1"),
        ('{ a = "steel" }', "no subdomain 'steel'; it has none: name them in its file"),
    ],
)
def test_regions_of_a_rectangle(tmp_path, regions, named):
    path = tmp_path / "case.toml"
    path.write_text(PLANE.replace("REGIONS", regions))
    if not named:
        assert set(cases.load(path).model.parameter_space.labels) == {"q[a]", "q[b]"}
        return
    with pytest.raises(lp.errors.CaseError) as error:
        cases.load(path)
    assert named in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("evolution", "expected"),
    [
        ('kind = "random-walk", rate = "6e-6 m^2/s/min^0.5"', lp.RandomWalk(6e-6 / 60**0.5)),
        ('kind = "mean-reverting", time = "2 h"', lp.MeanReverting(7200.0)),
        ('kind = "periodic", period = "1 day", harmonics = 2', lp.fem.Periodic(86400.0, 2)),
    ],
)
def test_unknowns_may_vary_in_time(rod, evolution, expected):
    path = rod(("bounds = [", f"evolution = {{ {evolution} }} #"))
    unknown = cases.load(path).model.parameter_space.unknowns["alpha"]
    assert type(unknown.evolution) is type(expected)
    assert vars(unknown.evolution) == pytest.approx(vars(expected))
    prepared = cases.load(path).prepare()
    assert 0 < preview(prepared, prepared.stream).unknowns[0].left < 1


def test_plain_numbers_have_the_unit_of_the_unknown(rod):
    numbers = {"unit": "cm^2/s", "prior": 0.5, "std": 0.3, "bounds": [0.01, 10.0]}
    numbers["evolution"] = {"kind": "random-walk", "rate": 0.01}
    case = cases.load(rod(), settings={"unknowns.alpha": numbers, "reference.alpha": 0.97})
    unknown = case.model.parameter_space.unknowns["alpha"]
    assert unknown.evolution.rate == pytest.approx(1e-6)
    assert case.references == {"alpha": pytest.approx(9.7e-5)}


@pytest.mark.slow
def test_positive_unknowns(rod):
    path = rod(('bounds = ["1e-6 m^2/s", "1e-3 m^2/s"]', 'transform = "log"'))
    prepared, data = result_of(path)
    assert float(data.alpha[-1]) == pytest.approx(9.7e-5, rel=0.03)
    (row,) = preview(prepared, prepared.stream).unknowns
    assert row.prior == pytest.approx(3e-5)
    assert row.left < 0.05
    case = cases.load(rod(('transform = "log"', 'transform = "log"\nfield = true')))
    assert case.model.parameter_space.unknowns["alpha"].prior == lp.LogNormal(5e-5, 3e-5)


def test_the_initial_state_is_specified_once(rod):
    with pytest.raises(lp.errors.CaseError, match="initial is missing"):
        cases.load(rod(('initial = "interpolate"', ""))).prepare()


# --- sensors ---------------------------------------------------------------------------------


def test_families(rod):
    old = 'T_20 = { role = "validation", column = "T_20", at = "20 cm" }'
    path = rod((old, 'T = { role = "validation", column = "T_{}0", each = ["0 cm", "40 cm", 5] }'),
               ("T_10 =", "first ="), ("T_30 =", "third ="))  # fmt: skip
    case = cases.load(path)
    assert case.validation.names(5) == ("T_0", "T_1", "T_2", "T_3", "T_4")
    np.testing.assert_allclose(list(case.validation.points.values()), [0.0, 0.1, 0.2, 0.3, 0.4])
    assert case.columns["T_3"].names == ("T_30",)
    with pytest.raises(lp.errors.CaseError, match="there is a channel 'T_1' already"):
        cases.load(rod(("first =", "T_1 =")))


@pytest.mark.slow
def test_very_many_sensors_share_one_table_row(rod):
    old = 'T_20 = { role = "validation", column = "T_20", at = "20 cm" }'
    new = 'W = { role = "validation", column = "T_20{}", each = [0, 0.4, 50] }'
    path = rod(
        (old, new),
        ("cells = 40", "cells = 4"),
        ("start, stop", ""),
        ("[data]", "[data]\nevery = 30"),
    )
    import pandas as pd

    frame = pd.read_csv(path.parent / "rod.csv")
    more = {f"T_20{k}": frame["T_20"] for k in range(50)}
    frame.assign(**more).to_csv(path.parent / "rod.csv", index=False)
    _, data = result_of(path)
    rows = tables(data)[1].rows
    assert [row[:2] for row in rows] == [
        ("T_10 ... T_30", "assimilated"),
        ("W_0 ... W_49", "validation"),
    ]


TWO = """
equation = "own.py:build"
initial = { c = 1, s = 0 }
mesh = { nodes = [0, 0.5, 1] }
data = { reader = "own.py:read" }
unknowns.k = { prior = 0.8, std = 0.3 }
law = { kind = "sensitivity", noise = 0.01 }
steps.scheme = "alexander2"
[channels]
c = { role = "sensor", column = "c", at = 0.5, of = "c" }
s = { role = "validation", column = "s{}", each = [0, 1, 2], of = "s" }
"""
TWO_CODE = """
import numpy as np
import livepde as lp
from livepde.fem import linear

def read(folder):
    t = np.linspace(0, 1, 11)
    return t, {"c": np.exp(-t), "s0": 1 - np.exp(-t), "s1": 1 - np.exp(-t)}

def build(mesh, unknowns, dirichlet):
    state = {name: lp.Field(mesh, linear(mesh)) for name in ("c", "s")}
    return lp.Model(state, unknowns, A=lambda q, u, v, x: q.k * u.c * (v.c - v.s))
"""


def test_two_components(tmp_path):
    (tmp_path / "own.py").write_text(TWO_CODE)
    (tmp_path / "two.toml").write_text(TWO)
    found = measures(result_of(tmp_path / "two.toml", allow_code=True)[1])
    assert found["k"] == pytest.approx(1.0, abs=0.02)
    assert found["rmse.s_0"] < 0.01


OFFSET = ('at = "10 cm", noise = "0.05 K"', 'at = "10 cm", noise = "0.05 K", offset = "0.5 K"')


def test_unknowns_of_sensors_share_a_prior(rod):
    more = ', offset = "0.5 K", gain = 0.05, correlated = { time = "1 h", std = "0.1 K" }'
    path = rod((OFFSET[0], f'at = "10 cm", noise = "0.05 K"{more}'))
    with pytest.raises(lp.errors.CaseError, match=r"T_30.offset: differs from that of 'T_10'"):
        cases.load(rod(('at = "30 cm", noise', 'at = "30 cm", offset = "0.4 K", noise')))
    model = cases.load(rod(('offset = "0.4 K", noise', "noise"))).model
    assert set(model.parameter_space.labels) == {
        "alpha", "offset[T_10]", "gain[T_10]", "correlated[T_10]"
    }  # fmt: skip
    unknowns = model.parameter_space.unknowns
    assert (unknowns["offset"].prior.std, unknowns["offset"].unit) == (0.5, "K")
    assert unknowns["gain"].prior == lp.Normal(1.0, 0.05)
    assert unknowns["correlated"].evolution == lp.MeanReverting(3600.0)
    assert path.exists()


@pytest.mark.slow
def test_means_along_a_line(rod):
    path = rod(('at = "30 cm", noise = "0.05 K"', 'along = ["28 cm", 0.32], noise = "0.07 K"'))
    prepared, data = result_of(path)
    assert prepared.identifier.observed.names == ("T_10", "T_30")
    assert float(data.alpha[-1]) == pytest.approx(9.7e-5, rel=0.03)
    with pytest.raises(lp.errors.CaseError, match=r"channels.T_30.along: 1 m lies outside"):
        cases.load(rod(('along = ["28 cm", 0.32]', 'along = ["28 cm", "1 m"]')))


@pytest.mark.slow
def test_a_sensor_may_move(rod):
    import pandas as pd

    place = 'where = { role = "position", column = "x_cm", unit = "cm" }\n'
    path = rod(
        ('at = "30 cm", noise = "0.05 K"', 'follows = "where", noise = "0.05 K"'),
        ("T_10 = {", place + "T_10 = {"),
    )
    frame = pd.read_csv(path.parent / "rod.csv")
    frame["x_cm"] = 30.0
    up = np.arange(len(frame)) % 2 == 1
    frame.loc[up, "x_cm"], frame.loc[up, "T_30"] = 20.0, frame.loc[up, "T_20"]
    frame.loc[5, "x_cm"] = np.nan
    frame.to_csv(path.parent / "rod.csv", index=False)
    _, data = result_of(path)
    assert np.isnan(data.innovation.sel(sensor="T_30").values[5])
    assert float(data.alpha[-1]) == pytest.approx(9.7e-5, rel=0.03)
    with pytest.raises(lp.errors.CaseError, match="there is no channel 'wehre' of role position"):
        cases.load(rod(('follows = "where"', 'follows = "wehre"')))


# --- data from a reader function -------------------------------------------------------------

READER = """
import numpy as np
import pandas as pd

def read(folder, name="rod.csv", noise=0.0, seed=0):
    frame = pd.read_csv(folder / name)
    rng = np.random.default_rng(seed)
    columns = {key: frame[key] + noise * rng.standard_normal(len(frame)) for key in frame}
    return frame["time_s"], columns
"""
FROM_READER = ('file = "rod.csv"', 'reader = "own.py:read"\noptions = { noise = 0.0 } #')


def with_reader(rod, body: str, *changes: tuple[str, str]) -> Path:
    path = rod(FROM_READER, *changes)
    (path.parent / "own.py").write_text(body)
    return path


@pytest.mark.long
def test_a_reader_function_gives_the_estimates_of_the_file(rod, monkeypatch):
    _, first = result_of(rod())
    path = with_reader(rod, READER)
    monkeypatch.setenv("LIVEPDE_DATA", str(path.parent))
    with pytest.raises(lp.errors.CaseError, match=r"data\.reader: .* add --allow-code"):
        cases.load(path)
    _, second = result_of(path, allow_code=True)
    assert float(second.alpha[-1]) == float(first.alpha[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("noise=0.0", "noize=0.0", "has no option 'noise'; did you mean 'noize'?"),
        ("return ", "return 3 #", "returned int; expected times and a mapping"),
        ("return ", "raise ValueError('bad') #", "failed with ValueError: bad"),
        ("rod.csv", "none.csv", "there is no file"),
        ('frame["time_s"]', "[]", "contains no samples"),
        ('frame["time_s"]', 'frame["time_s"][::-1].to_numpy()', "sample 1: the time is earlier"),
        ("{key:", "{key + '_': ", "there is no column 'T_left'; did you mean 'T_left_'?"),
        ("frame[key] + noise * rng", "['a'] * 91 or rng", "must contain numbers only"),
    ],
)
def test_readers_that_fail_are_refused_with_one_sentence(rod, monkeypatch, old, new, named):
    assert old in READER
    path = with_reader(rod, READER.replace(old, new))
    monkeypatch.setenv("LIVEPDE_DATA", str(path.parent))
    with pytest.raises(lp.LivepdeError) as error:
        cases.load(path, allow_code=True).prepare()
    message = str(error.value)
    assert named in message
    assert str(path) in message
    assert "\n" not in message


def test_options_that_are_text_or_booleans(rod):
    body = """
from dataclasses import replace
from livepde.models import EQUATIONS, Option

def make(mesh, unknowns, dirichlet, *, shape, closed):
    assert shape == "radial" and closed is True
    return EQUATIONS["heat"].build(mesh, unknowns, dirichlet)

options = {"shape": Option("", "coordinates", choices=("plane", "radial")),
           "closed": Option("", "closed at the left", False)}
build = replace(EQUATIONS["heat"], build=make, options=options)
"""
    path = own_code(rod, body)
    text = path.read_text()
    for given, named in (
        ("", "options.shape is missing: the coordinates: one of plane, radial"),
        ('shape = "radail"', "did you mean 'radial'?"),
        ("shape = 3", "options.shape: got 3.0; expected text"),
        ('shape = "radial"\nclosed = "yes"', "options.closed: got 'yes'; expected true or false"),
        ('shape = "radial"\nclosed = true', ""),
    ):
        path.write_text(text.replace("[law]", f"[options]\n{given}\n[law]"))
        if named:
            with pytest.raises(lp.errors.CaseError, match=named.replace("?", r"\?")):
                cases.load(path, allow_code=True)
        else:
            cases.load(path, allow_code=True)


def test_text_for_a_bare_function(rod):
    body = "from livepde.models import heat\n\ndef build(mesh, unknowns, dirichlet, *, a, b, c):\n"
    body += "    assert (a, b, c) == (2.0, 'x', True)\n"
    body += "    return heat(mesh, unknowns['alpha'], dirichlet)\n"
    path = own_code(rod, body, plain=True)
    path.write_text(path.read_text().replace("[law]", '[options]\na = 2\nb = "x"\nc = true\n[law]'))
    cases.load(path, allow_code=True)


# --- settings that override a case -----------------------------------------------------------


def test_settings(rod):
    path = rod()
    given = parse(["law.noise=0.2 K", "law.refit=false", "law.memory='1 h'",
                   "unknowns.alpha.prior=6e-5", "title=A rod", "channels.T_20.role=sensor",
                   "channels.T_20.noise='1 K'"])  # fmt: skip
    case = cases.load(path, settings=given)
    assert (case.title, case.law.noise, case.law.memory) == ("A rod", 0.2, 3600.0)
    assert case.model.parameter_space.prior[0] == 6e-5
    assert case.validation is None
    assert case.original == path.read_text()
    other = path.with_name("resolved.toml")
    other.write_text(case.text)
    again = cases.load(other, settings=given)
    assert (again.title, again.law.noise, again.text) == ("A rod", 0.2, case.text)


def test_tables_are_set_key_by_key(rod):
    case = cases.load(rod(), settings={"steps": {"dt_max": "5 s"}, 'law."refit".start': 16})
    assert (case.dt_max, case.spec.steps.scheme) == (5.0, "alexander2")
    assert case.law.refit == lp.Refit(start=16)


def test_settings_without_a_value_remove_keys(rod):
    path = rod()
    assert cases.load(path).expected
    taken = cases.load(path, settings=parse(["expect=", "channels.T_20=", "steps.dt_max="]))
    assert (taken.expected, taken.validation, taken.dt_max) == ({}, None, np.inf)
    assert "expect" not in taken.text


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("law.kidn", None, "there is no key 'law.kidn' to remove; did you mean 'kind'?"),
        ("law.niose", 1, "there is no key 'law.niose'; did you mean 'noise'?"),
        ("unknowns.alhpa.prior", 1, "has no 'unknowns.alhpa'; did you mean 'alpha'?"),
        ("channels.T_21.noise", 1, "did you mean 'T_20'?"),
        ("law..noise", 1, "'law..noise' is not a key"),
    ],
)
def test_settings_that_are_refused(rod, key, value, named):
    path = rod()
    with pytest.raises(lp.errors.CaseError) as error:
        cases.load(path, settings={key: value})
    assert named in str(error.value)
    assert str(error.value).startswith(f"{path}: ")


def test_settings_need_an_equals_sign():
    with pytest.raises(lp.errors.CaseError, match=r"--set law: expected key=value"):
        parse(["law"])


# --- references and variants -----------------------------------------------------------------


def described(path):
    prepared, data = result_of(path)
    return prepared.case, data


@pytest.mark.slow
def test_references(rod):
    path = rod(("[expect]", REFERENCE), ("alpha = [9e-5, 1.05e-4]", 'alpha.error = "<= 0.03"'))
    case, data = described(path)
    assert case.references == {"alpha": pytest.approx(9.7e-5)}
    assert case.source == "made up"
    assert not case.notes
    found = measures(data)
    assert found["alpha.error"] == pytest.approx(abs(found["alpha"] / 9.7e-5 - 1))
    assert all(check.ok for check in checks_of(case.expected, data))
    table = tables(data)[0]
    assert table.title.endswith("made up")
    assert table.columns[-2:] == ("reference", "error")
    assert table.rows[0][-2] == "9.7e-05"


def test_variants(rod):
    (variant,) = cases.load(rod(("[expect]", VARIANTS))).spec.variants
    assert variant.name == "noisier"
    assert variant.seeds == 3
    assert variant.expect == {"rmse": ("<=", 1.0), "alpha.error": ("<=", 0.1)}


# --- shipped cases ---------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_cases_are_valid_and_short(path):
    case = cases.load(path, allow_code=True)
    assert not case.notes
    assert case.expected
    assert len(case.text.splitlines()) <= 60
    tomllib.loads(case.text)


def shipped(name, tmp_path, *changes):
    text = (SHIPPED / f"{name}.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / f"{name}.toml"
    path.write_text(text)
    return path


@pytest.fixture
def measured(data_dir, monkeypatch):
    monkeypatch.setenv("LIVEPDE_DATA", str(data_dir))


@pytest.mark.long
@pytest.mark.usefixtures("measured")
def test_soil_by_layer(tmp_path):
    _, data = result_of(shipped("soil_layers", tmp_path))
    found = measures(data)
    assert found["rmse"] <= 0.25
    assert found["rmse.validation"] <= 0.25
    # Layers agree with batch fits of amplitude and phase within the reported standard deviations.
    for layer, fit in (("05-10", 4.1e-7), ("10-20", 5.4e-7), ("20-30", 8.1e-7), ("30-40", 7.7e-7)):
        name = f"alpha[{layer}]"
        assert abs(found[name] - fit) <= 4 * found[f"{name}.std"]


@pytest.mark.study
@pytest.mark.usefixtures("measured")
def test_thermal_response_does_not_depend_on_the_prior(tmp_path):
    ends = []
    for prior in (1.5, 2, 4):
        change = ('prior = "2 W/(m K)"', f'prior = "{prior} W/(m K)"')
        thin = ("time_unit =", "every = 3\ntime_unit =")
        prepared, data = result_of(shipped("thermal_response", tmp_path, change, thin))
        found = measures(data)
        ends.append(found["k"])
        assert 2.6 <= found["k"] <= 3.1
        assert abs(found["k"] - 2.88) <= 2 * found["k.std"]  # measured independently
        assert 0.05 < found["k.std"] < 0.3
        early = data.innovation.values[data.time.values < prepared.assimilate_from]
        assert np.sqrt(np.nanmean(early**2)) > 5 * found["rmse"]  # early, the model is wrong
    assert max(ends) - min(ends) <= 0.05


def test_a_misspelt_expectation(rod):
    (note,) = cases.load(rod(("alpha = [9e-5", "alpah = [9e-5"))).notes
    assert note.startswith("expect.alpah: a run of this case has no such number; did you mean")


def test_units_of_many_cases_are_those_of_pint():
    """The table that avoids loading Pint's registry agrees with the registry."""
    from livepde import units

    registry = units.pint_registry()
    for (given, unit), (factor, offset) in units.USUAL.items():
        zero, one = (registry.Quantity(k, registry.parse_units(given)) for k in (0.0, 1.0))
        found = [quantity.to(unit).magnitude for quantity in (zero, one)]
        assert found == pytest.approx([offset, offset + factor], rel=1e-15, abs=0.0)
        assert units.conversion(given, unit, "here") == units.Affine(factor, offset)


def test_every_option_of_the_sensitivity_law_is_a_key_with_the_same_default():
    keys = SensitivitySpec(kind="sensitivity")
    for option in dataclasses.fields(lp.SensitivityLaw):
        usual, given = getattr(lp.SensitivityLaw(), option.name), getattr(keys, option.name)
        if option.name == "memory":  # a time, which has a unit
            assert (usual, given) == (np.inf, None)
        elif dataclasses.is_dataclass(usual) or usual is None:
            assert bool(given) == (usual is not None)
        else:
            assert given == usual
    assert set(SensitivitySpec.model_fields) == {
        "kind", *(option.name for option in dataclasses.fields(lp.SensitivityLaw))
    }  # fmt: skip


def test_the_column_of_times_is_time_unless_another_is_named(rod):
    path = rod(('time = "time_s"', ""))
    with pytest.raises(lp.errors.SampleError, match="there is no column 'time'; did you mean"):
        cases.load(path).prepare()


def test_sensors_are_named_in_the_order_of_an_innovation(tmp_path):
    """Otherwise metrics and the table of predictions would mix up the sensors."""
    mean = "channels.mean={ role='sensor', column='T_20', over=[0.1, 0.2], noise='0.05 K' }"
    last = "channels.T_21={ role='sensor', column='T_20', at='20 cm', noise='0.05 K' }"
    settings = parse(["channels.T_20=", mean, last])
    case = cases.load(short_rod(tmp_path), settings=settings)
    assert case.prepare().identifier.observed.names == case.sensors
    assert case.sensors != tuple(case.roles("sensor"))
