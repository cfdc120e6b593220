"""The process that owns the arm: the vendor's client may freeze or kill it without taking the service along.

Two threads. The main one listens to the API, whose ``stop`` goes to the driver at once, whatever the other thread
waits for. The other one owns the driver: it opens it, answers the scan worker, and closes it. The arm is stopped when
the API asks for it, when its heartbeats stop, and when it has gone.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path

from pydantic import ValidationError

from sidelong.devices import Arm
from sidelong.errors import MotionRefusedError, MotionStoppedError, SidelongError
from sidelong.geometry.transforms import validated_transform
from sidelong.types import FloatArray
from sidelong_service.lines import Lines
from sidelong_service.messages import (
    HEARTBEAT_LOST_S,
    TO_ARM_HOST,
    ArmAnswer,
    ArmCall,
    ArmFailed,
    ArmReading,
    ArmReady,
    ArmStopped,
    ErrorReport,
    Heartbeat,
    ReleaseArm,
    StopArm,
)
from sidelong_service.problems import problem_of
from sidelong_service.settings import DriverSettings

log = logging.getLogger(__name__)

STOP_AGAIN_S = 0.02
"""A move that began while the stop came is stopped again after this time, until it has ended."""
CLOSING_S = 1.0
"""What the driver gets to end a move and to close."""
_POLL_S = 0.1


class ArmHost:
    """Serves one arm to one scan worker at a time, under the eye of the API."""

    def __init__(self, arm: Arm, control: Lines, listener: socket.socket) -> None:
        self._arm = arm
        self._control = control
        self._listener = listener
        self._gate = threading.Lock()
        self._refusing = False
        self._moving = False
        self._closing = threading.Event()

    def run(self) -> bool:
        """Serve until the API goes; return whether the driver was closed in time."""
        owner = threading.Thread(target=self._own_arm, name="arm", daemon=True)
        owner.start()
        self._watch()
        self._closing.set()
        deadline_s = time.monotonic() + CLOSING_S
        while owner.is_alive() and time.monotonic() < deadline_s:
            self._stop()
            owner.join(STOP_AGAIN_S)
        return not owner.is_alive()

    def _watch(self) -> None:
        """Listen to the API until it goes. A late heartbeat and a move that outlasts a stop are both stopped."""
        while True:
            try:
                line = self._control.receive(STOP_AGAIN_S if self._refusing and self._moving else HEARTBEAT_LOST_S)
            except TimeoutError:
                self._stop()
                continue
            except EOFError:
                return
            match TO_ARM_HOST.validate_json(line):
                case StopArm():
                    self._stop()
                    self._control.send(ArmStopped())
                case ReleaseArm():
                    with self._gate:
                        self._refusing = False
                case Heartbeat():
                    pass

    def _stop(self) -> None:
        with self._gate:
            self._refusing = True
        self._arm.stop()

    def _own_arm(self) -> None:
        try:
            self._arm.open()
            self._tell(ArmReady(name=self._arm.name))
            while not self._closing.is_set():
                self._serve_next_worker()
        except SidelongError as error:
            self._tell(ArmFailed(problem=problem_of(error)))
        finally:
            self._arm.close()
            self._control.end()

    def _tell(self, message: ArmReady | ArmFailed) -> None:
        # where the API went meanwhile, the main thread hears of it
        with contextlib.suppress(OSError):
            self._control.send(message)

    def _serve_next_worker(self) -> None:
        self._listener.settimeout(_POLL_S)
        try:
            connection, _ = self._listener.accept()
        except TimeoutError:
            return
        worker = Lines(connection)
        try:
            while not self._closing.is_set():
                try:
                    call = ArmCall.model_validate_json(worker.receive(_POLL_S))
                except TimeoutError:
                    continue
                worker.send(self._answer(call))
        except (EOFError, OSError, ValidationError) as error:
            log.info("the scan worker has gone: %s", error)
        finally:
            worker.close()

    def _answer(self, call: ArmCall) -> ArmAnswer:
        try:
            if call.call == "state":
                return ArmAnswer(reading=ArmReading.of(self._arm.state()))
            target = validated_transform(call.pose or (), f"{self._arm.name}: target base_T_flange")
            if call.call == "unreachable":
                return ArmAnswer(reason=self._arm.unreachable(target))
            return ArmAnswer(reading=self._move(target, call.deadline_s or 0.0))
        except SidelongError as error:
            return ArmAnswer(error=ErrorReport.of(error))

    def _move(self, target: FloatArray, deadline_s: float) -> ArmReading:
        """Move, after checking the target once more: the worker's word is not enough."""
        reason = self._arm.unreachable(target)
        if reason is not None:
            raise MotionRefusedError(self._arm.name, reason)
        with self._gate:
            if self._refusing:
                raise MotionStoppedError(self._arm.name, "is stopped; no move before the next scan")
            self._moving = True
        try:
            return ArmReading.of(self._arm.move(target, deadline_s))
        finally:
            self._moving = False


def main() -> None:
    """Run as ``python -m sidelong_service.arm_host DESCRIPTOR SOCKET DRIVER_JSON``."""
    from sidelong_drivers.registry import create_arm

    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s")
    control = Lines(socket.socket(fileno=int(sys.argv[1])))
    # Ctrl-C is for the API, which ends this process in its turn; a SIGTERM of its own stops the arm first
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda _sig, _frame: control.end())
    driver = DriverSettings.model_validate_json(sys.argv[3])
    try:
        arm = create_arm(driver.driver, driver.settings)
    except SidelongError as error:
        control.send(ArmFailed(problem=problem_of(error)))
        return
    with socket.socket(socket.AF_UNIX) as listener:
        path = Path(sys.argv[2])
        listener.bind(str(path))
        listener.listen(1)
        closed = ArmHost(arm, control, listener).run()
        path.unlink(missing_ok=True)
    if not closed:
        log.error("%s: its driver did not close within %g s", arm.name, CLOSING_S)
        os._exit(1)


if __name__ == "__main__":
    main()
