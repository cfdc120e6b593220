"""What makes a list of triangles a body: closed, wound one way; small cracks and holes are closed, and told.

Rays and normals need a surface that has an outside. It is closed where every edge is run through as often one way as
the other; more than two triangles may share one, as where two bodies touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sidelong.errors import MeshError
from sidelong.geometry.point_sets import distinct_rows
from sidelong.types import FloatArray, IntArray

WELD_SHARE = 1e-4
"""Vertices on open edges that are nearer than this share of the part's extent are one: 5 um on a part of 5 cm."""
WELD_EDGE_SHARE = 0.25
"""And nearer than this share of the shortest open edge: a thin wire keeps its rim."""
LARGEST_HOLES = 0.01
"""Largest share of the surface that may be missing and is closed with flat fans."""


@dataclass(frozen=True, eq=False)
class Shell:
    """Triangles (F, 3) over vertices (V, 3) in metres with a material (F,) each, and what was done to close them."""

    vertices_m: FloatArray
    triangles: IntArray
    material: IntArray
    repairs: tuple[str, ...] = ()


def closed(name: str, shell: Shell) -> Shell:
    """Return a closed shell; one that is closed already is returned as it is.

    Of an open one, triangles that are there twice are dropped, vertices on open edges that nearly coincide are welded
    (``WELD_SHARE``), and what holes remain are closed with a fan each, up to ``LARGEST_HOLES`` of the surface.

    Raises
    ------
    MeshError
        Triangles are wound against each other, or more of the surface is missing.
    """
    for repaired in (_without_repetitions, _welded):
        if not len(_open_edges(name, shell)[0]):
            return shell
        shell = repaired(name, shell)
    return _filled(name, shell)


def _open_edges(name: str, shell: Shell) -> tuple[IntArray, IntArray]:
    """Return edges (E, 2) that have a triangle on one side alone, in its direction, and that triangle (E,)."""
    start, end = shell.triangles.ravel(), np.roll(shell.triangles, -1, axis=1).ravel()
    key = np.minimum(start, end) * len(shell.vertices_m) + np.maximum(start, end)
    _, edge = np.unique(key, return_inverse=True)
    net = np.bincount(edge, weights=np.sign(end - start))
    against = int((np.abs(net) >= 2).sum())
    if against:
        raise MeshError(
            f"{name}: neighbouring triangles are wound against each other along {against} edges, limit 0: outside and "
            "inside are not clear"
        )
    towards = net[edge]
    wanted = np.flatnonzero((towards != 0) & (towards == np.sign(end - start)))
    first = wanted[np.unique(edge[wanted], return_index=True)[1]]
    return np.column_stack([start[first], end[first]]), first // 3


def _without_repetitions(_name: str, shell: Shell) -> Shell:
    """Drop triangles that are there twice with the same winding."""
    lowest = shell.triangles.argmin(axis=1)
    turned = np.take_along_axis(shell.triangles, (lowest[:, None] + np.arange(3)) % 3, axis=1)
    first = np.sort(distinct_rows(turned)[0])
    dropped = len(turned) - len(first)
    if not dropped:
        return shell
    told = f"{dropped} triangles that were there twice are dropped"
    return replace(
        shell, triangles=shell.triangles[first], material=shell.material[first], repairs=(*shell.repairs, told)
    )


def _welded(name: str, shell: Shell) -> Shell:
    """Make one vertex of those on open edges that nearly coincide."""
    from scipy.spatial import cKDTree

    edges, _triangle = _open_edges(name, shell)
    rim = np.unique(edges)
    shortest_m = float(np.linalg.norm(np.diff(shell.vertices_m[edges], axis=1), axis=2).min())
    reach_m = min(WELD_SHARE * float(np.ptp(shell.vertices_m, axis=0).max()), WELD_EDGE_SHARE * shortest_m)
    pairs = cKDTree(shell.vertices_m[rim]).query_pairs(reach_m, output_type="ndarray")
    if not len(pairs):
        return shell
    count, group = _components(pairs, len(rim))
    kept = np.full(count, len(shell.vertices_m))
    np.minimum.at(kept, group, rim)
    index = np.arange(len(shell.vertices_m))
    index[rim] = kept[group]
    moved_m = np.linalg.norm(shell.vertices_m[index[rim]] - shell.vertices_m[rim], axis=1).max()
    told = f"{len(rim) - count} vertices on open edges are welded, moved by at most {moved_m * 1e6:.2g} um"
    return replace(shell, triangles=index[shell.triangles], repairs=(*shell.repairs, told))


def _filled(name: str, shell: Shell) -> Shell:
    """Close each hole with a fan from the middle of its rim; its triangles take the material of the neighbour."""
    edges, neighbour = _open_edges(name, shell)
    if not len(edges):
        return shell
    rim, edge = np.unique(edges, return_inverse=True)
    edge = edge.reshape(-1, 2)
    count, hole = _components(edge, len(rim))
    sizes = np.bincount(hole)[:, None]
    middles = np.stack([np.bincount(hole, weights=axis) for axis in shell.vertices_m[rim].T], axis=1) / sizes
    vertices = np.concatenate([shell.vertices_m, middles])
    fans = np.column_stack([edges[:, ::-1], len(shell.vertices_m) + hole[edge[:, 0]]])
    share = float(_areas(vertices, fans).sum() / _areas(vertices, shell.triangles).sum())
    if share > LARGEST_HOLES:
        raise MeshError(
            f"{name}: the mesh is not watertight, {len(edges)} edges have a triangle on one side alone; closing the "
            f"{count} holes takes {share * 100:.3g} % of its surface, limit {LARGEST_HOLES * 100:g} %"
        )
    told = f"{count} holes with {len(edges)} edges are closed, {share * 100:.2g} % of the surface"
    return Shell(
        vertices,
        np.concatenate([shell.triangles, fans]),
        np.concatenate([shell.material, shell.material[neighbour]]),
        (*shell.repairs, told),
    )


def _components(pairs: IntArray, size: int) -> tuple[int, IntArray]:
    """Return how many groups linked pairs (P, 2) leave of ``size`` things, and the group (size,) of each."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    count, group = connected_components(links, directed=False)
    return int(count), np.asarray(group, dtype=np.intp)


def _areas(vertices_m: FloatArray, triangles: IntArray) -> FloatArray:
    a, b, c = (vertices_m[triangles[:, corner]] for corner in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
