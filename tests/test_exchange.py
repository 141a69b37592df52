"""FMI units for other programs and online learners give the numbers of the identifier."""

import copy
import json
import math
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from factories import short_rod
from skfem import ElementLineP1, MeshTri
from typer.testing import CliRunner

import livepde as lp
from benchmarks.__main__ import app as benchmarks
from benchmarks.fmu import compare_fmu, running
from livepde.cases import load
from livepde.cli import app
from livepde.exchange import OnlineRegressor, export_fmu, river_regressor
from livepde.exchange.fmu_export import recipe_of
from livepde.exchange.unit_process import REFUSED, WAITING, Component, of_code
from livepde.models import heat
from livepde.units import in_si

fmpy = pytest.importorskip("fmpy")
validation = pytest.importorskip("fmpy.validation")
pytest.importorskip("pythonfmu")
pytest.importorskip("pythonfmu3")

OWN = """\
import livepde as lp
from livepde.models import heat


def build():
    mesh = lp.interval(0.0, 0.4, 40)
    model = heat(mesh, lp.Normal(5e-5, std=3e-5, bounds=(1e-6, 1e-3)), {"left": lp.Channel("T")})
    sensors = lp.Points({"T_10": 0.1}, noise=0.05, unit="degC")
    return lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=20.0, dt_max=20.0)


def fails():
    raise ValueError("no rod today")


def other():
    return 3
"""


@pytest.fixture(scope="module")
def rod(tmp_path_factory):
    """Provide the case of `livepde init`, a rod with two sensors and 61 samples."""
    return short_rod(tmp_path_factory.mktemp("rod"))


@pytest.fixture(scope="module", params=[2, 3])
def unit(request, rod, tmp_path_factory):
    folder = tmp_path_factory.mktemp(f"fmi{request.param}")
    return export_fmu(rod, folder / "rod.fmu", fmi=request.param)


INPUTS = ("T_left", "T_10", "T_30", "T_right")
OUTPUTS = ("alpha", "alpha_std", "T_10_model", "T_20_model", "status")


def taken(instance, t, values):
    instance.set(INPUTS, values)
    instance.step(t, 20.0)
    return instance.get(OUTPUTS)


def history(count, start=0):
    for k in range(start, start + count):
        yield 20.0 * k, [20.0 + k, 20.0 + 0.1 * k, 20.0, 20.0]


@pytest.mark.slow
def test_the_unit_gives_the_numbers_of_the_identifier(rod, unit):
    prepared = load(rod).prepare()
    with running(unit, 0.0) as instance:
        for k, sample in enumerate(prepared.stream):
            z = dict(sample.z)
            if k % 7 == 3:
                z["T_10"] = math.nan
            estimate = prepared.identifier.step(sample.t, z)
            found = taken(instance, sample.t, [z[name] for name in INPUTS])
            ((alpha, std),) = estimate.parameters.values()
            model = [z["T_20"] - estimate.validation_error[0], 0.0]
            assert found[:2] == pytest.approx([alpha, std], rel=1e-10)
            assert found[3:] == pytest.approx(model, rel=1e-10)
    assert k == 60


@pytest.mark.long
def test_a_unit_of_another_case_is_detected(rod, tmp_path):
    other = load(rod, settings={"unknowns.alpha.prior": "6e-5 m^2/s"})
    found = compare_fmu(export_fmu(other, tmp_path / "other.fmu"), load(rod))
    assert found.differences["alpha"] > 1e-3
    assert not found.largest <= 1e-10


def test_the_description_has_names_units_and_times(unit):
    assert validation.validate_fmu(str(unit)) == []
    description = fmpy.read_model_description(str(unit))
    by_name = {item.name: item for item in description.modelVariables}
    assert [n for n, item in by_name.items() if item.causality == "input"] == list(INPUTS)
    assert by_name["alpha"].unit == by_name["alpha_std"].unit == "m^2/s"
    assert by_name["T_10"].unit == by_name["T_20_model"].unit == "degC"
    assert "role sensor" in by_name["T_10"].description
    assert "-2 sample refused" in by_name["status"].description
    assert by_name["status"].type in ("Integer", "Int32")
    units = {item.name: item.baseUnit for item in description.unitDefinitions}
    assert (units["degC"].K, units["degC"].offset) == (1, 273.15)
    assert (units["m^2/s"].m, units["m^2/s"].s) == (2, -1)
    times = description.defaultExperiment
    assert [float(t) for t in (times.startTime, times.stopTime, times.stepSize)] == [0, 1200, 20]
    able = description.coSimulation
    assert able.canHandleVariableCommunicationStepSize
    assert (getattr(able, "canGetAndSetFMUstate", 0) or able.canGetAndSetFMUState) is True
    assert able.canSerializeFMUstate if hasattr(able, "canSerializeFMUstate") else True
    assert "heated" in description.description
    assert description.generationTool.startswith(f"livepde {lp.__version__} by PythonFMU")


