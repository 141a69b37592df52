"""The same data and the same model in what users write and take today.

Each peer is given the reduced coordinates, the prior, the noise level and the initial state that
our laws are given, and steps of our forward model. Where it has a knob, the setting that does best
*with the truth* on the very data set is reported, which favours it. A package that is not installed
is a row that says so: `pip install --group peers`.
"""

from __future__ import annotations

from benchmarks.peers.table import PEERS, PROBLEMS, ROWS, Peer, peers

__all__ = ["PEERS", "PROBLEMS", "ROWS", "Peer", "peers"]
