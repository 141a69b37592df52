"""First lines of a new user of pandas and xarray, written without our documentation."""

import pickle
from functools import cache

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from factories import filter_alone

import livepde as lp
from livepde.models import borehole, fluid, heat

TRUE = 0.07  # diffusivity of the rod
NOISE = 0.05  # standard deviation of its sensors, K
START = "2025-03-01 12:00"


@cache
def rod() -> lp.Model:
    """Return a rod with one measured end."""
    ends = {"left": lp.Channel("T_left"), "right": 0.0}
    alpha = lp.Scalar(lp.LogNormal(0.1, std=0.05), unit="m^2/s")
    return heat(lp.interval(0.0, 1.0, 20), alpha, ends)


def identifier(**options) -> lp.Identifier:
    sensors = lp.Points({"T_30": 0.3, "T_60": 0.6}, noise=NOISE, unit="degC")
    return lp.Identifier(rod(), sensors, **{"law": filter_alone(), "u0": 0.0, **options})


@cache
def measured() -> pd.DataFrame:
    """Return a table as from a logger, with seconds and a column that is not a channel."""
    t = 0.125 * np.arange(24)  # also exact as dates

    def ends(when: float) -> dict[str, float]:
        return {"T_left": 20.0 * np.sin(when)}

    control = lp.Advance(lp.Alexander2(), 0.02)
    q = rod().initial_parameter({"alpha": TRUE})
    run = lp.simulate(rod(), q, 0.0, t.tolist(), control, ends)
    values = np.array([(rod().state_block.at_vertices @ u)[[6, 12]] for _, u in run])
    values += NOISE * np.random.default_rng(0).standard_normal(values.shape)
    columns = {"T_left": 20.0 * np.sin(t), "T_30": values[:, 0], "T_60": values[:, 1]}
    return pd.DataFrame({**columns, "battery_V": 3.3}, index=pd.Index(t, name="time"))


def dated(**index) -> pd.DataFrame:
    """Return the table of `measured` with dates as its index."""
    dates = pd.date_range(START, periods=len(measured()), freq="125ms", **index)
    return measured().set_axis(dates)


@cache
def known() -> lp.Result:
    """Return the run of the samples as tuples, without a table reader."""
    rows = measured()[["T_left", "T_30", "T_60"]].to_dict("index")
    return identifier().run(rows.items())


def same(result: lp.Result, rtol: float = 1e-12, to: lp.Result | None = None) -> bool:
    """Return whether a run has the results of the run of tuples, or of another run."""
    found, expected = (one.last.parameters["alpha"] for one in (result, to or known()))
    return len(result) == len(known()) and np.allclose(found, expected, rtol=rtol)


LINES = """
sensors = lp.Points({"T_30": 0.3, "T_60": 0.6}, noise=0.05, unit="degC")
identifier = lp.Identifier(model, sensors, u0=0.0)
df = pd.read_csv("rod.csv", parse_dates=["time"]).set_index("time")
result = identifier.run(df)
result = lp.Identifier(model, sensors, u0=0.0).run("rod.csv")
result = lp.Identifier(model, sensors, u0=0.0).run(df.to_xarray())
result = lp.Identifier(model, sensors, u0=0.0).run(df.reset_index())
result = lp.Identifier(model, sensors, u0=0.0).run(df.tz_localize("Europe/Berlin"))
result = lp.Identifier(model, sensors, u0=0.0).run(df.iterrows())
online = lp.Identifier(model, sensors, u0=0.0)
estimates = [online.step(t, row) for t, row in df.iterrows()]
print(model, online, estimates[-1], result)
print(result.summary().loc["alpha", ["value", "low", "high"]])
print(result.to_dataframe()["alpha"].resample("1s").last())
print(result.to_xarray()["estimates"].sel(parameter="alpha", statistic="std").max())
print(result.covariance(), result.correlation(), result.log_evidence)
print(result.residuals.describe(), result.predicted["T_30"].max())
print(result.sample(100)["alpha"].quantile([0.05, 0.95]))
print(pickle.loads(pickle.dumps(result.last)))
forecast = online.forecast(df.index[-1:] + pd.Timedelta("1s"), {"T_left": 5.0})["T_30"]
ax = result.plot.estimates("alpha")
ax.figure.savefig("alpha.png")
"""


@pytest.mark.slow
def test_the_first_lines_of_a_pandas_user_work(here, capsys):
    pytest.importorskip("matplotlib")
    dated().rename_axis("time").to_csv("rod.csv")
    names = {"lp": lp, "pd": pd, "pickle": pickle, "model": rod()}
    expected = identifier(law=lp.SensitivityLaw()).run(measured())
    for line in LINES.strip().splitlines():
        exec(line, names)
        if line.startswith("result = "):
            assert same(names["result"], to=expected), line
    assert names["estimates"][-1].t == dated().index.size * 0.125 - 0.125
    assert capsys.readouterr().out.count("alpha") > 5


# --- data in -------------------------------------------------------------------------------------


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_a_table_of_dates(zone):
    who = identifier()
    assert same(who.run(dated(tz=zone)))
    assert pd.Timestamp(who.origin, tz="UTC") == pd.Timestamp(START, tz=zone or "UTC")


def test_a_date_of_another_unit_of_time():
    ends = {"left": lp.Channel("T_left"), "right": 0.0}
    mesh, prior = lp.interval(0.0, 1.0, 20), lp.LogNormal(0.1, std=0.05)

    def conduction(q, u, v, x):
        return q.alpha * lp.dot(lp.grad(u), lp.grad(v))

    state = lp.Field(mesh, lp.linear(mesh), dirichlet=ends)
    hours = lp.Model(state, {"alpha": prior}, A=conduction, time_unit="h")
    sensors = lp.Points({"T_30": 0.3, "T_60": 0.6}, noise=NOISE)
    table = measured().set_axis(pd.date_range(START, periods=len(measured()), freq="450s"))
    assert same(lp.Identifier(hours, sensors, filter_alone(), u0=0.0).run(table))
    unitless = lp.Identifier(lp.Model(state, {"alpha": prior}, A=conduction), sensors, u0=0.0)
    with pytest.raises(lp.errors.ConfigurationError, match=r"dates, and the model has no unit"):
        unitless.run(table)
    with pytest.raises(lp.errors.ConfigurationError, match=r"date, and the model has no unit"):
        unitless.step(table.index[0], table.iloc[0])


