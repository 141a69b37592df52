"""Where samples come from."""

from __future__ import annotations

from livepde.streams.twin import AbsoluteNoise, Noise, RelativeNoise, Twin

__all__ = ["AbsoluteNoise", "Noise", "RelativeNoise", "Twin"]
