"""A cell controller completes a recorded scene: no camera, no arm, the same interface."""

from __future__ import annotations

import io
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from service_process import QUICK_RECIPE, ServiceProcess, small_cell

from sidelong.calibration.projector.white_image import fit_intensity
from sidelong.planning.light import DEFAULT_INTENSITY
from sidelong.recipe import Recipe, light_model
from sidelong.recorded.dataset import Dataset
from sidelong.types import FloatArray

ROBI = Path(__file__).parents[1] / "data/robi"
DEPTHS = ROBI / "Tube_fitting/Scene_1/Ensenso/Depth"
DEPTH_UNIT_M = 0.03125e-3
VIEWS = {"view_0", "view_4", "view_8", "view_10", "view_12", "view_16"}
RECORDING = {"dataset": "robi", "object": "Tube_fitting", "scene": 1, "reference": "view_4"}
RECORDED_SCAN = {"recording": RECORDING, "recipe": QUICK_RECIPE}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service that knows a data set, beside its simulated cell."""
    running = ServiceProcess(tmp_path_factory.mktemp("recording"), small_cell(), datasets={"robi": str(ROBI)})
    yield running
    running.close()


@pytest.fixture(scope="module")
def ended(service: ServiceProcess) -> dict[str, Any]:
    """A scan of the recorded scene that has run to its end."""
    return service.ended(start(service)["id"])


def start(service: ServiceProcess, **planning: Any) -> dict[str, Any]:
    scan = RECORDED_SCAN | {"recipe": QUICK_RECIPE | {"planning": {"max_views": 2} | planning}}
    return service.http.post("/v1/scans", json=scan).raise_for_status().json()


def read(service: ServiceProcess, scan: dict[str, Any], name: str) -> httpx.Response:
    return service.http.get(f"/v1/scans/{scan['id']}/artifacts/{name}").raise_for_status()


def recorded_depth_m(view: str) -> FloatArray:
    counts = cv2.imread(str(DEPTHS / f"DEPTH_{view}.png"), cv2.IMREAD_UNCHANGED)
    assert counts is not None
    return np.where(counts > 0, counts * DEPTH_UNIT_M, np.nan)


def test_recorded_scan_succeeds_and_says_what_it_replays(ended: dict[str, Any]) -> None:
    assert (ended["state"], ended["finish_reason"], ended["problem"]) == ("succeeded", "max_views", None)
    assert (ended["part"], ended["recording"]) == (None, RECORDING)
    setup = ended["setup"]
    assert (setup["camera"], setup["arm"]) == ("replay camera", "replay arm")
    assert (setup["width_px"], setup["height_px"], setup["candidates"]) == (640, 512, 6)


def test_it_begins_at_the_reference_and_takes_recorded_views_once_each(ended: dict[str, Any]) -> None:
    taken = [view["view"] for view in ended["views"]]
    assert taken[0] == "view_4"
    assert len(taken) == len(set(taken)) == 3
    assert set(taken) <= VIEWS
    assert ended["views"][0]["objects"] >= 5


def test_completeness_rises_from_view_to_view(ended: dict[str, Any]) -> None:
    completeness = [view["completeness"] for view in ended["views"]]
    assert completeness[0] == 0.0
    assert all(before < after for before, after in itertools.pairwise(completeness))
    assert completeness[-1] > 0.2


def test_each_candidate_not_taken_has_its_reason(ended: dict[str, Any]) -> None:
    for view in ended["views"][:-1]:
        assert {candidate["view"] for candidate in view["candidates"]} == VIEWS
        best = max(candidate["gain_px"] for candidate in view["candidates"])
        for candidate in view["candidates"]:
            lost_px = sum(candidate["lost_px"].values())
            assert candidate["dropped"] == "already taken" or candidate["gain_px"] == best or lost_px > 0
            assert set(candidate["lost_px"]) in (set(), {"outside", "hidden", "shadow", "dark", "saturated"})


def test_the_views_and_the_results_are_all_there(service: ServiceProcess, ended: dict[str, Any]) -> None:
    names = [artifact["name"] for artifact in ended["artifacts"]]
    views = ["view_00.npz", "view_01.npz", "view_02.npz"]
    pictures = ["picture.png", "poses.png", "reliability.png"]
    depth = ["depth.png", "sigma.png", "state.png", "depth.npz", "cloud.ply", "mesh.ply"]
    assert names == [*views, *depth, "poses.json", *pictures, "report.json"]
    for artifact in ended["artifacts"]:
        assert len(read(service, ended, artifact["name"]).content) == artifact["size_bytes"]


def test_where_the_reference_measured_its_recorded_depth_stands_to_the_bit(
    service: ServiceProcess, ended: dict[str, Any]
) -> None:
    result = np.load(io.BytesIO(read(service, ended, "depth.npz").content))
    recorded_m = recorded_depth_m("view_4")
    measured = np.isfinite(recorded_m)
    assert np.array_equal(result["source"] == 0, measured)
    assert np.array_equal(result["depth_m"][measured], recorded_m[measured])
    filled = result["source"] > 0
    assert filled.sum() > 200
    assert np.isfinite(result["depth_m"][filled]).all()


def test_each_view_file_holds_what_was_recorded_there(service: ServiceProcess, ended: dict[str, Any]) -> None:
    for view in ended["views"]:
        arrays = np.load(io.BytesIO(read(service, ended, f"view_{view['index']:02d}.npz").content))
        np.testing.assert_array_equal(arrays["depth_m"], recorded_depth_m(view["view"]).astype(np.float32))
        pose = np.reshape(json.loads((DEPTHS / f"DEPTH_{view['view']}.json").read_text())["cam_pose"], (4, 4))
        np.testing.assert_allclose(arrays["base_T_camera"][:3, 3], pose[:3, 3] * 1e-3, atol=1e-9)


def test_the_light_fitted_to_the_white_capture_stands_in_the_report(
    service: ServiceProcess, ended: dict[str, Any]
) -> None:
    assert ended["recipe"]["light"]["intensity"] is None
    report = read(service, ended, "report.json").json()
    dataset, recipe = Dataset(ROBI), Recipe()
    white, part = dataset.white_capture("Tube_fitting"), dataset.part("Tube_fitting")
    assert white is not None
    fit = fit_intensity(white.frame, white.base_T_objects, part, dataset.rig, light_model(recipe, part))
    assert report["recipe"]["light"]["intensity"] == pytest.approx(fit.intensity)
    assert fit.intensity != DEFAULT_INTENSITY
    assert report["recipe"] | {"light": None} == ended["recipe"] | {"light": None}
    assert report["recipe"] == ended["setup"]["recipe"]


def test_an_intensity_that_is_given_is_not_fitted(service: ServiceProcess) -> None:
    recipe = QUICK_RECIPE | {"planning": {"max_views": 0}, "light": {"intensity": 250.0}}
    scan_id = service.http.post("/v1/scans", json=RECORDED_SCAN | {"recipe": recipe}).raise_for_status().json()["id"]
    ended = service.ended(scan_id)
    assert (ended["state"], ended["finish_reason"], len(ended["views"])) == ("succeeded", "max_views", 1)
    assert read(service, ended, "report.json").json()["recipe"]["light"]["intensity"] == 250.0


def test_stopping_a_recorded_scan_ends_it_with_what_it_has(service: ServiceProcess) -> None:
    scan_id = start(service, max_views=5)["id"]
    service.wait_for(scan_id, "phase", phase="detect")
    assert service.http.post("/v1/cell/stop").raise_for_status().json() == {"stopped": True, "scan": scan_id}
    stopped = service.ended(scan_id)
    assert (stopped["state"], stopped["finish_reason"], stopped["problem"]) == ("stopped", None, None)
    assert len(stopped["views"]) < 2
    cell = service.http.get("/v1/cell").json()
    assert (cell["state"], cell["may_start"]) == ("idle", True)


def test_the_same_recording_gives_the_same_depth_and_leaves_the_cell_alone(
    service: ServiceProcess, ended: dict[str, Any]
) -> None:
    again = service.ended(start(service)["id"])
    first, second = (np.load(io.BytesIO(read(service, scan, "depth.npz").content)) for scan in (ended, again))
    np.testing.assert_array_equal(first["depth_m"], second["depth_m"])
    cell = service.http.get("/v1/cell").json()
    assert (cell["arm"], cell["state"]) == ("mock arm", "idle")
    # the arm that moved among the recorded views lived for those scans alone
    assert len(service.children("sidelong_service.arm_host")) == 1


def test_without_a_reference_the_first_recorded_view_is_completed(service: ServiceProcess) -> None:
    recording = {name: value for name, value in RECORDING.items() if name != "reference"}
    scan = {"recording": recording, "recipe": QUICK_RECIPE | {"planning": {"max_views": 0}}}
    ended = service.ended(service.http.post("/v1/scans", json=scan).raise_for_status().json()["id"])
    assert [view["view"] for view in ended["views"]] == ["view_0"]
