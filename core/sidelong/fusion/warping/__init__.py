"""Depth maps warped into the reference view, pixel by pixel."""
