"""Comparison with estimators of other packages, and with filters that users would write.

Each peer receives the reduced coordinates, the prior, the noise level and the initial state of our
laws, and steps of our forward model. If it has options, the setting with the smallest *true* error
on the same data set is reported, which favours it. The row of a package that is not installed has a
note. `pip install --group peers` installs all packages.
"""

from __future__ import annotations

from benchmarks.peers.table import PEERS, PROBLEMS, ROWS, Peer, peers

__all__ = ["PEERS", "PROBLEMS", "ROWS", "Peer", "peers"]
