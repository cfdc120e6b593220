"""Which reference views of a data set are evaluated, and against what truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.errors import DepthError, UnknownNameError
from sidelong.evaluation.metrics import Truth, truth_of
from sidelong.evaluation.pose_errors import PoseMetrics
from sidelong.evaluation.pose_score import PoseJudge
from sidelong.evaluation.silhouettes import visible_fractions
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import invert
from sidelong.recorded.dataset import Dataset, Scene
from sidelong.types import DetectedObject, Hypothesis, View


@dataclass(frozen=True)
class Case:
    """One reference view of one scene."""

    object: str
    scene: int
    reference: str


def cases_of(
    dataset: Dataset, object_name: str | None, scene: int | None, references: Sequence[str] | None
) -> tuple[Case, ...]:
    """Return the cases a data set has: of one object or all, of one scene or all, of some references or all.

    Parameters
    ----------
    references
        Positions in the scene's list, or names of views; None for all.

    Raises
    ------
    UnknownNameError
        There is no such object, scene or view.
    DatasetError, PoseError
        The list of a scene, or the pose of a named view, cannot be used.
    """
    if not dataset.objects:
        raise UnknownNameError(f"{dataset.root}: the data set has no <Object>/Scene_<k>/")
    return tuple(
        Case(name, number, view)
        for name in ((object_name,) if object_name is not None else dataset.objects)
        for number in ((scene,) if scene is not None else dataset.scenes(name))
        for view in _chosen(dataset.scene(name, number), references)
    )


def _chosen(scene: Scene, references: Sequence[str] | None) -> tuple[str, ...]:
    if references is None:
        return scene.names
    chosen: list[str] = []
    for each in references:
        if each.isdecimal() and each not in scene.names:
            if int(each) >= len(scene.names):
                raise UnknownNameError(f"{scene.folder}: reference {each} is out of range 0..{len(scene.names) - 1}")
            chosen.append(scene.names[int(each)])
        else:
            chosen.append(scene.view(each).name)
    return tuple(dict.fromkeys(chosen))


def truth_in(scene: Scene, reference: View, part: Part) -> Truth:
    """Return the truth of a reference view. Raises DepthError where its true depth was not recorded."""
    depth_m = scene.true_depth_m(reference.name)
    if depth_m is None:
        raise DepthError(f"{scene.folder}: view {reference.name} has no true depth")
    measured = np.isfinite(scene.depth_m(reference.name))
    return truth_of(
        depth_m,
        measured,
        [(part, pose) for pose in scene.base_T_objects],
        (scene.dataset.rig.left, reference.base_T_camera),
    )


def judge_in(scene: Scene, reference: View, metrics: PoseMetrics) -> PoseJudge:
    """Return what judges poses in a reference view."""
    base_T_objects = scene.base_T_objects
    visible = visible_fractions(
        [(metrics.part, pose) for pose in base_T_objects], metrics.camera, reference.base_T_camera
    )
    return PoseJudge(metrics, invert(reference.base_T_camera) @ np.array(base_T_objects).reshape(-1, 4, 4), visible)


def true_objects(scene: Scene, reference: View) -> tuple[DetectedObject, ...]:
    """Return the true poses as a detection that is sure."""
    camera_T_base = invert(reference.base_T_camera)
    return tuple(DetectedObject((Hypothesis(camera_T_base @ pose, 100.0, 1.0),)) for pose in scene.base_T_objects)
