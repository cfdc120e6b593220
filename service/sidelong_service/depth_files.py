"""The completed depth of a reference view as files: pictures that hold its numbers, arrays, points and a mesh."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.depth_surface import Surface, depth_surface
from sidelong.types import CompletedDepth, FloatArray, GrayImage, PixelState, StateArray
from sidelong_service.models import state_px_of
from sidelong_service.ply import ply

DEPTH_UNIT_M = 1e-4
"""Of the 16-bit depth picture: 0.1 mm reaches 6.5 m, and is a sixth of what the sensor repeats to at 0.7 m."""
LARGEST_PNG_DEPTH_M = 65535 * DEPTH_UNIT_M
SIGMA_UNIT_M = 1e-6
"""Of the 16-bit picture of standard deviations."""
LARGEST_PNG_SIGMA_M = 65535 * SIGMA_UNIT_M

STATES = tuple(state.name.lower() for state in PixelState)
"""Names of the states, in the order of their values."""
TRUSTED = tuple(state.name.lower() for state in (PixelState.MEASURED, PixelState.COMPLETED))
"""What pictures, points and mesh hold: they have no room for a mark, so what needs one is left out."""


@dataclass(frozen=True, eq=False)
class DepthFiles:
    """What is written of a completed depth.

    Attributes
    ----------
    depth
        Of the reference view.
    camera, base_T_camera
        Its intrinsics, and (4, 4) where it was.
    image
        (H, W) its gray values.
    views
        Names of the views, in the order of the steps.
    """

    depth: CompletedDepth
    camera: PinholeCamera
    base_T_camera: FloatArray
    image: GrayImage
    views: Sequence[str]

    def contents(self) -> dict[str, bytes]:
        """Return each file by its name."""
        cloud, mesh = self._surface, self._mesh
        return {
            "depth.png": depth_png(self.depth.trusted_m),
            "sigma.png": sigma_png(np.where(self.depth.trusted, self.depth.sigma_m, np.nan)),
            "state.png": state_png(self.depth.state),
            "depth.npz": npz(self._arrays()),
            "cloud.ply": ply(cloud.points_m, cloud.normals, self._gray(cloud)),
            "mesh.ply": ply(mesh.points_m, mesh.normals, self._gray(mesh), mesh.triangles),
        }

    def legend(self) -> dict[str, Any]:
        """Return what a reader of these files must know."""
        in_base = {"frame": "base", "unit_m": 1.0, "holds": TRUSTED}
        beyond_px = int((self.depth.trusted_m > LARGEST_PNG_DEPTH_M).sum())
        return {
            "state_px": state_px_of(self.depth.state),
            "depth_png": {"unit_m": DEPTH_UNIT_M, "missing": 0, "largest_m": LARGEST_PNG_DEPTH_M,
                          "beyond_largest_px": beyond_px, "holds": TRUSTED},
            "sigma_png": {"unit_m": SIGMA_UNIT_M, "missing": 0, "largest_m": LARGEST_PNG_SIGMA_M, "holds": TRUSTED},
            "state_png": {name: value for value, name in enumerate(STATES)},
            "cloud_ply": {**in_base, "points": len(self._surface.points_m)},
            "mesh_ply": {**in_base, "points": len(self._mesh.points_m), "triangles": len(self._mesh.triangles)},
        }  # fmt: skip

    @cached_property
    def _surface(self) -> Surface:
        return depth_surface(self.depth.trusted_m, self.camera).moved(self.base_T_camera)

    @cached_property
    def _mesh(self) -> Surface:
        return self._surface.connected()

    def _gray(self, surface: Surface) -> GrayImage:
        return self.image[surface.pixels[:, 0], surface.pixels[:, 1]]

    def _arrays(self) -> dict[str, Any]:
        return {
            "depth_m": self.depth.depth_m,
            "sigma_m": self.depth.sigma_m.astype(np.float32),
            "source": self.depth.source.astype(np.int16),
            "state": self.depth.state,
            "states": np.array(STATES),
            "K": intrinsics_of(self.camera),
            "base_T_camera": self.base_T_camera,
            "views": np.array(self.views),
        }


def depth_png(depth_m: FloatArray) -> bytes:
    """Return depth (H, W) as a 16-bit PNG in units of ``DEPTH_UNIT_M``; 0 where missing or beyond its range."""
    held = (depth_m > 0) & (depth_m <= LARGEST_PNG_DEPTH_M)
    return _png(np.where(held, np.rint(depth_m / DEPTH_UNIT_M), 0).astype(np.uint16))


def sigma_png(sigma_m: FloatArray) -> bytes:
    """Return standard deviations (H, W) as a 16-bit PNG in units of ``SIGMA_UNIT_M``.

    0 where missing; from 1 unit up, and the largest value for all that is larger.
    """
    units = np.clip(np.rint(sigma_m / SIGMA_UNIT_M), 1, 65535)
    return _png(np.where(np.isnan(units), 0, units).astype(np.uint16))


def state_png(state: StateArray) -> bytes:
    """Return states (H, W) as an 8-bit PNG whose gray values are those of :class:`PixelState`.

    No palette: readers differ in whether they give its colours or its indices.
    """
    return _png(state)


def intrinsics_of(camera: PinholeCamera) -> FloatArray:
    """Return the matrix of the intrinsics (3, 3)."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def npz(arrays: dict[str, Any]) -> bytes:
    """Return arrays by name as a compressed NPZ file."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _png(image: Any) -> bytes:
    import cv2

    return cv2.imencode(".png", image)[1].tobytes()
