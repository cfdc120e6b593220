"""Recorded data: scenes in ROBI's layout, and captures that calibrations are made from."""
