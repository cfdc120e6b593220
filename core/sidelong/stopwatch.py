"""Time spent in each stage of a scan."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from contextlib import contextmanager


class Stopwatch:
    """Adds up seconds by stage. Subclass and extend :meth:`stage` to follow a scan live.

    Parameters
    ----------
    clock
        Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Count the time inside the ``with`` block under ``name``."""
        started = self._clock()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + self._clock() - started

    def lap(self) -> dict[str, float]:
        """Return seconds by stage since the last lap, and start over."""
        lap, self._seconds = self._seconds, {}
        return lap
