"""A cell controller runs a scan over HTTP and reads everything back."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from service_process import QUICK_SCAN, ServiceProcess

from sidelong_service.models import ViewReport


@pytest.fixture(scope="module")
def ended(service: ServiceProcess) -> dict[str, Any]:
    """A scan that has run to its end."""
    return service.run_quick_scan()


def read(service: ServiceProcess, scan: dict[str, Any], name: str) -> bytes:
    return service.http.get(f"/v1/scans/{scan['id']}/artifacts/{name}").raise_for_status().content


def test_scan_is_accepted_with_its_location_and_runs_by_itself(service: ServiceProcess) -> None:
    answer = service.http.post("/v1/scans", json=QUICK_SCAN)
    assert answer.status_code == 202
    assert answer.headers["Location"] == f"/v1/scans/{answer.json()['id']}"
    assert answer.json()["state"] == "accepted"
    assert answer.json()["recipe"]["planning"]["max_views"] == 2
    ended = service.ended(answer.json()["id"])
    assert ended["state"] == "succeeded"
    assert ended["created_at"] <= ended["started_at"] <= ended["ended_at"]


def test_each_view_tells_its_gains_its_times_and_why_others_were_not_taken(ended: dict[str, Any]) -> None:
    views = ended["views"]
    assert ended["finish_reason"] == "max_views"
    assert [view["index"] for view in views] == [0, 1, 2]
    assert views[0]["missing_px"] > 100
    for before, after in itertools.pairwise(views):
        assert 0 <= after["measured_gain_px"] <= before["missing_px"] - before["recovered_px"]
        taken = max(before["candidates"], key=lambda candidate: candidate["gain_px"])
        assert (after["view"], after["predicted_gain_px"]) == (taken["view"], taken["gain_px"])
        still_missing_px = before["missing_px"] - before["recovered_px"]
        assert taken["gain_share"] == pytest.approx(taken["gain_px"] / still_missing_px)
        dropped = {c["view"]: c["dropped"] for c in before["candidates"] if c["dropped"]}
        assert dropped[before["view"]] == "already taken"
        assert {"move", "capture", "fuse"} <= after["stage_s"].keys()
    assert views[-1]["completeness"] == pytest.approx(views[-1]["recovered_px"] / views[-1]["missing_px"])
    assert any("inter-reflection" in term for term in ended["setup"]["left_out"])


def test_what_was_promised_of_each_view_stands_beside_what_it_gave(
    service: ServiceProcess, ended: dict[str, Any]
) -> None:
    views, told = ended["views"][1:], json.loads(read(service, ended, "report.json"))["reliability"]
    assert told["views"] == len(views)
    assert told["predicted_px"] == pytest.approx(sum(view["predicted_gain_px"] for view in views))
    assert told["measured_px"] > 0
    assert sum(each["pixels"] for each in told["bins"]) >= told["predicted_px"]
    assert read(service, ended, "reliability.png").startswith(b"\x89PNG")


def test_files_have_the_checksums_and_sizes_that_are_listed(service: ServiceProcess, ended: dict[str, Any]) -> None:
    listed = service.http.get(f"/v1/scans/{ended['id']}/artifacts").json()["artifacts"]
    assert listed == ended["artifacts"]
    names = {"depth.png", "sigma.png", "state.png", "depth.npz", "cloud.ply", "mesh.ply", "poses.json", "report.json"}
    names |= {"poses.png", "picture.png", "reliability.png"}
    assert {artifact["name"] for artifact in listed} == names | {"view_00.npz", "view_01.npz", "view_02.npz"}
    for artifact in listed:
        answer = service.http.get(f"/v1/scans/{ended['id']}/artifacts/{artifact['name']}")
        assert answer.headers["Content-Type"] == artifact["media_type"]
        assert len(answer.content) == artifact["size_bytes"]
        assert hashlib.sha256(answer.content).hexdigest() == artifact["sha256"]
        assert answer.headers["ETag"] == f'"{artifact["sha256"]}"'


TRUSTED = ("measured", "completed")


def in_states(arrays: Any, *names: str) -> Any:
    """Return which pixels (H, W) of a ``depth.npz`` are in one of the states, by the names it brings along."""
    return np.isin(arrays["states"][arrays["state"]], names)


def pixels(service: ServiceProcess, scan: dict[str, Any], name: str) -> Any:
    return cv2.imdecode(np.frombuffer(read(service, scan, name), np.uint8), cv2.IMREAD_UNCHANGED)


def test_pictures_and_arrays_hold_the_same(service: ServiceProcess, ended: dict[str, Any]) -> None:
    arrays = np.load(io.BytesIO(read(service, ended, "depth.npz")))
    report = json.loads(read(service, ended, "report.json"))
    depth, sigma, state = (pixels(service, ended, name) for name in ("depth.png", "sigma.png", "state.png"))
    depth_m, trusted = arrays["depth_m"], in_states(arrays, *TRUSTED)
    assert (depth.dtype, sigma.dtype, state.dtype) == (np.uint16, np.uint16, np.uint8)
    assert depth.shape == sigma.shape == state.shape == depth_m.shape == (256, 320)
    assert np.array_equal(depth > 0, trusted)
    unit_m = report["depth_png"]["unit_m"]
    np.testing.assert_allclose((depth * unit_m)[trusted], depth_m[trusted], atol=unit_m / 2 * 1.001)
    assert np.array_equal(sigma > 0, trusted)
    unit_m = report["sigma_png"]["unit_m"]
    np.testing.assert_allclose((sigma * unit_m)[trusted], arrays["sigma_m"][trusted], atol=unit_m / 2 * 1.001)
    for name, value in report["state_png"].items():
        assert np.array_equal(state == value, in_states(arrays, name))
        assert report["state_px"][name] == int((state == value).sum())


def test_each_pixel_says_what_its_depth_rests_on(service: ServiceProcess, ended: dict[str, Any]) -> None:
    arrays = np.load(io.BytesIO(read(service, ended, "depth.npz")))
    measured, missing = in_states(arrays, "measured", "contradicted"), in_states(arrays, "missing")
    assert np.array_equal(arrays["source"] == 0, measured)
    assert np.array_equal(arrays["source"] < 0, missing)
    assert np.array_equal(np.isnan(arrays["depth_m"]), missing)
    assert np.array_equal(np.isnan(arrays["sigma_m"]), missing)
    assert set(np.unique(arrays["source"])) == {-1, 0, 1, 2}
    completed = in_states(arrays, "completed")
    assert completed.sum() > 100
    assert (arrays["sigma_m"][completed] > 0).all()


def test_each_view_says_what_the_fusion_made_of_it(service: ServiceProcess, ended: dict[str, Any]) -> None:
    views = ended["views"]
    assert views[0]["fused"] is None
    assert [view["fused"]["refused"] for view in views[1:]] == [None, None]
    for before, after in itertools.pairwise(views):
        fused, given, had = after["fused"], after["state_px"], before["state_px"]
        assert sum(given.values()) == 256 * 320
        assert fused["filled_px"] == had["missing"] - given["missing"]
        assert given["measured"] + given["contradicted"] == had["measured"] + had["contradicted"]
        assert fused["shared_points"] > 0
        assert 0 <= fused["shift_m"] < 2e-3
        assert 0 < fused["sigma_shift_m"] < 1e-3
        assert 0.9 <= fused["agreement"] <= 1
        view_file = np.load(io.BytesIO(read(service, ended, f"view_{after['index']:02d}.npz")))
        moved_m = np.array(fused["base_T_camera"])[:3, 3] - view_file["base_T_camera"][:3, 3]
        assert np.linalg.norm(moved_m) == pytest.approx(fused["shift_m"], abs=1e-9)


def test_cloud_lies_where_depth_and_pose_say(service: ServiceProcess, ended: dict[str, Any]) -> None:
    arrays = np.load(io.BytesIO(read(service, ended, "depth.npz")))
    header, _, body = read(service, ended, "cloud.ply").partition(b"end_header\n")
    vertices = np.frombuffer(body, dtype=[("point", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
    rows, columns = np.nonzero(in_states(arrays, *TRUSTED))
    assert f"element vertex {len(rows)}\n".encode() in header
    assert len(vertices) == len(rows)
    # back through the inverse pose and the intrinsics, each point lands on its own pixel, at its own depth
    base_T_camera, intrinsics = arrays["base_T_camera"], arrays["K"]
    points_camera = (vertices["point"] - base_T_camera[:3, 3]) @ base_T_camera[:3, :3]
    projected = points_camera @ intrinsics.T
    np.testing.assert_allclose(points_camera[:, 2], arrays["depth_m"][rows, columns], atol=1e-6)
    np.testing.assert_allclose(projected[:, 0] / projected[:, 2], columns, atol=1e-3)
    np.testing.assert_allclose(projected[:, 1] / projected[:, 2], rows, atol=1e-3)
    # normals turn to the camera, and most of what it sees from above lies flat
    normals_camera = vertices["normal"] @ base_T_camera[:3, :3]
    np.testing.assert_allclose(np.linalg.norm(normals_camera, axis=1), 1.0, atol=1e-5)
    assert ((normals_camera * points_camera).sum(axis=1) < 0).all()
    assert np.median(vertices["normal"][:, 2]) > 0.9


def test_mesh_is_read_by_another_program_and_bridges_no_edge(
    service: ServiceProcess, ended: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "mesh.ply").write_bytes(read(service, ended, "mesh.ply"))
    mesh: Any = trimesh.load(tmp_path / "mesh.ply", process=False)
    report = json.loads(read(service, ended, "report.json"))
    assert (len(mesh.vertices), len(mesh.faces)) == (report["mesh_ply"]["points"], report["mesh_ply"]["triangles"])
    assert len(mesh.vertices) > 0.9 * report["cloud_ply"]["points"]
    base_T_camera = np.array(report["base_T_camera"])
    eye_m = base_T_camera[:3, 3]
    towards = eye_m - mesh.triangles_center
    cosines = (mesh.face_normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    assert cosines.min() > np.cos(1.31)


def test_what_the_reference_view_measured_is_in_the_result_to_the_bit(
    service: ServiceProcess, ended: dict[str, Any]
) -> None:
    first = np.load(io.BytesIO(read(service, ended, "view_00.npz")))["depth_m"]
    result = np.load(io.BytesIO(read(service, ended, "depth.npz")))
    measured = np.isfinite(first)
    assert np.array_equal(result["source"] == 0, measured)
    assert np.array_equal(result["depth_m"][measured].astype(np.float32), first[measured])


def test_report_says_what_the_scan_says(service: ServiceProcess, ended: dict[str, Any]) -> None:
    report = json.loads(read(service, ended, "report.json"))
    assert report["views"] == ended["views"]
    assert report["recipe"] == ended["setup"]["recipe"]
    assert report["finish_reason"] == ended["finish_reason"]
    assert report["depth_png"]["beyond_largest_px"] == 0


def test_poses_come_in_both_frames_with_their_uncertainty(service: ServiceProcess, ended: dict[str, Any]) -> None:
    """The same pose in the last view's report and in the file; camera and base frame agree."""
    document = json.loads(read(service, ended, "poses.json"))
    last = ended["views"][-1]
    assert len(document["objects"]) == len(last["poses"]) == last["objects"] > 0
    base_T_camera = np.array(document["base_T_camera"])
    for told, item in zip(last["poses"], document["objects"], strict=True):
        best = item["hypotheses"][0]
        assert told["camera_T_object"] == best["camera_T_object"]
        assert told["hypotheses"] == len(item["hypotheses"])
        assert sum(each["probability"] for each in item["hypotheses"]) == pytest.approx(1.0)
        for each in item["hypotheses"]:
            camera_T_object = np.array(each["camera_T_object"])
            np.testing.assert_allclose(base_T_camera @ camera_T_object, each["base_T_object"], atol=1e-12)
        assert set(told["supporting_views"]) <= {view["view"] for view in ended["views"]}
    known = [pose for pose in last["poses"] if pose["translation_sigma_m"] is not None]
    assert known, "no pose was refined"
    assert all(0 < pose["translation_sigma_m"] < 0.02 for pose in known)
    assert all(0 < pose["rotation_sigma_rad"] < 1 for pose in known)
    assert any(pose["supporting_views"] for pose in known)


