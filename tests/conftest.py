"""Settings for all tests."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

# shared machines stall: a slow example is no failure; CI judges a change by the same examples every time, whoever
# runs the tests by hand looks for new ones
settings.register_profile(
    "sidelong", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize="CI" in os.environ
)
settings.load_profile("sidelong")
