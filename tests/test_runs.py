"""The loop of a run, its directory, and its measures and reports."""

import json
import math
import re
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest
from commands import call

import livepde as lp
from livepde import runs
from livepde.models import heat
from livepde.result import Result
from livepde.runs import Check, RunWriter, Table, checks_of, drive, measures, tables, verdict
from livepde.runs.directory import attempted, markdown, plain
from livepde.runs.summary import digits

TIMES = range(6)


def identifier(unknown=None, validation=True):
    mesh = lp.interval(0.0, 1.0, 8)
    model = heat(
        mesh, unknown or lp.Scalar(lp.Normal(0.1, 0.05), unit="m^2/s"), {"left": lp.Channel("T0")}
    )
    return lp.Identifier(
        model,
        lp.Points({"a": 0.25}, noise=0.1, unit="degC"),
        lp.SensitivityLaw(modes=3),
        validation=lp.Points({"b": 0.5}) if validation else None,
    )


def samples(**extra):
    return [lp.Sample(t, {"T0": 1.0, "a": 0.1 * t, **extra}) for t in TIMES]


@pytest.fixture
def driven():
    return drive(identifier(), samples(b=0.0))


def written(path, driven, **options):
    writer = RunWriter.create(path, version="1", command=["livepde"], title="A run", **options)
    data = driven.result.to_xarray()
    shown = tables(data)
    checks = [Check("a", 1.0, 2.0, "<="), Check("b", np.nan, (0.0, 1.0), "in")]
    writer.finish(
        status=driven.status, dataset=data, shown=shown, checks=checks, notes=["so it is"]
    )
    return data


# --- outcome ---------------------------------------------------------------------------------


def test_checks_compare_values_with_bounds():
    assert Check("a", 1.0, 1.0, "<=").ok
    assert Check("a", 1.0, 1.0, ">=").ok
    assert Check("a", 1.0, (0.0, 1.0), "in").ok
    assert not Check("a", np.nan, 1.0, "<=").ok
    assert Check("a", 1, (0, 2), "in").to_dict() == {
        "name": "a", "value": 1, "bound": [0, 2], "sense": "in", "ok": True,
    }  # fmt: skip
    with pytest.raises(lp.errors.ConfigurationError, match="sense"):
        Check("a", 1.0, 1.0, "<")  # type: ignore[arg-type]
    with pytest.raises(lp.errors.ConfigurationError, match="a pair"):
        Check("a", 1.0, 1.0, "in")
    with pytest.raises(lp.errors.ConfigurationError, match="one number"):
        Check("a", 1.0, (0.0, 1.0), "<=")


# --- loop ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_drive_keeps_earlier_results_when_a_sample_is_invalid():
    stream = [*samples(), lp.Sample(2.0, {"T0": 1.0, "a": 0.0})]
    driven = drive(identifier(), stream, progress=True)
    assert driven.status == "failed"
    assert isinstance(driven.error, lp.errors.TimeOrderError)
    assert len(driven.result) == len(TIMES)


@pytest.mark.slow
def test_interrupt_ends_between_samples():
    """Ctrl-C within a step ends the run after that step, Ctrl-C while waiting immediately."""

    class Slow(lp.Identifier):
        def step(self, t, z, inputs=None):
            if t == 3:
                signal.raise_signal(signal.SIGINT)
            return super().step(t, z, inputs)

    one = identifier()
    one.__class__ = Slow
    before = signal.getsignal(signal.SIGINT)
    driven = drive(one, samples())
    assert (driven.status, len(driven.result)) == ("interrupted", 4)
    assert signal.getsignal(signal.SIGINT) is before

    def waiting():
        yield from samples()[:2]
        signal.raise_signal(signal.SIGINT)

    driven = drive(identifier(), waiting())
    assert (driven.status, len(driven.result)) == ("interrupted", 2)


@pytest.mark.slow
def test_drive_outside_of_the_main_thread():
    from threading import Thread

    found = []
    thread = Thread(target=lambda: found.append(drive(identifier(), samples())))
    thread.start()
    thread.join()
    assert found[0].status == "finished"


