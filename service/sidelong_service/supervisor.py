"""The cell: its processes, the one scan or job that may be active, and the stop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from sidelong.errors import SidelongError
from sidelong.types import Stop
from sidelong_service.calibration_store import CalibrationStore
from sidelong_service.children import ArmLink, ChildGoneError, WorkerLink
from sidelong_service.events import Bulletin
from sidelong_service.jobs import job_of
from sidelong_service.messages import (
    CalibrateJob,
    CapturesJob,
    CellJob,
    CheckJob,
    Job,
    Note,
    RecordingJob,
    RunJob,
    ScanJob,
    Settings,
)
from sidelong_service.models import CalibrationRequest, CellReport, CellState, Readiness, RunState, ScanRequest
from sidelong_service.problems import Problem, ServiceError, problem, problem_of
from sidelong_service.settings import ServiceSettings
from sidelong_service.storage import Storage
from sidelong_service.storage_thread import StorageThread

log = logging.getLogger(__name__)

RESTART_S = 0.5
"""Between the end of a process and the start of the next one in its place."""
STOPPING_S = 15.0
"""What a scan gets to end after a stop, before its worker is killed."""
CLOSING_S = 0.7
"""The same, where the service ends."""
STORE_ATTEMPTS, STORE_AGAIN_S = 6, 1.0
"""How often the end of a scan is stored where the database fails; one that is lost is ``interrupted`` at a restart."""


@dataclass(eq=False)
class ActiveRun:
    """The scan or job that has the worker."""

    id: str
    request: ScanRequest | CalibrationRequest
    job: Job
    settings: Settings
    accepted: bool = False
    stop_asked: bool = False

    @property
    def is_scan(self) -> bool:
        """Whether it is a scan, which has the cell too."""
        return isinstance(self.request, ScanRequest)

    @property
    def name(self) -> str:
        """What people call it."""
        return f"{'scan' if self.is_scan else 'job'} {self.id}"

    @property
    def reference(self) -> dict[str, str]:
        """The member of a problem document that names it."""
        return {"scan_id" if self.is_scan else "job_id": self.id}


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    state: RunState
    finish_reason: Stop | None = None
    problem: Problem | None = None


class Supervisor:
    """Owns arm host and scan worker, starts them again when they die, and runs one scan or job at a time.

    Parameters
    ----------
    settings
        Of the service.
    storage
        Where scans and jobs are kept.
    calibrations
        Where calibrations are kept.
    new_id
        Makes ids of scans and jobs.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        storage: StorageThread,
        calibrations: CalibrationStore,
        new_id: Callable[[], str],
    ) -> None:
        self._settings = settings
        self._storage = storage
        self._calibrations = calibrations
        self._new_id = new_id
        self._sockets = Path()
        self._socket_numbers = count()
        self._arm: ArmLink | None = None
        self._guest_arm: ArmLink | None = None
        self._arm_name = settings.cell.arm.driver
        self._arm_trouble = "is starting"
        self._worker: WorkerLink | None = None
        self._worker_trouble = "is starting"
        self._active: ActiveRun | None = None
        self._entrance = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._keepers: list[asyncio.Task[None]] = []
        self._closing = False
        self.bulletin = Bulletin()

    async def start(self) -> None:
        """Start the processes; runs that a former service left open are marked as interrupted."""
        left = await self._storage.call(Storage.interrupt_open_runs)
        if left:
            log.warning("%d scans or jobs were interrupted when the service last ended", left)
        self._sockets = Path(tempfile.mkdtemp(prefix="sidelong-"))
        self._keepers = [asyncio.create_task(self._keep_arm()), asyncio.create_task(self._keep_worker())]

    def begin_closing(self) -> None:
        """Stop the arm and the active run, take no other, and end the event streams. Harmless when repeated."""
        if not self._closing:
            self._closing = True
            self._spawn(self._stop_quietly())
            self.bulletin.close()

    async def close(self) -> None:
        """Stop the arm, then end the active run and the processes."""
        self.begin_closing()
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=CLOSING_S)
        if self._worker is not None:
            self._worker.kill()
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.gather(*self._keepers, *self._tasks, return_exceptions=True)
        shutil.rmtree(self._sockets, ignore_errors=True)

    async def submit(self, request: ScanRequest | CalibrationRequest) -> str:
        """Accept a scan or a job and return its id.

        Raises
        ------
        ServiceError
            Another one is active, the cell is not ready, or the request names what is not there.
        """
        # whoever comes while another request is checked waits for that: it may be refused, and its id never be a scan's
        async with self._entrance:
            return await self._admit(request)

    async def _admit(self, request: ScanRequest | CalibrationRequest) -> str:
        if self._active is not None:
            busy = self._active
            raise ServiceError(problem("cell-busy", f"{busy.name.capitalize()} is active.", **busy.reference))
        try:
            job = job_of(request, self._settings)
            documents = await asyncio.to_thread(self._calibrations.read_all, request.recipe.calibrations)
        except SidelongError as error:
            raise ServiceError(problem_of(error)) from error
        reasons = self._hindrances(job)
        if reasons:
            raise ServiceError(problem("not-ready", "; ".join(reasons) + ".", reasons=reasons))
        settings = Settings(recipe=request.recipe, documents=documents)
        run = self._active = ActiveRun(self._new_id(), request, job, settings)
        try:
            await self._check(run)
            await self._storage.call(Storage.create, run.id, request)
            run.accepted = True
        except BaseException:
            self._active = None
            raise
        self._spawn(self._conduct(run))
        return run.id

    def cancel(self, job_id: str) -> None:
        """Ask a job to end; one that is not active, or a scan, stays as it is."""
        if self._active is not None and self._active.id == job_id and not self._active.is_scan:
            self._end_early(self._active)

    async def stop(self) -> str | None:
        """Stop the arm and the active run, and return the id of a scan.

        No lock, queue or database stands before the message to the arm.

        Raises
        ------
        ServiceError
            The arm did not confirm in time.
        """
        run = self._active
        stops = [link.stop() for link in (self._arm, self._guest_arm) if link is not None]
        if run is not None:
            self._end_early(run)
        scan_id = run.id if run is not None and run.is_scan else None
        confirmed = await asyncio.gather(*stops)
        if self._arm is None or not all(confirmed):
            raise ServiceError(
                problem("stop-unconfirmed", f"Arm {self._arm_name} did not confirm that it stops.", scan_id=scan_id)
            )
        return scan_id

    def cell(self) -> CellReport:
        """Report on the cell."""
        cell = self._settings.cell
        reasons = self._hindrances(None)
        active = self._active if self._active is not None and self._active.accepted else None
        if self._active is not None:
            reasons = (f"{active.name} is active" if active else "a request is being checked", *reasons)
        return CellReport(
            name=cell.name,
            mode="simulated" if cell.simulated else "real",
            state=self._state(),
            camera=cell.camera.driver,
            arm=self._arm_name,
            active_scan=active.id if active is not None and active.is_scan else None,
            active_job=active.id if active is not None and not active.is_scan else None,
            may_start=not reasons,
            reasons=reasons,
        )

    async def readiness(self) -> Readiness:
        """Report what the service needs for a scan."""
        try:
            await self._storage.call(Storage.scans, 1)
            storage = "ready"
        except sqlite3.Error as error:
            storage = f"cannot be read: {error}"
        arm, worker = self._arm_trouble or "ready", self._worker_trouble or "ready"
        return Readiness(ready=(arm, worker, storage) == ("ready",) * 3, arm=arm, worker=worker, storage=storage)

    def _state(self) -> CellState:
        if self._active is not None:
            return CellState.STOPPING if self._active.stop_asked else CellState.EXECUTING
        troubles = [trouble for trouble in (self._arm_trouble, self._worker_trouble) if trouble]
        if not troubles:
            return CellState.IDLE
        return CellState.STARTING if set(troubles) == {"is starting"} else CellState.FAULT

    def _hindrances(self, job: Job | None) -> tuple[str, ...]:
        """Say what keeps a job from starting; what was recorded needs no arm of the cell."""
        reasons = ["the service is ending"] if self._closing else []
        if self._arm_trouble and not isinstance(job, RecordingJob | CapturesJob):
            reasons.append(f"arm {self._arm_name}: {self._arm_trouble}")
        if self._worker_trouble:
            reasons.append(f"scan worker: {self._worker_trouble}")
        return tuple(reasons)

    async def _check(self, run: ActiveRun) -> None:
        worker = self._worker
        try:
            if worker is None:
                raise ChildGoneError("the scan worker has gone")
            trouble = await worker.check(CheckJob(job=run.job, settings=run.settings))
        except ChildGoneError as error:
            if worker is not None:
                worker.kill()
            raise ServiceError(
                problem("worker-died", f"The scan worker could not check the request: {error}.")
            ) from error
        if trouble is not None:
            raise ServiceError(trouble)

    async def _conduct(self, run: ActiveRun) -> None:
        """See a run through to its end, whatever happens."""
        try:
            ending = await (self._scan(run) if run.is_scan else self._calibrate(run))
        except ServiceError as error:
            ending = Ending(RunState.FAILED, problem=error.problem)
        except Exception as error:
            log.exception("%s", run.name)
            ending = Ending(RunState.FAILED, problem=problem_of(error))
        try:
            await self._end(run, self._judge(run, ending))
        finally:
            self._active = None
            self.bulletin.post()

    async def _end(self, run: ActiveRun, ending: Ending) -> None:
        """Keep how a run ended, also where the database is not to be had for a while."""
        for attempt in range(1, STORE_ATTEMPTS + 1):
            try:
                await self._set_state(run.id, ending)
            except sqlite3.Error as error:
                log.error("%s: its end, %s, is not stored: %s", run.name, ending.state, error)
                if self._closing or attempt == STORE_ATTEMPTS:
                    raise
                await asyncio.sleep(STORE_AGAIN_S)
            else:
                return

    def _judge(self, run: ActiveRun, ending: Ending) -> Ending:
        """Say how a run ended: one that was stopped did not fail, whatever error the stop brought about."""
        if ending.state is RunState.SUCCEEDED:
            return ending
        if self._closing:
            trouble = problem("service-restarted", f"The service ended during {run.name}.", **run.reference)
            return Ending(RunState.INTERRUPTED, problem=trouble)
        return Ending(RunState.STOPPED) if run.stop_asked else ending

    async def _scan(self, run: ActiveRun) -> Ending:
        job = run.job
        if isinstance(job, CapturesJob):
            raise TypeError(f"{run.name} is no scan")
        async with contextlib.AsyncExitStack() as stack:
            arm, name = await self._arm_for(job, stack)
            worker = await self._begin(run)
            # from the state to the job no await: a stop comes either before, and is seen, or after, and finds both at
            # work
            if run.stop_asked:
                return Ending(RunState.STOPPED)
            arm.release()
            folder, cache = self._settings.data_dir / "scans" / run.id, self._settings.data_dir / "templates"
            worker.run(
                RunJob(
                    job=job,
                    settings=run.settings,
                    arm_socket=arm.path,
                    arm_name=name,
                    folder=folder.resolve(),
                    cache_dir=cache.resolve(),
                )
            )
            try:
                ending = await self._follow(run, worker)
            except Exception:
                # nobody follows the worker any more: the arm may not go on moving
                await arm.stop()
                raise
            if ending.state is RunState.INTERRUPTED:
                await arm.stop()
            return ending

    async def _calibrate(self, run: ActiveRun) -> Ending:
        job = run.job
        if not isinstance(job, CapturesJob):
            raise TypeError(f"{run.name} is no calibration")
        worker = await self._begin(run)
        if run.stop_asked:
            return Ending(RunState.STOPPED)
        worker.run(CalibrateJob(job=job, settings=run.settings, folder=self._calibrations.folder.resolve()))
        return await self._follow(run, worker)

    async def _begin(self, run: ActiveRun) -> WorkerLink:
        """Mark a run as running, and return the worker that shall do it."""
        worker = self._worker
        if worker is None:
            raise ServiceError(problem("worker-died", f"The scan worker ended before {run.name} began."))
        await self._set_state(run.id, Ending(RunState.RUNNING))
        return worker

    async def _follow(self, run: ActiveRun, worker: WorkerLink) -> Ending:
        """Keep what the worker tells until it is done; where that fails the worker may not go on."""
        try:
            while True:
                message = await worker.next()
                if isinstance(message, Note):
                    await self._storage.call(Storage.add_event, run.id, message.event, message.data)
                    self.bulletin.post()
                elif message.kind == "done":
                    state = RunState.STOPPED if message.cancelled else RunState.SUCCEEDED
                    state = state if message.problem is None else RunState.FAILED
                    return Ending(state, message.finish_reason, message.problem)
        except ChildGoneError:
            trouble = problem("worker-died", f"The scan worker ended during {run.name}.", **run.reference)
            return Ending(RunState.INTERRUPTED, problem=trouble)
        except Exception:
            worker.kill()
            raise

    async def _arm_for(self, job: ScanJob, stack: contextlib.AsyncExitStack) -> tuple[ArmLink, str]:
        """Return the arm of a job and its name: the cell's, or for recorded views one for this scan alone."""
        if isinstance(job, CellJob):
            if self._arm is None:
                raise ServiceError(problem("device-lost", f"arm {self._arm_name}: {self._arm_trouble}"))
            return self._arm, self._arm_name
        guest = self._guest_arm = ArmLink(job.arm(), self._new_socket())
        stack.push_async_callback(self._close_guest, guest)
        return guest, await guest.open()

    async def _close_guest(self, guest: ArmLink) -> None:
        self._guest_arm = None
        await guest.close()

    def _end_early(self, run: ActiveRun) -> None:
        """Ask for the end of a run, once; kill its worker where it does not come."""
        if run.stop_asked:
            return
        run.stop_asked = True
        if self._worker is not None:
            self._worker.cancel()
            asyncio.get_running_loop().call_later(STOPPING_S, self._kill_if_active, run, self._worker)
        self._spawn(self._set_state(run.id, Ending(RunState.STOPPING)))

    def _kill_if_active(self, run: ActiveRun, worker: WorkerLink) -> None:
        if self._active is run:
            log.error("%s did not end within %g s of the stop: its worker is killed", run.name, STOPPING_S)
            worker.kill()

    async def _stop_quietly(self) -> None:
        try:
            await self.stop()
        except ServiceError as error:
            log.error("while the service ends: %s", error)

    async def _set_state(self, run_id: str, ending: Ending) -> None:
        await self._storage.call(Storage.set_state, run_id, ending.state, ending.finish_reason, ending.problem)
        self.bulletin.post()

    async def _keep_arm(self) -> None:
        """Keep the cell's arm host running."""
        while True:
            link = ArmLink(self._settings.cell.arm, self._new_socket())
            try:
                self._arm_name = await link.open()
                self._arm, self._arm_trouble = link, ""
                await link.gone()
                self._arm_trouble = "its process ended"
            except ServiceError as error:
                self._arm_trouble = error.problem.detail
            finally:
                self._arm = None
                await link.close()
            await asyncio.sleep(RESTART_S)

    async def _keep_worker(self) -> None:
        """Keep the scan worker running."""
        while True:
            link = WorkerLink()
            try:
                await link.open()
                self._worker, self._worker_trouble = link, ""
                await link.gone()
                self._worker_trouble = "its process ended"
            except ChildGoneError as error:
                self._worker_trouble = str(error)
            finally:
                self._worker = None
                await link.close()
            await asyncio.sleep(RESTART_S)

    def _new_socket(self) -> Path:
        return self._sockets / f"arm{next(self._socket_numbers)}"

    def _spawn(self, work: Coroutine[object, object, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
