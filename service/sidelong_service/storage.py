"""What outlives the service: scans and jobs, their events and the names of their files, in one SQLite database.

One connection, owned by one thread. Both are runs: a row holds the present state, events are the truth about the
course. The files of a scan lie in ``<data_dir>/scans/<id>/``.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sidelong.types import Stop
from sidelong_service.models import (
    Artifact,
    CalibrationJob,
    CalibrationRequest,
    EventKind,
    JobEvent,
    JobList,
    RunKind,
    RunState,
    Scan,
    ScanEvent,
    ScanList,
    ScanRequest,
    ScanSummary,
    Setup,
    ViewReport,
)
from sidelong_service.problems import Problem, problem

MIGRATIONS = (
    """
    CREATE TABLE scans (
        seq INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, state TEXT NOT NULL, phase TEXT,
        finish_reason TEXT, problem TEXT, request TEXT NOT NULL,
        created_at TEXT NOT NULL, started_at TEXT, ended_at TEXT
    ) STRICT;
    CREATE TABLE events (
        id INTEGER PRIMARY KEY AUTOINCREMENT, scan TEXT NOT NULL REFERENCES scans(id), kind TEXT NOT NULL,
        at TEXT NOT NULL, data TEXT NOT NULL
    ) STRICT;
    CREATE INDEX events_of_scan ON events(scan, id);
    CREATE TABLE artifacts (
        scan TEXT NOT NULL REFERENCES scans(id), name TEXT NOT NULL, media_type TEXT NOT NULL,
        size_bytes INTEGER NOT NULL, sha256 TEXT NOT NULL, PRIMARY KEY (scan, name)
    ) STRICT;
    """,
    # jobs go the way of scans
    """
    ALTER TABLE scans RENAME TO runs;
    ALTER TABLE runs ADD COLUMN kind TEXT NOT NULL DEFAULT 'scan';
    ALTER TABLE events RENAME COLUMN scan TO run;
    ALTER TABLE artifacts RENAME COLUMN scan TO run;
    """,
)
"""Applied in order; ``user_version`` counts those a database has had."""

_OPEN_STATES = tuple(state.value for state in RunState if not state.ended)


def utc_now() -> datetime:
    """Return the present time."""
    return datetime.now(UTC)


def check_database(file: Path) -> None:
    """Open or make the database and look through its pages.

    Raises
    ------
    OSError, sqlite3.Error
        It cannot be made or written, is damaged, or comes from a later version.
    """
    with closing(Storage(file)) as storage:
        storage.check()


class Storage:
    """The database. All calls must come from the thread that made it."""

    def __init__(self, file: Path, now: Callable[[], datetime] = utc_now) -> None:
        file.parent.mkdir(parents=True, exist_ok=True)
        self._now = now
        self._db = sqlite3.connect(file, isolation_level=None)
        self._db.row_factory = sqlite3.Row
        try:
            self._db.execute("PRAGMA journal_mode = WAL")
            self._db.execute("PRAGMA synchronous = FULL")
            self._db.execute("PRAGMA foreign_keys = ON")
            self._migrate()
        except BaseException:
            # a migration that failed holds a lock as long as the connection lives
            self._db.close()
            raise

    def check(self) -> None:
        """Look through all pages. Raises sqlite3.DatabaseError where they are damaged."""
        found = str(self._db.execute("PRAGMA quick_check(1)").fetchone()[0])
        if found != "ok":
            raise sqlite3.DatabaseError(f"its pages are damaged: {found}")

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def create(self, run_id: str, request: ScanRequest | CalibrationRequest) -> None:
        """Add an accepted scan or job."""
        kind = RunKind.SCAN if isinstance(request, ScanRequest) else RunKind.CALIBRATION
        with self._transaction():
            self._db.execute(
                "INSERT INTO runs (id, kind, state, request, created_at) VALUES (?, ?, ?, ?, ?)",
                (run_id, kind, RunState.ACCEPTED, request.model_dump_json(), self._stamp()),
            )
            self._add_event(run_id, "state", {"state": RunState.ACCEPTED})

    def set_state(
        self, run_id: str, state: RunState, finish_reason: Stop | None = None, trouble: Problem | None = None
    ) -> None:
        """Change the state of a run; an ended one stays as it is."""
        with self._transaction():
            row = self._row(run_id)
            if row is None or RunState(row["state"]).ended:
                return
            document = None if trouble is None else trouble.model_dump_json(exclude_none=True)
            self._db.execute(
                "UPDATE runs SET state = ?, finish_reason = ?, problem = ?, started_at = ?, ended_at = ?, phase = ? "
                "WHERE id = ?",
                (
                    state,
                    finish_reason,
                    document,
                    row["started_at"] or (self._stamp() if state is RunState.RUNNING else None),
                    self._stamp() if state.ended else None,
                    None if state.ended else row["phase"],
                    run_id,
                ),
            )
            data = {"state": state, "finish_reason": finish_reason, "problem": document and json.loads(document)}
            self._add_event(run_id, "state", data)

    def add_event(self, run_id: str, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Add an event; a phase and an artifact enter their tables too."""
        with self._transaction():
            if kind == "phase":
                self._db.execute("UPDATE runs SET phase = ? WHERE id = ?", (data["phase"], run_id))
            if kind == "artifact":
                self._db.execute(
                    "INSERT OR REPLACE INTO artifacts (run, name, media_type, size_bytes, sha256) "
                    "VALUES (:run, :name, :media_type, :size_bytes, :sha256)",
                    {"run": run_id, **data},
                )
            self._add_event(run_id, kind, data)

    def interrupt_open_runs(self) -> int:
        """Mark runs that a former service left open as interrupted, and return how many there were."""
        query = f"SELECT id FROM runs WHERE state IN ({','.join('?' * len(_OPEN_STATES))})"
        left = [str(row["id"]) for row in self._db.execute(query, _OPEN_STATES)]
        for run_id in left:
            row = self._row(run_id)
            owner = "scan_id" if row is not None and row["kind"] == RunKind.SCAN else "job_id"
            trouble = problem("service-restarted", "The service ended while this was active.", **{owner: run_id})
            self.set_state(run_id, RunState.INTERRUPTED, trouble=trouble)
        return len(left)

    def scan(self, scan_id: str) -> Scan | None:
        """Return a scan with all it knows, None where there is none."""
        row = self._row(scan_id)
        if row is None or row["kind"] != RunKind.SCAN:
            return None
        request = ScanRequest.model_validate_json(row["request"])
        setups = [Setup.model_validate(event.data) for event in self.events(scan_id, kind="setup")]
        return Scan(
            **dict(_summary(row, request)),
            problem=Problem.model_validate_json(row["problem"]) if row["problem"] else None,
            recipe=request.recipe.model_dump(mode="json"),
            setup=setups[-1] if setups else None,
            views=tuple(ViewReport.model_validate(event.data) for event in self.events(scan_id, kind="view")),
            artifacts=self.artifacts(scan_id),
        )

    def job(self, job_id: str) -> CalibrationJob | None:
        """Return a calibration job with all it knows, None where there is none."""
        row = self._row(job_id)
        return None if row is None or row["kind"] != RunKind.CALIBRATION else self._job(row)

    def has_ended(self, run_id: str) -> bool:
        """Say whether nothing more happens to a run; true where there is none."""
        row = self._row(run_id)
        return row is None or RunState(row["state"]).ended

    def scans(self, limit: int, before: int | None = None) -> ScanList:
        """Return the newest scans, or those before a cursor."""
        rows, cursor = self._newest(RunKind.SCAN, limit, before)
        summaries = [_summary(row, ScanRequest.model_validate_json(row["request"])) for row in rows]
        return ScanList(scans=tuple(summaries), next_cursor=cursor)

    def jobs(self, limit: int, before: int | None = None) -> JobList:
        """Return the newest calibration jobs, or those before a cursor."""
        rows, cursor = self._newest(RunKind.CALIBRATION, limit, before)
        return JobList(jobs=tuple(self._job(row) for row in rows), next_cursor=cursor)

    def events(self, run_id: str, after: int = 0, kind: EventKind | None = None) -> list[ScanEvent | JobEvent]:
        """Return the events of a run after the given one, oldest first."""
        query = (
            "SELECT events.*, runs.kind AS owner FROM events JOIN runs ON runs.id = events.run "
            "WHERE run = ? AND events.id > ? AND events.kind = coalesce(?, events.kind) ORDER BY events.id"
        )
        return [_event(row) for row in self._db.execute(query, (run_id, after, kind))]

    def artifacts(self, scan_id: str) -> tuple[Artifact, ...]:
        """Return the files of a scan, in the order they were made."""
        rows = self._db.execute("SELECT * FROM artifacts WHERE run = ? ORDER BY rowid", (scan_id,))
        return tuple(Artifact.model_validate({key: row[key] for key in Artifact.model_fields}) for row in rows)

    def _row(self, run_id: str) -> sqlite3.Row | None:
        return self._db.execute("SELECT * FROM runs WHERE id = ?", (run_id,)).fetchone()

    def _newest(self, kind: RunKind, limit: int, before: int | None) -> tuple[list[sqlite3.Row], int | None]:
        """Return the newest runs of a kind before a cursor, and the cursor of older ones."""
        query = "SELECT * FROM runs WHERE kind = ? AND seq < ? ORDER BY seq DESC LIMIT ?"
        rows = self._db.execute(query, (kind, before if before is not None else 2**63 - 1, limit + 1)).fetchall()
        return rows[:limit], rows[limit - 1]["seq"] if len(rows) > limit else None

    def _job(self, row: sqlite3.Row) -> CalibrationJob:
        request = CalibrationRequest.model_validate_json(row["request"])
        columns = ("id", "state", "phase", "created_at", "started_at", "ended_at")
        return CalibrationJob(
            **{name: row[name] for name in columns},
            request=request.model_dump(mode="json"),
            problem=Problem.model_validate_json(row["problem"]) if row["problem"] else None,
            calibrations=tuple(event.data["id"] for event in self.events(row["id"], kind="calibration")),
        )

    def _add_event(self, run_id: str, kind: EventKind, data: Mapping[str, Any]) -> None:
        given = json.dumps({key: value for key, value in data.items() if value is not None}, allow_nan=False)
        self._db.execute(
            "INSERT INTO events (run, kind, at, data) VALUES (?, ?, ?, ?)", (run_id, kind, self._stamp(), given)
        )

    def _stamp(self) -> str:
        return self._now().isoformat(timespec="milliseconds")

    @contextmanager
    def _transaction(self) -> Generator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._db.execute("ROLLBACK")
            raise
        self._db.execute("COMMIT")

    def _migrate(self) -> None:
        version = int(self._db.execute("PRAGMA user_version").fetchone()[0])
        if version > len(MIGRATIONS):
            raise sqlite3.DatabaseError(f"its version is {version}, this service knows {len(MIGRATIONS)}")
        for number, script in enumerate(MIGRATIONS[version:], start=version + 1):
            self._db.executescript(f"BEGIN IMMEDIATE; {script} PRAGMA user_version = {number}; COMMIT;")


def _summary(row: sqlite3.Row, request: ScanRequest) -> ScanSummary:
    columns = ("id", "state", "phase", "finish_reason", "created_at", "started_at", "ended_at")
    values = {name: row[name] for name in columns}
    return ScanSummary.model_validate({**values, "part": request.part, "recording": request.recording})


def _event(row: sqlite3.Row) -> ScanEvent | JobEvent:
    about = {**{key: row[key] for key in ("id", "kind", "at")}, "data": json.loads(row["data"])}
    if row["owner"] == RunKind.SCAN:
        return ScanEvent.model_validate(about | {"scan": row["run"]})
    return JobEvent.model_validate(about | {"job": row["run"]})
