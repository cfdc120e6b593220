"""Files of a scan: whole or not there, and readable by anybody."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from sidelong.types import FloatArray
from sidelong_service.artifacts import DEPTH_UNIT_M, LARGEST_PNG_DEPTH_M, depth_png, ply, write_whole


def decoded(png: bytes) -> FloatArray:
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.dtype == np.uint16
    return picture.astype(np.float64)


def units(*depths_m: float) -> list[int]:
    return [int(value) for value in decoded(depth_png(np.array([depths_m]))).ravel()]


def test_a_file_is_written_with_its_folders(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "depth.png"
    write_whole(path, b"content")
    assert path.read_bytes() == b"content"
    assert list(path.parent.iterdir()) == [path]


def test_a_file_that_exists_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_whole(path, b"long" * 100_000)
    write_whole(path, b"short")
    assert path.read_bytes() == b"short"
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_left_where_the_folder_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match=r"Not a directory|exists"):
        write_whole(tmp_path / "file" / "depth.png", b"content")
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


@pytest.mark.parametrize("length", [250, 255, 300])
def test_nothing_is_left_where_the_name_is_too_long(tmp_path: Path, length: int) -> None:
    with pytest.raises(OSError, match="name too long"):
        write_whole(tmp_path / ("x" * (length - 4) + ".png"), b"content")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_left_where_the_name_is_taken_by_a_folder(tmp_path: Path) -> None:
    (tmp_path / "depth.png").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_whole(tmp_path / "depth.png", b"content")
    assert [path.name for path in tmp_path.rglob("*")] == ["depth.png"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_nothing_is_left_where_the_disk_is_full(tmp_path: Path) -> None:
    # the draft of this name leads to a disk without space
    (tmp_path / ".depth.png.part").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        write_whole(tmp_path / "depth.png", b"content")
    assert list(tmp_path.iterdir()) == []
    assert Path("/dev/full").exists()


def test_depth_is_in_tenths_of_a_millimetre_and_rounded() -> None:
    assert DEPTH_UNIT_M == 1e-4
    assert units(0.7, 0.70004, 0.70006, 1e-4, 1.0) == [7000, 7000, 7001, 1, 10000]


def test_what_is_not_there_is_zero() -> None:
    assert units(np.nan, np.inf, -np.inf, 0.0, -0.3, 0.5) == [0, 0, 0, 0, 0, 5000]


def test_depth_beyond_the_range_is_missing_and_not_near() -> None:
    assert pytest.approx(6.5535) == LARGEST_PNG_DEPTH_M
    assert units(LARGEST_PNG_DEPTH_M, 6.55354, 6.5536, 6.6, 100.0) == [65535, 0, 0, 0, 0]


def test_all_missing_depth_is_a_picture_too() -> None:
    assert decoded(depth_png(np.full((3, 5), np.nan))).tolist() == np.zeros((3, 5)).tolist()


def test_rounding_is_never_more_than_half_a_unit() -> None:
    depth_m = np.random.default_rng(1).uniform(0.3, 6.5, (40, 50))
    np.testing.assert_allclose(decoded(depth_png(depth_m)) * DEPTH_UNIT_M, depth_m, atol=DEPTH_UNIT_M * 0.5001)


def test_cloud_says_what_its_bytes_are() -> None:
    points_m = np.array([[0.1, -0.2, 0.3], [1.0, 2.0, 3.0]])
    content = ply(points_m, np.array([7, 255], np.uint8))
    header, _, body = content.partition(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "comment metres, base frame", "element vertex 2",
        "property float x", "property float y", "property float z",
        "property uchar red", "property uchar green", "property uchar blue",
    ]  # fmt: skip
    assert len(body) == 2 * (3 * 4 + 3)


def test_cloud_is_read_by_another_program(tmp_path: Path) -> None:
    points_m = np.random.default_rng(2).normal(size=(100, 3))
    gray = np.arange(100, dtype=np.uint8)
    (tmp_path / "cloud.ply").write_bytes(ply(points_m, gray))
    cloud = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_allclose(cloud.vertices, points_m, atol=1e-6)
    assert np.array_equal(cloud.colors[:, :3], np.repeat(gray[:, None], 3, axis=1))


def test_an_empty_cloud_is_a_whole_file() -> None:
    content = ply(np.empty((0, 3)), np.empty(0, np.uint8))
    assert b"element vertex 0\n" in content
    assert content.endswith(b"end_header\n")
