"""All sentences of a verdict: findings, likely causes, and remedies.

Findings fill these templates; programs read the fields of `Finding` and `Cause` instead. A cause is
a clause without a full stop, because it can be part of a list.
"""

from __future__ import annotations

import json
import math
import re
from typing import NamedTuple

from livepde.showing import in_percent

SMALLEST = 1e-6  # p-value that is printed
CENTI = {"m": ("cm", "mm")}  # unit -> units of a hundredth and a thousandth of it


class Sentence(NamedTuple):
    """A statement and its remedy, as templates; the remedy may be empty."""

    text: str
    remedy: str = ""

    def filled(self, **values: object) -> Sentence:
        """Return the sentence with values in its placeholders."""
        return Sentence(self.text.format(**values), self.remedy.format(**values))


JUMPS = "Allow jumps with `law.jumps = true`, or model the change with `evolution`."
LONGER_DATA = "Use longer data with larger changes near the sensors."
CHECK = 'Check {name}. If it is faulty, set `role = "ignored"`.'
CHECK_UNIT = "Check the scale and the unit of {name}."
RAISE_GATE = "increase `noise`, or increase `law.gate`."

FINDINGS: dict[str, Sentence] = {
    # --- fit of the model
    "misfit": Sentence("Model misfit: the residuals are not white noise ({p})."),
    "misfit, no cause": Sentence(
        "Model misfit: the residuals are not white noise ({p}). No single plausible cause explains "
        "them."
    ),
    "misfit, columns": Sentence("Model misfit: the data fit much better if a column is corrected."),
    "misfit, innovations": Sentence(
        "Model misfit: innovations are {times:.1f} times as large as noise and uncertainty allow "
        "(squared ratio {ratio:.1f}, limit {limit:g}). The intervals are widened but remain "
        "unreliable."
    ),
    "misfit, equation": Sentence(
        "Model misfit: with these estimates, the equation leaves a residual of {size} of its terms "
        "on the observed part. It persists from sample to sample, so it is not noise.",
        "Compare with `SensitivityLaw`, a longer run or a larger gain. The model may lack a "
        "process, a coefficient may be wrong, or the estimates may not have converged.",
    ),
    "start": Sentence(
        "The readings do not fit the initial state ({p}). This shifts each unknown by less than "
        "one standard deviation."
    ),
    "start, assumed": Sentence(
        "No `u0` was given, so the run began from a state of zero.",
        "Give `u0`, the state at t0. If it is zero, give 0.",
    ),
    "past": Sentence(
        "Earlier data did not fit the model. The last {count} samples fit, and the earlier error "
        "now shifts each unknown by less than one standard deviation."
    ),
    "following": Sentence(
        "Residuals of {name} are autocorrelated ({correlation:.2f}): the model lacks a slow "
        "process, or the noise is not white. The intervals are widened accordingly."
    ),
    "following, causes": Sentence(
        "Residuals are autocorrelated (up to {correlation:.2f}), so an apparent cause may be "
        "chance. The intervals are widened accordingly."
    ),
    "following, large noise": Sentence(
        "Residuals of {name} are autocorrelated ({correlation:.2f}) and smaller than expected. If "
        "`noise` is too large, estimates of changing unknowns lag behind. The intervals account "
        "for this."
    ),
    "constancy": Sentence("Estimates of {name} before and after {after} of the samples differ."),
    "disagreement": Sentence(
        "The sensors imply different values of the unknowns. {name} differs most."
    ),
    "prior": Sentence(
        "The unknowns are {distance:.1f} prior standard deviations from the prior mean. The prior "
        "may be too narrow, or a unit, a sensor or the model may be wrong."
    ),
    "fit, not converged": Sentence(
        "The fit of {samples} samples did not converge.",
        "Start from another prior, or check the model.",
    ),
    "fit, refused": Sentence(
        "The fit of {samples} samples excluded {share} of the readings ({count}). They are far "
        "from the readings around them, or from the model.",
        f"Check these readings, {RAISE_GATE}",
    ),
    # --- unknowns
    "flat": Sentence(
        "`{label}` is not identifiable from these data: its standard deviation is still {left} of "
        "the prior's.",
        LONGER_DATA,
    ),
    "flat, misfit": Sentence(
        "The misfit widens the standard deviation of `{label}` to {left} of the prior's.",
        "Find the cause of the misfit first.",
    ),
    "bound": Sentence(
        "`{label}` is at its bound {value:g}: the bound determines the estimate, not the data."
    ),
    "held": Sentence(
        "In {count} samples, last at {at}, updates would have exceeded the allowed distance from "
        "the prior (`within`, by default 10 prior standard deviations). The unknowns were held at "
        "that distance.",
        "Check units, sensors and model. If they are right, the prior is much too narrow.",
    ),
    "held, now": Sentence(
        "Unknowns are held at the allowed distance from the prior (`within`, by default 10 prior "
        "standard deviations).",
        "Check units, sensors and model. If they are right, the prior is much too narrow.",
    ),
    "left out": Sentence(
        "{share} of the variance of `{name}` is in details finer than the {count} modes of the "
        "law, which data do not reduce. Its standard deviation (root mean square) is {std}, and "
        "{modes} from these modes alone.",
        "Increase `law.modes`, or the correlation length of the field.",
    ),
    "jump": Sentence(
        "Jump at {at}: the samples no longer fitted the estimates, so the unknowns were allowed to "
        "change. Since then {moved}."
    ),
    "jump, nothing moved": Sentence(
        "Jump at {at}: the samples no longer fitted the estimates, so the unknowns were allowed to "
        "change. No number changed permanently. The cause was temporary, or the model lacks it."
    ),
    "jump, more": Sentence(
        "{count} more jumps were detected. The unknowns may change continuously (`evolution`), or "
        "the model lacks a process."
    ),
    "gain": Sentence(
        "The estimate of {names} fluctuates by more than {share} of its change since the start: "
        "the gain is too large for the noise.",
        "Use `gain = 'auto'`, or a smaller gain.",
    ),
    "rest": Sentence(
        "Only noise excited the unknowns in {count} samples{when}, so they were held constant."
    ),
    "rest, now": Sentence(
        "Only noise has excited the unknowns since {since}, so they are held constant{before}."
    ),
    # --- sensors and readings
    "noise, small": Sentence(
        "Residual scatter is {share} of the configured noise: `noise` may be too large."
    ),
    "noise, large": Sentence(
        "Residual scatter is {ratio:.2g} times the configured noise: `noise` may be too small."
    ),
    "noise, sensor": Sentence(
        "Residuals of {name} scatter {ratio:.2g} times more than its configured noise.",
        "Check this sensor, or increase its `noise`.",
    ),
    "noise, found": Sentence(
        "The noise is {ratio:.2g} times the first guess. Without `refit` the first samples keep "
        "the weight of the guess, and the intervals are too narrow.",
        "Configure the noise that was found, or allow a refit.",
    ),
    "stuck": Sentence("{name} appears stuck: same value for {count} samples."),
    "aside": Sentence(
        "{name} is excluded since t = {since}: its readings contradict the model, and the other "
        "sensors or its own past (last difference {off}).",
        "Check {name}. If it reports a placeholder value, add the value to `missing`. If it is "
        'faulty, set `role = "ignored"`.',
    ),
    "changed": Sentence(
        "Most readings contradict the model, or did until recently: the process or an input has "
        "changed. The readings update the state, but not the unknowns.",
        JUMPS,
    ),
    "refused": Sentence(
        "The gate rejected {share} of the readings ({count}, most of them from {name}). They are "
        "more than `law.gate` standard deviations from the prediction.",
        f"Check {{name}}, {RAISE_GATE}",
    ),
    "refused, run": Sentence(
        "The gate rejected {share} of the readings ({count}). They are more than `law.gate` "
        "standard deviations from the prediction.",
        f"Check these sensors, {RAISE_GATE}",
    ),
    "validation": Sentence(
        "The prediction of {name} (validation sensor) has an error of {size:.2g}{unit} (mean "
        "{mean:+.2g}{unit}), {ratio:.1f} times what prediction and noise allow."
    ),
    # --- inputs
    "input, start": Sentence(
        "Input {name} had no value at the initial time, so its first value was used for the first "
        "interval.",
        "If it was not constant, add a row with {name} at the initial time.",
    ),
    "input, gaps": Sentence(
        "Input {name} had no value in {count} of {samples} samples, so its last value was held. "
        "Linear interpolation across the gaps would shift the estimates by about: {shifts}.",
        "Interpolate {name} where the next value is known, or sample it more often.",
    ),
    "input, gaps, unknown shift": Sentence(
        "Input {name} had no value in {count} of {samples} samples, so its last value was held. "
        "The effect on the estimates is unknown.",
        "Interpolate {name} where the next value is known, or sample it more often.",
    ),
    "input, counts": Sentence("{kind} {name}: {counts}."),
    "input, bridged": Sentence(
        "{kind} {name}: {counts}.", "To leave out the rows in the gaps of {name}, set `{skip}`."
    ),
    "input, ended": Sentence(
        "{kind} {name}: {counts}.", "To end the run at the last value of {name}, set `data.stop`."
    ),
    "start, missed": Sentence(
        "The first readings miss the stated initial state by {missed} (root mean square).",
        "If the process began before the first row, set `data.t0`. If the readings have another "
        "zero than the model, estimate the `offset` of each sensor. Otherwise specify the "
        "uncertainty of the start: `{setting}`.",
    ),
    "hold": Sentence(
        'Inputs are held between readings (`between = "hold"` or `"next"`), but vary smoothly. '
        "Linear interpolation would shift the unknowns by {total:.1f} standard deviations{each}. "
        "The intervals do not include this shift.",
        'If these inputs are instantaneous readings, use `between = "line"`.',
    ),
    # --- time
    "clock": Sentence(
        "Times of rows went back {often}, and rows were skipped until their times were new again. "
        "Later times are correct only if the clock was.",
        "If the clock was wrong, specify its correction with `intake.shift`.",
    ),
    "clock, shifted": Sentence(
        "Times of rows went back {often}, and rows were skipped until their times were new again. "
        "The clock stayed set back {shifted} times, so the intervals there are too short.",
        "Synchronise the clock gradually. If it was wrong, specify its correction with "
        "`intake.shift`.",
    ),
    "clock, unit": Sentence(
        "From sample {sample} on ({at}), times are {factor:g} times as large as before. Their unit "
        "may have changed, such as from seconds to {unit}.",
        "Divide the times from that row on by {factor:g}, or split the table there.",
    ),
    "clock, leap": Sentence(
        "The clock was set forward by about {times} at {at} (sample {sample}): the readings "
        "continue without a gap.{after}",
        "{zone}If the later times are right, add {times} to the earlier ones. Otherwise subtract "
        "it from the later ones.",
    ),
    "pause": Sentence("No sample for {times} until {at} ({count:.0f} usual intervals).{after}"),
    # --- steps and discretisation
    "departed": Sentence(
        "{count} of {samples} samples are marked `departed`: prior and data contradict the update, "
        "so the unknowns were held."
    ),
    "not_converged": Sentence("{count} of {samples} steps failed: the solver did not converge."),
    "not_finite": Sentence("{count} of {samples} steps failed: the result is not finite."),
    "singular": Sentence("{count} of {samples} steps failed: a matrix is singular."),
    "start, late": Sentence(
        "The first sample comes {count:.4g} usual intervals after t0, the time of the initial "
        "state.",
        "If u0 is the state shortly before the first sample, give that time as `t0`.",
    ),
    "steps, long": Sentence(
        "{count} intervals between samples need more than {most} substeps of `dt_max`, so their "
        "substeps were longer.",
        "Check the times of the samples, or increase `steps.dt_max`.",
    ),
    "step": Sentence(
        "{count} of {steps} steps have an error of up to {size:.2g} times the noise (limit "
        "{allowed:g}). A substep is divided into at most {parts} parts.",
        "Reduce `steps.dt_max`, or increase `law.shadows.parts`.",
    ),
    "discretisation": Sentence(
        "Discretisation errors have shifted the unknowns by {total:.1f} standard deviations: "
        "{each}. The intervals include this shift."
    ),
    "untested": Sentence("Not tested: {what}."),
    # --- safeguards
    "guards, nonlinear": Sentence(
        "The update was too nonlinear in some samples: {tempered} were used with increased noise "
        "and {skipped} were skipped (last at t = {t:g}).",
        "Check the sensors at these times, increase `noise`, or start from a better prior.",
    ),
    "guards, restarted": Sentence(
        "The estimate diverged and was restarted from an earlier state {count} times (last at "
        "t = {t:g}).",
        "Check sensors and inputs before that time. If the model cannot be simulated for some "
        "values of an unknown, exclude them with bounds or a transform.",
    ),
    "guards, lost": Sentence(
        "{count} predictions differ from a reading by more than the sensor has ever varied, and a "
        "restart did not help (last at t = {t:g}).",
        "Check inputs, boundary values and their units.",
    ),
}
"""Test, and variant of its result -> statement with its remedy."""

