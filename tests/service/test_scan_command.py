"""``sidelong scan`` without a service, as a user types it: a recorded data set by its folder, and what cannot work."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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
