"""Templates of a part for Line2D: views of the viewsphere x turns in the image plane x distances.

A template shows the part on the optical axis of a camera with square pixels and focal length ``focal_px``. Each
(view, distance) is rendered once; turns in the plane rotate that picture, which is exact on the axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.shading import brightness
from sidelong.errors import DetectionError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import look_at, rotate, rotation_about, transform
from sidelong.types import FloatArray, GrayImage, IntArray

Progress: TypeAlias = Callable[[int, int], None]

PYRAMID = (4, 8)
"""Line2D's sampling steps T, fine and coarse level."""
LARGEST_UPSCALING = 2.0
MARGIN_PX = 12
"""Free border of a template picture: the blur, the Sobel and the coarse level must not see its edge."""
REFUSED_SHARES = (0.05, 0.2, 0.5)
"""Shares of the views that may offer too few features for a template, tried in turn: sheets have poor views."""
FEWER_FEATURES = (48, 32, 24, 16)


@dataclass(frozen=True, eq=False)
class TemplateSet:
    """Trained templates: their pictures' features in files of OpenCV, their poses here.

    Attributes
    ----------
    folder
        Holds one ``templates_<class>.yml.gz`` for each class.
    classes
        Class names in the order of ``class_index``; one class for each distance.
    focal_px
        Focal length of the matched image.
    num_features
        Features of each template.
    class_index, template_id
        (N,) what Line2D calls the template; ids count from 0 in each class, refused templates have none.
    axis_R_object
        (N, 3, 3) rotation from the object to a camera that looks straight at the part's centre.
    distance_m
        (N,) of the part's centre.
    centre_px
        (N, 2) the projected centre relative to the position Line2D reports.
    """

    folder: Path
    classes: tuple[str, ...]
    focal_px: float
    num_features: int
    class_index: IntArray
    template_id: IntArray
    axis_R_object: FloatArray
    distance_m: FloatArray
    centre_px: FloatArray

    def rows(self, class_index: IntArray, template_id: IntArray) -> IntArray:
        """Return the positions (M,) of the templates that Line2D names so."""
        stride = int(self.template_id.max()) + 1
        keys = self.class_index * stride + self.template_id
        order = np.argsort(keys)
        return order[np.searchsorted(keys[order], class_index * stride + template_id)]


