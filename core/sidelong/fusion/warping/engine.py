"""Fusion in the reference view: each depth map is warped into it, and the views vote on every hole.

Each hole is an element with a Gaussian-with-outlier measurement model (Vogiatzis and Hernandez, 2011: a depth is either
normal about the truth or anything at all). Their filter keeps one Gaussian and a Beta count a pixel, and what it keeps
depends on the order of the views. Here all depths of a hole are kept and weighed at once, so the order does not matter,
and what a view saw through speaks against a surface (free space, as in Curless and Levoy, 1996).
"""

from __future__ import annotations

import numpy as np

from sidelong.fusion.engine import MISSING, Estimate, PosedDepth
from sidelong.fusion.settings import FusionSettings
from sidelong.fusion.vote_kernels import settle
from sidelong.fusion.warping.warp import Holes, Layer, motion_of, warp
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, rotation_angle
from sidelong.kernels import strips
from sidelong.types import BoolArray, Float32Array, FloatArray, IntArray

SAME_PLACE_M, SAME_PLACE_RAD = 2e-3, 0.01
"""Views closer than this see the same errors of the matcher again: together they count as one."""


class WarpEngine:
    """Keeps what each view says of each hole, and settles on one depth.

    Memory grows by 12 bytes a hole and 4 a pixel with each view, up to ``max_views``; then what has been settled is
    kept as one layer, and the views before are forgotten.

    Parameters
    ----------
    camera
        Of all views.
    wanted
        (H, W) the holes.
    settings
        How.
    """

    def __init__(self, camera: PinholeCamera, wanted: BoolArray, settings: FusionSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._holes = Holes.of(wanted, settings)
        size = settings.max_views + 1, self._holes.count
        # only the pages that are written to take memory
        self._layers: tuple[Float32Array, Float32Array, Float32Array] = (
            np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
        )  # fmt: skip
        self._maps = np.empty((settings.max_views, *wanted.shape), dtype=np.float32)
        self._motions = np.empty((settings.max_views, 4, 3), dtype=np.float32)
        self._poses: list[FloatArray] = []
        self._steps: list[int] = []
        self._settled: IntArray | None = None
        """(N,) sources of layer 0 where it stands for views that are forgotten."""
        self._estimate: Estimate | None = None

    @property
    def scene(self) -> None:
        """None: what the reference view does not see is not kept."""

    def add(self, view: PosedDepth) -> None:
        """Take in the depth map of one more view."""
        if len(self._steps) == self._settings.max_views:
            self._forget_views()
        number = len(self._steps)
        warp(view, self._camera, self._holes, self._settings, self._layer(self._first + number))
        self._maps[number] = view.depth_m
        self._motions[number] = motion_of(self._camera, invert(view.reference_T_view))[:4]
        self._poses.append(view.reference_T_view)
        self._steps.append(view.step)
        self._estimate = None

    @property
    def _first(self) -> int:
        """Number of layers that stand for views that are forgotten."""
        return 0 if self._settled is None else 1

    def _layer(self, number: int) -> Layer:
        depth_m, variance_m2, trust = self._layers
        return depth_m[number], variance_m2[number], trust[number]

    def _forget_views(self) -> None:
        settled, odds = self._settle()
        self._settled = settled.source
        depth_m, variance_m2, trust = self._layer(0)
        depth_m[:], variance_m2[:], trust[:] = settled.depth_m, settled.sigma_m**2, odds
        self._poses.clear()
        self._steps.clear()

    def estimate(self) -> Estimate:
        """Return the depth of the holes as all views show it."""
        if self._estimate is None:
            self._estimate = self._settle()[0]
        return self._estimate

    def _settle(self) -> tuple[Estimate, Float32Array]:
        """Return the estimate, and the log-odds (N,) of its depths."""
        s, count = self._settings, self._first + len(self._steps)
        depth_m, variance_m2, odds = (np.empty(self._holes.count, dtype=np.float32) for _ in range(3))
        layer = np.empty(self._holes.count, dtype=np.int32)
        alike = np.ones(count, dtype=np.float32)
        alike[self._first :] = _alike(self._poses)
        limits = np.array([s.agreement_sigmas, s.front_band_m, s.through_m, s.noise.trust], dtype=np.float32)
        view_of = np.arange(count, dtype=np.int32) - self._first
        views = self._maps, self._motions, view_of
        result = depth_m, variance_m2, odds, layer
        strips(
            lambda first, last: settle(self._layers, alike, self._holes.pixels, views, limits, result, first, last),
            self._holes.count,
            each=8,
        )
        steps = np.array(self._steps, dtype=np.intp)
        source = np.full(len(layer), MISSING, dtype=np.intp)
        newer = layer >= self._first
        source[newer] = steps[layer[newer] - self._first]
        if self._settled is not None:
            source[layer == 0] = self._settled[layer == 0]
        return Estimate(depth_m.astype(np.float64), np.sqrt(variance_m2.astype(np.float64)), source), odds


def _alike(poses: list[FloatArray]) -> FloatArray:
    """Return how many of the poses (4, 4) are about the same as each."""
    alike = np.ones(len(poses))
    for i, one in enumerate(poses):
        for j, other in enumerate(poses):
            apart = invert(one) @ other
            near = np.linalg.norm(apart[:3, 3]) < SAME_PLACE_M and rotation_angle(apart[:3, :3]) < SAME_PLACE_RAD
            alike[i] += i != j and near
    return alike
