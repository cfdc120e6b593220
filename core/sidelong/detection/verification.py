"""Hypothesis verification: aligns poses with what was seen, and says how well each explains it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.appearance import (
    AppearanceModel,
    Look,
    explained_variance,
    faces_are_bright,
    grey_around,
    smoothed,
)
from sidelong.detection.contours import FINE_SPANS, ContourModel, EdgeField
from sidelong.detection.depth_evidence import contradicted, offsets, residuals
from sidelong.detection.settings import DetectionSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import FloatArray, GrayImage

BATCH = 48
"""Poses worked on at a time: many enough that numpy's calls cost nothing, few enough for the processor's cache."""


class Evidence:
    """What was seen: edges, grey values without noise (H, W), and depth (H, W) where the view was measured."""

    def __init__(self, image: GrayImage, depth_m: FloatArray | None) -> None:
        self.edges = EdgeField(image)
        self.smooth: NDArray[np.float32] = smoothed(image)
        self.depth_m = depth_m


@dataclass(frozen=True, eq=False)
class Starts:
    """Poses (K, 4, 4) before alignment, and how near and far (K, 2) their centres may be, in metres."""

    poses: FloatArray
    limits_m: FloatArray

    def __getitem__(self, chosen: slice) -> Starts:
        return Starts(self.poses[chosen], self.limits_m[chosen])

    @staticmethod
    def joined(parts: Sequence[Starts]) -> Starts:
        """Concatenate; none gives none."""
        return Starts(
            np.concatenate([np.zeros((0, 4, 4)), *(part.poses for part in parts)]),
            np.concatenate([np.zeros((0, 2)), *(part.limits_m for part in parts)]),
        )


@dataclass(frozen=True, eq=False)
class Verified:
    """Aligned poses (K, 4, 4), their scores (K,) 0..100, and the pixels (Q, 2) each covers."""

    poses: FloatArray
    scores: FloatArray
    silhouettes_px: tuple[FloatArray, ...]

    def __getitem__(self, chosen: slice | Sequence[int]) -> Verified:
        index = range(len(self.poses))[chosen] if isinstance(chosen, slice) else chosen
        silhouettes = tuple(self.silhouettes_px[k] for k in index)
        return Verified(self.poses[list(index)], self.scores[list(index)], silhouettes)

    @staticmethod
    def joined(parts: Sequence[Verified]) -> Verified:
        """Concatenate; none gives none."""
        return Verified(
            np.concatenate([np.zeros((0, 4, 4)), *(part.poses for part in parts)]),
            np.concatenate([np.zeros(0), *(part.scores for part in parts)]),
            tuple(silhouette for part in parts for silhouette in part.silhouettes_px),
        )


class Verifier:
    """Verifies poses of one part in images of one camera."""

    def __init__(self, part: Part, camera: PinholeCamera, settings: DetectionSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._centre_m = part.centre_m
        self._diameter_m = part.diameter_m
        self._contours = ContourModel(part, settings)
        self._appearance = AppearanceModel(part, camera)

    def verify(self, starts: Starts, evidence: Evidence) -> Verified:
        """Align poses and score them.

        The score is 50 (contour agreement + explained variance), less the share of pixels that a measured depth
        contradicts. Contours place a part exactly, its appearance tells its ends and faces apart, and depth its
        distance.
        """
        batches = (starts[first : first + BATCH] for first in range(0, len(starts.poses), BATCH))
        return Verified.joined([self._verify(batch, evidence) for batch in batches])

    def _verify(self, starts: Starts, evidence: Evidence) -> Verified:
        poses = self._contours.align(evidence.edges, self._camera, starts.poses, starts.limits_m)
        look, doubt = self._appearance.look(poses), np.zeros(len(poses))
        if evidence.depth_m is not None:
            poses = self._at_measured_distance(poses, look, evidence.edges, evidence.depth_m)
            look = self._appearance.look(poses)
            tolerance_m = self._settings.depth_tolerance * self._diameter_m
            doubt = contradicted(residuals(look, evidence.depth_m), look.covered, tolerance_m)
        grey = grey_around(look, evidence.smooth)
        agreement = self._contours.agreement(evidence.edges, self._camera, poses)
        appearance = explained_variance(look, grey)
        if self._settings.bright_faces:
            appearance *= faces_are_bright(look, grey, self._settings)
        scores = 50 * (agreement + appearance) * (1.0 - doubt)
        silhouettes = tuple(uv[covered] for uv, covered in zip(look.uv, look.covered, strict=True))
        return Verified(poses, scores, silhouettes)

    def _at_measured_distance(self, poses: FloatArray, look: Look, edges: EdgeField, depth_m: FloatArray) -> FloatArray:
        """Move poses to where they were measured, and align the rest of each pose anew."""
        further_m = offsets(residuals(look, depth_m), look.covered, self._diameter_m / 2)
        distance_m = (poses[:, :3, :3] @ self._centre_m)[:, 2] + poses[:, 2, 3] + further_m
        fixed_m = np.stack([distance_m, distance_m], axis=-1)
        return self._contours.align(edges, self._camera, poses, fixed_m, FINE_SPANS)
