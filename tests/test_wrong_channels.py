"""`python -m benchmarks first-hour --wrong`: each table with a wrong channel has it named."""

import tomllib

import numpy as np
import pytest

from benchmarks.first_hour import FOLDER, TABLES
from benchmarks.wrong_channels import FAULTS, SCALE, Fault, first_named, with_fault, wrong_channels
from livepde.verdict import Cause, Finding, Verdict

HEADER = ["t", "a", "b", "switch"]
COLUMNS = {name: name for name in HEADER[1:]}
T = np.arange(20.0)
TABLE = np.column_stack([T, 10.0 + T, 5.0 * T, T])


def changed(kind: str, *channels: str, samples: float = 0.0) -> np.ndarray:
    return with_fault(Fault("any", channels, kind, samples), HEADER, TABLE, COLUMNS)


def test_each_fault_changes_its_channels_alone() -> None:
    np.testing.assert_array_equal(changed("scaled", "a")[:, 1], SCALE * TABLE[:, 1])
    np.testing.assert_array_equal(changed("fahrenheit", "a")[:, 1], 1.8 * TABLE[:, 1] + 32.0)
    np.testing.assert_array_equal(changed("exchanged", "a", "b")[:, [1, 2]], TABLE[:, [2, 1]])
    late = changed("late", "a", samples=3.0)
    np.testing.assert_array_equal(late[3:, 1], TABLE[:-3, 1])
    for kind in ("scaled", "fahrenheit", "late"):
        found = changed(kind, "a", samples=2.0)
        np.testing.assert_array_equal(found[:, [0, 2, 3]], TABLE[:, [0, 2, 3]])


def test_a_value_that_is_written_at_changes_is_late_as_it_holds() -> None:
    table = TABLE.copy()
    table[:, 2] = np.nan
    table[[0, 10], 2] = 1.0, 2.0
    found = with_fault(Fault("any", ("b",), "late", 4.0), HEADER, table, COLUMNS)
    assert found[:, 2].tolist() == [1.0] * 14 + [2.0] * 6


def test_each_fault_is_of_channels_that_the_case_has() -> None:
    for fault in FAULTS:
        assert fault.walk in TABLES
        case = tomllib.loads((FOLDER / f"{fault.walk}.toml").read_text(encoding="utf-8"))
        assert set(fault.channels) <= set(case["channels"])


def test_the_channel_of_the_first_cause_counts() -> None:
    causes = (Cause("lag", "T_1", "late", 0.9), Cause("offset", "T_2", "high", 0.1))
    note = Finding("noise", "note", "The readings scatter.")
    misfit = Finding("misfit", "do not trust", "No.", causes=causes)
    assert first_named(Verdict.of((note, misfit), ())) == "T_1"
    assert first_named(Verdict.of((note,), ())) == ""


@pytest.mark.long
def test_a_wrong_scale_is_not_trusted() -> None:
    (fault,) = (fault for fault in FAULTS if fault.walk == "column")
    outcome = wrong_channels([fault], seeds=1)
    trusted, _ = outcome.checks
    assert trusted.ok
