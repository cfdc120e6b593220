from __future__ import annotations

from collections.abc import Iterator

import pytest
from service_process import ServiceProcess, small_cell


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """One service for all stories of a module, with a small and quick simulated cell."""
    running = ServiceProcess(tmp_path_factory.mktemp("service"), small_cell())
    yield running
    running.close()


@pytest.fixture(scope="module")
def slow_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """The same with an arm so slow that it is sure to be caught moving."""
    running = ServiceProcess(tmp_path_factory.mktemp("slow"), small_cell(arm_speed_factor=0.5))
    yield running
    running.close()
