"""Hypothesis verification: aligns poses with what was seen, and says how probable each is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.alignment import Aligner
from sidelong.detection.appearance import AppearanceModel, Look, ReflectanceMaps, smoothed
from sidelong.detection.contours import ContourModel, ContourPoints, EdgeField
from sidelong.detection.features import Features, contour_features, depth_features, grey_features
from sidelong.detection.plausibility import log_odds
from sidelong.detection.proposals import Starts
from sidelong.detection.settings import DetectionSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import FloatArray, GrayImage, IntArray

T = TypeVar("T")

BATCH = 48
"""Poses worked on at a time: many enough that numpy's calls cost nothing, few enough for the processor's cache."""
THREADS = 2
GLANCE_GRID = 16
"""Pixels looked at across a part's diameter while its pose is not exact."""
VIEW_STEP = 0.01
"""Directions to the viewer, unit vectors, that differ by less than about this show one view of a part."""


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
    fits
        (K,) share of what was measured on each that lies on its surface; 0 without depth.
    silhouettes
        For each the pixels (Q, 2) that it covers, with the depth of its surface there: (Q, 3).
    """

    poses: FloatArray
    log_odds: FloatArray
    fits: FloatArray
    silhouettes: tuple[FloatArray, ...]

    def __getitem__(self, chosen: slice | Sequence[int]) -> Verified:
        index = range(len(self.poses))[chosen] if isinstance(chosen, slice) else chosen
        silhouettes = tuple(self.silhouettes[k] for k in index)
        rows = list(index)
        return Verified(self.poses[rows], self.log_odds[rows], self.fits[rows], silhouettes)

    @staticmethod
    def joined(parts: Sequence[Verified]) -> Verified:
        """Concatenate; none gives none."""
        return Verified(
            np.concatenate([np.zeros((0, 4, 4)), *(part.poses for part in parts)]),
            np.concatenate([np.zeros(0), *(part.log_odds for part in parts)]),
            np.concatenate([np.zeros(0), *(part.fits for part in parts)]),
            tuple(silhouette for part in parts for silhouette in part.silhouettes),
        )


class Verifier:
    """Verifies poses of one part in images of one camera."""

    def __init__(self, part: Part, camera: PinholeCamera, settings: DetectionSettings) -> None:
        self._camera = camera
        self._centre_m, self._diameter_m = part.centre_m, part.diameter_m
        self._contours = ContourModel(part, settings)
        self._appearance = AppearanceModel(part, camera)
        self._glance = AppearanceModel(part, camera, GLANCE_GRID)
        self._aligner = Aligner(part, camera, self._contours, self._glance, settings.distance_ratio)

    def verify(self, starts: Starts, evidence: Evidence) -> Verified:
        """Align poses and say how probable each is. Contours, appearance and depth speak; see ``features``."""
        return Verified.joined(_in_batches(lambda batch: self._verify(batch, evidence), starts))

    def glance(self, starts: Starts, evidence: Evidence) -> tuple[Starts, FloatArray]:
        """Return poses moved to where they were measured, and how promising each (K,) is as it stands: log-odds.

        Poses that show the same view of the part, wherever it lies and however it is turned in the image, share what is
        found by casting rays: the surface and the contours that are seen.
        """
        order = np.argsort(same_view(starts.poses, self._centre_m)[1], kind="stable")
        parts = _in_batches(lambda batch: self._glance_at(batch, evidence), starts[order])
        moved = Starts.joined([each[0] for each in parts])
        back = np.argsort(order)
        return moved[back], np.concatenate([np.zeros(0), *(each[1] for each in parts)])[back]

    def aligned(self, starts: Starts, evidence: Evidence) -> tuple[FloatArray, Look, Features]:
        """Return aligned poses (K, 4, 4), what they look like, and what speaks for and against them."""
        poses = self._aligner.align(starts.poses, starts.limits_m, evidence.edges, evidence.depth_m)
        surface, contour = self._appearance.surface(poses), self._contours.select(poses, np.random.default_rng(1))
        look, maps = self._appearance.seen(surface, poses), ReflectanceMaps(surface)
        return poses, look, self._features(poses, (look, contour, maps, np.arange(len(poses))), evidence)

    def _features(
        self, poses: FloatArray, shown: tuple[Look, ContourPoints, ReflectanceMaps, IntArray], evidence: Evidence
    ) -> Features:
        look, contour, maps, view = shown
        features = {
            **contour_features(contour, evidence.edges, self._camera, poses, self._diameter_m),
            **grey_features(look, maps, view, evidence.smooth),
        }
        if evidence.depth_m is not None:
            features |= depth_features(look, evidence.depth_m, self._diameter_m)
        return features

    def _verify(self, starts: Starts, evidence: Evidence) -> Verified:
        poses, look, features = self.aligned(starts, evidence)
        surface = np.concatenate([look.uv, look.depth_m[..., None]], axis=-1).astype(np.float64)
        silhouettes = tuple(each[covered] for each, covered in zip(surface, look.covered, strict=True))
        fits = features.get("fits", np.zeros(len(poses)))
        return Verified(poses, log_odds(features), fits, silhouettes)

    def _glance_at(self, starts: Starts, evidence: Evidence) -> tuple[Starts, FloatArray]:
        first, view = same_view(starts.poses, self._centre_m)
        views = self._glance.surface(starts.poses[first])
        contour = self._contours.select(starts.poses[first], np.random.default_rng(1))[view]
        surface = views[view]
        poses = self._aligner.at_measured_distance(surface, starts.poses, evidence.depth_m)
        look = self._glance.seen(surface, poses)
        features = self._features(poses, (look, contour, ReflectanceMaps(views), view), evidence)
        return Starts(poses, starts.limits_m), log_odds(features)


def same_view(camera_T_object: FloatArray, centre_m: FloatArray) -> tuple[IntArray, IntArray]:
    """Group poses (K, 4, 4) by the direction from which they show the part; return the first of each, and its group.

    Turns in the image plane, places and distances do not matter: of a part much smaller than its distance they hide
    nothing else.

    Returns
    -------
    tuple of IntArray
        (V,) a pose of each view, and (K,) which view each pose shows.
    """
    rotation = camera_T_object[:, :3, :3]
    centre = rotation @ centre_m + camera_T_object[:, :3, 3]
    direction = (centre[:, None] @ rotation)[:, 0] / np.linalg.norm(centre, axis=1, keepdims=True)
    u, v, w = np.rint(direction / VIEW_STEP).astype(np.int64).T
    _, first, view = np.unique((u << 40) + (v << 20) + w, return_index=True, return_inverse=True)
    return first, view


def _in_batches(work: Callable[[Starts], T], starts: Starts) -> list[T]:
    """Do the work on batches of poses, in threads: numpy, OpenCV and Open3D let go of the interpreter."""
    batches = [starts[slice(first, first + BATCH)] for first in range(0, len(starts.poses), BATCH)]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, batches))
