"""Fields of a run in a browser: along an interval, on a plane domain, in a solid.

Matrices that interpolate values at the vertices to the drawn points are cached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
import plotly.graph_objects as go
import scipy.sparse as sp
import xarray as xr
from scipy.spatial import Delaunay

from livepde.dashboard.figures import canvas
from livepde.linalg import Array, IntArray
from livepde.plots import GREY, PALETTE, interval_95, sensor_places
from livepde.plots.style import axis_label
from livepde.runs.exported import kinds_of

MOST_LINES = 120  # largest number of lines of a map in each direction
OUTSIDE = 1e-9  # tolerance of negative barycentric coordinates
# A hexahedron as six tetrahedra around its diagonal from corner 0 to corner 6.
TETRAHEDRA = ((0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6))
FACES = {
    "tetra": ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)),
    "hexahedron": (
        (0, 1, 2, 3),
        (4, 5, 6, 7),
        (0, 1, 5, 4),
        (1, 2, 6, 5),
        (2, 3, 7, 6),
        (3, 0, 4, 7),
    ),
}
FINE = 0.2  # share of a mesh's lines on each side that may be far outside
OUT = 4.0  # size of a domain over its finely meshed part from which a map begins with this part


@dataclass(frozen=True, eq=False)
class Map:
    """A grid on a plane domain that is as fine as its mesh."""

    x: Array  # coordinates of the grid lines
    y: Array
    # Interpolation from vertices to grid points, row by row; shape (len(y) * len(x), vertices)
    weights: sp.csr_array
    inside: Any  # points inside the domain

    def of(self, values: Array) -> Array:
        """Return a field on the grid, shape (len(y), len(x)); NaN outside the domain."""
        found = np.where(self.inside, self.weights @ values, np.nan)
        return found.reshape(len(self.y), len(self.x))


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in space."""

    points: Array  # shape (points, 3)
    triangles: Any  # shape (triangles, 3)
    weights: sp.csr_array  # interpolation from the vertices of the mesh to the points

    def of(self, values: Array) -> Array:
        """Return the values of a field at the points."""
        found: Array = self.weights @ values
        return found


@dataclass(frozen=True)
class _Mesh:
    """Vertices and cells, compared by their content: a key of cached cuts."""

    content: tuple[bytes, bytes]
    points: Array = field(compare=False)
    cells: IntArray = field(compare=False)

    @classmethod
    def of(cls, data: xr.Dataset) -> _Mesh:
        """Return the mesh of a dataset; default cells: a Delaunay triangulation."""
        points = np.column_stack([data[axis].values for axis in "xyz" if axis in data.coords])
        kinds = kinds_of(data)
        cells = data[kinds[0]].values if kinds else Delaunay(points).simplices
        cells = cells.astype(np.intp)
        return cls((points.tobytes(), cells.tobytes()), points, cells)


def plane_map(data: xr.Dataset) -> Map:
    """Return the grid of a run in two space dimensions."""
    return _plane_map(_Mesh.of(data))


def boundary(data: xr.Dataset) -> Surface:
    """Return the surface of a solid domain."""
    return _boundary(_Mesh.of(data))


def slices(data: xr.Dataset, share: float = 0.5) -> list[Surface]:
    """Return the cuts of a solid domain by three planes, across x, y and z.

    `share`: position of each plane, as a share of the range of its coordinate.
    """
    return _slices(_Mesh.of(data), share)


def _lines(values: Array) -> Array:
    """Return the lines of a grid: through vertices, and between these if there are few."""
    lines = np.unique(values.round(12))
    # Every other line and the last one while there are too many; then halve the distances.
    while len(lines) > MOST_LINES:
        lines = np.unique(np.append(lines[::2], lines[-1]))
    while 2 * len(lines) - 1 <= MOST_LINES:
        lines = np.insert(lines, np.arange(1, len(lines)), (lines[1:] + lines[:-1]) / 2)
        if len(lines) < 2:
            break
    return lines