def test_durations_and_units_of_time():
    durations = measured().set_axis(pd.to_timedelta(measured().index, unit="s"))
    assert same(identifier().run(durations))
    minutes = measured().set_axis(measured().index / 60.0)
    assert same(identifier().run(minutes, time_unit="min"))


def test_a_column_of_times_and_other_names():
    table = measured().reset_index(names="time_s").rename(columns={"T_30": "TS_3_2_1"})
    assert same(identifier().run(table, columns={"T_30": "TS_3_2_1"}))
    table = table.rename(columns={"time_s": "when", "TS_3_2_1": "T_30"})
    assert same(identifier().run(table, time="when"))
    with pytest.raises(lp.errors.SampleError, match="the index only counts the rows"):
        identifier().run(table)
    with pytest.raises(lp.errors.SampleError, match=r"'time_1' and 'time_2' may be the column"):
        identifier().run(table.assign(time_1=0.0, time_2=0.0))


def test_units_of_columns():
    table = measured().assign(T_30=1.8 * measured()["T_30"] + 32.0)
    assert same(identifier().run(table, units={"T_30": "degF"}), rtol=1e-9)
    table = measured().assign(T_left=1.8 * measured()["T_left"] + 32.0)
    assert same(identifier().run(table, units={"T_left": "degF"}), rtol=1e-9)


def test_units_of_a_dataset_are_those_of_all_its_temperatures():
    """The unit of a boundary value was once ignored: it was wrong by 273 K, sensors were right."""
    kelvin = measured()[["T_30", "T_60", "T_left"]] + 273.15
    data = kelvin.assign(**{"noise of T_30": NOISE}).to_xarray()
    for name in kelvin:
        data[name].attrs["units"] = "K"
    assert same(identifier().run(data), rtol=1e-9)
    data["T_30"] = (1.8 * data["T_30"] - 459.67).assign_attrs(units="degF")
    data["noise of T_30"].attrs["units"] = "K"
    assert same(identifier().run(data), rtol=1e-9)


def test_units_of_inputs_are_converted_like_those_of_sensors():
    """The power of a dataset in kW was once read as W."""
    wall, hours = 0.07, np.linspace(0.0, 10.0, 11)
    mesh = lp.interval(wall, 5.0, 12, geometric=True)
    k, resistance = lp.LogNormal(2.0, std=0.5), lp.LogNormal(0.1, std=0.03)
    model = borehole(mesh, k, resistance, H=100.0, rho_c=2e6, T0=10.0)
    table = pd.DataFrame({"T": 10.0 + 2.0 * np.sqrt(hours), "Q": 5000.0}, index=3600.0 * hours)

    def ends(data, **how):
        sensors = lp.Points({"T": wall}, direct={"T": fluid(100.0)}, noise=0.1, unit="degC")
        who = lp.Identifier(model, sensors, filter_alone(), u0=10.0)
        return who.run(data, **how).summary()["value"].to_numpy()

    data = table.assign(Q=5.0).to_xarray()
    data["Q"].attrs["units"] = "kW"
    assert ends(data) == pytest.approx(ends(table), rel=1e-12)
    assert ends(table.assign(Q=5.0), units={"Q": "kW"}) == pytest.approx(ends(table), rel=1e-12)
    data["Q"].attrs["units"] = "m"
    with pytest.raises(lp.errors.ConfigurationError, match="units of 'Q'"):
        ends(data)


