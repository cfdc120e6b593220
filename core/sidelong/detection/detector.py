"""Detection of a part in one grey image: template matching, clustering, verification, hypotheses."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType

import numpy as np

from sidelong.detection.depth_evidence import DistanceBounds
from sidelong.detection.emptiness import is_empty
from sidelong.detection.half_turns import half_turns
from sidelong.detection.matcher_process import MatcherProcess
from sidelong.detection.objects import ObjectBuilder
from sidelong.detection.plausibility import probability
from sidelong.detection.proposals import Starts, propose
from sidelong.detection.report import DetectionReport, NothingFound
from sidelong.detection.search_region import resized, search_region, searched_image
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.template_cache import load_or_train
from sidelong.detection.templates import Progress, TemplateSet
from sidelong.detection.verification import Evidence, Verified, Verifier
from sidelong.errors import ImageError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import BoolArray, DetectedObject, FloatArray, GrayImage, IntArray

PROMISING_PER_OBJECT = 2
"""Clusters that are aligned, most promising first: so many more than objects."""
FIRST_POSES, MORE_POSES = 3, 18
"""Of a cluster; only where one of the first may be right are more looked at."""
HOPEFUL = 0.3
"""Share of ``min_score`` that one of the first poses needs."""


@dataclass(frozen=True, eq=False)
class _Models:
    """What ``prepare`` makes."""

    templates: TemplateSet
    matcher: MatcherProcess
    verifier: Verifier
    builder: ObjectBuilder


class TemplateDetector:
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

    def __enter__(self) -> TemplateDetector:
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

    def detect(
        self, image: GrayImage, depth_m: FloatArray | None = None, mask: BoolArray | None = None
    ) -> tuple[DetectedObject, ...]:
        """Find the part in an image.

        Parameters
        ----------
        image
            (H, W) 8-bit grey.
        depth_m
            (H, W) what was measured from the same place, NaN where missing: it bounds the distances.
        mask
            (H, W) where parts can be, for example inside the bin; beside ``region_px`` of the settings.

        Returns
        -------
        tuple of DetectedObject
            Best first, each with its hypotheses; () where there is none: ``last_report`` says why.

        Raises
        ------
        ImageError
            Not an 8-bit grey image, a depth map or a mask of the camera's size.
        SettingsError
            There are no templates for the distances that were measured, or ``region_px`` lies outside the image.
        MatcherDiedError
            The child process died or missed its deadline; the next call starts another one.
        """
        self._check(image, depth_m)
        region = search_region(self._camera, self._settings, mask)
        models = self._prepared()
        started = time.monotonic()
        searched = searched_image(image, self._camera, models.templates.focal_px)
        matches = models.matcher.match(searched, None if region is None else resized(region, searched.shape))
        matched = time.monotonic()
        bounds = DistanceBounds(depth_m, self._settings.reach_m, self._part.diameter_m)
        bounds.check()
        clusters = propose(matches, models.templates, bounds, self._settings, (self._part, self._camera))
        objects = models.builder.build(self._verified(clusters, Evidence(image, depth_m), models))
        self.last_report = DetectionReport(
            matches.total, len(matches.row), len(clusters), matched - started, time.monotonic() - matched,
            None if objects else self._why_none(image, depth_m, clusters),
        )  # fmt: skip
        return objects

    def _why_none(self, image: GrayImage, depth_m: FloatArray | None, clusters: list[Starts]) -> NothingFound:
        distance_m = float(np.sqrt(np.prod(self._settings.reach_m)))
        if is_empty(image, depth_m, self._camera, self._part.diameter_m, distance_m):
            return NothingFound.EMPTY_SCENE
        return NothingFound.NONE_VERIFIED if clusters else NothingFound.NO_MATCH

    def _verified(self, clusters: list[Starts], evidence: Evidence, models: _Models) -> Verified:
        """Verify a few promising poses of each cluster, more of them where one may be right, and what looks alike."""
        starts, promise = models.verifier.glance(Starts.joined(clusters), evidence)
        ends = np.cumsum([0, *(len(each.poses) for each in clusters)]).tolist()
        ranked = [first + np.argsort(-promise[first:last], kind="stable") for first, last in pairwise(ends)]
        ranked.sort(key=lambda order: -promise[order[0]])
        ranked = ranked[: PROMISING_PER_OBJECT * self._settings.max_objects]
        firsts = [order[:FIRST_POSES] for order in ranked]
        found = models.verifier.verify(starts[_joined(firsts)], evidence)
        owner = np.repeat(np.arange(len(firsts)), [len(order) for order in firsts])
        best = np.full(len(firsts), -np.inf)
        np.maximum.at(best, owner, found.log_odds)
        hopeful = probability(best) >= HOPEFUL * self._settings.min_score / 100
        rest = _joined([order[FIRST_POSES:MORE_POSES] for order, hope in zip(ranked, hopeful, strict=True) if hope])
        found = Verified.joined([found, models.verifier.verify(starts[rest], evidence)])
        turned = self._turned(found[models.builder.seeds(found)])
        return Verified.joined([found, models.verifier.verify(turned, evidence)])

    def _turned(self, found: Verified) -> Starts:
        """Return poses turned half round the part's principal axes: silhouettes hardly tell these apart."""
        turns = half_turns(self._part)
        poses = (found.poses[:, None] @ turns).reshape(-1, 4, 4)
        distance_m = (poses[:, :3, :3] @ self._part.centre_m + poses[:, :3, 3])[:, 2]
        return Starts(poses, distance_m[:, None] * [0.95, 1.05])

    def _prepared(self, progress: Progress | None = None) -> _Models:
        if self._models is None:
            templates = load_or_train(self._part, self._camera, self._settings, self._cache_dir, progress)
            self._models = _Models(
                templates,
                MatcherProcess(templates, self._settings),
                Verifier(self._part, self._camera, self._settings),
                ObjectBuilder(self._part, self._camera, self._settings),
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


def _joined(parts: list[IntArray]) -> IntArray:
    return np.concatenate([np.zeros(0, dtype=np.intp), *parts])
