"""Salvage of the whole records of a damaged journal."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from livepde.errors import RunError
from livepde.records import Record
from livepde.runs.database import damaged, released, salvager
from livepde.runs.journal import ESTIMATES, Journal

__all__ = ["Salvage"]

TABLES = ("estimates", "samples", "checkpoints", "fields")
MOST = 100_000_000  # numbers of records that are looked for


class Salvage(Journal):
    """A damaged journal, read record by record: those that are whole, and how many are not.

    Its layout has to be whole: without it no number has a name.

    Attributes
    ----------
    lost
        Numbers of the samples whose estimates are gone or not as they were.

    Raises
    ------
    RunError
        There is no journal, or its layout is damaged.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise RunError(f"{path}: there is no journal.")
        with released(path, None):
            super().__init__(path, salvager(path), None)
        self.lost: list[int] = []

    def _stand(self) -> None:
        self._last = self._newest = min(max(map(self._top, TABLES)), MOST)
        self._current = self._last
        if not self._last:
            raise RunError(damaged(self.path, "no record is whole"))

    def _top(self, table: str) -> int:
        """Return the largest number of a record in a table, as far as that can be read."""
        try:
            return self._highest(table)
        except RunError:
            pass
        # Where the last page is damaged, the records before it can still be read one by one.
        top = 0
        try:
            for (number,) in self._db.execute(f"SELECT id FROM {table} ORDER BY id"):
                top = number
        except sqlite3.Error:
            pass
        return top

    def _meta(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for key in ("channels", "layout", "thinned"):
            rows = self._sound("meta", self._read("SELECT * FROM meta WHERE key = ?", key))
            found |= dict(rows)
        if missing := {"channels", "layout"} - found.keys():
            raise RunError(damaged(self.path, f"no {' and no '.join(sorted(missing))}"))
        return found

    @property
    def verdict(self) -> str:
        """The verdict that was kept last, as JSON; empty if there is none or it is damaged."""
        try:
            return super().verdict
        except RunError:
            return ""

    def after(self, number: int) -> Iterator[tuple[int, Record]]:
        """Iterate over the whole estimates after one, with their numbers."""
        end, every = self._thinning()
        withdrawn = self._known_withdrawn()
        self.lost = []
        for k in range(number + 1, self._last + 1):
            record = self._whole(k)
            if record is not None:
                yield k, record
            elif k not in withdrawn and not (k < end and k % every):
                self.lost.append(k)

    def _known_withdrawn(self) -> set[int]:
        try:
            return self._withdrawn()
        except RunError:
            return set()

    def _whole(self, number: int) -> Record | None:
        """Return an estimate, without its fields if those are damaged; None if it is not whole."""
        try:
            rows = self._read(f"{ESTIMATES} id = ?", number)
        except RunError:
            rows = []
        if not rows:
            return self._plain(number)
        try:
            return self._estimate(rows[0])
        except RunError:
            return self._plain(number)

    def _plain(self, number: int) -> Record | None:
        """Return an estimate without its fields, None if it is not whole."""
        try:
            rows = self._read("SELECT * FROM estimates WHERE id = ?", number)
            return self._estimate((*rows[0], None, None, None)) if rows else None
        except RunError:
            return None

    def sentences(self) -> list[str]:
        """Return sentences on the damaged parts; known once all has been read."""
        kept = self._last - len(self.lost)
        if not self.lost:
            return [f"All {kept} estimates are whole."]
        first, last = self.lost[0], self.lost[-1]
        return [
            f"{len(self.lost)} of {self._last} estimates are not whole, the first of sample "
            f"{first}, the last of sample {last}: they are left out."
        ]