def test_the_overlay_shows_the_poses_in_colour(service: ServiceProcess, ended: dict[str, Any]) -> None:
    picture = cv2.imdecode(np.frombuffer(read(service, ended, "poses.png"), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 600
    assert (np.ptp(picture.astype(int), axis=2) > 60).sum() > 100


def test_picture_is_a_picture(service: ServiceProcess, ended: dict[str, Any]) -> None:
    picture = cv2.imdecode(np.frombuffer(read(service, ended, "picture.png"), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 1800
    assert picture.std() > 20


def test_same_request_gives_the_same_depth(service: ServiceProcess, ended: dict[str, Any]) -> None:
    again = service.run_quick_scan()
    assert again["id"] != ended["id"]
    first, second = (np.load(io.BytesIO(read(service, scan, "depth.npz"))) for scan in (ended, again))
    assert np.array_equal(first["depth_m"], second["depth_m"], equal_nan=True)
    assert [view["view"] for view in again["views"]] == [view["view"] for view in ended["views"]]


def test_a_second_scan_is_refused_while_one_is_active_and_is_told_which(service: ServiceProcess) -> None:
    active = service.http.post("/v1/scans", json=QUICK_SCAN).json()
    cell = service.http.get("/v1/cell").json()
    refused = service.http.post("/v1/scans", json=QUICK_SCAN)
    assert refused.status_code == 409
    assert refused.headers["Content-Type"] == "application/problem+json"
    problem = refused.json()
    assert problem["type"] == "urn:sidelong:problem:cell-busy"
    assert (problem["code"], problem["retryable"], problem["scan_id"]) == (2001, True, active["id"])
    assert (cell["state"], cell["active_scan"], cell["may_start"]) == ("executing", active["id"], False)
    assert service.ended(active["id"])["state"] == "succeeded"
    assert service.http.get("/v1/cell").json()["may_start"] is True


def test_events_tell_the_whole_course_and_can_be_replayed(service: ServiceProcess, ended: dict[str, Any]) -> None:
    events = list(service.client.events(ended["id"]))
    ids = [event.id for event in events]
    assert ids == sorted(set(ids))
    states = [event.data["state"] for event in events if event.kind == "state"]
    assert states == ["accepted", "running", "succeeded"]
    views = [ViewReport.model_validate(event.data) for event in events if event.kind == "view"]
    assert [view.model_dump(mode="json") for view in views] == ended["views"]
    phases = [event.data["phase"] for event in events if event.kind == "phase"]
    assert phases[:4] == ["move", "capture", "capture", "detect"]
    for cut in (0, len(events) // 2, len(events) - 1):
        assert list(service.client.events(ended["id"], after=ids[cut])) == events[cut + 1 :]


def test_a_reader_that_comes_back_misses_nothing_of_a_running_scan(service: ServiceProcess) -> None:
    scan_id = service.http.post("/v1/scans", json=QUICK_SCAN).json()["id"]
    seen = []
    stream = service.client.events(scan_id)
    for event in stream:
        seen.append(event)
        if event.kind == "phase":
            break
    stream.close()
    seen += service.client.events(scan_id, after=seen[-1].id)
    assert seen == list(service.client.events(scan_id))
    assert seen[-1].data["state"] == "succeeded"


def test_scans_are_listed_newest_first_and_page_by_page(service: ServiceProcess, ended: dict[str, Any]) -> None:
    everything = [scan.id for scan in service.client.scans(limit=200).scans]
    assert ended["id"] in everything
    paged: list[str] = []
    cursor = None
    while True:
        page = service.client.scans(limit=2, cursor=cursor)
        paged += [scan.id for scan in page.scans]
        cursor = page.next_cursor
        if cursor is None:
            break
    assert paged == everything
    times = [scan.created_at for scan in service.client.scans().scans]
    assert times == sorted(times, reverse=True)


def test_cell_and_health_are_told(service: ServiceProcess) -> None:
    assert service.http.get("/livez").status_code == 200
    ready = service.http.get("/readyz")
    assert (ready.status_code, ready.json()["ready"]) == (200, True)
    cell = service.http.get("/v1/cell").json()
    assert (cell["mode"], cell["state"], cell["camera"]) == ("simulated", "idle", "simulated")
    assert service.http.post("/v1/cell/stop").json() == {"stopped": True, "scan": None}
