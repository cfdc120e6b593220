"""The information gain of a candidate view: equations (12) and (13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.raycast import SURFACE_OFFSET_M, RayScene
from sidelong.geometry.transforms import invert, transform_points
from sidelong.physics.reflectance import Phong, fall_off, incident_light, radiance
from sidelong.physics.response import Response
from sidelong.physics.sensing import SensingSettings, both_cameras, sensing_probability
from sidelong.planning.prior import Belief
from sidelong.types import BoolArray, FloatArray, IntArray, Score, View

OCCLUDER_TRIANGLES = 3000
REASONS = ("outside", "hidden", "shadow", "dark", "saturated")
MEASURED = len(REASONS)
"""Code of a point that the view is expected to measure; smaller codes index ``REASONS``."""


@dataclass(frozen=True)
class LightModel:
    """Everything that turns geometry into the probability of depth.

    Attributes
    ----------
    reflectances
        By material index of the part.
    intensity
        Of the projector, at 1 m.
    fall_off
        Whether light falls with the squared distance; else it is the intensity at 1 m everywhere (the paper).
    shadows
        "none", "self" or "all": what may stand in the way of a ray.
    exposure_s
        Of the depth capture.
    response, sensing
        Sensor.
    """

    reflectances: tuple[Phong, ...]
    intensity: float
    fall_off: bool
    shadows: str
    exposure_s: float
    response: Response
    sensing: SensingSettings


@dataclass(frozen=True, eq=False)
class Outlook:
    """What one view promises for each point: probability of depth (N,) and code (N,), see ``REASONS``."""

    probability: FloatArray
    code: IntArray


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
        self._priors = belief.priors
        sizes = [len(prior.pixels) for prior in belief.priors]
        self._prior_of_point = np.repeat(np.arange(len(sizes)), sizes)
        self._points = _stack([p.points_base for p in belief.priors], 3)
        self._normals = _stack([p.normals_base for p in belief.priors], 3)
        self._pixels = np.concatenate([np.zeros((0, 2), np.intp), *(p.pixels for p in belief.priors)])
        self._material = np.concatenate([np.zeros(0, np.intp), *(p.material for p in belief.priors)])
        self._object = np.repeat([p.object_index for p in belief.priors], sizes).astype(np.intp)
        self._weight = np.repeat([p.probability * p.weight for p in belief.priors], sizes).astype(np.float64)
        # visibility rays start a little above the surface
        self._starts = self._points + SURFACE_OFFSET_M * self._normals
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

        Parameters
        ----------
        view
            Candidate.
        missing
            (H, W) pixels of the reference view that have no depth yet.
        """
        if view.name not in self._outlooks:
            self._outlooks[view.name] = self._outlook(view)
        outlook = self._outlooks[view.name]
        weight = np.where(missing[self._pixels[:, 0], self._pixels[:, 1]], self._weight, 0.0)
        lost = np.bincount(outlook.code, weights=weight, minlength=MEASURED + 1)
        return Score(
            view=view,
            gain_px=float(weight @ outlook.probability),
            lost_px={reason: float(lost[code]) for code, reason in enumerate(REASONS)},
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
        left, _, projector = self._centres(view.base_T_camera)
        chosen = np.flatnonzero(self._inside(view.base_T_camera))
        for target in (left, projector):
            chosen = chosen[~self._blocked(chosen, target)]
        to_left, to_light = _unit(left - self._points[chosen]), _unit(projector - self._points[chosen])
        power = self._incident(projector, chosen)
        return self._pixels[chosen], self._radiance(power, (to_light, to_left), chosen)

    def _outlook(self, view: View) -> Outlook:
        """Predict what the view would measure: h of equation (12) for each point."""
        centres = self._centres(view.base_T_camera)
        code = np.full(len(self._points), MEASURED, dtype=np.intp)
        _mark(code, ~self._inside(view.base_T_camera), "outside")
        probability = np.zeros(len(self._points))
        rest = np.flatnonzero(code == MEASURED)
        p, saturated, away = self._shade(centres, rest)
        for reason, mask in (("saturated", saturated), ("dark", ~saturated & ~(p > 0)), *away):
            code[rest[mask]] = REASONS.index(reason)
        # rays cost far more than shading: only points that would be measured need them
        survivors = rest[code[rest] == MEASURED]
        for reason, targets in (("hidden", centres[:2]), ("shadow", centres[2:])):
            for target in targets:
                blocked = self._blocked(survivors, target)
                code[survivors[blocked]] = REASONS.index(reason)
                survivors = survivors[~blocked]
        probability[rest] = p
        probability[code != MEASURED] = 0.0
        return Outlook(probability, code)

    def _centres(self, base_T_left: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the centres of left camera, right camera and projector in the base frame, (3,) each."""
        rig = self._rig
        return (
            base_T_left[:3, 3],
            (base_T_left @ rig.left_T_right)[:3, 3],
            (base_T_left @ rig.projector.left_T_projector)[:3, 3],
        )

    def _inside(self, base_T_left: FloatArray) -> BoolArray:
        """Say which points fall into both images and the projector's cone."""
        rig = self._rig
        in_left = transform_points(invert(base_T_left), self._points)
        in_right = transform_points(invert(rig.left_T_right), in_left)
        in_projector = transform_points(invert(rig.projector.left_T_projector), in_left)
        inside = rig.left.contains(rig.left.project(in_left)) & rig.projector.lights(in_projector)
        if self._light.sensing.stereo:
            inside &= rig.right.contains(rig.right.project(in_right))
        return inside

    def _shade(self, centres: Sequence[FloatArray], chosen: IntArray):
        """Return P, whether an image saturates, and masks of points that face away, for the chosen points."""
        points, normals = self._points[chosen], self._normals[chosen]
        to_left, to_right, to_light = (_unit(centre - points) for centre in centres)
        light = self._light
        power = self._incident(centres[2], chosen)
        seen = [to_left, to_right] if light.sensing.stereo else [to_left]
        saturated = np.zeros(len(points), dtype=np.bool_)
        probabilities: list[FloatArray] = []
        for to_camera in seen:
            e = self._radiance(power, (to_light, to_camera), chosen)
            clipped = light.response.saturated(e, light.exposure_s)
            z = light.response.intensity(e, light.exposure_s)
            probabilities.append(sensing_probability(z, clipped, light.sensing))
            saturated |= clipped
        away = (
            ("shadow", np.einsum("ij,ij->i", normals, to_light) <= 0),
            ("hidden", np.any([np.einsum("ij,ij->i", normals, d) <= 0 for d in seen], axis=0)),
        )
        p = both_cameras(probabilities[0], probabilities[1]) if light.sensing.stereo else probabilities[0]
        return p, saturated, away

    def _incident(self, projector: FloatArray, chosen: IntArray) -> FloatArray:
        """Return L_in of equation (1) at the chosen points."""
        light = self._light
        if not light.fall_off:
            return incident_light(np.full(len(chosen), light.intensity))
        return incident_light(fall_off(light.intensity, np.linalg.norm(projector - self._points[chosen], axis=1)))

    def _radiance(self, power: FloatArray, directions: tuple[FloatArray, FloatArray], chosen: IntArray) -> FloatArray:
        """Return radiance, material by material."""
        e = np.zeros(len(chosen))
        for index, material in enumerate(self._light.reflectances):
            mine = self._material[chosen] == index
            e[mine] = radiance(
                power[mine], (directions[0][mine], directions[1][mine]), self._normals[chosen[mine]], material
            )
        return e

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


def _unit(vectors: FloatArray) -> FloatArray:
    """Scale (N, 3) to unit length; a zero vector stays zero and so returns no light."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def _mark(code: IntArray, mask: BoolArray, reason: str) -> None:
    code[mask] = REASONS.index(reason)
