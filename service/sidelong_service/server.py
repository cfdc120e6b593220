"""Runs the application under uvicorn; a signal stops the arm before anything else.

Port and data directory are taken before any process is started: a second service by mistake must not touch the arm,
nor the scans, of the first.
"""

from __future__ import annotations

import contextlib
import fcntl
import signal
import socket
import sqlite3
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI

from sidelong.errors import SettingsError
from sidelong_service.app import DATABASE, Service, create_app
from sidelong_service.settings import ServiceSettings, check_loopback
from sidelong_service.storage import check_database

DRAIN_S = 1
"""What open connections get to end."""


def serve(settings: ServiceSettings) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises
    ------
    SettingsError
        The address is not a loopback address, the port or the data directory is in use, or the directory or the
        database in it cannot be used.
    """
    check_loopback(settings.host)
    with _listener(settings.host, settings.port) as listener, _own(settings.data_dir):
        _check_database(settings.data_dir / DATABASE)
        _run(settings, listener)


def _run(settings: ServiceSettings, listener: socket.socket) -> None:
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_level="warning",
        timeout_graceful_shutdown=DRAIN_S,
        server_header=False,
    )
    # uvicorn raises the signal once more when it has ended: that is a clean end, not a failure
    signal.signal(signal.SIGTERM, _exit_cleanly)
    with contextlib.suppress(KeyboardInterrupt):
        _Server(config, app).run(sockets=[listener])


def _listener(host: str, port: int) -> socket.socket:
    """Return a socket bound to the address; it listens when the application is there."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
    except OSError as error:
        listener.close()
        raise SettingsError(f"host, port: cannot listen on {host} port {port}: {error.strerror}") from error
    return listener


@contextmanager
def _own(data_dir: Path) -> Generator[None]:
    """Keep other services out of the data directory; the lock ends with this process, however it ends."""
    try:
        data_dir.mkdir(parents=True, exist_ok=True)
        lock = (data_dir / ".lock").open("ab")
    except OSError as error:
        raise SettingsError(f"data_dir: {data_dir} cannot be written: {error.strerror}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SettingsError(f"data_dir: {data_dir} is in use by another service") from error
        yield


def _check_database(file: Path) -> None:
    try:
        check_database(file)
    except (OSError, sqlite3.Error) as error:
        raise SettingsError(
            f"data_dir: the database {file} cannot be used: {error}; moved away, a new one is made, the files stay"
        ) from error


def _exit_cleanly(_sig: int, _frame: FrameType | None) -> None:
    sys.exit(0)


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        service: Service | None = getattr(self._app.state, "service", None)
        if service is not None:
            service.loop.call_soon_threadsafe(service.supervisor.begin_closing)
        super().handle_exit(sig, frame)