@pytest.mark.long
def test_a_simulation_runs_the_unit_as_users_do(rod, unit):
    """FMPy sets the inputs at each communication point, and reads outputs one step later."""
    prepared = load(rod).prepare()
    samples = list(prepared.stream)
    kinds = [("time", float), *((name, float) for name in INPUTS)]
    rows = [(s.t, *(s.z[name] for name in INPUTS)) for s in samples]
    found = fmpy.simulate_fmu(
        str(unit),
        start_time=0.0,
        stop_time=1200.0,
        output_interval=20.0,
        input=np.array(rows, dtype=kinds),
        output=["alpha", "status"],
    )
    alpha = [prepared.identifier.step(s.t, s.z).q[0] for s in samples[:-1]]
    assert found["status"][0] == WAITING
    assert found["alpha"][0] == pytest.approx(5e-5)  # the prior
    assert found["alpha"][1:] == pytest.approx(alpha, rel=1e-10)
    assert not found["status"][1:].any()


@pytest.mark.slow
def test_the_state_is_kept_serialised_and_restored(unit):
    with running(unit, 0.0) as one:
        for t, z in history(5):
            taken(one, t, z)
        state = one.fmu.getFMUState()
        stored = one.fmu.serializeFMUState(state)
        after = [taken(one, t, z) for t, z in history(5, 5)]
        one.fmu.setFMUState(state)
        assert [taken(one, t, z) for t, z in history(5, 5)] == after
    with running(unit, 0.0) as two:
        read = getattr(two.fmu, "deserializeFMUState", None) or two.fmu.deSerializeFMUstate
        free = getattr(two.fmu, "freeFMUState", None) or two.fmu.freeFMUstate
        begun = read(stored)
        two.fmu.setFMUState(begun)
        free(begun)
        assert two.get(["status"]) == [0.0]
        assert [taken(two, t, z) for t, z in history(5, 5)] == after


@pytest.mark.slow
def test_a_reset_unit_starts_from_the_beginning(unit):
    with running(unit, 0.0) as instance:
        before = [taken(instance, t, z) for t, z in history(4)]
        instance.fmu.reset()
        assert instance.get(["status"]) == [WAITING]
        if hasattr(instance.fmu, "setupExperiment"):
            instance.fmu.setupExperiment(startTime=0.0)
        instance.fmu.enterInitializationMode()
        instance.fmu.exitInitializationMode()
        assert [taken(instance, t, z) for t, z in history(4)] == before


@pytest.mark.long
def test_with_a_period_short_steps_are_not_measurements(unit):
    """For example, the master has steps of 6 s and a sample arrives every 20 s."""
    with running(unit, 0.0) as instance:
        assert instance.get(["sample_period"]) == [0.0]
        instance.set(["sample_period"], [20.0])
        shown = {}
        for k in range(14):
            instance.set(INPUTS, [20.0 + k, 20.0 + 0.1 * k, 20.0, 20.0])
            instance.step(6.0 * k, 6.0)
            shown[6.0 * k] = instance.get([*OUTPUTS, "estimate_time"])
            if k == 5:
                kept = instance.fmu.getFMUState()
        assert [found[-1] for found in shown.values()] == [0.0] * 4 + [24.0] * 3 + [42.0] * 3 + [
            60.0
        ] * 4
        instance.fmu.setFMUState(kept)
        instance.set(["sample_period"], [20.0])
        instance.step(36.0, 6.0)
        assert instance.get([*OUTPUTS, "estimate_time"]) == shown[36.0]
        instance.fmu.freeFMUState(kept)
    with running(unit, 0.0) as other:
        for t in (0.0, 24.0, 42.0, 60.0):
            k = round(t / 6.0)
            found = taken(other, t, [20.0 + k, 20.0 + 0.1 * k, 20.0, 20.0])
            assert found == shown[t][:-1]


