"""The commands ``sidelong bop ...``: recorded scenes and detections in the files of the BOP benchmark."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sidelong.errors import DatasetError
from sidelong.types import Projector
from sidelong_service.command import ConfigFile, RecipeFile, err, out, plain_errors, recipe_of
from sidelong_service.console import CountedProgress

if TYPE_CHECKING:  # open3d and what needs it wait for the commands that use them
    from sidelong.recipe import Stages
    from sidelong.recorded.dataset import Scene
    from sidelong.types import DetectedObject

bop = typer.Typer(name="bop", help="Write the files of the BOP benchmark, for its toolkit.", no_args_is_help=True)

DataSet = Annotated[Path, typer.Argument(help="Folder of a data set in ROBI's layout.")]
Object = Annotated[str, typer.Option("--object", help="Object of the data set.")]
Number = Annotated[int, typer.Option("--scene", min=0, help="Number of the scene.")]
ObjectId = Annotated[int, typer.Option(min=1, help="BOP's number of the object.")]


@bop.command()
def scene(
    dataset: DataSet,
    folder: Annotated[Path, typer.Argument(help="Folder to write to; what is there of other scenes stays.")],
    object_name: Object,
    number: Number = 1,
    object_id: ObjectId = 1,
) -> None:
    """Export a recorded scene: camera, model with its symmetries, images, depth, true poses and visibility."""
    from sidelong.evaluation.bop import export_scene
    from sidelong.recorded.dataset import Dataset

    with plain_errors():
        export_scene(Dataset(dataset).scene(object_name, number), folder, object_id)
        out.print(f"  {folder}", highlight=False, markup=False, soft_wrap=True)


@bop.command()
def results(
    dataset: DataSet,
    file: Annotated[Path, typer.Argument(help="CSV file to write.")],
    object_name: Object,
    number: Number = 1,
    object_id: ObjectId = 1,
    recipe: RecipeFile = None,
    config: ConfigFile = None,
) -> None:
    """Detect in every view of a scene, refine by the depth of that view, and write the poses."""
    from sidelong.evaluation.bop import ImageId, write_results
    from sidelong.recipe import build_stages
    from sidelong.recorded.dataset import Dataset
    from sidelong_service.cells import effective_recipe
    from sidelong_service.messages import RecordingJob, Settings
    from sidelong_service.settings import load_settings

    with plain_errors(), CountedProgress(err) as progress:
        recorded = Dataset(dataset)
        here, part = recorded.scene(object_name, number), recorded.part(object_name)
        job = RecordingJob(root=dataset, object=object_name, scene=number, reference=None)
        settings = effective_recipe(job, Settings(recipe=recipe_of(recipe), documents=()), part, recorded.serial)
        cache = load_settings(config).data_dir / "templates"

        def train(done: int, pictures: int) -> None:
            progress.show("training templates", done, pictures)

        rows: list[tuple[ImageId, Sequence[DetectedObject], float]] = []
        with build_stages(settings, part, recorded.rig, cache, progress=train) as stages:
            for image, view in enumerate(here.names):
                started_s = time.monotonic()
                objects = _detected(here, view, stages)
                rows.append((ImageId(number, image, object_id), objects, time.monotonic() - started_s))
                progress.show(f"{object_name} scene {number}", image + 1, len(here.names))
        write_results(file, rows)
        out.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def _detected(here: Scene, view: str, stages: Stages) -> Sequence[DetectedObject]:
    """Return what is found in one view, refined by its own depth."""
    import numpy as np

    from sidelong.detection.refinement import DepthView

    image = here.image(view, Projector.OFF)
    if image is None:
        raise DatasetError(f"{here.folder}: view {view} has no left image with the projector off")
    depth_m = here.depth_m(view)
    refiner = stages.new_refiner()
    refiner.add(DepthView(view, depth_m, np.eye(4)))
    return refiner.refine(stages.detector.detect(image, depth_m))
