"""Predicted exposure beside measured depth: what a sensing curve is learned from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import invert
from sidelong.planning.gain import Planner
from sidelong.planning.prior import believe
from sidelong.planning.shading import LightModel
from sidelong.types import BoolArray, DetectedObject, FloatArray, Frame, Hypothesis, IntArray


@dataclass(frozen=True, eq=False)
class SensingSamples:
    """Predicted exposure beside measured depth, one row for each of N pixels that cameras and projector reach.

    Attributes
    ----------
    exposure
        (N, C) of the C cameras that must see the pattern, in units of the exposure that clips, not clipped.
    valid
        (N,) whether depth of the predicted surface was measured.
    group
        (N,) what belongs together (the view, the scene): cross-validation leaves out whole groups.
    weight
        (N,) how much a row counts.

    Raises
    ------
    CalibrationError
        Lengths differ, or an exposure or a weight is negative or not finite.
    """

    exposure: FloatArray
    valid: BoolArray
    group: IntArray
    weight: FloatArray

    def __post_init__(self) -> None:
        shapes = [self.exposure.shape[:1], self.valid.shape, self.group.shape, self.weight.shape]
        if self.exposure.ndim != 2 or len(set(shapes)) != 1 or self.exposure.shape[1] not in (1, 2):
            raise CalibrationError(
                f"sensing samples: shapes are {self.exposure.shape} for exposure, {self.valid.shape} for valid, "
                f"{self.group.shape} for group and {self.weight.shape} for weight, need (N, 1 or 2) and (N,)"
            )
        for name, values in (("exposure", self.exposure), ("weight", self.weight)):
            bad = int((~(np.isfinite(values) & (values >= 0))).sum())
            if bad:
                raise CalibrationError(
                    f"sensing samples: {bad} of {values.size} values of {name} are not finite and >= 0"
                )

    @classmethod
    def of(
        cls,
        exposure_left: FloatArray,
        exposure_right: FloatArray | None,
        valid: BoolArray,
        group: IntArray | None = None,
        weight: FloatArray | None = None,
    ) -> SensingSamples:
        """Put arrays (N,) together; without groups all belong together, without weights all count the same."""
        n = len(valid)
        cameras = [exposure_left] if exposure_right is None else [exposure_left, exposure_right]
        if any(np.shape(camera) != (n,) for camera in cameras):
            raise CalibrationError(
                f"sensing samples: exposures have shapes {[np.shape(camera) for camera in cameras]}, valid has ({n},)"
            )
        return cls(
            np.stack(cameras, axis=1).astype(np.float64),
            np.asarray(valid, dtype=np.bool_),
            np.zeros(n, np.intp) if group is None else np.asarray(group),
            np.ones(n) if weight is None else np.asarray(weight, dtype=np.float64),
        )

    def __len__(self) -> int:
        return len(self.valid)

    def __getitem__(self, chosen: BoolArray | IntArray) -> SensingSamples:
        return SensingSamples(self.exposure[chosen], self.valid[chosen], self.group[chosen], self.weight[chosen])


def samples_of(
    frames: Sequence[Frame],
    base_T_objects: Sequence[FloatArray],
    part: Part,
    rig: StereoRig,
    light: LightModel,
    stride_px: int = 4,
) -> SensingSamples:
    """Predict the exposure of the part pixels of each frame, and look up whether the frame has their depth.

    Parameters
    ----------
    frames
        Captures with depth; each is a group of its own.
    base_T_objects
        Poses of the parts in them.
    part, rig, light
        Geometry and light; the exposure time is each frame's own.
    stride_px
        Every stride-th row and column is used: neighbours say the same.

    Raises
    ------
    CalibrationError
        A frame has no depth map.
    """
    rows = [_rows_of(frame, base_T_objects, part, rig, light, stride_px) for frame in frames]
    cameras = 2 if light.sensing.stereo else 1
    return SensingSamples(
        np.concatenate([np.zeros((0, cameras)), *(exposure for exposure, _ in rows)]),
        np.concatenate([np.zeros(0, np.bool_), *(valid for _, valid in rows)]),
        np.repeat(np.arange(len(rows)), [len(valid) for _, valid in rows]),
        np.ones(sum(len(valid) for _, valid in rows)),
    )


def _rows_of(
    frame: Frame, base_T_objects: Sequence[FloatArray], part: Part, rig: StereoRig, light: LightModel, stride_px: int
) -> tuple[FloatArray, BoolArray]:
    if frame.depth_m is None:
        raise CalibrationError(f"view {frame.view.name}: the frame has no depth map, the sensing curve needs one")
    camera_T_base = invert(frame.view.base_T_camera)
    objects = [DetectedObject((Hypothesis(camera_T_base @ pose, 100.0, 1.0),)) for pose in base_T_objects]
    everywhere = np.ones(frame.depth_m.shape, dtype=np.bool_)
    belief = believe(objects, part, rig.left, frame.view.base_T_camera, everywhere, stride_px)
    planner = Planner(belief, part, rig, replace(light, exposure_s=frame.exposure_s))
    prediction = planner.predict(frame.view)
    reached = prediction.reached
    return prediction.exposure[reached], prediction.measured(frame.depth_m)[reached]
