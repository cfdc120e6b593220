"""The demonstration: a service in a process of its own, one scan over HTTP, the pictures in a folder."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import yaml

from sidelong_service.artifacts import write_whole
from sidelong_service.client import ClientError, SidelongClient

READY_S = 60.0
EXIT_S = 5.0


@contextmanager
def running_service(data_dir: Path, part: str) -> Generator[SidelongClient]:
    """Run a service on a free loopback port, as long as the ``with`` block lasts; its simulated bin holds one part.

    Raises
    ------
    ClientError
        It did not become ready.
    """
    port = _free_port()
    cell = {"camera": {"driver": "simulated", "settings": {"part": part}}, "parts": [part]}
    config = data_dir / "config.yaml"
    write_whole(config, yaml.safe_dump({"data_dir": str(data_dir), "cell": cell}).encode())
    process = subprocess.Popen(
        [sys.executable, "-m", "sidelong_service", "serve", "--port", str(port), "--config", str(config)],
        # Ctrl-C is for the demonstration, which stops the scan and then the service
        start_new_session=True,
    )
    try:
        with SidelongClient(f"http://127.0.0.1:{port}") as client:
            client.wait_until_ready(READY_S)
            yield client
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        code = process.wait(EXIT_S)
    except subprocess.TimeoutExpired as error:
        process.kill()
        process.wait()
        raise ClientError(f"the service did not end within {EXIT_S:g} s of SIGTERM") from error
    if code != 0:
        raise ClientError(f"the service ended with code {code}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
