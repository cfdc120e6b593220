"""Softmax, clusters and like poses, against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sidelong.detection.clusters import cluster, distinct, softmax
from sidelong.errors import SettingsError
from sidelong.geometry.symmetry import Symmetry
from sidelong.geometry.transforms import rotation_about


def test_softmax_of_the_worked_example():
    probabilities = softmax(np.array([92.0, 90.0, 88.0, 85.0, 80.0]), 1.0)
    expected = np.exp([0.0, -2.0, -4.0, -7.0, -12.0])
    np.testing.assert_allclose(probabilities, expected / expected.sum(), rtol=1e-12)


def test_softmax_of_two_scores_is_the_logistic_function():
    np.testing.assert_allclose(softmax(np.array([3.0, 0.0]), 6.0)[0], 1 / (1 + np.exp(-0.5)), rtol=1e-14)


def test_softmax_of_huge_scores_does_not_overflow():
    np.testing.assert_allclose(softmax(np.array([1e4, 1e4 - np.log(3.0)]), 1.0), [0.75, 0.25], rtol=1e-9)


def test_softmax_of_equal_scores_is_uniform():
    np.testing.assert_allclose(softmax(np.full(7, 88.0), 0.01), np.full(7, 1 / 7), rtol=1e-14)


def test_softmax_of_nothing_is_nothing():
    assert softmax(np.zeros(0), 1.0).shape == (0,)


@given(st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=20), st.floats(0.1, 100), st.floats(-1e3, 1e3))
def test_softmax_sums_to_one_and_ignores_an_offset(scores: list[float], temperature: float, offset: float):
    probabilities = softmax(np.array(scores), temperature)
    assert probabilities.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(softmax(np.array(scores) + offset, temperature), probabilities, atol=1e-8)


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan")])
def test_softmax_refuses_a_temperature_that_is_not_positive(temperature: float):
    with pytest.raises(SettingsError, match=r"temperature: is .*greater than 0"):
        softmax(np.ones(2), temperature)


def test_cluster_gathers_around_the_best_that_is_left():
    uv = np.array([[0.0, 0.0], [100.0, 0.0], [3.0, 0.0], [104.0, 0.0], [8.0, 0.0]])
    found = cluster(uv, np.full(5, 5.0), max_clusters=10)
    assert [members.tolist() for members in found] == [[0, 2], [1, 3], [4]]


def test_cluster_stops_at_the_limit():
    assert len(cluster(np.arange(20.0).reshape(10, 2) * 50, np.full(10, 5.0), max_clusters=3)) == 3


def test_distinct_keeps_the_first_of_like_poses():
    rotations = np.stack([rotation_about((0, 0, 1), np.radians(a)) for a in (0, 5, 30, 33, 60)])
    kept = distinct(rotations, np.full(5, 0.7), np.radians(12), limit=10)
    assert kept.tolist() == [0, 2, 4]


def test_distinct_tells_distances_apart_and_stops_at_the_limit():
    same = np.stack([np.eye(3)] * 4)
    distances_m = np.array([0.60, 0.62, 0.80, 1.2])
    assert distinct(same, distances_m, np.radians(12), limit=10).tolist() == [0, 2, 3]
    assert distinct(same, distances_m, np.radians(12), limit=2).tolist() == [0, 2]


def test_distinct_counts_poses_once_that_the_symmetry_makes_equal():
    rotations = np.stack([rotation_about((0, 0, 1), np.radians(a)) for a in (0, 90, 45, 185)])
    square = Symmetry(np.zeros(3), np.stack([rotation_about((0, 0, 1), np.radians(a)) for a in (0, 90, 180, 270)]))
    assert distinct(rotations, np.full(4, 0.7), np.radians(12), limit=10).tolist() == [0, 1, 2, 3]
    assert distinct(rotations, np.full(4, 0.7), np.radians(12), limit=10, symmetry=square).tolist() == [0, 2]