def test_a_column_that_is_no_channel_is_ignored_unless_strict():
    with pytest.raises(lp.errors.SampleError, match="column 'battery_V' is not a channel"):
        identifier().run(measured(), strict=True)
    assert same(identifier().run(measured().drop(columns="battery_V"), strict=True))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda table: table.rename(columns={"T_30": "T30"}), "no column 'T_30'; did you mean"),
        (lambda table: table.assign(T_30="warm"), "column 'T_30' must contain numbers only"),
        (lambda table: table.iloc[::-1], "the time is earlier than the one before"),
        (lambda table: table.iloc[:0], "contains no samples"),
        (lambda table: table[["T_30", "T_30", "T_60", "T_left"]], "two columns are called 'T_30'"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_sentence(wrong, message):
    who = identifier()
    with pytest.raises(lp.errors.DataError, match=message):
        who.run(wrong(measured()))
    assert same(who.run(measured()))  # the refused tables changed nothing


def test_invalid_options_of_a_table_are_refused():
    with pytest.raises(lp.errors.ConfigurationError, match="columns: there is no channel 'T_3'"):
        identifier().run(measured(), columns={"T_3": "T_30"})
    with pytest.raises(lp.errors.ConfigurationError, match="strict describes a table or a file"):
        identifier().run([], strict=True)
    with pytest.raises(TypeError, match="colums"):
        identifier().run(measured(), colums={})


def test_missing_values_of_pandas():
    table = measured().copy()
    table.iloc[5, 1] = np.nan
    nullable = table.convert_dtypes()
    assert str(nullable["T_30"].dtype) == "Float64"
    found, expected = (identifier().run(one).last.parameters for one in (nullable, table))
    assert found == expected
    assert found != known().last.parameters


@pytest.mark.slow
def test_the_noise_of_readings_has_the_unit_of_the_column():
    table = measured().drop(columns="battery_V")
    noise = np.where(np.arange(len(table)) % 2, 0.02, 0.3)
    plain = identifier().run(table.assign(**{"noise of T_30": noise}))
    other = table.assign(T_30=1.8 * table["T_30"] + 32.0, **{"noise of T_30": 1.8 * noise})
    found = identifier().run(other, units={"T_30": "degF"})
    (one, std), (two, deviation) = (r.last.parameters["alpha"] for r in (plain, found))
    assert (two, deviation) == pytest.approx((one, std), rel=1e-9)


@pytest.mark.slow
def test_an_xarray_dataset_with_units():
    data = xr.Dataset.from_dataframe(measured())
    assert same(identifier().run(data))
    data = data.assign(T_30=1.8 * data["T_30"] + 32.0)
    data["T_30"].attrs["units"] = "degF"
    data = data.assign_coords(time=data["time"] / 60.0)
    data["time"].attrs["units"] = "min"
    assert same(identifier().run(data), rtol=1e-9)
    assert same(identifier().run(xr.Dataset.from_dataframe(dated().rename_axis("t"))))
    with pytest.raises(lp.errors.SampleError, match="no column 'T_30'"):
        identifier().run(data.drop_vars("T_30"))
    with pytest.raises(lp.errors.SampleError, match=r"the dimensions \['depth', 'time'\]"):
        identifier().run(data.assign(T_30=data["T_30"].expand_dims("depth")))


@pytest.mark.slow
def test_files_are_read_like_their_tables(tmp_path):
    measured().to_csv(tmp_path / "numbers.csv")
    dated().to_csv(tmp_path / "dates.csv")
    measured().to_csv(tmp_path / "german.csv", sep=";", decimal=",")
    measured().reset_index().to_json(tmp_path / "rows.jsonl", orient="records", lines=True)
    for name, rtol in {"numbers.csv": 1e-12, "dates.csv": 1e-12, "german.csv": 1e-12}.items():
        assert same(identifier().run(tmp_path / name), rtol), name
    assert same(identifier().run(str(tmp_path / "rows.jsonl")), 1e-6)
    with pytest.raises(lp.errors.DataError, match=r"no file .*number.csv'; did you mean"):
        identifier().run(tmp_path / "number.csv")
    with pytest.raises(lp.errors.SampleError, match="'battery_V' is not a channel"):
        identifier().run(tmp_path / "rows.jsonl", strict=True)


@pytest.mark.slow
def test_parquet(tmp_path):
    pytest.importorskip("pyarrow")
    measured().to_parquet(tmp_path / "numbers.parquet")
    dated().to_parquet(tmp_path / "dates.parquet")
    assert same(identifier().run(tmp_path / "numbers.parquet"))
    assert same(identifier().run(tmp_path / "dates.parquet"))
    (tmp_path / "wrong.parquet").write_text("no")
    with pytest.raises(lp.errors.DataError, match="cannot be read as a Parquet file"):
        identifier().run(tmp_path / "wrong.parquet")


@pytest.mark.slow
def test_rows_one_by_one():
    channels = dated().drop(columns="battery_V")
    who, other = identifier(), identifier()
    for time, row in channels.iterrows():
        found = who.step(time, row)
        assert found.parameters == other.step(time.to_datetime64(), row.to_dict()).parameters
    assert who.origin == pd.Timestamp(START)
    later = pd.date_range(channels.index[-1] + pd.Timedelta("125ms"), periods=2, freq="125ms")
    ahead = [who.forecast(times, {"T_left": 1.0})["T_30"] for times in (later, [3.0, 3.125])]
    assert np.array_equal(*ahead)


@pytest.mark.slow
def test_a_row_of_a_table_may_have_other_columns():
    found = [identifier().step(0.0, row) for _, row in measured().iloc[:1].iterrows()]
    assert found[0].parameters == identifier().step(0.0, measured().iloc[0, :3]).parameters
    assert same(identifier().run(dated().iterrows()))
    row = measured().iloc[0]
    for wrong in (row.rename({"T_30": "T30"}), row.to_dict()):  # a mapping has chosen its names
        with pytest.raises(lp.errors.SampleError, match=r"unknown channel '(T30|battery_V)'"):
            identifier().step(0.0, wrong)


@pytest.mark.slow
def test_the_next_table_continues_the_dates():
    who, whole = identifier(), identifier().run(dated()).to_xarray()
    first, second = who.run(dated().iloc[:15]), who.run(dated().iloc[15:])
    times = np.concatenate([one.to_xarray()["time"] for one in (first, second)])
    assert np.allclose(times, whole["time"], atol=1e-6)
    assert second.to_xarray().attrs["origin"] == whole.attrs["origin"] == "2025-03-01 12:00:00"
    with pytest.raises(lp.errors.TimeOrderError):
        who.run(dated())
    numbers = identifier()
    numbers.run(measured())
    with pytest.raises(lp.errors.SampleError, match="those of the samples before are numbers"):
        numbers.run(dated())


@pytest.mark.slow
def test_a_checkpoint_keeps_the_origin(tmp_path):
    who, other = identifier(), identifier()
    who.run(dated().iloc[:15])
    who.save(tmp_path / "state")
    other.load(tmp_path / "state")
    rest = dated().iloc[15:]
    assert other.run(rest).last.parameters == who.run(rest).last.parameters
    assert other.origin == who.origin


@pytest.mark.slow
def test_a_smoothed_table_has_its_dates():
    smoothed = identifier().run(dated()).smoothed()
    assert smoothed.attrs["origin"] == "2025-03-01 12:00:00"
    again = identifier().smoothed(dated())
    xr.testing.assert_allclose(again["alpha"], smoothed["alpha"])


# --- results out ---------------------------------------------------------------------------------


@cache
def found() -> lp.Result:
    """Provide the run of a table with dates."""
    again = lp.Points({"T_60 again": 0.6})
    table = dated().assign(**{"T_60 again": dated()["T_60"]})
    return identifier(law=lp.SensitivityLaw(), validation=again).run(table)


@cache
def two() -> lp.Result:
    """Provide a run with a transformed number, a plain number and a field."""
    mesh = lp.interval(0.0, 1.0, 20)
    state = lp.Field(mesh, lp.linear(mesh), dirichlet={"left": lp.Channel("T_left"), "right": 0.0})
    source = lp.Field(mesh, lp.linear(mesh), inner="H1", prior=lp.Normal(0.0, std=1.0))
    model = lp.Model(
        state,
        {"k": lp.LogNormal(0.1, std=0.05), "r": lp.Normal(0.0, std=0.5), "s": source},
        A=lambda q, u, v, x: q.k * lp.dot(lp.grad(u), lp.grad(v)) + q.r * u * v - q.s * v,
        time_unit="s",
    )
    sensors = lp.Points({"T_30": 0.3, "T_60": 0.6}, noise=NOISE)
    return lp.Identifier(model, sensors, lp.SensitivityLaw(modes=3), u0=0.0).run(measured())


@pytest.mark.slow
def test_a_summary_is_a_table():
    summary = found().summary()
    row, alpha = summary.loc["alpha"], found().last["alpha"]
    assert (row["low"], row["high"]) == pytest.approx(alpha.interval())
    assert row["low"] < TRUE < row["high"]
    assert row["unit"] == "m^2/s"
    assert row["level"] == found().verdict.level
    assert list(two().summary().index) == ["k", "r"]
    errors = two().verdict.errors
    assert two().summary().loc["k", "model_high"] == pytest.approx(errors["k"].high)
    assert two().summary().attrs["misfit"] == errors.misfit


def test_the_summary_is_what_a_run_prints():
    from livepde.runs import tables

    printed, summary = tables(two().dataset())[0], two().summary()
    for row, label in zip(printed.rows, ["k", "r"], strict=True):
        low, high = map(float, row[printed.columns.index("95 %")].split(" to "))
        assert np.allclose((low, high), summary.loc[label, ["low", "high"]].tolist(), rtol=0.05)


@pytest.mark.slow
def test_numbers_over_time_are_a_table():
    table = found().to_dataframe()
    assert table.index.equals(dated().index.rename("time").as_unit(table.index.unit))
    assert table["alpha"].iloc[-1] == found().last["alpha"].median
    assert (table["alpha_low"] < table["alpha_high"]).all()
    assert set(table["status"]) == {"ok"}
    assert np.allclose(table["validation_error:T_60 again"], found().residuals["T_60 again"])
    assert (identifier().run(measured()).to_dataframe().index == measured().index).all()


def test_an_xarray_dataset_has_dates_and_a_dimension_of_parameters():
    data = two().to_xarray()
    for label in ("k", "r"):
        ends = data["estimates"].sel(parameter=label).isel(time=-1)
        assert ends.sel(statistic="value") == two().last[label].median
        low_high = ends.sel(statistic=["low", "high"])
        assert np.allclose(low_high, two().last[label].interval(), rtol=1e-5)
        assert f"{label}_low" in data
    assert data["s_low"].dims == data["s"].dims
    dates = found().to_xarray()["date"]
    assert (dates.values == dated().index.values).all()
    assert found().to_xarray()["parameter_unit"].item() == "m^2/s"
    assert all(data.sizes.values())


@pytest.mark.parametrize("engine", ["scipy", "h5netcdf", "netcdf4"])
def test_the_dataset_is_written_and_read_again(engine, tmp_path):
    pytest.importorskip({"netcdf4": "netCDF4"}.get(engine, engine))
    data = found().to_xarray()
    data.to_netcdf(tmp_path / "run.nc", engine=engine)
    with xr.open_dataset(tmp_path / "run.nc", engine=engine) as read:
        assert np.allclose(read["estimates"], data["estimates"])
        assert (read["date"].values == data["date"].values).all()


def test_covariances_are_selected_by_name():
    covariance, correlation = two().covariance(), two().correlation()
    for label in ("k", "r"):
        assert np.sqrt(covariance.loc[label, label]) == pytest.approx(two().last[label].deviation)
        assert correlation.loc[label, label] == pytest.approx(1.0)
    known = two().to_xarray()["correlation"].values
    assert np.allclose(correlation, known)
    assert abs(correlation.loc["k", "r"]) > 0.1


def test_draws_have_the_moments_of_the_estimate():
    drawn, last = two().sample(4000, seed=1), two().last
    k, r = np.log(drawn["k"]), drawn["r"]
    assert float(k.std()) == pytest.approx(last["k"].deviation / last["k"].median, rel=0.05)
    assert float(r.mean()) == pytest.approx(last["r"].mean, abs=0.1 * last["r"].std)
    expected = two().correlation().loc["k", "r"]
    assert np.corrcoef(k, r)[0, 1] == pytest.approx(expected, abs=0.05)
    data = two().to_xarray().isel(snapshot=-1)
    for name in ("s", "u"):
        known = data[f"{name}_std"].values > 1e-6
        spread = drawn[name].std("draw").values[known]
        assert np.allclose(spread, data[f"{name}_std"].values[known], rtol=0.06), name
    assert two().sample(3, seed=1).identical(two().sample(3, seed=1))


def test_a_field_at_points():
    estimate, data = two().last, two().to_xarray().isel(snapshot=-1)
    x = np.array([0.05, 0.3, 0.325])
    for name in ("s", "u"):
        found = estimate[name].at(x)
        std = data[f"{name}_std"].values
        assert np.allclose(found.mean, np.interp(x, data["x"], data[name]))
        assert np.allclose(found.std[:2], std[[1, 6]])
        assert found.std[2] < std[6:8].max() + 1e-12
        low, high = found.interval()
        assert np.allclose((high - low) / 2.0, 1.959964 * found.std)
    drawn = two().sample(4000, seed=1)["u"].values
    at = estimate["u"].at(0.325)  # between two vertices
    assert at.std == pytest.approx(drawn[:, 6:8].mean(axis=1).std(), rel=0.05)
    assert isinstance(at.mean, float)
    with pytest.raises(lp.errors.ObservationError, match=r"point 1 at \[1.5\] lies outside the"):
        estimate["u"].at([0.5, 1.5])
    with pytest.raises(lp.errors.ConfigurationError, match=r"expected numbers, shape \(points,\)"):
        estimate["u"].at([[0.5, 1.5]])
    with pytest.raises(lp.errors.ConfigurationError, match="only a field has values at points"):
        estimate["k"].at(0.5)
    with pytest.raises(lp.errors.ConfigurationError, match=r"no unknown 'D'; there are .*'s', 'u'"):
        estimate["D"]


def test_a_vector_field_and_a_logarithm_at_points():
    from skfem import ElementQuad1, ElementVector

    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4))
    state = lp.Field(mesh, ElementVector(ElementQuad1()))
    k = lp.Field(mesh, lp.linear(mesh), prior=lp.LogNormal(2.0, std=0.2), inner="H1")
    model = lp.Model(state, {"k": k}, A=lambda q, u, v, x: q.k * lp.dot(u, v))
    sensors = lp.Points({"a": (0.25, 0.5)}, component=0, noise=0.1)
    start = lambda x: np.array([1.0 + x[0], 3.0 * x[1]])  # noqa: E731
    estimate = lp.Identifier(model, sensors, u0=start).step(1e-9, [1.25])
    found = estimate["u"].at([(0.25, 0.5), (0.3, 0.9)])
    assert np.allclose(found.mean, [[1.25, 1.5], [1.3, 2.7]])
    assert estimate["u"].at((0.25, 0.5)).std.shape == (2,)
    inside = estimate["k"].at((0.1, 0.2))
    assert inside.median == pytest.approx(2.0)
    assert inside.interval()[0] > 0.0
    with pytest.raises(lp.errors.ObservationError, match=r"point 0 at \[2.0, 0.5\] lies outside"):
        estimate["k"].at([2.0, 0.5])


