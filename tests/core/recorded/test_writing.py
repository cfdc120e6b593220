"""What is written is read again as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sidelong.errors import DatasetError
from sidelong.geometry.transforms import look_at
from sidelong.recorded.dataset import Dataset
from sidelong.recorded.files import pose_from_mm, read_gray, read_json
from sidelong.recorded.writing import add_to_json, pose_to_mm, write_depth, write_gray, write_json, write_rig
from sidelong.simulation.rig import rig_for


def test_a_rig_comes_back_with_its_serial_number(tmp_path: Path) -> None:
    rig = rig_for(640, 512)
    write_rig(tmp_path, rig, "N35-1")
    read = Dataset(tmp_path)
    assert read.serial == "N35-1"
    assert (read.rig.left, read.rig.right) == (rig.left, rig.right)
    assert read.rig.baseline_m == pytest.approx(rig.baseline_m, rel=1e-12)
    np.testing.assert_allclose(read.rig.projector.left_T_projector, rig.projector.left_T_projector, atol=1e-12)
    assert read.rig.projector.half_width_rad == pytest.approx(rig.projector.half_width_rad, rel=1e-12)
    assert read.rig.projector.half_height_rad == pytest.approx(rig.projector.half_height_rad, rel=1e-12)


def test_recordings_of_two_cameras_are_kept_apart(tmp_path: Path) -> None:
    write_rig(tmp_path, rig_for(640, 512), "N35-1")
    write_rig(tmp_path, rig_for(640, 512), "N35-1")
    with pytest.raises(DatasetError, match="holds recordings of camera N35-1, this one is N35-2"):
        write_rig(tmp_path, rig_for(640, 512), "N35-2")
    with pytest.raises(DatasetError, match="holds recordings of 640x512 px with other intrinsics"):
        write_rig(tmp_path, rig_for(320, 256), "N35-1")


def test_depth_comes_back_within_half_a_unit_and_missing_as_missing(tmp_path: Path) -> None:
    rig = rig_for(80, 64)
    write_rig(tmp_path, rig, "x")
    depth_m = np.random.default_rng(0).uniform(0.3, 2.0, (64, 80))
    depth_m[0] = np.nan
    depth_m[1] = 2.1
    write_depth(tmp_path / "a" / "depth.png", depth_m)
    read = Dataset(tmp_path).read_depth_m(tmp_path / "a" / "depth.png")
    assert np.isnan(read[:2]).all()
    np.testing.assert_allclose(read[2:], depth_m[2:], atol=0.0157e-3)


def test_images_and_poses_come_back_to_the_bit(tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 256, (6, 9)).astype(np.uint8)
    for name in ("a.bmp", "a.png"):
        write_gray(tmp_path / name, image)
        np.testing.assert_array_equal(read_gray(tmp_path / name), image)
    pose = look_at((0.5, 0.1, 0.7), (0.5, 0.0, 0.0))
    np.testing.assert_allclose(pose_from_mm(pose_to_mm(pose), "a"), pose, atol=1e-12)


def test_members_are_added_to_a_file_one_by_one(tmp_path: Path) -> None:
    path = tmp_path / "poses.json"
    add_to_json(path, "poses", a=1)
    add_to_json(path, "poses", b=2)
    assert read_json(path) == {"poses": {"a": 1, "b": 2}}
    path.write_text("{")
    with pytest.raises(DatasetError, match=r"poses\.json: cannot be read"):
        add_to_json(path, "poses", c=3)
    assert path.read_text() == "{"


def test_what_is_no_number_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not (tmp_path / "a.json").exists()
