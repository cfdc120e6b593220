"""Steps of a depth map that are edges: those that fit neither the step before nor the one after."""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.geometry.depth_edges import depth_jumps, neighbours, typical

NAN = np.nan
STEP = 0.01
"""Of the depth: 5 mm at 0.5 m."""


def jumps(*depths_m: float) -> list[int]:
    """Return before which depths of a row there is an edge."""
    with np.errstate(invalid="ignore"):
        found = depth_jumps(1.0 / np.array([depths_m]), 1, STEP)
    return [int(index) + 1 for index in np.flatnonzero(found)]


def ramp(first_m: float, step_m: float, count: int) -> list[float]:
    """Depths that are affine in 1/z, as a plane's are."""
    return list(1.0 / (1.0 / first_m - np.arange(count) * step_m / first_m**2))


@pytest.mark.parametrize(
    ("depths_m", "expected"),
    [
        ([0.5] * 5 + [0.6] * 5, [5]),
        ([0.6] * 5 + [0.5] * 5, [5]),
        ([0.5] * 5 + [0.504] * 5, []),
        ([0.5] * 5 + [0.506] * 5, [5]),
        (ramp(0.5, 0.02, 10), []),
        ([0.5] * 5 + ramp(0.5, 0.02, 6)[1:], []),
        ([0.6] * 4 + [0.5, 0.5] + [0.6] * 4, [4, 5, 6]),  # the step between two large ones is odd, too
        ([0.6] * 4 + [0.5] + [0.6] * 4, [4, 5]),
        ([0.5] * 4 + [0.6, NAN] + [0.5] * 4, [4]),
        ([0.5] * 4 + [NAN] + [0.6] * 4, []),
        ([NAN, 0.5, 0.6, NAN], []),
    ],
    ids=[
        "step back", "step forward", "small step", "just large enough", "steep plane", "crease", "bar", "wire",
        "before a hole", "across a hole", "nothing to compare with",
    ],
)  # fmt: skip
def test_a_step_is_an_edge_where_it_fits_neither_neighbour(depths_m: list[float], expected: list[int]) -> None:
    assert jumps(*depths_m) == expected


def test_columns_are_searched_as_rows_are() -> None:
    inverse = 1.0 / np.where(np.arange(12)[:, None] < 7, 0.5, 0.6) * np.ones((1, 9))
    assert np.array_equal(depth_jumps(inverse, 0, STEP), depth_jumps(np.ascontiguousarray(inverse.T), 1, STEP).T)
    assert np.flatnonzero(depth_jumps(inverse, 0, STEP).any(axis=1)).tolist() == [6]
    assert not depth_jumps(inverse, 1, STEP).any()


def test_noise_alone_makes_few_edges() -> None:
    """Of white noise far larger than the step asked for, 1 step in 6,000 is taken for an edge."""
    inverse = 1.0 / (0.5 + 1e-3 * np.random.default_rng(0).standard_normal((400, 500)))
    assert depth_jumps(inverse, 1, 1e-6).mean() < 5e-4


def test_neighbours_are_views_and_the_typical_value_is_the_median_of_what_is_known() -> None:
    image = np.arange(12.0).reshape(3, 4)
    before, after = neighbours(image, 1)
    assert np.shares_memory(before, image)
    assert (after - before == 1.0).all()
    assert typical(np.array([[1.0, NAN, 5.0, 2.0]])) == 2.0
    assert typical(np.full((3, 3), NAN)) == 0.0
