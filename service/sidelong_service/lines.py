"""Messages between the processes: one JSON object a line, over a connected socket."""

from __future__ import annotations

import select
import socket
import threading

from pydantic import BaseModel

LONGEST_LINE = 16 * 1024 * 1024
_CHUNK = 65536


def encode(message: BaseModel) -> bytes:
    """Return a message as a line."""
    return message.model_dump_json().encode() + b"\n"


class Lines:
    """The blocking side of a channel; one thread receives, any thread sends."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._buffer = bytearray()
        self._sending = threading.Lock()

    def send(self, message: BaseModel) -> None:
        """Send a message. Raises OSError where the other side has gone."""
        with self._sending:
            self._socket.sendall(encode(message))

    def receive(self, timeout_s: float | None = None) -> bytes:
        """Wait for the next line.

        Raises
        ------
        TimeoutError
            None came in time; what has come of it is kept for the next call.
        EOFError
            The other side has gone.
        """
        while True:
            end = self._buffer.find(b"\n")
            if end >= 0:
                line = bytes(self._buffer[:end])
                del self._buffer[: end + 1]
                return line
            if not select.select([self._socket], [], [], timeout_s)[0]:
                raise TimeoutError(f"no message within {timeout_s:g} s")
            try:
                chunk = self._socket.recv(_CHUNK)
            except ConnectionError as error:
                raise EOFError("the other process has gone") from error
            if not chunk or len(self._buffer) > LONGEST_LINE:
                raise EOFError("the other process has gone")
            self._buffer += chunk

    def end(self) -> None:
        """Wake the receiver: it gets an EOFError."""
        self._socket.shutdown(socket.SHUT_RD)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