LIKELY: dict[str, Sentence] = {
    "offset": Sentence(
        "{name} may read {amount} too {side}", "Check the offset and the position of {name}."
    ),
    "drift": Sentence(
        "{name} may drift by {rate} per sample",
        'Calibrate {name}. If that is impossible, set `role = "ignored"`.',
    ),
    "gain": Sentence("the scale of {name} may be {share} too {side}", CHECK_UNIT),
    "lag": Sentence(
        "{name} may be {amount} {side}",
        "Check the clock, the averaging and the response time of {name}.",
    ),
    "response": Sentence(
        "{name} may respond slowly, with a time constant of {amount}",
        "To test this, estimate its time constant.",
    ),
    "position": Sentence("{name} may be {amount} {where}", "Check the position of {name}."),
    "averaging": Sentence(
        "{name} may average over {amount}",
        "Check the length of {name}. For a mean along a line, use `along` instead of `at`.",
    ),
    "layers": Sentence(
        "{name} may differ between layers, with borders near {at} {unit}",
        "To test this, estimate it by layer: add `regions = {regions}` to {table}.",
    ),
    "jump": Sentence("{name} may have changed during the run", JUMPS),
    "boundary": Sentence(
        "{name} may be {amount} too {side}",
        "Check the unit, the position, the offset and the gaps of {name}.",
    ),
    "boundary, constant": Sentence(
        "a constant boundary value may be {amount} too {side}", "Check the boundary conditions."
    ),
    "source": Sentence(
        "a {side} may be missing in the model", "Add a source to the model, or estimate one."
    ),
    "loss": Sentence(
        "a loss to the surroundings may be missing in the model",
        "Add a loss term, or estimate one.",
    ),
    "flux": Sentence(
        "a flux {side} the domain may be missing at boundary {name}",
        "Check the boundary condition at {name}.",
    ),
    "transfer": Sentence(
        "an exchange with the surroundings may be missing at boundary {name}",
        "Add the exchange at {name}, or estimate it.",
    ),
    "channel": Sentence("the scale of {name} may be {share} too {side}", CHECK_UNIT),
    "initial": Sentence(
        "the initial state may be {side} than configured",
        'Specify its uncertainty: `initial = {{ from = "readings", std = ... }}`.',
    ),
    "initial, uncertain": Sentence(
        "the initial state may be {side} than configured",
        "Increase `initial.std`, or skip the first samples.",
    ),
    "unit": Sentence(
        "{name} may be in {unit} instead of {expected}",
        'Specify the unit: add `unit = "{unit}"` to {table}.',
    ),
    "factor": Sentence(
        "{name} may be {factor:g} times too {side}, as in another unit",
        "Check the unit of {name}. To correct it, add `factor = {correction}` to {table}.",
    ),
    "sign": Sentence(
        "{name} may have the opposite sign",
        "Check the direction in which {name} counts. To turn it, add `factor = -1` to {table}.",
    ),
    "exchange": Sentence(
        "the columns {name} and {other} may be exchanged",
        "Check the columns of {name} and {other}. If they are exchanged, correct the case.",
    ),
    "disagreement": Sentence(
        "{name} may be at another position, or measure another quantity, than configured"
    ),
    "stuck": Sentence("{name} or its transmission may be faulty", CHECK),
    "aside": Sentence("{name} may be broken or displaced"),
    "validation": Sentence(
        "the model may not hold at {name}, or its position or calibration may be wrong",
        f"{CHECK} If it is not, the model is wrong at this position.",
    ),
    "clock, unit": Sentence("the unit of time may have changed at {at}"),
    "clock, leap": Sentence("the clock may have jumped by {times} at {at}"),
}
"""Kind of a cause, and its variant -> clause with its remedy."""

