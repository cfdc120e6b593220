"""The service as a process: who may start it, what it survives, and how it ends."""

from __future__ import annotations

import signal
import socket
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from service_process import QUICK_SCAN, ServiceProcess, free_port, small_cell, wait_until_gone

RESET_ON_CLOSE = struct.pack("ii", 1, 0)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service whose log shows no trace of an error in the end."""
    running = ServiceProcess(tmp_path_factory.mktemp("server"), small_cell())
    yield running
    running.terminate()
    assert running.process.stderr is not None
    log = running.process.stderr.read()
    running.close()
    assert "Traceback" not in log, log


def start(service: ServiceProcess) -> str:
    return service.http.post("/v1/scans", json=QUICK_SCAN).raise_for_status().json()["id"]


def serve(*options: str) -> subprocess.CompletedProcess[str]:
    """Start another service that is expected to end by itself."""
    command = [sys.executable, "-m", "sidelong_service", "serve", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def connected(service: ServiceProcess, content: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", service.port), timeout=30)
    connection.sendall(content)
    return connection


def request(method: str, path: str, body: bytes = b"", length: int | None = None) -> bytes:
    head = f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    return f"{head}Content-Length: {len(body) if length is None else length}\r\n\r\n".encode() + body


# --- clients ---


def test_of_many_requests_at_once_one_is_accepted_and_the_others_are_told_which(service: ServiceProcess) -> None:
    def post(_: int) -> httpx.Response:
        return httpx.post(f"{service.url}/v1/scans", json=QUICK_SCAN, timeout=30)

    with ThreadPoolExecutor(16) as clients:
        answers = list(clients.map(post, range(16)))
    (accepted,) = [answer for answer in answers if answer.status_code == 202]
    refused = [answer for answer in answers if answer is not accepted]
    assert {answer.status_code for answer in refused} == {409}
    assert {answer.json()["type"] for answer in refused} == {"urn:sidelong:problem:cell-busy"}
    assert {answer.json()["scan_id"] for answer in refused} == {accepted.json()["id"]}
    assert service.ended(accepted.json()["id"])["state"] == "succeeded"


def test_many_requests_for_what_is_not_there_are_all_told_so(service: ServiceProcess) -> None:
    def post(_: int) -> httpx.Response:
        return httpx.post(f"{service.url}/v1/scans", json={"part": "nonesuch"}, timeout=30)

    with ThreadPoolExecutor(8) as clients:
        answers = list(clients.map(post, range(24)))
    assert {answer.json()["type"] for answer in answers} == {"urn:sidelong:problem:unknown-name"}
    assert service.http.get("/v1/cell").json()["may_start"] is True


def test_a_hundred_readers_of_one_scan_all_see_its_end_and_do_not_hold_up_a_stop(service: ServiceProcess) -> None:
    scan_id = start(service)
    readers = [connected(service, request("GET", f"/v1/scans/{scan_id}/events")) for _ in range(100)]
    service.wait_for(scan_id, "phase", phase="detect")
    started_s = time.monotonic()
    service.http.post("/v1/cell/stop").raise_for_status()
    assert time.monotonic() - started_s < 2.0
    assert service.ended(scan_id)["state"] == "stopped"
    for reader in readers:
        received = b""
        while b'"state": "stopped"' not in received:
            chunk = reader.recv(65536)
            assert chunk, received[-300:]
            received += chunk
        reader.close()


def test_clients_that_vanish_do_no_harm(service: ServiceProcess) -> None:
    connected(service, request("POST", "/v1/scans", b'{"part":', length=1000)).close()
    body = str(QUICK_SCAN).replace("'", '"').encode()
    connected(service, request("POST", "/v1/scans", body)).close()
    deadline_s = time.monotonic() + 20
    while (scan_id := service.http.get("/v1/cell").json()["active_scan"]) is None:
        assert time.monotonic() < deadline_s
    for _ in range(30):
        reader = connected(service, request("GET", f"/v1/scans/{scan_id}/events"))
        reader.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
        reader.close()
    assert service.ended(scan_id)["state"] == "succeeded"
    connected(service, b"\x16\x03\x01 not HTTP at all \r\n\r\n").close()
    assert service.http.get("/v1/cell").json()["may_start"] is True


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="needs Linux")
def test_the_api_process_has_no_library_that_may_hold_up_its_loop(service: ServiceProcess) -> None:
    assert service.run_quick_scan()["state"] == "succeeded"
    maps = Path(f"/proc/{service.process.pid}/maps").read_text()
    assert "sqlite" in maps
    assert not any(name in maps for name in ("open3d", "cv2", "rtde", "matplotlib"))
    (worker,) = service.children("sidelong_service.worker")
    assert "open3d" in Path(f"/proc/{worker}/maps").read_text()


# --- starting ---


def test_a_second_service_is_refused_and_does_not_touch_the_scan_of_the_first(
    service: ServiceProcess, tmp_path: Path
) -> None:
    scan_id = start(service)
    same_port = serve("--port", str(service.port), "--data", str(tmp_path / "other"))
    same_data = serve("--port", str(free_port()), "--data", str(service.data))
    assert (same_port.returncode, same_data.returncode) == (1, 1)
    assert f"port {service.port}: Address already in use" in same_port.stderr
    assert "is in use by another service" in same_data.stderr
    assert "Traceback" not in same_port.stderr + same_data.stderr
    assert not (tmp_path / "other").exists()
    assert service.ended(scan_id)["state"] == "succeeded"


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "example.com"])
def test_a_host_beyond_this_machine_is_refused(tmp_path: Path, host: str) -> None:
    ended = serve("--host", host, "--port", str(free_port()), "--data", str(tmp_path / "data"))
    assert ended.returncode == 1
    assert f"'{host}' is not a loopback address" in ended.stderr
    assert not (tmp_path / "data").exists()


def test_a_data_directory_that_cannot_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    ended = serve("--port", str(free_port()), "--data", str(tmp_path / "file" / "data"))
    assert ended.returncode == 1
    assert "data_dir" in ended.stderr
    assert "Not a directory" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_damaged_database_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "sidelong.sqlite"
    file.write_bytes(b"\x00garbage" * 1000)
    ended = serve("--port", str(free_port()), "--data", str(tmp_path))
    assert ended.returncode == 1
    assert str(file) in ended.stderr.replace("\n", "")
    assert "not a database" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert file.read_bytes() == b"\x00garbage" * 1000


# --- trouble while it runs ---


def test_a_service_killed_after_a_view_has_it_after_the_restart_and_nothing_moves(tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path, small_cell(arm_speed_factor=3))
    scan_id = start(service)
    service.wait_for(scan_id, "phase", phase="move", count=2)
    children = service.children("sidelong_service.worker") + service.children("sidelong_service.arm_host")
    service.process.kill()
    service.process.communicate()
    assert all(wait_until_gone(child, 3.0) for child in children)
    service.start()
    left = service.http.get(f"/v1/scans/{scan_id}").json()
    assert (left["state"], [view["index"] for view in left["views"]]) == ("interrupted", [0])
    (artifact,) = left["artifacts"]
    content = service.http.get(f"/v1/scans/{scan_id}/artifacts/{artifact['name']}").raise_for_status().content
    assert len(content) == artifact["size_bytes"]
    cell = service.http.get("/v1/cell").json()
    assert (cell["state"], cell["may_start"], cell["active_scan"]) == ("idle", True, None)
    events = list(service.client.events(scan_id))
    time.sleep(0.5)
    assert list(service.client.events(scan_id)) == events
    # and Ctrl-C is a clean end
    children = service.children("sidelong_service.worker") + service.children("sidelong_service.arm_host")
    service.process.send_signal(signal.SIGINT)
    assert service.process.wait(10) == 0
    assert all(wait_until_gone(child, 1.0) for child in children)
    service.close()


def test_a_scan_whose_course_cannot_be_stored_is_ended_and_not_left_to_itself(tmp_path: Path) -> None:
    service = ServiceProcess(tmp_path, small_cell(arm_speed_factor=3))
    scan_id = start(service)
    service.wait_for(scan_id, "phase", phase="move")
    (worker,) = service.children("sidelong_service.worker")
    with closing(sqlite3.connect(service.data / "sidelong.sqlite", isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert service.http.post("/v1/scans", json=QUICK_SCAN).status_code == 409
        assert service.http.get("/livez").status_code == 200
        assert wait_until_gone(worker, 30.0)
        other.execute("ROLLBACK")
    ended = service.ended(scan_id)
    assert (ended["state"], ended["problem"]["type"]) == ("failed", "urn:sidelong:problem:storage")
    service.client.wait_until_ready(30)
    assert service.http.get("/v1/cell").json()["may_start"] is True
    following = start(service)
    service.wait_for(following, "phase", phase="capture")
    service.http.post("/v1/cell/stop").raise_for_status()
    assert service.ended(following)["state"] == "stopped"
    service.close()
