"""The arm as the scan worker sees it: a ``sidelong.devices.Arm`` that lives in the arm host."""

from __future__ import annotations

import socket
from pathlib import Path

from sidelong.devices import ArmState
from sidelong.errors import DeviceLostError, DeviceTimeoutError, DeviceUnavailableError
from sidelong.types import FloatArray
from sidelong_service.lines import Lines
from sidelong_service.messages import ArmAnswer, ArmCall, ArmReading, flat

CALL_S = 5.0
"""Deadline of a call that moves nothing, and what a move may take beyond its own deadline."""


class RemoteArm:
    """Forwards each call to the arm host and raises what the driver raised there."""

    def __init__(self, name: str, path: Path) -> None:
        self._name = name
        self._path = path
        self._host: Lines | None = None

    @property
    def name(self) -> str:
        """The arm's name in messages."""
        return self._name

    def open(self) -> None:
        """Connect to the host. Raises DeviceUnavailableError."""
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(str(self._path))
        except OSError as error:
            connection.close()
            raise DeviceUnavailableError(self._name, f"its process does not answer: {error.strerror}") from error
        self._host = Lines(connection)

    def close(self) -> None:
        """Disconnect; the arm stays with its host. Harmless when repeated."""
        if self._host is not None:
            self._host.close()
        self._host = None

    def state(self) -> ArmState:
        """Read the arm now."""
        return self._reading(ArmCall(call="state"), CALL_S).state()

    def unreachable(self, base_T_flange: FloatArray) -> str | None:
        """Say why this pose cannot be reached; None where it can."""
        return self._ask(ArmCall(call="unreachable", pose=flat(base_T_flange)), CALL_S).reason

    def move(self, base_T_flange: FloatArray, deadline_s: float) -> ArmState:
        """Move there, wait until the arm rests, and return a new reading."""
        call = ArmCall(call="move", pose=flat(base_T_flange), deadline_s=deadline_s)
        return self._reading(call, deadline_s + CALL_S).state()

    def stop(self) -> None:
        """Drop the connection; stopping is for the API, which has a channel of its own to the host."""
        self.close()

    def _reading(self, call: ArmCall, timeout_s: float) -> ArmReading:
        reading = self._ask(call, timeout_s).reading
        if reading is None:
            raise DeviceLostError(self._name, f"its process answered {call.call} without a reading")
        return reading

    def _ask(self, call: ArmCall, timeout_s: float) -> ArmAnswer:
        if self._host is None:
            raise DeviceUnavailableError(self._name, "is not open")
        try:
            self._host.send(call)
            answer = ArmAnswer.model_validate_json(self._host.receive(timeout_s))
        except TimeoutError as error:
            # a late answer would be taken for that of the next call
            self.close()
            raise DeviceTimeoutError(self._name, f"its process gave no answer within {timeout_s:g} s") from error
        except (EOFError, OSError) as error:
            self.close()
            raise DeviceLostError(self._name, f"its process ended during {call.call}") from error
        if answer.error is not None:
            raise answer.error.error()
        return answer
