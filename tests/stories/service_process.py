"""A service as its users meet it: a process of its own, a port, a data directory."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import yaml

from sidelong_service.client import SidelongClient

QUICK_RECIPE = {
    "detection": {
        "view_step_deg": 40,
        "roll_step_deg": 30,
        "distance_m": [0.6, 0.75],
        "hypotheses_per_object": 3,
    },
    "planning": {"max_views": 2},
}
QUICK_SCAN = {"part": "tube_fitting", "recipe": QUICK_RECIPE}


def small_cell(arm_speed_factor: float = 50.0) -> dict[str, Any]:
    return {
        "camera": {"driver": "simulated", "settings": {"width": 320, "height": 256, "count": 4}},
        "arm": {"driver": "mock", "settings": {"speed_factor": arm_speed_factor}},
        "dome": {"azimuths": 4, "elevations_deg": [70]},
    }


class ServiceProcess:
    """``sidelong serve`` with a small simulated cell; templates are shared, as training them is not what is tested."""

    def __init__(self, folder: Path, cell: dict[str, Any], **settings: Any) -> None:
        self.data = folder / "data"
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.config = folder / "config.yaml"
        folder.mkdir(parents=True, exist_ok=True)
        self.config.write_text(yaml.safe_dump({"data_dir": str(self.data), "cell": cell, **settings}))
        self.http = httpx.Client(base_url=self.url, timeout=60)
        self.client = SidelongClient(self.url)
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-m", "sidelong_service", "serve", "--config", str(self.config)]
        self.process = subprocess.Popen([*command, "--port", str(self.port)], stderr=subprocess.PIPE, text=True)
        self.client.wait_until_ready(60)

    def children(self, module: str) -> list[int]:
        """Return the ids of the service's children that run a module."""
        return [pid for pid, parent, command in processes() if parent == self.process.pid and module in command]

    def run_quick_scan(self) -> dict[str, Any]:
        """Run a scan to its end and return it."""
        scan_id = self.http.post("/v1/scans", json=QUICK_SCAN).raise_for_status().json()["id"]
        return self.ended(scan_id)

    def ended(self, scan_id: str) -> dict[str, Any]:
        """Wait for the end of a scan and return it."""
        for _ in self.client.events(scan_id):
            pass
        return self.http.get(f"/v1/scans/{scan_id}").raise_for_status().json()

    def wait_for(self, scan_id: str, kind: str, count: int = 1, **data: Any) -> None:
        """Return at the count-th event of a kind with these data."""
        for event in self.client.events(scan_id):
            if event.kind == kind and data.items() <= event.data.items():
                count -= 1
            if count == 0:
                return
        raise AssertionError(f"the scan ended before {kind} {data}")

    def terminate(self) -> float:
        """End the service with SIGTERM and return how long that took, in seconds."""
        started_s = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(10) == 0
        return time.monotonic() - started_s

    def close(self) -> None:
        self.http.close()
        self.client.close()
        if self.process.poll() is None:
            self.terminate()
        assert self.process.stderr is not None
        self.process.stderr.close()


def processes() -> list[tuple[int, int, str]]:
    """Return id, parent's id and command of all processes."""
    listing = subprocess.run(["ps", "-A", "-ww", "-o", "pid=,ppid=,args="], capture_output=True, text=True, check=True)
    rows = [line.split(None, 2) for line in listing.stdout.splitlines()]
    return [(int(row[0]), int(row[1]), row[2]) for row in rows if len(row) == 3]


def wait_until_gone(pid: int, timeout_s: float) -> bool:
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
