"""The service's child processes as the event loop sees them: nothing here waits for a child without a deadline."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from collections.abc import Awaitable
from pathlib import Path
from typing import Self

from pydantic import BaseModel

from sidelong_service.lines import LONGEST_LINE, encode
from sidelong_service.messages import (
    FROM_ARM_HOST,
    FROM_WORKER,
    HEARTBEAT_S,
    ArmFailed,
    ArmReady,
    ArmStopped,
    CalibrateJob,
    CancelJob,
    CheckJob,
    FromWorker,
    Heartbeat,
    JobChecked,
    ReleaseArm,
    RunJob,
    StopArm,
    WorkerReady,
)
from sidelong_service.problems import Problem, ServiceError, problem
from sidelong_service.settings import DriverSettings

log = logging.getLogger(__name__)

START_S = 60.0
CHECK_S = 30.0
STOP_CONFIRMED_S = 0.2
END_S = 1.5


class ChildGoneError(Exception):
    """A child process has ended, or does not answer."""


class Child:
    """A Python module that runs as a process, and the channel to it."""

    def __init__(
        self, process: asyncio.subprocess.Process, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._process = process
        self._reader = reader
        self._writer = writer

    @classmethod
    async def start(cls, module: str, *arguments: str) -> Self:
        """Start ``python -m module DESCRIPTOR arguments...`` with one end of a socket pair as DESCRIPTOR."""
        ours, theirs = socket.socketpair()
        with theirs:
            descriptor = theirs.fileno()
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", module, str(descriptor), *arguments,
                pass_fds=[descriptor], stdin=asyncio.subprocess.DEVNULL,
            )  # fmt: skip
        reader, writer = await asyncio.open_connection(sock=ours, limit=LONGEST_LINE)
        return cls(process, reader, writer)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def send(self, message: BaseModel) -> None:
        """Hand a message to the channel; returns at once. What is sent to a child that has gone is lost."""
        if not self._writer.is_closing():
            self._writer.write(encode(message))

    async def receive(self) -> bytes:
        """Wait for the next line. Raises ChildGoneError where the child has gone."""
        try:
            line = await self._reader.readline()
        except (ConnectionError, ValueError) as error:
            raise ChildGoneError(str(error)) from error
        if not line.endswith(b"\n"):
            raise ChildGoneError(f"process {self.pid} ended")
        return line

    async def gone(self) -> None:
        """Wait until the process has ended."""
        await self._process.wait()

    async def end(self) -> None:
        """Close the channel, which asks the child to end, and kill it where it does not."""
        self._writer.close()
        try:
            await asyncio.wait_for(self._process.wait(), END_S)
        except TimeoutError:
            self.kill()
            await self._process.wait()

    def kill(self) -> None:
        """Kill the child at once."""
        if self._process.returncode is None:
            self._process.kill()


class ArmLink:
    """An arm host as the API sees it. It is told twice a second that the API is there."""

    def __init__(self, driver: DriverSettings, path: Path) -> None:
        self.path = path
        self._driver = driver
        self._child: Child | None = None
        self._ready: asyncio.Future[str | Problem] = asyncio.get_running_loop().create_future()
        self._confirmations: list[asyncio.Future[None]] = []
        self._tasks: list[asyncio.Task[None]] = []

    async def open(self) -> str:
        """Start the process, open the arm and return its name. Raises ServiceError where it cannot be opened."""
        self._child = await Child.start(
            "sidelong_service.arm_host", str(self.path), self._driver.model_dump_json()
        )  # fmt: skip
        self._tasks = [asyncio.create_task(self._listen(self._child)), asyncio.create_task(self._beat(self._child))]
        try:
            answer = await asyncio.wait_for(asyncio.shield(self._ready), START_S)
        except TimeoutError:
            answer = problem("device-timeout", f"arm {self._driver.driver!r} did not open within {START_S:g} s")
        if isinstance(answer, Problem):
            await self.close()
            raise ServiceError(answer)
        return answer

    async def gone(self) -> None:
        """Wait until the process has ended."""
        if self._child is not None:
            await self._child.gone()

    def release(self) -> None:
        """Allow moves again: a scan begins."""
        if self._child is not None:
            self._child.send(ReleaseArm())

    def stop(self) -> Awaitable[bool]:
        """Stop the arm at once; what it returns says, when awaited, whether the driver confirmed in time."""
        confirmation: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        if self._child is None or self._tasks[0].done():
            # a host that has gone has stopped its arm, or has lost it: nobody is left to confirm
            confirmation.cancel()
        else:
            self._child.send(StopArm())
            self._confirmations.append(confirmation)
        return self._confirmed(confirmation)

    async def _confirmed(self, confirmation: asyncio.Future[None]) -> bool:
        done, _ = await asyncio.wait([confirmation], timeout=STOP_CONFIRMED_S)
        return bool(done) and not confirmation.cancelled()

    async def close(self) -> None:
        """Stop the arm and end its process. Harmless when repeated."""
        for task in self._tasks:
            task.cancel()
        if self._child is not None:
            await self._child.end()
        self._child = None

    async def _listen(self, child: Child) -> None:
        try:
            while True:
                match FROM_ARM_HOST.validate_json(await child.receive()):
                    case ArmReady(name=name):
                        self._ready.set_result(name)
                    case ArmFailed(problem=trouble):
                        self._settle(trouble)
                    case ArmStopped():
                        self._confirm()
        except ChildGoneError as error:
            log.warning("arm host: %s", error)
            self._settle(problem("device-lost", f"arm {self._driver.driver!r}: its process ended"))
            for confirmation in self._confirmations:
                confirmation.cancel()

    def _settle(self, trouble: Problem) -> None:
        if not self._ready.done():
            self._ready.set_result(trouble)

    def _confirm(self) -> None:
        for confirmation in self._confirmations:
            if not confirmation.done():
                confirmation.set_result(None)
        self._confirmations.clear()

    async def _beat(self, child: Child) -> None:
        while True:
            child.send(Heartbeat())
            await asyncio.sleep(HEARTBEAT_S)


class WorkerLink:
    """The scan worker as the API sees it; another one is started where it has gone."""

    def __init__(self) -> None:
        self._child: Child | None = None

    @property
    def pid(self) -> int | None:
        """Process id, None where there is none."""
        return None if self._child is None else self._child.pid

    async def open(self) -> None:
        """Start the process and wait until it has loaded what it needs. Raises ChildGoneError."""
        self._child = await Child.start("sidelong_service.worker")
        if not isinstance(await self._next(START_S), WorkerReady):
            raise ChildGoneError("the scan worker did not say that it is ready")

    async def gone(self) -> None:
        """Wait until the process has ended."""
        if self._child is not None:
            await self._child.gone()

    async def check(self, job: CheckJob) -> Problem | None:
        """Return what is wrong with a job. Raises ChildGoneError."""
        self._send(job)
        answer = await self._next(CHECK_S)
        if not isinstance(answer, JobChecked):
            raise ChildGoneError(f"the scan worker answered {answer.kind} to a check")
        return answer.problem

    def run(self, job: RunJob | CalibrateJob) -> None:
        """Start a job; its course comes from ``next``."""
        self._send(job)

    def cancel(self) -> None:
        """Ask the worker to end its job."""
        if self._child is not None:
            self._child.send(CancelJob())

    async def next(self) -> FromWorker:
        """Return the next message of the running job. Raises ChildGoneError."""
        return await self._next(None)

    async def close(self) -> None:
        """End the process. Harmless when repeated."""
        if self._child is not None:
            self._child.kill()
            await self._child.end()
        self._child = None

    def kill(self) -> None:
        """Kill the process; ``next`` then raises."""
        if self._child is not None:
            self._child.kill()

    def _send(self, message: BaseModel) -> None:
        if self._child is None:
            raise ChildGoneError("the scan worker has gone")
        self._child.send(message)

    async def _next(self, timeout_s: float | None) -> FromWorker:
        if self._child is None:
            raise ChildGoneError("the scan worker has gone")
        try:
            return FROM_WORKER.validate_json(await asyncio.wait_for(self._child.receive(), timeout_s))
        except TimeoutError as error:
            raise ChildGoneError(f"the scan worker gave no answer within {timeout_s:g} s") from error
