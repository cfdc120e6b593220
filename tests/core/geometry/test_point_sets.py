"""Widest pairs, distinct rows and evenly spread directions against plain computations."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from sidelong.geometry.point_sets import EXACT_POINTS, QHULL_POINTS, WIDTHS, diameter_of, distinct_rows, hemisphere
from sidelong.types import FloatArray


def on_sphere(count: int) -> FloatArray:
    half = hemisphere(count // 2)
    return np.concatenate([half, -half])


@given(seed=st.integers(0, 2**31), count=st.integers(2, 60))
def test_the_diameter_of_few_points_is_that_of_all_pairs(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    assert diameter_of(points) == pytest.approx(pdist(points).max(), rel=1e-15)


def test_the_diameter_of_many_points_is_that_of_their_hull() -> None:
    points = np.random.default_rng(0).normal(size=(EXACT_POINTS + 1000, 3)) * (1, 2, 3)
    assert diameter_of(points) == pytest.approx(pdist(points).max(), rel=1e-15)


@pytest.mark.parametrize("count", [3 * EXACT_POINTS, QHULL_POINTS + 2], ids=["all on the hull", "too many for qhull"])
def test_where_not_all_pairs_are_tried_the_diameter_is_at_most_a_little_short(count: int) -> None:
    """Opposite points of an ellipsoid with nearly equal axes: 2 x 1.001 is the longest, and it is in the set."""
    points = on_sphere(count) * (1.0, 0.999, 1.0)
    points[0] = (0.0, 0.0, 1.001)
    points[1] = (0.0, 0.0, -1.001)
    assert 2.002 * (1 - 0.0025) <= diameter_of(points) <= 2.002 * (1 + 1e-12)


def test_a_ball_of_a_million_points_takes_seconds_and_little_memory() -> None:
    points = on_sphere(1_000_000)
    started_s = time.perf_counter()
    assert diameter_of(points) == pytest.approx(2.0, rel=1e-6)
    assert time.perf_counter() - started_s < 60


def test_one_point_has_no_extent() -> None:
    assert diameter_of(np.ones((1, 3))) == 0.0


def test_no_direction_is_far_from_those_that_are_tried() -> None:
    """4 degrees shorten a width by 0.25 %: what the diameter promises."""
    tried = hemisphere(WIDTHS)
    np.testing.assert_allclose(np.linalg.norm(tried, axis=1), 1.0)
    anywhere = np.random.default_rng(0).normal(size=(100_000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    cosine = min(float(np.abs(part @ tried.T).max(axis=1).min()) for part in np.array_split(anywhere, 50))
    assert cosine > np.cos(np.deg2rad(4.0)) > 1 - 0.0025


@given(seed=st.integers(0, 2**31), count=st.integers(1, 50))
def test_distinct_rows_are_those_of_numpy(seed: int, count: int) -> None:
    rows = np.random.default_rng(seed).integers(-1, 2, size=(count, 3)).astype(np.float64)
    first, which = distinct_rows(rows)
    expected, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(rows[first], expected)
    np.testing.assert_array_equal(first, index)
    np.testing.assert_array_equal(which, inverse.reshape(-1))
