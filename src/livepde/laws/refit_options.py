"""Options of the refit."""

from __future__ import annotations

from dataclasses import dataclass

from livepde.errors import LawError

__all__ = ["Refit"]


@dataclass(frozen=True)
class Refit:
    """Fit the stored samples again: at the start of a run, at its end, and on demand.

    An update leaves a second-order error that a state with long memory never forgets, and far from
    the truth it may end anywhere. The refit is a search for the most probable constant unknowns
    given all stored samples: Levenberg-Marquardt steps in a trust region, new starts where the end
    does not explain the samples, and a second look at refused readings. See `livepde.laws.refit`.

    The samples are fitted each time their number has doubled, so that most of the search is over
    while they are few. Such a call of `step` takes longer than others; where it must not, as in a
    control loop, a smaller `start` leaves later fits to the end of the run (`Identifier.run`,
    `livepde run`) and to `Identifier.refit`.

    Unknowns that move, noisy inputs and a fading memory have no such fit: there the samples of the
    start are smoothed again, as `livepde.laws.iterated_smoother` does.

    Parameters
    ----------
    start
        Up to this many samples are taken again at each doubling; 64 at most of unknowns that move.
    window
        At most this many samples are stored. When it is full, the estimate of that moment becomes
        the prior of the next window.
    passes
        A search that takes more passes over the samples has not converged.
    """

    start: int = 4096
    window: int = 4096
    passes: int = 40

    def __post_init__(self) -> None:
        for name, least in (("start", 0), ("window", 2), ("passes", 1)):
            value = getattr(self, name)
            if value < least:
                raise LawError(f"Refit: {name} must be at least {least}; got {value}.")
