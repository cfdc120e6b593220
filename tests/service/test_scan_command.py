"""``sidelong scan`` without a service, as a user types it: a recorded data set by its folder, and what cannot work."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

ROBI = Path(__file__).parents[1] / "data" / "robi"
QUICK = {"detection": {"view_step_deg": 40, "roll_step_deg": 30}, "planning": {"max_views": 1}}


def sidelong(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sidelong_service", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def test_a_recorded_scene_is_scanned_in_this_process(tmp_path: Path) -> None:
    (tmp_path / "quick.json").write_text(json.dumps(QUICK))
    arguments = ["--dataset", str(ROBI), "--object", "Tube_fitting", "--reference", "view_8", "--recipe", "quick.json"]
    done = sidelong(tmp_path, "scan", *arguments, "--output", "out")
    assert done.returncode == 0, done.stderr
    assert "ended: max_views" in done.stdout
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["views"][0]["view"] == "view_8"
    assert report["recovered_px"] > 0
    assert np.isfinite(np.load(tmp_path / "out/depth.npz")["depth_m"]).any()
    near_m, far_m = report["recipe"]["detection"]["distance_m"]
    assert near_m < 0.7 < far_m


def test_the_volume_gives_the_surface_of_the_whole_bin_too(tmp_path: Path) -> None:
    """Read back by another library; in the base frame, around the bin. The model fills in, marked."""
    fusion = {"engine": "volume", "volume": {"voxel_m": 1e-3, "front_m": 3e-3, "behind_m": 2e-3}, "model": {}}
    (tmp_path / "volume.json").write_text(json.dumps(QUICK | {"fusion": fusion}))
    arguments = ["--dataset", str(ROBI), "--object", "Tube_fitting", "--reference", "view_8", "--recipe", "volume.json"]
    done = sidelong(tmp_path, "scan", *arguments, "--output", "out")
    assert done.returncode == 0, done.stderr
    mesh, cloud = (trimesh.load(tmp_path / f"out/bin_{kind}.ply", process=False) for kind in ("mesh", "cloud"))
    assert len(mesh.faces) > 10_000
    assert len(cloud.vertices) == len(mesh.vertices)
    completed = trimesh.load(tmp_path / "out/cloud.ply")
    low, high = np.percentile(completed.vertices, (2, 98), axis=0)
    inside = ((mesh.vertices > low - 0.05) & (mesh.vertices < high + 0.05)).all(axis=1)
    assert inside.mean() > 0.9
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["state_px"]["completed"] > 100
    assert "completion by the CAD model" not in "".join(report["setup"]["left_out"])


def test_a_view_that_is_not_where_it_says_is_refused_and_the_scan_goes_on_without_it(tmp_path: Path) -> None:
    """One view of the recording is moved by 50 mm: the reason stands in the output, the table and the report."""
    root, moved = tmp_path / "robi", "view_0"
    shutil.copytree(ROBI, root, copy_function=os.symlink)
    path = root / f"Tube_fitting/Scene_1/Ensenso/Depth/DEPTH_{moved}.json"
    content = json.loads(path.read_text())
    content["cam_pose"][3] += 50.0
    path.unlink()
    path.write_text(json.dumps(content))
    (tmp_path / "all.json").write_text(json.dumps(QUICK | {"planning": {"max_views": 5, "gain_threshold_share": 0.0}}))
    arguments = ["--dataset", str(root), "--object", "Tube_fitting", "--reference", "view_8", "--recipe", "all.json"]
    done = sidelong(tmp_path, "scan", *arguments, "--output", "out")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out/report.json").read_text())
    told = {view["view"]: view["fused"] for view in report["views"]}
    assert len(told) == 6
    assert told.pop("view_8") is None
    refused = told.pop(moved)
    assert refused["refused"]
    assert (refused["filled_px"], refused["contradicted_px"]) == (0, 0)
    assert f"{moved}: refused: {refused['refused']}" in done.stdout
    assert done.stdout.count("refused") == 2
    assert all(each["refused"] is None and each["filled_px"] > 0 for each in told.values())
    assert "moved by" in done.stdout
    index = [view["view"] for view in report["views"]].index(moved)
    with np.load(tmp_path / "out/depth.npz") as result:
        assert set(np.unique(result["source"])) == {-1, 0, 1, 2, 3, 4, 5} - {index}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either --part"),
        (["--part", "a", "--dataset", "b"], "give either --part"),
        (["--dataset", str(ROBI)], "--dataset needs --object"),
        (["--dataset", "nope", "--object", "Tube_fitting"], "'nope' is neither a folder nor known"),
        (["--dataset", str(ROBI), "--object", "Gear"], "object 'Gear' is unknown, known are Tube_fitting"),
        (["--part", "gear"], "part: 'gear' is unknown, known are tube_fitting"),
        (["--part", "tube_fitting", "--recipe", "missing.json"], "missing.json"),
        (["--part", "tube_fitting", "--url", "http://127.0.0.1:9"], "cannot be reached"),
    ],
)
def test_what_cannot_work_is_one_line_and_exit_code_1(tmp_path: Path, arguments: list[str], message: str) -> None:
    done = sidelong(tmp_path, "scan", *arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "sidelong-output").exists()


def test_a_recipe_out_of_range_names_file_field_and_limit(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text('{"planning": {"max_views": 101}}')
    done = sidelong(tmp_path, "scan", "--part", "tube_fitting", "--recipe", "bad.json")
    assert done.returncode == 1
    assert "bad.json: planning.max_views: Input should be less than or equal to 100" in done.stderr
