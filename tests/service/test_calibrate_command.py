"""``sidelong record`` and ``sidelong calibrate`` as a user types them: from captures to a file that a scan uses.

One of each kind is a process of its own; the many refusals run in this one, which has its libraries loaded.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import Result
from PIL import Image
from typer.testing import CliRunner

from sidelong.commissioning.documents import Document, read_document, to_json
from sidelong.recorded.captures import CalibrationCaptures
from sidelong.recorded.dataset import Dataset
from sidelong_service.cli import app

ROBI = Path(__file__).parents[1] / "data" / "robi"
RECIPE = {"detection": {"view_step_deg": 40, "roll_step_deg": 30}, "planning": {"max_views": 1}}
BRACKET_MS = "3,6,12,25,50,100,200,400,800"
BOARD = {"squares_x": 11, "squares_y": 8, "square_m": 0.02, "marker_m": 0.015}


def sidelong(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sidelong_service", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def succeeded(folder: Path, *arguments: str) -> list[str]:
    """Run a command in a process of its own and return the lines it printed."""
    done = sidelong(folder, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def here(folder: Path, *arguments: str) -> Result:
    """Run a command in this process."""
    with contextlib.chdir(folder):
        return CliRunner().invoke(app, arguments)


def succeeded_here(folder: Path, *arguments: str) -> list[str]:
    done = here(folder, *arguments)
    assert done.exit_code == 0, (done.exception, done.stderr)
    return done.stdout.splitlines()


def refused_here(folder: Path, *arguments: str) -> str:
    """Run a command that cannot work and return its one line."""
    done = here(folder, *arguments)
    assert isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code == 1
    return one_line(done.stderr)


def one_line(told: str) -> str:
    lines = [line for line in told.splitlines() if line]
    assert len(lines) == 1, told
    assert lines[0].startswith("error: ")
    return lines[0]


def write_cell(folder: Path, name: str, **settings: Any) -> None:
    """Write the configuration of a small simulated cell: two parts in a small bin before a small camera."""
    camera = {"width": 320, "height": 256, "count": 2, "bin": {"length_m": 0.16, "width_m": 0.12}}
    cell = {
        "camera": {"driver": "simulated", "settings": camera | settings},
        "arm": {"driver": "mock", "settings": {"speed_factor": 1000.0}},
        "dome": {"azimuths": 4, "elevations_deg": [70]},
    }
    content = {"data_dir": str(folder / "data"), "cell": cell}
    (folder / name).write_text(yaml.safe_dump(content))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the configuration of two cameras, a recipe, and a bracket in the data set ``data-set``."""
    folder = tmp_path_factory.mktemp("desk")
    write_cell(folder, "cell.yaml")
    write_cell(folder, "other.yaml", serial="other")
    (folder / "recipe.json").write_text(json.dumps(RECIPE))
    (folder / "board.json").write_text(json.dumps(BOARD))
    succeeded(folder, "record", "bracket", "data-set", "--config", "cell.yaml")
    return folder


@pytest.fixture(scope="module")
def response(desk: Path) -> Path:
    lines = succeeded(desk, "calibrate", "response", "data-set", "--output", "made")
    assert lines[0].endswith(".json")
    return desk / lines[0].strip()


def test_a_recorded_bracket_becomes_a_calibration_with_its_picture(desk: Path, response: Path) -> None:
    document = read_document(response)
    assert (document.kind, document.device_serial) == ("response", "simulated")
    assert sorted(file.name for file in (desk / "made").iterdir()) == [f"{document.id}.json", f"{document.id}.png"]
    with Image.open(response.with_suffix(".png")) as picture:
        assert picture.format == "PNG"
    exposures_s = CalibrationCaptures(Dataset(desk / "data-set")).bracket().exposures_s
    assert exposures_s == pytest.approx([float(each) * 1e-3 for each in BRACKET_MS.split(",")])


def test_a_scan_with_the_calibration_names_it_in_its_report(desk: Path, response: Path) -> None:
    arguments = ("--part", "tube_fitting", "--recipe", "recipe.json", "--calibration", str(response))
    succeeded(desk, "scan", *arguments, "--config", "cell.yaml", "--output", "scanned")
    report = json.loads((desk / "scanned/report.json").read_text())
    document = read_document(response)
    assert report["recipe"]["calibrations"] == [document.id]
    assert report["recipe"]["light"]["response_table"] == list(document.model_dump()["log_exposure"])


def test_a_calibration_of_another_camera_stops_a_scan_with_one_line(desk: Path, response: Path) -> None:
    arguments = ("--part", "tube_fitting", "--recipe", "recipe.json", "--calibration", str(response))
    done = sidelong(desk, "scan", *arguments, "--config", "other.yaml", "--output", "nothing")
    assert done.returncode == 1
    line = one_line(done.stderr)
    assert line.endswith("is of device 'simulated', the camera is 'other'")
    assert not (desk / "nothing").exists()


