"""Lets the event loop use the database: a write may wait for the disk, the loop may not."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from sidelong_service.storage import Storage

P = ParamSpec("P")
T = TypeVar("T")


class StorageThread:
    """Owns a ``Storage`` on a thread of its own; calls are made one after the other, in the order they came."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="storage")
        self._storage: Storage | None = None

    async def open(self) -> None:
        """Open or create the database. Raises OSError or sqlite3.Error where that cannot be done."""
        self._storage = await asyncio.get_running_loop().run_in_executor(self._thread, Storage, self._file)

    async def call(self, method: Callable[Concatenate[Storage, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a method of the storage, as in ``await storage.call(Storage.scan, scan_id)``."""
        if self._storage is None:
            raise RuntimeError("the storage is not open")
        storage = self._storage
        return await asyncio.get_running_loop().run_in_executor(self._thread, lambda: method(storage, *args, **kwargs))

    async def close(self) -> None:
        """Close the database, after the calls that wait."""
        if self._storage is not None:
            await self.call(Storage.close)
        self._storage = None
        self._thread.shutdown(wait=False)