def test_draws_lie_within_bounds():
    mesh = lp.interval(0.0, 1.0, 20)
    model = heat(mesh, lp.LogitNormal(0.1, bounds=(0.0, 0.2), std=0.05), {"right": 0.0})
    who = lp.Identifier(model, lp.Points({"T": 0.5}, noise=1.0), u0=1.0)
    drawn = who.run([(0.1, [1.0])]).sample(500, seed=0)["alpha"]
    assert float(drawn.min()) > 0.0
    assert float(drawn.max()) < 0.2
    assert float(drawn.std()) > 0.02


def test_measured_predicted_and_residuals():
    result = found()
    assert np.allclose(result.measured["T_30"], dated()["T_30"])
    assert np.allclose(result.predicted + result.residuals, result.measured)
    assert (result.residuals["T_30"] == result.to_dataframe()["innovation:T_30"]).all()
    assert list(result.measured) == ["T_30", "T_60", "T_60 again"]


def test_a_pickled_result_has_no_draws():
    result = pickle.loads(pickle.dumps(found()))
    with pytest.raises(lp.errors.ConfigurationError, match="this result was pickled"):
        result.sample(1)


def test_a_law_without_covariance_has_no_draws():
    model = heat(lp.interval(0.0, 1.0, 8), lp.Normal(0.1, std=0.05), {"right": 0.0})
    whole = lp.Identifier(model, lp.Full(noise=0.1), lp.GradientLaw(), u0=1.0)
    result = whole.run([(0.1, np.ones(8))])
    for of in (result.covariance, lambda: result.sample(1)):
        with pytest.raises(lp.errors.LawError, match="no covariance: use SensitivityLaw"):
            of()
    assert np.isnan(result.summary().loc["alpha", "low"])
    empty = whole.run([])
    with pytest.raises(lp.errors.ConfigurationError, match="contains no samples"):
        empty.covariance()
    assert len(empty.summary()) == len(empty.to_dataframe()) == 0


