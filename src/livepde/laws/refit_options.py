"""Options of the refit."""

from __future__ import annotations

from dataclasses import dataclass, field

from livepde.errors import LawError


@dataclass(frozen=True)
class Refit:
    """Fit the stored samples again: at the start of a run, at its end, and on demand.

    An update leaves a second-order error that a state with long memory never forgets, and far from
    the truth it may end anywhere. The refit is a search for the most probable constant unknowns
    given all stored samples: Levenberg-Marquardt steps in a trust region, new starts where the end
    does not explain the samples, and a second look at refused readings. See `livepde.laws.refit`.

    The samples are fitted each time their number has doubled, so that most of the search is over
    while they are few. Such a call of `step` takes longer than others. Where it must not, as in a
    control loop or a live run, `apart` fits them in a thread of its own.

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
    apart
        True: a fit of more than 64 samples runs in a thread, while samples continue. An eighth more
        samples later the filter goes over to it; then each call of `step` takes three of the
        samples in between, until all are taken. The numbers do not depend on the time that the fit
        takes: a call waits for it where it is due and not there yet. Members of a fleet are fitted
        at once. None: in runs of a case that wait for their source.
    """

    start: int = 4096
    window: int = 4096
    passes: int = 40
    # It moves when a fit is used, not what the run is of.
    apart: bool | None = field(default=None, metadata={"begins_anew": True})

    def __post_init__(self) -> None:
        for name, least in (("start", 0), ("window", 2), ("passes", 1)):
            value = getattr(self, name)
            if value < least:
                raise LawError(f"Refit: {name} must be at least {least}; got {value}.")
