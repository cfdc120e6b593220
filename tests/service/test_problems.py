"""The table of problems, and what an exception may tell the caller."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator

import pytest
from pydantic import ValidationError

from sidelong import errors
from sidelong_service.messages import ErrorReport
from sidelong_service.models import ScanRequest
from sidelong_service.problems import (
    KIND_OF_ERROR,
    KINDS,
    LONGEST_VALUE,
    Problem,
    problem,
    problem_of,
    validation_problem,
)


def classes(base: type[errors.SidelongError] = errors.SidelongError) -> Iterator[type[errors.SidelongError]]:
    for kind in base.__subclasses__():
        yield kind
        yield from classes(kind)


def example(kind: type[errors.SidelongError]) -> errors.SidelongError:
    if issubclass(kind, errors.DeviceError):
        return kind("the arm", "is 3 mm off, limit 1 mm")
    return kind("part.stl: is 3 mm off, limit 1 mm")


def test_codes_and_titles_tell_kinds_apart() -> None:
    assert len({kind.code for kind in KINDS.values()}) == len(KINDS)
    assert len({kind.title for kind in KINDS.values()}) == len(KINDS)


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_has_a_status_of_an_error_and_tells_people_what_to_do(name: str) -> None:
    kind = KINDS[name]
    assert 400 <= kind.status < 600
    assert re.fullmatch(r"[a-z]+(-[a-z]+)*", name)
    assert kind.operator_action.endswith(".")
    assert not kind.title.endswith(".")
    made = problem(name, "what happened")
    assert (made.type, made.status, made.code) == (f"urn:sidelong:problem:{name}", kind.status, kind.code)


@pytest.mark.parametrize("kind", list(classes()))
def test_each_error_of_ours_has_its_kind_and_keeps_its_message(kind: type[errors.SidelongError]) -> None:
    assert kind in KIND_OF_ERROR
    error = example(kind)
    made = problem_of(error)
    assert made.type == f"urn:sidelong:problem:{KIND_OF_ERROR[kind]}"
    assert made.detail == str(error)
    assert "limit 1 mm" in made.detail
    assert made.device == ("the arm" if isinstance(error, errors.DeviceError) else None)


def test_kinds_of_errors_are_kinds_of_problems() -> None:
    assert set(KIND_OF_ERROR.values()) <= set(KINDS)


def test_an_error_class_of_tomorrow_takes_the_kind_of_its_base() -> None:
    class RustError(errors.MeshError):
        pass

    assert problem_of(RustError("part.stl: is rusty")).type.endswith(":mesh")


@pytest.mark.parametrize("kind", [*classes(), errors.SidelongError])
def test_each_error_of_ours_comes_through_to_another_process(kind: type[errors.SidelongError]) -> None:
    sent = example(kind)
    come = ErrorReport.model_validate_json(ErrorReport.of(sent).model_dump_json()).error()
    assert type(come) is kind
    assert str(come) == str(sent)


def test_an_error_that_the_other_side_does_not_know_is_its_nearest_base() -> None:
    assert type(ErrorReport(name="Later", text="x").error()) is errors.SidelongError
    later = ErrorReport(name="LaterError", text="is off", device="arm").error()
    assert (type(later), str(later)) == (errors.DeviceError, "arm: is off")


def test_a_disk_error_names_file_and_reason() -> None:
    made = problem_of(FileNotFoundError(2, "No such file or directory", "/data/depth.png"))
    assert made.type.endswith(":storage")
    assert made.detail == "/data/depth.png: No such file or directory (ENOENT)"


@pytest.mark.parametrize("error", [OSError(), OSError("nothing but words"), OSError(28, "No space left on device")])
def test_a_disk_error_without_a_file_name_is_told_too(error: OSError) -> None:
    made = problem_of(error)
    assert (made.type, made.status) == ("urn:sidelong:problem:storage", 507)
    assert made.detail.startswith("a file: ")
    assert "None" not in made.detail


def test_a_database_error_is_one_of_the_data_directory() -> None:
    made = problem_of(sqlite3.OperationalError("database is locked"))
    assert (made.type, made.retryable) == ("urn:sidelong:problem:storage", True)
    assert "database is locked" in made.detail


@pytest.mark.parametrize(
    "error", [ValueError("secret"), KeyError("secret"), RuntimeError("secret"), SystemExit("secret")]
)
def test_an_unexpected_error_shows_nothing_of_itself(error: BaseException) -> None:
    document = problem_of(error).model_dump_json()
    assert "secret" not in document
    assert type(error).__name__ not in document
    assert problem_of(error).status == 500


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_that_json_does_not_know_are_told_in_valid_json(number: str) -> None:
    with pytest.raises(ValidationError) as caught:
        ScanRequest.model_validate_json(f'{{"part": "x", "recipe": {{"depth_exposure_s": {number}}}}}')
    made = validation_problem([dict(error) for error in caught.value.errors()])
    text = json.dumps(made.model_dump(mode="json"), allow_nan=False)
    assert Problem.model_validate_json(text) == made
    assert "recipe.depth_exposure_s: " in made.detail
    assert made.errors is not None
    assert made.errors[0].value in ("nan", "inf", "-inf")


def test_field_value_and_limit_stand_in_the_detail() -> None:
    with pytest.raises(ValidationError) as caught:
        ScanRequest.model_validate({"part": "x", "recipe": {"planning": {"max_views": 101}}})
    made = validation_problem([dict(error) for error in caught.value.errors()])
    assert made.detail == "recipe.planning.max_views: Input should be less than or equal to 100, got 101"


def test_values_are_cut_and_the_rest_of_many_is_counted() -> None:
    found = [{"loc": ("field", index), "msg": "is wrong", "input": "x" * 10_000} for index in range(7)]
    made = validation_problem(found)
    assert made.errors is not None
    assert len(made.errors) == 7
    assert all(len(field.value or "") == LONGEST_VALUE for field in made.errors)
    assert made.detail.endswith("; and 4 more")


def test_a_wrong_document_is_not_repeated_as_the_value_of_a_field() -> None:
    made = validation_problem([{"loc": (), "msg": "is wrong", "input": {"password": "x"}}])
    assert made.errors is not None
    assert (made.errors[0].field, made.errors[0].value) == ("body", None)
    assert made.detail == "body: is wrong"
