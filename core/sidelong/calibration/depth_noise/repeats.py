"""Noise of depth from repeated shots of any scene at rest: what changes from shot to shot.

An error that is the same in each shot does not show, and of an active stereo camera that is most of it: patterns,
albedo and matcher stay as they are. So this is a lower bound; a plate tells all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sidelong.calibration.depth_noise.fit import NoiseFit, fit_noise
from sidelong.calibration.depth_noise.plane import LEAST_NOISE_PX
from sidelong.calibration.depth_noise.plates import refuse_copies
from sidelong.calibration.depth_noise.table import MAD_TO_SIGMA, MOST_ERRORS, Errors, groups_of, spread_px
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.physics.depth_noise import rim_distance_px, seen_noise_px
from sidelong.types import Float32Array, FloatArray, IntArray

FEWEST_SHOTS, MOST_SHOTS = 5, 40
FEWEST_PIXELS = 5000
STEADY_SHARE = 0.8
"""Of the shots a pixel must have depth in, to have a mean."""
JUMP_SPREADS = 6.0
GRADIENT_EDGES = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 1.0)
FEWEST_IN_CLASS, AWAY_FROM_RIM_PX = 2000, 4.5
MOVED_SPREADS, LEAST_MOVE_PX = 3.0, 0.05
"""How far half of the pixels of a shot must be from the others, in what is usual and in pixels, to call it moved."""
LARGEST_DRIFT = 0.5
LOWER_BOUND = "a lower bound: errors that are the same in each shot do not show, captures of a plate show them"


@dataclass(frozen=True, eq=False)
class _Steady:
    """Pixels (P,) that most shots measured: where they are, their gradient, and (N, P) deviations and rim distances."""

    rows: IntArray
    columns: IntArray
    gradient: FloatArray
    deviation_px: FloatArray
    rim_px: FloatArray


def noise_from_repeats(depth_maps_m: Mapping[str, FloatArray], rig: StereoRig) -> NoiseFit:
    """Fit the noise to what differs between depth maps of one scene from one pose.

    Parameters
    ----------
    depth_maps_m
        (H, W) each, by the name of the shot; at least ``FEWEST_SHOTS``.
    rig
        The cameras.

    Raises
    ------
    CalibrationError
        They are too few or too many, of another size than the camera's, too empty, two are the same, or the scene
        moved.
    """
    _check(depth_maps_m, rig)
    fb = rig.left.fx * rig.baseline_m
    steady = _steady(depth_maps_m, fb)
    drift_px = _check_at_rest(tuple(depth_maps_m), steady)
    sigma_px = spread_px(steady.deviation_px[np.isfinite(steady.deviation_px)])
    if sigma_px < LEAST_NOISE_PX:
        raise CalibrationError(
            f"depth noise: half of the depths are the same in all shots ({sigma_px:.1g} px of disparity apart, needs "
            f"{LEAST_NOISE_PX:g}): the camera repeats itself, or stores depth in steps that hide its noise"
        )
    first = next(iter(depth_maps_m.values()))
    seen_px = seen_noise_px(_disparity_px(first, fb), rim_distance_px(first))
    fit = fit_noise(_classes(steady), len(depth_maps_m), seen_px)
    drifts = f"depth drifts by {drift_px:.2g} px of disparity between shots: let the camera warm up"
    return replace(fit, warnings=(LOWER_BOUND, *((drifts,) if drift_px > LARGEST_DRIFT * sigma_px else ())))


def _check(depth_maps_m: Mapping[str, FloatArray], rig: StereoRig) -> None:
    count, size = len(depth_maps_m), (rig.left.height, rig.left.width)
    if not FEWEST_SHOTS <= count <= MOST_SHOTS:
        raise CalibrationError(f"depth noise: {count} shots of the scene, limits {FEWEST_SHOTS} to {MOST_SHOTS}")
    for name, depth_m in depth_maps_m.items():
        if depth_m.shape != size:
            raise CalibrationError(f"{name}: the depth map is {depth_m.shape}, the camera has {size} rows and columns")
    refuse_copies(depth_maps_m)


def _steady(depth_maps_m: Mapping[str, FloatArray], fb: float) -> _Steady:
    """Return the pixels that most shots measured, and what differs there."""
    maps = list(depth_maps_m.values())
    step = max(1, int(np.ceil(len(maps) * maps[0].size / MOST_ERRORS)))
    shots = np.stack([_disparity_px(depth_m, fb) for depth_m in maps])
    present = np.isfinite(shots).sum(axis=0)
    enough = present >= max(FEWEST_SHOTS, STEADY_SHARE * len(maps))
    if enough.sum() < FEWEST_PIXELS:
        raise CalibrationError(
            f"depth noise: {int(enough.sum())} px are measured in {STEADY_SHARE:.0%} of the shots, needs "
            f"{FEWEST_PIXELS}"
        )
    typical = np.full(enough.shape, np.nan)
    typical[enough] = np.nanmedian(shots[:, enough], axis=0)
    down, across = np.gradient(typical)
    gradient = np.hypot(np.nan_to_num(down), np.nan_to_num(across))
    kept = enough & (np.arange(len(enough)) % step == 0)[:, None]
    rows, columns = np.nonzero(kept)
    rim_px = np.stack([rim_distance_px(depth_m)[rows, columns] for depth_m in maps]).astype(np.float64)
    deviation = _deviation_px(shots[:, rows, columns].astype(np.float64), typical[rows, columns])
    return _Steady(rows, columns, gradient[rows, columns], deviation, rim_px)


def _disparity_px(depth_m: FloatArray, fb: float) -> Float32Array:
    present = np.isfinite(depth_m) & (np.nan_to_num(depth_m) > 0)
    return (fb / np.where(present, depth_m, np.nan)).astype(np.float32)


def _deviation_px(shots: FloatArray, typical: FloatArray) -> FloatArray:
    """Return deviations (N, P) from the mean of each pixel without jumps, scaled up by what the mean took off."""
    off = shots - typical
    limit = JUMP_SPREADS * max(spread_px(off[np.isfinite(off)]), LEAST_NOISE_PX)
    still = np.abs(off) <= limit
    count = still.sum(axis=0)
    mean = np.where(still, off, 0.0).sum(axis=0) / np.maximum(count, 1)
    return (off - mean) * np.sqrt(count / np.maximum(count - 1, 1))


def _check_at_rest(names: tuple[str, ...], steady: _Steady) -> float:
    """Return how far whole shots differ in disparity; raise CalibrationError where one shows something else."""
    spread = np.array([MAD_TO_SIGMA * np.nanmedian(np.abs(shot)) for shot in steady.deviation_px])
    worst = int(np.argmax(spread))
    usual = float(np.median(spread))
    if spread[worst] > max(MOVED_SPREADS * usual, usual + LEAST_MOVE_PX):
        raise CalibrationError(
            f"{names[worst]}: half of its depths are {spread[worst]:.2g} px of disparity off the other shots, "
            f"which differ by {usual:.2g} px: the scene or the camera moved"
        )
    return float(np.std([np.nanmedian(shot) for shot in steady.deviation_px]))


def _classes(steady: _Steady) -> list[Errors]:
    """Return the deviations by class of slope, without those too small. Raise CalibrationError if all are."""
    group = groups_of(steady.rows, steady.columns)
    there = np.isfinite(steady.deviation_px)
    which = np.digitize(steady.gradient, GRADIENT_EDGES) - 1
    classes: list[Errors] = []
    for each in range(len(GRADIENT_EDGES) - 1):
        inside = there & (which == each)
        if (inside & (steady.rim_px > AWAY_FROM_RIM_PX)).sum() < FEWEST_IN_CLASS:
            continue
        pixel = np.nonzero(inside)[1]
        classes.append(
            Errors(
                float(np.sqrt(np.mean(steady.gradient[pixel] ** 2))),
                steady.deviation_px[inside],
                steady.rim_px[inside],
                group[pixel],
            )
        )
    if not classes:
        raise CalibrationError(
            f"depth noise: no slope is shown by {FEWEST_IN_CLASS} depths that are more than {AWAY_FROM_RIM_PX:g} px "
            "from missing ones: show larger surfaces, or expose for less dropout"
        )
    return classes
