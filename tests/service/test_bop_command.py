"""The commands that write BOP's files, as a user runs them, read back by other means."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from sidelong.recorded.dataset import Dataset

ROBI = Path(__file__).parents[1] / "data" / "robi"
OBJECT = "Tube_fitting"


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("SIDELONG_", "FORCE_"))}
    return subprocess.run(
        [sys.executable, "-m", "sidelong_service", "bop", *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip


def test_a_scene_is_exported_with_its_truth(tmp_path: Path) -> None:
    done = command(tmp_path, "scene", str(ROBI), "out", "--object", OBJECT)
    assert done.returncode == 0, done.stderr
    test = tmp_path / "out/test/000001"
    truths = json.loads((test / "scene_gt.json").read_text())
    recorded = Dataset(ROBI).scene(OBJECT, 1)
    assert sorted(truths, key=int) == [str(k) for k in range(len(recorded.names))]
    assert all(len(each) == len(recorded.base_T_objects) for each in truths.values())
    about = json.loads((test / "scene_camera.json").read_text())["0"]
    with Image.open(test / "depth/000000.png") as picture:
        depth_m = np.asarray(picture) * about["depth_scale"] * 1e-3
    measured = recorded.depth_m(recorded.names[0])
    np.testing.assert_allclose(depth_m[np.isfinite(measured)], measured[np.isfinite(measured)], atol=2e-5)


def test_detections_are_written_where_the_parts_are(tmp_path: Path) -> None:
    """Of the parts in the first view, most have a row within a tenth of their diameter."""
    root = tmp_path / "robi"
    shutil.copytree(ROBI, root, copy_function=shutil.copyfile)
    (root / OBJECT / "Scene_1/Ensenso/list.txt").write_text("view_0\n")
    done = command(tmp_path, "results", str(root), "out/results.csv", "--object", OBJECT, "--object-id", "7")
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["scene_id"], row["im_id"], row["obj_id"]) for row in rows} == {("1", "0", "7")}
    assert all(float(row["time"]) > 0 for row in rows)
    scene = Dataset(root).scene(OBJECT, 1)
    camera_T_base = np.linalg.inv(scene.view("view_0").base_T_camera)
    truths_mm = 1e3 * (camera_T_base @ np.array(scene.base_T_objects))[:, :3, 3]
    found_mm = np.array([[float(number) for number in row["t"].split()] for row in rows])
    apart_mm = np.linalg.norm(truths_mm[:, None] - found_mm, axis=2).min(axis=1)
    assert (apart_mm < 5.6).mean() > 0.6


def test_an_unknown_object_is_one_line_on_the_error_stream(tmp_path: Path) -> None:
    done = command(tmp_path, "results", str(ROBI), "r.csv", "--object", "Gear")
    assert done.returncode == 1
    assert "object 'Gear' is unknown, known are Tube_fitting" in done.stderr
    assert not (tmp_path / "r.csv").exists()
