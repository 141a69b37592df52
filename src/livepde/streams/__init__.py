"""Sources of samples (files, brokers, joined tables, twin experiments) and stages of streams."""

from livepde.streams.clock import Clock
from livepde.streams.csvfile import read_csv
from livepde.streams.gaps import FillGaps
from livepde.streams.smoothing import (
    Exponential,
    LocalPolynomial,
    Smoothed,
    Smoother,
    WindowAverage,
)
from livepde.streams.sources import Follow, Lines, Row, Rows, RowSource
from livepde.streams.table import Column, DataTable, JsonLines, read_json_lines, tabulated
from livepde.streams.twin import AbsoluteNoise, Noise, RelativeNoise, Twin

__all__ = [
    "AbsoluteNoise",
    "Clock",
    "Column",
    "DataTable",
    "Exponential",
    "FillGaps",
    "Follow",
    "JsonLines",
    "Lines",
    "LocalPolynomial",
    "Noise",
    "RelativeNoise",
    "Row",
    "RowSource",
    "Rows",
    "Smoothed",
    "Smoother",
    "Twin",
    "WindowAverage",
    "read_csv",
    "read_json_lines",
    "tabulated",
]
