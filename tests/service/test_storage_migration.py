"""A database of the version before calibration jobs: opened by today's storage, with all it held, and jobs beside."""

from __future__ import annotations

import gc
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sidelong.commissioning.tasks import ResponseTask
from sidelong.types import Stop
from sidelong_service.models import CalibrationJob, CalibrationRequest, JobEvent, RunState, ScanEvent, ScanRequest
from sidelong_service.problems import problem
from sidelong_service.storage import MIGRATIONS, Storage, check_database

START = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
REQUEST = ScanRequest(part="tube_fitting")
JOB = CalibrationRequest(dataset="robi", object="Tube_fitting", task=ResponseTask())
VIEW: dict[str, Any] = {
    "index": 0, "view": "v0", "objects": 1, "predicted_gain_px": 0.0, "measured_gain_px": 0.0, "missing_px": 9,
    "recovered_px": 0, "completeness": 0.0, "stage_s": {"move": 1.5}, "candidates": [],
}  # fmt: skip
SETUP: dict[str, Any] = {
    "part": "tube_fitting", "camera": "c", "arm": "a", "width_px": 4, "height_px": 3, "candidates": 2, "left_out": [],
    "recipe": {"planning": {}},
}  # fmt: skip
TROUBLE = problem("device", "camera: is gone", scan_id="failed")
SCANS = (
    ("done", RunState.SUCCEEDED, Stop.MAX_VIEWS, None),
    ("failed", RunState.FAILED, None, TROUBLE.model_dump_json(exclude_none=True)),
    ("left", RunState.RUNNING, None, None),
)
EVENTS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("done", "state", {"state": "accepted"}), ("done", "setup", SETUP), ("failed", "state", {"state": "accepted"}),
    ("done", "view", VIEW), ("left", "state", {"state": "accepted"}),
    ("done", "state", {"state": "succeeded", "finish_reason": "max_views"}),
)  # fmt: skip
ARTIFACTS = (("depth.png", "image/png", 7, "0" * 64), ("report.json", "application/json", 9, "1" * 64))


