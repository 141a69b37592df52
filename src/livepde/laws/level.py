"""How large the noise is: found from what updates leave of the samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["NoiseLevel"]

WINDOW = 500  # samples: older ones fade
GUESS = 2.0  # samples that the first guess counts for
LEARN = 0.3  # of a sample each adds to the count: errors of the first guess fade fast


@dataclass(frozen=True)
class NoiseLevel:
    """The noise as a multiple of a first guess, by expectation maximisation sample by sample.

    Under the right level the mean square of what an update leaves of a sample, with the variance
    that is left of its prediction, is that of the noise, also while the parameters are uncertain.

    Attributes
    ----------
    square
        Square of the multiple.
    count
        Samples that it stands for, at most `WINDOW`.
    """

    square: float = 1.0
    count: float = GUESS

    @property
    def scale(self) -> float:
        """The multiple."""
        return float(np.sqrt(self.square))

    def times(self, factor: float) -> NoiseLevel:
        """Return the level of noise that is larger by a factor."""
        return NoiseLevel(self.square * factor**2, self.count)

    def add(self, left: float) -> NoiseLevel:
        """Return the level after a sample.

        Parameters
        ----------
        left
            Mean square of residual and left variance of the sample, in units of the noise so far.
        """
        count = min(self.count + LEARN, WINDOW)
        return NoiseLevel(self.square * (1.0 + (left - 1.0) / count), count)
