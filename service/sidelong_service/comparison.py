"""Strategies side by side over a data set: which scenes and references, through the replay drivers, row by row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sidelong.devices import Cell
from sidelong.errors import DepthError, UnknownNameError
from sidelong.evaluation.compare import Label, Row, Run, compare_reference
from sidelong.evaluation.dataset import Dataset, Scene
from sidelong.evaluation.metrics import Truth, truth_of
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import invert
from sidelong.recipe import GivenObjects, Recipe, Stages, build_stages
from sidelong.types import DetectedObject, Hypothesis, View
from sidelong_drivers.registry import create_arm, create_camera
from sidelong_service.cells import effective_recipe
from sidelong_service.messages import RecordingJob

NO_TRUTH = "has no true depth"


@dataclass(frozen=True)
class Case:
    """One reference view of one scene."""

    object: str
    scene: int
    reference: str


@dataclass(frozen=True)
class Comparison:
    """What is compared.

    Attributes
    ----------
    dataset
        Recorded data.
    cases
        Reference views; those of one scene stand together.
    runs
        Strategies and seeds.
    recipe
        Settings of all runs.
    cache_dir
        Where trained templates are kept.
    true_poses
        Whether the true poses stand in for detection.
    """

    dataset: Dataset
    cases: tuple[Case, ...]
    runs: tuple[Run, ...]
    recipe: Recipe
    cache_dir: Path
    true_poses: bool = False

    def rows(
        self, skipped: Callable[[Case, str], None], progress: Callable[[int, int], None] | None = None
    ) -> Iterator[Row]:
        """Yield the rows of all cases; ``skipped`` hears of a case without a yardstick, and why.

        ``progress(done, total)`` counts pictures while templates are trained.

        Raises
        ------
        SidelongError
            A file cannot be used, or detection failed.
        """
        for object_name, number in dict.fromkeys((case.object, case.scene) for case in self.cases):
            scene, part = self.dataset.scene(object_name, number), self.dataset.part(object_name)
            job = RecordingJob(root=self.dataset.root, object=object_name, scene=number, reference=None)
            recipe = effective_recipe(job, self.recipe, part)
            given: tuple[DetectedObject, ...] | None = () if self.true_poses else None
            with build_stages(
                recipe, part, self.dataset.rig, self.cache_dir, objects=given, progress=progress
            ) as stages:
                cases = [case for case in self.cases if (case.object, case.scene) == (object_name, number)]
                yield from self._scene_rows(scene, cases, (recipe, stages), skipped)

    def _scene_rows(
        self,
        scene: Scene,
        cases: Sequence[Case],
        planned: tuple[Recipe, Stages],
        skipped: Callable[[Case, str], None],
    ) -> Iterator[Row]:
        recipe, stages = planned
        job = RecordingJob(root=self.dataset.root, object=scene.object, scene=scene.number, reference=None)
        camera, arm = create_camera("replay", job.driver_settings()), create_arm("replay", job.driver_settings())
        views = scene.views()
        with closing(camera), closing(arm):
            camera.open()
            arm.open()
            for case in cases:
                reference = scene.view(case.reference)
                try:
                    truth = truth_in(scene, reference, stages.part)
                    _ = truth.missing
                except DepthError as error:
                    skipped(case, str(error))
                    continue
                mine = stages
                if self.true_poses:
                    mine = replace(stages, detector=GivenObjects(true_objects(scene, reference)))
                cell = Cell(camera, arm, np.eye(4), reference, views)
                label = Label(case.object, case.scene, case.reference)
                yield from compare_reference(label, cell, mine, recipe, truth, self.runs)


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
        raise DepthError(f"{scene.folder}: view {reference.name} {NO_TRUTH}")
    measured = np.isfinite(scene.depth_m(reference.name))
    return truth_of(
        depth_m,
        measured,
        [(part, pose) for pose in scene.base_T_objects],
        (scene.dataset.rig.left, reference.base_T_camera),
    )


def true_objects(scene: Scene, reference: View) -> tuple[DetectedObject, ...]:
    """Return the true poses as a detection that is sure."""
    camera_T_base = invert(reference.base_T_camera)
    return tuple(DetectedObject((Hypothesis(camera_T_base @ pose, 100.0, 1.0),)) for pose in scene.base_T_objects)