@pytest.mark.slow
def test_a_step_without_a_sample_does_not_consume_its_period(unit):
    with running(unit, 0.0) as instance:
        instance.set(["sample_period"], [20.0])
        found = []
        for k in range(8):
            instance.set(INPUTS, [20.0 if k % 2 else math.nan] * 4)
            instance.step(10.0 * k, 10.0)
            found += instance.get(["estimate_time"])
    assert found[1:] == [10.0, 20.0, 20.0, 40.0, 40.0, 60.0, 60.0]  # the unit could not begin at 0


@pytest.mark.slow
def test_a_custom_function_also_waits_for_a_first_sample(tmp_path):
    (tmp_path / "own.py").write_text(
        "import livepde as lp\n"
        "from livepde.models import heat\n"
        "def build():\n"
        "    alpha = lp.Normal(5e-5, std=3e-5)\n"
        "    model = heat(lp.interval(0.0, 0.4, 8), alpha, {'left': lp.Channel('hot')})\n"
        "    return lp.Identifier(model, lp.Points({'T': 0.1}, noise=0.1), lp.SensitivityLaw())\n"
    )
    unit = export_fmu(f"{tmp_path / 'own.py'}:build", tmp_path / "own.fmu")
    with running(unit, 0.0) as instance:
        for t in (0.0, 1.0):
            instance.step(t, 1.0)
            assert instance.get(["status"]) == [WAITING]
            assert "'hot' has no value" in instance.messages[-1]
        instance.set(["hot", "T"], [20.0, 20.0])
        instance.step(2.0, 1.0)
        assert instance.get(["status", "estimate_time"]) == [0.0, 2.0]


@pytest.mark.slow
def test_unusable_inputs_give_a_status_and_a_message(unit):
    (_, z), *others = history(6)
    with running(unit, 0.0) as instance:
        first = taken(instance, 0.0, [math.nan, *z[1:]])
        assert first[4] == WAITING
        assert first[0] == pytest.approx(5e-5)  # the prior
        assert math.isnan(first[2])
        assert "T_left" in instance.messages[-1]
        for t, z in others[:2]:
            good = taken(instance, t, z)
        assert good[4] == 0.0
        t, z = others[2]
        assert taken(instance, t, [z[0], math.inf, *z[2:]]) == [*good[:4], REFUSED]
        assert "'T_10': got inf" in instance.messages[-1]
        assert taken(instance, 0.0, z) == [*good[:4], REFUSED]
        assert "not later than the last one" in instance.messages[-1]
        assert taken(instance, t, z)[4] == 0.0


@pytest.mark.slow
def test_a_failed_step_gives_a_status_and_a_message(tmp_path):
    (tmp_path / "own.py").write_text(
        "import numpy as np\n"
        "import livepde as lp\n"
        "from skfem import ElementLineP1\n"
        "def build():\n"
        "    field = lp.Field(lp.interval(0.0, 1.0, 10), ElementLineP1())\n"
        "    model = lp.Model(field, {'k': lp.Normal(1.0, std=0.5)},\n"
        "        A=lambda q, u, v, x: q.k * u * v, B=lambda u, v, x: -10 * np.exp(u) * v)\n"
        "    return lp.Identifier(model, lp.Points({'a': 0.5}, noise=0.1), lp.SensitivityLaw(),\n"
        "        u0=2.0)\n"
    )
    unit = export_fmu(f"{tmp_path / 'own.py'}:build", tmp_path / "own.fmu")
    with running(unit, 0.0) as instance:
        instance.step(0.0, 0.001)
        before = instance.get(["k", "a_model"])
        instance.step(1.0, 1.0)
        (status,) = instance.get(["status"])
        assert status > 0.0
        assert "t = 1 s" in instance.messages[-1]
        assert "dt_max" in instance.messages[-1]
        assert instance.get(["k", "a_model"]) == before