# --- directory -------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_is_read_back_unchanged(tmp_path, driven):
    data = written(tmp_path / "run", driven, case="title = 'x'\n")
    run = runs.open(tmp_path / "run")
    assert run.status == "finished"
    assert run.title == "A run"
    assert run.notes == ["so it is"]
    assert [check.ok for check in run.checks] == [True, False]
    assert (tmp_path / "run" / "case.toml").read_text() == "title = 'x'\n"
    assert run.record["samples"] == len(TIMES)
    assert len(run.record["case_sha256"]) == 64
    for name in data.variables:
        assert repr(run.dataset[name].values.tolist()) == repr(data[name].values.tolist())
    assert run.dataset.attrs["scalars"] == data.attrs["scalars"]
    assert run.dataset.alpha.attrs["units"] == "m^2/s"
    first, *others = run.summary()
    assert first.title.startswith(f"Verdict: {verdict(data).level} (")
    assert [table.to_dict() for table in others] == [t.to_dict() for t in tables(data)]
    assert "| alpha |" in (tmp_path / "run" / "report.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("field", [True, False])
def test_fields_and_runs_without_validation_channels(tmp_path, field):
    one = identifier(validation=False)
    if field:
        mesh = lp.interval(0.0, 1.0, 8)
        from livepde.models import EQUATIONS

        unknown = lp.Field(
            mesh, EQUATIONS["heat"].element(mesh), inner="H1", prior=lp.Normal(0.1, std=0.05)
        )
        model = heat(mesh, unknown, {"left": lp.Channel("T0")})
        one = lp.Identifier(model, lp.Points({"a": 0.25}, noise=0.1), lp.SensitivityLaw(modes=3))
    data = written(tmp_path / "run", drive(one, samples()))
    back = runs.open(tmp_path / "run").dataset
    assert np.array_equal(back.u.values, data.u.values)
    titles = [table.title for table in tables(back)]
    assert ("Estimated fields" in titles) == field


def test_a_run_without_samples(tmp_path):
    written(tmp_path / "run", drive(identifier(), []))
    assert runs.open(tmp_path / "run").dataset.sizes["time"] == 0


@pytest.mark.slow
def test_an_existing_run_is_not_overwritten(tmp_path, driven):
    written(tmp_path / "run", driven)
    before = (tmp_path / "run" / "run.json").read_text()
    with pytest.raises(lp.errors.RunError, match="already contains a run"):
        written(tmp_path / "run", driven)
    assert (tmp_path / "run" / "run.json").read_text() == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("mine")
    with pytest.raises(lp.errors.RunError, match="is not empty"):
        written(tmp_path / "other", driven)
    with pytest.raises(lp.errors.RunError, match="is a file"):
        written(tmp_path / "other" / "notes.txt", driven)
    with pytest.raises(lp.errors.RunError, match="cannot be created"):
        written(tmp_path / "other" / "notes.txt" / "run", driven)
    (tmp_path / "empty").mkdir()
    written(tmp_path / "empty", driven)


def test_free_path(tmp_path):
    assert runs.free_path(tmp_path / "demo").name == "demo"
    (tmp_path / "demo").mkdir()
    assert runs.free_path(tmp_path / "demo").name == "demo-2"
    (tmp_path / "demo-2").mkdir()
    assert runs.free_path(tmp_path / "demo").name == "demo-3"


@pytest.mark.slow
def test_a_deleted_run_directory_is_reported(tmp_path, driven):
    writer = RunWriter.create(tmp_path / "run", version="1", command=[], title="")
    (tmp_path / "run" / "run.json").unlink()
    (tmp_path / "run").rmdir()
    with pytest.raises(lp.errors.RunError, match="cannot be written"):
        writer.finish(status="finished", dataset=driven.result.to_xarray())


@pytest.mark.slow
def test_checkpoint_continues(tmp_path):
    first = identifier()
    whole = identifier()
    drive(first, samples()[:3])
    writer = RunWriter.create(tmp_path / "run", version="1", command=[], title="")
    writer.finish(status="finished", identifier=first)
    second = identifier()
    second.load(tmp_path / "run" / "checkpoint.bin")
    drive(second, samples()[3:])
    drive(whole, samples())
    assert np.array_equal(second.estimate().q, whole.estimate().q)


@pytest.mark.slow
def test_runs_that_cannot_be_opened(tmp_path, driven):
    with pytest.raises(lp.errors.RunError, match="contains no run"):
        runs.open(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(lp.errors.RunError, match="is damaged"):
        runs.open(tmp_path)
    (tmp_path / "run.json").write_text('{"format": 99}')
    with pytest.raises(lp.errors.RunError, match="not a record of this version"):
        runs.open(tmp_path)
    (tmp_path / "run.json").write_text(json.dumps({"format": 2, "status": "running"}))
    with pytest.raises(
        lp.errors.RunError, match="is damaged: its content has changed since it was written"
    ):
        runs.open(tmp_path)
    RunWriter(tmp_path, {"format": 2, "status": "running"})._save_record()
    run = runs.open(tmp_path)
    assert run.title == tmp_path.name
    assert run.checks == []
    with pytest.raises(lp.errors.RunError, match="contains no estimates; its status is 'running'"):
        _ = run.dataset
    (tmp_path / "estimates.nc").write_text("not netCDF")
    with pytest.raises(lp.errors.RunError, match="is damaged"):
        _ = run.dataset
    for checks in ([{"name": "k"}], {"name": "k"}, 5):
        RunWriter(tmp_path, {"format": 2, "checks": checks})._save_record()
        with pytest.raises(lp.errors.RunError, match=r"run\.json is damaged"):
            _ = runs.open(tmp_path).checks


@pytest.mark.slow
def test_figures_are_drawn(tmp_path, driven):
    pytest.importorskip("matplotlib")
    writer = RunWriter.create(tmp_path / "run", version="1", command=[], title="")
    writer.finish(status="finished", figures={"overview": driven.result.plot})
    assert (tmp_path / "run" / "overview.png").stat().st_size > 1000
    assert "![overview](overview.png)" in (tmp_path / "run" / "report.md").read_text()


def test_a_journal_gives_the_readings_of_channels():
    journal = drive(identifier(), samples(b=0.0)).journal
    t, values = journal.readings(["b", "a", "nowhere"])
    given = [*samples(b=0.0)]
    assert t.tolist() == [item.t for item in given]
    for name, column in zip(("b", "a"), values.T, strict=False):
        assert column.tolist() == [item.z[name] for item in given]
    assert np.isnan(values[:, 2]).all()


# --- numbers ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_measures_and_checks(driven):
    data = driven.result.to_xarray()
    found = measures(data)
    assert found["alpha"] == float(data.alpha[-1])
    assert found["alpha.std"] == float(data.alpha_std[-1])
    both = np.concatenate([data.innovation.values.ravel(), data.validation_error.values.ravel()])
    assert found["rmse"] == pytest.approx(np.sqrt(np.mean(both**2)))
    assert found["rmse.a"] == found["rmse.assimilated"]
    assert found["rmse.b"] == found["rmse.validation"]
    assert found["failed_steps"] == 0
    checks = checks_of({"alpha": (">=", -9.0), "beta": ("<=", 1.0)}, data)
    assert [check.ok for check in checks] == [True, False]


@pytest.mark.slow
def test_scores_begin_with_the_assimilation(driven):
    data = driven.result.to_xarray()
    data.attrs["assimilate_from"] = 3.0
    late = data.innovation.sel(sensor="a")[3:]
    assert measures(data)["rmse.a"] == pytest.approx(float(np.sqrt((late**2).mean())))
    data.attrs["assimilate_from"] = 99.0
    assert np.isnan(measures(data)["rmse"])
    assert any("–" in row for table in tables(data) for row in table.rows)


def test_markdown_and_plain():
    table = Table("T", ("a|b", "n"), [("x|y", 1.23456789)])
    text = markdown("Title", [table], [Check("c", 2.0, (0.0, 1.0), "in")], ["note"], ["f.png"])
    assert "| x\\|y | 1.2346 |" in text
    assert "FAILED" in text
    assert "> note" in text
    assert plain({"a": [np.float64(1.5), np.nan, np.int64(2)], 1: (np.inf,)}) == {
        "a": [1.5, None, 2], "1": [None],
    }  # fmt: skip
    json.dumps(plain({"x": np.float32(0.5)}), allow_nan=False)


# --- results are read back unchanged -------------------------------------------------------------


def flipped(content: bytes, bit: int) -> bytes:
    """Return bytes with one bit changed."""
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.mark.slow
def test_each_bit_of_the_estimates_counts(tmp_path, driven):
    written(tmp_path / "run", driven)
    path = tmp_path / "run" / "estimates.nc"
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for bit in rng.integers(0, 8 * len(whole), 200):
        path.write_bytes(flipped(whole, int(bit)))
        with pytest.raises(
            lp.errors.RunError, match=r"is damaged: its content has changed .* run the case again"
        ):
            _ = runs.open(tmp_path / "run").dataset
    path.write_bytes(whole)
    assert runs.open(tmp_path / "run").dataset.sizes["time"] == len(driven.result)
    (tmp_path / "run" / "journal.sqlite").write_bytes(b"")
    path.write_bytes(flipped(whole, 0))
    with pytest.raises(
        lp.errors.RunError, match="delete it, so that they are read from the journal"
    ):
        _ = runs.open(tmp_path / "run").dataset


@pytest.mark.slow
def test_each_bit_of_the_record_counts(tmp_path, driven):
    """Any changed bit is refused, unless it only changes the layout of the text."""
    written(tmp_path / "run", driven)
    path, rng = tmp_path / "run" / "run.json", np.random.default_rng(0)
    whole, record = path.read_bytes(), runs.open(tmp_path / "run").record
    refused = 0
    for bit in rng.integers(0, 8 * len(whole), 200):
        path.write_bytes(flipped(whole, int(bit)))
        try:
            assert runs.open(tmp_path / "run").record == record
        except lp.errors.RunError:
            refused += 1
    assert refused > 150


@pytest.mark.slow
@pytest.mark.parametrize("when", ["before", "after"])
def test_a_kill_while_estimates_are_replaced_leaves_a_whole_run(
    tmp_path, driven, monkeypatch, when
):
    """The run has either the previous or the new file."""
    written(tmp_path / "run", driven)
    data = driven.result.to_xarray().isel(time=slice(3))
    replace = Path.replace

    def killed(self, target):
        if Path(target).name == "estimates.nc":
            if when == "after":
                replace(self, target)
            raise KeyboardInterrupt
        return replace(self, target)

    writer = RunWriter(tmp_path / "run", dict(runs.open(tmp_path / "run").record))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            writer.finish(status="finished", dataset=data)
    expected = 3 if when == "after" else len(driven.result)
    assert runs.open(tmp_path / "run").dataset.sizes["time"] == expected


def test_a_copy_of_a_case_that_was_changed_is_not_run(tmp_path):
    RunWriter.create(tmp_path / "run", version="1", command=[], title="", case="a = 1\n")
    assert runs.open(tmp_path / "run").case_file() == tmp_path / "run" / "case.toml"
    (tmp_path / "run" / "case.toml").write_text("a = 2\n")
    with pytest.raises(lp.errors.RunError, match="is not the case that was run"):
        runs.open(tmp_path / "run").case_file()


@pytest.mark.parametrize(
    ("text", "settings", "same"),
    [
        ('[intake]\nshift = "60 s"\nwait = 1\n', [], True),
        ("[intake]\nwait = 1\n", ["intake.shift=60 s"], True),
        ("[intake]\nwait = 2\n", [], False),
        ("[intake]\nwait = 1\n", ["intake.wait=1"], False),
        ("[intake\n", [], False),
    ],
)
def test_a_run_resumes_with_a_new_correction_of_its_clock(tmp_path, text, settings, same):
    folder, case = tmp_path / "run", "[intake]\nwait = 1\n"
    RunWriter.create(folder, version="1", command=[], title="", case=case)
    (folder / "journal.sqlite").write_bytes(b"")
    again = {"version": "2", "command": [], "case": text, "settings": settings, "original": case}
    if not same:
        with pytest.raises(lp.errors.RunError, match="another case or other settings"):
            RunWriter.reopen(folder, **again)
        return
    RunWriter.reopen(folder, **again)
    opened = runs.open(folder)
    assert opened.settings == settings
    assert opened.case_file().read_text() == text
    assert "intake.shift" in opened.record["resumed"][0]


# --- the end of a run ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_figure_that_cannot_be_drawn_is_a_note(tmp_path, driven):
    def broken():
        raise ValueError("Axis limits cannot be NaN or Inf\nand more")

    def order():
        seen.append(sorted(item.name for item in (tmp_path / "run").iterdir()))
        return broken()

    seen = []
    writer = RunWriter.create(tmp_path / "run", version="1", command=[], title="A run")
    data = driven.result.to_xarray()
    writer.finish(status="finished", dataset=data, notes=["mine"], figures={"overview": order})
    assert seen == [["estimates.nc", "report.md", "run.json"]]  # everything else is written before
    run = runs.open(tmp_path / "run")
    assert run.status == "finished"
    assert run.notes[0] == "mine"
    assert run.notes[1].startswith("The figure 'overview' failed (ValueError: Axis limits")
    assert run.dataset.sizes == data.sizes
    report = (tmp_path / "run" / "report.md").read_text()
    assert "The figure 'overview' failed" in report
    assert "![" not in report


def test_a_write_error_is_not_a_failed_diagnostic():
    def full():
        raise OSError("no room")

    notes: list[str] = []
    with pytest.raises(OSError, match="no room"):
        attempted("The tables", full, None, notes)
    assert attempted("The tables", lambda: 1 // 0, 7, notes) == 7
    assert notes == [
        "The tables failed (ZeroDivisionError: integer division or modulo by zero); "
        "everything else is complete."
    ]


@pytest.mark.parametrize(
    ("value", "std", "shown"),
    [
        (1234.5, 67.0, ("1234", "67")),
        (0.0, 0.5, ("0.00", "0.50")),
        (1e-300, 1e300, ("1e-300", "1e+300")),
        (1e300, 1e-300, ("1e+300", "1e-300")),
        (5.0, 5e-324, ("5", "4.9e-324")),
        (5.0, 1e30, ("5", "1e+30")),
        (1.5e308, 1e308, ("1.5e+308", "1.0e+308")),
        (math.inf, 1.0, ("inf", "–")),
    ],
)
def test_numbers_of_any_size_have_digits(value, std, shown):
    assert digits(value, std) == shown


@pytest.mark.slow
def test_a_report_with_numbers_that_overflow_is_written(tmp_path, driven):
    """Notes replace tables, figures and page parts that no axis can show, without a crash."""
    data = driven.result.to_xarray().copy(deep=True)
    label = data.attrs["scalars"].split("\n")[0]
    for k, value in ((2, 1e308), (3, -1e308), (-1, 1e300)):
        data[label].values[k] = value
        data[f"{label}_std"].values[k] = 1e308
        data["innovation"].values[k] = 1e308
    folder = tmp_path / "run"
    RunWriter.create(folder, version="1", command=[], title="A run").finish(
        status="finished", dataset=data
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy and Matplotlib warn about overflows
        code, output = call("report", folder)
    assert code == 0
    assert "A run" in output


@pytest.mark.slow
def test_the_last_fields_that_cannot_be_computed_are_an_event(tmp_path, monkeypatch):
    """The run still ends with its data, checkpoint and status."""

    usual = Result._snapshot

    def broken(self, estimate):
        if estimate.t == TIMES[-1]:
            raise np.linalg.LinAlgError("SVD did not converge")
        return usual(self, estimate)

    monkeypatch.setattr(Result, "_snapshot", broken)
    driven = drive(identifier(), samples(b=0.0), fields_every=10**9)
    assert driven.status == "finished"
    assert len(driven.journal) == len(TIMES)
    (event,) = driven.journal.events
    assert event.kind == "unfinished"
    assert "SVD did not converge" in event.message


def test_a_report_escapes_html_in_titles_and_notes():
    text = markdown(
        "<script>alert(1)</script>",
        [Table("<b>T</b>", ("a<br>",), [("<img src=x>", 1.0)])],
        [Check("<i>", 1.0, 2.0, "<=")],
        ["<!-- hidden", "a < b"],
    )
    assert not re.search("<[A-Za-z/!?]", text)
    assert "&lt;script>" in text
    assert "a < b" in text
    assert "| <= |" in text