def test_inference_data_for_arviz():
    tree = found().to_inference_data(50)
    assert tree["posterior"]["alpha"].sizes == {"chain": 1, "draw": 50}
    assert tree["prior"]["alpha"].std() > 3.0 * tree["posterior"]["alpha"].std()
    assert np.allclose(tree["observed_data"]["T_30"], dated()["T_30"])
    assert tree["posterior_predictive"]["T_30"].sizes == {"chain": 1, "draw": 50, "time": 24}
    arviz = pytest.importorskip("arviz_base")
    assert arviz.extract(tree)["alpha"].sizes["sample"] == 50


@pytest.mark.slow
def test_the_likelihood_of_draws_is_that_of_simulations():
    noise = np.where(np.arange(24) % 2, NOISE, 2.0 * NOISE)
    table = dated().assign(**{"noise of T_30": noise})
    table.iloc[7, 1] = np.nan
    who = identifier(dt_max=0.005, law=lp.SensitivityLaw(shadows=None))
    tree = who.run(table).to_inference_data(400, seed=3)
    found = tree["log_likelihood"]["readings"].isel(chain=0)
    t, nodes = measured().index.to_numpy(), [6, 12]
    for draw in (0, 1):
        q = rod().initial_parameter({"alpha": tree["posterior"]["alpha"].values[0, draw]})

        def ends(when):  # inputs change linearly between their readings
            return {"T_left": float(np.interp(when, t, table["T_left"]))}

        fine = lp.Advance(lp.Alexander2(), 0.005)
        run = lp.simulate(rod(), q, 0.0, t.tolist(), fine, ends)
        shown = np.array([(rod().state_block.at_vertices @ u)[nodes] for _, u in run])
        std = np.column_stack([noise, np.full(24, NOISE)])
        e = (table[["T_30", "T_60"]].to_numpy() - shown) / std
        density = (-0.5 * e**2 - np.log(std * np.sqrt(2.0 * np.pi)))[1:]  # the start is known
        assert np.allclose(
            found[draw], density[np.isfinite(density)], rtol=0.0, atol=5e-3
        )  # linear
    assert list(found["sensor"].values[:4]) == ["T_30", "T_60", "T_30", "T_60"]
    assert found["time"].values[0] == table.index.values[1]
    shown = tree["posterior_predictive"]["T_30"].isel(time=slice(2, None))
    assert np.allclose(shown.std(("chain", "draw")), noise[2:], rtol=0.25)


@pytest.mark.slow
def test_noise_of_inputs_widens_the_likelihood():
    exact, noisy = (
        identifier(**options).run(measured().iloc[:9]).to_inference_data(99)
        for options in ({}, {"input_noise": {"T_left": 2.0}})
    )
    spread = [tree["posterior_predictive"]["T_30"].std("draw").mean() for tree in (exact, noisy)]
    assert spread[1] > 2.0 * spread[0]


@pytest.mark.slow
def test_unknowns_that_move_have_no_likelihood_of_a_draw():
    drifting = lp.Scalar(lp.LogNormal(0.1, std=0.05), evolution=lp.RandomWalk(0.1))
    model = heat(lp.interval(0.0, 1.0, 8), drifting, {"right": 0.0})
    who = lp.Identifier(model, lp.Points({"T": 0.5}, noise=0.1), u0=1.0)
    assert "log_likelihood" not in who.run([(0.1, [1.0])]).to_inference_data(3)
    who = identifier()
    who.run(measured().iloc[:9])
    assert "log_likelihood" not in who.run(measured().iloc[9:]).to_inference_data(3)


# --- representations of objects ------------------------------------------------------------------


def test_a_ready_made_equation_shows_its_formula():
    from livepde.models import EQUATIONS, burgers, conduction, with_conditions

    assert "equation: u_t = div(alpha grad u)\n" in repr(rod())
    mesh, one = lp.interval(0.0, 1.0, 8), lp.LogNormal(1.0, std=0.1)
    lossy = conduction(mesh, one, {"left": 0.0}, C=2.0, loss=one)
    assert "equation: C u_t = div(k grad u) - loss (u - ambient)\n" in repr(lossy)
    assert "lambda" not in repr(lossy)
    assert "mass" not in repr(lossy)
    assert "equation: u_t + a u u_x = nu u_xx\n" in repr(burgers(mesh, one, 1.0))
    heated = with_conditions(lossy, sources={"heater": lp.models.Source(5.0)})
    assert "- loss (u - ambient), with added conditions and sources\n" in repr(heated)
    for equation in EQUATIONS.values():
        assert equation.about(equation.unknowns)["formula"] == equation.formula


