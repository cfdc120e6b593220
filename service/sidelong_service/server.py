"""Runs the application under uvicorn; a signal stops the arm before anything else."""

from __future__ import annotations

import contextlib
import signal
import sys
from types import FrameType

import uvicorn
from fastapi import FastAPI

from sidelong_service.app import Service, create_app
from sidelong_service.settings import ServiceSettings, check_loopback

DRAIN_S = 1
"""What open connections get to end."""


def serve(settings: ServiceSettings) -> None:
    """Serve until SIGINT or SIGTERM.

    Raises
    ------
    SettingsError
        The address is not a loopback address.
    """
    check_loopback(settings.host)
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
        _Server(config, app).run()


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