@pytest.mark.slow
def test_missing_values_follow_the_rules_of_the_case(rod, tmp_path):
    shutil.copy(rod.with_name("rod.csv"), tmp_path)
    text = rod.read_text().replace('time_unit = "s"', 'time_unit = "s"\nmissing = [-9999]')
    text = text.replace('column = "T_10", ', 'column = "T_10", valid = ["0 degC", "90 degC"], ')
    text = text.replace('column = "T_30", ', 'column = "T_30", unit = "K", missing = "skip", ')
    case = tmp_path / "case.toml"
    case.write_text(text)
    component = Component(recipe_of(load(case)).process)
    identifier = None
    for k, (t, (left, one, other, right)) in enumerate(history(8)):
        given = [left, one, other + 273.15, right]
        if k == 3:
            one, given[1] = math.nan, 95.0  # invalid
        if k == 4:
            left, given[0] = math.nan, -9999.0
        if k == 5:
            given[2] = math.nan  # the whole sample is missing
        component.inputs = given
        assert component.take(t) == ""
        z = dict(zip(INPUTS, [left, one, other, right], strict=True))
        if identifier is None:
            identifier = load(case).begin(lp.Sample(t, z)).identifier
        if k != 5:
            identifier.step(t, z)
        assert component.outputs[0] == (80.0 if k == 5 else t)
        assert component.outputs[1] == pytest.approx(identifier.estimate().q[0], rel=1e-9)
    names = [item.name for item in component.process.outputs()]
    shown = component.outputs[names.index("T_30_model")]
    assert shown == pytest.approx(identifier.forecast(t)["T_30"][0] + 273.15)


def test_a_channel_with_a_factor_has_no_stated_unit(rod):
    process = recipe_of(load(rod, settings={"channels.T_10.factor": 0.01})).process
    units = {item.name: item.unit for item in (*process.inputs, *process.outputs())}
    assert units["T_10"] == units["T_10_model"] == ""
    assert units["T_30"] == units["T_30_model"] == "degC"


@pytest.mark.parametrize("key", ["late", "noise_column"])
def test_features_that_a_unit_lacks_are_refused(rod, key):
    value = {"late": "10 s", "noise_column": "T_20"}[key]
    with pytest.raises(lp.errors.CaseError, match=f"channels.T_10.{key}"):
        recipe_of(load(rod, settings={f"channels.T_10.{key}": value}))


@pytest.mark.slow
def test_time_is_in_seconds_for_any_time_unit_of_the_model(tmp_path):
    model = lp.Model(
        lp.Field(lp.interval(0.0, 1.0, 10), ElementLineP1()),
        {"k": lp.Scalar(lp.Normal(0.1, std=0.05), unit="1/h")},
        A=lambda q, u, v, x: q.k * u * v,
        time_unit="h",
    )

    def build():
        sensors = lp.Points({"a": 0.5}, noise=0.1)
        return lp.Identifier(model, sensors, lp.SensitivityLaw(), u0=1.0, t0=2.0)

    process = of_code("own:build", build)
    assert process.experiment.start == 7200.0
    component, identifier = Component(process), build()
    for t, z in ((2.0, 1.0), (3.0, 0.8), (4.5, 0.6)):
        component.inputs = [z]
        assert component.take(3600.0 * t) == ""
        estimate = identifier.step(t, [z])
    assert component.outputs[:3] == pytest.approx(
        [16200.0, estimate.q[0], estimate.q_std[0]], rel=1e-12
    )


@pytest.mark.slow
def test_a_field_is_an_output_at_the_vertices(tmp_path):
    def build(cells):
        mesh = lp.interval(0.0, 1.0, cells)
        model = lp.Model(
            lp.Field(mesh, ElementLineP1(), dirichlet={"boundary": 0.0}),
            lp.Field(mesh, ElementLineP1(), inner="H1", prior=lp.Normal(1.0, std=0.5), unit="1/s"),
            A=lambda q, u, v, x: q * u * v,
            B=lambda u, v, x: lp.dot(lp.grad(u), lp.grad(v)),
        )
        sensors = lp.Points({"a": 0.3, "b": 0.6}, noise=0.01)
        return lp.Identifier(model, sensors, lp.SensitivityLaw(modes=3), u0=lambda x: x[0])

    process = of_code("own:build", lambda: build(6))
    names = [item.name for item in process.outputs()]
    assert names[1:5] == ["q[1]", "q[1]_std", "q[2]", "q[2]_std"]
    component, identifier = Component(process), build(6)
    assert component.outputs[1:5:2] == pytest.approx([1.0, 1.0])
    component.inputs = [0.25, 0.5]
    component.take(0.1)
    estimate = identifier.step(0.1, [0.25, 0.5])
    found = dict(zip(names, component.outputs, strict=True))
    assert [found[f"q[{k}]"] for k in range(1, 8)] == estimate.q.tolist()
    assert [found[f"q[{k}]_std"] for k in range(1, 8)] == estimate.q_std.tolist()
    large = of_code("own:build", lambda: build(1200))
    assert [item.name for item in large.outputs()] == ["estimate_time", "a_model", "b_model"]
    assert large.notes == ["The field q is not an output: it has 1201 vertices, more than 1000."]


