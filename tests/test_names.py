"""Names that would be ambiguous in the dataset of a run are refused before the run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skfem import ElementLineP1, ElementTriP1, ElementVector

import livepde as lp
from livepde import cases
from livepde.fem import cells
from livepde.model import Model
from livepde.plots.style import note
from livepde.records import FIELD_ENDS, NUMBER_ENDS, STATE_ENDS, Layout
from livepde.runs.summary import measures, tables

MESH = lp.interval(0.0, 1.0, 8)


def decay(names: list[str], state: str = "") -> lp.Model:
    """A reaction whose unknown rates are added up."""

    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return sum(getattr(q, name) for name in names) * u * v

    field = lp.Field(MESH, ElementLineP1(), name=state)
    return lp.Model(field, {name: lp.Normal(0.5, 0.1) for name in names}, A)


def run(model: lp.Model, law: Any = None, validation: Any = None) -> lp.Result:
    points = lp.Points([0.3, 0.7], noise=0.01)
    law = law or lp.SensitivityLaw()
    identifier = lp.Identifier(model, points, law, u0=1.0, validation=validation)
    rng = np.random.default_rng(0)
    times = 0.1 * np.arange(1, 8)
    noise = 0.01 * rng.standard_normal((7, 2))
    return identifier.run((t, np.exp(-t) + e) for t, e in zip(times.tolist(), noise, strict=True))


@pytest.mark.parametrize(
    "name",
    [
        "status",
        "steps",
        "time",
        "snapshot",
        "sensor",
        "validation",
        "innovation",
        "validation_error",
        "x",
        "date",
        "vertex",
        "unknown",
        "other",
        "correlation",
    ],
)
def test_a_name_of_the_dataset_is_refused(name: str):
    expected = f"'{name}' would be a name of the dataset itself and the unknown '{name}': give"
    with pytest.raises(lp.errors.ModelError, match=expected):
        decay([name, "k"])


@pytest.mark.parametrize("end", sorted({*STATE_ENDS, *NUMBER_ENDS}))
@pytest.mark.parametrize("turned", [False, True])
def test_what_stands_beside_an_unknown_is_refused_for_another(end: str, turned: bool):
    names = [f"k{end}", "k"] if turned else ["k", f"k{end}"]
    with pytest.raises(lp.errors.ModelError, match=r"would be .* of 'k'.*: give the unknown"):
        decay(names)
    assert decay([f"k{end}"])  # alone it is a name as any other


@pytest.mark.parametrize("end", sorted(FIELD_ENDS))
def test_what_stands_beside_a_field_is_refused(end: str):
    def A(q: Any, u: Any, v: Any, x: Any) -> Any:
        return (q.c + getattr(q, f"c{end}")) * u * v

    field = lp.Field(MESH, ElementLineP1())
    with pytest.raises(lp.errors.ModelError, match=f"'c{end}' would be"):
        lp.Model(field, {"c": field, f"c{end}": lp.Normal()}, A)


@pytest.mark.parametrize(("state", "name"), [("", "u"), ("", "u_std"), ("T", "T")])
def test_the_state_and_its_deviation_are_refused(state: str, name: str):
    with pytest.raises(
        lp.errors.ModelError, match=f"'{name}' would be .*state|of '{state or 'u'}'"
    ):
        decay([name], state)


def test_a_state_with_a_name_of_the_dataset_is_refused():
    with pytest.raises(
        lp.errors.ModelError, match="the state 'time': give the component another name"
    ):
        decay(["k"], "time")


def test_directions_of_a_vector_and_cells_are_refused():
    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (2, 2))
    state = lp.Field(mesh, ElementVector(ElementTriP1()))

    def model(name: str) -> lp.Model:
        A = lambda q, u, v, x: getattr(q, name) * lp.dot(u, v)  # noqa: E731
        return lp.Model(state, {name: lp.Normal()}, A)

    for name in ("u_x", "u_y_std", "y", "cell", "sensor_x", *cells(mesh)):
        with pytest.raises(lp.errors.ModelError, match=f"'{name}' would be"):
            model(name)
    assert model("z")
    assert model("u_z")


def test_unknowns_of_sensors_are_checked_too():
    with pytest.raises(lp.errors.ModelError, match="'k_std' would be"):
        decay(["k"]).with_unknowns({"k_std": lp.Normal()})


@pytest.mark.slow
def test_every_name_that_a_dataset_has_is_known_to_the_check():
    """So that what is written later is refused, too: nothing here is copied by hand."""
    field = lp.Field(MESH, ElementLineP1(), prior=lp.LogNormal(1.0, std=0.1))
    model = lp.Model(
        lp.Field(MESH, ElementLineP1()),
        {"c": field, "k": lp.Normal(0.5, 0.1, bounds=(0.0, 1.0)), "s": lp.Normal(0.5, 0.1)},
        A=lambda q, u, v, x: (q.c + q.k + q.s) * u * v,
    )
    result = run(model, validation=lp.Points({"v": 0.4}))
    data = result.to_xarray()
    assert {"validation_x", "validation_error"} <= {*data.variables}
    own = {"u": STATE_ENDS, "c": FIELD_ENDS, "k": NUMBER_ENDS, "s": NUMBER_ENDS}
    expected = {f"{name}{end}" for name, ends in own.items() for end in ("", *ends)}
    expected |= Layout.own_names("x", ())
    notes = {name for record in result.records for name in record.notes}
    assert {*data.variables, *data.dims} <= expected | notes
    assert {f"c{end}" for end in FIELD_ENDS} <= set(data.variables)


@pytest.mark.slow
def test_a_note_of_the_same_name_stands_beside_the_unknown():
    """`innovation_ratio` and `jump` are not read from unknowns that are called so."""
    model = decay(["innovation_ratio", "jump"])
    data = run(model, lp.SensitivityLaw(jumps=lp.Jumps())).to_xarray()
    plain = run(decay(["a", "b"]), lp.SensitivityLaw(jumps=lp.Jumps())).to_xarray()
    for name in ("innovation_ratio", "jump"):
        np.testing.assert_array_equal(note(data, name), note(plain, name))
    assert not (data["jump"].values == note(data, "jump")).any()
    assert measures(data)["jumps"] == 0.0
    assert [table.title for table in tables(data)] == [table.title for table in tables(plain)]
    alone = run(decay(["jump"])).to_xarray()
    assert note(alone, "jump") is None
    assert "jumps" not in measures(alone)


def test_no_unknown_is_called_like_a_note_that_had_to_move():
    with pytest.raises(lp.errors.ModelError, match=r"'note_jump' would be .* a note of the law"):
        decay(["note_jump"])


def test_a_fleet_has_one_dimension_more():
    model, points = decay(["member"]), lp.Points([0.5], noise=0.1)
    fleet = lp.Fleet(model, points, lp.SensitivityLaw(), members=2, u0=1.0)
    with pytest.raises(lp.errors.ConfigurationError, match="'member' would be the dimension"):
        fleet.run([])


OWN = """
import livepde as lp
from skfem import ElementLineP1


