"""Refinement of hypotheses by depth: their poses, how well these are known, and how probable they are.

Every call looks at all views so far. Poses go on from where they are; probabilities start anew from the detector's, so
that no view counts twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from sidelong.detection.appearance import AppearanceModel
from sidelong.detection.clusters import softmax
from sidelong.detection.depth_likelihood import log_likelihood_ratio
from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.detection.registration import Cloud, Registered, Registration
from sidelong.errors import ImageError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.transforms import invert, transform_points, validated_transform
from sidelong.types import DetectedObject, FloatArray, Hypothesis, IntArray

MAX_TRIANGLES = 100_000
"""Finer meshes are simplified: nearest points take far longer on millions of triangles, and are no better."""
LEAST_SUPPORT = 6
"""Inliers a view needs to support an object: as many as a pose has unknowns."""
PIXELS_LOOKED_AT = 4
"""Measured pixels looked at for one that is kept: some lie around the part."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """One depth map and where it was taken from.

    Attributes
    ----------
    name
        Of the view.
    depth_m
        (H, W) along the optical axis, NaN where missing. It is kept, not copied.
    reference_T_camera
        (4, 4) left camera of this view in that of the reference view.
    """

    name: str
    depth_m: FloatArray
    reference_T_camera: FloatArray


class Refiner:
    """Refines the hypotheses of one scan.

    Parameters
    ----------
    part
        What was detected.
    camera
        The left camera of all views.
    settings
        How.
    """

    def __init__(self, part: Part, camera: PinholeCamera, settings: RefinementSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._part = simplified(part, MAX_TRIANGLES)
        self._symmetry = part.symmetry
        self._registration = Registration(self._part, settings)
        self._appearance = AppearanceModel(self._part, camera)
        self._views: list[DepthView] = []
        # the detector's log-probability of hypotheses that left this refiner; others still have it as their own
        self._log_prior: WeakKeyDictionary[Hypothesis, float] = WeakKeyDictionary()

    def add(self, view: DepthView) -> None:
        """Take in the depth of one more view; the reference view comes first.

        Raises
        ------
        ImageError
            The depth map is not of the camera's size.
        PoseError
            ``reference_T_camera`` is not a rigid motion.
        """
        wanted = self._camera.height, self._camera.width
        if view.depth_m.shape != wanted:
            raise ImageError(f"view {view.name}: the depth map is {view.depth_m.shape} px, the camera {wanted} px")
        pose = validated_transform(view.reference_T_camera, f"view {view.name}: reference_T_camera")
        self._views.append(replace(view, reference_T_camera=pose))

    def refine(self, objects: tuple[DetectedObject, ...]) -> tuple[DetectedObject, ...]:
        """Return the objects with poses and probabilities that agree with the depth of all views.

        An object that no view measured comes back as it is, and each keeps at least one hypothesis.
        """
        return tuple(self._refined(each) for each in objects) if self._views else objects

    def _refined(self, detected: DetectedObject) -> DetectedObject:
        hypotheses = detected.hypotheses
        if not hypotheses:
            return detected
        poses = np.stack([validated_transform(each.camera_T_object, "hypothesis") for each in hypotheses])
        log_prior = np.array([self._log_prior.get(each, _log(each.probability)) for each in hypotheses])
        cloud = self._cloud_around(poses)
        approached = self._registration.approach(poses, cloud)
        groups = self._alike(approached, log_prior)
        leaders: list[int] = [group[0] for group in groups]
        found = self._registration.settle(approached[leaders], cloud, len(self._views))
        log_prior = np.array([np.logaddexp.reduce(log_prior[group]) for group in groups])
        probability = softmax(log_prior + self._settings.tempering * self._log_likelihood(found.poses), 1.0)
        order = np.argsort(-probability, kind="stable").astype(np.intp)
        kept = order[probability[order] >= min(self._settings.least_probability, probability[order[0]])]
        chosen = [int(k) for k in kept]
        total = float(probability[kept].sum())
        refined = tuple(_updated(hypotheses[leaders[k]], found, k, float(probability[k]) / total) for k in chosen)
        self._log_prior.update(zip(refined, (float(log_prior[k]) for k in chosen), strict=True))
        support = found.determined[order[0]] & (found.inliers[order[0]] >= LEAST_SUPPORT)
        names = tuple(view.name for view, supports in zip(self._views, support, strict=True) if supports)
        return replace(detected, hypotheses=refined, supporting_views=names)

    def _alike(self, poses: FloatArray, log_prior: FloatArray) -> list[list[int]]:
        """Gather poses (K, 4, 4) that have become one, modulo the symmetry; the most probable leads its group."""
        s = self._settings
        centres = poses[:, :3, :3] @ self._symmetry.centre_m + poses[:, :3, 3]
        left = np.argsort(-log_prior, kind="stable")
        groups: list[list[int]] = []
        while left.size:
            turn_rad = self._symmetry.angle_rad(poses[left, :3, :3], poses[left[0], :3, :3])
            shift_m = np.linalg.norm(centres[left] - centres[left[0]], axis=1)
            alike = (turn_rad < np.deg2rad(s.same_turn_deg)) & (shift_m < s.same_shift * self._part.diameter_m)
            alike[0] = True
            groups.append(left[alike].tolist())
            left = left[~alike]
        return groups

    def _log_likelihood(self, poses: FloatArray) -> FloatArray:
        """Return the log-likelihood (K,) of the depth of all views for poses (K, 4, 4)."""
        total = np.zeros(len(poses))
        for view in self._views:
            camera_T_object = invert(view.reference_T_camera) @ poses
            centre_z = camera_T_object[:, 2, :3] @ self._part.centre_m + camera_T_object[:, 2, 3]
            seen = np.flatnonzero(centre_z > self._part.diameter_m / 2)
            if seen.size:
                look = self._appearance.look(camera_T_object[seen])
                total[seen] += log_likelihood_ratio(look, view.depth_m, self._part.diameter_m, self._settings)
        return total

    def _cloud_around(self, poses: FloatArray) -> Cloud:
        """Return the points of all views near any of the poses (K, 4, 4), each view giving the same number at most."""
        rng = np.random.default_rng(0)
        centres = poses[:, :3, :3] @ self._part.centre_m + poses[:, :3, 3]
        limit = max(1, self._settings.object_points // len(self._views))
        clouds = [self._points_of(view, centres, limit, rng) for view in self._views]
        points = np.concatenate([each[0] for each in clouds])
        index = np.repeat(np.arange(len(clouds)), [len(each[0]) for each in clouds])
        origins = np.stack([view.reference_T_camera[:3, 3] for view in self._views])
        towards = origins[index] - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cells = np.concatenate([each[1] for each in clouds]) + index * self._camera.width * self._camera.height
        order = rng.permutation(len(points))
        return Cloud(points[order], towards[order], index[order], cells[order])

    def _points_of(
        self, view: DepthView, centres: FloatArray, limit: int, rng: np.random.Generator
    ) -> tuple[FloatArray, IntArray]:
        """Return at most ``limit`` points (N, 3) of a view near centres (K, 3), and the cells (N,) they lie in."""
        radius_m = self._part.diameter_m / 2 + self._registration.reach_m
        rows, columns = self._window(transform_points(invert(view.reference_T_camera), centres), radius_m)
        depth_m = view.depth_m[rows, columns]
        row, column = np.nonzero(np.isfinite(depth_m) & (depth_m > 0))
        chosen = rng.permutation(len(row))[: PIXELS_LOOKED_AT * limit]
        row, column = row[chosen], column[chosen]
        z = depth_m[row, column]
        row, column = row + rows.start, column + columns.start
        points = transform_points(view.reference_T_camera, self._camera.rays(column, row) * z[:, None])
        distance2 = (points**2).sum(axis=1, keepdims=True) - 2 * points @ centres.T + (centres**2).sum(axis=1)
        near = np.flatnonzero((distance2 < radius_m**2).any(axis=1))[:limit]
        cell_row, cell_column = (np.floor_divide(each[near], self._settings.correlation_px) for each in (row, column))
        return points[near], (cell_row * self._camera.width + cell_column).astype(np.intp)

    def _window(self, centres_camera: FloatArray, radius_m: float) -> tuple[slice, slice]:
        """Return rows and columns of the image that hold the balls around centres (K, 3) that lie before the camera."""
        camera = self._camera
        centres = centres_camera[centres_camera[:, 2] > radius_m]
        if not len(centres):
            return slice(0, 0), slice(0, 0)
        x, y, z = centres.T
        # a point of the ball is off the centre's ray by at most radius (1 + |slope|), at the nearest depth
        half = radius_m / (z - radius_m) * np.array([camera.fx * (1 + np.abs(x / z)), camera.fy * (1 + np.abs(y / z))])
        uv = camera.project(centres).T
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor((uv - half).min(axis=1)), 0, size).astype(int)
        high = np.clip(np.ceil((uv + half).max(axis=1)) + 1, 0, size).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])


def _updated(hypothesis: Hypothesis, found: Registered, index: int, probability: float) -> Hypothesis:
    """Return a hypothesis as registration (item ``index``) left it."""
    covariance = found.covariance[index] if found.determined[index] else hypothesis.covariance
    return Hypothesis(found.poses[index], hypothesis.score, probability, covariance)


def _log(probability: float) -> float:
    return float(np.log(max(probability, 1e-300)))
