"""Verdict of a run on itself: its level, with the findings against it."""

from livepde.verdict.assess import REFUSED, Position, assess
from livepde.verdict.channel_ledgers import InputLedger, WithheldLedger
from livepde.verdict.directions import Dictionary, ScoreDirection
from livepde.verdict.findings import (
    FEWEST,
    FLAT,
    LEVELS,
    MOST,
    NOT_JUDGED,
    NUMBERS,
    PROMISES,
    Cause,
    Finding,
    Severity,
    Verdict,
    at_bound,
    channel_setting,
    flat,
    too_few,
)
from livepde.verdict.judge import Judge, ScoredSample
from livepde.verdict.ledger import WINDOWS, Ledger
from livepde.verdict.model_errors import Allowed, ModelErrors
from livepde.verdict.shifts import REFINE, Shifts, discretised, held_inputs

__all__ = [
    "FEWEST",
    "FLAT",
    "LEVELS",
    "MOST",
    "NOT_JUDGED",
    "NUMBERS",
    "PROMISES",
    "REFINE",
    "REFUSED",
    "WINDOWS",
    "Allowed",
    "Cause",
    "Dictionary",
    "Finding",
    "InputLedger",
    "Judge",
    "Ledger",
    "ModelErrors",
    "Position",
    "ScoreDirection",
    "ScoredSample",
    "Severity",
    "Shifts",
    "Verdict",
    "WithheldLedger",
    "assess",
    "at_bound",
    "channel_setting",
    "discretised",
    "flat",
    "held_inputs",
    "too_few",
]
