"""Somebody wants the arm to stand still, now."""

from __future__ import annotations

import time

from service_process import QUICK_SCAN, ServiceProcess

STOP_S = 1.0


def start(service: ServiceProcess) -> str:
    return service.http.post("/v1/scans", json=QUICK_SCAN).raise_for_status().json()["id"]


def stop(service: ServiceProcess) -> tuple[float, dict[str, object]]:
    started_s = time.monotonic()
    answer = service.http.post("/v1/cell/stop").raise_for_status()
    return time.monotonic() - started_s, answer.json()


def test_stop_during_a_move_is_confirmed_at_once_and_ends_the_scan(slow_service: ServiceProcess) -> None:
    scan_id = start(slow_service)
    slow_service.wait_for(scan_id, "phase", phase="move")
    took_s, report = stop(slow_service)
    assert took_s < STOP_S
    assert report == {"stopped": True, "scan": scan_id}
    asked_s = time.monotonic()
    ended = slow_service.ended(scan_id)
    assert time.monotonic() - asked_s < 5.0
    assert (ended["state"], ended["problem"], ended["views"]) == ("stopped", None, [])


def test_stop_in_a_later_move_keeps_the_views_that_were_taken(slow_service: ServiceProcess) -> None:
    scan_id = start(slow_service)
    slow_service.wait_for(scan_id, "phase", phase="move", count=2)
    stop(slow_service)
    ended = slow_service.ended(scan_id)
    assert ended["state"] == "stopped"
    assert [view["index"] for view in ended["views"]] == [0]
    names = {artifact["name"] for artifact in ended["artifacts"]}
    assert {"view_00.npz", "depth.npz", "cloud.ply", "report.json", "picture.png"} <= names
    report = slow_service.http.get(f"/v1/scans/{scan_id}/artifacts/report.json").json()
    assert report["finish_reason"] is None


def test_stop_while_computing_ends_the_scan_before_the_next_move(slow_service: ServiceProcess) -> None:
    scan_id = start(slow_service)
    slow_service.wait_for(scan_id, "phase", phase="detect")
    took_s, _ = stop(slow_service)
    assert took_s < STOP_S
    assert slow_service.ended(scan_id)["state"] == "stopped"
    moves = [e for e in slow_service.client.events(scan_id) if e.kind == "phase" and e.data["phase"] == "move"]
    assert len(moves) == 1


def test_stop_right_after_the_start_is_not_lost(slow_service: ServiceProcess) -> None:
    scan_id = start(slow_service)
    stop(slow_service)
    assert slow_service.ended(scan_id)["state"] == "stopped"


def test_stop_may_be_repeated_and_needs_no_scan(slow_service: ServiceProcess) -> None:
    for _ in range(3):
        took_s, report = stop(slow_service)
        assert took_s < STOP_S
        assert report == {"stopped": True, "scan": None}


def test_stop_twice_during_one_scan_is_one_stop(slow_service: ServiceProcess) -> None:
    scan_id = start(slow_service)
    slow_service.wait_for(scan_id, "phase", phase="move")
    stop(slow_service)
    stop(slow_service)
    slow_service.ended(scan_id)
    states = [event.data["state"] for event in slow_service.client.events(scan_id) if event.kind == "state"]
    assert states == ["accepted", "running", "stopping", "stopped"]


def test_after_a_stop_the_next_scan_moves_again(slow_service: ServiceProcess) -> None:
    stop(slow_service)
    scan_id = start(slow_service)
    slow_service.wait_for(scan_id, "phase", phase="capture")
    stop(slow_service)
    assert slow_service.ended(scan_id)["state"] == "stopped"
