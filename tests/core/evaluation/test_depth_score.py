"""Errors of a completed depth against the truth, in closed forms, and whether its sigma is honest."""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.evaluation.depth_score import DepthErrors, depth_errors, score_depth
from sidelong.evaluation.metrics import Truth, seen_m
from sidelong.types import CompletedDepth, FloatArray, PixelState

NAN = np.nan
TRUTH_M = 0.5


def completed(
    error_m: FloatArray, sigma_m: float = 1e-3, state: PixelState | list[PixelState] = PixelState.COMPLETED
) -> CompletedDepth:
    """One row of depth that is so far from 0.5 m."""
    depth_m = TRUTH_M + np.asarray(error_m, dtype=np.float64)[None]
    states = np.broadcast_to(np.array(state, dtype=np.uint8), depth_m.shape)
    return CompletedDepth(depth_m, np.full(depth_m.shape, sigma_m), np.ones(depth_m.shape, dtype=np.intp), states)


def truth(count: int, on_parts: list[bool] | None = None) -> Truth:
    shape = (1, count)
    parts = np.ones(shape, dtype=bool) if on_parts is None else np.array([on_parts])
    return Truth(np.full(shape, TRUTH_M), parts, np.zeros(shape, dtype=bool))


def errors(depth: CompletedDepth) -> DepthErrors:
    return score_depth(depth, truth(depth.state.size)).completed


def test_median_and_95_percent_are_of_the_absolute_error() -> None:
    """Of 0, -0.1, 0.2, ... -1.9, 2.0 mm the 11th and the 20th in size."""
    size_m = np.arange(21) * 1e-4
    found = errors(completed(size_m * np.where(np.arange(21) % 2, -1, 1)))
    assert found.pixels == 21
    assert found.median_m == pytest.approx(1.0e-3)
    assert found.p95_m == pytest.approx(1.9e-3)


def test_beyond_2_mm_are_those_that_recover_nothing() -> None:
    found = errors(completed(np.array([0.0, 1.99e-3, -1.99e-3, 2.01e-3, -2.01e-3, 0.1])))
    assert found.beyond == pytest.approx(0.5)
    assert found.recovered_p95_m == pytest.approx(1.99e-3)
    assert found.p95_m is not None
    assert found.p95_m > 0.05


@pytest.mark.parametrize(("claimed", "std", "coverage"), [(1.0, 1.0, 0.95), (2.0, 0.5, 0.9999), (0.5, 2.0, 0.673)])
def test_an_honest_sigma_has_unit_normalised_error_and_covers_95_percent(
    claimed: float, std: float, coverage: float
) -> None:
    """Of a normal distribution 95 % lie within 1.96 sigma, 67.3 % within 0.98 sigma."""
    error_m = 3e-4 * np.random.default_rng(0).standard_normal(200_000)
    found = errors(completed(error_m, sigma_m=claimed * 3e-4))
    assert found.normalised_std == pytest.approx(std, rel=0.01)
    assert found.coverage == pytest.approx(coverage, abs=0.003)


def test_outliers_have_no_part_in_the_normalised_error_but_are_not_covered() -> None:
    error_m = 1e-4 * np.random.default_rng(1).standard_normal(10_000)
    error_m[:500] = 0.05
    found = errors(completed(error_m, sigma_m=1e-4))
    assert found.normalised_std == pytest.approx(1.0, rel=0.03)
    assert found.beyond == pytest.approx(0.05)
    assert found.coverage == pytest.approx(0.95 * 0.95, abs=0.01)


def test_each_pixel_counts_by_its_state_and_by_what_it_shows() -> None:
    states = [
        PixelState.MEASURED, PixelState.MEASURED, PixelState.COMPLETED, PixelState.COMPLETED,
        PixelState.CONTRADICTED, PixelState.DOUBTFUL, PixelState.MODELLED, PixelState.MISSING,
    ]  # fmt: skip
    error_m = np.array([1e-4, 2e-4, 3e-4, 4e-4, 0.1, 0.1, 0.1, NAN])
    score = score_depth(completed(error_m, state=states), truth(8, [True, False] * 4))
    found = [score.measured_on_parts, score.measured, score.completed_on_parts, score.completed]
    assert [each.pixels for each in found] == [1, 2, 1, 2]
    assert [each.p95_m for each in found] == pytest.approx([1e-4, 1.95e-4, 3e-4, 3.95e-4])
    assert all(each.beyond == 0.0 for each in found)


def test_where_the_truth_is_unknown_or_nothing_is_asked_for_there_are_no_numbers() -> None:
    depth, unknown = completed(np.zeros(3)), truth(3)
    nothing = DepthErrors(pixels=0)
    assert depth_errors(depth, unknown, np.zeros((1, 3), dtype=bool)) == nothing
    blind = Truth(np.full((1, 3), NAN), unknown.on_parts, unknown.measured)
    assert score_depth(depth, blind).completed == nothing
    assert nothing.model_dump(exclude={"pixels"}) == dict.fromkeys(
        ("median_m", "p95_m", "beyond", "recovered_p95_m", "normalised_std", "coverage")
    )


def test_where_all_is_beyond_2_mm_sigma_is_not_judged() -> None:
    found = errors(completed(np.full(4, 0.1)))
    assert (found.beyond, found.recovered_p95_m, found.normalised_std, found.coverage) == (1.0, None, None, 0.0)


def test_a_score_survives_json() -> None:
    score = score_depth(completed(np.array([1e-4, NAN])), truth(2))
    assert type(score).model_validate_json(score.model_dump_json()) == score


def test_what_a_model_says_is_not_seen_and_what_is_doubtful_is() -> None:
    states = list(PixelState)
    depth = completed(np.where(np.array(states) == PixelState.MISSING, NAN, 0.0), state=states)
    seen = [state.name for state, value in zip(states, seen_m(depth)[0], strict=True) if np.isfinite(value)]
    assert seen == ["MEASURED", "COMPLETED", "CONTRADICTED", "DOUBTFUL"]
