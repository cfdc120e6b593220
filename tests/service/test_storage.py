"""The database: what a scan went through, in order, whatever happens to the service in between."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong.types import Stop
from sidelong_service.events import Bulletin, follow
from sidelong_service.models import RecordedScene, RunState, Scan, ScanRequest
from sidelong_service.problems import problem
from sidelong_service.storage import MIGRATIONS, Storage, check_database
from sidelong_service.storage_thread import StorageThread

REQUEST = ScanRequest(part="tube_fitting")
START = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
ARTIFACT = {"name": "depth.png", "media_type": "image/png", "size_bytes": 7, "sha256": "0" * 64}
VIEW: dict[str, Any] = {
    "index": 0, "view": "v0", "objects": 1, "predicted_gain_px": 0.0, "measured_gain_px": 0.0, "missing_px": 9,
    "recovered_px": 0, "completeness": 0.0, "stage_s": {"move": 1.5}, "candidates": [],
}  # fmt: skip
SETUP: dict[str, Any] = {
    "part": "tube_fitting", "camera": "c", "arm": "a", "width_px": 4, "height_px": 3, "candidates": 2, "left_out": [],
    "recipe": {"planning": {}},
}  # fmt: skip


class Clock:
    """Goes on by a second each time it is read."""

    def __init__(self) -> None:
        self.now = START

    def __call__(self) -> datetime:
        self.now += timedelta(seconds=1)
        return self.now


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "folder" / "db.sqlite"


@pytest.fixture
def storage(file: Path) -> Iterator[Storage]:
    with closing(Storage(file, Clock())) as opened:
        yield opened


def known(storage: Storage, scan_id: str) -> Scan:
    scan = storage.scan(scan_id)
    assert scan is not None
    return scan


def test_an_accepted_scan_is_there_with_all_its_settings(storage: Storage) -> None:
    storage.create("a", REQUEST)
    scan = known(storage, "a")
    assert (scan.state, scan.part, scan.recording) == (RunState.ACCEPTED, "tube_fitting", None)
    assert scan.created_at == START + timedelta(seconds=1)
    assert (scan.started_at, scan.ended_at, scan.phase, scan.problem, scan.setup) == (None,) * 5
    assert (scan.views, scan.artifacts) == ((), ())
    assert scan.recipe == REQUEST.recipe.model_dump(mode="json")


def test_a_recorded_scene_comes_back_as_it_was_asked_for(storage: Storage) -> None:
    recording = RecordedScene(dataset="robi", object="Nut", scene=3, reference=None)
    storage.create("a", ScanRequest(recording=recording))
    assert known(storage, "a").recording == recording


def test_states_change_and_times_are_kept(storage: Storage) -> None:
    storage.create("a", REQUEST)
    storage.set_state("a", RunState.RUNNING)
    storage.add_event("a", "phase", {"phase": "move"})
    running = known(storage, "a")
    assert (running.state, running.phase, running.ended_at) == (RunState.RUNNING, "move", None)
    storage.set_state("a", RunState.STOPPING)
    assert known(storage, "a").started_at == running.started_at
    assert not storage.has_ended("a")
    storage.set_state("a", RunState.STOPPED)
    stopped = known(storage, "a")
    assert stopped.created_at < (stopped.started_at or START) < (stopped.ended_at or START)
    assert (stopped.state, stopped.phase) == (RunState.STOPPED, None)
    assert storage.has_ended("a")


def test_why_a_scan_ended_is_kept(storage: Storage) -> None:
    storage.create("good", REQUEST)
    storage.create("bad", REQUEST)
    storage.set_state("good", RunState.SUCCEEDED, Stop.MAX_VIEWS)
    trouble = problem("device-lost", "arm: gone", device="arm", scan_id="bad")
    storage.set_state("bad", RunState.FAILED, trouble=trouble)
    assert known(storage, "good").finish_reason is Stop.MAX_VIEWS
    assert known(storage, "bad").problem == trouble
    assert storage.events("bad")[-1].data["problem"]["device"] == "arm"


@pytest.mark.parametrize("end", [state for state in RunState if state.ended])
@pytest.mark.parametrize("later", RunState)
def test_an_ended_scan_stays_as_it_ended(storage: Storage, end: RunState, later: RunState) -> None:
    storage.create("a", REQUEST)
    storage.set_state("a", end, Stop.MAX_VIEWS)
    before, events = known(storage, "a"), storage.events("a")
    storage.set_state("a", later, trouble=problem("internal", "too late"))
    assert known(storage, "a") == before
    assert storage.events("a") == events


def test_what_is_told_of_an_unknown_scan_is_not_kept(storage: Storage) -> None:
    storage.set_state("nobody", RunState.RUNNING)
    with pytest.raises(sqlite3.IntegrityError):
        storage.add_event("nobody", "phase", {"phase": "move"})
    assert storage.scan("nobody") is None
    assert storage.has_ended("nobody")
    assert storage.events("nobody") == []


def test_an_id_is_given_once(storage: Storage) -> None:
    storage.create("a", REQUEST)
    with pytest.raises(sqlite3.IntegrityError):
        storage.create("a", REQUEST)
    assert [event.kind for event in storage.events("a")] == ["state"]


def test_an_event_that_is_no_json_changes_nothing(storage: Storage) -> None:
    storage.create("a", REQUEST)
    before = known(storage, "a"), storage.events("a")
    with pytest.raises(ValueError, match="JSON"):
        storage.add_event("a", "artifact", ARTIFACT | {"more": float("nan")})
    assert (known(storage, "a"), storage.events("a")) == before


def test_events_are_replayed_in_order_from_anywhere(storage: Storage) -> None:
    storage.create("a", REQUEST)
    storage.create("b", REQUEST)
    for number in range(5):
        storage.add_event("ab"[number % 2], "progress", {"done": number})
    events = storage.events("a")
    ids = [event.id for event in events]
    assert ids == sorted(set(ids))
    assert [event.data["done"] for event in events if event.kind == "progress"] == [0, 2, 4]
    for cut, last in enumerate(ids):
        assert storage.events("a", after=last) == events[cut + 1 :]
    assert [event.kind for event in storage.events("a", kind="state")] == ["state"]
    assert storage.events("a", after=2**63 - 1) == []


def test_events_fill_the_scan(storage: Storage) -> None:
    storage.create("a", REQUEST)
    storage.add_event("a", "setup", SETUP)
    storage.add_event("a", "view", VIEW)
    storage.add_event("a", "view", VIEW | {"index": 1, "view": "v1"})
    storage.add_event("a", "artifact", ARTIFACT)
    scan = known(storage, "a")
    assert scan.setup is not None
    assert scan.setup.width_px == 4
    assert [view.view for view in scan.views] == ["v0", "v1"]
    assert scan.artifacts == storage.artifacts("a")
    assert scan.artifacts[0].model_dump() == ARTIFACT


def test_a_file_that_is_written_again_is_listed_once(storage: Storage) -> None:
    storage.create("a", REQUEST)
    storage.add_event("a", "artifact", ARTIFACT)
    storage.add_event("a", "artifact", ARTIFACT | {"size_bytes": 8})
    assert [artifact.size_bytes for artifact in storage.artifacts("a")] == [8]


@given(count=st.integers(0, 12), limit=st.integers(1, 14))
def test_pages_give_each_scan_once_newest_first(
    tmp_path_factory: pytest.TempPathFactory, count: int, limit: int
) -> None:
    with closing(Storage(tmp_path_factory.mktemp("pages") / "db.sqlite", Clock())) as storage:
        for number in range(count):
            storage.create(f"scan{number}", REQUEST)
        paged: list[str] = []
        cursor = None
        while True:
            page = storage.scans(limit, cursor)
            assert len(page.scans) <= limit
            paged += [scan.id for scan in page.scans]
            cursor = page.next_cursor
            if cursor is None:
                break
        assert paged == [f"scan{number}" for number in reversed(range(count))]


def test_a_page_before_the_first_scan_is_empty(storage: Storage) -> None:
    storage.create("a", REQUEST)
    assert storage.scans(5, before=1).scans == ()
    assert len(storage.scans(5, before=2**63 - 1).scans) == 1


@pytest.mark.parametrize("exists", [False, True])
def test_a_missing_or_empty_file_becomes_a_database_of_this_version(tmp_path: Path, exists: bool) -> None:
    file = tmp_path / "db.sqlite"
    if exists:
        file.touch()
    with closing(Storage(file)) as storage:
        storage.create("a", REQUEST)
    with closing(sqlite3.connect(file)) as plain:
        assert plain.execute("PRAGMA user_version").fetchone() == (len(MIGRATIONS),)
        assert plain.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_a_database_of_a_later_version_is_left_alone(file: Path) -> None:
    with closing(Storage(file)) as storage:
        storage.create("a", REQUEST)
    with closing(sqlite3.connect(file)) as plain:
        plain.execute(f"PRAGMA user_version = {len(MIGRATIONS) + 1}")
    with pytest.raises(sqlite3.DatabaseError, match=rf"version is {len(MIGRATIONS) + 1}.*knows {len(MIGRATIONS)}"):
        Storage(file)


def test_open_scans_are_interrupted_and_ended_ones_are_not(storage: Storage) -> None:
    states = list(RunState)
    for state in states:
        storage.create(state, REQUEST)
        storage.set_state(state, state)
        storage.add_event(state, "artifact", ARTIFACT)
    assert storage.interrupt_open_runs() == sum(not state.ended for state in states)
    for state in states:
        scan = known(storage, state)
        assert scan.state is (state if state.ended else RunState.INTERRUPTED)
        assert len(scan.artifacts) == 1
        if not state.ended:
            assert scan.problem is not None
            assert scan.problem.type.endswith(":service-restarted")
            assert scan.problem.scan_id == state
    assert storage.interrupt_open_runs() == 0


def test_reopening_keeps_everything(file: Path) -> None:
    with closing(Storage(file, Clock())) as storage:
        storage.create("a", REQUEST)
        storage.set_state("a", RunState.RUNNING)
        storage.add_event("a", "setup", SETUP)
        storage.add_event("a", "view", VIEW)
        storage.add_event("a", "artifact", ARTIFACT)
        storage.set_state("a", RunState.SUCCEEDED, Stop.NOTHING_MISSING)
        before = known(storage, "a"), storage.events("a"), storage.scans(10)
    with closing(Storage(file, Clock())) as storage:
        assert (known(storage, "a"), storage.events("a"), storage.scans(10)) == before
        storage.create("b", REQUEST)
        assert storage.events("b")[0].id > before[1][-1].id


def test_a_process_that_never_closed_loses_nothing(file: Path) -> None:
    left_open = Storage(file, Clock())
    left_open.create("a", REQUEST)
    left_open.set_state("a", RunState.RUNNING)
    with closing(Storage(file, Clock())) as storage:
        assert known(storage, "a").state is RunState.RUNNING
    left_open.close()


def test_check_makes_a_database_and_accepts_a_whole_one(file: Path) -> None:
    check_database(file)
    with closing(Storage(file)) as storage:
        storage.create("a", REQUEST)
    check_database(file)
    with closing(Storage(file)) as storage:
        assert known(storage, "a").state is RunState.ACCEPTED


def test_check_finds_what_is_no_database(file: Path) -> None:
    file.parent.mkdir()
    file.write_bytes(b"no database " * 1000)
    with pytest.raises(sqlite3.DatabaseError, match="not a database"):
        check_database(file)
    assert file.read_bytes() == b"no database " * 1000


def test_check_finds_damaged_pages(file: Path) -> None:
    with closing(Storage(file)) as storage:
        for number in range(200):
            storage.create(f"scan{number}", REQUEST)
    content = bytearray(file.read_bytes())
    content[8 * 4096 : 12 * 4096] = b"\xff" * 4 * 4096
    file.write_bytes(content)
    with pytest.raises(sqlite3.DatabaseError):
        check_database(file)


def test_calls_from_the_loop_are_made_in_their_order(file: Path) -> None:
    async def many() -> list[int]:
        thread = StorageThread(file)
        await thread.open()
        await thread.call(Storage.create, "a", REQUEST)
        await asyncio.gather(
            *(thread.call(Storage.add_event, "a", "progress", {"done": number}) for number in range(50))
        )
        events = await thread.call(Storage.events, "a", kind="progress")
        await thread.close()
        return [event.data["done"] for event in events]

    assert asyncio.run(many()) == list(range(50))


def test_a_storage_that_is_not_open_says_so(file: Path) -> None:
    with pytest.raises(RuntimeError, match="not open"):
        asyncio.run(StorageThread(file).call(Storage.scans, 1))


def test_followers_hear_everything_once_and_end_with_the_scan(file: Path) -> None:
    async def follow_live() -> tuple[list[list[int]], list[int]]:
        thread, bulletin = StorageThread(file), Bulletin()
        await thread.open()
        await thread.call(Storage.create, "a", REQUEST)

        async def listen() -> list[int]:
            return [event.id async for event in follow(thread, bulletin, "a", 0)]

        listeners = [asyncio.create_task(listen()) for _ in range(5)]
        for number in range(20):
            await thread.call(Storage.add_event, "a", "progress", {"done": number})
            bulletin.post()
        await thread.call(Storage.set_state, "a", RunState.STOPPED)
        bulletin.post()
        heard = await asyncio.gather(*listeners)
        kept = [event.id for event in await thread.call(Storage.events, "a")]
        await thread.close()
        return list(heard), kept

    heard, kept = asyncio.run(follow_live())
    assert heard == [kept] * 5


def test_followers_of_a_scan_that_goes_on_end_with_the_service(file: Path) -> None:
    async def follow_to_the_end() -> int:
        thread, bulletin = StorageThread(file), Bulletin()
        await thread.open()
        await thread.call(Storage.create, "a", REQUEST)
        asyncio.get_running_loop().call_later(0.05, bulletin.close)
        heard = [event async for event in follow(thread, bulletin, "a", 0)]
        await thread.close()
        return len(heard)

    assert asyncio.run(follow_to_the_end()) == 1