def test_a_calibration_that_was_changed_is_refused(desk: Path, response: Path) -> None:
    content = json.loads(response.read_text()) | {"samples": 7}
    (desk / "changed.json").write_text(json.dumps(content))
    for command in (("scan", "--part", "tube_fitting"), ("calibrate", "projector", "data-set", "--plane-k-d", "0.5")):
        assert "changed.json: was changed after it was written" in refused_here(
            desk, *command, "--calibration", "changed.json"
        )


def test_white_sprayed_plane_and_board_are_recorded_where_they_are_read(desk: Path) -> None:
    at_view = ("--view", "e70_a90", "--config", "cell.yaml")
    named = ("captured", "--object", "tube_fitting", *at_view)
    succeeded_here(desk, "record", "white", *named, "--exposures-ms", "6,1.5")
    succeeded_here(desk, "record", "sprayed", *named, "--exposure-ms", "6")
    succeeded_here(desk, "record", "plane", "captured", *at_view)
    succeeded_here(desk, "record", "board", "captured", "--config", "cell.yaml", "--board", "board.json")
    lines = succeeded(desk, "record", "board", "captured", *at_view)
    assert lines == ["  captured/Calibration/HandEye/LEFT_1.bmp"]
    captures = CalibrationCaptures(Dataset(desk / "captured"), "tube_fitting")
    sprayed = captures.sprayed()
    assert sprayed.exposure_s == pytest.approx(0.006)
    assert [pair.exposure_s for pair in sprayed.others] == pytest.approx([0.0015])
    assert sprayed.room is not None
    assert np.isfinite(sprayed.depth_m).mean() > 0.3
    (plane,), _ = captures.planes()
    assert plane.room is not None
    # the camera stood at the view, and the board was seen from two poses
    assert 0.5 < np.linalg.norm(sprayed.base_T_camera[:3, 3] - (0.5, 0.0, 0.03)) < 0.9
    board = captures.board()
    assert dict(board.board) == BOARD
    first, second = board.base_T_flanges
    assert np.linalg.norm(first[:3, 3] - second[:3, 3]) > 0.05


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bracket", "data-set", "--view", "nowhere"), "--view: 'nowhere' is unknown, known are top, e70_a0"),
        (("bracket", "data-set", "--exposures-ms", "3,x,4"), "--exposures-ms: 'x' is no number"),
        (("bracket", "data-set", "--exposures-ms", ""), "'' names none, needs at least one"),
        (("bracket", "data-set", "--exposures-ms", "3,6,3.0"), "'3,6,3.0' has fewer than 3 exposures"),
        (("bracket", "data-set", "--exposures-ms", "3,nan,6"), "exposure is nan s, limits"),
        (("bracket", "data-set", "--exposures-ms", "3,6,20000"), "exposure is 20.0 s, limits 1e-06 to 10 s"),
        (("white", "data-set", "--exposures-ms", " , "), "' , ' names none, needs at least one"),
        (("board", "data-set", "--board", "missing.json"), "--board: missing.json is no file"),
        (("white", "data-set", "--object", "../elsewhere"), "--object: '../elsewhere' is no name of an object"),
    ],
)
def test_a_recording_that_cannot_be_made_leaves_the_one_that_is_there(
    desk: Path, response: Path, arguments: tuple[str, ...], message: str
) -> None:
    before = contents(desk)
    assert message in refused_here(desk, "record", *arguments, "--config", "cell.yaml")
    assert contents(desk) == before


def test_a_data_set_of_another_camera_is_not_recorded_into(desk: Path) -> None:
    before = contents(desk)
    line = refused_here(desk, "record", "white", "data-set", "--config", "other.yaml")
    assert "data-set: holds recordings of camera simulated, this one is other" in line
    assert contents(desk) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("response", "missing"), "missing: no such data set folder"),
        (("hand-eye", "data-set"), "HandEye: no such folder of captures"),
        (("material", "data-set"), "name the object whose captures they are"),
        (("material", str(ROBI), "--object", "Tube_fitting", "--material", "gold"), "'gold' is none of Tube_fitting's"),
        (("sensing", str(ROBI), "--object", "Tube_fitting", "--scene", "9"), "scene 9 is unknown, known are 1"),
        (
            ("sensing", str(ROBI), "--object", "Tube_fitting", "--calibration", "no.json"),
            "no.json: no such calibration",
        ),
    ],
)
def test_what_cannot_be_calibrated_is_one_line_and_leaves_no_file(
    desk: Path, arguments: tuple[str, ...], message: str
) -> None:
    assert message in refused_here(desk, "calibrate", *arguments, "--output", "nothing-made")
    assert not (desk / "nothing-made").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("calibrate", "projector", "data-set"), "Missing option '--plane-k-d'"),
        (("calibrate", "projector", "data-set", "--plane-k-d", "2"), "less than or equal to 1, got 2.0"),
        (("record", "plane", "data-set", "--exposure-ms", "0"), "'--exposure-ms'"),
    ],
)
def test_options_out_of_range_are_told_with_the_usage(desk: Path, arguments: tuple[str, ...], message: str) -> None:
    done = here(desk, *arguments)
    assert done.exit_code == 2
    assert "Usage:" in done.stderr
    assert message in " ".join(done.stderr.split())


