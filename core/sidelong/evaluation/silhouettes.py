"""Which pixels of a view show which part, and which would if nothing stood before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, transform_points
from sidelong.types import BoolArray, FloatArray, IntArray

FARTHEST_OUTSIDE = 1.0
"""How far beyond the image a silhouette is counted, in widths and heights of the image."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A part in a view.

    Attributes
    ----------
    all_px
        Pixels it would cover alone, those that lie beyond the image included.
    visible
        (H, W) pixels of the image that show it.
    covered
        (H, W) pixels of the image it would cover alone.
    box
        First column and row, width and height of all that it would cover; None where that is nothing.
    """

    all_px: int
    visible: BoolArray
    covered: BoolArray
    box: tuple[int, int, int, int] | None

    @property
    def visible_fraction(self) -> float:
        """Share 0..1 of the silhouette that the image shows; 0 where there is none."""
        return int(self.visible.sum()) / self.all_px if self.all_px else 0.0


def visible_fractions(
    parts_and_poses: Sequence[tuple[Part, FloatArray]], camera: PinholeCamera, base_T_camera: FloatArray
) -> FloatArray:
    """Return which share (N,) of each part's silhouette the image shows: neither hidden by another nor beyond the edge.

    Parameters
    ----------
    parts_and_poses
        Each part with its ``base_T_object`` (4, 4).
    base_T_camera
        (4, 4) of the view.
    """
    return np.array([each.visible_fraction for each in silhouettes(parts_and_poses, camera, base_T_camera)])


def silhouettes(
    parts_and_poses: Sequence[tuple[Part, FloatArray]], camera: PinholeCamera, base_T_camera: FloatArray
) -> tuple[Silhouette, ...]:
    """Return the silhouette of each part. One that reaches behind the camera has none."""
    shown = RayScene(parts_and_poses).render(camera, base_T_camera).instance
    return tuple(
        _silhouette(part, invert(base_T_camera) @ base_T_object, camera, shown == index)
        for index, (part, base_T_object) in enumerate(parts_and_poses)
    )


def _silhouette(part: Part, camera_T_object: FloatArray, camera: PinholeCamera, visible: BoolArray) -> Silhouette:
    covered = np.zeros((camera.height, camera.width), dtype=np.bool_)
    uv = camera.project(transform_points(camera_T_object, part.vertices_m))
    if not np.isfinite(uv).all():
        return Silhouette(0, visible, covered, None)
    size = np.array([camera.width, camera.height])
    low, high = (
        np.clip(np.rint(edge), -FARTHEST_OUTSIDE * size, (1 + FARTHEST_OUTSIDE) * size).astype(np.intp)
        for edge in (uv.min(axis=0), uv.max(axis=0))
    )
    window = replace(
        camera,
        width=int(high[0] - low[0]) + 1,
        height=int(high[1] - low[1]) + 1,
        cx=camera.cx - int(low[0]),
        cy=camera.cy - int(low[1]),
    )
    alone = RayScene([(part, camera_T_object)]).render(window, np.eye(4)).instance >= 0
    rows, columns = (found + offset for found, offset in zip(np.nonzero(alone), low[::-1], strict=True))
    inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    covered[rows[inside], columns[inside]] = True
    return Silhouette(len(rows), visible, covered, box_of(rows, columns))


def box_of(rows: IntArray, columns: IntArray) -> tuple[int, int, int, int] | None:
    """Return first column and row, width and height of pixels; None where there are none."""
    if not len(rows):
        return None
    left, top = int(columns.min()), int(rows.min())
    return left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1
