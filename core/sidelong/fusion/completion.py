"""The completed depth of the reference view, as it grows with every further view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.errors import DepthError, ImageError
from sidelong.fusion.settings import FusionSettings
from sidelong.fusion.warp import measured, warp
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, validated_transform
from sidelong.types import BoolArray, FloatArray, Frame, IntArray

MISSING, REFERENCE = -1, 0
"""Values of ``Completion.source`` that are no later step."""


@dataclass(frozen=True, eq=False)
class _Layer:
    """What one view says of the holes: their numbers among all holes, their depth (N,), and the step."""

    hole: IntArray
    depth_m: FloatArray
    step: int


class Completion:
    """Completes the depth of a reference view from further views.

    Pixels the reference measured stay as they are, to the bit. For each other pixel every view gives at most one depth
    (:func:`sidelong.fusion.warp.warp`), and all of them are kept: the result is the mean of those within
    ``front_band_m`` of the nearest, so a later view may refine what an earlier one gave, and the order of the views
    does not matter.

    Parameters
    ----------
    reference
        The frame to complete.
    camera
        Intrinsics of this and of all further frames.
    settings
        How depth maps are laid into the reference view.

    Attributes
    ----------
    depth_m
        (H, W) completed depth, NaN where still missing.
    source
        (H, W) step that measured each pixel: 0 the reference, i the i-th frame added (the first of those averaged),
        -1 missing.

    Raises
    ------
    DepthError
        The reference frame has no depth map, or not one measured pixel.
    ImageError
        The depth map does not have the camera's size.
    PoseError
        The pose of the view is no rigid motion.
    """

    def __init__(self, reference: Frame, camera: PinholeCamera, settings: FusionSettings | None = None) -> None:
        self._camera = camera
        self._settings = settings or FusionSettings()
        self._camera_T_base = invert(_pose_of(reference))
        self._reference_m = _depth_of(reference, camera)
        present = measured(self._reference_m)
        if not present.any():
            raise DepthError(f"view {reference.view.name}: the depth map has 0 of {present.size} px measured")
        self._holes = ~present
        """(H, W) what the reference did not measure; holes are numbered row by row."""
        self._farthest_m: FloatArray = np.full(int(self._holes.sum()), np.inf)
        self._layers: list[_Layer] = []
        self.depth_m: FloatArray
        self.source: IntArray
        self._recompute()

    @property
    def missing(self) -> BoolArray:
        """(H, W) pixels that no view has measured yet."""
        return self.source == MISSING

    def expect(self, surface_m: FloatArray) -> None:
        """Say what surface is believed to be at the pixels, (H, W), NaN where nothing is known; see ``doubtful``."""
        expected_m = surface_m[self._holes]
        self._farthest_m = np.where(np.isnan(expected_m), np.inf, expected_m + self._settings.behind_m)

    @property
    def doubtful(self) -> BoolArray:
        """(H, W) completed pixels whose depth lies more than ``behind_m`` behind the surface believed there.

        Where no view has measured a part yet, another view may look past it and measure the ground, which then lands in
        the part's pixels. A nearer depth of a later view takes its place.
        """
        doubtful = np.zeros_like(self._holes)
        with np.errstate(invalid="ignore"):
            doubtful[self._holes] = self.depth_m[self._holes] > self._farthest_m
        return doubtful

    def add(self, frame: Frame) -> int:
        """Lay the depth map of a further view into the reference view.

        Returns
        -------
        int
            Pixels that had no depth before and have one now.

        Raises
        ------
        DepthError
            The frame has no depth map.
        ImageError
            The depth map does not have the camera's size.
        PoseError
            The pose of the view is no rigid motion.
        """
        depth_m, base_T_view = _depth_of(frame, self._camera), _pose_of(frame)
        warped = warp(depth_m, self._camera, self._camera_T_base @ base_T_view, self._holes, self._settings)
        at_holes = warped[self._holes]
        seen = np.flatnonzero(np.isfinite(at_holes))
        self._layers.append(_Layer(seen, at_holes[seen], step=len(self._layers) + 1))
        missing_px = int(self.missing.sum())
        self._recompute()
        return missing_px - int(self.missing.sum())

    def _recompute(self) -> None:
        """Average, at each hole, the layers within the band behind the nearest."""
        holes = int(self._holes.sum())
        nearest, total, count = np.full(holes, np.inf), np.zeros(holes), np.zeros(holes)
        source = np.full(holes, MISSING, dtype=np.intp)
        for layer in self._layers:
            nearest[layer.hole] = np.minimum(nearest[layer.hole], layer.depth_m)
        for layer in reversed(self._layers):  # so that the first of those averaged names itself last
            used = layer.depth_m <= nearest[layer.hole] + self._settings.front_band_m
            hole = layer.hole[used]
            total[hole] += layer.depth_m[used]
            count[hole] += 1
            source[hole] = layer.step
        self.depth_m = self._reference_m.copy()
        self.depth_m[self._holes] = np.divide(total, count, out=np.full(holes, np.nan), where=count > 0)
        self.source = np.full(self._holes.shape, REFERENCE, dtype=np.intp)
        self.source[self._holes] = source


def _depth_of(frame: Frame, camera: PinholeCamera) -> FloatArray:
    """Return the depth map of a frame, checked for presence and size."""
    if frame.depth_m is None:
        raise DepthError(f"view {frame.view.name}: the frame has no depth map, it was captured without")
    if frame.depth_m.shape != (camera.height, camera.width):
        size = "x".join(str(n) for n in reversed(frame.depth_m.shape))
        raise ImageError(
            f"view {frame.view.name}: the depth map is {size} px, the camera {camera.width}x{camera.height} px"
        )
    return np.asarray(frame.depth_m, dtype=np.float64)


def _pose_of(frame: Frame) -> FloatArray:
    return validated_transform(frame.view.base_T_camera, f"view {frame.view.name}")
