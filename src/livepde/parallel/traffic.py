"""Message counts between ranks, from the team and from PETSc."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from livepde.parallel.team import Team

__all__ = ["Traffic", "TrafficLog"]


@dataclass(frozen=True)
class Traffic:
    """Message counts, summed over all ranks.

    Attributes
    ----------
    messages, size
        Messages between ranks within PETSc, and their bytes.
    reductions
        Collective operations, such as inner products.
    led_messages, led_size
        Messages between rank 0 and the others, and their bytes: scattered and gathered vectors.
    """

    messages: float
    size: float
    reductions: float
    led_messages: float
    led_size: float

    def since(self, before: Traffic) -> Traffic:
        """Return the difference to an earlier count."""
        mine, theirs = vars(self), vars(before)
        return Traffic(**{name: mine[name] - theirs[name] for name in mine})


class TrafficLog:
    """PETSc's message log since construction; shared by all ranks."""

    def __init__(self, team: Team) -> None:
        from petsc4py import PETSc

        self.team = team
        PETSc.Log.begin()

    def close(self) -> None:
        """Do nothing: PETSc has a single log, which continues."""

    def read(self, folder: str) -> Traffic:
        """Return the counts so far; on rank 0 the sum over all ranks."""
        from petsc4py import PETSc

        path = Path(folder) / "log.txt"
        viewer = PETSc.Viewer().createASCII(str(path), comm=self.team.comm)
        PETSc.Log.view(viewer)
        viewer.destroy()
        text = path.read_text() if self.team.rank == 0 else ""
        size, messages = self.team.sent
        return Traffic(
            _last(text, "Msg Count"),
            _last(text, "Msg Len"),
            _last(text, "Reductions"),
            messages,
            size,
        )


def traffic(log: object) -> Traffic:
    """Return the counts of a shared log; only rank 0 calls this."""
    with tempfile.TemporaryDirectory() as folder:
        found: Traffic = log("read", folder)  # type: ignore[operator]
    return found


def _last(text: str, name: str) -> float:
    """Return the last number in a line of PETSc's summary; for Reductions the first."""
    line = re.search(rf"^MPI {name}[^:]*:(.*)$", text, flags=re.MULTILINE)
    if line is None:
        return 0.0
    numbers = [float(word) for word in line.group(1).split()]
    return numbers[0] if name == "Reductions" else numbers[-1]
