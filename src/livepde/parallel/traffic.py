"""What crosses between ranks: counted by the team and by PETSc."""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

from livepde.parallel.team import Team

__all__ = ["Traffic", "TrafficLog"]


@dataclass(frozen=True)
class Traffic:
    """Sums over all ranks.

    Attributes
    ----------
    messages, size
        Within PETSc: messages from rank to rank, and their bytes.
    reductions
        Operations of all ranks together, such as an inner product.
    led_messages, led_size
        Between rank 0 and the others: vectors that are cut and put together.
    """

    messages: float
    size: float
    reductions: float
    led_messages: float
    led_size: float

    def since(self, before: Traffic) -> Traffic:
        """Return what came after another count."""
        mine, theirs = vars(self), vars(before)
        return Traffic(**{name: mine[name] - theirs[name] for name in mine})


class TrafficLog:
    """PETSc's log of messages, from its making on; shared by all ranks."""

    def __init__(self, team: Team) -> None:
        from petsc4py import PETSc

        self.team = team
        PETSc.Log.begin()

    def close(self) -> None:
        """The log goes on: PETSc has one for all."""

    def read(self, folder: str) -> Traffic:
        """Return the counts so far, on rank 0 what all ranks have sent."""
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
    """Return what a shared log has counted; only rank 0 calls this."""
    with tempfile.TemporaryDirectory() as folder:
        found: Traffic = log("read", folder)  # type: ignore[operator]
    return found


def _last(text: str, name: str) -> float:
    """Return the last number of a line of PETSc's summary; of Reductions the first."""
    line = re.search(rf"^MPI {name}[^:]*:(.*)$", text, flags=re.MULTILINE)
    if line is None:
        return 0.0
    numbers = [float(word) for word in line.group(1).split()]
    return numbers[0] if name == "Reductions" else numbers[-1]
