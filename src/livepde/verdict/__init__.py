"""Verdict of a run on itself: its level, with the findings against it."""

from livepde.verdict.assess import REFUSED, Position, assess
from livepde.verdict.directions import Dictionary, ScoreDirection
from livepde.verdict.findings import (
    FEWEST,
    FLAT,
    LEVELS,
    MOST,
    NOT_JUDGED,
    NUMBERS,
    PROMISES,
    REFINE,
    Cause,
    Finding,
    Severity,
    Shifts,
    Verdict,
    at_bound,
    channel_setting,
    discretised,
    flat,
    held_inputs,
    too_few,
)
from livepde.verdict.judge import Judge, ScoredSample
from livepde.verdict.ledger import WINDOWS, InputLedger, Ledger, ValidationLedger
from livepde.verdict.model_errors import Allowed, ModelErrors

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
    "ValidationLedger",
    "Verdict",
    "assess",
    "at_bound",
    "channel_setting",
    "discretised",
    "flat",
    "held_inputs",
    "too_few",
]
