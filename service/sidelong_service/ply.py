"""Points and meshes as binary PLY files."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.types import FloatArray, GrayImage, IntArray

COORDINATES = ("x", "y", "z", "nx", "ny", "nz")
COLOURS = ("red", "green", "blue")


def ply(
    points_m: FloatArray, normals: FloatArray, gray: GrayImage | None = None, triangles: IntArray | None = None
) -> bytes:
    """Return points in the base frame as a binary PLY file, a mesh where there are triangles.

    Parameters
    ----------
    points_m, normals
        (N, 3).
    gray
        (N,) gray value of each point.
    triangles
        (M, 3) indices of points, counter-clockwise as seen from outside.
    """
    colours = () if gray is None else COLOURS
    header = [
        "ply", "format binary_little_endian 1.0", "comment metres, base frame", f"element vertex {len(points_m)}",
        *(f"property float {name}" for name in COORDINATES), *(f"property uchar {name}" for name in colours),
    ]  # fmt: skip
    fields: list[Any] = [("point", "<f4", 3), ("normal", "<f4", 3)]
    vertices = np.empty(len(points_m), dtype=fields if gray is None else [*fields, ("colour", "u1", 3)])
    vertices["point"], vertices["normal"] = points_m, normals
    if gray is not None:
        vertices["colour"] = gray[:, None]
    body = vertices.tobytes()
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(triangles), dtype=[("corners", "u1"), ("indices", "<i4", 3)])
        faces["corners"], faces["indices"] = 3, triangles
        body += faces.tobytes()
    return ("\n".join([*header, "end_header"]) + "\n").encode() + body
