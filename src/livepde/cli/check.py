"""Command `check`: model, data and identifiability of a case before a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape

from livepde.cases import Case, Prepared
from livepde.cases.data import policy_of, source_text
from livepde.cases.preview import MOST_SAMPLES, advise, predicted, preview
from livepde.cases.remedies import switching
from livepde.cli.options import CaseArgument, CodeOption, DataOption, SetOption, load_case, option
from livepde.cli.printing import CHECK_FAILED, extent, print_table, terminal
from livepde.runs import Table, sampling_findings
from livepde.samples import by_name
from livepde.showing import in_percent
from livepde.stepping import ForwardStage
from livepde.streams import DataTable
from livepde.streams.oddities import sentinels
from livepde.units import has_states
from livepde.verdict.sentences import LONGER_DATA

MOST_CHANNELS = 40  # largest number of rows in tables of channels
FEWEST = 10  # readings required for a correlation with the prediction
OPPOSITE = -0.9  # correlation with the prediction below which the sign may be wrong


def check(
    case: CaseArgument,
    data: DataOption = None,
    allow_code: CodeOption = False,
    settings: SetOption = None,
    advised: Annotated[
        bool, option("Recommend a position for one more point sensor.", "--advise")
    ] = False,
) -> None:
    """Check a case and its data, and which unknowns its sensors can identify.

    Nothing is written. Example:  livepde check mycase/case.toml
    """
    console = terminal()
    loaded = load_case(case, allow_code, settings)
    _show_model(console, loaded)
    if loaded.live and data is None:
        _show_wiring(console, loaded)
        console.print(f"[bold green]ok[/]  livepde run {escape(str(case))}")
        return
    prepared = loaded.prepare(data)
    samples: DataTable = prepared.raw  # type: ignore[assignment]
    _show_data(console, loaded, prepared, samples)
    failed = _show_checks(console, prepared)
    notes = [
        *loaded.notes,
        *_refused(prepared),
        *_sentinels(loaded, samples),
        *_sampling(prepared, samples),
        *_switching(loaded, samples),
        *_show_predicted(console, prepared),
        *_show_preview(console, prepared),
    ]
    if advised:
        _show_advice(console, prepared)
    for note in notes:
        console.print(f"[yellow]Note:[/] {escape(note)}")
    if failed:
        raise typer.Exit(CHECK_FAILED)
    console.print(f"[bold green]ok[/]  livepde run {escape(str(case))}")


def _refused(prepared: Prepared) -> list[str]:
    """Return sentences on values that a run will leave out, reject or interpolate."""
    texts = {
        "start": "{name}: the first {n} values are outliers. A run counts them as missing.",
        "spike": "{name}: {n} values are spikes. A run rejects them. To use them, set "
        '`channels.{name}.spikes = "keep"`.',
        "repeated": "{n} rows repeat time and values of the row before. A run leaves them out.",
        "begin": "{name}: the first {n} rows have no value. A run leaves them out.",
        "early": "{name}: the first {n} values are earlier than other data that a run needs at its "
        "start. A run leaves them out.",
        "bridged": "{name}: {n} values are missing in long gaps. A run interpolates them. To leave "
        'these rows out, set `channels.{name}.missing = "skip"`.',
        "ended": "{name}: the last {n} rows have no value. A run holds the one before. To end the "
        "run before them, set `data.stop`.",
    }
    remarks = getattr(prepared.stream, "remarks", {})
    return [
        text.format(name=name, n=number)
        for kind, text in texts.items()
        for (of, name), number in remarks.items()
        if of == kind
    ]


def _sentinels(case: Case, samples: DataTable) -> list[str]:
    """Return sentences on values in the file that may be placeholders."""
    sentences: list[str] = []
    for name, values in zip(samples.names, samples.values.T, strict=True):
        column = case.columns[name]
        if len(column.names) > 1:  # means of columns are not values in the file
            continue
        constants = not (name in case.roles("input") and has_states(case.unit(name)))
        sentences += [
            f"{name}: {found.value:g} occurs {found.times} times, far outside the other values "
            f"({found.low:.4g} to {found.high:.4g}). If it is a placeholder, add it to "
            f"`data.missing`. Otherwise specify the range with `channels.{name}.valid`."
            for found in sentinels(np.round((values - column.offset) / column.factor, 9), constants)
        ]
    return sentences


def _sampling(prepared: Prepared, samples: DataTable) -> list[str]:
    """Return sentences on pauses, and on times that jump or change their unit."""
    import xarray as xr

    unit = {"units": prepared.case.equation.time_unit}
    attrs = {} if prepared.origin is None else {"origin": prepared.origin.isoformat(sep=" ")}
    times = xr.Dataset(coords={"time": ("time", samples.t, unit)}, attrs=attrs)
    found = sampling_findings(times, lambda: (samples.t, samples.values))
    return [finding.sentence for finding in found]


def _switching(case: Case, samples: DataTable) -> list[str]:
    """Return sentences on inputs that switch, if the case does not specify `between`."""
    return [
        f'{name}: constant stretches with jumps, but the default `between = "line"` interpolates '
        f'each jump. If a value holds until the next reading, add `between = "hold"` to '
        f'`[channels.{name}]`. If it is the mean since the last reading, add `between = "next"`.'
        for name in switching(case, samples)
    ]


def _show_predicted(console: Console, prepared: Prepared) -> list[str]:
    """Print readings and their prior predictions; return a sentence on opposite signs, if any."""
    measured, prior = predicted(prepared, prepared.stream)
    against: list[str] = []
    rows: list[tuple[str, ...]] = []
    for name, own, other in zip(prepared.case.sensors, measured.T, prior.T, strict=True):
        there = np.isfinite(own) & np.isfinite(other)
        if not there.any():
            continue
        ends = (f"{one[there].min():.4g} to {one[there].max():.4g}" for one in (own, other))
        rows.append((name, *ends, prepared.case.unit(name)))
        moves = there.sum() >= FEWEST and min(np.ptp(own[there]), np.ptp(other[there])) > 0.0
        if moves and np.corrcoef(own[there], other[there])[0, 1] < OPPOSITE:
            against.append(name)
    if rows:
        title = "Readings, and their prediction at the prior"
        print_table(
            console, Table(title, ("sensor", "readings", "prior", "unit"), rows[:MOST_CHANNELS])
        )
    if not against:
        return []
    return [
        f"{', '.join(against)}: the readings fall where the prior predicts a rise, or the reverse. "
        "Check the sign of these columns and of the inputs: `factor = -1` changes it."
    ]


def _show_preview(console: Console, prepared: Prepared) -> Sequence[str]:
    """Print the standard deviations in the preview; return its sentences on identifiability."""
    found = preview(prepared, prepared.stream)
    late = {item.name: item.left for item in found.last}
    rows = [
        (
            item.name,
            f"{item.prior:.3g}",
            f"{item.posterior:.3g}",
            in_percent(item.left),
            *([in_percent(late[item.name])] if item.name in late else []),
            item.unit,
            "not identifiable" if item.not_identifiable else "",
        )
        for item in found.unknowns
    ]
    if rows:
        more = [f"share after the last {MOST_SAMPLES}"] if late else []
        columns = ("unknown", "prior std. dev.", "after", "share", *more, "unit", "")
        which = f"the first {found.samples}" if late else str(found.samples)
        title = f"Smallest standard deviations that {which} samples allow"
        print_table(console, Table(title, columns, rows))
    unidentified = [
        f"`{item.name}` is not identifiable from these data. {LONGER_DATA}"
        for item in found.unknowns
        if item.not_identifiable
    ]
    return [*unidentified, *found.sentences]


def _show_advice(console: Console, prepared: Prepared) -> None:
    """Print the best position for an additional sensor."""
    found = advise(prepared, prepared.stream)
    unit = prepared.case.equation.length_unit
    at = ", ".join(f"{x:.3g}" for x in found.position)
    rows = [
        (name, in_percent(left), in_percent(found.then[name])) for name, left in found.now.items()
    ]
    title = f"One more sensor helps most at {at} {unit}".rstrip()
    columns = ("unknown", "std. dev. / prior", "with the sensor")
    print_table(console, Table(title, columns, rows))
    console.print(
        f"Best of {found.candidates} vertices by the mean share of the prior variance, with the "
        "noise of the other sensors."
    )


def _show_wiring(console: Console, case: Case) -> None:
    """Print the source of a live case, and the intake policy of each channel."""
    policy, unit = policy_of(case), case.equation.time_unit
    rows: list[tuple[str, ...]] = []
    for name, column in case.columns.items():
        habit, spec = policy.habit(name), case.spec.channels[column.noise_of or name]
        low, high = column.valid
        rows.append(
            (
                name,
                "noise" if column.noise_of else spec.role,
                ", ".join(column.names),
                "" if math.isinf(high - low) else f"{low:g} to {high:g} {case.unit(name)}",
                f"{policy.longest(habit):g} {unit}".rstrip(),
                policy.keeps(name),
                "skip" if column.needed else spec.gaps if spec.drives else "continue",
                spec.between if spec.drives else "",  # only sensors have a noise column
            )
        )
    columns = ("channel", "role", "column", "valid", "wait", "repeated", "missing", "between")
    # If all channels have the default, the column `between` is left out.
    shown = len(columns) - all(row[-1] in ("", "line") for row in rows)
    rows = [row[:shown] for row in rows]
    print_table(console, Table(f"Channels from {source_text(case)}", columns[:shown], rows))
    console.print(
        "To see what the sensors can identify, add --data FILE: a recording with these columns."
    )


def _show_model(console: Console, case: Case) -> None:
    model = case.model
    title, formula = escape(case.title), escape(case.equation.formula)
    console.print(f"[bold]{title}[/]\n{formula}", soft_wrap=False)
    engine = ForwardStage(model).engine
    console.print(
        f"State: {model.X.dim} coefficients; parameter: {model.Q.dim}; "
        f"law: {type(case.law).__name__}; scheme: {type(case.scheme).__name__}; "
        f"engine: {engine.solver.name} ({engine.reason}).",
        soft_wrap=False,
    )


def _show_data(console: Console, case: Case, prepared: Prepared, samples: DataTable) -> None:
    steps = np.diff(samples.t)
    unit = case.equation.time_unit
    begin = f" from {prepared.origin}" if prepared.origin else ""
    text = f"Data: {len(samples)} samples{begin}, t = {samples.t[0]:g} to {samples.t[-1]:g} {unit}"
    if len(steps):
        text += f"; step {np.median(steps):g} {unit}, longest {steps.max():g} {unit}"
    console.print(text + ".")
    rows: list[tuple[Any, ...]] = []
    for name, values in list(zip(samples.names, samples.values.T, strict=True))[:MOST_CHANNELS]:
        least, largest, missing = extent(values)
        of = case.columns[name].noise_of
        # Known values, with an additional one before the first and after the last row.
        known = np.flatnonzero(np.concatenate([[True], np.isfinite(values), [True]]))
        longest_gap = int(np.diff(known).max()) - 1
        rows.append(
            (
                name,
                "noise" if of else case.spec.channels[name].role,
                least,
                largest,
                case.unit(of).replace("degC", "K") if of else case.unit(name),
                missing,
                longest_gap,
            )
        )
    if (more := len(samples.names) - MOST_CHANNELS) > 0:
        rows.append((f"and {more} more", "", "", "", "", "", ""))
    columns = ("channel", "role", "least", "largest", "unit", "missing", "longest gap")
    print_table(console, Table("Channels", columns, rows))


def _show_checks(console: Console, prepared: Prepared) -> bool:
    """Print the checks of model and observation; return whether a check failed."""
    from livepde.diagnostics import check_model, check_observation

    case, first = prepared.case, prepared.first
    values = by_name(first.z, ())
    inputs = {name: values[name] for name in case.model.channels if values[name] == values[name]}
    report = check_model(case.model, u=prepared.u0, t=first.t, inputs=inputs)
    observed, size = prepared.identifier.observed, prepared.typical(inputs)
    read = {name: values[name] for name in observed.observation.inputs}
    reports = [report, check_observation(observed, at=size, inputs={**inputs, **read})]
    for item in reports:
        if item.ok:
            console.print(f"{item.name}: [green]ok[/] ({len(item.lines)} properties)")
        else:
            console.print(escape(str(item)))
    return not all(item.ok for item in reports)