def build(mesh, unknowns, dirichlet, *, {name}=0.0):
    state = lp.Field(mesh, ElementLineP1(), dirichlet=dirichlet)
    flux = lambda q, u, v, x: q.{name} * lp.dot(lp.grad(u), lp.grad(v))
    return lp.Model(state, unknowns, flux, time_unit="s")
"""
CASE = """
equation = "own.py:build"
mesh = {{ from = 0, to = 1, cells = 8 }}
law = {{ kind = "sensitivity", noise = 0.1 }}
data = {{ file = "data.csv", time = "t" }}
unknowns.{name} = {{ prior = 1, std = 0.1 }}
channels.left = {{ role = "boundary", column = "left", at = "left" }}
channels.{sensor} = {{ role = "sensor", column = "T", at = 0.5 }}
"""


def case(folder: Path, name: str = "k", sensor: str = "T") -> cases.Case:
    (folder / "own.py").write_text(OWN.format(name=name), encoding="utf-8")
    path = folder / "case.toml"
    path.write_text(CASE.format(name=name, sensor=sensor), encoding="utf-8")
    return cases.load(path, allow_code=True)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"name": "status"}, "unknowns: Model: in tables and datasets of a run 'status' would be"),
        ({"name": "u"}, "unknowns: Model: in tables and datasets of a run 'u' would be the state"),
        ({"name": "jumps"}, r"unknowns.jumps: 'jumps' is another number in \[expect\]"),
        ({"sensor": "validation"}, "channels.validation: 'validation' is another number"),
    ],
)
def test_a_case_says_which_key_has_such_a_name(tmp_path: Path, names: dict[str, str], message: str):
    assert case(tmp_path).model
    with pytest.raises(lp.errors.CaseError, match=f"case.toml: {message}"):
        case(tmp_path, **names)


def test_models_are_checked_without_the_packages_of_tables(monkeypatch: pytest.MonkeyPatch):
    """A name costs no import of xarray."""
    import sys

    monkeypatch.setitem(sys.modules, "xarray", None)
    assert isinstance(decay(["k"]), Model)
