"""Loops that array expressions cannot say: compiled at first use, kept on disk, run on strips of an image by threads.

Threads run compiled code that has released the interpreter lock; numba's own thread pools are left alone, because the
one it falls back on aborts the process when two threads enter it, and the others clash with Open3D's TBB.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

Function = TypeVar("Function", bound=Callable[..., Any])

LARGEST_THREADS = 8


def compiled(function: Function) -> Function:
    """Compile a function of arrays and numbers to machine code at its first call; it holds no interpreter lock.

    What was compiled is kept beside the source file, or in the user's cache; where neither can be written, each process
    compiles anew.
    """
    # products may be fused with sums and quotients turned into products; NaN keeps its meaning: it is missing depth
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "arcp"}}
    dispatcher: Any = numba.njit(**options)(function)
    with suppress(RuntimeError):  # "no locator available": there is no folder to keep it in
        dispatcher._cache = _PackageCache(function)  # what cache=True does, with another cache
    return cast(Function, dispatcher)


class _PackageCache(FunctionCache):
    """Forgets what it keeps when any file of loops in this package changes.

    Numba's own looks at the file of the function alone: one that calls a changed function of another file would go on
    with what that was.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        own: Any = self
        self._cache_file = IndexDataCacheFile(
            cache_path=own._cache_path, filename_base=own._impl.filename_base, source_stamp=_stamp()
        )


@cache
def _stamp() -> str:
    """Return a digest of all files of this package that hold compiled functions."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        content = path.read_bytes()
        if b"@compiled" in content or b"@inlined" in content:
            digest.update(content)
    return digest.hexdigest()


def inlined(function: Function) -> Function:
    """Compile a function into those that call it.

    Else each call counts up and down who holds its arrays, which threads that share them wait for.
    """
    return cast(Function, numba.njit(inline="always", error_model="numpy")(function))


def strips(function: Callable[[int, int], Any], rows: int, *, each: int = 1) -> list[Any]:
    """Call ``function(first, last)`` for strips that make up ``range(rows)`` and return what they return, in order.

    Strips run at the same time: they must not write to the same entries. There are ``each`` of them for each processor:
    several where some rows are more work than others.
    """
    count = min(each * threads(), max(rows, 1))
    bounds = [rows * index // count for index in range(count + 1)]
    if count == 1:
        return [function(0, rows)]
    return list(_pool().map(function, bounds[:-1], bounds[1:]))


@cache
def threads() -> int:
    """Return how many strips are made: processors this process may use, at most ``LARGEST_THREADS``."""
    return min(len(os.sched_getaffinity(0)), LARGEST_THREADS)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads(), thread_name_prefix="strips")
