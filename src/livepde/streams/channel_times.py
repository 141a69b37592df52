"""Times of each channel of a source: its usual step, times far ahead, and times that went back.

The program never changes a time. A row far ahead waits until the rows that follow agree with it; a
row that went back is not used. Both are reported, with the key that corrects a wrong clock.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

STEPS = 16  # last steps of a channel, of which the longest but one is the usual step
NEXT = 1.5  # usual steps up to which a time is the next one
CALM = 1.5  # intervals between two times that went back, after which a clock is steady again
FAR = 10.0  # usual steps: a row that is farther ahead waits. It costs a delay, and no row
NAN = math.nan


def usual_of(steps: Sequence[float]) -> float:
    """Return the longest but one of several steps, NaN of none."""
    # The longest step may be a pause of the source, which is not usual.
    return sorted(steps)[-2:][0] if steps else NAN


@dataclass
class _Times:
    """Times of one channel: the newest used one, steps, and late times since then."""

    newest: float = -math.inf
    steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS))
    late: float = NAN
    went_back: bool = False
    backs: deque[float] = field(default_factory=lambda: deque(maxlen=2))  # newest times then

    def use(self, t: float) -> bool:
        """Note a time that is used; return whether it shows that the clock was set back."""
        # Late times that lead on to this one: the clock stays as it is. Else it was wrong for a
        # while, or a source has sent its past.
        shifted = self.went_back and t - self.late <= NEXT * usual_of(self.steps)
        if 0.0 < t - self.newest < math.inf:
            self.steps.append(t - self.newest)
        self.newest = max(self.newest, t)
        self.late, self.went_back = NAN, False
        return shifted

    @property
    def unsteady(self) -> bool:
        """Whether the clock has gone back repeatedly, and not been right for long since then."""
        if len(self.backs) < 2:
            return False
        return self.newest - self.backs[-1] < CALM * (self.backs[-1] - self.backs[0])

    def refuse(self, t: float) -> bool:
        """Note a late time; return whether it is the first that shows that the clock went back."""
        # One late row is a row that was delayed. Two that follow one another, with no row in order
        # between them, show a clock that went back or a source that sends its past.
        begins = t > self.late and not self.went_back
        self.went_back |= begins
        if begins:
            self.backs.append(self.newest)
        self.late = t
        return begins


class ChannelTimes:
    """Times of the channels of a source, each by its own steps.

    Parameters
    ----------
    recent
        Times and values of the last samples of an earlier session.
    """

    def __init__(self, recent: Iterable[tuple[float, Mapping[str, float]]] = ()) -> None:
        self._known: dict[str, _Times] = {}
        for t, values in recent:
            self.use(t, values)

    def usual(self, values: Mapping[str, float]) -> float:
        """Return the usual step of the slowest channel with a value in a row; NaN if unknown."""
        known = (self._known[name] for name in present(values) if name in self._known)
        return max((usual_of(times.steps) for times in known if times.steps), default=NAN)

    @property
    def slowest(self) -> float:
        """Usual step of the slowest channel; NaN if unknown."""
        return self.usual(dict.fromkeys(self._known, 0.0))

    def use(self, t: float, values: Mapping[str, float]) -> bool:
        """Note the time of a row that is used; return whether its clock was set back before."""
        shown = [self._known.setdefault(name, _Times()).use(t) for name in present(values)]
        return any(shown)

    def refuse(self, t: float, values: Mapping[str, float]) -> bool:
        """Note the time of a late row; return whether it shows first that its clock went back."""
        shown = [self._known.setdefault(name, _Times()).refuse(t) for name in present(values)]
        return any(shown)

    def withdraw(self, last: float) -> None:
        """Forget that times later than this one were used."""
        for times in self._known.values():
            times.newest = min(times.newest, last)

    @property
    def unsteady(self) -> list[str]:
        """Channels whose clock goes back again and again."""
        return [name for name, times in self._known.items() if times.unsteady]

    @property
    def went_back(self) -> dict[str, float]:
        """Channels whose clock went back, with the time of their last late row."""
        return {name: times.late for name, times in self._known.items() if times.went_back}


def present(values: Mapping[str, float]) -> list[str]:
    """Return the channels with a value, or all channels of a row without any."""
    return [name for name, value in values.items() if not math.isnan(value)] or list(values)
