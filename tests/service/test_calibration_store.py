"""The folder of calibration files: what is added is found again, and what somebody put there is listed as it is."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sidelong.commissioning.documents import ResponseDocument, to_json
from sidelong.errors import CalibrationError, UnknownNameError
from sidelong.physics.response import Response
from sidelong_service.calibration_store import CalibrationStore

START = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
PICTURE = b"\x89PNG picture"


def document(age_s: float = 0.0, serial: str = "N35-1") -> ResponseDocument:
    return ResponseDocument(
        created_at=START - timedelta(seconds=age_s),
        device_serial=serial,
        inputs=(),
        warnings=("noisy",),
        log_exposure=tuple(float(g) for g in Response.gamma().log_exposure),
        standard_error=(0.01,) * 256,
        exposures_s=(0.001, 0.002, 0.004),
        samples=1000,
        condition=1e4,
        residual_rms_ln=0.01,
        residual_rms_grey=0.5,
        image_residuals_grey={"a.bmp": 0.01},
    ).sealed()


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    return CalibrationStore(tmp_path / "calibrations")


def test_a_store_without_a_folder_is_empty(store: CalibrationStore) -> None:
    assert store.listed().calibrations == ()
    assert store.read_all(()) == ()
    assert not store.folder.exists()


def test_what_was_added_is_read_listed_and_has_its_picture(store: CalibrationStore) -> None:
    added = document()
    store.add(added, PICTURE)
    assert store.read(added.id) == added
    assert store.read_all([added.id, added.id]) == (added, added)
    assert store.picture(added.id).read_bytes() == PICTURE
    (listed,) = store.listed().calibrations
    assert (listed.id, listed.kind, listed.device_serial, listed.material) == (added.id, "response", "N35-1", None)
    assert (listed.created_at, listed.warnings, listed.trouble) == (added.created_at, ("noisy",), None)
    assert sorted(file.name for file in store.folder.iterdir()) == [f"{added.id}.json", f"{added.id}.png"]


def test_adding_again_changes_nothing(store: CalibrationStore) -> None:
    added = document()
    for _ in range(2):
        store.add(added, PICTURE)
    assert len(store.listed().calibrations) == 1
    assert store.read(added.id) == added


def test_the_newest_comes_first_whatever_the_ids_and_the_unusable_last(store: CalibrationStore) -> None:
    by_age = [document(age_s) for age_s in (0.0, 10.0, 20.0, 30.0, 40.0)]
    assert [each.id for each in by_age] != sorted(each.id for each in by_age)
    for each in by_age[::-2] + by_age[1::2]:
        store.add(each, PICTURE)
    (store.folder / "a.json").write_text("{}")
    (store.folder / "z.json").write_text("{}")
    assert [each.id for each in store.listed().calibrations] == [*(each.id for each in by_age), "a", "z"]


def test_a_changed_file_is_listed_with_its_trouble_and_not_read(store: CalibrationStore) -> None:
    added = document()
    store.add(added, PICTURE)
    path = store.folder / f"{added.id}.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"samples": 7}))
    (listed,) = store.listed().calibrations
    assert (listed.id, listed.kind, listed.created_at, listed.warnings) == (added.id, None, None, ())
    assert listed.trouble is not None
    assert f"{path}: was changed after it was written" in listed.trouble
    for ask in (store.read, store.picture):
        with pytest.raises(CalibrationError, match="was changed after it was written"):
            ask(added.id)


def test_a_file_under_another_name_is_listed_with_the_id_it_holds(store: CalibrationStore) -> None:
    added = document()
    store.add(added, PICTURE)
    (store.folder / f"{added.id}.json").rename(store.folder / "mine.json")
    (listed,) = store.listed().calibrations
    assert (listed.id, listed.trouble) == ("mine", f"{store.folder / 'mine.json'}: holds calibration {added.id}")
    with pytest.raises(UnknownNameError, match=f"calibration '{added.id}' is unknown"):
        store.read(added.id)


def test_a_file_that_was_put_there_by_hand_is_one_of_them(store: CalibrationStore) -> None:
    store.folder.mkdir()
    copied = document()
    (store.folder / f"{copied.id}.json").write_bytes(to_json(copied))
    assert store.read(copied.id) == copied
    assert [each.id for each in store.listed().calibrations] == [copied.id]
    with pytest.raises(UnknownNameError, match=f"calibration {copied.id} has no picture"):
        store.picture(copied.id)


@pytest.mark.parametrize(
    ("content", "trouble"),
    [
        (b"", "document: Invalid JSON"),
        (b"null", "document: Input should be an object"),
        (b"\xff\xfe", "document: Invalid JSON"),
        (b'{"version": 2}', "its version is 2, this program reads 1"),
        (b'{"version": {"a": 1}}', "its version is {'a': 1}, this program reads 1"),
        (b'{"kind": "response"}', "response.device_serial: Field required"),
        (b"[" * (10 * sys.getrecursionlimit()), "document: Invalid JSON: recursion limit exceeded"),
        (b'{"version": ' + b"9" * 10_000 + b"}", "document: Invalid JSON"),
    ],
)
def test_a_foreign_file_is_listed_with_its_trouble_beside_the_good_ones(
    store: CalibrationStore, content: bytes, trouble: str
) -> None:
    store.add(document(), PICTURE)
    (store.folder / "foreign.json").write_bytes(content)
    good, foreign = store.listed().calibrations
    assert good.trouble is None
    assert foreign.id == "foreign"
    assert f"foreign.json: {trouble}" in (foreign.trouble or "")
    assert len(foreign.trouble or "") < 400


@pytest.mark.parametrize(
    "put",
    [
        lambda folder: (folder / "folder.json").mkdir(),
        lambda folder: (folder / "link.json").symlink_to(folder / "nowhere"),
        lambda folder: (folder / "notes.txt").write_text("mine"),
        lambda folder: (folder / ".response-0.json.part").write_text("{"),
    ],
)
def test_what_is_no_file_of_a_calibration_is_not_listed(store: CalibrationStore, put: Callable[[Path], object]) -> None:
    added = document()
    store.add(added, PICTURE)
    put(store.folder)
    assert [each.id for each in store.listed().calibrations] == [added.id]


@pytest.mark.parametrize(
    "wanted",
    ["", ".", "..", "../calibrations/{id}", "./{id}", "{id}/", "{id}.json", "sub/{id}", "/etc/passwd", "a\0b", "\udcff",
     "response-000000000000", "a" * 300, "é" * 200],
)  # fmt: skip
def test_an_id_is_no_path(store: CalibrationStore, wanted: str) -> None:
    added = document()
    store.add(added, PICTURE)
    (store.folder / "sub").mkdir()
    (store.folder / "sub" / f"{added.id}.json").write_bytes(to_json(added))
    for ask in (store.read, store.picture):
        with pytest.raises(UnknownNameError, match="is unknown"):
            ask(wanted.replace("{id}", added.id))


def test_an_absolute_path_is_no_id(store: CalibrationStore, tmp_path: Path) -> None:
    outside = document()
    (tmp_path / f"{outside.id}.json").write_bytes(to_json(outside))
    store.folder.mkdir()
    with pytest.raises(UnknownNameError):
        store.read(str(tmp_path / outside.id))


def test_a_picture_that_cannot_be_written_leaves_no_calibration(store: CalibrationStore) -> None:
    added = document()
    (store.folder / f"{added.id}.png").mkdir(parents=True)
    with pytest.raises(OSError, match="directory"):
        store.add(added, PICTURE)
    assert store.listed().calibrations == ()
    assert [file.name for file in store.folder.iterdir()] == [f"{added.id}.png"]
