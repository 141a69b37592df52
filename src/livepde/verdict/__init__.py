"""Verdict of a run on itself: trusted, caution or do not trust, with what speaks against it."""

from livepde.verdict.assess import Position, assess
from livepde.verdict.directions import Dictionary, Direction
from livepde.verdict.findings import FLAT, LEVELS, TELLING, Cause, Finding, Verdict
from livepde.verdict.judge import Judge, Seen
from livepde.verdict.ledger import WINDOWS, Ledger

__all__ = [
    "FLAT",
    "LEVELS",
    "TELLING",
    "WINDOWS",
    "Cause",
    "Dictionary",
    "Direction",
    "Finding",
    "Judge",
    "Ledger",
    "Position",
    "Seen",
    "Verdict",
    "assess",
]