def conduction(q, u, v, x):
    """Weak form of conduction as a single expression."""
    return q.k * lp.dot(lp.grad(u), lp.grad(v))


def loss(u, v, x):
    ambient = 1.0
    return (u - ambient) * v


def test_terms_of_a_model_are_shown_as_they_are_written():
    mesh = lp.interval(0.0, 1.0, 8, regions={"core": lambda x: x[0] < 0.5})
    model = lp.Model(
        lp.Field(mesh, lp.linear(mesh)),
        {"k": lp.LogitNormal(0.3, bounds=(0.0, 1.0), std=0.1)},
        A=conduction,
        B=[loss, lp.On("left", lambda u, v, x: 2.0 * u * v)],
        f=[lambda x, t: x[0] * t, 1.0],
        M=lambda u, v, x: 3.0 * u * v,
    )
    assert (
        "equation: integral of M(u', v) + q.k * lp.dot(lp.grad(u), lp.grad(v)) + loss(...) + "
        "2.0 * u * v on 'left' = integral of (x[0] * t + 1.0) * v"
    ) in repr(model)
    assert "mass M(u, v): 3.0 * u * v" in repr(model)
    assert "unknown k: LogitNormal(0.3, std=0.1, bounds=(0.0, 1.0))" in repr(model)
    layers = lp.Piecewise({"a": lambda x: x[0] < 0.5, "b": lambda x: x[0] >= 0.5}, lp.Normal(1, 1))
    model = lp.Model(lp.Field(mesh, lp.linear(mesh)), {"k": layers}, A=conduction)
    assert "unknown k: Normal(1, std=1) for each of k[a], k[b]" in repr(model)


def test_a_notebook_shows_tables():
    for one in (two().model, identifier(), two().last, two()):
        shown = one._repr_html_()
        title, *lines = repr(one).splitlines()
        assert shown.startswith(f"<b>{title}</b><table>")
        assert shown.count("<tr>") == len(lines)
    assert "u&#x27; * v" in two().model._repr_html_()


# --- figures by name -----------------------------------------------------------------------------


def test_measured_against_predicted():
    plt = pytest.importorskip("matplotlib.figure")
    ax = plt.Figure().subplots()
    assert found().plot.measured_and_predicted(ax=ax) is ax
    points, line = ax.lines[:2]
    assert np.allclose(points.get_ydata(), dated()["T_30"])
    assert np.allclose(line.get_ydata(), found().predicted["T_30"])
    assert line.get_label() == "T_30"
    ax = found().plot.measured_and_predicted(sensors=["T_60"])
    assert len(ax.lines) == 2
    with pytest.raises(lp.errors.ConfigurationError, match="no sensor 'T_3'; there are"):
        found().plot.measured_and_predicted(sensors=["T_3"])
    assert np.allclose(found().plot().axes[0].lines[0].get_ydata(), dated()["T_30"])


@pytest.mark.slow
def test_sensors_of_several_units_have_a_figure_for_each():
    pytest.importorskip("matplotlib")
    cold = lp.Points({"T_60": 0.6}, noise=NOISE, unit="K")
    warm = lp.Points({"T_30": 0.3}, noise=NOISE, unit="degC")
    result = lp.Identifier(rod(), lp.Combined([cold, warm]), u0=0.0).run(measured())
    with pytest.raises(lp.errors.ConfigurationError, match=r"several units, .*sensors=\['T_60'\]"):
        result.plot.measured_and_predicted()
    assert "K" in result.plot.measured_and_predicted(sensors=["T_60"]).get_ylabel()


def test_estimates_with_their_band():
    pytest.importorskip("matplotlib")
    ax = found().plot.estimates()
    assert np.allclose(ax.lines[0].get_ydata(), found().to_dataframe()["alpha"])
    assert len(ax.collections) == 1
    with pytest.raises(lp.errors.ConfigurationError, match=r"name one of .* \['k', 'r'\]"):
        two().plot.estimates()
    with pytest.raises(lp.errors.ConfigurationError, match="no unknown number 's'"):
        two().plot.estimates("s")
    assert "r" in two().plot.estimates("r").get_ylabel()


def test_residuals():
    pytest.importorskip("matplotlib")
    ax = found().plot.residuals()
    assert any(np.array_equal(x.get_ydata(), found().residuals["T_30"]) for x in ax.lines)
    ax = found().plot.residuals(validation=True)
    assert any(np.array_equal(x.get_ydata(), found().residuals["T_60 again"]) for x in ax.lines)
    with pytest.raises(lp.errors.ConfigurationError, match="no validation sensors"):
        two().plot.residuals(validation=True)


def test_corner():
    pytest.importorskip("matplotlib")
    axes = two().plot.corner(n=300)
    assert axes.shape == (2, 2)
    assert not axes[0, 1].get_visible()
    drawn = two().sample(300, 0)
    assert np.array_equal(axes[1, 0].lines[0].get_xydata().T, [drawn["k"], drawn["r"]])
    assert two().plot.corner(["r"], axes=axes[:1, :1]).shape == (1, 1)
    assert found().plot.corner(n=9)[0, 0].get_xlabel() == "alpha [m²/s]"
    with pytest.raises(lp.errors.ConfigurationError, match="no unknown number 's'"):
        two().plot.corner(["s"])


@pytest.mark.slow
def test_fields():
    pytest.importorskip("matplotlib")
    last = two().to_xarray()["s"].values[-1]
    assert any(np.array_equal(x.get_ydata(), last) for x in two().plot.field("s").lines)
    assert len(two().plot.field("u").lines)
    with pytest.raises(lp.errors.ConfigurationError, match="no field 'k'"):
        two().plot.field("k")
    with pytest.raises(lp.errors.ConfigurationError, match="no map of the standard deviation"):
        two().plot.field("s", std=True)
    plate = heat(lp.rectangle((0.0, 1.0), (0.0, 1.0), (4, 4)), lp.LogNormal(0.1, std=0.05))
    who = lp.Identifier(plate, lp.Points({"T": (0.5, 0.5)}, noise=0.1), u0=lambda x: x[0])
    maps = [who.run([(0.1, [0.5])]).plot.field("u"), who.run([(0.2, [0.5])]).plot.field("u", std=1)]
    assert [ax.get_title().startswith("standard deviation") for ax in maps] == [False, True]