def view_directions(step_deg: float) -> FloatArray:
    """Return unit vectors (V, 3) from the part to the camera, about ``step_deg`` apart, on rings of equal elevation."""
    rings = round(180.0 / step_deg)
    directions: list[tuple[float, float, float]] = []
    for ring in range(rings + 1):
        elevation = -np.pi / 2 + np.pi * ring / rings
        count = max(1, round(2 * np.pi * np.cos(elevation) / np.radians(step_deg)))
        # odd rings are turned by half a step: neighbours of neighbours are not aligned
        for azimuth in 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count:
            directions.append(
                (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
            )
    return np.array(directions)


def distances(settings: DetectionSettings) -> FloatArray:
    """Return the distances (D,) in metres: the middles of equal ratios that cover the range."""
    near, far = settings.reach_m
    count = max(1, int(np.ceil(np.log(far / near) / np.log(settings.distance_ratio) - 1e-9)))
    return near * (far / near) ** ((np.arange(count) + 0.5) / count)


def rolls_rad(settings: DetectionSettings) -> FloatArray:
    """Return the turns (R,) in the image plane, equal steps of at most ``roll_step_deg``."""
    count = int(np.ceil(360.0 / settings.roll_step_deg))
    return 2 * np.pi * np.arange(count) / count


def matched_focal_px(part: Part, camera: PinholeCamera, settings: DetectionSettings) -> float:
    """Return the focal length at which the part spans ``span_px`` at the middle (geometric mean) distance."""
    middle_m = float(np.sqrt(settings.reach_m[0] * settings.reach_m[1]))
    return min(settings.span_px * middle_m / part.diameter_m, LARGEST_UPSCALING * camera.fx)


def train(
    part: Part,
    camera: PinholeCamera,
    settings: DetectionSettings,
    folder: Path,
    progress: Progress | None = None,
) -> TemplateSet:
    """Render and train the templates of ``part`` and write them to ``folder``, which must exist.

    Parameters
    ----------
    part
        The CAD model.
    camera
        Of the images that will be searched.
    settings
        Grid of views, turns and distances.
    folder
        Receives one file for each distance.
    progress
        Called with (pictures done, pictures in all), a picture for each view and distance.

    Raises
    ------
    DetectionError
        The part offers too few edges for any template at this size.
    """
    focal_px = matched_focal_px(part, camera, settings)
    studio = _Studio(part, focal_px, settings)
    num_features = _features_that_fit(studio, settings)
    detector = new_detector(settings, num_features)
    rows: list[tuple[int, int, FloatArray, float, FloatArray]] = []
    all_distances, directions = distances(settings), view_directions(settings.view_step_deg)
    for index, distance_m in enumerate(all_distances):
        for done, direction in enumerate(directions):
            for picture, axis_R_object in studio.turned(direction, float(distance_m)):
                template_id, corner_px = _add(detector, picture, f"distance_{index}")
                if template_id >= 0:
                    centre_px = np.array(picture.shape[::-1]) / 2 - corner_px
                    rows.append((index, template_id, axis_R_object, float(distance_m), centre_px))
            if progress is not None:
                progress(index * len(directions) + done + 1, len(all_distances) * len(directions))
    detector.writeClasses(str(folder / "templates_%s.yml.gz"))
    return TemplateSet(
        folder=folder,
        classes=tuple(f"distance_{index}" for index in range(len(all_distances))),
        focal_px=focal_px,
        num_features=num_features,
        class_index=np.array([row[0] for row in rows], dtype=np.intp),
        template_id=np.array([row[1] for row in rows], dtype=np.intp),
        axis_R_object=np.array([row[2] for row in rows]),
        distance_m=np.array([row[3] for row in rows]),
        centre_px=np.array([row[4] for row in rows]),
    )


def new_detector(settings: DetectionSettings, num_features: int) -> Any:
    """Return an empty Line2D detector (``cv2.linemod``): colour gradients only."""
    import cv2

    contrib: Any = cv2  # its stubs leave linemod out
    linemod = contrib.linemod
    gradient = linemod.ColorGradient_create(settings.weak_threshold, num_features, settings.strong_threshold)
    return linemod.Detector([gradient], list(PYRAMID))


class _Studio:
    """Takes the pictures of one part; rays are moved into the object frame, so that one scene serves all views."""

    def __init__(self, part: Part, focal_px: float, settings: DetectionSettings) -> None:
        self.part = part
        self._focal_px = focal_px
        self._settings = settings
        self._scene = RayScene([(part, np.eye(4))])

    def turned(self, direction: FloatArray, distance_m: float) -> Iterator[tuple[GrayImage, FloatArray]]:
        """Yield the picture from this view at each turn, with ``axis_R_object`` (3, 3)."""
        import cv2

        picture, camera_R_object = self.picture(direction, distance_m)
        half = picture.shape[0] / 2
        for roll_rad in rolls_rad(self._settings):
            turn = rotation_about((0, 0, 1), roll_rad)
            about_centre = np.hstack([turn[:2, :2], (half - turn[:2, :2] @ (half, half))[:, None]])
            turned = cv2.warpAffine(picture, about_centre, picture.shape[::-1]).astype(np.uint8, copy=False)
            yield turned, turn @ camera_R_object

    def picture(self, direction: FloatArray, distance_m: float) -> tuple[GrayImage, FloatArray]:
        """Return the shaded picture (S, S), the part's centre at S / 2, and ``camera_R_object`` (3, 3)."""
        radius_m = self.part.diameter_m / 2
        half = int(np.ceil(self._focal_px * radius_m / max(distance_m - radius_m, radius_m))) + MARGIN_PX
        half += -half % 16
        camera = PinholeCamera(2 * half, 2 * half, self._focal_px, self._focal_px, half, half)
        centre_m = self.part.centre_m
        object_T_camera = look_at(centre_m + distance_m * direction, centre_m)
        rays = rotate(object_T_camera, camera.pixel_rays())
        hits = self._scene.cast(object_T_camera[:3, 3], rays)
        cosine = -(hits.normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
        level = brightness(np.where(hits.instance >= 0, cosine, -1.0), self._settings)
        return (255 * level).astype(np.uint8), object_T_camera[:3, :3].T


def _features_that_fit(studio: _Studio, settings: DetectionSettings) -> int:
    """Return the most features that the smallest pictures offer in all but ``REFUSED_SHARES`` of the views."""
    far_m = float(distances(settings)[-1])
    pictures = [studio.picture(direction, far_m)[0] for direction in view_directions(settings.view_step_deg)]
    refused: dict[int, float] = {}
    for count in (settings.num_features, *(n for n in FEWER_FEATURES if n < settings.num_features)):
        detector = new_detector(settings, count)
        refused[count] = sum(_add(detector, picture, "probe")[0] < 0 for picture in pictures) / len(pictures)
    for share in REFUSED_SHARES:
        fitting = [count for count in refused if refused[count] <= share]
        if fitting:
            return max(fitting)
    raise DetectionError(
        f"{studio.part.name}: over {REFUSED_SHARES[-1]:.0%} of the views offer fewer than {min(refused)} features at "
        f"{far_m:.3g} m; raise span_px ({settings.span_px:g}) or lower strong_threshold ({settings.strong_threshold:g})"
    )


def _add(detector: Any, picture: GrayImage, name: str) -> tuple[int, FloatArray]:
    """Train one picture; return its id (-1: refused) and the corner (2,) its position is counted from."""
    import cv2

    # no mask: with one, features come from the border of the mask only and the creases are lost
    template_id, box = detector.addTemplate([cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)], name, None)
    return int(template_id), np.array(box[:2], dtype=np.float64)


def pose_on_ray(
    uv: FloatArray, camera: PinholeCamera, axis_R_object: FloatArray, distance_m: float, centre_m: FloatArray
) -> FloatArray:
    """Return ``camera_T_object`` (4, 4) of a template found with its centre at pixel ``uv`` (2,).

    The rotation turns with the ray. Off the axis a pinhole image grows by 1/cos along the radius and not across it;
    the distance takes the geometric mean.
    """
    ray = camera.rays(uv[0], uv[1])
    direction = ray / np.linalg.norm(ray)
    axis = np.cross((0.0, 0.0, 1.0), direction)
    turn = rotation_about(axis, float(np.arccos(direction[2]))) if np.linalg.norm(axis) > 1e-9 else np.eye(3)
    rotation = turn @ axis_R_object
    return transform(rotation, ray * distance_m / np.sqrt(direction[2]) - rotation @ centre_m)