ESTIMATED = {
    "offset": ("an offset", "offset"),
    "gain": ("a gain", "gain"),
    "position": ("its position", "at_std"),
}
"""Kind of sensor error -> the quantity to estimate, and the key that makes it an unknown."""

SIDES = {
    "offset": ("high", "low"),
    "boundary": ("high", "low"),
    "boundary, constant": ("high", "low"),
    "gain": ("large", "small"),
    "channel": ("large", "small"),
    "factor": ("large", "small"),
    "lag": ("late", "early"),
    "source": ("source", "sink"),
    "flux": ("into", "out of"),
    "initial": ("higher", "lower"),
    "initial, uncertain": ("higher", "lower"),
}
"""Kind of a cause -> word for its direction if it is positive, and if it is negative."""


def clause(
    kind: str, name: str, size: float, size_unit: str, *, positive: bool, **more: object
) -> Sentence:
    """Return the clause for a cause of a size in a unit, with its remedy."""
    side = SIDES[kind][not positive] if kind in SIDES else ""
    amount, share = amount_of(abs(size), size_unit), in_percent(abs(size))
    return LIKELY[kind].filled(name=name, amount=amount, share=share, side=side, **more)


def table_of(name: str) -> str:
    """Return the name of a channel's table in a case, for use in a sentence.

    >>> table_of("T_50"), table_of("T 50")
    ('`[channels.T_50]`', '`[channels."T 50"]`')
    """
    return f"`[channels.{quoted(name)}]`"


