"""Processes die at the worst moment; the service says so and goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
from service_process import QUICK_SCAN, ServiceProcess, small_cell, wait_until_gone


def start(service: ServiceProcess) -> str:
    return service.http.post("/v1/scans", json=QUICK_SCAN).raise_for_status().json()["id"]


def test_worker_killed_in_a_scan_leaves_it_interrupted_and_the_next_one_works(service: ServiceProcess) -> None:
    scan_id = start(service)
    service.wait_for(scan_id, "view")
    (worker,) = service.children("sidelong_service.worker")
    os.kill(worker, signal.SIGKILL)
    ended = service.ended(scan_id)
    assert ended["state"] == "interrupted"
    assert ended["problem"]["type"] == "urn:sidelong:problem:worker-died"
    assert ended["problem"]["retryable"] is True
    assert ended["views"][0]["index"] == 0
    assert "view_00.npz" in {artifact["name"] for artifact in ended["artifacts"]}
    service.client.wait_until_ready(20)
    assert service.run_quick_scan()["state"] == "succeeded"


def test_arm_host_killed_in_a_scan_fails_it_and_the_next_one_works(service: ServiceProcess) -> None:
    scan_id = start(service)
    service.wait_for(scan_id, "phase", phase="detect")
    (host,) = service.children("sidelong_service.arm_host")
    os.kill(host, signal.SIGKILL)
    ended = service.ended(scan_id)
    assert ended["state"] == "failed"
    assert ended["problem"]["type"] == "urn:sidelong:problem:device-lost"
    assert ended["problem"]["device"] == "mock arm"
    service.client.wait_until_ready(20)
    assert service.run_quick_scan()["state"] == "succeeded"


def test_stop_that_nobody_confirms_says_so(service: ServiceProcess) -> None:
    (host,) = service.children("sidelong_service.arm_host")
    os.kill(host, signal.SIGSTOP)
    try:
        answer = service.http.post("/v1/cell/stop")
    finally:
        os.kill(host, signal.SIGCONT)
    assert answer.status_code == 504
    assert answer.json()["type"] == "urn:sidelong:problem:stop-unconfirmed"
    assert answer.json()["operator_action"] == "Press the emergency stop."
    assert service.http.post("/v1/cell/stop").status_code == 200


def test_children_end_when_the_service_is_killed_and_a_restart_marks_the_scan(tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path, small_cell(arm_speed_factor=0.5))
    scan_id = start(service)
    service.wait_for(scan_id, "phase", phase="move")
    children = service.children("sidelong_service.worker") + service.children("sidelong_service.arm_host")
    assert len(children) == 2
    service.process.kill()
    service.process.communicate()
    assert all(wait_until_gone(child, 3.0) for child in children)
    service.start()
    left = service.http.get(f"/v1/scans/{scan_id}").json()
    assert left["state"] == "interrupted"
    assert left["problem"]["type"] == "urn:sidelong:problem:service-restarted"
    assert service.http.get("/v1/cell").json()["active_scan"] is None
    service.close()


def test_sigterm_stops_the_arm_and_ends_with_open_streams_within_seconds(tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path, small_cell(arm_speed_factor=0.5))
    scan_id = start(service)
    service.wait_for(scan_id, "phase", phase="move")
    opened = threading.Barrier(5)

    def listen() -> None:
        with httpx.stream("GET", f"{service.url}/v1/scans/{scan_id}/events", timeout=30) as response:
            opened.wait()
            for _ in response.iter_raw():
                pass

    listeners = [threading.Thread(target=listen) for _ in range(4)]
    for listener in listeners:
        listener.start()
    opened.wait()
    children = service.children("sidelong_service.worker") + service.children("sidelong_service.arm_host")
    took_s = service.terminate()
    for listener in listeners:
        listener.join()
    assert took_s < 5.0
    assert all(wait_until_gone(child, 1.0) for child in children)
    service.close()


def test_an_arm_that_does_not_exist_is_a_reason_and_not_a_crash(tmp_path: Path) -> None:
    cell = small_cell() | {"arm": {"driver": "nonesuch"}}
    config = tmp_path / "config.yaml"
    service = _started_without_waiting(tmp_path, cell, config)
    try:
        refused = _when_settled(service)
        assert refused.status_code == 503
        assert "nonesuch" in refused.json()["detail"]
        assert refused.headers["Retry-After"] == "1"
        cell_report = httpx.get(f"{service[1]}/v1/cell").json()
        assert (cell_report["state"], cell_report["may_start"]) == ("fault", False)
    finally:
        service[0].send_signal(signal.SIGTERM)
        assert service[0].wait(10) == 0


def _started_without_waiting(
    folder: Path, cell: dict[str, object], config: Path
) -> tuple[subprocess.Popen[bytes], str]:  # fmt: skip
    import yaml
    from service_process import free_port

    config.write_text(yaml.safe_dump({"data_dir": str(folder / "data"), "cell": cell}))
    port = free_port()
    command = [sys.executable, "-m", "sidelong_service", "serve", "--config", str(config), "--port", str(port)]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL), f"http://127.0.0.1:{port}"


def _when_settled(service: tuple[subprocess.Popen[bytes], str]) -> httpx.Response:
    """Ask for a scan until nothing is starting any more."""
    deadline_s = time.monotonic() + 30
    while time.monotonic() < deadline_s:
        try:
            answer = httpx.post(f"{service[1]}/v1/scans", json=QUICK_SCAN)
        except httpx.ConnectError:
            time.sleep(0.1)
            continue
        if "is starting" not in answer.text:
            return answer
        time.sleep(0.1)
    raise AssertionError("the service did not settle")
