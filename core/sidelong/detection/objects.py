"""From verified poses to objects: which are about the same object, which of them to keep, how much of it is seen."""

from __future__ import annotations

import numpy as np

from sidelong.detection.clusters import distinct, softmax
from sidelong.detection.plausibility import probability
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.verification import Verified
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.raycast import RayScene
from sidelong.types import DetectedObject, FloatArray, Hypothesis

SAME_PLACE = 0.25
"""Poses whose centres lie nearer to each other than this, sideways, are about the same object; in diameters."""
CELL = 0.05
"""Size of the cells on which silhouettes are compared, in diameters of the part."""
OVERLAP_COST = 4.0
"""Log-odds that a silhouette loses which a better object covers: the edges and grey values there are that object's."""
LIKE_DEPTH = 0.2
"""Surfaces of known depth that differ by more are two, in diameters: of parts that lie across each other both exist."""
KNOWN = 0.3
"""Share of what was measured on a pose that must lie on its surface for its depth to be known."""
COARSE_TRIANGLES = 1000
IN_FRONT = 0.02
"""How far before an object another surface must lie to hide it, in diameters: meshes and poses are not exact."""

Cells = dict[tuple[int, int], float]
"""Depth by cell of the image, metres."""


class ObjectBuilder:
    """Makes objects of verified poses of one part in images of one camera."""

    def __init__(self, part: Part, camera: PinholeCamera, settings: DetectionSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._symmetry = part.symmetry
        self._centre_m = part.centre_m
        self._diameter_m = part.diameter_m
        self._coarse = simplified(part, COARSE_TRIANGLES)

    def seeds(self, found: Verified) -> list[int]:
        """Return which of K poses are objects, best first.

        Taken first is what probably explains most pixels: edges and grey values of a part make slivers of it probable
        too. Poses at the place of one that was taken are none; what a pose has in common with another speaks less for
        it.
        """
        settings, uv, reach_px = self._settings, *self._places(found)
        cell_px = max(2.0, CELL / SAME_PLACE * float(reach_px.min(initial=np.inf)))
        seeds: list[int] = []
        taken: list[Cells] = []
        probable = probability(found.log_odds) >= settings.min_score / 100
        explained = probability(found.log_odds) * np.array([len(surface) for surface in found.silhouettes])
        order: list[int] = np.argsort(-explained, kind="stable").tolist()
        for k in order:
            if len(seeds) == settings.max_objects:
                break
            if not probable[k] or (np.linalg.norm(uv[seeds] - uv[k], axis=1) <= reach_px[seeds]).any():
                continue
            cells = occupied(found.silhouettes[k], cell_px)
            like_m = np.where(found.fits[[k, *seeds]] >= KNOWN, LIKE_DEPTH * self._diameter_m, np.inf)
            limits_m = np.maximum(like_m[0], like_m[1:]).tolist()
            overlaps = (shared(cells, *each) for each in zip(taken, limits_m, strict=True))
            overlap = max(overlaps, default=0.0) if cells else 1.0
            still = probability(found.log_odds[k] - OVERLAP_COST * overlap)
            if overlap <= settings.overlap and still >= settings.min_score / 100:
                seeds.append(k)
                taken.append(cells)
        return sorted(seeds, key=lambda k: -found.log_odds[k])

    def build(self, found: Verified) -> tuple[DetectedObject, ...]:
        """Return the objects, best first, each with its best distinct hypotheses."""
        seeds = self.seeds(found)
        uv, reach_px = self._places(found)
        apart = np.linalg.norm(uv[:, None] - uv[seeds], axis=-1)
        owner = np.where((apart <= reach_px[seeds]).any(axis=1), apart.argmin(axis=1), -1) if seeds else None
        visible = self.visible_fractions(found[seeds])
        return tuple(
            DetectedObject(self._hypotheses(found[np.flatnonzero(owner == k).tolist()]), visible_fraction=visible[k])
            for k in range(len(seeds))
        )

    def _hypotheses(self, found: Verified) -> tuple[Hypothesis, ...]:
        """Return the best of each group of like poses, with probabilities."""
        settings = self._settings
        order = np.argsort(-found.log_odds, kind="stable")
        poses = found.poses[order]
        step_rad = np.radians(settings.pose_step_deg)
        most = settings.hypotheses_per_object
        first = distinct(poses[:, :3, :3], poses[:, 2, 3], step_rad, most, self._symmetry)
        kept = order[first]
        share = softmax(found.log_odds[kept], settings.temperature)
        share = np.where(share >= settings.least_probability, share, 0.0)
        share /= share.sum()
        scores = 100 * probability(found.log_odds[kept])
        return tuple(
            Hypothesis(pose, float(score), float(p))
            for pose, score, p in zip(found.poses[kept], scores, share, strict=True)
            if p > 0
        )

    def _places(self, found: Verified) -> tuple[FloatArray, FloatArray]:
        """Return the projected centres (K, 2), and how far around (K,) poses are about the same object, pixels."""
        centre = found.poses[:, :3, :3] @ self._centre_m + found.poses[:, :3, 3]
        return self._camera.project(centre), SAME_PLACE * self._camera.fx * self._diameter_m / centre[:, 2]

    def visible_fractions(self, found: Verified) -> list[float]:
        """Return the share of each silhouette that none of the other poses hides."""
        scene = RayScene([(self._coarse, pose) for pose in found.poses])
        shares: list[float] = []
        for surface in found.silhouettes:
            rays = self._camera.rays(surface[:, 0], surface[:, 1])
            nearest_m = scene.cast(np.zeros(3), rays).distance
            shares.append(float(np.mean(nearest_m > surface[:, 2] - IN_FRONT * self._diameter_m)))
        return shares


def occupied(surface: FloatArray, cell_px: float) -> Cells:
    """Return the cells of the image that pixels with their depth (Q, 3) lie in, and the depth in each."""
    places = np.floor(surface[:, :2] / cell_px).astype(np.int64)
    return {(u, v): depth_m for (u, v), depth_m in zip(places.tolist(), surface[:, 2].tolist(), strict=True)}


def shared(cells: Cells, other: Cells, like_m: float) -> float:
    """Return where two surfaces, neither empty, lie within ``like_m``, as a share of the smaller one."""
    common = cells.keys() & other.keys()
    return sum(abs(cells[each] - other[each]) < like_m for each in common) / min(len(cells), len(other))
