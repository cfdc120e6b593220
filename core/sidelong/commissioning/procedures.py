"""From a task and recorded captures to calibration files."""

from __future__ import annotations

from collections.abc import Iterator

from sidelong.commissioning.made import Captures, Made, Progress
from sidelong.commissioning.tasks import (
    HandEyeTask,
    MaterialTask,
    NoiseTask,
    ProjectorTask,
    ResponseTask,
    SensingTask,
    Task,
)


def perform(task: Task, captures: Captures, progress: Progress) -> Iterator[Made]:
    """Do a task, and yield each calibration as soon as it is made.

    Parameters
    ----------
    task
        What to calibrate.
    captures
        Where the captures are, and what is known already.
    progress
        Called with (work, done, total); what it raises ends the task.

    Raises
    ------
    DatasetError, ImageError, PoseError, MeshError
        A file is missing or cannot be used.
    CalibrationError
        The captures cannot carry the calibration.
    """
    match task:
        case ResponseTask():
            from sidelong.commissioning.response import make_response

            yield make_response(captures, progress)
        case ProjectorTask():
            from sidelong.commissioning.projector import make_projector

            yield make_projector(task, captures, progress)
        case MaterialTask():
            from sidelong.commissioning.material import make_materials

            yield from make_materials(task, captures, progress)
        case SensingTask():
            from sidelong.commissioning.sensing import make_sensing

            yield make_sensing(task, captures, progress)
        case HandEyeTask():
            from sidelong.commissioning.hand_eye import make_hand_eye

            yield make_hand_eye(task, captures, progress)
        case NoiseTask():
            from sidelong.commissioning.noise import make_noise

            yield make_noise(task, captures, progress)