def test_noise_is_calibrated_from_planes_and_used_by_a_scan(desk: Path) -> None:
    for view in ("top", "e70_a90"):
        succeeded_here(desk, "record", "plane", "flat", "--view", view, "--config", "cell.yaml")
    lines = succeeded(desk, "calibrate", "noise", "flat", "--output", "noise-made")
    file = desk / lines[0].strip()
    document = read_document(file)
    assert document.kind == "noise"
    arguments = ("--part", "tube_fitting", "--recipe", "recipe.json", "--calibration", str(file))
    succeeded_here(desk, "scan", *arguments, "--config", "cell.yaml", "--output", "scanned-with-noise")
    report = json.loads((desk / "scanned-with-noise/report.json").read_text())
    assert report["recipe"]["fusion"]["noise"] == document.model_dump()["noise"]


def test_a_camera_that_repeats_itself_has_no_noise_to_measure(desk: Path) -> None:
    succeeded_here(desk, "record", "repeats", "still", "--count", "5", "--config", "cell.yaml")
    line = refused_here(desk, "calibrate", "noise", "still", "--repeats", "--output", "nothing-made")
    assert "DEPTH_1.png: is the same as DEPTH_0.png to the last bit" in line


@pytest.fixture(scope="module")
def robi_response(desk: Path) -> Path:
    lines = succeeded_here(
        desk, "calibrate", "response", str(ROBI), "--object", "Tube_fitting", "--output", "robi-made"
    )
    return desk / lines[0].strip()


def test_a_calibration_builds_on_those_that_are_named(desk: Path, robi_response: Path) -> None:
    arguments = (str(ROBI), "--object", "Tube_fitting", "--calibration", str(robi_response))
    lines = succeeded_here(desk, "calibrate", "material", *arguments, "--output", "robi-made")
    document: Document = read_document(desk / lines[0].strip())
    assert document.uses == (read_document(robi_response).id,)


def test_strategies_are_compared_with_a_calibration(desk: Path, robi_response: Path) -> None:
    quick = ("--true-poses", "--references", "0", "--views", "1", "--strategies", "nbv")
    succeeded(
        desk,
        "compare",
        str(ROBI),
        *quick,
        "--calibration",
        str(robi_response),
        "--json",
        "with.json",
        "--plot",
        "a.png",
    )
    (row,) = json.loads((desk / "with.json").read_text())
    assert row["measured_gain_px"] > 0
    document = read_document(robi_response)
    other = document.model_copy(update={"device_serial": "other"}).sealed()
    (desk / "foreign.json").write_bytes(to_json(other))
    line = refused_here(desk, "compare", str(ROBI), *quick, "--calibration", "foreign.json", "--plot", "b.png")
    assert f"calibration {other.id}: is of device 'other', the camera is 'intrinsics-" in line
    assert not (desk / "b.png").exists()


def test_ctrl_c_ends_a_calibration_and_leaves_no_file(desk: Path) -> None:
    arguments = ("calibrate", "sensing", str(ROBI), "--object", "Tube_fitting", "--output", "interrupted")
    command = [sys.executable, "-m", "sidelong_service", *arguments]
    with subprocess.Popen(command, cwd=desk, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        wait_for_rays(running.pid)
        running.send_signal(signal.SIGINT)
        printed, told = running.communicate(timeout=60)
    assert running.returncode == 130
    assert "Traceback" not in told
    assert "calibration" not in printed
    folder = desk / "interrupted"
    assert not folder.exists() or not list(folder.iterdir())


def wait_for_rays(pid: int) -> None:
    """Wait until a process has loaded what casts rays: the views are being predicted from then on."""
    maps, deadline_s = Path(f"/proc/{pid}/maps"), time.monotonic() + 60
    while time.monotonic() < deadline_s:
        if "open3d" in maps.read_text():
            return
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    pytest.fail("no views were predicted")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_a_board_is_printed_with_the_description_that_calibrating_reads(tmp_path: Path) -> None:
    succeeded_here(
        tmp_path, "record", "print-board", "board", "--squares", "7x5", "--square-mm", "30", "--marker-mm", "22"
    )
    about = json.loads((tmp_path / "board/board.json").read_text())
    assert (about["squares_x"], about["squares_y"]) == (7, 5)
    assert (about["square_m"], about["marker_m"]) == pytest.approx((0.03, 0.022))
    assert (tmp_path / "board/board.png").read_bytes().startswith(b"\x89PNG")
    assert "is not like 11x8" in refused_here(tmp_path, "record", "print-board", "board", "--squares", "7")
    assert "marker_m" in refused_here(tmp_path, "record", "print-board", "board", "--marker-mm", "25")
