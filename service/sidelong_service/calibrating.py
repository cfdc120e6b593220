"""Makes a calibration and tells of it: the same in the scan worker and in a process without a service."""

from __future__ import annotations

from dataclasses import dataclass

from sidelong.commissioning.procedures import Captures, perform
from sidelong.recorded.dataset import Dataset
from sidelong_service.calibration_store import CalibrationStore
from sidelong_service.messages import CapturesJob, Settings
from sidelong_service.runner import Listener


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """A calibration that is ready to be made.

    Attributes
    ----------
    job
        Which captures, and what of them.
    settings
        Recipe, and the calibrations it names.
    store
        Where the files go.
    listener
        Who hears of it.
    """

    job: CapturesJob
    settings: Settings
    store: CalibrationStore
    listener: Listener

    def run(self) -> None:
        """Make the calibrations, each written as soon as it is there.

        Raises
        ------
        Cancelled
            The listener asked for the end.
        SidelongError
            The captures cannot be used, or cannot carry the calibration.
        OSError
            A file could not be written.
        """
        captures = Captures(Dataset(self.job.root), self.job.object, self.settings.recipe, self.settings.documents)
        for made in perform(self.job.task, captures, self._progress):
            self.listener.check_cancelled()
            self.store.add(made.document, made.picture)
            about = made.document.model_dump(mode="json", include={"id", "kind", "material", "warnings"})
            self.listener.note("calibration", about | {"summary": made.summary})

    def _progress(self, work: str, done: int, total: int) -> None:
        self.listener.check_cancelled()
        self.listener.note("progress", {"work": work, "done": done, "total": total})