@lru_cache(maxsize=4)
def _plane_map(mesh: _Mesh) -> Map:
    corners = mesh.cells
    if corners.shape[1] == 4:
        corners = np.vstack([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    x, y = (_lines(values) for values in mesh.points.T)
    count = len(x) * len(y)
    vertices = np.zeros((count, 3), dtype=np.intp)
    weights = np.zeros((count, 3))
    inside = np.zeros(count, dtype=bool)
    p = mesh.points[corners]  # (triangles, 3, 2)
    margin = OUTSIDE * np.ptp(mesh.points, axis=0)
    low, high = p.min(axis=1) - margin, p.max(axis=1) + margin
    columns = np.searchsorted(x, low[:, 0]), np.searchsorted(x, high[:, 0], "right")
    rows = np.searchsorted(y, low[:, 1]), np.searchsorted(y, high[:, 1], "right")
    for k, (a, b, c) in enumerate(p):
        i, j = np.meshgrid(
            np.arange(columns[0][k], columns[1][k]), np.arange(rows[0][k], rows[1][k])
        )
        # Barycentric coordinates of grid points in a triangle's bounding box, by Cramer's rule.
        to_b, to_c = b - a, c - a
        area = to_b[0] * to_c[1] - to_b[1] * to_c[0]
        if not i.size or not area:
            continue
        dx, dy = x[i] - a[0], y[j] - a[1]
        second = (dx * to_c[1] - dy * to_c[0]) / area
        third = (dy * to_b[0] - dx * to_b[1]) / area
        share = np.stack([1.0 - second - third, second, third], axis=-1)
        hit = (share >= -OUTSIDE).all(axis=-1)
        at = (j * len(x) + i)[hit]
        vertices[at], weights[at], inside[at] = corners[k], share[hit], True
    matrix = sp.csr_array(
        (weights.ravel(), (np.repeat(np.arange(count), 3), vertices.ravel())),
        shape=(count, len(mesh.points)),
    )
    return Map(x, y, matrix, inside)


@lru_cache(maxsize=4)
def _boundary(mesh: _Mesh) -> Surface:
    faces = FACES["tetra" if mesh.cells.shape[1] == 4 else "hexahedron"]
    every = np.vstack([mesh.cells[:, list(face)] for face in faces])
    _, first, count = np.unique(
        np.sort(every, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = every[first[count == 1]]  # faces between two cells occur twice
    if outer.shape[1] == 4:
        outer = np.vstack([outer[:, [0, 1, 2]], outer[:, [0, 2, 3]]])
    used, triangles = np.unique(outer, return_inverse=True)
    weights = sp.eye_array(len(mesh.points), format="csr")[used]
    return Surface(mesh.points[used], triangles.reshape(outer.shape), weights)


@lru_cache(maxsize=8)
def _slices(mesh: _Mesh, share: float) -> list[Surface]:
    cells = mesh.cells
    if cells.shape[1] == 8:
        cells = np.vstack([cells[:, list(corners)] for corners in TETRAHEDRA])
    least, size = mesh.points.min(axis=0), np.ptp(mesh.points, axis=0)
    return [_slice(mesh.points, cells, axis, least[axis] + share * size[axis]) for axis in range(3)]


def _slice(points: Array, cells: Any, axis: int, at: float) -> Surface:
    """Return the cut of tetrahedra by a plane across an axis."""
    height = points[:, axis] - at
    above = (height >= 0.0)[cells]
    order = np.argsort(~above, axis=1, kind="stable")  # corners above the plane come first
    cells, count = np.take_along_axis(cells, order, axis=1), above.sum(axis=1)
    # A cut that separates one or three corners is a triangle, else it is two triangles.
    edges = []  # three cut edges of each triangle
    for number, triangles in (
        (1, (((0, 1), (0, 2), (0, 3)),)),
        (2, (((0, 2), (0, 3), (1, 3)), ((0, 2), (1, 3), (1, 2)))),
        (3, (((0, 3), (1, 3), (2, 3)),)),
    ):
        cut = cells[count == number]
        edges += [np.stack([cut[:, list(edge)] for edge in three], 1) for three in triangles]
    every = np.concatenate(edges).reshape(-1, 2)
    ends, triangles_of = np.unique(np.sort(every, axis=1), axis=0, return_inverse=True)
    first, second = height[ends[:, 0]], height[ends[:, 1]]
    # The height above the plane is linear along an edge, and zero at the cut.
    share = first / (first - second)  # both have opposite signs
    rows = np.arange(len(ends))
    weights = sp.csr_array(
        (np.append(1.0 - share, share), (np.append(rows, rows), ends.T.ravel())),
        shape=(len(ends), len(points)),
    )
    return Surface(weights @ points, triangles_of.reshape(-1, 3), weights)


def drawn_by(data: xr.Dataset, cut: float) -> tuple[Callable[..., go.Figure], str]:
    """Return the function that draws a field, and a hint for its caption."""
    if "z" in data.coords:
        hint = f" Translucent surface, and three cuts at {cut:.0%} of its size: drag to rotate."
        return partial(field_solid, cut=cut), hint
    if "y" in data.coords:
        drawn = plane_map(data)
        zoomed = _fine(drawn.x) or _fine(drawn.y)
        hint = " The region of fine mesh is shown. Double-click to show all."
        return field_map, hint if zoomed else ""
    return field_profile, " Grey: initial state."


def field_profile(data: xr.Dataset, name: str, at: float | None = None) -> go.Figure:
    """Draw a field along an interval, with its 95 % band and its initial values."""
    k = canvas.at_time(data, "snapshot", at)
    figure = canvas.empty(axis_label(data, "x"), canvas.unit_label(data, name))
    x, values = data["x"].values, data[name].values
    reach = [values]
    if k > 0:
        canvas.line(figure, x, values[0], GREY, 1.2, "dot", name="start", hovertemplate="%{y:.4g}")
    if f"{name}_std" in data:
        low, high = interval_95(data, name)
        # The wide band of the prior would hide all later values, so it does not set the scale.
        late = slice(len(values) // 10, None)
        reach += [low[late], high[late]]
        canvas.band(figure, x, low[k], high[k], PALETTE[0], name)
    canvas.line(figure, x, values[k], PALETTE[0], 2.2, name="estimate", hovertemplate="%{y:.4g}")
    canvas.show(figure, reach)
    figure.update_layout(showlegend=k > 0)
    return figure


def field_map(data: xr.Dataset, name: str, at: float | None = None) -> go.Figure:
    """Draw a field on a plane domain, on a grid as fine as its mesh."""
    drawn = plane_map(data)
    values = data[name].values[canvas.at_time(data, "snapshot", at)]
    figure = canvas.empty(axis_label(data, "x"), axis_label(data, "x", "y"), height=380)
    figure.add_heatmap(
        x=drawn.x,
        y=drawn.y,
        z=drawn.of(values).astype(np.float32),
        **_colours(data, name),
        zsmooth="best",
        hovertemplate="x %{x:.4g}, y %{y:.4g}: %{z:.4g}<extra></extra>",
    )
    for kind, sensors in sensor_places(data).items():
        inside, edge = ("white", "black") if kind == "sensor" else ("black", "white")
        figure.add_scatter(
            x=sensors.x,
            y=sensors.y,
            text=sensors.names,
            mode="markers",
            marker={"size": 7, "color": inside, "line": {"color": edge, "width": 1.2}},
            showlegend=False,
            hovertemplate=f"{kind} %{{text}}<extra></extra>",
        )
    plain = {"constrain": "domain", "showgrid": False, "zeroline": False}
    figure.update_xaxes(range=_fine(drawn.x), **plain)
    figure.update_yaxes(range=_fine(drawn.y), scaleanchor="x", **plain)
    figure.update_layout(hovermode="closest")
    return figure


def _fine(lines: Array) -> list[float] | None:
    """Return the finely meshed part of a domain if the domain is much larger."""
    low, high = np.quantile(lines, [FINE, 1.0 - FINE]).tolist()
    return [low, high] if np.ptp(lines) > OUT * (high - low) else None


def field_solid(
    data: xr.Dataset, name: str, at: float | None = None, cut: float = 0.5
) -> go.Figure:
    """Draw a field in a solid: a transparent surface, and cuts across x, y and z."""
    values = data[name].values[canvas.at_time(data, "snapshot", at)]
    figure = canvas.empty(height=440)
    parts = [(boundary(data), 0.15), *((found, 1.0) for found in slices(data, cut))]
    low, high = float(values.min()), float(values.max())
    for k, (surface, opacity) in enumerate(parts):
        x, y, z = surface.points.T
        i, j, l = surface.triangles.T
        figure.add_mesh3d(
            x=x,
            y=y,
            z=z,
            i=i,
            j=j,
            k=l,
            intensity=surface.of(values),
            cmin=low,
            cmax=high if high > low else low + 1.0,
            **_colours(data, name),
            showscale=k == 0,
            opacity=opacity,
            flatshading=True,
            lighting={"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
            hovertemplate="%{x:.4g}, %{y:.4g}, %{z:.4g}: %{intensity:.4g}<extra></extra>",
        )
    axes = {
        f"{axis}axis": {
            "title": {"text": canvas.text(axis_label(data, "x", axis))},
            "gridcolor": canvas.GRID,
        }
        for axis in "xyz"
    }
    camera = {"eye": {"x": 1.5, "y": 1.5, "z": 1.1}, "center": {"x": 0, "y": 0, "z": -0.1}}
    figure.update_layout(
        hovermode="closest", scene={**axes, "aspectmode": "data", "camera": camera}
    )
    return figure


def _colours(data: xr.Dataset, name: str) -> dict[str, Any]:
    """Return the colours of a field and their colour bar."""
    title = {"text": canvas.text(canvas.unit_label(data, name)), "side": "right"}
    bar = {"title": title, "thickness": 14, "outlinewidth": 0, "exponentformat": "power"}
    return {"colorscale": "Cividis" if name.endswith("_std") else "Viridis", "colorbar": bar}
