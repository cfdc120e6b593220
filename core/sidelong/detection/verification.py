"""Hypothesis verification: aligns poses with what was seen, and says how probable each is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.alignment import Aligner
from sidelong.detection.appearance import AppearanceModel, Look, smoothed
from sidelong.detection.contours import ContourModel, EdgeField
from sidelong.detection.features import Features, contour_features, depth_features, grey_features
from sidelong.detection.plausibility import log_odds
from sidelong.detection.proposals import Starts
from sidelong.detection.settings import DetectionSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import FloatArray, GrayImage

T = TypeVar("T")

BATCH = 48
"""Poses worked on at a time: many enough that numpy's calls cost nothing, few enough for the processor's cache."""
THREADS = 2
GLANCE_GRID = 16
"""Pixels looked at across a part's diameter while its pose is not exact."""


class Evidence:
    """What was seen: edges, grey values without noise (H, W), and depth (H, W) where the view was measured."""

    def __init__(self, image: GrayImage, depth_m: FloatArray | None) -> None:
        self.edges = EdgeField(image)
        self.smooth: NDArray[np.float32] = smoothed(image)
        self.depth_m = depth_m


@dataclass(frozen=True, eq=False)
class Verified:
    """Aligned poses.

    Attributes
    ----------
    poses
        (K, 4, 4) ``camera_T_object``.
    log_odds
        (K,) that each is right, as if it were the only one.
    silhouettes
        For each the pixels (Q, 2) that it covers, with the depth of its surface there: (Q, 3).
    """

    poses: FloatArray
    log_odds: FloatArray
    silhouettes: tuple[FloatArray, ...]

    def __getitem__(self, chosen: slice | Sequence[int]) -> Verified:
        index = range(len(self.poses))[chosen] if isinstance(chosen, slice) else chosen
        silhouettes = tuple(self.silhouettes[k] for k in index)
        return Verified(self.poses[list(index)], self.log_odds[list(index)], silhouettes)

    @staticmethod
    def joined(parts: Sequence[Verified]) -> Verified:
        """Concatenate; none gives none."""
        return Verified(
            np.concatenate([np.zeros((0, 4, 4)), *(part.poses for part in parts)]),
            np.concatenate([np.zeros(0), *(part.log_odds for part in parts)]),
            tuple(silhouette for part in parts for silhouette in part.silhouettes),
        )


class Verifier:
    """Verifies poses of one part in images of one camera."""

    def __init__(self, part: Part, camera: PinholeCamera, settings: DetectionSettings) -> None:
        self._camera = camera
        self._diameter_m = part.diameter_m
        self._contours = ContourModel(part, settings)
        self._appearance = AppearanceModel(part, camera)
        self._glance = AppearanceModel(part, camera, GLANCE_GRID)
        self._aligner = Aligner(part, camera, self._contours, self._glance)

    def verify(self, starts: Starts, evidence: Evidence) -> Verified:
        """Align poses and say how probable each is. Contours, appearance and depth speak; see ``features``."""
        return Verified.joined(_in_batches(lambda batch: self._verify(batch, evidence), starts))

    def glance(self, starts: Starts, evidence: Evidence) -> tuple[Starts, FloatArray]:
        """Return poses moved to where they were measured, and how promising each (K,) is as it stands: log-odds."""
        parts = _in_batches(lambda batch: self._glance_at(batch, evidence), starts)
        moved, odds = [each[0] for each in parts], [each[1] for each in parts]
        return Starts.joined(moved), np.concatenate([np.zeros(0), *odds])

    def aligned(self, starts: Starts, evidence: Evidence) -> tuple[FloatArray, Look, Features]:
        """Return aligned poses (K, 4, 4), what they look like, and what speaks for and against them."""
        poses = self._aligner.align(starts.poses, starts.limits_m, evidence.edges, evidence.depth_m)
        look = self._appearance.look(poses)
        return poses, look, self._features(poses, look, evidence)

    def _features(self, poses: FloatArray, look: Look, evidence: Evidence) -> Features:
        features = {
            **contour_features(self._contours, evidence.edges, self._camera, poses, self._diameter_m),
            **grey_features(look, evidence.smooth),
        }
        if evidence.depth_m is not None:
            features |= depth_features(look, evidence.depth_m, self._diameter_m)
        return features

    def _verify(self, starts: Starts, evidence: Evidence) -> Verified:
        poses, look, features = self.aligned(starts, evidence)
        surface = np.concatenate([look.uv, look.depth_m[..., None]], axis=-1)
        silhouettes = tuple(each[covered] for each, covered in zip(surface, look.covered, strict=True))
        return Verified(poses, log_odds(features), silhouettes)

    def _glance_at(self, starts: Starts, evidence: Evidence) -> tuple[Starts, FloatArray]:
        poses = self._aligner.at_measured_distance(starts.poses, evidence.depth_m)
        look = self._glance.look(poses)
        return Starts(poses, starts.limits_m), log_odds(self._features(poses, look, evidence))


def _in_batches(work: Callable[[Starts], T], starts: Starts) -> list[T]:
    """Do the work on batches of poses, in threads: numpy, OpenCV and Open3D let go of the interpreter."""
    batches = [starts[slice(first, first + BATCH)] for first in range(0, len(starts.poses), BATCH)]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, batches))
