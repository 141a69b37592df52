"""Possible causes of a rejected sensor, and the variants that test them."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.first_hour import FOLDER, TABLES, save
from benchmarks.wrong_channels import Fault, with_fault
from livepde.cases.case import load
from livepde.cases.proposals import proposed
from livepde.cases.set_aside import _Sensor
from livepde.cases.variants import AS_STATED, Variant, run_variant
from livepde.verdict import Verdict

T = np.arange(200.0)
Y = 20.0 + 5.0 * np.sin(T / 20.0)
WRONG = {
    "offset": Y + 8.0,
    "gain": 1.3 * Y,
    "lag": np.interp(T - 9.0, T, Y),
    "unit": 1.8 * Y + 32.0,
    "": np.full(200, 85.0) + 0.01 * np.sin(7.0 * T),  # broken: it follows nothing
}


@pytest.mark.parametrize("kind", WRONG)
def test_the_error_that_explains_the_readings_comes_first(kind: str) -> None:
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(T))
    found = list(_Sensor("T", T, WRONG[kind] + noise, Y).errors("degC"))
    share, error = max(found, key=lambda one: one[0])
    assert (share > 0.9) == bool(kind)
    assert not kind or error.kind == kind
    if kind == "lag":
        assert error.size == pytest.approx(9.0)


@pytest.mark.long
def test_compare_proposes_errors_of_a_sensor_that_is_set_aside(tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "walk")
    path = tmp_path / "walk" / "heater.toml"
    columns = {name: str(item.column) for name, item in load(path).spec.channels.items()}
    header, table, _ = TABLES["heater"](1)
    fault = Fault("heater", ("T_10",), "fahrenheit")
    save(path.with_suffix(".csv"), header, with_fault(fault, header, table, columns)[:120])
    base = run_variant(path, (), Variant(AS_STATED))
    (finding,) = (one for one in Verdict.from_dict(base.verdict).findings if one.what == "aside")
    assert "T_10 may be in degF instead of degC" in finding.sentence
    names = [variant.name for variant in proposed(load(path).prepare(), base)]
    own = [name for name in names if name.endswith(" T_10")]
    assert own[0] == "unit of T_10"
    assert {"gain of T_10", "offset of T_10", "position of T_10", "without T_10"} <= set(own)
