"""The process that scans: planner, camera and files; kept warm from scan to scan.

Two threads. One listens to the API, so that a cancellation is heard while the other one computes.
"""

from __future__ import annotations

import logging
import os
import queue
import signal
import socket
import sys
import threading
from collections.abc import Mapping
from typing import Any

from sidelong.errors import DeviceError, SidelongError
from sidelong_service.calibrating import CalibrationRun
from sidelong_service.calibration_store import CalibrationStore
from sidelong_service.cells import Cameras, cell_of, check, effective_recipe, plan_of
from sidelong_service.lines import Lines
from sidelong_service.messages import (
    TO_WORKER,
    CalibrateJob,
    CancelJob,
    CheckJob,
    JobChecked,
    JobDone,
    Note,
    RunJob,
    WorkerReady,
)
from sidelong_service.models import EventKind
from sidelong_service.problems import Problem, problem_of
from sidelong_service.remote_arm import RemoteArm
from sidelong_service.runner import Cancelled, ScanRun

log = logging.getLogger(__name__)


class Worker:
    """Checks and runs one job at a time."""

    def __init__(self, control: Lines) -> None:
        self._control = control
        self._jobs: queue.Queue[CheckJob | RunJob | CalibrateJob] = queue.Queue()
        self._cancelled = threading.Event()
        self._cameras = Cameras()

    def run(self) -> None:
        """Serve until the API goes."""
        threading.Thread(target=self._listen, name="control", daemon=True).start()
        _warm_up()
        self._control.send(WorkerReady())
        while True:
            self._control.send(self._do(self._jobs.get()))

    def note(self, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Tell the API what happened."""
        self._control.send(Note(event=kind, data=dict(data)))

    def check_cancelled(self) -> None:
        """Raise Cancelled where the API asked for the end of the job."""
        if self._cancelled.is_set():
            raise Cancelled

    def _listen(self) -> None:
        while True:
            try:
                message = TO_WORKER.validate_json(self._control.receive())
            except EOFError:
                # files are written whole or not at all, and nobody is left to tell
                os._exit(0)
            if isinstance(message, CancelJob):
                self._cancelled.set()
                continue
            self._cancelled.clear()
            self._jobs.put(message)

    def _do(self, job: CheckJob | RunJob | CalibrateJob) -> JobChecked | JobDone:
        match job:
            case CheckJob():
                return self._check(job)
            case RunJob():
                return self._run(job)
            case CalibrateJob():
                return self._calibrate(job)

    def _check(self, job: CheckJob) -> JobChecked:
        try:
            check(job.job, job.settings)
        except Exception as error:  # noqa: BLE001 - told to the API, and logged where unexpected
            return JobChecked(problem=_problem_of(error))
        return JobChecked(problem=None)

    def _run(self, job: RunJob) -> JobDone:
        arm = RemoteArm(job.arm_name, job.arm_socket)
        try:
            plan = plan_of(job.job, job.settings.recipe)
            camera = self._cameras.open(plan.camera)
            recipe = effective_recipe(job.job, job.settings, plan.part, camera.serial)
            arm.open()
            cell = cell_of(plan, camera, arm, job.settings.documents)
            reason = ScanRun(cell, plan.part, recipe, job.folder, job.cache_dir, self).run()
        except Cancelled:
            return JobDone(cancelled=True)
        except Exception as error:  # noqa: BLE001 - told to the API, and logged where unexpected
            if isinstance(error, DeviceError) and error.device != arm.name:
                self._cameras.close()
            return JobDone(problem=_problem_of(error))
        finally:
            arm.close()
        return JobDone(finish_reason=reason)

    def _calibrate(self, job: CalibrateJob) -> JobDone:
        try:
            CalibrationRun(job.job, job.settings, CalibrationStore(job.folder), self).run()
        except Cancelled:
            return JobDone(cancelled=True)
        except Exception as error:  # noqa: BLE001 - told to the API, and logged where unexpected
            return JobDone(problem=_problem_of(error))
        return JobDone()


def _problem_of(error: Exception) -> Problem:
    if not isinstance(error, SidelongError | OSError):
        log.error("unexpected error", exc_info=error)
    return problem_of(error)


def _warm_up() -> None:
    """Import now what the first scan would wait for."""
    import matplotlib.figure  # noqa: F401  # pyright: ignore[reportUnusedImport]
    import open3d  # noqa: F401  # pyright: ignore[reportUnusedImport]


def main() -> None:
    """Run as ``python -m sidelong_service.worker DESCRIPTOR``."""
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    # Ctrl-C is for the API, which ends this process in its turn
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Worker(Lines(socket.socket(fileno=int(sys.argv[1])))).run()


if __name__ == "__main__":
    main()
