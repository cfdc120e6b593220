"""How far an estimated pose is from the true one, by the definitions of the BOP benchmark.

ADD and ADI: Hinterstoisser et al., ACCV 2012; MSSD and MSPD: Hodan et al., "BOP Challenge 2020". All are of the
vertices of the CAD model, as there: a finely cut region weighs more than a coarse one in the two means, not in the two
maxima.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import fminbound
from scipy.spatial import ConvexHull, cKDTree

from sidelong.errors import PoseError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.point_sets import QHULL_POINTS
from sidelong.geometry.transforms import invert, rotation_about, transform, transform_points
from sidelong.types import FloatArray

MOST_POINTS = 20_000
"""Vertices the errors are of; of more, every so-manieth of the list, which so dense ones change by less than 1 %. The
neighbours of ADI are looked for among all."""
AXIS_STEP_RAD = float(np.deg2rad(5.0))
"""How finely a continuous axis is searched before the best turn is found between two steps."""
AXIS_TOLERANCE_RAD = 1e-5
VALLEYS = 3

Cost = Callable[[FloatArray], FloatArray]
"""Of true poses (M, 4, 4), (M,)."""


@dataclass(frozen=True)
class PoseDeviation:
    """How far one pose is from the truth.

    Attributes
    ----------
    add_m
        Mean distance of the vertices, each from itself.
    add_symmetric_m
        The same from the nearest of the true poses that the part's symmetry makes equivalent.
    adi_m
        Mean distance of the true vertices, each from the nearest estimated one (ADI, also called ADD-S).
    mssd_m
        Largest distance of the vertices, from the nearest equivalent true pose.
    mspd_px
        Largest distance of their images, from the nearest equivalent true pose; infinite where one lies behind the
        camera.
    rotation_rad
        Angle between the orientations, modulo the symmetry.
    translation_m
        Distance of the part's centre of symmetry, which no equivalent pose moves.
    """

    add_m: float
    add_symmetric_m: float
    adi_m: float
    mssd_m: float
    mspd_px: float
    rotation_rad: float
    translation_m: float


class PoseMetrics:
    """Errors of the poses of one part in one camera.

    Parameters
    ----------
    part
        Its vertices and its symmetry.
    camera
        For the error in the image.
    """

    def __init__(self, part: Part, camera: PinholeCamera) -> None:
        used = part.vertices_m[np.unique(part.triangles)]
        self.part = part
        self.camera = camera
        self._points = _thinned(used, MOST_POINTS)
        # the largest distance between two poses of a body is that of a corner of its hull
        candidates = _thinned(used, QHULL_POINTS)
        self._corners = _thinned(candidates[ConvexHull(candidates).vertices], MOST_POINTS)
        self._tree = cKDTree(used)

    def deviation(self, camera_T_estimate: FloatArray, camera_T_truth: FloatArray) -> PoseDeviation:
        """Return all errors of a pose (4, 4).

        Raises
        ------
        PoseError
            A pose has entries that are not finite.
        """
        for name, pose in (("estimated", camera_T_estimate), ("true", camera_T_truth)):
            if not np.isfinite(pose).all():
                raise PoseError(f"{name} pose of {self.part.name}: {int((~np.isfinite(pose)).sum())} of 16 not finite")
        symmetry = self.part.symmetry
        estimate, truth = camera_T_estimate, camera_T_truth
        pixels = self.camera.project(transform_points(estimate, self._points))

        def mspd_px(truths: FloatArray) -> FloatArray:
            apart = self.camera.project(_placed(truths, self._points)) - pixels
            return np.nan_to_num(np.linalg.norm(apart, axis=2).max(axis=1), nan=np.inf)

        moved = transform_points(estimate, symmetry.centre_m) - transform_points(truth, symmetry.centre_m)
        return PoseDeviation(
            add_m=float(self._mean_m(estimate, truth[None])[0]),
            add_symmetric_m=self._least(lambda truths: self._mean_m(estimate, truths), estimate, truth),
            adi_m=self._adi_m(estimate, truth),
            mssd_m=self._least(lambda truths: self._largest_m(estimate, truths), estimate, truth),
            mspd_px=self._least(mspd_px, estimate, truth),
            rotation_rad=float(symmetry.angle_rad(estimate[:3, :3], truth[:3, :3])),
            translation_m=float(np.linalg.norm(moved)),
        )

    def add_m(self, estimates: FloatArray, truths: FloatArray) -> FloatArray:
        """Return ADD (N, M) of poses (N, 4, 4) from true poses (M, 4, 4)."""
        return np.array([self._mean_m(estimate, truths) for estimate in estimates]).reshape(len(estimates), len(truths))

    def _mean_m(self, estimate: FloatArray, truths: FloatArray) -> FloatArray:
        return _distances_m(estimate, truths, self._points).mean(axis=1)

    def _largest_m(self, estimate: FloatArray, truths: FloatArray) -> FloatArray:
        return _distances_m(estimate, truths, self._corners).max(axis=1)

    def _adi_m(self, estimate: FloatArray, truth: FloatArray) -> float:
        # seen from the estimated object, so that one tree serves for all poses
        away_m, _index = self._tree.query(transform_points(invert(estimate) @ truth, self._points))
        return float(np.mean(away_m))

    def _least(self, cost: Cost, estimate: FloatArray, truth: FloatArray) -> float:
        """Return the least cost over the true poses that are equivalent.

        The first tried is the one turned most like the estimate, so a turn about a continuous axis costs nothing. About
        such an axis the cost of a maximum has more than one valley: the best few are searched between their neighbours,
        and the least found is at most 1e-3 of itself too large.
        """
        symmetry = self.part.symmetry
        nearest = symmetry.nearest(truth, to=estimate)
        if symmetry.ball:
            # of centred balls, no turn brings all points nearer than their centres are
            return float(cost(nearest[None])[0])
        equivalent = nearest @ symmetry.equivalent(AXIS_STEP_RAD)
        costs = cost(equivalent)
        axis, least = symmetry.axis, float(costs.min())
        if axis is None:
            return least

        def turned(angle_rad: float, pose: FloatArray) -> float:
            turn = rotation_about(axis, angle_rad)
            about = transform(turn, symmetry.centre_m - turn @ symmetry.centre_m)
            return float(cost((pose @ about)[None])[0])

        for pose in equivalent[np.argsort(costs, kind="stable")[:VALLEYS]]:
            angle_rad = fminbound(turned, -AXIS_STEP_RAD, AXIS_STEP_RAD, args=(pose,), xtol=AXIS_TOLERANCE_RAD)
            least = min(least, turned(float(angle_rad), pose))
        return least


def _thinned(points: FloatArray, most: int) -> FloatArray:
    return points[:: max(1, int(np.ceil(len(points) / most)))]


def _placed(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (M, P, 3) of a part at each of the poses (M, 4, 4)."""
    return points @ np.swapaxes(poses[:, :3, :3], -1, -2) + poses[:, None, :3, 3]


def _distances_m(estimate: FloatArray, truths: FloatArray, points: FloatArray) -> FloatArray:
    """Return how far points (P, 3) of the part are from themselves (M, P) between a pose and each of (M, 4, 4)."""
    # one pose in the frame of the other, less the identity: a small difference keeps its digits
    apart = invert(estimate) @ truths - np.eye(4)
    return np.linalg.norm(_placed(apart, points), axis=2)
