"""Closed surfaces spanned between rings of points, the one way simulated shapes are made: no booleans needed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sidelong.types import FloatArray, IntArray


def polar_ring(radius: FloatArray | float, z: float, points: int) -> FloatArray:
    """Return a ring (points, 3) about the z axis at height ``z``; ``radius`` is a number or one for each point."""
    angles_rad = ring_angles_rad(points)
    return np.stack([radius * np.cos(angles_rad), radius * np.sin(angles_rad), np.full(points, z)], axis=-1)


def ring_angles_rad(points: int) -> FloatArray:
    """Return the angles (points,) at which ``polar_ring`` puts its points."""
    return np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)


def rectangle_ring(size_x: float, size_y: float, z: float) -> FloatArray:
    """Return the corners (4, 3) of a rectangle centred on the z axis."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) / 2
    return np.column_stack([corners * (size_x, size_y), np.full(4, z)])


def loft(rings: Sequence[FloatArray], cyclic: bool = False) -> tuple[FloatArray, IntArray]:
    """Span a closed surface between consecutive rings.

    Parameters
    ----------
    rings
        R rings of the same number n of points, (n, 3) each.
    cyclic
        Join the last ring to the first (a tube that closes on itself, or a part with a bore); otherwise both ends get
        a flat cap.

    Returns
    -------
    vertices (V, 3) and triangles (F, 3), counter-clockwise seen from outside.
    """
    count, points = len(rings), len(rings[0])
    index = np.arange(count * points).reshape(count, points)
    lower = index if cyclic else index[:-1]
    upper = np.roll(index, -1, axis=0) if cyclic else index[1:]
    a, b, c, d = lower, np.roll(lower, -1, axis=1), np.roll(upper, -1, axis=1), upper
    triangles = [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    vertices = np.concatenate(list(rings))
    if not cyclic:
        first, last = len(vertices), len(vertices) + 1
        vertices = np.concatenate([vertices, [rings[0].mean(axis=0), rings[-1].mean(axis=0)]])
        triangles += [_fan(index[0][::-1], first), _fan(index[-1], last)]
    return vertices, _outward(vertices, np.concatenate(triangles).astype(np.intp))


def joined(shells: Sequence[tuple[FloatArray, IntArray]]) -> tuple[FloatArray, IntArray]:
    """Put closed surfaces into one mesh as they are: where they overlap, the inner walls stay, which no ray sees."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in shells)])
    vertices = np.concatenate([vertices for vertices, _ in shells])
    return vertices, np.concatenate([faces + offset for (_, faces), offset in zip(shells, offsets[:-1], strict=True)])


def _fan(ring: IntArray, centre: int) -> IntArray:
    return np.stack([ring, np.roll(ring, -1), np.full(len(ring), centre)], axis=-1)


def _outward(vertices: FloatArray, triangles: IntArray) -> IntArray:
    """Turn all triangles if the enclosed volume is negative."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    volume = float(np.einsum("ij,ij", a, np.cross(b, c))) / 6.0
    return triangles if volume > 0 else np.ascontiguousarray(triangles[:, ::-1])
