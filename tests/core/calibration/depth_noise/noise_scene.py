"""Depth maps of plates whose noise is known, term by term."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sidelong.physics.depth_noise import DepthNoise, rim_distance_px
from sidelong.simulation.rig import rig_for
from sidelong.types import BoolArray, FloatArray

RIG = rig_for(640, 512)
SIZE = (RIG.left.height, RIG.left.width)
FB = RIG.left.fx * RIG.baseline_m
TILTS = ((0.6, 0.05, 0.0), (0.7, 0.35, 0.4), (0.8, 0.6, 1.0), (0.7, 0.8, 2.2), (0.65, 0.9, 0.2))
"""Distance, tilt, and the direction of the tilt of five captures: gradients of disparity up to 0.24 px per px."""


@dataclass(frozen=True)
class Plate:
    """A plate with three holes, before something that is not flat; noise reaches ``blur_px`` from pixel to pixel."""

    noise: DepthNoise
    blur_px: float = 1.2
    dropout: float = 0.02
    behind: bool = True
    filling: bool = False

    def capture(self, distance_m: float, tilt_rad: float, turn_rad: float, seed: int) -> FloatArray:
        """Return a depth map (H, W)."""
        random = np.random.default_rng(seed)
        truth_px = plane_px(distance_m, tilt_rad, turn_rad)
        shown, beyond = self._places()
        spots = cv2.GaussianBlur(random.normal(size=SIZE), (0, 0), 3.0)
        present = shown & (spots <= np.quantile(spots, 1 - self.dropout))
        known = present | beyond
        error_px = self._error_px(truth_px, known, random)
        wavy_px = truth_px - 12 + 4 * np.sin(np.indices(SIZE).sum(axis=0) / 20)
        return FB / np.where(known, np.where(present, truth_px, wavy_px) + error_px, np.nan)

    def captures(self, seed: int = 0) -> dict[str, FloatArray]:
        """Return the captures at all tilts."""
        return {f"DEPTH_{index}": self.capture(*tilt, 100 * seed + index) for index, tilt in enumerate(TILTS)}

    def _places(self) -> tuple[BoolArray, BoolArray]:
        """Return which pixels (H, W) show the plate, and which what is beyond it: between them depth is missing."""
        v, u = np.indices(SIZE)
        plate = np.ones(SIZE, dtype=np.bool_)
        if not self.filling:
            plate = (np.abs(u - 320) < 230) & (np.abs(v - 256) < 200)
            for column, row, radius in ((220, 200, 30), (390, 310, 45), (320, 120, 18)):
                plate &= (u - column) ** 2 + (v - row) ** 2 > radius**2
        apart = cv2.dilate(plate.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        return plate, ~apart if self.behind else np.zeros(SIZE, dtype=np.bool_)

    def _error_px(self, truth_px: FloatArray, known: BoolArray, random: np.random.Generator) -> FloatArray:
        noise = self.noise
        rim_px = rim_distance_px(np.where(known, 1.0, np.nan))
        gradient = np.hypot(*np.gradient(truth_px))
        edge = noise.rim_px * np.exp((1 - rim_px) / noise.rim_reach_px)
        sigma_px = np.sqrt((noise.disparity_px or 0.0) ** 2 + (noise.slope_px * gradient) ** 2 + edge**2)
        share = np.where(rim_px < 1.5, noise.rim_outlier_share, noise.outlier_share)
        far_px = random.uniform(8, 30, SIZE) * random.choice([-1, 1], SIZE)
        return np.where(random.random(SIZE) < share, far_px, sigma_px * blurred(random, self.blur_px))


def plane_px(distance_m: float, tilt_rad: float, turn_rad: float) -> FloatArray:
    """Return the disparity (H, W) of a plane through a point on the image's middle, tilted."""
    normal = np.array([np.sin(tilt_rad) * np.cos(turn_rad), np.sin(tilt_rad) * np.sin(turn_rad), np.cos(tilt_rad)])
    middle = distance_m * RIG.left.rays(np.array(320.0), np.array(256.0))
    return FB * (RIG.left.pixel_rays() @ normal) / float(normal @ middle)


def blurred(random: np.random.Generator, blur_px: float) -> FloatArray:
    """Return noise (H, W) of deviation 1 that a Gaussian has blurred."""
    noise = random.normal(size=SIZE)
    if blur_px > 0:
        noise = cv2.GaussianBlur(noise, (0, 0), blur_px)
    return noise / noise.std()