# --- mistakes in forms, sensors and initial states -----------------------------------------------


def test_forms_that_are_not_linear_in_v_are_refused():
    mesh = lp.interval(0.0, 1.0, 8)
    state, k = lp.Field(mesh, lp.linear(mesh)), {"k": lp.LogNormal(1.0, std=0.1)}

    def ok(q, u, v, x):
        return q.k * lp.dot(lp.grad(u), lp.grad(v))

    for wrong, why in (
        (lambda q, u, v, x: q.k * u, "Form A.* has a part without v: every part needs v"),
        (lambda q, u, v, x: q.k * u * v - q.k, "Form A.* has a part without v"),
        (lambda q, u, v, x: q.k * u * v * v, "Form A.* is not linear in v"),
        ([ok, lambda q, u, v, x: q.k * u], r"Form A\(q, u, v, x\), term 2 has a part without v"),
    ):
        with pytest.raises(lp.errors.ModelError, match=why):
            lp.Model(state, k, A=wrong)
    for part, wrong, why in (
        ("B", lambda u, v, x: u, "Form B.* has a part without v"),
        ("B", lp.On("left", lambda u, v, x: u - 1.0), "Form B.* has a part without v"),
        ("M", lambda u, v, x: u * u * v, r"Form M\(u, v, x\) is not linear in u"),
        ("initial", lambda q, v, x: q.k, "Form initial.* has a part without v"),
    ):
        with pytest.raises(lp.errors.ModelError, match=why):
            lp.Model(state, k, A=ok, **{part: wrong})
    roots = lp.Model(state, k, A=lambda q, u, v, x: q.k * np.sqrt(u) * v)  # NaN where probed
    assert not roots.affine


def test_a_diffusion_of_the_wrong_sign_is_reported():
    mesh = lp.interval(0.0, 1.0, 8)
    state = lp.Field(mesh, lp.linear(mesh))

    def growing(q, u, v, x):
        return -q.k * lp.dot(lp.grad(u), lp.grad(v))

    def depends(q, u, v, x):
        return -q.k * (1.0 + u**2) * lp.dot(lp.grad(u), lp.grad(v))

    for A in (growing, depends):
        with pytest.warns(UserWarning, match="the diffusion of the model is negative"):
            lp.Model(state, {"k": lp.LogNormal(1.0, std=0.1)}, A=A)

    def stabilised(u, v, x):
        return 2.0 * lp.dot(lp.grad(u), lp.grad(v))

    lp.Model(state, {"k": lp.LogNormal(1.0, std=0.1)}, A=growing, B=stabilised)  # no warning
    lp.Model(state, {"k": lp.Normal(-1.0, std=0.1)}, A=growing)
    lp.Model(state, {"k": lp.Normal(0.0, std=0.1)}, A=growing)


def test_the_sign_of_diffusion_is_checked_in_systems_and_directions():
    k = {"k": lp.LogNormal(1.0, std=0.1)}
    line, plate = lp.interval(0.0, 1.0, 8), lp.rectangle((0.0, 1.0), (0.0, 1.0), (3, 3))

    def fields(*names: str) -> dict[str, lp.Field]:
        return {name: lp.Field(line, lp.linear(line)) for name in names}

    def flux(u, v):
        return lp.dot(lp.grad(u), lp.grad(v))

    def opposed(q, u, v, x):
        return q.k * flux(u.c, v.c) - q.k * flux(u.d, v.d)

    with pytest.warns(UserWarning, match="the diffusion of 'd' is negative at the prior mean"):
        lp.Model(fields("c", "d"), k, A=opposed)
    with pytest.warns(UserWarning, match="the diffusion of the model is negative"):
        lp.Model(
            lp.Field(plate, lp.linear(plate)),
            k,
            A=lambda q, u, v, x: q.k * (flux(u, v) - 3.0 * lp.grad(u)[1] * lp.grad(v)[1]),
        )
    with pytest.warns(UserWarning, match="the diffusion of the model is negative"):
        lp.Model(
            fields("u")["u"], k, A=lambda q, u, v, x: q.k * flux(u, v), M=lambda u, v, x: -u * v
        )
    # Valid: both signs reversed, no time derivative of d, and sufficient diffusion across.
    lp.Model(fields("u")["u"], k, A=lambda q, u, v, x: -q.k * flux(u, v), M=lambda u, v, x: -u * v)
    lp.Model(fields("c", "d"), k, A=opposed, M=lambda u, v, x: u.c * v.c)
    lp.Model(
        fields("c", "d"),
        k,
        A=lambda q, u, v, x: q.k * (flux(u.c, v.c) + 2.0 * flux(u.d, v.c) - 2.0 * flux(u.c, v.d)),
        B=lambda u, v, x: -0.1 * flux(u.d, v.d),
    )


def system() -> lp.Model:
    mesh = lp.interval(0.0, 1.0, 8)
    parts = {name: lp.Field(mesh, lp.linear(mesh)) for name in ("c", "d")}
    return lp.Model(parts, {"k": lp.Normal(1.0, 0.1)}, A=lambda q, u, v, x: q.k * u.c * v.d)


