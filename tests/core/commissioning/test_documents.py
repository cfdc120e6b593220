"""Calibration files: what was written is read, and anything else is refused with the field that is wrong."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from calibration_examples import (
    hand_eye_document,
    material_document,
    noise_document,
    projector_document,
    response_document,
    sensing_document,
)

from sidelong.commissioning.documents import Document, hashed, read_document, to_json
from sidelong.errors import CalibrationError

MAKERS: tuple[Callable[..., Document], ...] = (
    response_document, projector_document, material_document, sensing_document, hand_eye_document,
    noise_document,
)  # fmt: skip
kinds = pytest.mark.parametrize("make", MAKERS)


@kinds
def test_a_calibration_comes_back_from_its_file(make: Callable[..., Document], tmp_path: Path) -> None:
    document = make()
    path = tmp_path / f"{document.id}.json"
    path.write_bytes(to_json(document))
    assert read_document(path) == document


@kinds
def test_ids_tell_kind_and_content_apart(make: Callable[..., Document]) -> None:
    document, other = make(), make(device_serial="N35-2")
    assert document.id.startswith(document.kind.replace("_", "-"))
    assert document.id != other.id
    assert document.sealed().id == document.id


@kinds
def test_a_file_that_was_changed_is_refused(make: Callable[..., Document], tmp_path: Path) -> None:
    content = json.loads(to_json(make()))
    content["device_serial"] = "N35-2"
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match=r"changed\.json: was changed after it was written"):
        read_document(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"a\.json: document: Invalid JSON"),
        ("[]", r"a\.json: document: "),
        ("{}", r"a\.json: document: Unable to extract tag"),
        ('{"kind": "colour"}', r"a\.json: document: .*'colour'"),
        ('{"version": 2, "kind": "response"}', r"a\.json: its version is 2, this program reads 1"),
        ('{"kind": "response"}', r"a\.json: response\.device_serial: Field required"),
    ],
)
def test_a_file_that_is_no_calibration_is_refused_with_the_field(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(CalibrationError, match=message):
        read_document(tmp_path / "a.json")


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999", "true", '"1"'])
def test_what_is_no_finite_number_is_refused(tmp_path: Path, number: str) -> None:
    text = to_json(response_document()).decode().replace('"condition": 10000.0', f'"condition": {number}')
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(CalibrationError, match=r"a\.json: response\.condition: "):
        read_document(tmp_path / "a.json")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"nothing\.json: no such calibration file"):
        read_document(tmp_path / "nothing.json")
    with pytest.raises(CalibrationError, match="cannot be read: Is a directory"):
        read_document(tmp_path)


def test_inputs_are_named_below_the_data_set_and_hashed(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b.bmp").write_bytes(b"bytes")
    (inside,) = hashed([tmp_path / "a" / "b.bmp"], tmp_path)
    assert inside.name == "a/b.bmp"
    assert inside.sha256 == hashlib.sha256(b"bytes").hexdigest()
