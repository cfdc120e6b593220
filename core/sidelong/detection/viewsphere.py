"""From where templates see a part: directions on rings around its symmetry axis, and turns in the image plane.

A part that turns into itself shows the same again: of an n-fold axis one sector of each ring is enough, of a continuous
one a single view, and where a turn reverses the axis half the rings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sidelong.geometry.symmetry import Symmetry
from sidelong.geometry.transforms import look_at
from sidelong.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Axis:
    """The axis with the most turns: ``fold`` of them (0: by any angle).

    ``reversed_by`` is the axis (3,) across it of a half turn that reverses it; None where there is none.
    """

    direction: FloatArray
    fold: int
    reversed_by: FloatArray | None = None


def main_axis(symmetry: Symmetry) -> Axis:
    """Return the axis on which views need not be repeated; a part without symmetry gets z and one turn."""
    if symmetry.axis is not None:
        return Axis(symmetry.axis, 0, _reversing(symmetry.rotations, symmetry.axis))
    vectors = Rotation.from_matrix(symmetry.rotations).as_rotvec()
    angles = np.linalg.norm(vectors, axis=1)
    if symmetry.ball or not (angles > 1e-6).any():
        return Axis(np.array([0.0, 0.0, 1.0]), 1)
    axes = vectors[angles > 1e-6] / angles[angles > 1e-6, None]
    folds = [int(np.sum(symmetry.rotations @ axis @ axis > 1 - 1e-6)) for axis in axes]
    best = int(np.argmax(folds))
    return Axis(axes[best], folds[best], _reversing(symmetry.rotations, axes[best]))


def _reversing(rotations: FloatArray, axis: FloatArray) -> FloatArray | None:
    reversing = rotations[rotations @ axis @ axis < -1 + 1e-6]
    if len(reversing) == 0:
        return None
    vector = Rotation.from_matrix(reversing[0]).as_rotvec()
    return vector / np.linalg.norm(vector)


def views(step_deg: float, roll_step_deg: float, symmetry: Symmetry) -> list[tuple[FloatArray, FloatArray]]:
    """Return directions (3,) from the part to the camera, each with its turns (R,) in the image plane, radians.

    Directions are about ``step_deg`` apart, on rings of equal elevation above the main axis' equator; every other view
    of the part, turned as it may be, equals one of them within the steps.
    """
    axis = main_axis(symmetry)
    object_R_ring = _ring_frame(axis)
    rings = 2 * max(1, round(90.0 / step_deg))
    found: list[tuple[FloatArray, FloatArray]] = []
    for ring in range(rings + 1):
        if (symmetry.ball and ring > 0) or (axis.reversed_by is not None and ring > rings // 2):
            break
        elevation = np.pi / 2 - np.pi * ring / rings
        at_pole, at_equator = ring in (0, rings), axis.reversed_by is not None and ring == rings // 2
        # a ring's views that are the same turned in the plane: all of a pole's; a cylinder's from either side
        same = axis.fold if at_pole else 2 if at_equator and axis.fold == 0 else 1
        rolls = _turns(roll_step_deg, 0 if symmetry.ball else same)
        for azimuth in np.zeros(1) if at_pole else _sector(elevation, step_deg, axis, ring, at_equator):
            flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
            found.append((object_R_ring @ (*flat, np.sin(elevation)), rolls))
    return found


@dataclass(frozen=True)
class Ranges:
    """From where a part can be seen, in degrees and the part's own frame: (low, high) each.

    Attributes
    ----------
    elevation_deg
        Of the camera over the part's xy plane, -90..90.
    azimuth_deg
        Of the camera about the part's z axis, from x to y.
    roll_deg
        Of the image of the z axis, clockwise from straight up.
    """

    elevation_deg: tuple[float, float]
    azimuth_deg: tuple[float, float]
    roll_deg: tuple[float, float]

    def allow(self, axis_R_object: FloatArray, symmetry: Symmetry, step_deg: float) -> BoolArray:
        """Say which orientations (N, 3, 3), or one that looks the same, lie in the ranges or within half a step."""
        equivalent = symmetry.equivalent(np.radians(step_deg))[:, :3, :3]
        seen = axis_R_object[:, None] @ equivalent
        x, y, z = np.moveaxis(-seen[..., 2, :], -1, 0)  # from the part to the camera
        elevation, azimuth = np.degrees(np.arcsin(np.clip(z, -1.0, 1.0))), np.degrees(np.arctan2(y, x))
        roll = np.degrees(np.arctan2(seen[..., 0, 2], -seen[..., 1, 2]))
        margin = step_deg / 2
        low, high = self.elevation_deg
        high_enough = (elevation >= low - margin) & (elevation <= high + margin)
        # seen along the axis, azimuth and roll are not apart
        at_pole = np.abs(elevation) > 90.0 - margin
        turned = _within(azimuth, self.azimuth_deg, margin) & _within(roll, self.roll_deg, margin)
        return (high_enough & (at_pole | turned)).any(axis=1)


def _within(angle_deg: FloatArray, span_deg: tuple[float, float], margin_deg: float) -> BoolArray:
    """Say which angles (...) lie in a span, full turns aside."""
    low, high = span_deg[0] - margin_deg, span_deg[1] + margin_deg
    return (angle_deg - low) % 360.0 <= high - low


def _ring_frame(axis: Axis) -> FloatArray:
    """Return ``object_R_ring`` (3, 3): z along the axis, x along the axis of the half turn that reverses it."""
    if axis.reversed_by is None:
        return look_at(-axis.direction, np.zeros(3))[:3, :3]
    return np.stack([axis.reversed_by, np.cross(axis.direction, axis.reversed_by), axis.direction], axis=1)


def _sector(elevation: float, step_deg: float, axis: Axis, ring: int, at_equator: bool) -> FloatArray:
    """Return the azimuths of one ring: of its whole circle, or of the sector that is not a repetition."""
    if axis.fold == 0:
        return np.zeros(1)
    # on the equator a half turn across the axis takes azimuth a to -a
    fold = axis.fold * (2 if at_equator else 1)
    count = int(np.ceil(2 * np.pi * np.cos(elevation) / np.radians(step_deg) / fold - 1e-9))
    # odd rings are turned by half a step: neighbours of neighbours are not aligned
    offset = 0.5 if at_equator else 0.5 * (ring % 2)
    return 2 * np.pi / fold * (np.arange(count) + offset) / count


def _turns(step_deg: float, fold: int) -> FloatArray:
    """Return equal turns of at most ``step_deg`` that fill 2 pi / fold; of a picture all round (0) a single one."""
    if fold == 0:
        return np.zeros(1)
    span = 2 * np.pi / fold
    return span * np.arange(count := int(np.ceil(span / np.radians(step_deg) - 1e-9))) / count