@pytest.mark.slow
def test_the_initial_state_of_a_system_is_one_number_or_names_all_fields():
    sensors = lp.Points({"C": 0.5}, of="c", noise=0.1)
    assert (lp.Identifier(system(), sensors, u0=20.0).u0 == 20.0).all()
    both = lp.Identifier(system(), sensors, u0={"c": 1.0, "d": lambda x: 2.0 + 0.0 * x[0]})
    assert np.allclose(both.u0, [1.0] * 9 + [2.0] * 9)
    control, law = lp.Advance(lp.Alexander2(), 0.1), lp.SensitivityLaw()
    partial = {"c": 1.0}
    for begin in (
        lambda u0: lp.Identifier(system(), sensors, u0=u0),
        lambda u0: lp.Fleet(system(), sensors, law, 2, u0=u0),
        lambda u0: list(lp.simulate(system(), np.ones(1), u0, [0.0, 1.0], control)),
    ):
        with pytest.raises(lp.errors.ConfigurationError, match=r"u0 has no value for \['d'\]"):
            begin(partial)
        with pytest.raises(lp.errors.ConfigurationError, match="u0 has values that are not finite"):
            begin({"c": lambda x: np.where(x[0] < 0.5, np.nan, 1.0), "d": 1.0})
    for wrong, message in (
        ([1.0, 2.0], r"coefficients of shape \(2,\); expected \(18,\)"),
        (lambda x: x[0], r"a function of x for \['c', 'd'\]: give a mapping"),
        ({"c": 1.0, "d": 1.0, "e": 1.0}, r"no unknown is called \['e'\]"),
    ):
        with pytest.raises(lp.errors.ConfigurationError, match=message):
            lp.Identifier(system(), sensors, u0=wrong)


# --- own data by coordinates ---------------------------------------------------------------------


@pytest.mark.slow
def test_data_of_a_subdomain_by_coordinates():
    mesh = lp.interval(0.0, 1.0, 10)
    model = heat(mesh, lp.Normal(0.1, std=0.05), {"right": 0.0})
    omega = lp.Subdomain(lambda x: x[0] < 0.45, noise=0.1)
    z = omega.sample(lambda x: x[0] ** 2, model.state_space)
    assert np.allclose(z, np.linspace(0.0, 0.4, 5) ** 2)
    assert (lp.Full().sample(lambda x: 3.0, model.state_space) == np.full(10, 3.0)).all()
    camera = np.linspace(0.5, 0.0, 51)  # points that differ from the nodes, in descending order
    table = xr.DataArray(
        np.outer([1.0, 2.0], np.cos(camera)), {"time": [0.1, 0.2], "x": camera}, ("time", "x")
    )
    data = omega.sample(table, model.state_space)
    assert np.allclose(data, np.outer([1.0, 2.0], np.cos(np.linspace(0.0, 0.4, 5))), atol=1e-4)
    result = lp.Identifier(model, omega, u0=1.0).run(zip(table["time"].values, data, strict=True))
    assert np.allclose(result.measured, data)
    table[1, 25] = np.nan
    assert np.isnan(omega.sample(table, model.state_space)).sum() < 2
    for given, message in (
        (table, r"for x from 0 to 0.5; they are needed from 0 to 1"),
        (
            table.rename(x="place"),
            r"the dimensions \['time', 'place'\]; expected the coord.*\['x'\]",
        ),
        (lambda x: np.ones(3), r"the function returns shape \(3,\) for x of shape \(1, 11\)"),
        (np.ones(10), "got ndarray; expected a function of x or a DataArray"),
    ):
        with pytest.raises(lp.errors.ObservationError, match=message):
            lp.Full().sample(given, model.state_space)


def test_data_of_elements_with_slopes_are_projected_on_the_subdomain():
    from skfem import ElementLineHermite, ElementQuad2

    mesh = lp.interval(0.0, 1.0, 10)
    state = lp.Field(mesh, ElementLineHermite(), dirichlet={"left": 0.0})
    model = lp.Model(state, {"k": lp.Normal(1.0, 0.1)}, A=lambda q, u, v, x: q.k * u * v)
    omega = lp.Subdomain(lambda x: x[0] < 0.35)
    whole = lp.Full().sample(lambda x: x[0] ** 3 - x[0], model.state_space)
    cubic = model.state_block.interpolate(lambda x: x[0] ** 3 - x[0])
    assert np.allclose(whole, cubic[lp.Full().selected(model.state_block)], atol=1e-9)
    within = omega.sample(lambda x: np.where(x[0] < 0.3, x[0] ** 3 - x[0], 99.0), model.state_space)
    assert np.allclose(within, cubic[omega.selected(model.state_block)], atol=1e-9)
    plate = lp.rectangle((0.0, 1.0), (0.0, 2.0), (3, 4))
    model = lp.Model(
        {"c": lp.Field(plate, ElementQuad2()), "d": lp.Field(plate, lp.linear(plate))},
        {"k": lp.Normal(1.0, 0.1)},
        A=lambda q, u, v, x: q.k * u.c * v.d,
    )
    x, y = np.linspace(0.0, 1.0, 30), np.linspace(0.0, 2.0, 40)
    grid = xr.DataArray(2.0 * x[:, None] - y, {"x": x, "y": y}, ("x", "y"))
    for of in ("c", "d"):
        found = lp.Full(of=of).sample(grid, model.state_space)
        at = model.state_space.fields[of].doflocs
        assert np.allclose(found, 2.0 * at[0] - at[1], atol=1e-9)
    with pytest.raises(lp.errors.ObservationError, match="a value is not finite"):
        lp.Full(of="c").sample(lambda x: np.nan, model.state_space)


def test_data_of_a_vector_field():
    from skfem import ElementQuad1, ElementVector

    mesh = lp.rectangle((0.0, 1.0), (0.0, 1.0), (3, 3))
    state = lp.Field(mesh, ElementVector(ElementQuad1()))
    model = lp.Model(state, {"k": lp.Normal(0.0, 0.1)}, A=lambda q, u, v, x: q.k * lp.dot(u, v))
    flow = lambda x: np.array([x[0], 3.0 * x[1]])  # noqa: E731
    expected = model.state_block.interpolate(flow)
    assert np.allclose(lp.Full().sample(flow, model.state_space), expected)
    with pytest.raises(lp.errors.ObservationError, match="a row for each of 2 components"):
        lp.Full().sample(lambda x: x[0], model.state_space)


def test_a_text_as_a_boundary_value_is_refused_with_the_channel_to_write():
    with pytest.raises(lp.errors.SpaceError, match=r"give Channel\('T_left'\)"):
        heat(lp.interval(0.0, 1.0, 4), lp.Normal(0.1), {"left": "T_left"})


def test_a_guessed_attribute_of_a_result_gets_the_place_of_the_estimates():
    with pytest.raises(AttributeError, match=r"last\['alpha'\] and to_dataframe\(\).*forecasts"):
        known().forecast  # noqa: B018
    shown = repr(known().last["u"].at([0.2, 0.4]))
    assert shown.startswith("Marginal(median=array([")
    assert len(shown) < 120
