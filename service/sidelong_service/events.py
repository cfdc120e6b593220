"""The course of a scan or job as server-sent events, always read from the database: so ids and replay hold."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator

from sidelong_service.models import JobEvent, ScanEvent
from sidelong_service.storage import Storage
from sidelong_service.storage_thread import StorageThread

PING_S = 15
"""How often a stream that has no news says so."""


class Bulletin:
    """Wakes all who wait for news; whoever is woken looks for himself what is new."""

    def __init__(self) -> None:
        self._news = asyncio.Event()
        self.closed = False

    def post(self) -> None:
        """There is something new."""
        news, self._news = self._news, asyncio.Event()
        news.set()

    def close(self) -> None:
        """There will be nothing new any more."""
        self.closed = True
        self.post()

    def news(self) -> asyncio.Event:
        """Return what is set at the next news. Take it first, then look, then wait: so nothing is missed."""
        return self._news


async def follow(
    storage: StorageThread, bulletin: Bulletin, run_id: str, after: int
) -> AsyncIterator[ScanEvent | JobEvent]:
    """Yield the events of a scan or job after the given one, as they come, until it has ended or the service ends."""
    while not bulletin.closed:
        news = bulletin.news()
        # in this order: what is added after the first call is news
        ended = await storage.call(Storage.has_ended, run_id)
        events = await storage.call(Storage.events, run_id, after)
        for event in events:
            after = event.id
            yield event
        if ended:
            return
        if not events:
            await news.wait()


def sse(event: ScanEvent | JobEvent) -> dict[str, str]:
    """Return an event in the shape sse-starlette sends."""
    return {"id": str(event.id), "event": event.kind, "data": json.dumps(event.model_dump(mode="json"))}
