"""Files of a scan: whole or not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from sidelong_service.artifacts import write_whole


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
