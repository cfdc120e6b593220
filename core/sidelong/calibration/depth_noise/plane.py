"""The largest flat surface of a depth map: on a plane disparity is affine in the image.

Three random pixels make a plane; the one that most pixels lie on (RANSAC, Fischler and Bolles 1981) is fitted anew to
those, until its tolerance suits their noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sidelong.calibration.depth_noise.table import MAD_TO_SIGMA, spread_px
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import StereoRig
from sidelong.physics.depth_noise import rim_distance_px, seen_noise_px
from sidelong.types import BoolArray, FloatArray, IntArray

TRIPLES = 1000
PIXELS_TO_VOTE = 4000
VOTE_SIGMAS, FIT_SIGMAS, CORE_SIGMAS = 2.0, 3.0, 4.0
"""How far off a plane pixels may lie that vote for it, are fitted, and show it. The floor of a bin and the table below
it may be so close that a plane between them has both within 4."""
ROUNDS = 10
TILE_PX = 16
TILE_SPREADS, LEAST_TILE_SIGMAS = 4.0, 0.5
"""How far the mean error of a tile may be from that of most: in their deviations, and at least so many of the noise."""
FEWEST_PIXELS = 2000
FRINGE_REACH_PX = 2
"""How far beside the plane what is off it counts as errors on it; what is wider than twice that is another thing."""
LARGEST_BOW = 0.5
"""Share of the variance of the errors that a cubic surface explains, above which a surface is not flat."""
LARGEST_NOISE_PX = 1.0
LEAST_NOISE_PX = 1e-4
"""Below it there is none: depth was made up, or its steps hide it."""


@dataclass(frozen=True, eq=False)
class FlatSurface:
    """A plane and the pixels that show it.

    Attributes
    ----------
    coefficients
        (3,): disparity is their product with (u, v, 1).
    pixels
        (H, W) with depth of the surface, outliers included.
    error_px
        (H, W) disparity less that of the plane; NaN where missing.
    """

    coefficients: FloatArray
    pixels: BoolArray
    error_px: FloatArray

    @property
    def gradient(self) -> float:
        """Change of disparity from pixel to pixel."""
        return float(np.hypot(*self.coefficients[:2]))

    @property
    def span_px(self) -> float:
        """How much disparity changes over it, but for its ends."""
        v, u = np.nonzero(self.pixels)
        return float(np.ptp(np.percentile(_on(self.coefficients, u, v), (2, 98))))


def flat_surface(depth_m: FloatArray, rig: StereoRig, name: str) -> FlatSurface:
    """Find the largest flat surface.

    Parameters
    ----------
    depth_m
        (H, W), NaN where missing.
    rig
        The cameras.
    name
        Of the capture, for messages.

    Raises
    ------
    CalibrationError
        Its size is not the camera's, nothing is measured, no surface is flat or large enough, or it shows no noise.
    """
    size = (rig.left.height, rig.left.width)
    if depth_m.shape != size:
        raise CalibrationError(f"{name}: the depth map is {depth_m.shape}, the camera has {size} rows and columns")
    present = np.isfinite(depth_m) & (np.nan_to_num(depth_m) > 0)
    if present.sum() < FEWEST_PIXELS:
        raise CalibrationError(f"{name}: {int(present.sum())} of {depth_m.size} px are measured, needs {FEWEST_PIXELS}")
    disparity_px = rig.left.fx * rig.baseline_m / np.where(present, depth_m, np.nan)
    plane, tolerance_px, own = _plane(disparity_px, present, name)
    error_px = disparity_px - _on(plane, *np.indices(size)[::-1])
    core = _connected(own & (np.nan_to_num(np.abs(error_px), nan=np.inf) <= tolerance_px))
    if core.sum() < FEWEST_PIXELS:
        raise CalibrationError(
            f"{name}: its largest flat surface has {int(core.sum())} px, needs {FEWEST_PIXELS}: show a "
            "flat plate, nearer"
        )
    _check_flat(error_px, core, name)
    return FlatSurface(plane, _with_fringe(core, present), error_px)


def _plane(disparity_px: FloatArray, present: BoolArray, name: str) -> tuple[FloatArray, float, BoolArray]:
    """Return the plane (3,) most pixels lie on, how far off it they may lie, and (H, W) where none is another's."""
    v, u = np.nonzero(present)
    d = disparity_px[v, u]
    sigma_px = seen_noise_px(disparity_px.astype(np.float32), rim_distance_px(disparity_px))
    plane = _voted(u, v, d, VOTE_SIGMAS * sigma_px)
    width = disparity_px.shape[1] // TILE_PX + 1
    tile = v // TILE_PX * width + u // TILE_PX
    own: BoolArray = np.ones(int(tile.max()) + 1, dtype=np.bool_)
    for _ in range(ROUNDS):
        inside = (np.abs(d - _on(plane, u, v)) <= FIT_SIGMAS * sigma_px) & own[tile]
        if inside.sum() < FEWEST_PIXELS:
            break
        columns = np.stack([u[inside], v[inside], np.ones(int(inside.sum()))], axis=1)
        plane = np.asarray(np.linalg.lstsq(columns, d[inside], rcond=None)[0], dtype=np.float64)
        error = d - _on(plane, u, v)
        sigma_px = spread_px(error[inside])
        if sigma_px < LEAST_NOISE_PX:
            raise CalibrationError(
                f"{name}: the depth of its flat surface has no noise ({sigma_px:.1g} px of disparity, needs "
                f"{LEAST_NOISE_PX:g}): it is made up, or stored in steps that hide the noise"
            )
        if sigma_px > LARGEST_NOISE_PX:
            break
        near = np.abs(error) <= CORE_SIGMAS * sigma_px
        own = _own_tiles(tile[near], error[near], sigma_px, len(own))
    if sigma_px > LARGEST_NOISE_PX:
        raise CalibrationError(
            f"{name}: its flattest surface scatters by {sigma_px:.2g} px of disparity about a plane, limit "
            f"{LARGEST_NOISE_PX:g}: show a flat plate"
        )
    mask: BoolArray = np.zeros(present.shape, dtype=bool)
    mask[v, u] = own[tile]
    return plane, CORE_SIGMAS * sigma_px, mask


