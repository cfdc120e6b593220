"""Settings for all tests."""

from __future__ import annotations

from hypothesis import HealthCheck, settings

# shared machines stall: a slow example is no failure
settings.register_profile("sidelong", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("sidelong")
