"""Recorded data sets and the comparison of strategies against the truth."""
