"""Excessive cases are refused with one sentence before they use time or memory."""

import subprocess
import sys

import pytest
from patience import PATIENCE

import livepde as lp
from benchmarks.faults.hostile import HOSTILE, hostile_case
from livepde import cases
from livepde.cases.case_content import CELLS
from livepde.streams.clock import Clock, number_of
from livepde.streams.csvfile import read_csv
from livepde.streams.table import Column
from livepde.units import check_unit, conversion, in_si


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_case_is_one_sentence(tmp_path, name):
    path = hostile_case(tmp_path, name)
    with pytest.raises(lp.errors.CaseError) as caught:
        cases.load(path)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 1000
    assert str(path) in text


def test_the_case_that_is_made_hostile_is_right(tmp_path):
    assert cases.load(hostile_case(tmp_path, "")).title


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_hostile_cases_need_little_memory(tmp_path):
    """The peak is that of the program itself: `ru_maxrss` holds that of who has started it, too."""
    paths = [str(hostile_case(tmp_path, name)) for name in HOSTILE]
    code = (
        "import sys\n"
        "from livepde import cases\n"
        "from livepde.errors import CaseError\n"
        "cases.load(sys.argv[1])\n"
        "for path in sys.argv[2:]:\n"
        "    try:\n"
        "        cases.load(path)\n"
        "    except CaseError:\n"
        "        pass\n"
        "rows = open('/proc/self/status').read().splitlines()\n"
        "print(*(row.split()[1] for row in rows if row.startswith('VmHWM')))\n"
    )
    right = str(hostile_case(tmp_path, ""))
    found = subprocess.run(
        [sys.executable, "-c", code, right, *paths],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert found.returncode == 0, found.stderr
    assert 1024 * int(found.stdout) < 500e6


@pytest.mark.parametrize(
    "unit",
    ["m^9^9^9^9", "9**9**9 m", "(m^2)^9", "((m^9)^9)^9", "m^1000", "m" * 101, "1" * 10 + " m"],
)
def test_units_that_are_none(unit):
    with pytest.raises(lp.errors.CaseError):
        check_unit(unit, "here")
    with pytest.raises(lp.errors.CaseError):
        conversion(unit, "m", "here")
    assert in_si(unit) is None


@pytest.mark.parametrize("unit", ["(m^2/s)/(d)**0.5", "W/(m^2*K)", "kg*m^2*s^-2"])
def test_units_that_are_some(unit):
    check_unit(unit, "here")
    assert conversion(unit, unit, "here").factor == 1.0
    assert conversion(f"({unit})", unit, "here").factor == pytest.approx(1.0)


def test_the_largest_mesh_is_no_hostile_one(tmp_path):
    assert CELLS >= 1_000_000  # what the benchmark of scale takes


# --- small things --------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["1_000", "1_0.5", "_1", "1e1_0"])
def test_digits_with_a_line_between_them_are_no_number(tmp_path, cell):
    assert number_of(cell) is None
    (tmp_path / "a.csv").write_text(f"t,a\n0,1\n1,{cell}\n")
    with pytest.raises(lp.errors.SampleError, match="expected a number"):
        read_csv(tmp_path / "a.csv", {"a": Column(("a",))}, Clock("t"))


def test_a_file_that_is_no_data_is_not_shown(tmp_path):
    for name, shown in (("shadow", False), ("data.csv", True)):
        (tmp_path / name).write_text("root:secret,b\n1,2\n")
        with pytest.raises(lp.errors.SampleError, match="there is no column 't'") as caught:
            read_csv(tmp_path / name, {"a": Column(("b",))}, Clock("t"))
        assert ("secret" in str(caught.value)) == shown
