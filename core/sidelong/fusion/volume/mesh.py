"""The surface of a volume as triangles. Open3D does the marching cubes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.fusion.volume.grid import BLOCK, VOXELS, Grid, read_voxel
from sidelong.fusion.volume.march import difference, sample
from sidelong.kernels import compiled, strips
from sidelong.types import Float32Array, FloatArray, IntArray, SceneSurface

NEAR = 2.0
"""Blocks none of whose voxels is nearer to a surface, in voxels, hold none of it."""


def triangulated(grid: Grid, least: float) -> SceneSurface:
    """Return the surfaces of a grid, lengths in voxels; cubes with an unknown corner have none."""
    import open3d as o3d

    blocks = np.argwhere(grid.slots >= 0)
    near = np.zeros(len(blocks), dtype=np.bool_)
    strips(lambda first, last: _fill_near(grid, blocks, least, near, first, last), len(blocks))
    blocks = blocks[near]
    if not len(blocks):
        nothing = np.empty((0, 3))
        return SceneSurface(nothing, nothing, np.empty(0), np.empty((0, 3), dtype=np.intp))
    core: Any = o3d.core
    voxels: Any = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), 1.0, BLOCK, len(blocks)
    )
    indices, _ = voxels.hashmap().activate(core.Tensor(np.ascontiguousarray(blocks.astype(np.int32))))
    # views of Open3D's memory, which is not to be held twice
    distance, known = (voxels.attribute(name).numpy().reshape(-1, VOXELS) for name in ("tsdf", "weight"))
    rows = indices.numpy().astype(np.intp)
    strips(lambda first, last: _fill_field(grid, blocks, rows, least, distance, known, first, last), len(blocks))
    return _with_normals(voxels.extract_triangle_mesh(weight_threshold=0.5), grid, least)


def _with_normals(mesh: Any, grid: Grid, least: float) -> SceneSurface:
    """Return a mesh of Open3D with normals, and with what its vertices are worth.

    Open3D's own normals take unknown voxels for zero distance: at rims they are off by up to 60 degrees.
    """
    vertices = mesh.vertex.positions.numpy().astype(np.float64)
    normals, information = np.empty_like(vertices), np.empty(len(vertices))
    strips(lambda first, last: _fill_vertices(grid, vertices, least, normals, information, first, last), len(vertices))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    np.divide(normals, lengths, out=normals, where=lengths > 0)
    triangles = mesh.triangle.indices.numpy().astype(np.intp)
    return SceneSurface(vertices, normals, 1 / np.sqrt(information), triangles)


@compiled
def _fill_near(grid: Grid, blocks: IntArray, least: float, near: NDArray[np.bool_], first: int, last: int) -> None:
    """Say which of the blocks ``first`` to ``last`` have a voxel near a surface."""
    for index in range(first, last):
        x0, y0, z0 = blocks[index, 0] * BLOCK, blocks[index, 1] * BLOCK, blocks[index, 2] * BLOCK
        for voxel in range(VOXELS):
            information, distance, _ = read_voxel(
                grid, x0 + (voxel & 3), y0 + ((voxel >> 2) & 3), z0 + (voxel >> 4), least
            )
            if information > 0 and abs(distance) < NEAR:
                near[index] = True
                break


@compiled
def _fill_field(
    grid: Grid,
    blocks: IntArray,
    rows: IntArray,
    least: float,
    distance: Float32Array,
    known: Float32Array,
    first: int,
    last: int,
) -> None:
    """Fill the distances of blocks ``first`` to ``last`` and whether they are known; x runs fastest, as in Open3D."""
    for index in range(first, last):
        x0, y0, z0 = blocks[index, 0] * BLOCK, blocks[index, 1] * BLOCK, blocks[index, 2] * BLOCK
        for voxel in range(VOXELS):
            x, y, z = x0 + (voxel & 3), y0 + ((voxel >> 2) & 3), z0 + (voxel >> 4)
            information, value, _ = read_voxel(grid, x, y, z, least)
            distance[rows[index], voxel] = value
            known[rows[index], voxel] = np.float32(1 if information > 0 else 0)


@compiled
def _fill_vertices(
    grid: Grid,
    vertices: FloatArray,
    least: float,
    normals: FloatArray,
    information: FloatArray,
    first: int,
    last: int,
) -> None:
    """Fill the gradient of the distance and the information at vertices ``first`` to ``last``."""
    corners = np.empty((8, 2))
    for index in range(first, last):
        x, y, z = vertices[index]
        _, information[index], _ = sample(grid, x, y, z, least, corners)
        for axis in range(3):
            normals[index, axis] = difference(corners, 4 >> axis)
