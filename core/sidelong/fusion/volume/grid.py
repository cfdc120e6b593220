"""Voxels in blocks: a dense table of the region's blocks, of which only those near a surface have voxels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sidelong.kernels import compiled
from sidelong.types import Float32Array

BLOCK = 4
"""Voxels along a side of a block."""
VOXELS = BLOCK**3
CHUNK = 8
"""Voxels along a side of a chunk, for which it is counted how often all of it was seen through."""
CELL = 2
"""Voxels along a side of a cell, for which it is counted how often it was seen through besides."""
CELLS = (CHUNK // CELL) ** 3
MOST_COUNTED = np.iinfo(np.uint16).max
"""Counts stop there."""

Uint16Array = NDArray[np.uint16]


class Grid(NamedTuple):
    """What is known of each voxel; lengths are in voxels.

    Attributes
    ----------
    slots
        (X, Y, Z) for each block of the region where its voxels are in the arrays ``sums`` and ``counts``, -1 for none.
    sums
        (S, 64, 2): the information 1/sigma^2 of all distances to the surface that views gave, and the sum of distances
        times information. Positive is before the surface.
    counts
        (S, 64, 2): how many views gave one, and one more than the lowest step of these, 0 for none.
    chunks_through
        (X / 2, Y / 2, Z / 2): how many views saw through a whole chunk.
    cells_through
        (X / 2, Y / 2, Z / 2, 64): how many others saw through a cell of it.
    """

    slots: NDArray[np.int32]
    sums: Float32Array
    counts: Uint16Array
    chunks_through: Uint16Array
    cells_through: Uint16Array


BYTES_PER_CHUNK = (CHUNK // BLOCK) ** 3 * (4 + 2) + 2 + 2 * CELLS
"""Of a chunk without voxels: the slots of its blocks and the marks that two threads make, and its counts."""
BYTES_PER_SLOT = VOXELS * (2 * 4 + 2 * 2)


def empty_grid(chunks: tuple[int, int, int], slots: int) -> Grid:
    """Return a grid with room for this many slots; the system hands out their memory only when they are written to."""
    blocks = tuple(CHUNK // BLOCK * number for number in chunks)
    return Grid(
        np.full(blocks, -1, dtype=np.int32),
        np.zeros((slots, VOXELS, 2), dtype=np.float32),
        np.zeros((slots, VOXELS, 2), dtype=np.uint16),
        np.zeros(chunks, dtype=np.uint16),
        np.zeros((*chunks, CELLS), dtype=np.uint16),
    )


@compiled
def slot_of(grid: Grid, x: int, y: int, z: int) -> int:
    """Return where the voxels of the block around a voxel are, -1 for nowhere."""
    i, j, k = x >> 2, y >> 2, z >> 2
    if x < 0 or y < 0 or z < 0 or i >= grid.slots.shape[0] or j >= grid.slots.shape[1] or k >= grid.slots.shape[2]:
        return -1
    return int(grid.slots[i, j, k])


@compiled
def views_through(grid: Grid, x: int, y: int, z: int) -> int:
    """Return how many views saw through the cell of a voxel of the region."""
    cell = ((x & 6) << 3) | ((y & 6) << 1) | ((z & 6) >> 1)
    i, j, k = x >> 3, y >> 3, z >> 3
    return int(grid.chunks_through[i, j, k]) + int(grid.cells_through[i, j, k, cell])


@compiled
def read_voxel(grid: Grid, x: int, y: int, z: int, least: float) -> tuple[float, float, int]:
    """Return information, distance and step + 1 of a voxel; no information where it is unknown or likely free space.

    ``least`` is the least probability of being no outlier. With a uniform prior, ``n`` views that put a surface near
    the voxel and ``m`` that saw through it leave a Beta distribution whose mean is ``(1 + n) / (2 + n + m)``.
    """
    slot = slot_of(grid, x, y, z)
    if slot < 0:
        return 0.0, 0.0, 0
    voxel = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
    information = float(grid.sums[slot, voxel, 0])
    if information <= 0:
        return 0.0, 0.0, 0
    near = int(grid.counts[slot, voxel, 0])
    if 1 + near <= least * (2 + near + views_through(grid, x, y, z)):
        return 0.0, 0.0, 0
    return information, grid.sums[slot, voxel, 1] / information, int(grid.counts[slot, voxel, 1])
