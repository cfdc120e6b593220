"""The information gain of a candidate view: equations (12) and (13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.raycast import SURFACE_OFFSET_M, RayScene
from sidelong.geometry.transforms import invert, transform_points
from sidelong.planning.prediction import Prediction
from sidelong.planning.prior import Belief
from sidelong.planning.shading import LightModel, Surface, radiance_towards
from sidelong.types import BoolArray, FloatArray, Forecast, IntArray, Score, View

OCCLUDER_TRIANGLES = 3000
REASONS = ("outside", "hidden", "shadow", "dark", "saturated")
OUTSIDE, HIDDEN, SHADOW, DARK, SATURATED = range(len(REASONS))


@dataclass(frozen=True, eq=False)
class Outlook:
    """What one view promises for each point.

    Attributes
    ----------
    probability
        (N,) of depth.
    loss
        (N,) position in ``REASONS`` of what takes the rest of the probability: ``DARK`` and ``SATURATED`` where
        cameras and projector reach the point, the others where they do not.
    """

    probability: FloatArray
    loss: IntArray


class Planner:
    """Scores candidate views against a belief.

    Probabilities of a view do not depend on what is still missing, so they are computed once per view; after each
    capture only the sum over the missing pixels is taken again.

    Parameters
    ----------
    belief
        Hypotheses on the missing pixels.
    part
        CAD model.
    rig
        Cameras and projector.
    light
        Reflectance, light, sensor.
    """

    def __init__(self, belief: Belief, part: Part, rig: StereoRig, light: LightModel) -> None:
        self._rig, self._light = rig, light
        sizes = [len(prior.pixels) for prior in belief.priors]
        self._prior_of_point = np.repeat(np.arange(len(sizes)), sizes)
        self._surface = Surface(
            _stack([p.points_base for p in belief.priors], 3),
            _stack([p.normals_base for p in belief.priors], 3),
            np.concatenate([np.zeros(0, np.intp), *(p.material for p in belief.priors)]),
        )
        self._pixels = np.concatenate([np.zeros((0, 2), np.intp), *(p.pixels for p in belief.priors)])
        self._object = np.repeat([p.object_index for p in belief.priors], sizes).astype(np.intp)
        self._weight = np.repeat([p.probability * p.weight for p in belief.priors], sizes).astype(np.float64)
        # visibility rays start a little above the surface
        self._starts = self._surface.points + SURFACE_OFFSET_M * self._surface.normals
        self._object_T_base = invert(np.array([p.base_T_object for p in belief.priors]).reshape(-1, 4, 4))
        self._starts_object = _stack(
            [
                transform_points(self._object_T_base[k], self._starts[self._prior_of_point == k])
                for k in range(len(sizes))
            ],
            3,
        )
        coarse = simplified(part, OCCLUDER_TRIANGLES) if light.shadows != "none" else part
        self._alone = RayScene([(coarse, np.eye(4))] if light.shadows != "none" else [])
        self._together = RayScene([(coarse, pose) for pose in belief.base_T_objects] if light.shadows == "all" else [])
        self._outlooks: dict[str, Outlook] = {}

    def score(self, view: View, missing: BoolArray) -> Score:
        """Return G_i of one view over the pixels still missing, equation (13), and what is lost to what.

        Gain and losses add up to the hypotheses' share of the missing pixels.

        Parameters
        ----------
        view
            Candidate.
        missing
            (H, W) pixels of the reference view that have no depth yet.
        """
        outlook = self._outlook_of(view)
        weight = np.where(missing[self._pixels[:, 0], self._pixels[:, 1]], self._weight, 0.0)
        lost = np.bincount(outlook.loss, weights=weight * (1.0 - outlook.probability), minlength=len(REASONS))
        return Score(
            view=view,
            gain_px=float(weight @ outlook.probability),
            lost_px={reason: float(lost[code]) for code, reason in enumerate(REASONS)},
        )

    def forecast(self, view: View, missing: BoolArray, still_missing: BoolArray) -> Forecast:
        """Set what a view promised beside what it gave.

        Parameters
        ----------
        view
            A view that was taken; scored before, it costs no more than a look-up.
        missing, still_missing
            (H, W) pixels of the reference view that had no depth before the view, and after it.
        """
        rows, columns = self._pixels[:, 0], self._pixels[:, 1]
        chosen = missing[rows, columns]
        return Forecast(
            probability=self._outlook_of(view).probability[chosen],
            weight=self._weight[chosen],
            measured=~still_missing[rows, columns][chosen],
        )

    def predict(self, view: View) -> Prediction:
        """Return what a view should show of every point of the belief, whether it promises depth or not."""
        everything = np.arange(len(self._surface))
        exposure = self._exposure(view, everything)
        chosen = np.flatnonzero(self._inside(view) & (self._turned_away(view, everything) < 0))
        chosen = chosen[self._blocked_by(view, chosen) < 0]
        reached = np.zeros(len(self._surface), dtype=np.bool_)
        reached[chosen] = True
        in_left = transform_points(invert(view.base_T_camera), self._surface.points)
        uv = self._rig.left.project(in_left)
        shown = self._rig.left.contains(uv)
        seen_at = np.where(shown[:, None], np.rint(np.where(shown[:, None], uv, 0.0))[:, ::-1], -1.0).astype(np.intp)
        return Prediction(
            pixels=self._pixels,
            weight=self._weight,
            exposure=exposure,
            reached=reached,
            probability=np.where(reached, self._light.kind.probability(exposure), 0.0),
            seen_at=seen_at,
            depth_m=in_left[:, 2],
        )

    def left_radiance(self, view: View) -> tuple[IntArray, FloatArray]:
        """Return what the left camera should receive from the points that it and the projector reach.

        Returns
        -------
        pixels
            (M, 2) of the points, in the image the belief was made for.
        radiance
            (M,) E of equation (5), in units of the sensor's saturation exposure per second.
        """
        (left, *_), base_T_projector = self._poses(view)
        chosen = np.flatnonzero(self._inside(view))
        for target in (left, base_T_projector[:3, 3]):
            chosen = chosen[~self._blocked(chosen, target)]
        e = radiance_towards((left,), base_T_projector, self._surface[chosen], self._light)
        return self._pixels[chosen], e[:, 0]

    def _outlook_of(self, view: View) -> Outlook:
        """Predict what the view would measure, once: h of equation (12) for each point."""
        if view.name not in self._outlooks:
            self._outlooks[view.name] = self._outlook(view)
        return self._outlooks[view.name]

    def _outlook(self, view: View) -> Outlook:
        loss = np.full(len(self._surface), OUTSIDE, dtype=np.intp)
        probability = np.zeros(len(self._surface))
        inside = np.flatnonzero(self._inside(view))
        exposure = self._exposure(view, inside)
        p = self._light.kind.probability(exposure)
        away = self._turned_away(view, inside)
        loss[inside] = np.where(away >= 0, away, np.where((exposure >= 1.0).any(axis=1), SATURATED, DARK))
        # rays cost far more than shading: only points that would be measured need them
        bright = (p > 0) & (away < 0)
        survivors, p = inside[bright], p[bright]
        blocked = self._blocked_by(view, survivors)
        loss[survivors] = np.where(blocked >= 0, blocked, loss[survivors])
        probability[survivors] = np.where(blocked >= 0, 0.0, p)
        return Outlook(probability, loss)

    def _poses(self, view: View) -> tuple[tuple[FloatArray, ...], FloatArray]:
        """Return the centres (3,) of the cameras that must see a point, and ``base_T_projector`` (4, 4)."""
        base_T_left, rig = view.base_T_camera, self._rig
        left, right = base_T_left[:3, 3], (base_T_left @ rig.left_T_right)[:3, 3]
        return (left, right) if self._light.sensing.stereo else (left,), base_T_left @ rig.projector.left_T_projector

    def _inside(self, view: View) -> BoolArray:
        """Say which points fall into the images and the projector's cone."""
        rig = self._rig
        in_left = transform_points(invert(view.base_T_camera), self._surface.points)
        in_right = transform_points(invert(rig.left_T_right), in_left)
        in_projector = transform_points(invert(rig.projector.left_T_projector), in_left)
        inside = rig.left.contains(rig.left.project(in_left)) & rig.projector.lights(in_projector)
        if self._light.sensing.stereo:
            inside &= rig.right.contains(rig.right.project(in_right))
        return inside

    def _exposure(self, view: View, chosen: IntArray) -> FloatArray:
        """Return what each camera receives from the chosen points (N, C), in units of the saturation exposure."""
        cameras, base_T_projector = self._poses(view)
        e = radiance_towards(cameras, base_T_projector, self._surface[chosen], self._light)
        return e * (self._light.exposure_s / self._light.response.saturation_exposure)

    def _turned_away(self, view: View, chosen: IntArray) -> IntArray:
        """Return (N,) HIDDEN where a chosen point faces away from a camera, SHADOW from the projector, else -1."""
        cameras, base_T_projector = self._poses(view)
        points, normals = self._surface.points[chosen], self._surface.normals[chosen]

        def behind(target: FloatArray) -> BoolArray:
            return np.einsum("ij,ij->i", normals, target - points) <= 0

        hidden = np.any([behind(camera) for camera in cameras], axis=0)
        return np.where(hidden, HIDDEN, np.where(behind(base_T_projector[:3, 3]), SHADOW, -1))

    def _blocked_by(self, view: View, chosen: IntArray) -> IntArray:
        """Return (N,) HIDDEN where a part hides a chosen point from a camera, SHADOW from the projector, else -1."""
        cameras, base_T_projector = self._poses(view)
        reason = np.full(len(chosen), -1, dtype=np.intp)
        left = np.arange(len(chosen))
        for target, code in (*((camera, HIDDEN) for camera in cameras), (base_T_projector[:3, 3], SHADOW)):
            blocked = self._blocked(chosen[left], target)
            reason[left[blocked]] = code
            left = left[~blocked]
        return reason

    def _blocked(self, chosen: IntArray, target: FloatArray) -> BoolArray:
        """Say which chosen points a part hides from ``target`` (3,): their own, or another one."""
        # the own part stands where this hypothesis says: rays move into its frame, so that one ray scene serves all
        target_object = (self._object_T_base @ np.append(target, 1.0))[:, :3]
        blocked = self._alone.blocked(self._starts_object[chosen], target_object[self._prior_of_point[chosen]])
        hits = self._together.cast(self._starts[chosen], target - self._starts[chosen])
        return blocked | ((hits.distance < 1.0) & (hits.instance != self._object[chosen]))


def _stack(arrays: Sequence[FloatArray], columns: int) -> FloatArray:
    """Concatenate (N_i, columns); none gives (0, columns)."""
    return np.concatenate([np.zeros((0, columns)), *arrays])
