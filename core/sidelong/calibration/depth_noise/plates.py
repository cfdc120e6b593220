"""Noise of depth from captures of a flat plate: whatever deviates from a plane is error, fixed patterns included."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sidelong.calibration.depth_noise.fit import NoiseFit, fit_noise
from sidelong.calibration.depth_noise.plane import FlatSurface, flat_surface
from sidelong.calibration.depth_noise.table import MOST_ERRORS, Errors, groups_of
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.physics.depth_noise import rim_distance_px
from sidelong.types import FloatArray

FEW_CAPTURES = 3
LEAST_SPAN_PX = 2.0
"""A plate over which disparity changes less hides errors that go with the fraction of a pixel: most of them."""


def noise_from_plates(depth_maps_m: Mapping[str, FloatArray], rig: StereoRig) -> NoiseFit:
    """Fit the noise to depth maps whose largest flat surface is a plate.

    Distances make sure that the noise is one of disparity, tilts tell the slope term, and where the plate ends within
    the image, or depth is missing on it, rims do theirs.

    Parameters
    ----------
    depth_maps_m
        (H, W) each, by the name of the capture.
    rig
        The cameras.

    Raises
    ------
    CalibrationError
        There is none, two are the same, or one shows no plate, no noise, or too few depths.
    """
    if not depth_maps_m:
        raise CalibrationError("depth noise: 0 captures of a plate, needs at least 1")
    refuse_copies(depth_maps_m)
    surfaces = {name: flat_surface(depth_m, rig, name) for name, depth_m in depth_maps_m.items()}
    most = MOST_ERRORS // len(depth_maps_m)
    cells = [_errors(depth_maps_m[name], surface, most) for name, surface in surfaces.items()]
    return replace(fit_noise(cells, len(cells)), warnings=_warnings(surfaces))


def _warnings(surfaces: Mapping[str, FlatSurface]) -> tuple[str, ...]:
    faced = [name for name, surface in surfaces.items() if surface.span_px < LEAST_SPAN_PX]
    said = {
        f"number of captures: {len(surfaces)}; from {FEW_CAPTURES} on, what differs between them is in the intervals": (
            len(surfaces) < FEW_CAPTURES
        ),
        f"disparity changes by less than {LEAST_SPAN_PX:g} px over {', '.join(faced)}: errors that go with the "
        "fraction of a pixel do not show there, tilt the plate": bool(faced),
    }
    return tuple(text for text, applies in said.items() if applies)


def refuse_copies(depth_maps_m: Mapping[str, FloatArray]) -> None:
    """Raise CalibrationError where two depth maps are the same: one capture is no proof of another."""
    seen: dict[bytes, str] = {}
    for name, depth_m in depth_maps_m.items():
        content = np.ascontiguousarray(depth_m).tobytes()
        if content in seen:
            raise CalibrationError(
                f"{name}: is the same as {seen[content]} to the last bit: it was copied, or the camera repeats itself"
            )
        seen[content] = name


def _errors(depth_m: FloatArray, surface: FlatSurface, most: int) -> Errors:
    rows, columns = np.nonzero(surface.pixels)
    kept = rows % max(1, -(-len(rows) // most)) == 0
    rows, columns = rows[kept], columns[kept]
    rim_px = rim_distance_px(depth_m)[rows, columns].astype(np.float64)
    return Errors(surface.gradient, surface.error_px[rows, columns], rim_px, groups_of(rows, columns))