def stamp(seconds: int) -> str:
    return (START + timedelta(seconds=seconds)).isoformat(timespec="milliseconds")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A database as the first version left it: made with its script, written in plain SQL."""
    path = tmp_path / "sidelong.sqlite"
    with closing(sqlite3.connect(path)) as db:
        db.executescript(f"{MIGRATIONS[0]} PRAGMA user_version = 1;")
        db.execute("PRAGMA foreign_keys = ON")
        for index, (scan_id, state, reason, trouble) in enumerate(SCANS):
            db.execute(
                "INSERT INTO scans (id, state, finish_reason, problem, request, created_at, started_at, ended_at) "
                "VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                (scan_id, state, reason, trouble, REQUEST.model_dump_json(), stamp(index), stamp(index + 1),
                 stamp(index + 2) if state.ended else None),
            )  # fmt: skip
        for index, (scan_id, kind, data) in enumerate(EVENTS):
            db.execute(
                "INSERT INTO events (scan, kind, at, data) VALUES (?, ?, ?, ?)",
                (scan_id, kind, stamp(index), json.dumps(data)),
            )
        db.executemany("INSERT INTO artifacts VALUES ('done', ?, ?, ?, ?)", ARTIFACTS)
        db.commit()
    return path


@pytest.fixture
def storage(file: Path) -> Iterator[Storage]:
    with closing(Storage(file)) as opened:
        yield opened


def known_job(storage: Storage, job_id: str) -> CalibrationJob:
    job = storage.job(job_id)
    assert job is not None
    return job


def test_scans_of_the_former_version_are_all_there(storage: Storage) -> None:
    assert [scan.id for scan in storage.scans(10).scans] == ["left", "failed", "done"]
    done = storage.scan("done")
    assert done is not None
    assert (done.state, done.finish_reason, done.part) == (RunState.SUCCEEDED, Stop.MAX_VIEWS, "tube_fitting")
    assert (done.created_at, done.ended_at) == (START, START + timedelta(seconds=2))
    assert done.recipe == REQUEST.recipe.model_dump(mode="json")
    assert done.setup is not None
    assert done.setup.model_dump(mode="json") == SETUP | {"repairs": []}
    unknown_then = {"poses": [], "state_px": {}, "fused": None}
    assert [view.model_dump(mode="json") for view in done.views] == [VIEW | unknown_then]
    artifacts = [(a.name, a.media_type, a.size_bytes, a.sha256) for a in done.artifacts]
    assert artifacts == list(ARTIFACTS)
    failed = storage.scan("failed")
    assert failed is not None
    assert failed.problem == TROUBLE


def test_events_of_the_former_version_keep_their_numbers(storage: Storage) -> None:
    events = storage.events("done")
    assert [(event.id, event.kind) for event in events] == [(1, "state"), (2, "setup"), (4, "view"), (6, "state")]
    assert all(isinstance(event, ScanEvent) for event in events)
    assert [event.id for event in storage.events("done", after=2)] == [4, 6]
    storage.add_event("left", "phase", {"phase": "detect"})
    assert storage.events("left")[-1].id == 7


def test_opening_again_migrates_no_more(file: Path) -> None:
    contents: list[list[str]] = []
    for _ in range(2):
        check_database(file)
        with closing(sqlite3.connect(file)) as db:
            assert db.execute("PRAGMA user_version").fetchone()[0] == len(MIGRATIONS)
            assert db.execute("PRAGMA foreign_key_check").fetchall() == []
            contents.append(list(db.iterdump()))
    assert contents[0] == contents[1]


def test_a_migrated_database_refuses_what_belongs_to_no_run(storage: Storage) -> None:
    with pytest.raises(sqlite3.IntegrityError, match="FOREIGN KEY"):
        storage.add_event("nobody", "phase", {"phase": "detect"})
    with pytest.raises(sqlite3.IntegrityError, match="UNIQUE"):
        storage.create("done", JOB)


def test_a_migration_that_breaks_off_leaves_the_former_version(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(sqlite3.connect(file)) as db:
        before = list(db.iterdump())
    broken = (MIGRATIONS[0], MIGRATIONS[1] + "ALTER TABLE nothing RENAME TO something;")
    monkeypatch.setattr("sidelong_service.storage.MIGRATIONS", broken)
    with pytest.raises(sqlite3.OperationalError, match="nothing"):
        Storage(file)
    monkeypatch.undo()
    gc.collect()  # the failed one has not closed its connection
    with closing(sqlite3.connect(file)) as db:
        assert db.execute("PRAGMA user_version").fetchone()[0] == 1
        assert list(db.iterdump()) == before
    with closing(Storage(file)) as storage:
        assert len(storage.scans(10).scans) == len(SCANS)


def test_the_former_version_refuses_a_migrated_database(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_database(file)
    monkeypatch.setattr("sidelong_service.storage.MIGRATIONS", MIGRATIONS[:1])
    with pytest.raises(sqlite3.DatabaseError, match="its version is 2, this service knows 1"):
        Storage(file)


def test_a_migrated_and_a_new_database_have_the_same_tables(file: Path, tmp_path: Path) -> None:
    tables: list[dict[str, Any]] = []
    for path in (file, tmp_path / "new.sqlite"):
        check_database(path)
        with closing(sqlite3.connect(path)) as db:
            names = [row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
            tables.append({name: db.execute(f"PRAGMA table_info({name})").fetchall() for name in names})
    assert tables[0] == tables[1]


def test_jobs_and_scans_stand_beside_each_other_and_do_not_mix(storage: Storage) -> None:
    for number in range(3):
        storage.create(f"job-{number}", JOB)
        storage.create(f"scan-{number}", REQUEST)
    assert [job.id for job in storage.jobs(10).jobs] == ["job-2", "job-1", "job-0"]
    assert [scan.id for scan in storage.scans(3).scans] == ["scan-2", "scan-1", "scan-0"]
    assert storage.scan("job-0") is None
    assert storage.job("scan-0") is None
    assert storage.job("done") is None
    assert not storage.has_ended("job-0")
    assert all(isinstance(event, JobEvent) for event in storage.events("job-0"))
    assert all(isinstance(event, ScanEvent) for event in storage.events("scan-0"))


def test_cursors_of_jobs_and_of_scans_pass_over_each_other(storage: Storage) -> None:
    for number in range(5):
        storage.create(f"job-{number}", JOB)
        storage.create(f"scan-{number}", REQUEST)
    jobs: list[str] = []
    cursor = None
    while True:
        page = storage.jobs(2, cursor)
        jobs += [job.id for job in page.jobs]
        cursor = page.next_cursor
        if cursor is None:
            break
        assert len(page.jobs) == 2
    assert jobs == [f"job-{number}" for number in (4, 3, 2, 1, 0)]
    scans: list[str] = []
    while True:
        listed = storage.scans(3, cursor)
        scans += [scan.id for scan in listed.scans]
        cursor = listed.next_cursor
        if cursor is None:
            break
    assert scans == [*(f"scan-{number}" for number in (4, 3, 2, 1, 0)), "left", "failed", "done"]


def test_a_job_has_its_request_its_times_and_what_it_made(storage: Storage) -> None:
    storage.create("job", JOB)
    storage.set_state("job", RunState.RUNNING)
    storage.add_event("job", "progress", {"work": "response", "done": 0, "total": 3})
    for made in ("response-000000000001", "response-000000000002"):
        storage.add_event("job", "calibration", {"id": made, "kind": "response", "material": None, "warnings": []})
    storage.set_state("job", RunState.SUCCEEDED)
    job = known_job(storage, "job")
    assert job.request == JOB.model_dump(mode="json")
    assert job.calibrations == ("response-000000000001", "response-000000000002")
    assert (job.state, job.problem) == (RunState.SUCCEEDED, None)
    assert job.started_at is not None
    assert job.ended_at is not None
    assert [event.kind for event in storage.events("job")] == [
        "state", "state", "progress", "calibration", "calibration", "state"
    ]  # fmt: skip
    assert [event.data.get("id") for event in storage.events("job", kind="calibration")] == list(job.calibrations)


def test_runs_that_a_former_service_left_open_are_interrupted(storage: Storage) -> None:
    storage.create("open", JOB)
    storage.set_state("open", RunState.RUNNING)
    storage.create("ended", JOB)
    storage.set_state("ended", RunState.SUCCEEDED)
    assert storage.interrupt_open_runs() == 2
    left, job = storage.scan("left"), known_job(storage, "open")
    assert left is not None
    assert (left.state, job.state) == (RunState.INTERRUPTED, RunState.INTERRUPTED)
    assert left.problem is not None
    assert job.problem is not None
    assert (left.problem.type, job.problem.type) == ("urn:sidelong:problem:service-restarted",) * 2
    assert (left.problem.scan_id, left.problem.job_id) == ("left", None)
    assert known_job(storage, "ended").state is RunState.SUCCEEDED
    assert storage.interrupt_open_runs() == 0


def test_an_interrupted_job_is_named_as_a_job(storage: Storage) -> None:
    storage.create("open", JOB)
    storage.interrupt_open_runs()
    job = known_job(storage, "open")
    assert job.problem is not None
    assert (job.problem.scan_id, job.problem.job_id) == (None, "open")
