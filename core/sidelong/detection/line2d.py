"""Detection of a part in one grey image: template matching (Line2D), clustering, alignment, hypotheses."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType

import numpy as np

from sidelong.detection.clusters import cluster, distinct, softmax, uncovered
from sidelong.detection.depth_evidence import DistanceBounds
from sidelong.detection.matcher_process import MatcherProcess, Matches
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.template_cache import load_or_train
from sidelong.detection.templates import Progress, TemplateSet, pose_on_ray
from sidelong.detection.verification import Evidence, Starts, Verified, Verifier
from sidelong.errors import ImageError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import DetectedObject, FloatArray, GrayImage, Hypothesis

CLUSTERS_PER_OBJECT = 3
"""False clusters are dropped after alignment only: so many more than objects are looked at."""
FIRST_POSES = 4
CELL = 0.05
"""Size of the cells on which silhouettes are compared, in diameters of the part."""


@dataclass(frozen=True)
class DetectionReport:
    """What the last detection did: matches found and kept, clusters looked at, seconds of matching and of the rest."""

    matches: int
    matches_kept: int
    clusters: int
    match_s: float
    align_s: float


@dataclass(frozen=True, eq=False)
class _Models:
    """What ``prepare`` makes."""

    templates: TemplateSet
    matcher: MatcherProcess
    verifier: Verifier


class Line2DDetector:
    """Finds a part in images of one camera. A context manager; it owns a child process.

    Parameters
    ----------
    part
        CAD model.
    camera
        Of the images.
    settings
        Templates, matching, hypotheses.
    cache_dir
        Where trained templates are kept.
    """

    def __init__(self, part: Part, camera: PinholeCamera, settings: DetectionSettings, cache_dir: Path) -> None:
        self._part = part
        self._camera = camera
        self._settings = settings
        self._cache_dir = cache_dir
        self._models: _Models | None = None
        self.last_report: DetectionReport | None = None

    def __enter__(self) -> Line2DDetector:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def matcher_pid(self) -> int | None:
        """Process id of the matcher's child, None where there is none."""
        return None if self._models is None else self._models.matcher.pid

    def close(self) -> None:
        """End the child process. Harmless when repeated; ``detect`` starts another one."""
        if self._models is not None:
            self._models.matcher.close()

    def prepare(self, progress: Progress | None = None) -> None:
        """Load the templates from the cache, or train and store them; ``progress(done, total)`` counts pictures.

        Raises
        ------
        DetectionError
            The part offers too few edges for templates.
        """
        self._prepared(progress)

    def detect(self, image: GrayImage, depth_m: FloatArray | None = None) -> tuple[DetectedObject, ...]:
        """Find the part in an image.

        Parameters
        ----------
        image
            (H, W) 8-bit grey.
        depth_m
            (H, W) what was measured from the same place, NaN where missing: it bounds the distances.

        Returns
        -------
        tuple of DetectedObject
            Best first, each with its hypotheses; () where there is none.

        Raises
        ------
        ImageError
            Not an 8-bit grey image, or a depth map, of the camera's size.
        SettingsError
            There are no templates for the distances that were measured.
        MatcherDiedError
            The child process died or missed its deadline; the next call starts another one.
        """
        self._check(image, depth_m)
        if image.min() == image.max():
            return ()
        models = self._prepared()
        started = time.monotonic()
        matches = models.matcher.match(self._resized(image, models.templates.focal_px))
        matched = time.monotonic()
        bounds = DistanceBounds(depth_m, self._settings.reach_m, self._part.diameter_m)
        bounds.check()
        clusters = self._clusters(matches, models.templates, bounds)
        evidence = Evidence(image, depth_m)

        def verified(starts: list[Starts], known: list[Verified]) -> list[Verified]:
            """Verify all at once, and merge each with what is known of it already."""
            found = models.verifier.verify(Starts.joined(starts), evidence)
            ends = np.cumsum([0, *(len(each.poses) for each in starts)])
            mine = (found[first:last] for first, last in pairwise(ends.tolist()))
            return [self._merged([old, new]) for old, new in zip(known, mine, strict=True)]

        # a few poses decide whether a cluster is an object; only then the others are worth their time
        nothing = Verified.joined([])
        first = verified([starts[:FIRST_POSES] for starts in clusters], [nothing] * len(clusters))
        free = self._free(first)
        objects = verified([clusters[index][FIRST_POSES:] for index in free], [first[index] for index in free])
        objects = [objects[index] for index in self._free(objects)][: self._settings.max_objects]
        self.last_report = DetectionReport(
            matches.total, len(matches.row), len(clusters), matched - started, time.monotonic() - matched
        )
        return tuple(_object(found, self._settings.temperature) for found in objects)

    def _prepared(self, progress: Progress | None = None) -> _Models:
        if self._models is None:
            templates = load_or_train(self._part, self._camera, self._settings, self._cache_dir, progress)
            self._models = _Models(
                templates,
                MatcherProcess(templates, self._settings),
                Verifier(self._part, self._camera, self._settings),
            )
        return self._models

    def _check(self, image: GrayImage, depth_m: FloatArray | None) -> None:
        if image.dtype != np.uint8:
            raise ImageError(f"detection: the image's type is {image.dtype}, needs uint8")
        if image.ndim != 2:
            raise ImageError(f"detection: the image has {image.ndim} dimensions {image.shape}, needs 2 (grey)")
        height, width = image.shape
        if (width, height) != (self._camera.width, self._camera.height):
            raise ImageError(
                f"detection: the image is {width}x{height} px, "
                f"the camera's are {self._camera.width}x{self._camera.height} px"
            )
        if depth_m is not None and depth_m.shape != image.shape:
            raise ImageError(f"detection: the depth map is {depth_m.shape}, the image {image.shape}")

    def _resized(self, image: GrayImage, focal_px: float) -> GrayImage:
        """Return the image as a camera with square pixels and the templates' focal length sees it."""
        import cv2

        size = (
            max(1, round(self._camera.width * focal_px / self._camera.fx)),
            max(1, round(self._camera.height * focal_px / self._camera.fy)),
        )
        shrinks = focal_px < self._camera.fx
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR).astype(np.uint8)

    def _clusters(self, matches: Matches, templates: TemplateSet, bounds: DistanceBounds) -> list[Starts]:
        """Return the distinct poses of each cluster, best match first."""
        settings, camera = self._settings, self._camera
        scale = templates.focal_px / np.array([camera.fx, camera.fy])
        # (corner + 1/2) / scale - 1/2 moves pixel centres between the sizes
        uv = (matches.corner_px + templates.centre_px[matches.row] + 0.5) / scale - 0.5
        distance_m, rotation = templates.distance_m[matches.row], templates.axis_R_object[matches.row]
        diameter_px = camera.fx * self._part.diameter_m / distance_m
        near_m, far_m = bounds.at(uv, diameter_px / 2)
        half_step = np.sqrt(settings.distance_ratio)
        possible = (distance_m * half_step >= near_m) & (distance_m / half_step <= far_m)
        row = matches.row[possible]
        uv, distance_m, rotation, near_m, far_m, diameter_px = (
            each[possible] for each in (uv, distance_m, rotation, near_m, far_m, diameter_px)
        )
        distance_m = np.clip(distance_m, near_m, far_m)
        step_rad, limit = np.radians(settings.pose_step_deg), settings.hypotheses_per_object
        clusters: list[Starts] = []
        for members in cluster(uv, settings.cluster_radius * diameter_px, CLUSTERS_PER_OBJECT * settings.max_objects):
            # one template matches at many places next to each other: its best place stands for them
            members = members[np.sort(np.unique(row[members], return_index=True)[1])]
            kept = members[distinct(rotation[members], distance_m[members], step_rad, limit)]
            poses = [pose_on_ray(uv[k], camera, rotation[k], float(distance_m[k]), self._part.centre_m) for k in kept]
            clusters.append(Starts(np.array(poses), np.stack([near_m[kept], far_m[kept]], axis=-1)))
        return clusters

    def _merged(self, parts: list[Verified]) -> Verified:
        """Join hypotheses of one object, best first, like poses once."""
        found = Verified.joined(parts)
        order = np.argsort(-found.scores, kind="stable")
        fine_rad = np.radians(self._settings.pose_step_deg) / 3
        poses = found.poses[order]
        return found[order[distinct(poses[:, :3, :3], poses[:, 2, 3], fine_rad, len(order))].tolist()]

    def _free(self, candidates: list[Verified]) -> list[int]:
        """Return the positions of the candidates that score well and that no better one covers, best first."""
        order = sorted(range(len(candidates)), key=lambda index: -candidates[index].scores[0])
        good = [index for index in order if candidates[index].scores[0] >= self._settings.min_score]
        if not good:
            return []
        far_m = max(float(candidates[index].poses[0, 2, 3]) for index in good)
        cell_px = max(2.0, CELL * self._camera.fx * self._part.diameter_m / far_m)
        free = uncovered([candidates[index].silhouettes_px[0] for index in good], cell_px, self._settings.overlap)
        return [index for index, is_free in zip(good, free, strict=True) if is_free]


def _object(candidate: Verified, temperature: float) -> DetectedObject:
    probabilities = softmax(candidate.scores, temperature)
    return DetectedObject(
        tuple(
            Hypothesis(pose, float(score), float(probability))
            for pose, score, probability in zip(candidate.poses, candidate.scores, probabilities, strict=True)
        )
    )
