"""The stereo rig of the simulated cell: the constants of the camera that took the ROBI data set."""

from __future__ import annotations

import numpy as np

from sidelong.errors import SettingsError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.transforms import rotation_about, transform

FULL_WIDTH_PX, FULL_HEIGHT_PX = 1280, 1024
FOCAL_PX = 1083.097
PRINCIPAL_X_PX, RIGHT_PRINCIPAL_X_PX, PRINCIPAL_Y_PX = 379.327, 735.997, 509.437
BASELINE_M = 101.1839e-3
PROJECTOR_TOE_IN_RAD = 0.0768483
"""The projector stands midway between the cameras and is turned 4.4 degrees about the image's y axis."""
PROJECTOR_WIDTH_RAD = np.deg2rad(62.0)
PROJECTOR_ASPECT = FULL_WIDTH_PX / FULL_HEIGHT_PX


def rig_for(width: int = 640, height: int = 512) -> StereoRig:
    """Return the rig scaled to an image size.

    Raises
    ------
    SettingsError
        The size has not the sensor's 5:4 sides, or is below 80x64.
    """
    factor = width / FULL_WIDTH_PX
    if round(FULL_HEIGHT_PX * factor) != height or width < 80:
        raise SettingsError(f"image size: is {width}x{height} px, needs sides 5:4 and at least 80x64")
    full = StereoRig(_full(PRINCIPAL_X_PX), _full(RIGHT_PRINCIPAL_X_PX), BASELINE_M, _projector())
    return full.scaled(factor)


def _full(cx: float) -> PinholeCamera:
    return PinholeCamera(FULL_WIDTH_PX, FULL_HEIGHT_PX, FOCAL_PX, FOCAL_PX, cx, PRINCIPAL_Y_PX)


def _projector() -> LightProjector:
    half_width_rad = PROJECTOR_WIDTH_RAD / 2
    return LightProjector(
        left_T_projector=transform(rotation_about((0, 1, 0), PROJECTOR_TOE_IN_RAD), (BASELINE_M / 2, 0.0, 0.0)),
        half_width_rad=half_width_rad,
        half_height_rad=float(np.arctan(np.tan(half_width_rad) / PROJECTOR_ASPECT)),
    )