@pytest.mark.long
def test_a_case_with_code_requires_permission_and_includes_its_files(rod, tmp_path):
    (tmp_path / "inside").mkdir()
    shutil.copy(rod.with_name("rod.csv"), tmp_path)
    (tmp_path / "inside" / "pde.py").write_text(
        "from livepde.models import EQUATIONS\nmine = EQUATIONS['heat']\n"
    )
    case = tmp_path / "case.toml"
    text = rod.read_text().replace('equation = "heat"', 'equation = "inside/pde.py:mine"')
    case.write_text(text)
    with pytest.raises(lp.errors.CaseError, match="--allow-code"):
        export_fmu(case, tmp_path / "a.fmu")
    unit = export_fmu(case, tmp_path / "a.fmu", allow_code=True)
    expected = load(case, allow_code=True)
    inside = zipfile.ZipFile(unit).namelist()
    assert {"resources/process/pde.py", "resources/process/case.toml"} <= set(inside)
    assert not any(name.endswith(".csv") for name in inside)
    assert compare_fmu(unit, expected).largest <= 1e-10
    (tmp_path / "inside" / "pde.py").unlink()
    with running(unit, 0.0) as instance:
        for t, z in history(3):
            assert taken(instance, t, z)[4] == 0.0


@pytest.mark.slow
def test_a_unit_includes_the_mesh_of_its_case(rod, tmp_path):
    pytest.importorskip("meshio")
    (tmp_path / "meshes").mkdir()
    MeshTri().refined(2).scaled(0.4).save(tmp_path / "meshes" / "plate.msh")
    shutil.copy(rod.with_name("rod.csv"), tmp_path)
    text = re.sub(
        r"\[mesh\].*?\[data\]",
        '[mesh]\nfile = "meshes/plate.msh"\n\n[data]',
        rod.read_text(),
        flags=re.DOTALL,
    )
    text = re.sub(r"^T_(left|right|20) = .*\n", "", text, flags=re.MULTILINE)
    text = text.replace('at = "10 cm"', 'at = ["10 cm", "10 cm"]')
    text = text.replace('at = "30 cm"', 'at = ["30 cm", "10 cm"]')
    case = tmp_path / "case.toml"
    case.write_text(text.replace('initial = "interpolate"', 'initial = "20 degC"'))
    unit = export_fmu(case, tmp_path / "plate.fmu")
    assert "resources/process/plate.msh" in zipfile.ZipFile(unit).namelist()
    (tmp_path / "meshes" / "plate.msh").rename(tmp_path / "gone.msh")
    with running(unit, 0.0) as instance:
        instance.set(["T_10", "T_30"], [20.0, 20.0])
        instance.step(0.0, 20.0)
        assert instance.get(["status", "T_10_model"]) == pytest.approx([0.0, 20.0])


def test_two_files_of_one_name_are_refused(rod, tmp_path):
    shutil.copy(rod.with_name("rod.csv"), tmp_path)
    for folder, code in (("a", "mine = EQUATIONS['heat']"), ("b", "def read(folder): ...")):
        (tmp_path / folder).mkdir()
        text = f"from livepde.models import EQUATIONS\n{code}\n"
        (tmp_path / folder / "own.py").write_text(text)
    text = rod.read_text().replace('equation = "heat"', 'equation = "a/own.py:mine"')
    text = re.sub(r"^file = .*$", 'reader = "b/own.py:read"', text, flags=re.MULTILINE)
    case = tmp_path / "case.toml"
    case.write_text(text)
    with pytest.raises(lp.errors.ConfigurationError, match="holds another file of that name"):
        recipe_of(load(case, allow_code=True))


@pytest.mark.slow
def test_a_case_without_data_becomes_a_unit(rod, tmp_path):
    case = tmp_path / "case.toml"
    case.write_text(re.sub(r"^file = .*\n", "", rod.read_text(), flags=re.MULTILINE))
    unit = export_fmu(case, tmp_path / "rod.fmu")
    assert fmpy.read_model_description(str(unit)).defaultExperiment is None
    with running(unit, 400.0) as instance:  # it begins with the other program
        found = [taken(instance, 400.0 + t, z) for t, z in history(3)]
    assert [row[-1] for row in found] == [0.0, 0.0, 0.0]
    with pytest.raises(lp.errors.CaseError, match=r"data\.file is missing"):
        compare_fmu(unit, load(case))