def quoted(name: str) -> str:
    """Return the name of a channel as a TOML key, quoted if necessary."""
    plain = re.fullmatch(r"[A-Za-z0-9_-]+", name)
    return name if plain else json.dumps(name, ensure_ascii=False)


def estimating(kind: str, name: str, value: str) -> str:
    """Return the remedy that estimates a sensor error; the value is TOML.

    >>> estimating("offset", "T_50", '"0.2 K"')
    'To test this, estimate an offset: add `offset = "0.2 K"` to `[channels.T_50]`.'
    """
    what, key = ESTIMATED[kind]
    return f"To test this, estimate {what}: add `{key} = {value}` to {table_of(name)}."


def width(size: float, unit: str) -> str:
    """Return twice a size as a standard deviation in TOML, with its unit."""
    value, unit = f"{2.0 * abs(size):.2g}", unit.replace("degC", "K")
    return f'"{value} {unit}"' if unit else value


def percent(share: float, digits: int = 0) -> str:
    """Return a share as a percentage.

    >>> percent(0.187), percent(0.0234, 1)
    ('19 %', '2.3 %')
    """
    return f"{100.0 * share:.{digits}f} %"


def amount_of(size: float, unit: str) -> str:
    """Return a positive difference with its unit: a difference of temperatures is in K.

    >>> (
    ...     amount_of(0.01, "m"),
    ...     amount_of(0.0005, "m"),
    ...     amount_of(0.5, "degC"),
    ...     amount_of(3618.96, "s"),
    ... )
    ('1 cm', '0.5 mm', '0.5 K', '3600 s')
    """
    unit = unit.replace("degC", "K")
    if unit in CENTI and 0.0 < size < 1.0:
        centi, milli = CENTI[unit]
        size, unit = (100.0 * size, centi) if size >= 0.00995 else (1000.0 * size, milli)
    return f"{float(f'{size:.2g}'):g} {unit}".rstrip()


def significance(log_e: float) -> str:
    """Return a bound of the p-value: by Ville's inequality, the inverse of the e-value.

    >>> significance(20.0), significance(10.0)
    ('p < 1e-6', 'p < 5e-5')
    """
    p = math.exp(-min(log_e, 700.0))
    if p < SMALLEST:
        return "p < 1e-6"
    power = math.floor(math.log10(p))
    digit = math.ceil(p / 10.0**power)
    return f"p < {digit}e{power}" if digit < 10 else f"p < 1e{power + 1}"