def _own_tiles(tile: IntArray, error: FloatArray, sigma_px: float, tiles: int) -> BoolArray:
    """Say of which tiles the mean error is like that of most: others show a second surface a little off the first."""
    count = np.bincount(tile, minlength=tiles)
    mean = np.bincount(tile, error, minlength=tiles) / np.maximum(count, 1)
    full = count >= TILE_PX**2 / 2
    if not full.any():
        return np.ones(tiles, dtype=bool)
    off = np.abs(mean - np.median(mean[full]))
    limit = max(TILE_SPREADS * MAD_TO_SIGMA * float(np.median(off[full])), LEAST_TILE_SIGMAS * sigma_px)
    return ~full | (off <= limit)


def _voted(u: Any, v: Any, d: FloatArray, tolerance_px: float) -> FloatArray:
    """Return the plane through three pixels that most of some pixels lie on."""
    random = np.random.default_rng(0)  # same captures, same calibration
    voters = random.choice(len(d), min(len(d), PIXELS_TO_VOTE), replace=False)
    points = np.stack([u[voters], v[voters], np.ones(len(voters))], axis=1)
    triples = random.integers(0, len(voters), (TRIPLES, 3))
    corners = points[triples]
    sound = np.abs(np.linalg.det(corners)) > 1.0
    planes = np.linalg.solve(corners[sound], d[voters][triples[sound]][..., None])[..., 0]
    votes = (np.abs(planes @ points.T - d[voters]) <= tolerance_px).sum(axis=1)
    return planes[int(np.argmax(votes))]


def _on(plane: FloatArray, u: Any, v: Any) -> FloatArray:
    return plane[0] * u + plane[1] * v + plane[2]


def _connected(core: BoolArray) -> BoolArray:
    """Take off lines where other surfaces run through the plane."""
    import cv2

    image: Any = core.astype(np.uint8)
    closed = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    broad = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    return core & (cv2.dilate(broad, np.ones((5, 5), np.uint8)) > 0)


def _with_fringe(core: BoolArray, present: BoolArray) -> BoolArray:
    """Add pixels that are far off the plane, but in it or at its rim: outliers, not other things beside it."""
    import cv2

    square = np.ones((2 * FRINGE_REACH_PX + 1,) * 2, np.uint8)
    off: Any = (present & ~core).astype(np.uint8)
    things: BoolArray = np.asarray(cv2.morphologyEx(off, cv2.MORPH_OPEN, square) > 0)
    beside: BoolArray = np.asarray(cv2.dilate(core.astype(np.uint8), square) > 0)
    return core | (present & beside & ~things)


def _check_flat(error_px: FloatArray, core: BoolArray, name: str) -> None:
    """Refuse a surface whose errors a cubic one explains."""
    v, u = np.nonzero(core)
    error = error_px[v, u]
    x, y = (2 * (each - each.mean()) / max(np.ptp(each), 1) for each in (u, v))
    columns = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    bow = columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
    share = float(bow.var() / max(error.var(), 1e-30))
    if share > LARGEST_BOW:
        raise CalibrationError(
            f"{name}: its largest surface is bent by {bow.std():.2g} px of disparity rms, {share:.0%} of what it "
            f"deviates from a plane, limit {LARGEST_BOW:.0%}: show a flat plate"
        )
