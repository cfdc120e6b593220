"""Calibrations over HTTP: made as jobs, listed, fetched, used by scans, and refused where they do not fit."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from service_process import QUICK_SCAN, ServiceProcess, small_cell

from sidelong.commissioning.documents import read_document, to_json
from sidelong_service.client import ProblemError
from sidelong_service.models import CalibrationRequest, RunState

ROBI = Path(__file__).parents[1] / "data" / "robi"
RESPONSE = {"dataset": "robi", "object": "Tube_fitting", "task": {"kind": "response"}}
SENSING = {"dataset": "robi", "object": "Tube_fitting", "task": {"kind": "sensing"}}
RECORDED_SCAN: dict[str, Any] = {
    "recording": {"dataset": "robi", "object": "Tube_fitting", "scene": 1},
    "recipe": {
        "planning": {"max_views": 1},
        "detection": {"view_step_deg": 40, "roll_step_deg": 30, "distance_m": [0.6, 0.75], "hypotheses_per_object": 3},
    },
}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    running = ServiceProcess(tmp_path_factory.mktemp("calibration"), small_cell(), datasets={"robi": str(ROBI)})
    yield running
    running.close()


def job_of(service: ServiceProcess, request: dict[str, Any]) -> dict[str, Any]:
    """Start a job and return it when it has ended."""
    accepted = service.http.post("/v1/jobs", json=request)
    assert accepted.status_code == 202, accepted.text
    assert accepted.headers["Location"] == f"/v1/jobs/{accepted.json()['id']}"
    for _ in service.client.job_events(accepted.json()["id"]):
        pass
    return service.http.get(accepted.headers["Location"]).raise_for_status().json()


@pytest.fixture(scope="module")
def response_id(service: ServiceProcess) -> str:
    job = job_of(service, RESPONSE)
    assert job["state"] == "succeeded", job
    (made,) = job["calibrations"]
    return made


def test_a_job_tells_its_course_and_leaves_a_calibration_with_its_picture(
    service: ServiceProcess, response_id: str, tmp_path: Path
) -> None:
    newest = service.http.get("/v1/jobs").json()["jobs"][0]
    events = list(service.client.job_events(newest["id"]))
    assert [event.data["state"] for event in events if event.kind == "state"] == ["accepted", "running", "succeeded"]
    assert any(event.kind == "progress" for event in events)
    assert {event.job for event in events} == {newest["id"]}
    listed = service.client.calibrations().calibrations
    assert response_id in [each.id for each in listed]
    file, picture = service.client.download_calibration(response_id, tmp_path)
    assert read_document(file).id == response_id
    assert picture.read_bytes().startswith(b"\x89PNG")
    inputs = {each.name for each in read_document(file).inputs}
    assert "Tube_fitting/Calibration/Response/times.json" in inputs


def test_the_same_captures_give_the_same_numbers(service: ServiceProcess, response_id: str, tmp_path: Path) -> None:
    (again,) = job_of(service, RESPONSE)["calibrations"]
    first, second = (service.http.get(f"/v1/calibrations/{each}").json() for each in (response_id, again))
    told = {"id", "created_at"}
    assert {k: v for k, v in first.items() if k not in told} == {k: v for k, v in second.items() if k not in told}


def test_a_scan_names_the_calibrations_it_used(service: ServiceProcess, response_id: str) -> None:
    wanted = {**RECORDED_SCAN, "recipe": {**RECORDED_SCAN["recipe"], "calibrations": [response_id]}}
    scan_id = service.http.post("/v1/scans", json=wanted).raise_for_status().json()["id"]
    scan = service.ended(scan_id)
    assert scan["state"] == "succeeded", scan["problem"]
    assert scan["setup"]["recipe"]["calibrations"] == [response_id]
    table = service.http.get(f"/v1/calibrations/{response_id}").json()["log_exposure"]
    assert scan["setup"]["recipe"]["light"]["response_table"] == table
    report = service.http.get(f"/v1/scans/{scan_id}/artifacts/report.json").json()
    assert report["recipe"]["calibrations"] == [response_id]


def test_a_calibration_of_another_device_stops_a_scan_before_anything_moves(
    service: ServiceProcess, response_id: str
) -> None:
    wanted = {**QUICK_SCAN, "recipe": {**QUICK_SCAN["recipe"], "calibrations": [response_id]}}
    scan = service.ended(service.http.post("/v1/scans", json=wanted).raise_for_status().json()["id"])
    assert scan["state"] == "failed"
    assert scan["problem"]["type"] == "urn:sidelong:problem:calibration"
    assert "the camera is 'simulated'" in scan["problem"]["detail"]
    assert scan["views"] == []
    events = service.client.events(scan["id"])
    assert not [event for event in events if event.kind == "phase"]


def test_an_unknown_calibration_is_refused_at_once(service: ServiceProcess) -> None:
    wanted = {**RECORDED_SCAN, "recipe": {"calibrations": ["response-000000000000"]}}
    answer = service.http.post("/v1/scans", json=wanted)
    assert (answer.status_code, answer.json()["type"]) == (404, "urn:sidelong:problem:unknown-name")
    assert "response-000000000000" in answer.json()["detail"]


def test_a_recorded_scan_with_a_calibration_of_another_device_is_refused_at_once(
    service: ServiceProcess, response_id: str
) -> None:
    document = read_document(service.data / "calibrations" / f"{response_id}.json")
    other = document.model_copy(update={"device_serial": "N35-9"}).sealed()
    (service.data / "calibrations" / f"{other.id}.json").write_bytes(to_json(other))
    wanted = {**RECORDED_SCAN, "recipe": {"calibrations": [other.id]}}
    answer = service.http.post("/v1/scans", json=wanted)
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:sidelong:problem:calibration")
    assert "is of device 'N35-9', the camera is 'intrinsics-" in answer.json()["detail"]


def test_a_file_that_somebody_changed_is_listed_with_its_trouble_and_not_used(
    service: ServiceProcess, response_id: str
) -> None:
    folder = service.data / "calibrations"
    content = json.loads((folder / f"{response_id}.json").read_text()) | {"samples": 7, "id": "response-ffffffffffff"}
    (folder / "response-ffffffffffff.json").write_text(json.dumps(content))
    listed = {each.id: each.trouble for each in service.client.calibrations().calibrations}
    assert listed[response_id] is None
    assert "was changed after it was written" in (listed["response-ffffffffffff"] or "")
    answer = service.http.get("/v1/calibrations/response-ffffffffffff")
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:sidelong:problem:calibration")


@pytest.mark.parametrize("path", ["nothing", "response-0", "..%2Fsidelong", "%2e%2e"])
def test_what_is_no_calibration_is_not_found(service: ServiceProcess, path: str) -> None:
    for ending in ("", "/picture"):
        answer = service.http.get(f"/v1/calibrations/{path}{ending}")
        assert answer.status_code == 404
        assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("changes", "status", "word"),
    [
        ({"dataset": "nothing"}, 404, "nothing"),
        ({"dataset": "../robi"}, 422, "dataset"),
        ({"task": {"kind": "colour"}}, 422, "colour"),
        ({"task": {"kind": "projector"}}, 422, "plane_k_d"),
        ({"task": {"kind": "projector", "plane_k_d": True}}, 422, "plane_k_d"),
        ({"task": {"kind": "projector", "plane_k_d": 1.5}}, 422, "plane_k_d"),
        ({"task": {"kind": "sensing", "scene": -1}}, 422, "scene"),
        ({"task": {"kind": "noise", "method": "guess"}}, 422, "method"),
        ({"colour": "red"}, 422, "colour"),
        ({"recipe": {"calibrations": ["../a"]}}, 422, "calibrations"),
        ({"recipe": {"calibrations": ["response-000000000000"]}}, 404, "response-000000000000"),
    ],
)
def test_a_request_that_cannot_be_done_is_refused_with_the_field(
    service: ServiceProcess, changes: dict[str, Any], status: int, word: str
) -> None:
    answer = service.http.post("/v1/jobs", json=RESPONSE | changes)
    assert answer.status_code == status, answer.text
    assert word in answer.json()["detail"]


def test_captures_that_are_not_there_fail_the_job_with_the_folder(service: ServiceProcess) -> None:
    job = job_of(service, {"dataset": "robi", "task": {"kind": "hand_eye"}})
    assert (job["state"], job["problem"]["type"]) == ("failed", "urn:sidelong:problem:dataset")
    assert "HandEye: no such folder of captures" in job["problem"]["detail"]
    assert job["calibrations"] == []


def test_a_job_and_a_scan_wait_for_each_other_and_a_job_can_be_cancelled(service: ServiceProcess) -> None:
    job = service.client.start_job(CalibrationRequest.model_validate_json(json.dumps(SENSING)))
    for event in service.client.job_events(job.id):
        if event.kind == "progress":
            break
    busy = service.http.post("/v1/scans", json=QUICK_SCAN)
    assert (busy.status_code, busy.json()["job_id"]) == (409, job.id)
    cell = service.client.cell()
    assert (cell.active_scan, cell.active_job, cell.may_start) == (None, job.id, False)
    service.client.cancel_job(job.id)
    for _ in service.client.job_events(job.id):
        pass
    assert service.client.job(job.id).state is RunState.STOPPED
    assert service.client.cancel_job(job.id).state is RunState.STOPPED
    assert service.client.job(job.id).calibrations == ()


def test_a_worker_that_dies_leaves_an_interrupted_job(service: ServiceProcess) -> None:
    job = service.client.start_job(CalibrationRequest.model_validate_json(json.dumps(SENSING)))
    for event in service.client.job_events(job.id):
        if event.kind == "progress":
            (worker,) = service.children("sidelong_service.worker")
            os.kill(worker, signal.SIGKILL)
            break
    for _ in service.client.job_events(job.id):
        pass
    ended = service.client.job(job.id)
    assert ended.state is RunState.INTERRUPTED
    assert ended.problem is not None
    assert (ended.problem.type, ended.problem.job_id) == ("urn:sidelong:problem:worker-died", job.id)
    service.client.wait_until_ready(60)


def test_a_job_is_no_scan_and_a_scan_is_no_job(service: ServiceProcess) -> None:
    job = service.http.get("/v1/jobs").json()["jobs"][0]
    assert service.http.get(f"/v1/scans/{job['id']}").status_code == 404
    assert job["id"] not in [scan["id"] for scan in service.http.get("/v1/scans").json()["scans"]]
    with pytest.raises(ProblemError, match="There is no job"):
        service.client.job("nobody")
