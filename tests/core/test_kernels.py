"""Compiled loops: strips cover everything once and run at the same time; no folder to keep them in is no error."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import sidelong
from sidelong.kernels import compiled, strips, threads


@pytest.mark.parametrize("rows", [0, 1, 2, 3, 7, 1000])
@pytest.mark.parametrize("each", [1, 5])
def test_strips_cover_all_rows_once_and_in_order(rows: int, each: int) -> None:
    bounds = strips(lambda first, last: (first, last), rows, each=each)
    covered = [row for first, last in bounds for row in range(first, last)]
    assert covered == list(range(rows))
    assert len(bounds) <= each * threads()


def test_strips_run_at_the_same_time() -> None:
    if threads() == 1:
        pytest.skip("one processor")
    together = threading.Barrier(threads(), timeout=30)
    strips(lambda first, last: together.wait(), 1000)


def test_an_error_in_a_strip_reaches_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        strips(lambda first, last: 1 // 0, 10)


@compiled
def _sum_of_squares(values: np.ndarray, first: int, last: int) -> float:
    total = 0.0
    for index in range(first, last):
        total += values[index] * values[index]
    return total


def test_many_threads_may_use_strips_at_once() -> None:
    values = np.arange(10_000, dtype=np.float64)

    def total(_: int) -> float:
        return sum(strips(lambda first, last: _sum_of_squares(values, first, last), len(values), each=3))

    with ThreadPoolExecutor(4) as pool:
        totals = list(pool.map(total, range(40)))
    np.testing.assert_allclose(totals, (values**2).sum())


def test_nan_stays_nan() -> None:
    """Missing depth is NaN: rounding may be relaxed in loops, the meaning of NaN may not."""
    assert np.isnan(_sum_of_squares(np.array([1.0, np.nan]), 0, 2))


def test_where_nothing_can_be_kept_it_is_compiled_anew(tmp_path: Path) -> None:
    """A read-only installation of a user without a home folder."""
    (tmp_path / "loops.py").write_text(
        "from sidelong.kernels import compiled\n\n@compiled\ndef double(x):\n    return 2 * x\n\nprint(double(21))\n"
    )
    environment = {
        **os.environ,
        "HOME": "/nonexistent",
        "XDG_CACHE_HOME": "/nonexistent",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    tmp_path.chmod(0o555)
    try:
        ran = subprocess.run(
            [sys.executable, "loops.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
        )
    finally:
        tmp_path.chmod(0o755)
    assert ran.stdout.strip() == "42", ran.stderr


def test_what_is_kept_is_forgotten_when_another_file_of_loops_changes(tmp_path: Path) -> None:
    """A loop calls a loop of another file, which then changes: numba alone would go on with the old one."""
    package = tmp_path / "sidelong"
    shutil.copytree(Path(sidelong.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "callee.py").write_text(
        "from sidelong.kernels import compiled\n\n@compiled\ndef answer():\n    return 1\n"
    )
    (package / "caller.py").write_text(
        "from sidelong.kernels import compiled\nfrom sidelong.callee import answer\n\n"
        "@compiled\ndef asked():\n    return answer() + 40\n\nprint(asked(), len(asked.stats.cache_hits))\n"
    )
    command = [sys.executable, "-c", "import sidelong.caller"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def asked() -> str:
        ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=True)
        return ran.stdout.strip()

    assert [asked(), asked()] == ["41 0", "41 1"]
    changed = (package / "callee.py").read_text().replace("return 1", "return 2")
    (package / "callee.py").write_text(changed)
    assert asked() == "42 0"
