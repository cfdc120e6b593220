"""Strategies side by side over a data set, through the replay drivers, row by row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sidelong.commissioning.documents import Document
from sidelong.devices import Cell
from sidelong.errors import DepthError
from sidelong.evaluation.cases import Case, judge_in, true_objects, truth_in
from sidelong.evaluation.compare import Row, Run, Yardstick, compare_reference
from sidelong.evaluation.pose_errors import PoseMetrics
from sidelong.recipe import GivenObjects, Recipe, Stages, build_stages
from sidelong.recorded.dataset import Dataset, Scene
from sidelong.types import DetectedObject
from sidelong_drivers.registry import create_arm, create_camera
from sidelong_service.cells import effective_recipe
from sidelong_service.messages import RecordingJob, Settings


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
    documents
        Calibrations that go before what the recipe says.
    poses, depth
        Whether poses, and errors of the depth, are judged as well.
    """

    dataset: Dataset
    cases: tuple[Case, ...]
    runs: tuple[Run, ...]
    recipe: Recipe
    cache_dir: Path
    true_poses: bool = False
    documents: tuple[Document, ...] = ()
    poses: bool = False
    depth: bool = False

    @property
    def rows_each(self) -> int:
        """How many rows a reference view gives."""
        alone = self.poses or self.depth
        return len(self.runs) * (self.recipe.planning.max_views + alone)

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
            settings = Settings(recipe=self.recipe, documents=self.documents)
            recipe = effective_recipe(job, settings, part, self.dataset.serial)
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
        metrics = PoseMetrics(stages.part, stages.rig.left) if self.poses else None
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
                judge = judge_in(scene, reference, metrics) if metrics is not None else None
                yardstick = Yardstick(truth, judge, self.depth)
                yield from compare_reference(case, cell, mine, recipe, yardstick, self.runs)
