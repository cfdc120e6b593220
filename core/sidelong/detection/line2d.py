"""Detection of a part in one grey image: template matching (Line2D), clustering, alignment, hypotheses."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.appearance import AppearanceModel, explained_variance, smoothed
from sidelong.detection.clusters import cluster, distinct, softmax, uncovered
from sidelong.detection.contours import ContourModel, EdgeField
from sidelong.detection.matcher_process import MatcherProcess, Matches
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.template_cache import load_or_train
from sidelong.detection.templates import Progress, TemplateSet, pose_on_ray
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
    contours: ContourModel
    appearance: AppearanceModel


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What the image says: its edges, and its grey values without noise (H, W)."""

    edges: EdgeField
    smooth: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Aligned poses (K, 4, 4) of one cluster, their scores (K,) best first, and their silhouettes (Q, 2) px."""

    poses: FloatArray
    scores: FloatArray
    silhouettes_px: tuple[FloatArray, ...]


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

    def detect(self, image: GrayImage) -> tuple[DetectedObject, ...]:
        """Return the objects in the image (H, W), best first, each with its hypotheses; () where there is none.

        Raises
        ------
        ImageError
            Not an 8-bit grey image of the camera's size.
        MatcherDiedError
            The child process died or missed its deadline; the next call starts another one.
        """
        self._check(image)
        if image.min() == image.max():
            return ()
        models = self._prepared()
        started = time.monotonic()
        matches = models.matcher.match(self._resized(image, models.templates.focal_px))
        matched = time.monotonic()
        clusters = self._clusters(matches, models.templates)
        evidence = _Evidence(EdgeField(image), smoothed(image))
        # a few poses decide whether a cluster is an object; only then the others are worth their time
        first = [self._candidate(poses[:FIRST_POSES], None, evidence, models) for poses in clusters]
        objects = [
            self._candidate(clusters[index][FIRST_POSES:], first[index], evidence, models)
            for index in self._free(first)
        ]
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
                ContourModel(self._part, self._settings),
                AppearanceModel(self._part, self._camera),
            )
        return self._models

    def _check(self, image: GrayImage) -> None:
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

    def _resized(self, image: GrayImage, focal_px: float) -> GrayImage:
        """Return the image as a camera with square pixels and the templates' focal length sees it."""
        import cv2

        size = (
            max(1, round(self._camera.width * focal_px / self._camera.fx)),
            max(1, round(self._camera.height * focal_px / self._camera.fy)),
        )
        shrinks = focal_px < self._camera.fx
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR).astype(np.uint8)

    def _clusters(self, matches: Matches, templates: TemplateSet) -> list[FloatArray]:
        """Return the distinct poses (K, 4, 4) of each cluster, best match first."""
        settings, camera = self._settings, self._camera
        scale = templates.focal_px / np.array([camera.fx, camera.fy])
        # (corner + 1/2) / scale - 1/2 moves pixel centres between the sizes
        uv = (matches.corner_px + templates.centre_px[matches.row] + 0.5) / scale - 0.5
        distance_m, rotation = templates.distance_m[matches.row], templates.axis_R_object[matches.row]
        radius_px = settings.cluster_radius * camera.fx * self._part.diameter_m / distance_m
        step_rad, limit = np.radians(settings.pose_step_deg), settings.hypotheses_per_object
        clusters: list[FloatArray] = []
        for members in cluster(uv, radius_px, CLUSTERS_PER_OBJECT * settings.max_objects):
            kept = members[distinct(rotation[members], distance_m[members], step_rad, limit)]
            poses = [pose_on_ray(uv[k], camera, rotation[k], float(distance_m[k]), self._part.centre_m) for k in kept]
            clusters.append(np.array(poses))
        return clusters

    def _candidate(
        self, poses: FloatArray, known: _Candidate | None, evidence: _Evidence, models: _Models
    ) -> _Candidate:
        """Align and score poses (K, 4, 4), and merge them with those ``known`` of the same cluster."""
        if len(poses) == 0 and known is not None:
            return known
        edges = evidence.edges
        poses = models.contours.align(edges, self._camera, poses)
        look = models.appearance.look(poses)
        # both are 0..1: contours place the part exactly, appearance tells its ends and faces apart
        scores = 50 * (
            models.contours.agreement(edges, self._camera, poses) + explained_variance(look, evidence.smooth)
        )
        silhouettes = [uv[covered] for uv, covered in zip(look.uv, look.covered, strict=True)]
        if known is not None:
            poses, scores = np.concatenate([known.poses, poses]), np.concatenate([known.scores, scores])
            silhouettes = [*known.silhouettes_px, *silhouettes]
        order = np.argsort(-scores, kind="stable")
        fine_rad = np.radians(self._settings.pose_step_deg) / 3
        kept = order[distinct(poses[order, :3, :3], poses[order, 2, 3], fine_rad, len(order))]
        return _Candidate(poses[kept], scores[kept], tuple(silhouettes[k] for k in kept))

    def _free(self, candidates: list[_Candidate]) -> list[int]:
        """Return the positions of the candidates that score well and that no better one covers, best first."""
        order = sorted(range(len(candidates)), key=lambda index: -candidates[index].scores[0])
        good = [index for index in order if candidates[index].scores[0] >= self._settings.min_score]
        if not good:
            return []
        far_m = max(float(candidates[index].poses[0, 2, 3]) for index in good)
        cell_px = max(2.0, CELL * self._camera.fx * self._part.diameter_m / far_m)
        free = uncovered([candidates[index].silhouettes_px[0] for index in good], cell_px, self._settings.overlap)
        return [index for index, is_free in zip(good, free, strict=True) if is_free]


def _object(candidate: _Candidate, temperature: float) -> DetectedObject:
    probabilities = softmax(candidate.scores, temperature)
    return DetectedObject(
        tuple(
            Hypothesis(pose, float(score), float(probability))
            for pose, score, probability in zip(candidate.poses, candidate.scores, probabilities, strict=True)
        )
    )
