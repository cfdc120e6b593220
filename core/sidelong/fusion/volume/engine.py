"""The volumetric engine behind the same protocol as the warp: the reference view is rendered from the volume."""

from __future__ import annotations

import numpy as np

from sidelong.fusion.engine import Estimate, PosedDepth
from sidelong.fusion.volume.region import region_of
from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.fusion.volume.volume import Volume
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.types import BoolArray, Float32Array, FloatArray

MARGIN_M = 0.02
"""Around what the reference measured: further views see a little more."""


class VolumeEngine:
    """Lays every depth map, that of the reference too, into a volume of the base frame.

    Parameters
    ----------
    camera
        Of all views.
    reference, base_T_reference
        The reference's depth map, and where it is (4, 4).
    wanted
        (H, W) the holes.
    settings
        Of the volume; without a region it is where the reference measured.

    Raises
    ------
    SettingsError
        The region would need more than ``max_bytes``.
    DepthError
        The reference's surface would.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        reference: PosedDepth,
        base_T_reference: FloatArray,
        wanted: BoolArray,
        settings: VolumeSettings,
    ) -> None:
        self._base_T_reference = base_T_reference
        self._wanted = wanted
        region = settings.region_m or region_of(reference.depth_m, camera, base_T_reference, MARGIN_M)
        self._volume = Volume(camera, region, settings)
        self._estimate: Estimate | None = None
        self.add(reference)

    @property
    def scene(self) -> Volume:
        """The volume."""
        return self._volume

    def add(self, view: PosedDepth) -> None:
        """Take in the depth map of one more view.

        Raises
        ------
        DepthError
            Its surface would need more than ``max_bytes``; the volume is as it was.
        """
        base_T_view = self._base_T_reference @ view.reference_T_view
        self._volume.add(view.depth_m, _with_pose(view), base_T_view, view.step)
        self._estimate = None

    def estimate(self) -> Estimate:
        """Return the depth of the holes as all views show it; source 0 is what the reference measured beside them."""
        if self._estimate is None:
            seen = self._volume.render(self._base_T_reference, self._wanted)
            self._estimate = Estimate(
                seen.depth_m[self._wanted], seen.sigma_m[self._wanted], seen.source[self._wanted].astype(np.intp)
            )
        return self._estimate


def _with_pose(view: PosedDepth) -> Float32Array:
    """Return the standard deviation (H, W) of depths with what the error of the view's pose makes of the middle one."""
    depth_m = view.depth_m[np.isfinite(view.depth_m)]
    if not depth_m.size or not view.covariance.any():
        return view.sigma_m
    ahead = view.reference_T_view[:3, 2]
    moved = np.concatenate([np.cross(float(np.median(depth_m)) * ahead, ahead), ahead])
    return np.sqrt(view.sigma_m**2 + np.float32(moved @ view.covariance @ moved))