@pytest.mark.long
def test_the_unit_uses_the_dates_of_the_case(rod, tmp_path):
    header, *rows = rod.with_name("rod.csv").read_text().splitlines()
    begin = datetime(2025, 4, 1)
    dated = [header]
    for row in rows[:50]:
        seconds, _, rest = row.partition(",")
        dated.append(f"{begin + timedelta(seconds=float(seconds))},{rest}")
    (tmp_path / "rod.csv").write_text("\n".join(dated))
    text = rod.read_text().replace('time_unit = "s"', "assimilate_from = 2025-04-01T00:10:00")
    case = tmp_path / "case.toml"
    case.write_text(text)
    unit = export_fmu(case, tmp_path / "rod.fmu")
    found = compare_fmu(unit, load(case))
    assert found.samples == 50
    assert found.largest <= 1e-10
    component = Component(recipe_of(load(case)).process)
    for t, z in history(32):
        component.inputs = z
        component.take(t)
        assert (component.outputs[1] == 5e-5) == (t < 600.0)


@pytest.mark.slow
def test_bad_input_is_one_sentence(rod, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    Path("there.fmu").write_text("")
    for source, options, error, words in [
        (rod, {"target": "a.zip"}, lp.errors.ConfigurationError, "ends with .fmu"),
        (rod, {"target": "there.fmu"}, lp.errors.RunError, "exists. Choose another file"),
        (
            rod,
            {"target": "a.fmu", "fmi": 1},
            lp.errors.ConfigurationError,
            "expected 2 .FMI 2.0. or 3",
        ),
        ("nix.toml", {}, lp.errors.CaseError, "no such case file"),
        ("own.py:nix", {}, lp.errors.CaseError, "has no function 'nix'"),
        ("nix.py:build", {}, lp.errors.CaseError, "there is no file 'nix.py'"),
        ("own.py:fails", {}, lp.errors.ConfigurationError, "failed with ValueError: no rod today"),
        (
            "own.py:other",
            {},
            lp.errors.ConfigurationError,
            r"returned int; expected \(\) -> livepde",
        ),
    ]:
        with pytest.raises(error, match=words):
            export_fmu(source, **options)
    for name in ("pythonfmu", "pythonfmu.builder"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        lp.errors.ConfigurationError, match=r"needs pythonfmu: pip install 'livepde\[fmu\]'"
    ):
        export_fmu(rod, "a.fmu")
    assert not list(Path().glob("*.fmu.*"))


def test_variables_need_unique_names(rod, tmp_path):
    shutil.copy(rod.with_name("rod.csv"), tmp_path)
    case = tmp_path / "case.toml"
    case.write_text(rod.read_text().replace("T_left = {", "alpha_std = {"))
    with pytest.raises(lp.errors.ConfigurationError, match=r"two variables .* 'alpha_std'; rename"):
        export_fmu(case, tmp_path / "a.fmu")


@pytest.mark.slow
def test_a_unit_that_cannot_run_reports_why(rod, tmp_path, monkeypatch):
    unit, broken = export_fmu(rod, tmp_path / "rod.fmu"), tmp_path / "broken.fmu"
    with zipfile.ZipFile(unit) as old, zipfile.ZipFile(broken, "w") as new:
        for item in old.infolist():
            content = old.read(item)
            if item.filename.endswith("case.toml"):
                content = content.replace(b'"heat"', b'"haet"')
            if item.filename.endswith("slavemodule.txt"):
                content += b"_broken"
            name = item.filename
            if name.startswith("resources/livepde_unit"):
                name = name.replace(".py", "_broken.py")
            new.writestr(name, content)
    with pytest.raises(lp.errors.RunError, match="did you mean 'heat'"), running(broken, 0.0):
        pass


@pytest.mark.process
def test_many_units_run_in_one_process(rod, tmp_path):
    """Each unit has its own library; one that frees too much memory would crash the next."""
    paths = []
    for k, prior in enumerate(("5e-5 m^2/s", "6e-5 m^2/s")):
        case = load(rod, settings={"unknowns.alpha.prior": prior})
        for fmi in (2, 3):
            paths.append(str(export_fmu(case, tmp_path / f"u{k}{fmi}.fmu", fmi=fmi)))
    code = (
        "import gc, sys\nfrom benchmarks.fmu import running\n"
        "for unit in 3 * sys.argv[1:]:\n"
        "    with running(unit, 0.0) as one, running(unit, 0.0) as two:\n"
        "        one.step(0.0, 20.0)\n        two.step(0.0, 20.0)\n"
        "        print(*one.get(['alpha']), *two.get(['alpha']))\n"
        "    gc.collect()\n"
    )
    command = [sys.executable, "-X", "faulthandler", "-c", code, *paths]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines == 3 * (2 * ["5e-05 5e-05"] + 2 * ["6e-05 6e-05"])


@pytest.mark.process
def test_the_unit_runs_in_a_program_without_python(rod, tmp_path):
    compiler = shutil.which("cc")
    folder, name = sysconfig.get_config_vars("LIBDIR", "INSTSONAME")
    library = Path(folder) / name
    if compiler is None or not name.startswith("libpython") or ".so" not in name:
        pytest.skip("needs a C compiler and a shared library of Python, on Linux")
    host, source = tmp_path / "host", Path(__file__).with_name("fmu_host.c")
    subprocess.run([compiler, str(source), "-o", str(host), "-ldl"], check=True)
    unit = export_fmu(rod, tmp_path / "rod.fmu")
    inside = fmpy.extract(str(unit), str(tmp_path / "inside"))
    description = fmpy.read_model_description(str(unit))
    (binary,) = Path(inside).glob("binaries/linux64/*.so")
    command = [str(binary), f"file://{inside}/resources"]
    done = subprocess.run(
        [str(host), *command, description.guid],
        env={
            "LD_PRELOAD": str(library),
            "PYTHONHOME": sys.base_prefix,
            "PYTHONPATH": ":".join(filter(None, sys.path)),
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = [[float(word) for word in line.split()] for line in done.stdout.splitlines()]
    assert found[:10] == found[10:]  # the second run
    component = Component(recipe_of(load(rod)).process)
    for (t, z), shown in zip(history(10), found[:10], strict=True):
        component.inputs = z
        component.take(t)
        assert component.outputs[1:3] == pytest.approx(shown, rel=1e-10)


@pytest.mark.long
def test_the_command_writes_and_compares_a_unit_and_reports(rod, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = CliRunner()
    done = run.invoke(app, ["fmu", str(rod), "--out", "rod.fmu", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["unit"] == "rod.fmu"
    done = run.invoke(benchmarks, ["fmu", str(rod), "--unit", "rod.fmu", "--json"])
    assert done.exit_code == 0, done.output
    (check,) = json.loads(done.stdout)["checks"]
    assert check["bound"] == 1e-10
    assert check["ok"]
    Path("own.py").write_text(OWN)
    done = run.invoke(app, ["fmu", "own.py:build", "--out", "own.fmu", "--fmi", "3"])
    assert done.exit_code == 0
    assert "Written: own.fmu (2 inputs, 5 outputs)" in done.stdout
    done = run.invoke(app, ["fmu", "own.py:build", "--set", "law.noise=1"])
    assert isinstance(done.exception, lp.errors.ConfigurationError)
    assert "--set requires a case file" in str(done.exception)


def test_units_are_converted_to_si():
    assert in_si("cm/h").exponents == {"m": 1, "s": -1}
    assert in_si("cm/h").factor == pytest.approx(0.01 / 3600)
    assert in_si("percent").exponents == {}
    assert in_si("m/s**0.5") is None
    assert in_si("apples") is None
    assert in_si("dB") is None  # not a linear scale


@pytest.mark.parametrize(("unit", "step"), [("degC", "K"), ("degF", "degR"), ("m", "m")])
def test_a_deviation_has_the_unit_of_differences(unit, step):
    def build():
        model = heat(lp.interval(0.0, 0.4, 8), lp.Scalar(lp.Normal(1.0, std=0.5), unit=unit))
        return lp.Identifier(model, lp.Points({"T": 0.1}, noise=0.1), lp.SensitivityLaw())

    units = {item.name: item.unit for item in of_code("own.py:build", build).outputs()}
    assert (units["alpha"], units["alpha_std"]) == (unit, step)
    assert in_si(step).offset == 0.0
    assert in_si(step).factor == pytest.approx(in_si(unit).factor)


# --- online learners -----------------------------------------------------------------------------


def slab(sensors):
    model = lp.Model(
        lp.Field(
            lp.interval(0.0, 1.0, 10), ElementLineP1(), dirichlet={"left": lp.Channel("T_left")}
        ),
        {"k": lp.Normal(0.2, std=0.05, bounds=(0.01, 5.0))},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)),
    )
    return lp.Identifier(model, lp.Points(sensors, noise=0.01), lp.SensitivityLaw())


def measured(count=40):
    """Return features and targets of a slab with k = 0.3."""
    model, points = slab({"a": 0.3}).model, lp.Points({"a": 0.3, "b": 0.6})
    scheme = lp.SensitivityLaw.scheme
    truth = lp.Identifier(model, points, lp.GradientLaw(), q0={"k": 0.3}, scheme=scheme)
    for k in range(count):
        x = {"t": 0.05 * k, "T_left": float(np.sin(0.3 * k))}
        truth.step(x["t"], {}, {"T_left": x["T_left"]})
        yield x, {name: float(truth.forecast(truth.t)[name][0]) for name in "ab"}


@pytest.mark.slow
def test_a_regressor_predicts_before_it_learns():
    model = OnlineRegressor(slab({"a": 0.3, "b": 0.6}))
    before, errors = model.identifier.dump(), []
    for x, y in measured():
        shown = model.predict_one(x)
        assert shown == model.predict_one(x)
        errors.append(max(abs(shown[name] - y[name]) for name in y))
        model.learn_one(x, y)
        assert model.estimate.status.ok
    assert model.estimate.q[0] == pytest.approx(0.3, rel=0.05)
    assert max(errors[-10:]) < 0.3 * max(errors)
    assert model.identifier.dump() == before


@pytest.mark.slow
def test_a_regressor_of_one_sensor_takes_numbers():
    model = OnlineRegressor(slab({"a": 0.3}))
    for x, y in measured(5):
        assert isinstance(model.predict_one(x), float)
        model.learn_one(x, y["a"])
    with pytest.raises(lp.errors.SampleError, match="have no 't', the time"):
        model.predict_one({"T_left": 0.0})
    with pytest.raises(lp.errors.SampleError, match="unknown input 'colour'"):
        model.predict_one({"t": 3.0, "colour": 1.0})
    several = OnlineRegressor(slab({"a": 0.3, "b": 0.6}))
    with pytest.raises(lp.errors.SampleError, match="expected a mapping"):
        several.learn_one({"t": 0.0, "T_left": 0.0}, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", [{"a": 0.3}, {"a": 0.3, "b": 0.6}])
def test_a_target_that_is_missing_is_not_learned_from(sensors):
    model = OnlineRegressor(slab(sensors))
    (x, _), (later, _) = measured(2)
    for features in (x, later):
        model.learn_one(features, None)
    assert (model.current.t, model.estimate.status.ok) == (later["t"], True)
    assert model.estimate.q[0] == pytest.approx(slab(sensors).model.initial_parameter()[0])


@pytest.mark.long
def test_the_evaluation_of_river_runs_it():
    evaluate = pytest.importorskip("river.evaluate")
    metrics = pytest.importorskip("river.metrics")
    model = river_regressor(slab({"a": 0.3, "b": 0.6}))
    several = metrics.multioutput.MicroAverage(metrics.MAE())
    score = evaluate.progressive_val_score(measured(), model, several)
    by_hand, plain = [], OnlineRegressor(slab({"a": 0.3, "b": 0.6}))
    for x, y in measured():
        shown = plain.predict_one(x)
        by_hand += [abs(shown[name] - y[name]) for name in y]
        plain.learn_one(x, y)
    assert score.get() == pytest.approx(np.mean(by_hand), rel=1e-12)
    one = river_regressor(slab({"a": 0.3}))
    single = [(x, y["a"]) for x, y in measured()]
    steps = evaluate.iter_progressive_val_score(single, one, metrics.MAE(), step=20)
    first, last = [step["MAE"].get() for step in copy.deepcopy(list(steps))][:2]
    assert 0.0 < last <= first


@pytest.mark.long
def test_the_applicable_checks_of_river_pass():
    """Except checks that omit features, such as the time, or pickle models with lambdas."""
    common = pytest.importorskip("river.checks.common")
    model = river_regressor(slab({"a": 0.3}))
    for x, y in measured(10):
        model.learn_one(x, y["a"])
    data = [(x, y["a"]) for x, y in measured(10)]
    for name in ("repr", "str", "tags", "clone_same_class", "clone_is_idempotent", "doc"):
        getattr(common, f"check_{name}")(model.clone())
    for name in (
        "learn_one",
        "shuffle_features_no_impact",
        "predict_one_pure",
        "predict_one_before_any_learn",
        "bounded_memory_growth",
    ):
        getattr(common, f"check_{name}")(model.clone(), data)
    assert model.clone().estimate is None
